//! A worker of a farm: it joins a coordinator, renders the tiles that it is leased and brings
//! the pixels. What is rendered, and by whom, the coordinator decides.

mod map;
mod parent;
mod pulse;
mod run;
mod scene;

pub use parent::{ParentError, die_with_parent};
pub use run::{Config, WorkerError, run};
