//! Speed against error: one scene at better and better settings, how long each takes and how far
//! its pictures are from the truth, in tables and plots.
//!
//! The command asks this about a user's scene, the report on closed forms about its own. Nothing
//! here knows where a truth comes from.

mod effort;
mod ladder;
mod report;
mod settings;

pub mod figures;
mod flip;
pub mod plot;
pub mod tables;

pub use effort::Effort;
pub use ladder::{Ladder, Reach, Reference, Rung, Series, Subject};
pub use report::{ERROR_PLOT, Report};
pub use settings::adaptive_settings;
