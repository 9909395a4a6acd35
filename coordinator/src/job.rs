//! What the shell keeps of a job: its scene, its picture, and how far it is for those who watch.

use std::{io, sync::Arc};

use rtfarm_core::{
    render::{Quality, Sampling, Settings},
    tile::{Area, Crop, Size, TileGrid},
};
use rtfarm_job::{Progress, Provenance};
use rtfarm_picture::{Canvas, Notes, Picture, PictureFormat};
use rtfarm_proto::{JobId, TileHasher};
use tokio::sync::watch;

use crate::{
    farm::Terms,
    record::{JobRecord, Plan, Ticket, to_event},
    state::JobFolder,
    store::SceneFile,
};

/// A picture being rendered or ready.
#[derive(Debug)]
pub struct Job {
    pub(crate) id: JobId,
    pub(crate) ticket: Ticket,
    pub(crate) scene: SceneFile,
    pub(crate) settings: Settings,
    pub(crate) grid: TileGrid,
    /// Hashes its tiles' pixels as workers do.
    pub(crate) hasher: TileHasher,
    pub(crate) canvas: Canvas,
    /// Where it outlives this process.
    pub(crate) folder: Option<JobFolder>,
    /// Another build began it.
    pub(crate) is_foreign: bool,
    pub(crate) progress: watch::Sender<Progress>,
}

impl Job {
    /// Makes one of which nothing is known to be done.
    pub(crate) fn new(
        id: JobId,
        ticket: Ticket,
        plan: &Plan,
        scene: SceneFile,
        canvas: Canvas,
        (folder, is_foreign): (Option<JobFolder>, bool),
    ) -> Arc<Self> {
        let &Plan { settings, grid, .. } = plan;
        let hasher = TileHasher::new(id, scene.hash(), settings, grid);
        let progress = Progress { tile_count: grid.count(), ..Progress::default() };
        let progress = watch::Sender::new(progress);
        Arc::new(Self {
            id,
            ticket,
            scene,
            settings,
            grid,
            hasher,
            canvas,
            folder,
            is_foreign,
            progress,
        })
    }

    /// Its number.
    pub fn id(&self) -> JobId {
        self.id
    }

    /// The part of the frame that it renders.
    pub fn window(&self) -> Area {
        self.grid.window()
    }

    /// Its picture, complete once the job has finished.
    pub fn picture(&self) -> &Picture {
        self.canvas.picture()
    }

    /// What a coarse picture of the same renders, with one sample for each of some thousand pixels;
    /// `None` when this one is hardly finer.
    pub(crate) fn coarse(&self) -> Option<Plan> {
        const MOST_PIXELS: u64 = 1 << 15;
        let (window, quality) = (self.grid.window(), self.settings.quality);
        let step = |step: &u32| window.size().pixel_count() / u64::from(step * step) <= MOST_PIXELS;
        let step = (0..16).map(|power| 1 << power).find(step).filter(|step| *step > 1)?;
        let frame = self.settings.size;
        let side = |side: u32| u64::from(side.div_ceil(step));
        let size = Size::new(side(frame.width()), side(frame.height())).ok()?;
        let sides = [window.width(), window.height()].map(|side| (side / step).max(1));
        let window = Crop { corner: [window.x0(), window.y0()].map(|place| place / step), sides };
        Some(Plan {
            scene: self.scene.hash(),
            scene_byte_count: self.scene.byte_count(),
            settings: Settings {
                size,
                quality: Quality { sampling: Sampling::fixed(1)?, ..quality },
            },
            grid: TileGrid::new(window.of(size).ok()?, 32).ok()?,
            format: PictureFormat::Png8,
            transfer: self.picture().transfer(),
        })
    }

    /// What its picture's file says of it, rendered by `software` (a version and a build).
    pub fn notes(&self, software: &str) -> io::Result<Notes> {
        let build = if self.is_foreign { "another" } else { software };
        let provenance = Provenance {
            build: build.to_owned(),
            scene: self.scene.hash(),
            settings: self.settings,
            grid: self.grid,
            transfer: self.picture().transfer(),
            format: self.picture().format(),
        };
        let provenance = provenance.text(&self.canvas.tally()?);
        Ok(Notes { software: format!("rtfarm {build}"), provenance })
    }

    /// How far it is, now and later.
    pub fn progress(&self) -> watch::Receiver<Progress> {
        self.progress.subscribe()
    }

    /// Shows how far it is. Threads may bring the states out of order: one that is older than
    /// what is shown already is not shown. Says whether it is.
    pub(crate) fn publish(&self, progress: Progress) -> bool {
        if progress.outcome.is_some() {
            self.keep_end(&progress);
        }
        self.progress.send_if_modified(|shown| replace_older(shown, progress))
    }
}

impl Job {
    /// Has the end of a job outlive this process before anybody is told of it.
    fn keep_end(&self, progress: &Progress) {
        let Some(folder) = &self.folder else { return };
        let end = to_event(progress);
        let kept = self.canvas.sync().and_then(|()| {
            folder.change(|record| {
                record.end.get_or_insert(end);
            })
        });
        if let Err(error) = kept {
            // A later coordinator finds what there is of it and goes on.
            tracing::error!(job = self.id.0, reason = %error, "cannot keep the end of a job");
        }
    }

    /// Has it outlive this process as one that has not ended.
    pub(crate) fn reopen(&self) {
        self.change(|record| record.end = None);
    }

    /// Has its terms outlive this process.
    pub(crate) fn keep(&self, terms: Terms) {
        self.change(|record| {
            (record.priority, record.is_paused) = (terms.priority, terms.is_paused);
        });
    }

    fn change(&self, change: impl FnOnce(&mut JobRecord)) {
        let changed = self.folder.as_ref().map(|folder| folder.change(change));
        if let Some(Err(error)) = changed {
            tracing::error!(job = self.id.0, reason = %error, "cannot keep a change of a job");
        }
    }

    /// Bytes on disk that are kept for it.
    pub(crate) fn byte_count(&self) -> u64 {
        let picture = self.picture();
        self.scene.byte_count() + Picture::byte_count(picture.size(), picture.format())
    }

    /// Removes what outlives this process.
    pub(crate) fn forget(&self) {
        if let Some(Err(error)) = self.folder.as_ref().map(JobFolder::forget) {
            tracing::error!(job = self.id.0, reason = %error, "cannot remove the files of a job");
        }
    }
}

/// Replaces an older state of a job; says whether it was older.
fn replace_older(shown: &mut Progress, progress: Progress) -> bool {
    // One of these grows with every change, and none before it shrinks.
    let age = |progress: &Progress| {
        let Progress { tiles_done, differing_tiles, taken_back, retry_count, .. } = *progress;
        let has_ended = progress.outcome.is_some();
        (retry_count, has_ended, taken_back, tiles_done, differing_tiles, progress.obstacle_count)
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
