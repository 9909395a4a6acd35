//! Carries finished tiles from the threads that render to where the worker decides.

use std::sync::{Mutex, MutexGuard, PoisonError};

use tokio::{
    sync::Notify,
    time::{Instant, sleep_until},
};

use crate::task::{Rendered, TURN};

/// Tiles that the threads are done with. They wait for each other for a turn at most, and for
/// nobody when a thread is about to have nothing to do.
#[derive(Debug)]
pub(crate) struct Outbox {
    threads: usize,
    state: Mutex<State>,
    due: Notify,
}

#[derive(Debug)]
struct State {
    rendered: Vec<Rendered>,
    /// Renderings that have not ended.
    at_hand: usize,
    /// When the turn ends that began when tiles were last taken.
    turn_ends: Instant,
}

impl Outbox {
    pub(crate) fn new(threads: usize) -> Self {
        let state = State { rendered: Vec::new(), at_hand: 0, turn_ends: Instant::now() };
        Self { threads, state: Mutex::new(state), due: Notify::new() }
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Event: a tile is handed to the threads.
    pub(crate) fn on_begun(&self) {
        self.state().at_hand += 1;
    }

    /// Event: a thread is done with a tile.
    pub(crate) fn put(&self, rendered: Rendered) {
        let mut state = self.state();
        state.rendered.push(rendered);
        state.at_hand -= 1;
        if state.at_hand <= self.threads || Instant::now() >= state.turn_ends {
            self.due.notify_one();
        }
    }

    /// Waits until there may be tiles to be taken.
    pub(crate) async fn due(&self) {
        let turn_ends = self.state().turn_ends;
        tokio::select! {
            biased;
            () = self.due.notified() => {}
            () = sleep_until(turn_ends), if Instant::now() < turn_ends => {}
        }
    }

    /// Takes all tiles. A turn begins if there are any.
    pub(crate) fn take(&self) -> Vec<Rendered> {
        let mut state = self.state();
        if !state.rendered.is_empty() {
            state.turn_ends = Instant::now() + TURN;
        }
        std::mem::take(&mut state.rendered)
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use tokio::time::{advance, timeout};

    use super::*;
    use crate::task::TaskId;

    /// Says whether tiles are due within that time.
    async fn is_due(outbox: &Outbox, time: Duration) -> bool {
        timeout(time, outbox.due()).await.is_ok()
    }

    #[tokio::test(start_paused = true)]
    async fn tiles_wait_for_each_other_for_a_turn_and_not_while_a_thread_has_nothing_to_do() {
        let tick = Duration::from_millis(1);
        let outbox = Outbox::new(1);
        (0..9).for_each(|_| outbox.on_begun());
        let put = || outbox.put((TaskId::default(), None));
        put();
        assert!(is_due(&outbox, tick).await, "the first waits for nobody");
        assert_eq!(outbox.take().len(), 1);
        put();
        put();
        assert!(!is_due(&outbox, TURN / 2).await, "a turn has begun");
        assert!(is_due(&outbox, TURN).await, "it is over");
        assert_eq!(outbox.take().len(), 2);
        assert!(is_due(&outbox, 2 * TURN).await && outbox.take().is_empty());
        assert!(!is_due(&outbox, 9 * TURN).await, "nothing has come");
        advance(TURN).await;
        put();
        assert!(is_due(&outbox, tick).await, "the turn was over long ago");
        assert_eq!(outbox.take().len(), 1);
        (0..4).for_each(|_| put());
        assert!(is_due(&outbox, tick).await, "the thread has its last tile");
        assert_eq!(outbox.take().len(), 4);
    }
}
