//! Signs of progress, on their way from the threads that render to the coordinator.

use std::{
    sync::atomic::{AtomicU64, Ordering},
    time::Duration,
};

use tokio::{sync::mpsc, time::Instant};

/// Beaten by whoever makes progress; heard at most once a period.
#[derive(Debug)]
pub(crate) struct Pulse {
    start: Instant,
    period: Duration,
    /// Milliseconds from `start`.
    next_beat: AtomicU64,
    send: mpsc::Sender<()>,
}

impl Pulse {
    /// A pulse, and where its beats are heard.
    pub(crate) fn new(period: Duration) -> (Self, mpsc::Receiver<()>) {
        let (send, receive) = mpsc::channel(1);
        (Self { start: Instant::now(), period, next_beat: AtomicU64::new(0), send }, receive)
    }

    /// Some work was done.
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
            // Full: one is waiting to be heard already.
            let _ = self.send.try_send(());
        }
    }
}
