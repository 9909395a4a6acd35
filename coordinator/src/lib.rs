//! The coordinator of a farm: it takes orders, leases tiles to workers and stitches what they
//! bring into pictures.
//!
//! `farm` and what it is made of decide: time is an argument there, and nothing waits. `shell` runs
//! that machine: it hands events to it and does what it answers, with the files of `store` and what
//! it keeps of each `job`. `service` translates between gRPC and the shell, `page` shows a browser
//! what `live` tells, and `run` serves. Each knows only what stands before it:
//!
//! ```text
//! upload <- shell, service
//! identity, tiles, pace <- lease, members, waiting, audit <- farm, store, record <- state <- job
//! farm <- events; events, job <- shell <- live, metrics <- page; shell <- service; live, service <- run
//! security, accept <- guard, page <- service; accept <- run
//! ```

mod accept;
mod audit;
mod events;
mod farm;
mod flight;
mod guard;
mod identity;
mod job;
mod lease;
mod live;
#[cfg(test)]
mod load;
mod members;
mod metrics;
mod pace;
mod page;
mod record;
#[cfg(test)]
mod restart;
mod run;
mod security;
mod service;
mod shell;
#[cfg(test)]
mod simulation;
mod state;
#[cfg(test)]
mod steady;
mod store;
mod tiles;
mod upload;
mod waiting;
#[cfg(test)]
mod whole_farm;

pub use accept::{Limits, listen};
pub use farm::Keeping;
pub use job::Job;
pub use run::{Coordinator, Listener, ServeError};
pub use security::{Holder, Owner, Role, Security, SecurityError, renew_token, revoke_token};
pub use shell::{Config, SubmitError};
pub use state::{Durability, StateError, StateFolder};
pub use upload::OrderLimits;
