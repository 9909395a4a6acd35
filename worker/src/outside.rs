//! What a worker reaches the world by: the network and threads, or what a simulation puts there.

use std::panic::resume_unwind;

use rayon::{ThreadPool, ThreadPoolBuildError, ThreadPoolBuilder};
use rtfarm_proto::{Access, Connection, Reached};
use tokio::time::Instant;

/// What a worker reaches the world by.
pub trait Outside: Send + Sync + 'static {
    /// Reaches a coordinator.
    type Connection: Connection;

    /// Reaches a coordinator, or says why it cannot.
    fn connect(
        &self,
        access: &Access,
    ) -> impl Future<Output = Result<Self::Connection, String>> + Send;

    /// Hands work to the threads, which begin what came earlier first, and tell it when it begins.
    fn render(&self, work: impl FnOnce(Instant) + Send + 'static);

    /// Does work that takes a while and waits for files.
    fn block<T: Send + 'static>(
        &self,
        work: impl FnOnce() -> T + Send + 'static,
    ) -> impl Future<Output = T> + Send;
}

/// This machine.
pub(crate) struct Machine {
    pool: ThreadPool,
}

impl Machine {
    pub(crate) fn new(threads: usize) -> Result<Self, ThreadPoolBuildError> {
        let pool = ThreadPoolBuilder::new()
            .num_threads(threads)
            .thread_name(|index| format!("render-{index}"))
            .build()?;
        Ok(Self { pool })
    }
}

impl Outside for Machine {
    type Connection = Reached;

    async fn connect(&self, access: &Access) -> Result<Reached, String> {
        access.connect().await.map_err(|error| error.to_string())
    }

    fn render(&self, work: impl FnOnce(Instant) + Send + 'static) {
        self.pool.spawn_fifo(move || work(Instant::now()));
    }

    async fn block<T: Send + 'static>(&self, work: impl FnOnce() -> T + Send + 'static) -> T {
        let done = tokio::task::spawn_blocking(work).await;
        done.unwrap_or_else(|error| resume_unwind(error.into_panic()))
    }
}
