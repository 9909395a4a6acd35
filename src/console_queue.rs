//! What is to be said on standard error and shown there, written by a thread of its own: whoever
//! says it never waits for whoever reads. What comes close together is written together. Lines that
//! do not fit into the queue are dropped, and how many there were is told; of bars and pictures
//! only the last waits.

use std::{
    mem,
    sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError},
    thread,
    time::Duration,
};

use crate::terminal::Drawing;

/// What waits to be written has at most so many bytes, besides the picture that is under way.
const MOST_BYTES: usize = 1 << 20;

/// A queue for standard error. Clones are the same one.
#[derive(Debug, Clone)]
pub(crate) struct ConsoleQueue {
    shared: Arc<Shared>,
}

/// Something to be written, after what came before it.
#[derive(Debug)]
pub(crate) enum Item {
    /// Whole lines for standard error.
    Lines(Vec<u8>),
    /// A line for standard output, which is a terminal, too.
    Answer(Vec<u8>),
    /// The picture stays where it is, after this one has been drawn in its place.
    Leave(Option<Drawing>),
}

/// All that there is to write.
#[derive(Debug, Default)]
pub(crate) struct Batch {
    pub(crate) items: Vec<Item>,
    /// A picture to be drawn below them, in place of the one that is there.
    pub(crate) picture: Option<Drawing>,
    /// What the last line is to show.
    pub(crate) bar: Option<String>,
}

/// So many bytes are written at once, or one line: a pipe does not mix them with those of other
/// processes. Source: POSIX.1-2024, `write()`.
const PIECE: usize = 4096;

/// Lines are gathered for so long after others were written.
const PAUSE: Duration = Duration::from_millis(10);

/// So long while there is a bar: nobody reads one that changes more often.
const BAR_PAUSE: Duration = Duration::from_millis(100);

#[derive(Debug)]
struct Shared {
    state: Mutex<State>,
    changed: Condvar,
    /// Words for a number of lines that were dropped.
    describe: fn(u64) -> String,
}

#[derive(Debug, Default)]
struct State {
    /// What waits.
    batch: Batch,
    /// Bytes of its items.
    bytes: usize,
    /// Lines that were dropped after those that wait.
    dropped: u64,
    /// The bar is another than the one that was written last.
    is_bar_new: bool,
    /// A picture stands at the end once all that was taken from here is written.
    has_picture: bool,
    /// What the thread does.
    writer: Writer,
    /// Somebody waits for all to be written.
    is_flushing: bool,
}

#[derive(Debug, Default, PartialEq, Eq)]
enum Writer {
    /// It waits for something to write.
    #[default]
    Idle,
    /// It lets more come together.
    Gathering,
    Writing,
}

impl ConsoleQueue {
    /// Starts the thread, which hands on what there is to write.
    pub(crate) fn start(
        describe: fn(u64) -> String,
        mut write: impl FnMut(Batch) + Send + 'static,
    ) -> Self {
        let state = Mutex::new(State::default());
        let shared = Arc::new(Shared { state, changed: Condvar::new(), describe });
        let queue = Self { shared: Arc::clone(&shared) };
        // Without the thread nothing is written, and nobody waits.
        let _ = thread::Builder::new().name("console".to_owned()).spawn(move || {
            loop {
                write(shared.next_batch());
                shared.gather();
            }
        });
        queue
    }

    /// Appends a line for standard error. This never waits for it to be written.
    pub(crate) fn push(&self, line: Vec<u8>) {
        self.append(line, Item::Lines);
    }

    /// Appends a line for standard output, in the same way.
    pub(crate) fn answer(&self, line: Vec<u8>) {
        self.append(line, Item::Answer);
    }

    fn append(&self, line: Vec<u8>, item: fn(Vec<u8>) -> Item) {
        let mut state = self.shared.lock();
        if state.bytes + line.len() > MOST_BYTES {
            state.dropped += 1;
            return;
        }
        state.tell_dropped(self.shared.describe);
        state.bytes += line.len();
        state.append(item(line));
        self.shared.wake(&mut state);
    }

    /// Has the last line show this, or nothing, from now on.
    pub(crate) fn show_bar(&self, bar: Option<String>) {
        let mut state = self.shared.lock();
        state.batch.bar = bar;
        state.is_bar_new = true;
        self.shared.wake(&mut state);
    }

    /// Draws a picture below all lines, in place of the one that is there or waits.
    pub(crate) fn draw(&self, drawing: Drawing) {
        let mut state = self.shared.lock();
        state.batch.picture = Some(drawing);
        self.shared.wake(&mut state);
    }

    /// Lets the picture stand where it is: what comes next is written below it.
    pub(crate) fn leave_picture(&self) {
        let mut state = self.shared.lock();
        let picture = state.batch.picture.take();
        // Where nobody reads pictures must not pile up.
        let picture = picture.filter(|_| state.bytes <= MOST_BYTES);
        state.bytes += picture.as_ref().map_or(0, |picture| picture.bytes.len());
        state.batch.items.push(Item::Leave(picture));
        self.shared.wake(&mut state);
    }

    /// Whether a picture stands at the end, or will.
    pub(crate) fn has_picture(&self) -> bool {
        let state = self.shared.lock();
        state.has_picture || state.batch.picture.is_some()
    }

