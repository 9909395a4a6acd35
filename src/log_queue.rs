//! Lines for standard error, written by a thread of their own: whoever logs never waits for whoever
//! reads. Lines that come close together are written together. What does not fit into the queue is
//! dropped, and how much it was is told.

use std::{
    sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError},
    thread,
    time::Duration,
};

/// Lines that wait to be written have at most so many bytes together.
const MOST_BYTES: usize = 1 << 20;

/// A queue of lines. Clones are the same one.
#[derive(Debug, Clone)]
pub(crate) struct LogQueue {
    shared: Arc<Shared>,
}

/// So many bytes are written at once, or one line: a pipe does not mix them with those of other
/// processes. Source: POSIX.1-2024, `write()`.
const PIECE: usize = 4096;

/// Lines are gathered for so long after others were written.
const PAUSE: Duration = Duration::from_millis(10);

#[derive(Debug)]
struct Shared {
    state: Mutex<State>,
    changed: Condvar,
    /// Words for a number of lines that were dropped.
    describe: fn(u64) -> String,
}

#[derive(Debug, Default)]
struct State {
    /// Lines that wait, one after the other.
    lines: Vec<u8>,
    /// Lines that were dropped after those that wait.
    dropped: u64,
    /// What the thread does.
    writer: Writer,
    /// Somebody waits for all lines to be written.
    is_flushing: bool,
}

#[derive(Debug, Default, PartialEq, Eq)]
enum Writer {
    /// It waits for a line.
    #[default]
    Idle,
    /// It gathers lines.
    Gathering,
    Writing,
}

impl LogQueue {
    /// Starts the thread, which hands lines to `write`, one or several whole ones at a time.
    pub(crate) fn start(
        describe: fn(u64) -> String,
        mut write: impl FnMut(&[u8]) + Send + 'static,
    ) -> Self {
        let state = Mutex::new(State::default());
        let shared = Arc::new(Shared { state, changed: Condvar::new(), describe });
        let queue = Self { shared: Arc::clone(&shared) };
        // Without the thread nothing is written, and nobody waits.
        let _ = thread::Builder::new().name("log".to_owned()).spawn(move || {
            loop {
                let lines = shared.next_lines();
                pieces(&lines).for_each(&mut write);
                shared.gather();
            }
        });
        queue
    }

    /// Appends a line. This never waits for it to be written.
    pub(crate) fn push(&self, line: &[u8]) {
        let mut state = self.shared.lock();
        if state.lines.len() + line.len() > MOST_BYTES {
            state.dropped += 1;
            return;
        }
        if state.dropped > 0 {
            let dropped = std::mem::take(&mut state.dropped);
            state.lines.extend((self.shared.describe)(dropped).into_bytes());
        }
        state.lines.extend_from_slice(line);
        if state.writer == Writer::Idle {
            state.writer = Writer::Gathering;
            self.shared.changed.notify_all();
        }
    }

    /// Waits until every line is written, but not longer than `patience`.
    pub(crate) fn flush(&self, patience: Duration) {
        let mut state = self.shared.lock();
        state.is_flushing = true;
        self.shared.changed.notify_all();
        let is_busy = |state: &mut State| state.writer == Writer::Writing || state.has_lines();
        let waited = self.shared.changed.wait_timeout_while(state, patience, is_busy);
        waited.unwrap_or_else(PoisonError::into_inner).0.is_flushing = false;
    }
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Waits for lines and takes them.
    fn next_lines(&self) -> Vec<u8> {
        let mut state = self.lock();
        while !state.has_lines() {
            state.writer = Writer::Idle;
            state = self.changed.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
        state.writer = Writer::Writing;
        let mut lines = std::mem::take(&mut state.lines);
        if state.dropped > 0 {
            lines.extend((self.describe)(std::mem::take(&mut state.dropped)).into_bytes());
        }
        lines
    }

    /// Lets lines come together, unless somebody waits for them.
    fn gather(&self) {
        let mut state = self.lock();
        state.writer = Writer::Gathering;
        self.changed.notify_all();
        let is_calm = |state: &mut State| !state.is_flushing;
        drop(self.changed.wait_timeout_while(state, PAUSE, is_calm));
    }
}

/// Cuts lines into pieces of whole ones.
fn pieces(mut lines: &[u8]) -> impl Iterator<Item = &[u8]> {
    std::iter::from_fn(move || {
        let is_end = |&byte: &u8| byte == b'\n';
        let end = if lines.len() <= PIECE {
            lines.len()
        } else if let Some(last) = lines[..PIECE].iter().rposition(is_end) {
            last + 1
        } else {
            lines.iter().position(is_end).map_or(lines.len(), |first| first + 1)
        };
        lines.split_off(..end).filter(|piece| !piece.is_empty())
    })
}

impl State {
    fn has_lines(&self) -> bool {
        !self.lines.is_empty() || self.dropped > 0
    }
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc;

    use super::*;

    #[test]
    fn lines_longer_than_a_piece_are_whole() {
        let long = "x".repeat(PIECE + 1);
        let lines = format!("{long}\na\nb\n{long}\n{long}");
        let pieces: Vec<&[u8]> = pieces(lines.as_bytes()).collect();
        let lengths: Vec<usize> = pieces.iter().map(|piece| piece.len()).collect();
        assert_eq!(lengths, [PIECE + 2, 4, PIECE + 2, PIECE + 1]);
    }

    #[test]
    fn who_logs_never_waits_and_dropped_lines_are_counted() {
        let (open, gate) = mpsc::channel::<()>();
        let (begin, begun) = mpsc::channel();
        let (send, written) = mpsc::channel();
        let queue = LogQueue::start(
            |count| format!("dropped {count}\n"),
            move |lines| {
                // Nobody reads until the gate is open.
                let _ = begin.send(());
                let _ = gate.recv();
                let _ = send.send(String::from_utf8(lines.to_vec()).unwrap());
            },
        );
        let count = 3 * MOST_BYTES / 1000;
        for number in 0..count {
            queue.push(format!("{number:999}\n").as_bytes());
            if number == 0 {
                begun.recv().unwrap();
            }
        }
        queue.flush(Duration::from_millis(1));
        drop(open);
        queue.flush(Duration::from_secs(60));
        queue.push(b"after\n");
        queue.flush(Duration::from_secs(60));
        let written: Vec<String> = written.try_iter().collect();
        let is_whole = |piece: &String| piece.ends_with('\n') && piece.len() <= PIECE;
        assert!(written.iter().all(is_whole) && written.len() < count / 2, "written together");
        let lines: Vec<String> = written.concat().lines().map(str::to_owned).collect();
        let (last, lines) = lines.split_last().unwrap();
        let (told, lines) = lines.split_last().unwrap();
        assert_eq!(last, "after");
        let numbers: Vec<usize> = lines.iter().map(|line| line.trim().parse().unwrap()).collect();
        assert!(numbers.iter().copied().eq(0..numbers.len()), "the first ones, in their order");
        assert!(numbers.len() >= MOST_BYTES / 1000 && numbers.len() < count);
        assert_eq!(*told, format!("dropped {}", count - numbers.len()));
    }
}
