//! Jobs: ordered, changed, cancelled and looked up.

use std::{sync::Arc, time::Duration};

use rtfarm_core::{
    prepared::SceneHash,
    tile::{TileGrid, TileId},
};
use rtfarm_job::Order;
use rtfarm_picture::{Canvas, TileRecord};
use rtfarm_proto::JobId;

use super::{ChangeError, Shell, SubmitError};
use crate::{
    farm::{Arrived, Change, Earlier, Explanation, JobEntry, Refused, Terms},
    job::Job,
    record::{Plan, Ticket},
    state::KeptJob,
    store::SceneFile,
    tiles::Tiles,
};

impl Shell {
    /// Takes an order, or finds the job of an earlier one with the same key. This writes files:
    /// never call it on the async runtime.
    pub(crate) fn submit(&self, order: Order, ticket: Ticket) -> Result<Arc<Job>, SubmitError> {
        let _alone = self.changing.lock().expect("writing never panics");
        if let Some(job) = self.claim(&ticket)? {
            return Ok(job);
        }
        let id = self.state().farm.number_job();
        let Some(folder) = &self.folder else {
            let picture_folder = &self.config.picture_folder;
            let canvas = Canvas::new_in(picture_folder, order.grid, order.format, order.transfer);
            let canvas =
                canvas.map_err(|error| SubmitError::Picture(picture_folder.clone(), error))?;
            return self.submit_on(id, (order, ticket), canvas, &[]);
        };
        let Order { name: _, prepared, settings, grid, transfer, format } = order;
        let scene_byte_count = prepared.as_ref().len() as u64;
        let plan =
            Plan { scene: prepared.hash(), scene_byte_count, settings, grid, format, transfer };
        let same = self.job_with_scene(plan.scene);
        let same = same.as_ref().map(|job| job.scene.path());
        let kept = folder.create_job(id, (&ticket, &plan), &prepared, same);
        let (scene, canvas, folder) = kept.map_err(SubmitError::State)?;
        let job = Job::new(id, ticket, &plan, scene, canvas, (Some(folder), false));
        self.begin(&job, Tiles::new(grid), Earlier::default(), false);
        Ok(job)
    }

    /// The job that the account's earlier order with the same key has, which another client is told
    /// of now. It fails if that order was another one.
    pub(crate) fn claim(&self, ticket: &Ticket) -> Result<Option<Arc<Job>>, SubmitError> {
        let Ticket { account, key, wanted, .. } = ticket;
        let has_key = |of: &Ticket| !key.is_empty() && (&of.account, &of.key) == (account, key);
        self.tell(|state, _| {
            let job = state.jobs.values().find(|job| has_key(&job.ticket)).cloned();
            let claimed = match job {
                Some(job) if job.ticket.wanted != *wanted => {
                    Err(SubmitError::Key(job.id, key.clone()))
                }
                Some(job) => {
                    state.farm.on_claim(job.id);
                    Ok(Some(job))
                }
                None => Ok(None),
            };
            (claimed, Vec::new())
        })
    }

    /// Who submitted a job has gone before he was told of it.
    pub(crate) fn abandon(&self, job: JobId) {
        self.tell_farm(|farm, now| farm.on_abandon(job, now));
    }

    /// Gives a number to a job that [`Shell::submit_on`] takes.
    pub(crate) fn number_job(&self) -> JobId {
        self.state().farm.number_job()
    }

    /// Takes an order whose picture is `canvas`; these tiles are in it already. This writes files:
    /// never call it on the async runtime.
    pub(crate) fn submit_on(
        &self,
        id: JobId,
        (order, ticket): (Order, Ticket),
        canvas: Canvas,
        done: &[(TileId, TileRecord)],
    ) -> Result<Arc<Job>, SubmitError> {
        let scene_folder = &self.config.scene_folder;
        let Order { name: _, prepared, settings, grid, transfer, format } = order;
        let scene = SceneFile::write(scene_folder, &prepared)
            .map_err(|error| SubmitError::Scene(scene_folder.clone(), error))?;
        drop(prepared);
        let (hash, scene_byte_count) = (scene.hash(), scene.byte_count());
        let plan = Plan { scene: hash, scene_byte_count, settings, grid, format, transfer };
        let job = Job::new(id, ticket, &plan, scene, canvas, (None, false));
        let (tiles, earlier) = progress_of(grid, done);
        if self.config.begins_coarsely && !tiles.is_over() {
            self.coarse(&job);
        }
        self.begin(&job, tiles, earlier, false);
        Ok(job)
    }

    /// The job of a coarse picture of what another job renders, before all others: it is made when
    /// there is none. Nobody is told of it but those who watch. This writes a file: never call it
    /// on the async runtime.
    pub(crate) fn coarse(&self, of: &Arc<Job>) -> Option<Arc<Job>> {
        let id = coarse_id(of.id);
        if let Some(known) = self.job(id) {
            return Some(known);
        }
        let plan = of.coarse()?;
        let Plan { scene, scene_byte_count, grid, format, transfer, .. } = plan;
        let canvas = Canvas::new_in(&self.config.picture_folder, grid, format, transfer).ok()?;
        // The file is that of the other job.
        let scene = SceneFile::kept(of.scene.path().to_owned(), scene, scene_byte_count);
        let name = format!("{}, coarse", of.ticket.name);
        let ticket = Ticket { name, priority: i32::MAX, ..Ticket::default() };
        let job = Job::new(id, ticket, &plan, scene, canvas, (None, false));
        self.state().coarse.insert(id);
        self.begin(&job, Tiles::new(grid), Earlier::default(), false);
        Some(job)
    }

    /// The coarse picture of what a job renders, if it was begun.
    pub(crate) fn coarse_of(&self, job: JobId) -> Option<Arc<Job>> {
        self.job(coarse_id(job))
    }

