//! Whom a farm believes: it compares what workers bring of the same tile, and keeps liars out.

use std::time::Instant;

use rtfarm_core::tile::TileId;
use rtfarm_proto::{JobId, LeaseName, WorkerId};

use super::{Action, Delivery, Farm, LONGEST_SILENCE, Notice};
use crate::{audit::Finding, tiles::Rendering};

impl Farm {
    /// Compares a copy of a tile with what is in the picture.
    pub(super) fn compare(
        &mut self,
        copy: Delivery,
        first: Rendering,
        now: Instant,
        actions: &mut Vec<Action>,
    ) {
        let Delivery { worker, lease: LeaseName { job: id, .. }, tile, hash, .. } = copy;
        let Some(job) = self.jobs.get_mut(&id) else { return };
        if first.hash != hash {
            job.progress.differing_tiles += 1;
            actions.push(Action::Publish(id, job.progress.clone()));
            actions.push(Action::Log(Notice::CopiesDiffer { second: copy, first }));
        }
        match self.audit.on_copy(id, tile, first, Rendering { worker, hash }) {
            Finding::Nothing | Finding::Dispute => {}
            Finding::Agreement => self.leases.confirm(id, tile),
            Finding::Unsettled => {
                job.unsettled.insert(tile);
            }
            Finding::Liar(liar) => {
                if liar != first.worker {
                    self.leases.confirm(id, tile);
                }
                actions.push(Action::Log(Notice::Liar { worker: liar, job: id, tile }));
                self.quarantine(liar, now, actions);
            }
        }
    }

    /// Keeps a liar out, and takes back what it rendered, unless another worker confirmed it.
    fn quarantine(&mut self, liar: WorkerId, now: Instant, actions: &mut Vec<Action>) {
        self.members.on_lie(liar);
        actions.push(self.keep_marks());
        self.lose_worker(liar, false, "it brought wrong pixels", now, actions);
        self.audit.on_quarantine(liar);
        let jobs: Vec<JobId> = self.leases.jobs().map(|(job, _)| job).collect();
        for job in jobs {
            self.take_back(liar, job, actions);
        }
    }

    pub(super) fn take_back(&mut self, liar: WorkerId, id: JobId, actions: &mut Vec<Action>) {
        let tiles = self.leases.take_back(id, liar);
        let Some(job) = self.jobs.get_mut(&id).filter(|_| !tiles.is_empty()) else { return };
        for tile in &tiles {
            self.audit.end(id, *tile);
            job.unsettled.remove(tile);
        }
        job.forget_tallies(&tiles.iter().copied().collect());
        job.progress.tiles_done -= tiles.len() as u32;
        job.progress.taken_back += tiles.len() as u32;
        self.finishing.remove(&id);
        actions.push(Action::TakeBack(id, tiles.clone()));
        actions.push(Action::Publish(id, job.progress.clone()));
        actions.push(Action::Log(Notice::TakenBack { worker: liar, job: id, tiles }));
    }

    /// Nobody will say whether a tile is right. That is bad only if two copies differ.
    pub(super) fn give_up(&mut self, id: JobId, tile: TileId) {
        let renderings = self.audit.end(id, tile);
        if let Some(job) = self.jobs.get_mut(&id).filter(|_| renderings > 1) {
            job.unsettled.insert(tile);
        }
    }

    /// Tiles of a finished job under examination that nobody will render again: there is no worker
    /// that may and was heard of lately, or all have had something else to do for too long.
    pub(super) fn hopeless(&self, job: JobId, since: Instant, now: Instant) -> Vec<TileId> {
        let is_late = since + LONGEST_SILENCE <= now;
        let hopeless = self.audit.of(job).filter(|(_, is_leased, workers)| {
            let may =
                |worker: &WorkerId| !workers.contains(worker) && self.may_render(*worker, job);
            let recently = now.checked_sub(2 * self.term).unwrap_or(now);
            let heard = self.members.heard_since(recently);
            let has_hope =
                heard.chain(self.waiting.iter().map(|(_, ask)| ask.worker)).any(|w| may(&w));
            !is_leased && (!has_hope || is_late && workers.len() == 1)
        });
        hopeless.map(|(tile, ..)| tile).collect()
    }
}
