//! The jobs of a farm: what is known of each, how they begin and how they end.

use std::{
    collections::{BTreeMap, BTreeSet},
    time::{Duration, Instant},
};

use rtfarm_core::{render::Tally, tile::TileId};
use rtfarm_job::{Outcome, Progress, TileCosts};
use rtfarm_proto::{JobId, LeaseId, WorkerId};

use super::{
    Action, Delivery, DeliveryId, Farm, Notice, Phase, STOPPED, Terms, Verdict, history::Given,
};
use crate::tiles::{MOST_LOSSES, Tiles};

/// What is counted of a job.
#[derive(Debug)]
pub(super) struct JobState {
    pub(super) started: Instant,
    pub(super) earlier: Earlier,
    pub(super) terms: Terms,
    /// A client was told of it.
    pub(super) is_claimed: bool,
    pub(super) ended_at: Option<Instant>,
    /// Its tiles, when it has failed and can be tried again.
    pub(super) rest: Option<Tiles>,
    pub(super) progress: Progress,
    pub(super) contributors: BTreeSet<WorkerId>,
    /// Workers that brought pixels that make no sense. They get no more tiles of this job while
    /// there is another worker.
    pub(super) suspects: BTreeSet<WorkerId>,
    /// Tiles of which such pixels came: who brought the last, under which lease.
    pub(super) senseless: BTreeMap<TileId, (WorkerId, LeaseId)>,
    pub(super) storing: BTreeMap<TileId, Storing>,
    /// The tiles in the picture that came since this start, in the order of coming.
    pub(super) brought: Vec<Delivery>,
    /// The leases that were given since this start, the earliest first.
    pub(super) history: Vec<Given>,
    /// What the tiles that were brought took.
    pub(super) costs: TileCosts,
    /// Tiles of which copies differ, and nobody could say which is right.
    pub(super) unsettled: BTreeSet<TileId>,
}

/// What earlier starts of a farm did for a job.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Earlier {
    /// How long they were there for it.
    pub(crate) elapsed: Duration,
    /// What the tiles in its picture took.
    pub(crate) tally: Tally,
    /// Workers that brought some of them.
    pub(crate) worker_count: u32,
}

/// A tile whose pixels are on their way into the picture.
#[derive(Debug)]
pub(super) struct Storing {
    pub(super) id: DeliveryId,
    pub(super) first: Delivery,
    /// Copies that came meanwhile. They are compared and answered when the first is safe.
    pub(super) copies: Vec<(DeliveryId, Delivery)>,
}

impl JobState {
    pub(super) fn new(progress: Progress, earlier: Earlier, terms: Terms, now: Instant) -> Self {
        Self {
            started: now,
            earlier,
            terms,
            is_claimed: false,
            ended_at: None,
            rest: None,
            progress,
            contributors: BTreeSet::new(),
            suspects: BTreeSet::new(),
            senseless: BTreeMap::new(),
            storing: BTreeMap::new(),
            brought: Vec::new(),
            history: Vec::new(),
            costs: TileCosts::default(),
            unsettled: BTreeSet::new(),
        }
    }

    /// Counts no more what tiles took that are out of the picture again.
    pub(super) fn forget_tallies(&mut self, taken: &BTreeSet<TileId>) {
        self.brought.retain(|delivery| !taken.contains(&delivery.tile));
        self.progress.tally = self.earlier.tally;
        self.costs = TileCosts::default();
        for delivery in &self.brought {
            self.costs.add(delivery.seconds);
            self.progress.tally.add(&delivery.tally);
        }
    }

    /// How long it has been rendered, or was until its end.
    pub(super) fn elapsed(&self, now: Instant) -> Duration {
        let until = self.ended_at.unwrap_or(now);
        self.earlier.elapsed + until.saturating_duration_since(self.started)
    }
}

impl Farm {
    /// Gives a number to a job to come.
    pub(crate) fn number_job(&mut self) -> JobId {
        self.last_job.0 += 1;
        self.last_job
    }

    /// Event: a picture is ordered under a number from [`Farm::number_job`]. Some of its tiles may
    /// be done already, the others are free.
    pub(crate) fn on_order(
        &mut self,
        id: JobId,
        tiles: Tiles,
        earlier: Earlier,
        terms: Terms,
        now: Instant,
    ) -> Vec<Action> {
        let progress = Progress {
            tiles_done: tiles.done_count(),
            tile_count: tiles.grid().count(),
            tally: earlier.tally,
            worker_count: earlier.worker_count,
            ..Progress::default()
        };
        let is_whole = progress.tiles_done == progress.tile_count;
        let is_begun = progress.tiles_done > 0;
        let mut actions = Vec::from_iter(is_begun.then(|| Action::Publish(id, progress.clone())));
        let job = JobState::new(progress, earlier, terms, now);
        let elapsed = job.elapsed(now);
        self.jobs.insert(id, job);
        self.leases.on_submit(id, tiles, terms.priority);
        if is_whole {
            self.end(id, Outcome::Finished(elapsed), now, &mut actions);
        } else if self.phase == Phase::Open {
            self.look_for_obstacles(&mut actions);
            self.serve(now, &mut actions);
        } else {
            self.fail(id, STOPPED.to_owned(), now, &mut actions);
        }
        actions
    }

