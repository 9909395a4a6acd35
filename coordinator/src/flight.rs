//! How much of what is sent may be in memory at once, of all peers together: more waits.

use std::sync::Arc;

use rtfarm_proto::CHUNK_BYTES;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};

/// What may be in memory one way. Clones are the same one.
#[derive(Debug, Clone)]
pub(crate) struct Flight {
    /// A place for each [`CHUNK_BYTES`].
    places: Arc<Semaphore>,
    count: u32,
}

impl Flight {
    /// At least one piece fits in.
    pub(crate) fn new(byte_count: u64) -> Self {
        let count = (byte_count / CHUNK_BYTES as u64).clamp(1, 1 << 24) as u32;
        Self { places: Arc::new(Semaphore::new(count as usize)), count }
    }

    /// Waits until there is room for so many bytes, which is taken until the answer is dropped. Who
    /// waits longest is first. What is larger than all there may be has all to itself.
    pub(crate) async fn take(&self, byte_count: usize) -> OwnedSemaphorePermit {
        let count = (byte_count.div_ceil(CHUNK_BYTES) as u32).min(self.count);
        let places = Arc::clone(&self.places);
        places.acquire_many_owned(count).await.expect("it is never closed")
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use tokio::time::timeout;

    use super::*;

    #[tokio::test(start_paused = true)]
    async fn what_has_no_room_waits_and_the_longest_waiting_is_first() {
        let flight = Flight::new(3 * CHUNK_BYTES as u64);
        let first = flight.take(1).await;
        let large = tokio::spawn({
            let flight = flight.clone();
            async move { flight.take(9 * CHUNK_BYTES).await }
        });
        tokio::task::yield_now().await;
        let small = timeout(Duration::from_secs(1), flight.take(1)).await;
        assert!(small.is_err(), "another waits for longer");
        drop(first);
        let large = large.await.unwrap();
        assert_eq!(large.num_permits(), 3, "all there is");
        drop(large);
        let _all = flight.take(3 * CHUNK_BYTES).await;
    }
}
