//! What people do with a farm: look at it, change the order of its jobs, stop some, try again what
//! failed, send workers home. And how long it keeps what has ended.

use std::{
    collections::BTreeMap,
    time::{Duration, Instant},
};

use rtfarm_job::{Outcome, Progress};
use rtfarm_proto::{JobId, WorkerId};

use super::{Action, Earlier, Farm, JobState, Notice};
use crate::{
    members::{Mark, MemberEntry, NoMember, Standing},
    tiles::Tiles,
};

/// The most jobs that have ended and are kept: each has files open.
const MOST_KEPT: usize = 200;

/// How long jobs that have ended are kept for their clients.
#[derive(Debug, Clone, Copy)]
pub struct Keeping {
    /// The longest, after its end.
    pub time: Duration,
    /// The most bytes of all of them together. The last to end is kept whatever it has.
    pub byte_count: u64,
}

impl Default for Keeping {
    fn default() -> Self {
        Self { time: Duration::from_secs(7 * 24 * 3600), byte_count: 16 << 30 }
    }
}

/// What a farm knows of a job besides its tiles.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct Terms {
    /// Jobs of a higher one come first.
    pub(crate) priority: i32,
    /// No worker gets tiles of it.
    pub(crate) is_paused: bool,
    /// The most workers that have tiles of it at the same time.
    pub(crate) most_workers: Option<u32>,
    /// Bytes of its scene, as a worker has them.
    pub(crate) scene_byte_count: u64,
    /// What is kept for it.
    pub(crate) byte_count: u64,
    /// Another build began it, and this one cannot go on with it.
    pub(crate) is_foreign: bool,
}

/// What somebody wants of a job.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Change {
    /// That it rests, or goes on.
    Pause(bool),
    /// That it comes before those of a lower priority.
    Priority(i32),
    /// That what it lacks is rendered, though it has failed.
    Retry,
}

/// Why a job is not changed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub(crate) enum Refused {
    #[error("there is no such job")]
    Unknown,
    #[error("the job has ended")]
    Ended,
    #[error("the job has not failed: only what failed is tried again")]
    NotFailed,
    #[error("another build of rtfarm began the job; submit it again")]
    Foreign,
    /// The caller has to look at its picture first.
    #[error("the job's tiles are not known")]
    TilesUnknown,
    #[error("the coordinator is about to stop")]
    Stopping,
}

/// What there is to say of a job.
#[derive(Debug, Clone)]
pub(crate) struct JobEntry {
    pub(crate) id: JobId,
    pub(crate) phase: Phase,
    pub(crate) terms: Terms,
    pub(crate) workers_now: usize,
    pub(crate) progress: Progress,
    pub(crate) elapsed: Duration,
    /// When it is forgotten at the latest, if it has ended.
    pub(crate) expires_in: Option<Duration>,
}

/// What is done about a job.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Phase {
    /// No worker has tiles of it.
    Waiting,
    Rendering,
    Paused,
    Finished,
    Failed,
}

impl Farm {
    /// Has the farm keep so what has ended.
    pub(crate) fn keep(&mut self, keeping: Keeping) {
        self.keeping = keeping;
    }

    /// The jobs: those that are rendered in their order, then those that have ended.
    pub(crate) fn job_entries(&self, now: Instant) -> Vec<JobEntry> {
        let open = self.leases.jobs().map(|(id, _)| id);
        let ids = open.chain(self.ended.iter().map(|&(_, id)| id));
        ids.filter_map(|id| Some(self.job_entry(id, self.jobs.get(&id)?, now))).collect()
    }

    fn job_entry(&self, id: JobId, job: &JobState, now: Instant) -> JobEntry {
        let workers_now = self.leases.workers_of(id).len();
        let phase = match job.progress.outcome {
            Some(Outcome::Finished(_)) => Phase::Finished,
            Some(Outcome::Failed(_)) => Phase::Failed,
            None if job.terms.is_paused => Phase::Paused,
            None if workers_now > 0 => Phase::Rendering,
            None => Phase::Waiting,
        };
        let elapsed = match job.progress.outcome {
            Some(Outcome::Finished(time)) => time,
            _ => job.elapsed(now),
        };
        let expires = |end: Instant| self.keeping.time.saturating_sub(now - end);
        JobEntry {
            id,
            phase,
            terms: job.terms,
            workers_now,
            progress: job.progress.clone(),
            elapsed,
            expires_in: job.ended_at.map(expires),
        }
    }