    /// Event: a job that has ended so, and as long ago, is there for its clients, as an earlier
    /// start of the farm kept it.
    pub(crate) fn on_kept(
        &mut self,
        id: JobId,
        progress: Progress,
        terms: Terms,
        (age, now): (Duration, Instant),
    ) -> Vec<Action> {
        debug_assert!(progress.outcome.is_some(), "it has ended");
        let mut actions = vec![Action::Publish(id, progress.clone())];
        self.jobs.insert(id, JobState::new(progress, Earlier::default(), terms, now));
        self.keep_ended(id, now.checked_sub(age).unwrap_or(now));
        self.forget_old(now, &mut actions);
        actions
    }

    /// What a job has got so far: how long it has been rendered, and how many workers brought
    /// tiles.
    pub(crate) fn so_far(&self, job: JobId, now: Instant) -> Option<(Duration, u32)> {
        self.jobs.get(&job).map(|job| (job.elapsed(now), job.progress.worker_count))
    }

    /// Event: nobody wants a job's picture any more.
    pub(crate) fn on_cancel(&mut self, job: JobId, now: Instant) -> Vec<Action> {
        let mut actions = Vec::new();
        if self.end(job, Outcome::Failed("it was cancelled".to_owned()), now, &mut actions) {
            actions.push(Action::Log(Notice::JobCancelled(job)));
        }
        self.forget(job, &mut actions);
        actions
    }

    /// Notes a job of which there is nothing more to be rendered, if it is one.
    pub(super) fn finish(&mut self, job: JobId, now: Instant) {
        if self.leases.tiles(job).is_some_and(Tiles::is_over) {
            self.finishing.entry(job).or_insert(now);
        }
    }

    /// Ends jobs of which each tile is in the picture or was set aside, and none is to be compared
    /// any more.
    pub(super) fn end_what_is_over(&mut self, now: Instant, actions: &mut Vec<Action>) {
        for (id, since) in std::mem::take(&mut self.finishing) {
            // A tile that was set aside may be on its way all the same.
            if !self.leases.tiles(id).is_some_and(Tiles::is_over) {
                continue;
            }
            for tile in self.hopeless(id, since, now) {
                if !std::mem::replace(&mut self.is_told_of_no_audit, true) {
                    actions.push(Action::Log(Notice::NoAudit));
                }
                self.give_up(id, tile);
            }
            if self.audit.of(id).next().is_some() {
                self.finishing.insert(id, since);
                continue;
            }
            let time = self.jobs.get(&id).map_or(Duration::ZERO, |job| job.elapsed(now));
            if let Some(reason) = self.failure(id) {
                self.fail(id, reason, now, actions);
            } else {
                self.end(id, Outcome::Finished(time), now, actions);
            }
        }
        self.look_at = (!self.finishing.is_empty()).then(|| now + self.term);
    }

    /// Why a finished job is not what it should be.
    fn failure(&self, id: JobId) -> Option<String> {
        let (tiles, unsettled) = (self.leases.tiles(id)?, &self.jobs.get(&id)?.unsettled);
        let list = |tiles: &mut dyn Iterator<Item = &TileId>| {
            tiles.map(|tile| tile.number().to_string()).collect::<Vec<String>>().join(", ")
        };
        let aside = tiles.aside();
        let mut reasons = Vec::new();
        if !aside.is_empty() {
            let tiles = list(&mut aside.iter());
            reasons.push(format!(
                "set aside, since {MOST_LOSSES} workers were lost with each or stood still: {tiles}"
            ));
        }
        if !unsettled.is_empty() {
            let tiles = list(&mut unsettled.iter());
            reasons.push(format!("rendered differently, and nobody knows who is right: {tiles}"));
        }
        let right = tiles.done_count() - unsettled.len() as u32;
        let count = tiles.grid().count();
        (!reasons.is_empty())
            .then(|| format!("{right} of {count} tiles are right; {}", reasons.join("; ")))
    }

    pub(super) fn fail(
        &mut self,
        job: JobId,
        reason: String,
        now: Instant,
        actions: &mut Vec<Action>,
    ) {
        if self.end(job, Outcome::Failed(reason.clone()), now, actions) {
            actions.push(Action::Log(Notice::JobFailed(job, reason)));
        }
    }

    /// Ends a job, unless it has ended; says whether it had not. What is being stored of it is
    /// not needed any more, and tiles of which nobody knows whether they are right are out of the
    /// picture.
    pub(super) fn end(
        &mut self,
        id: JobId,
        outcome: Outcome,
        now: Instant,
        actions: &mut Vec<Action>,
    ) -> bool {
        let Some(job) = self.jobs.get_mut(&id) else { return false };
        if job.progress.outcome.is_some() {
            return false;
        }
        let tiles = self.leases.on_end(id);
        if let (Outcome::Failed(_), Some(mut tiles)) = (&outcome, tiles) {
            let wrong = std::mem::take(&mut job.unsettled);
            tiles.reopen(&wrong);
            job.progress.tiles_done = tiles.done_count();
            if !wrong.is_empty() {
                job.forget_tallies(&wrong);
                actions.push(Action::TakeBack(id, wrong.into_iter().collect()));
            }
            job.rest = Some(tiles);
        }
        (job.progress.outcome, job.progress.left) = (Some(outcome), None);
        actions.push(Action::Publish(id, job.progress.clone()));
        for storing in std::mem::take(&mut job.storing).into_values() {
            let copies = storing.copies.into_iter().map(|(id, _)| id);
            let deliveries = std::iter::once(storing.id).chain(copies);
            actions.extend(deliveries.map(|id| Action::Acknowledge(id, Verdict::Rejected)));
        }
        self.audit.on_end(id);
        self.finishing.remove(&id);
        self.keep_ended(id, now);
        self.forget_old(now, actions);
        true
    }
}
