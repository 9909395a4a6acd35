//! How far a job is.

use std::{collections::BTreeSet, sync::Arc, time::Duration};

use rtfarm_core::render::Tally;

use crate::TimeLeft;

/// How far a job is.
#[derive(Debug, Clone, Default)]
pub struct Progress {
    /// Tiles in the picture.
    pub tiles_done: u32,
    /// Tiles of the picture.
    pub tile_count: u32,
    /// What the tiles in the picture took.
    pub tally: Tally,
    /// Workers that brought some of them; none where the process renders by itself.
    pub worker_count: u32,
    /// The hosts that they run on, of those that came since the coordinator's start or finished the
    /// picture.
    pub hosts: Arc<BTreeSet<String>>,
    /// Tiles of which two copies differed.
    pub differing_tiles: u32,
    /// Tiles that were taken out of the picture again, since their worker was found to lie.
    pub taken_back: u32,
    /// How often it was tried again after it had failed.
    pub retry_count: u32,
    /// Why it does not get further, unless that may change by itself.
    pub obstacle: Option<String>,
    /// How often that changed.
    pub obstacle_count: u32,
    /// How long it will take yet, if that can be told.
    pub left: Option<TimeLeft>,
    /// How it ended, once it has.
    pub outcome: Option<Outcome>,
}

/// How a job ended.
#[derive(Debug, Clone, PartialEq)]
pub enum Outcome {
    /// Every tile is in the picture, after that time.
    Finished(Duration),
    /// It will never be.
    Failed(String),
}
