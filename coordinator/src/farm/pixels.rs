//! Pixels on their way into a picture.

use std::{
    sync::Arc,
    time::{Duration, Instant},
};

use rtfarm_core::tile::TileId;
use rtfarm_proto::{JobId, LeaseName, WorkerId};

use super::{Action, Delivery, DeliveryId, Farm, Notice, Storing, Verdict};
use crate::tiles::{Arrival, Rendering};

impl Farm {
    /// Event: pixels came. The first of a tile are stored, and acknowledged when that is done. They
    /// are taken only from a worker that was to render the tile under that lease, however late.
    pub(crate) fn on_pixels(
        &mut self,
        id: DeliveryId,
        delivery: Delivery,
        now: Instant,
    ) -> Vec<Action> {
        let Delivery { worker, lease, tile, .. } = delivery;
        let is_liar = self.members.is_liar(worker);
        if !is_liar
            && self.leases.tiles(lease.job).is_some()
            && !self.leases.is_granted(worker, lease, tile)
        {
            let mut actions = vec![Action::Acknowledge(id, Verdict::Rejected)];
            actions.extend(self.on_ungranted(worker, lease, tile));
            return actions;
        }
        // The worker may have been given up meanwhile.
        let _ = self.members.on_sign_of_life(worker, now);
        let arrival = if is_liar { None } else { self.stitch(id, delivery, now) };
        let mut actions = Vec::new();
        match arrival {
            None => actions.push(Action::Acknowledge(id, Verdict::Rejected)),
            Some(Arrival::First(..)) => actions.push(Action::Store(id, lease.job, tile)),
            Some(Arrival::WhileStoring(_)) => {
                let job = self.jobs.get_mut(&lease.job).expect("a tile of it is being stored");
                let storing = job.storing.get_mut(&tile).expect("it is being stored");
                storing.copies.push((id, delivery));
            }
            Some(Arrival::AfterDone(first)) => {
                self.compare(delivery, first, now, &mut actions);
                // What was in the picture may have been taken out of it.
                match self.leases.tiles(lease.job) {
                    Some(tiles) if tiles.is_open(tile) => {
                        self.stitch(id, delivery, now);
                        actions.push(Action::Store(id, lease.job, tile));
                    }
                    _ => actions.push(Action::Acknowledge(id, Verdict::Duplicate)),
                }
            }
        }
        // A worker that waits may have waited for the end of its leases.
        let is_first = matches!(arrival, Some(Arrival::First(..)));
        if !is_first || self.waiting.of(worker).is_some() {
            self.serve(now, &mut actions);
        }
        actions
    }

    /// Has the first pixels of a tile stored. `None` when the job is over.
    pub(super) fn stitch(
        &mut self,
        id: DeliveryId,
        delivery: Delivery,
        now: Instant,
    ) -> Option<Arrival> {
        let Delivery { worker, lease, tile, hash, seconds, .. } = delivery;
        let job = self.jobs.get_mut(&lease.job)?;
        // Nobody is believed more than the job's age.
        let time = Duration::try_from_secs_f64(seconds).unwrap_or_default().min(now - job.started);
        let arrival = self.leases.on_pixels(worker, lease, (tile, time), hash, now)?;
        if let Arrival::First(..) = arrival {
            job.storing.insert(tile, Storing { id, first: delivery, copies: Vec::new() });
        }
        Some(arrival)
    }

    fn on_ungranted(&mut self, worker: WorkerId, lease: LeaseName, tile: TileId) -> Option<Action> {
        self.ungranted_count += 1;
        let count = self.ungranted_count;
        // Strangers cannot fill the log.
        let is_told = count.is_power_of_two();
        is_told.then_some(Action::Log(Notice::NotGranted { worker, lease, tile, count }))
    }

