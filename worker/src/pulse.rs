//! Carries signs of progress from the threads that render to where the worker decides.

use std::{
    collections::BTreeMap,
    mem,
    sync::{
        Mutex, PoisonError,
        atomic::{AtomicU64, Ordering},
    },
    time::Duration,
};

use rtfarm_core::tile::TileId;
use rtfarm_proto::LeaseName;
use tokio::{sync::mpsc, time::Instant};

/// What steps were made for: a tile of a lease, or the lease's scene.
pub(crate) type Object = (LeaseName, Option<TileId>);

/// Whoever makes progress beats it; it is heard at most once a period.
#[derive(Debug)]
pub(crate) struct Pulse {
    start: Instant,
    period: Duration,
    /// Milliseconds from `start`.
    next_beat: AtomicU64,
    send: mpsc::Sender<()>,
    /// Beats that nobody has counted yet.
    beats: Mutex<BTreeMap<Object, u64>>,
}

impl Pulse {
    /// Makes a pulse, and the place where its beats are heard.
    pub(crate) fn new(period: Duration) -> (Self, mpsc::Receiver<()>) {
        let (send, receive) = mpsc::channel(1);
        let (start, next_beat) = (Instant::now(), AtomicU64::new(0));
        (Self { start, period, next_beat, send, beats: Mutex::default() }, receive)
    }

    /// Event: a step was made for a tile of a lease, or for the lease's scene.
    pub(crate) fn beat(&self, object: Object) {
        *self.beats.lock().unwrap_or_else(PoisonError::into_inner).entry(object).or_default() += 1;
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

    /// Counts the beats since they were counted last.
    pub(crate) fn count(&self) -> BTreeMap<Object, u64> {
        mem::take(&mut *self.beats.lock().unwrap_or_else(PoisonError::into_inner))
    }
}