    /// The workers, and how many tiles each has.
    pub(crate) fn worker_entries(&self, now: Instant) -> Vec<(MemberEntry, usize)> {
        let entries = self.members.entries(now);
        entries.map(|entry| (entry.clone(), self.leases.tile_count(entry.worker))).collect()
    }

    /// Event: a client is told of a job.
    pub(crate) fn on_claim(&mut self, job: JobId) {
        if let Some(job) = self.jobs.get_mut(&job) {
            job.is_claimed = true;
        }
    }

    /// Event: who submitted a job went before he was told of it. It ends, unless another was.
    pub(crate) fn on_abandon(&mut self, job: JobId, now: Instant) -> Vec<Action> {
        let is_claimed = self.jobs.get(&job).is_some_and(|job| job.is_claimed);
        if is_claimed { Vec::new() } else { self.on_cancel(job, now) }
    }

    /// Event: somebody wants a job to be paused, to go on, or to come before others.
    pub(crate) fn on_change(
        &mut self,
        id: JobId,
        change: Change,
        now: Instant,
    ) -> (Result<(), Refused>, Vec<Action>) {
        let Some(job) = self.jobs.get_mut(&id) else { return (Err(Refused::Unknown), Vec::new()) };
        if let Change::Retry = change {
            return self.on_retry(id, None, now);
        }
        if job.ended_at.is_some() {
            return (Err(Refused::Ended), Vec::new());
        }
        match change {
            Change::Pause(is_paused) => job.terms.is_paused = is_paused,
            Change::Priority(priority) => {
                job.terms.priority = priority;
                self.leases.on_priority(id, priority);
            }
            Change::Retry => {}
        }
        let keep = Action::Keep(id, job.terms);
        let mut actions = vec![keep, Action::Log(Notice::JobChanged(id, change))];
        self.serve(now, &mut actions);
        (Ok(()), actions)
    }

    /// Event: somebody wants rendered what a job lacks that has failed. `known` are its tiles, and
    /// what was done for them, if the caller has looked at its picture.
    pub(crate) fn on_retry(
        &mut self,
        id: JobId,
        known: Option<(Tiles, Earlier)>,
        now: Instant,
    ) -> (Result<(), Refused>, Vec<Action>) {
        let refused = |reason| (Err(reason), Vec::new());
        let Some(job) = self.jobs.get_mut(&id) else { return refused(Refused::Unknown) };
        let (Some(ended_at), Some(Outcome::Failed(_))) = (job.ended_at, &job.progress.outcome)
        else {
            return refused(Refused::NotFailed);
        };
        if job.terms.is_foreign {
            return refused(Refused::Foreign);
        }
        if self.phase != super::Phase::Open {
            return refused(Refused::Stopping);
        }
        let tiles = match (job.rest.take(), known) {
            (Some(rest), _) => rest,
            (None, Some((tiles, earlier))) => {
                job.progress.tally = earlier.tally;
                job.progress.worker_count = earlier.worker_count;
                job.progress.tiles_done = tiles.done_count();
                job.earlier = earlier;
                job.brought.clear();
                job.costs = rtfarm_job::TileCosts::default();
                tiles
            }
            (None, None) => return refused(Refused::TilesUnknown),
        };
        job.earlier.elapsed = job.elapsed(now);
        (job.started, job.ended_at) = (now, None);
        job.progress.outcome = None;
        job.progress.retry_count += 1;
        job.suspects.clear();
        job.senseless.clear();
        self.ended.remove(&(ended_at, id));
        let mut actions = vec![Action::Reopen(id), Action::Publish(id, job.progress.clone())];
        actions.push(Action::Log(Notice::JobChanged(id, Change::Retry)));
        self.leases.on_submit(id, tiles, job.terms.priority);
        // Its last tile may have been written while it failed.
        self.finish(id, now);
        self.look_for_obstacles(&mut actions);
        self.serve(now, &mut actions);
        (Ok(()), actions)
    }

    /// Event: somebody decides what a worker gets.
    pub(crate) fn on_station(
        &mut self,
        worker: WorkerId,
        standing: Standing,
        now: Instant,
    ) -> (Result<(), NoMember>, Vec<Action>) {
        if let Err(stranger) = self.members.on_station(worker, standing) {
            return (Err(stranger), Vec::new());
        }
        let mut actions = vec![Action::Log(Notice::Stationed(worker, standing))];
        actions.push(self.keep_marks());
        self.look_for_obstacles(&mut actions);
        self.serve(now, &mut actions);
        (Ok(()), actions)
    }

