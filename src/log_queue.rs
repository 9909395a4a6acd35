//! Lines for standard error, written by a thread of their own: whoever logs never waits for whoever
//! reads. What does not fit into the queue is dropped, and how much it was is told.

use std::{
    collections::VecDeque,
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

#[derive(Debug)]
struct Shared {
    state: Mutex<State>,
    changed: Condvar,
    /// Words for a number of lines that were dropped.
    describe: fn(u64) -> String,
}

#[derive(Debug, Default)]
struct State {
    lines: VecDeque<Vec<u8>>,
    byte_count: usize,
    /// Lines that were dropped after those that wait.
    dropped: u64,
    is_writing: bool,
}

impl LogQueue {
    /// Starts the thread, which hands one line after the other to `write`.
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
                let line = shared.next_line();
                write(&line);
            }
        });
        queue
    }

    /// Appends a line. This never waits for it to be written.
    pub(crate) fn push(&self, line: Vec<u8>) {
        let mut state = self.shared.lock();
        if state.byte_count + line.len() > MOST_BYTES {
            state.dropped += 1;
            return;
        }
        if state.dropped > 0 {
            let dropped = std::mem::take(&mut state.dropped);
            state.append((self.shared.describe)(dropped).into_bytes());
        }
        state.append(line);
        self.shared.changed.notify_all();
    }

    /// Waits until every line is written, but not longer than `patience`.
    pub(crate) fn flush(&self, patience: Duration) {
        let is_busy =
            |state: &mut State| state.is_writing || !state.lines.is_empty() || state.dropped > 0;
        let state = self.shared.lock();
        drop(self.shared.changed.wait_timeout_while(state, patience, is_busy));
    }
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Waits for the next line.
    fn next_line(&self) -> Vec<u8> {
        let mut state = self.lock();
        state.is_writing = false;
        self.changed.notify_all();
        loop {
            if let Some(line) = state.lines.pop_front() {
                state.byte_count -= line.len();
                state.is_writing = true;
                return line;
            }
            if state.dropped > 0 {
                state.is_writing = true;
                return (self.describe)(std::mem::take(&mut state.dropped)).into_bytes();
            }
            state = self.changed.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
    }
}

impl State {
    fn append(&mut self, line: Vec<u8>) {
        self.byte_count += line.len();
        self.lines.push_back(line);
    }
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc;

    use super::*;

    #[test]
    fn who_logs_never_waits_and_dropped_lines_are_counted() {
        let (open, gate) = mpsc::channel::<()>();
        let (send, written) = mpsc::channel();
        let queue = LogQueue::start(
            |count| format!("dropped {count}"),
            move |line| {
                // Nobody reads until the gate is open.
                let _ = gate.recv();
                let _ = send.send(String::from_utf8(line.to_vec()).unwrap());
            },
        );
        let count = 3 * MOST_BYTES / 1000;
        for number in 0..count {
            queue.push(format!("{number:1000}").into_bytes());
        }
        queue.flush(Duration::from_millis(1));
        drop(open);
        queue.flush(Duration::from_secs(60));
        queue.push(b"after".to_vec());
        queue.flush(Duration::from_secs(60));
        let lines: Vec<String> = written.try_iter().collect();
        let (last, lines) = lines.split_last().unwrap();
        let (told, lines) = lines.split_last().unwrap();
        assert_eq!(last, "after");
        let numbers: Vec<usize> = lines.iter().map(|line| line.trim().parse().unwrap()).collect();
        assert!(numbers.iter().copied().eq(0..numbers.len()), "the first ones, in their order");
        assert!(numbers.len() >= MOST_BYTES / 1000 && numbers.len() < count);
        assert_eq!(*told, format!("dropped {}", count - numbers.len()));
    }
}
