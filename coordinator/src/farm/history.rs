//! What became of each tile: who was to render it, and what came of that.

use std::time::{Duration, Instant};

use rtfarm_core::tile::TileId;
use rtfarm_proto::{JobId, LeaseId, WorkerId};

use super::{Delivery, Farm};
use crate::lease::{Loss, Run};

/// A lease that was given, and what was lost with it.
#[derive(Debug)]
pub(super) struct Given {
    lease: LeaseId,
    worker: WorkerId,
    host: String,
    at: Instant,
    tiles: Box<[TileId]>,
    lost: Vec<(Vec<TileId>, String)>,
}

/// What became of a tile under this start of the farm.
#[derive(Debug)]
pub(crate) struct Explanation {
    /// It is in the picture.
    pub(crate) is_done: bool,
    /// A worker has it.
    pub(crate) is_in_work: bool,
    /// What is in the picture, unless it came under an earlier start.
    pub(crate) brought: Option<Delivery>,
    /// The leases that covered it, the earliest first.
    pub(crate) attempts: Vec<Attempt>,
}

/// A lease that covered a tile.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Attempt {
    pub(crate) lease: LeaseId,
    pub(crate) worker: WorkerId,
    pub(crate) host: String,
    /// Since it was given.
    pub(crate) age: Duration,
    /// Why the tile was lost with it, if it was.
    pub(crate) lost: Option<String>,
}

impl Farm {
    /// Notes that tiles are leased to a worker.
    pub(super) fn note_given(&mut self, worker: WorkerId, run: &Run, now: Instant) {
        let host = self.members.host(worker).unwrap_or_default().to_owned();
        if let Some(job) = self.jobs.get_mut(&run.lease.job) {
            let (lease, tiles) = (run.lease.id, run.tiles.clone().into());
            job.history.push(Given { lease, worker, host, at: now, tiles, lost: Vec::new() });
        }
    }

    /// Notes that tiles are lost with a lease, for that reason.
    pub(super) fn note_lost(&mut self, loss: &Loss, reason: &str) {
        let Some(job) = self.jobs.get_mut(&loss.lease.job) else { return };
        // It is one of the last.
        let given = job.history.iter_mut().rev().find(|given| given.lease == loss.lease.id);
        if let Some(given) = given {
            given.lost.push((loss.tiles.clone(), reason.to_owned()));
        }
    }

    /// What became of a tile; `None` when the job has no such tile.
    pub(crate) fn explain(&self, id: JobId, tile: TileId, now: Instant) -> Option<Explanation> {
        let job = self.jobs.get(&id)?;
        let covering = job.history.iter().filter(|given| given.tiles.contains(&tile));
        let attempts = covering.map(|given| {
            let lost = given.lost.iter().find(|(tiles, _)| tiles.contains(&tile));
            Attempt {
                lease: given.lease,
                worker: given.worker,
                host: given.host.clone(),
                age: now.saturating_duration_since(given.at),
                lost: lost.map(|(_, reason)| reason.clone()),
            }
        });
        let done = self.done(id);
        Some(Explanation {
            is_done: done.is_some_and(|done| done[tile.index()]),
            is_in_work: self.leases.tiles(id).is_some()
                && self.leases.in_work(id).any(|(known, ..)| known == tile),
            brought: job.brought.iter().rev().find(|delivery| delivery.tile == tile).copied(),
            attempts: attempts.collect(),
        })
    }
}
