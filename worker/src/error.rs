//! Why a worker ends.

use rayon::ThreadPoolBuildError;
use rtfarm_proto::Address;

use crate::scene::SceneError;

/// Why a worker ends before it is told to.
#[derive(Debug, thiserror::Error)]
pub enum WorkerError {
    /// Nobody answers at the address.
    #[error("no coordinator answers at {0}: {1}")]
    Connect(Address, String),
    /// The coordinator does not accept this worker.
    #[error("the coordinator refuses this worker: {0}")]
    Refused(String),
    /// The coordinator does not answer any more.
    #[error("the coordinator is gone: {0}")]
    Gone(String),
    /// The coordinator's answer cannot be understood.
    #[error("the coordinator's answer makes no sense: {0}")]
    Nonsense(String),
    /// A job's scene cannot be rendered.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// The system starts no threads.
    #[error("cannot start threads: {0}")]
    Threads(#[from] ThreadPoolBuildError),
    /// The system gives no random number.
    #[error("the system gives no random numbers: {0}")]
    Random(#[from] rustix::io::Errno),
}
