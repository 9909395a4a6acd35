//! How a worker works.

use std::time::Duration;

use rtfarm_core::isa::Isa;
use rtfarm_proto::Access;

/// How a worker works.
#[derive(Debug, Clone)]
pub struct Config {
    /// How its coordinator is reached.
    pub coordinator: Access,
    /// Threads that render, at least 1.
    pub threads: usize,
    /// The instruction set that they render with.
    pub isa: Isa,
    /// The version of the package; the coordinator must have the same.
    pub version: String,
    /// Of the sources that pixels depend on; likewise.
    pub build: String,
    /// What [`crate::reference()`] makes of the instruction set; none where the coordinator does
    /// not ask for it.
    pub reference: Option<[u8; 32]>,
    /// Bytes that prepared scenes may have here together, those of tiles in work and those that are
    /// kept; `None`: any scene is taken, and none kept that is not needed.
    pub memory: Option<u64>,
    /// How long it goes on without a coordinator, from the first call on that has no answer.
    pub patience: Duration,
}
