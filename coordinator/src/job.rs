//! What the shell keeps of a job: its scene, its picture, and how far it is for those who watch.

use rtfarm_core::{render::Settings, tile::TileGrid};
use rtfarm_job::Progress;
use rtfarm_picture::Picture;
use rtfarm_proto::{JobId, TileHasher};
use tokio::sync::watch;

use crate::store::SceneFile;

/// A picture being rendered or ready.
#[derive(Debug)]
pub struct Job {
    pub(crate) id: JobId,
    pub(crate) scene: SceneFile,
    pub(crate) settings: Settings,
    pub(crate) grid: TileGrid,
    /// Hashes its tiles' pixels as workers do.
    pub(crate) hasher: TileHasher,
    pub(crate) picture: Picture,
    pub(crate) progress: watch::Sender<Progress>,
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

    /// Shows how far it is. Threads may bring the states out of order: one that is older than
    /// what is shown already is not shown.
    pub(crate) fn publish(&self, progress: Progress) {
        self.progress.send_if_modified(|shown| replace_older(shown, progress));
    }
}

/// Replaces an older state of a job; says whether it was older.
fn replace_older(shown: &mut Progress, progress: Progress) -> bool {
    // One of these grows with every change, and none before it shrinks.
    let age = |progress: &Progress| {
        let Progress { tiles_done, differing_tiles, taken_back, outcome, .. } = progress;
        (outcome.is_some(), *taken_back, *tiles_done, *differing_tiles)
    };
    let is_older = age(shown) < age(&progress);
    if is_older {
        *shown = progress;
    }
    is_older
}

#[cfg(test)]
mod tests {
    use rtfarm_job::Outcome;

    use super::*;

    #[test]
    fn a_state_that_comes_late_is_not_shown() {
        let state = |tiles_done, outcome| Progress { tiles_done, outcome, ..Progress::default() };
        let mut shown = state(1, None);
        assert!(replace_older(&mut shown, state(3, None)));
        assert!(!replace_older(&mut shown, state(2, None)));
        assert!(replace_older(&mut shown, state(3, Some(Outcome::Failed(String::new())))));
        assert!(!replace_older(&mut shown, state(4, None)), "the end is the last to be shown");
        assert_eq!(shown.tiles_done, 3);
        let mut shown = state(3, None);
        assert!(replace_older(&mut shown, Progress { taken_back: 2, ..state(1, None) }));
        assert!(!replace_older(&mut shown, state(3, None)), "tiles were taken back since");
    }
}