    /// Whether a picture waits to be written.
    pub(crate) fn is_drawing(&self) -> bool {
        self.shared.lock().batch.picture.is_some()
    }

    /// Waits until all is written, but not longer than `patience`.
    pub(crate) fn flush(&self, patience: Duration) {
        let mut state = self.shared.lock();
        state.is_flushing = true;
        self.shared.changed.notify_all();
        let is_busy = |state: &mut State| state.writer == Writer::Writing || state.has_work();
        let waited = self.shared.changed.wait_timeout_while(state, patience, is_busy);
        waited.unwrap_or_else(PoisonError::into_inner).0.is_flushing = false;
    }
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn wake(&self, state: &mut State) {
        if state.writer == Writer::Idle {
            state.writer = Writer::Gathering;
            self.changed.notify_all();
        }
    }

    /// Waits for something to write and takes it.
    fn next_batch(&self) -> Batch {
        let mut state = self.lock();
        while !state.has_work() {
            state.writer = Writer::Idle;
            state = self.changed.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
        state.writer = Writer::Writing;
        state.tell_dropped(self.describe);
        state.take()
    }

    /// Lets more come together, unless somebody waits for it to be written.
    fn gather(&self) {
        let mut state = self.lock();
        state.writer = Writer::Gathering;
        self.changed.notify_all();
        let pause = if state.batch.bar.is_some() { BAR_PAUSE } else { PAUSE };
        let is_calm = |state: &mut State| !state.is_flushing;
        drop(self.changed.wait_timeout_while(state, pause, is_calm));
    }
}

/// Cuts lines into pieces of whole ones.
pub(crate) fn pieces(mut lines: &[u8]) -> impl Iterator<Item = &[u8]> {
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
    fn has_work(&self) -> bool {
        let Self { batch: Batch { items, picture, .. }, dropped, is_bar_new, .. } = self;
        !items.is_empty() || picture.is_some() || *dropped > 0 || *is_bar_new
    }

    fn append(&mut self, item: Item) {
        match (self.batch.items.last_mut(), item) {
            (Some(Item::Lines(lines)), Item::Lines(more)) => lines.extend(more),
            (_, item) => self.batch.items.push(item),
        }
    }

    fn tell_dropped(&mut self, describe: fn(u64) -> String) {
        if self.dropped > 0 {
            let told = describe(mem::take(&mut self.dropped));
            self.append(Item::Lines(told.into_bytes()));
        }
    }

    fn take(&mut self) -> Batch {
        let Batch { items, picture, bar } = &mut self.batch;
        let batch = Batch { items: mem::take(items), picture: picture.take(), bar: bar.clone() };
        (self.bytes, self.is_bar_new) = (0, false);
        // What is written takes the place of a picture or leaves it.
        self.has_picture = batch.picture.is_some() || self.has_picture && batch.items.is_empty();
        batch
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
        let queue = ConsoleQueue::start(
            |count| format!("dropped {count}\n"),
            move |batch| {
                // Nobody reads until the gate is open.
                let _ = begin.send(());
                let _ = gate.recv();
                for item in batch.items {
                    let Item::Lines(lines) = item else { panic!("{item:?}") };
                    for piece in pieces(&lines) {
                        let _ = send.send(String::from_utf8(piece.to_vec()).unwrap());
                    }
                }
            },
        );
        let count = 3 * MOST_BYTES / 1000;
        for number in 0..count {
            queue.push(format!("{number:999}\n").into_bytes());
            if number == 0 {
                begun.recv().unwrap();
            }
        }
        queue.flush(Duration::from_millis(1));
        drop(open);
        queue.flush(Duration::from_secs(60));
        queue.push(b"after\n".to_vec());
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

    #[test]
    fn where_nobody_reads_the_last_picture_and_bar_wait_and_left_ones_do_not_pile_up() {
        let (open, gate) = mpsc::channel::<()>();
        let (begin, begun) = mpsc::channel();
        let (send, written) = mpsc::channel();
        let queue = ConsoleQueue::start(
            |_| String::new(),
            move |batch| {
                let _ = begin.send(());
                let _ = gate.recv();
                let _ = send.send(batch);
            },
        );
        let drawing =
            |name: u8| Drawing { bytes: vec![name; MOST_BYTES / 2], rows: 1, erase: String::new() };
        queue.push(b"first\n".to_vec());
        begun.recv().unwrap();
        assert!(!queue.has_picture());
        for name in 0..10 {
            queue.draw(drawing(name));
            queue.show_bar(Some(name.to_string()));
            assert!(queue.has_picture() && queue.is_drawing());
        }
        for name in 10..20 {
            queue.draw(drawing(name));
            queue.leave_picture();
        }
        queue.draw(drawing(20));
        drop(open);
        queue.flush(Duration::from_secs(60));
        assert!(queue.has_picture() && !queue.is_drawing());
        let _ = written.recv().unwrap();
        let Batch { items, picture, bar } = written.recv().unwrap();
        let left = items.iter().map(|item| match item {
            Item::Leave(picture) => picture.as_ref().map(|picture| picture.bytes[0]),
            _ => panic!("{item:?}"),
        });
        let expected: Vec<Option<u8>> = (10..20).map(|name| (name < 13).then_some(name)).collect();
        assert_eq!(left.collect::<Vec<_>>(), expected);
        assert_eq!((picture.unwrap().bytes[0], bar.as_deref()), (20, Some("9")));
    }
}
