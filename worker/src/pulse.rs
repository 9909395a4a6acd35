//! Carries signs of progress from the threads that render to where the worker decides.

use std::{
    sync::atomic::{AtomicU64, Ordering},
    time::Duration,
};

use tokio::{sync::mpsc, time::Instant};

/// Whoever makes progress beats it; it is heard at most once a period.
#[derive(Debug)]
pub(crate) struct Pulse {
    start: Instant,
    period: Duration,
    /// Milliseconds from `start`.
    next_beat: AtomicU64,
    send: mpsc::Sender<()>,
}

impl Pulse {
    /// Makes a pulse, and the place where its beats are heard.
    pub(crate) fn new(period: Duration) -> (Self, mpsc::Receiver<()>) {
        let (send, receive) = mpsc::channel(1);
        (Self { start: Instant::now(), period, next_beat: AtomicU64::new(0), send }, receive)
    }

    /// Event: some work was done.
    pub(crate) fn beat(&self) {
        let now = self.start.elapsed().as_millis() as u64;
        let next = self.next_beat.load(Ordering::Relaxed);
        let after = now + self.period.as_millis() as u64;
        let is_due = now >= next
            && self
                .next_beat
                .compare_exchange(next, after, Ordering::Relaxed, Ordering::Relaxed)
                .is_ok();
        if is_due {
            // When the channel is full, a beat waits to be heard already.
            let _ = self.send.try_send(());
        }
    }
}
