//! How a worker works.

use std::time::Duration;

use rtfarm_core::isa::Isa;
use rtfarm_proto::Address;

/// How a worker works.
#[derive(Debug, Clone)]
pub struct Config {
    /// Where its coordinator is.
    pub coordinator: Address,
    /// Threads that render, at least 1.
    pub threads: usize,
    /// The instruction set that they render with.
    pub isa: Isa,
    /// The version of the package; the coordinator must have the same.
    pub version: String,
    /// How long it goes on without a coordinator, from the first failure on.
    pub patience: Duration,
}
