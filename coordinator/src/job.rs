//! A job: its scene, its picture, how far it is.

use std::{collections::BTreeSet, time::Duration};

use rtfarm_core::{
    render::{Settings, Tally},
    tile::TileGrid,
};
use rtfarm_picture::Picture;
use rtfarm_proto::{JobId, WorkerId};
use tokio::{sync::watch, time::Instant};

use crate::store::SceneFile;

/// A picture being rendered or ready.
#[derive(Debug)]
pub struct Job {
    pub(crate) id: JobId,
    pub(crate) name: String,
    pub(crate) scene: SceneFile,
    pub(crate) settings: Settings,
    pub(crate) grid: TileGrid,
    pub(crate) picture: Picture,
    pub(crate) started: Instant,
    pub(crate) progress: watch::Sender<Progress>,
}

/// How far a job is.
#[derive(Debug, Clone, Default)]
pub struct Progress {
    /// Tiles in the picture.
    pub tiles_done: u32,
    /// Tiles of the picture.
    pub tile_count: u32,
    /// What the tiles in the picture took.
    pub tally: Tally,
    /// Workers that brought some of them.
    pub workers: BTreeSet<WorkerId>,
    /// Tiles of which two copies differed.
    pub differing_tiles: u32,
    /// How it ended, once it has.
    pub end: Option<End>,
}

/// How a job ended.
#[derive(Debug, Clone, PartialEq)]
pub enum End {
    /// Every tile is in the picture, after that time.
    Finished(Duration),
    /// It will never be.
    Failed(String),
}

impl Job {
    /// Its number.
    pub fn id(&self) -> JobId {
        self.id
    }

    /// Its picture, complete once the job has finished.
    pub fn picture(&self) -> &Picture {
        &self.picture
    }

    /// How far it is, now and later.
    pub fn progress(&self) -> watch::Receiver<Progress> {
        self.progress.subscribe()
    }

    /// Ends the job, unless it has ended; says whether it had not.
    pub(crate) fn end(&self, end: End) -> bool {
        self.progress.send_if_modified(|progress| {
            let is_first = progress.end.is_none();
            progress.end.get_or_insert(end);
            is_first
        })
    }
}
