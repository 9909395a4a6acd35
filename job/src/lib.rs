//! What is rendered, whoever renders it: a request becomes an order with the scene's text, the
//! order a job, which reports how far it is, tile by tile, until it ends.
//!
//! A process that renders alone, a coordinator and its clients all speak of jobs in these words.

mod log;
mod order;
mod progress;
mod provenance;
mod time_left;

pub use log::FinishedTile;
pub use order::{MOST_TILES, Order, Placed, ReadyScene, Refusal, RenderRequest};
pub use progress::{Outcome, Progress};
pub use provenance::{Provenance, ProvenanceError};
pub use time_left::{TileCosts, TimeLeft};
