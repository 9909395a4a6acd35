//! The coordinator of a farm: it takes orders, leases tiles to workers and stitches what they
//! bring into pictures.
//!
//! `lease` and `jobs` decide and never wait; `service` and `run` are the shell around them.

mod job;
mod jobs;
mod lease;
mod run;
mod service;
mod store;

pub use job::Job;
pub use run::{Config, Coordinator, Listener, SubmitError};
