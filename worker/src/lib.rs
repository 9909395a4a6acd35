//! A worker of a farm: it joins a coordinator, renders the tiles that it is leased and brings
//! the pixels. What is rendered, and by whom, the coordinator decides.
//!
//! `worker` decides what this process does next, with `task` for what it waits for: pure
//! state machines with events in, actions out and time as an argument. [`run()`] is their shell.

mod call;
mod client;
mod config;
mod error;
mod job;
mod map;
mod memory;
mod outbox;
mod outside;
mod parent;
mod pulse;
mod reference;
mod run;
mod scene;
mod task;
mod worker;

pub use config::Config;
pub use error::WorkerError;
pub use memory::memory_for_scenes;
pub use parent::{ParentError, die_with_parent};
pub use reference::reference;
pub use run::run;
pub use scene::SceneError;

/// A door for simulations.
#[doc(hidden)]
pub mod simulation {
    pub use crate::{outside::Outside, run::run_in};
}