    /// Event: a worker brought pixels of a tile that make no sense, for that reason. The tile, and
    /// all else that this worker has of the job, goes to others. The job fails when another worker
    /// had brought such pixels of the tile, or the same one while there was no other.
    pub(crate) fn on_senseless_pixels(
        &mut self,
        worker: WorkerId,
        lease: LeaseName,
        tile: TileId,
        reason: &str,
        now: Instant,
    ) -> Vec<Action> {
        if self.members.is_liar(worker) {
            return Vec::new();
        }
        if !self.leases.is_granted(worker, lease, tile) {
            return self.on_ungranted(worker, lease, tile).into_iter().collect();
        }
        let Some(job) = self.jobs.get_mut(&lease.job) else { return Vec::new() };
        let earlier = job.senseless.insert(tile, (worker, lease.id));
        let mut actions = Vec::new();
        match earlier {
            // The same delivery, once more.
            Some(earlier) if earlier == (worker, lease.id) => return actions,
            Some((other, _)) => {
                let tile = tile.number();
                let reason = format!("workers {other} and {worker} rendered tile {tile}: {reason}");
                self.fail(lease.job, reason, now, &mut actions);
            }
            None => {
                job.suspects.insert(worker);
                let (job, reason) = (lease.job, reason.to_owned());
                actions.push(Action::Log(Notice::Suspect { worker, job, tile, reason }));
                let losses = self.leases.on_suspicion(worker, job);
                let reason = "its worker brought pixels that make no sense";
                self.on_losses(losses, reason, now, &mut actions);
            }
        }
        self.serve(now, &mut actions);
        actions
    }

    /// Event: the pixels of a tile are in the picture.
    pub(crate) fn on_stored(&mut self, id: JobId, tile: TileId, now: Instant) -> Vec<Action> {
        let Some(job) = self.jobs.get_mut(&id) else { return Vec::new() };
        // Nothing is stored of a job that has ended: its deliveries are answered already.
        let Some(storing) = job.storing.remove(&tile) else { return Vec::new() };
        let done = self.leases.on_stored(id, tile).expect("a job that stores has not ended");
        let delivery = storing.first;
        let Delivery { worker, hash, .. } = delivery;
        let the_first = job.contributors.insert(worker);
        if let Some(host) = self.members.host(worker)
            && !job.progress.hosts.contains(host)
        {
            Arc::make_mut(&mut job.progress.hosts).insert(host.to_owned());
        }
        self.members.on_tile(worker);
        job.progress.tiles_done = done;
        job.progress.tally.add(&delivery.tally);
        job.brought.push(delivery);
        job.costs.add(delivery.seconds);
        let left = job.progress.tile_count - done;
        job.progress.left = job.costs.time_left(left, now.saturating_duration_since(job.started));
        job.progress.worker_count = job.earlier.worker_count.max(job.contributors.len() as u32);
        let (progress, elapsed) = (job.progress.clone(), job.elapsed(now));
        let mut actions = vec![Action::Acknowledge(storing.id, Verdict::Accepted)];
        actions.push(Action::Publish(id, progress.clone()));
        actions.push(Action::Log(Notice::TileDone { delivery, progress, elapsed }));
        let rendering = Rendering { worker, hash };
        if self.members.is_liar(worker) {
            self.take_back(worker, id, &mut actions);
        } else if self.audit.chooses(id, tile, worker, the_first) {
            self.audit.begin(id, tile, rendering);
        }
        for (copy, delivery) in storing.copies {
            let is_open = self.leases.tiles(id).is_none_or(|tiles| tiles.is_open(tile));
            if is_open || self.members.is_liar(delivery.worker) {
                actions.push(Action::Acknowledge(copy, Verdict::Rejected));
            } else {
                actions.push(Action::Acknowledge(copy, Verdict::Duplicate));
                self.compare(delivery, rendering, now, &mut actions);
            }
        }
        self.finish(id, now);
        if self.audit.has_pending() {
            self.serve(now, &mut actions);
        } else {
            self.end_what_is_over(now, &mut actions);
        }
        actions
    }

    /// Event: the pixels of a tile cannot be written, for that reason.
    pub(crate) fn on_store_failed(
        &mut self,
        job: JobId,
        reason: String,
        now: Instant,
    ) -> Vec<Action> {
        let mut actions = Vec::new();
        self.fail(job, reason, now, &mut actions);
        actions
    }
}
