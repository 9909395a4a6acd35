//! A job: its scene, its picture, how far it is.

use std::{collections::BTreeSet, sync::Mutex};

use rtfarm_core::{render::Settings, tile::TileGrid};
use rtfarm_job::{Outcome, Progress};
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
    /// Those that have brought a tile.
    pub(crate) workers: Mutex<BTreeSet<WorkerId>>,
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

    /// Notes that `worker` has brought a tile; says whether it is its first.
    pub(crate) fn note_worker(&self, worker: WorkerId) -> bool {
        self.workers.lock().expect("a set never panics").insert(worker)
    }

    /// Ends the job, unless it has ended; says whether it had not.
    pub(crate) fn end(&self, outcome: Outcome) -> bool {
        self.progress.send_if_modified(|progress| {
            let is_first = progress.outcome.is_none();
            progress.outcome.get_or_insert(outcome);
            is_first
        })
    }
}