    fn begin(&self, job: &Arc<Job>, tiles: Tiles, earlier: Earlier, is_paused: bool) {
        tracing::info!(
            job = job.id.0,
            scene = job.ticket.name,
            size = %job.grid.window().size(),
            sampling = %job.settings.quality.sampling,
            transfer = ?job.canvas.picture().transfer(),
            tiles = job.grid.count(),
            side = job.grid.side(),
            scene_bytes = job.scene.byte_count(),
            done = (tiles.done_count() > 0).then_some(tiles.done_count()),
            "job started"
        );
        self.events.on_job(job.id, &job.ticket.name);
        self.tell(|state, now| {
            state.jobs.insert(job.id, Arc::clone(job));
            let terms = terms_of(job, is_paused, false);
            ((), state.farm.on_order(job.id, tiles, earlier, terms, now))
        });
    }

    /// Goes on with a job that an earlier coordinator left.
    pub(super) fn take_up(&self, kept: KeptJob) {
        let KeptJob { id, ticket, is_paused, is_foreign, plan, scene, canvas, done, end, folder } =
            kept;
        let job = Job::new(id, ticket, &plan, scene, canvas, (Some(folder), is_foreign));
        if let Some((end, age)) = end {
            let terms = terms_of(&job, is_paused, is_foreign);
            // Who watches is not told of its end as of news.
            job.progress.send_replace(end.clone());
            self.tell(|state, now| {
                state.jobs.insert(id, job);
                ((), state.farm.on_kept(id, end, terms, (age, now)))
            });
        } else {
            let (tiles, earlier) = progress_of(plan.grid, &done);
            self.begin(&job, tiles, earlier, is_paused);
        }
    }

    /// Ends and forgets a job; says whether it was known.
    pub(crate) fn cancel(&self, job: JobId) -> bool {
        if self.state().coarse.remove(&coarse_id(job)) {
            self.tell_farm(|farm, now| farm.on_cancel(coarse_id(job), now));
        }
        self.tell(|state, now| (state.jobs.contains_key(&job), state.farm.on_cancel(job, now)))
    }

    /// Changes a job. This reads and writes files: never call it on the async runtime.
    pub(crate) fn change(&self, job: JobId, change: Change) -> Result<(), ChangeError> {
        let _alone = self.changing.lock().expect("writing never panics");
        let changed = self.tell(|state, now| state.farm.on_change(job, change, now));
        let (Err(Refused::TilesUnknown), Some(known)) = (changed, self.job(job)) else {
            return changed.map_err(ChangeError::Refused);
        };
        // It failed under an earlier start.
        let done = known.canvas.done().map_err(ChangeError::Picture)?;
        let tiles = progress_of(known.grid, &done);
        self.tell(|state, now| state.farm.on_retry(job, Some(tiles), now))
            .map_err(ChangeError::Refused)
    }

    /// The jobs that are known, and what there is to say of them.
    pub(crate) fn jobs(&self) -> Vec<(JobEntry, Arc<Job>)> {
        self.tell(|state, now| {
            let entries = state.farm.job_entries(now).into_iter();
            let known = |entry: JobEntry| {
                if state.coarse.contains(&entry.id) {
                    return None;
                }
                let job = state.jobs.get(&entry.id).cloned()?;
                Some((entry, job))
            };
            (entries.filter_map(known).collect(), Vec::new())
        })
    }

    /// Which tiles came into a job's picture, but for the first `seen`.
    pub(crate) fn arrived(&self, job: JobId, seen: usize) -> Option<Arrived> {
        self.state().farm.arrived(job, seen)
    }

    /// Says of each tile of a job whether it is in the picture, if that is known.
    pub(crate) fn done(&self, job: JobId) -> Option<Vec<bool>> {
        self.state().farm.done(job)
    }

    /// What became of a tile.
    pub(crate) fn explain(&self, job: JobId, tile: TileId) -> Option<Explanation> {
        self.tell(|state, now| (state.farm.explain(job, tile, now), Vec::new()))
    }

    /// A job that has not been forgotten.
    pub(crate) fn job(&self, job: JobId) -> Option<Arc<Job>> {
        self.state().jobs.get(&job).cloned()
    }

    /// A job that has not been forgotten and has this scene.
    pub(crate) fn job_with_scene(&self, hash: SceneHash) -> Option<Arc<Job>> {
        self.state().jobs.values().find(|job| job.scene.hash() == hash).cloned()
    }
}

/// The number of the coarse picture of what a job renders; no other job comes to have it.
fn coarse_id(of: JobId) -> JobId {
    JobId(!of.0)
}

/// What the machine knows of a job besides its tiles.
fn terms_of(job: &Job, is_paused: bool, is_foreign: bool) -> Terms {
    let Ticket { priority, most_workers, .. } = job.ticket;
    let (byte_count, scene_byte_count) = (job.byte_count(), job.scene.byte_count());
    Terms { priority, is_paused, most_workers, scene_byte_count, byte_count, is_foreign }
}

/// A picture's tiles, of which some are done, and what was done so far.
fn progress_of(grid: TileGrid, done: &[(TileId, TileRecord)]) -> (Tiles, Earlier) {
    // Not under the lock: there may be a million.
    let (mut tiles, mut earlier) = (Tiles::new(grid), Earlier::default());
    for (tile, record) in done {
        tiles.set_done(*tile, record.arrived);
        earlier.tally.add(&record.tally);
        let elapsed = Duration::try_from_secs_f32(record.elapsed).unwrap_or_default();
        earlier.elapsed = earlier.elapsed.max(elapsed);
        earlier.worker_count = earlier.worker_count.max(record.worker_count);
    }
    (tiles, earlier)
}