    /// Remembers what an earlier start of the farm knew of processes.
    pub(crate) fn remember(&mut self, marks: BTreeMap<u64, Mark>) {
        self.members.remember(marks);
    }

    pub(super) fn keep_marks(&self) -> Action {
        Action::KeepMarks(self.members.marks().clone())
    }

    /// Says of each job under way whether there are workers, but none that can hold its scene.
    pub(super) fn look_for_obstacles(&mut self, actions: &mut Vec<Action>) {
        let Some(most) = self.members.most_memory() else { return };
        for (id, _) in self.leases.jobs() {
            let Some(job) = self.jobs.get_mut(&id) else { continue };
            let bytes = job.terms.scene_byte_count;
            let obstacle = (bytes > most).then(|| {
                format!(
                    "no worker can hold its scene of {bytes} bytes: the largest has room for {most}"
                )
            });
            if job.progress.obstacle != obstacle {
                job.progress.obstacle.clone_from(&obstacle);
                job.progress.obstacle_count += 1;
                actions.push(Action::Publish(id, job.progress.clone()));
                actions.extend(obstacle.map(|reason| Action::Log(Notice::NoRoom(id, reason))));
            }
        }
    }

    /// Sends workers home that are to go, ask for tiles and have none.
    pub(super) fn send_home_who_is_drained(&mut self, actions: &mut Vec<Action>) {
        let drained = |worker: &WorkerId| self.leases.is_without(*worker);
        let drained: Vec<WorkerId> = self.members.draining().filter(drained).collect();
        for worker in drained {
            if let Some(ask) = self.waiting.of(worker) {
                self.waiting.remove(ask);
                self.members.on_drained(worker);
                self.send_home(worker, ask, actions);
                actions.push(self.keep_marks());
                let reason = "it was drained".to_owned();
                actions.push(Action::Log(Notice::Gone(worker, reason)));
            }
        }
    }

    /// Says whether a worker may begin tiles of a job now.
    pub(super) fn may_begin(&self, worker: WorkerId, id: JobId) -> bool {
        let has_room = |most: u32| {
            let workers = self.leases.workers_of(id);
            workers.contains(&worker) || workers.len() < most as usize
        };
        self.may_render(worker, id)
            && self.jobs.get(&id).is_none_or(|JobState { terms, .. }| {
                !terms.is_paused && terms.most_workers.is_none_or(has_room)
            })
    }

    // Keeping.

    /// Keeps a job that has ended for its clients.
    pub(super) fn keep_ended(&mut self, id: JobId, end: Instant) {
        if let Some(job) = self.jobs.get_mut(&id) {
            job.ended_at = Some(end);
            self.ended.insert((end, id));
        }
    }

    /// Forgets jobs that ended long ago, and the oldest when there are too many or they are too
    /// large.
    pub(super) fn forget_old(&mut self, now: Instant, actions: &mut Vec<Action>) {
        let size = |id: JobId| self.jobs.get(&id).map_or(0, |job| job.terms.byte_count);
        let mut byte_count: u64 = self.ended.iter().map(|&(_, id)| size(id)).sum();
        while let Some(&(end, oldest)) = self.ended.first() {
            let count = self.ended.len();
            let is_too_much = byte_count > self.keeping.byte_count && count > 1;
            if !is_too_much && count <= MOST_KEPT && now < end + self.keeping.time {
                return;
            }
            byte_count -= self.jobs.get(&oldest).map_or(0, |job| job.terms.byte_count);
            self.forget(oldest, actions);
            actions.push(Action::Log(Notice::JobExpired(oldest)));
        }
    }

    /// When the oldest job that has ended is forgotten.
    pub(super) fn next_oblivion(&self) -> Option<Instant> {
        self.ended.first().map(|&(end, _)| end + self.keeping.time)
    }

    pub(super) fn forget(&mut self, id: JobId, actions: &mut Vec<Action>) {
        if let Some(job) = self.jobs.remove(&id) {
            self.ended.retain(|&(_, ended)| ended != id);
            debug_assert!(job.ended_at.is_some(), "only what has ended is forgotten");
            actions.push(Action::Forget(id));
        }
    }
}
