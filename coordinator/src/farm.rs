//! The coordinator's one machine: members, leases, stitching, counting, ending and waiting.
//! Decisions alone: every event is a method that takes the time, and answers with what its shell
//! is to do; nothing here waits, writes or logs.

use std::{
    collections::{BTreeMap, BTreeSet},
    sync::Arc,
    time::{Duration, Instant},
};

use rtfarm_core::{render::Tally, tile::TileId};
use rtfarm_job::{Outcome, Progress, TileCosts};
use rtfarm_proto::{Incarnation, JobId, LONGEST_WAIT, LeaseId, LeaseName, Renewal, WorkerId};

use crate::{
    audit::Audit,
    identity::{Identity, Stranger},
    lease::{LONGEST_QUIET, Leases, Loss, Run},
    members::{KeptOut, Mark, Members, NoMember, Process, Standing},
    tiles::{Arrival, MOST_LOSSES, PixelHash, Rendering, Tiles},
    waiting::{Ask, AskId, Waiting},
};

/// A worker that says nothing for this long is a member no more. One without work asks again
/// after each wait at the latest.
const LONGEST_SILENCE: Duration = LONGEST_WAIT.saturating_mul(6);

/// A tile that takes so many times what others of its job took is rendered a second time before
/// tiles of later jobs.
const OVERDUE: u32 = 3;

/// How long workers may take to go home when the coordinator stops.
const FAREWELL: Duration = Duration::from_millis(1500);

/// Why jobs fail when the coordinator stops.
const STOPPED: &str = "the coordinator was stopped";

/// A farm. Invariants: every lease and every waiting question belongs to a member; a tile counts
/// as done only after its pixels were stored; every question and every delivery gets exactly one
/// answer.
#[derive(Debug)]
pub(crate) struct Farm {
    identity: Identity,
    /// Calls that were meant for another incarnation.
    stranger_count: u64,
    /// Tiles that came from workers that were never to render them.
    ungranted_count: u64,
    /// Jobs are there again when the farm is: it may stop before they have ended.
    keeps_jobs: bool,
    term: Duration,
    members: Members,
    leases: Leases,
    waiting: Waiting,
    audit: Audit,
    /// It was said that nobody renders tiles again.
    is_told_of_no_audit: bool,
    jobs: BTreeMap<JobId, JobState>,
    keeping: Keeping,
    /// Jobs that have ended and are kept, by the time of their ends.
    ended: BTreeSet<(Instant, JobId)>,
    /// Jobs of which each tile is in the picture or was set aside, since when.
    finishing: BTreeMap<JobId, Instant>,
    /// When they are looked at again: what they wait for may never come.
    look_at: Option<Instant>,
    last_job: JobId,
    phase: Phase,
}

/// What is counted of a job.
#[derive(Debug)]
struct JobState {
    started: Instant,
    earlier: Earlier,
    terms: Terms,
    /// A client was told of it.
    is_claimed: bool,
    ended_at: Option<Instant>,
    /// Its tiles, when it has failed and can be tried again.
    rest: Option<Tiles>,
    progress: Progress,
    contributors: BTreeSet<WorkerId>,
    /// Workers that brought pixels that make no sense. They get no more tiles of this job while
    /// there is another worker.
    suspects: BTreeSet<WorkerId>,
    /// Tiles of which such pixels came: who brought the last, under which lease.
    senseless: BTreeMap<TileId, (WorkerId, LeaseId)>,
    storing: BTreeMap<TileId, Storing>,
    /// The tiles in the picture that came since this start, in the order of coming.
    brought: Vec<Delivery>,
    /// The leases that were given since this start, the earliest first.
    history: Vec<Given>,
    /// What the tiles that were brought took.
    costs: TileCosts,
    /// Tiles of which copies differ, and nobody could say which is right.
    unsettled: BTreeSet<TileId>,
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
struct Storing {
    id: DeliveryId,
    first: Delivery,
    /// Copies that came meanwhile. They are compared and answered when the first is safe.
    copies: Vec<(DeliveryId, Delivery)>,
}

/// What there is to do for a worker that waits.
#[derive(Debug, Clone, Copy)]
enum Work {
    /// Free tiles of a job.
    Free(JobId),
    /// A tile of a job that may be the end of its worker.
    Suspect(JobId),
    /// A tile of a lease that another worker has.
    Overdue(LeaseId),
    /// A tile that another worker has rendered, to compare.
    Audit(JobId, TileId),
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Phase {
    Open,
    /// Workers that ask for tiles are sent home.
    Closing,
    /// The same, and the shell stops when they have gone, at that time at the latest.
    Farewell(Instant),
    Stopped,
}

/// Pixels that came. The shell numbers them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(crate) struct DeliveryId(pub(crate) u64);

/// What came with the pixels of a tile.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Delivery {
    pub(crate) worker: WorkerId,
    pub(crate) lease: LeaseName,
    pub(crate) tile: TileId,
    pub(crate) hash: PixelHash,
    /// Time on one thread.
    pub(crate) seconds: f64,
    pub(crate) tally: Tally,
}

/// The answer to a question for tiles.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Next {
    /// Render these tiles.
    Render(Run),
    /// There was nothing to do for as long as the worker would wait.
    Nothing,
    /// There will be nothing to do any more.
    GoHome,
}

/// The answer to a delivery.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Verdict {
    /// The pixels are in the picture.
    Accepted,
    /// Earlier pixels of the tile are in the picture.
    Duplicate,
    /// The job is over, or the worker was never to render the tile.
    Rejected,
}

/// What the shell is to do, in this order.
#[derive(Debug)]
pub(crate) enum Action {
    /// Answer a question for tiles.
    Answer(AskId, Result<Next, NoMember>),
    /// Write the pixels of a delivery into the picture of a job, then report
    /// [`Farm::on_stored`] or [`Farm::on_store_failed`].
    Store(DeliveryId, JobId, TileId),
    /// Answer a delivery.
    Acknowledge(DeliveryId, Verdict),
    /// Keep that a job has not ended, whatever was kept of its end.
    Reopen(JobId),
    /// Keep the terms of a job.
    Keep(JobId, Terms),
    /// Keep what is remembered of processes.
    KeepMarks(BTreeMap<u64, Mark>),
    /// Forget what is kept of tiles that are not in the picture any more.
    TakeBack(JobId, Vec<TileId>),
    /// Show those who watch a job how far it is.
    Publish(JobId, Progress),
    /// Drop a job's scene and picture.
    Forget(JobId),
    /// Write a line into the log.
    Log(Notice),
    /// Close the connections: everybody has gone home, or had the time to.
    Stop,
}

/// What a log line says.
#[derive(Debug)]
pub(crate) enum Notice {
    /// A worker is new on the farm.
    Joined(WorkerId, Process),
    /// A worker without leases is gone, for that reason.
    Gone(WorkerId, String),
    /// A lease is lost, or tiles of it, for that reason.
    LeaseLost(Loss, String),
    /// A tile is rendered no more: too many workers were lost with it in work.
    SetAside(JobId, TileId),
    /// A tile is in the picture, as the last of those in `progress`, so long after the job's
    /// start.
    TileDone { delivery: Delivery, progress: Progress, elapsed: Duration },
    /// A further copy of a tile has another hash than what is in the picture.
    CopiesDiffer { second: Delivery, first: Rendering },
    /// A worker brought pixels of a tile that two others contradict, and is kept out from now on.
    Liar { worker: WorkerId, job: JobId, tile: TileId },
    /// Tiles of a liar are taken out of a picture, to be rendered again.
    TakenBack { worker: WorkerId, job: JobId, tiles: Vec<TileId> },
    /// Nobody is there to render tiles again and compare. It is said once.
    NoAudit,
    /// A tile is not compared any more: workers were lost with it too often.
    NotCompared(JobId, TileId),
    /// A job failed, for that reason.
    JobFailed(JobId, String),
    /// A job waits for a worker that can hold its scene.
    NoRoom(JobId, String),
    /// A client cancelled a job.
    JobCancelled(JobId),
    /// A job is forgotten, since there is no room or no time for it any more.
    JobExpired(JobId),
    /// Somebody changed a job.
    JobChanged(JobId, Change),
    /// Somebody decided what a worker gets.
    Stationed(WorkerId, Standing),
    /// Pixels came of a tile that their worker was never to render under that lease, as the last of
    /// so many.
    NotGranted { worker: WorkerId, lease: LeaseName, tile: TileId, count: u64 },
    /// A worker brought pixels that make no sense, for that reason.
    Suspect { worker: WorkerId, job: JobId, tile: TileId, reason: String },
    /// So many calls were refused, since they were meant for another incarnation.
    Strangers(u64),
}

impl JobState {
    fn new(progress: Progress, earlier: Earlier, terms: Terms, now: Instant) -> Self {
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
    fn forget_tallies(&mut self, taken: &BTreeSet<TileId>) {
        self.brought.retain(|delivery| !taken.contains(&delivery.tile));
        self.progress.tally = self.earlier.tally;
        self.costs = TileCosts::default();
        for delivery in &self.brought {
            self.costs.add(delivery.seconds);
            self.progress.tally.add(&delivery.tally);
        }
    }

    /// How long it has been rendered, or was until its end.
    fn elapsed(&self, now: Instant) -> Duration {
        let until = self.ended_at.unwrap_or(now);
        self.earlier.elapsed + until.saturating_duration_since(self.started)
    }
}

impl Farm {
    /// Makes a farm without members and jobs. A lease lives for `term` after the last progress.
    pub(crate) fn new(identity: Identity, term: Duration, audit: Audit) -> Self {
        Self {
            identity,
            stranger_count: 0,
            ungranted_count: 0,
            keeps_jobs: false,
            term,
            members: Members::new(LONGEST_SILENCE.max(term)),
            leases: Leases::new(term),
            waiting: Waiting::default(),
            audit,
            is_told_of_no_audit: false,
            jobs: BTreeMap::new(),
            keeping: Keeping::default(),
            ended: BTreeSet::new(),
            finishing: BTreeMap::new(),
            look_at: None,
            last_job: identity.job_before_first(),
            phase: Phase::Open,
        }
    }

    /// Makes a farm whose jobs outlive it, of which `last_job` was the last so far.
    pub(crate) fn keeping_jobs(
        identity: Identity,
        term: Duration,
        audit: Audit,
        last_job: JobId,
    ) -> Self {
        Self { keeps_jobs: true, last_job, ..Self::new(identity, term, audit) }
    }

    /// When [`Farm::on_time`] is to be called next, at the latest.
    pub(crate) fn next_wake(&self) -> Option<Instant> {
        let farewell = if let Phase::Farewell(until) = self.phase { Some(until) } else { None };
        let deadline = self.waiting.next_deadline().map(|(until, _)| until);
        let second = self.next_second_rendering().map(|(from, ..)| from);
        let expiry = self.leases.next_expiry();
        let check = self.members.next_check();
        let oldest = self.next_oblivion();
        let times = [expiry, check, deadline, second, farewell, self.look_at, oldest];
        times.into_iter().flatten().min()
    }

    /// Event: time passes.
    pub(crate) fn on_time(&mut self, now: Instant) -> Vec<Action> {
        let mut actions = Vec::new();
        let losses = self.leases.on_time(now);
        let reason = format!("no progress for {:.1} s", self.term.as_secs_f64());
        self.on_losses(losses, &reason, now, &mut actions);
        for worker in self.members.on_time(now) {
            let reason = format!("silent for {} s", LONGEST_SILENCE.max(self.term).as_secs());
            self.lose_worker(worker, true, &reason, now, &mut actions);
        }
        self.forget_old(now, &mut actions);
        self.serve(now, &mut actions);
        self.end_farewell(now, &mut actions);
        actions
    }

    /// Event: a call comes that is neither to join nor to submit. What it asks for may be done only
    /// if it is meant for this incarnation.
    pub(crate) fn on_call(
        &mut self,
        incarnation: Incarnation,
    ) -> (Result<(), Stranger>, Vec<Action>) {
        if incarnation == self.identity.incarnation {
            return (Ok(()), Vec::new());
        }
        self.stranger_count += 1;
        // Strangers cannot fill the log.
        let is_told = self.stranger_count.is_power_of_two();
        let told = is_told.then_some(Action::Log(Notice::Strangers(self.stranger_count)));
        (Err(Stranger), told.into_iter().collect())
    }

    // Members.

    /// Event: a process joins. The same nonce gets the same number.
    pub(crate) fn on_join(
        &mut self,
        process: Process,
        now: Instant,
    ) -> (Result<WorkerId, KeptOut>, Vec<Action>) {
        match self.members.on_join(&process, now) {
            Ok((worker, true)) => {
                let mut actions = vec![Action::Log(Notice::Joined(worker, process))];
                self.look_for_obstacles(&mut actions);
                (Ok(worker), actions)
            }
            Ok((worker, false)) => (Ok(worker), Vec::new()),
            Err(kept_out) => (Err(kept_out), Vec::new()),
        }
    }

    /// Event: a worker leaves, for that reason.
    pub(crate) fn on_leave(&mut self, worker: WorkerId, reason: &str, now: Instant) -> Vec<Action> {
        self.on_worker_gone(worker, false, reason, now)
    }

    /// Event: a process on this machine, which may be a worker, has ended for that reason.
    pub(crate) fn on_process_exit(
        &mut self,
        process: u32,
        reason: &str,
        now: Instant,
    ) -> Vec<Action> {
        let worker = self.members.in_process(process);
        worker.map_or_else(Vec::new, |worker| self.on_worker_gone(worker, true, reason, now))
    }

    fn on_worker_gone(
        &mut self,
        worker: WorkerId,
        died: bool,
        reason: &str,
        now: Instant,
    ) -> Vec<Action> {
        let mut actions = Vec::new();
        self.lose_worker(worker, died, reason, now, &mut actions);
        self.serve(now, &mut actions);
        self.end_farewell(now, &mut actions);
        actions
    }

    fn lose_worker(
        &mut self,
        worker: WorkerId,
        died: bool,
        reason: &str,
        now: Instant,
        actions: &mut Vec<Action>,
    ) {
        let was_member = self.members.remove(worker);
        self.look_for_obstacles(actions);
        if let Some(ask) = self.waiting.of(worker) {
            self.waiting.remove(ask);
            actions.push(Action::Answer(ask, Err(NoMember(worker))));
        }
        let losses = self.leases.on_worker_lost(worker, died);
        if was_member && losses.is_empty() {
            actions.push(Action::Log(Notice::Gone(worker, reason.to_owned())));
        }
        self.on_losses(losses, reason, now, actions);
    }

    fn on_losses(
        &mut self,
        losses: Vec<Loss>,
        reason: &str,
        now: Instant,
        actions: &mut Vec<Action>,
    ) {
        for loss in losses {
            let job = loss.lease.job;
            self.note_lost(&loss, reason);
            for &tile in &loss.again {
                if self.audit.on_loss(job, tile) {
                    actions.push(Action::Log(Notice::NotCompared(job, tile)));
                    self.give_up(job, tile);
                }
            }
            let aside = loss.aside.iter().map(|&tile| Notice::SetAside(job, tile));
            let aside: Vec<Action> = aside.map(Action::Log).collect();
            actions.push(Action::Log(Notice::LeaseLost(loss, reason.to_owned())));
            actions.extend(aside);
            self.finish(job, now);
        }
    }

    // Asking and waiting.

    /// Event: a worker asks for tiles. It is answered at once when there are some; otherwise as
    /// soon as there are, or when it would wait no longer. An older question that the worker still
    /// has is answered with nothing.
    pub(crate) fn on_ask(&mut self, id: AskId, ask: Ask, now: Instant) -> Vec<Action> {
        let mut actions = Vec::new();
        if self.phase != Phase::Open {
            self.send_home(ask.worker, id, &mut actions);
            self.end_farewell(now, &mut actions);
            return actions;
        }
        if let Err(stranger) = self.members.on_sign_of_life(ask.worker, now) {
            return vec![Action::Answer(id, Err(stranger))];
        }
        if let Some(older) = self.waiting.add(id, ask) {
            actions.push(Action::Answer(older, Ok(Next::Nothing)));
        }
        self.serve(now, &mut actions);
        actions
    }

    /// Event: a worker has pixels of these tiles of a job, which it rendered for an earlier start of
    /// this farm. Those that are free are leased to it, as any tile is.
    pub(crate) fn on_offer(
        &mut self,
        worker: WorkerId,
        job: JobId,
        numbers: &[u32],
        now: Instant,
    ) -> Option<Run> {
        self.members.on_sign_of_life(worker, now).ok()?;
        let is_on_trial = self.leases.is_on_trial(worker);
        if self.phase != Phase::Open || is_on_trial || !self.may_render(worker, job) {
            return None;
        }
        let grid = self.leases.tiles(job)?.grid();
        let tiles: Vec<TileId> = numbers.iter().filter_map(|&number| grid.tile(number)).collect();
        let threads = self.members.threads(worker).0;
        let run = self.leases.on_offer((worker, threads), job, &tiles, now)?;
        self.note_given(worker, &run, now);
        Some(run)
    }

    /// Event: nobody waits for the answer to a question any longer.
    pub(crate) fn on_hang_up(&mut self, ask: AskId) {
        self.waiting.remove(ask);
    }

    /// Answers the questions for which there is an answer now: free tiles go to those who wait
    /// longest, then quiet leases are rendered a second time, then the rest may have waited
    /// long enough.
    fn serve(&mut self, now: Instant, actions: &mut Vec<Action>) {
        self.send_home_who_is_drained(actions);
        while let Some((id, ask, work)) = self.next_work(now) {
            self.waiting.remove(id);
            let run = match work {
                Work::Free(job) => {
                    let threads = self.members.threads(ask.worker);
                    self.leases.on_idle(ask.worker, job, threads, ask.most, now)
                }
                Work::Suspect(job) => self.leases.on_trial(ask.worker, job, now),
                Work::Overdue(lease) => self.leases.on_idle_at_the_end(ask.worker, lease, now),
                Work::Audit(job, tile) => {
                    self.audit.on_lease(job, tile);
                    self.leases.on_audit(ask.worker, job, tile, now)
                }
            };
            let run = run.expect("the job has a free tile, or the lease one that is in no other");
            self.note_given(ask.worker, &run, now);
            actions.push(Action::Answer(id, Ok(Next::Render(run))));
        }
        while let Some((from, id, quiet)) = self.next_second_rendering()
            && from <= now
            && let Some(ask) = self.waiting.remove(id)
        {
            let run = self.leases.on_idle_at_the_end(ask.worker, quiet, now);
            let run = run.expect("a quiet lease holds a tile that no other lease holds");
            self.note_given(ask.worker, &run, now);
            actions.push(Action::Answer(id, Ok(Next::Render(run))));
        }
        while let Some((until, id)) = self.waiting.next_deadline()
            && until <= now
        {
            self.waiting.remove(id);
            actions.push(Action::Answer(id, Ok(Next::Nothing)));
        }
        self.end_what_is_over(now, actions);
    }

    /// What the worker that waits longest of those that may have some gets, while there are free
    /// tiles or some to compare.
    fn next_work(&self, now: Instant) -> Option<(AskId, Ask, Work)> {
        if !self.leases.has_free() && !self.audit.has_pending() {
            return None;
        }
        self.waiting.iter().find_map(|(id, ask)| Some((id, ask, self.work_for(ask.worker, now)?)))
    }

    /// What a worker that waits may begin: a tile to compare or free tiles of the first job that has
    /// any, unless one before it has a tile that is overdue, or a suspect, for which the worker
    /// first finishes all else that it has.
    fn work_for(&self, worker: WorkerId, now: Instant) -> Option<Work> {
        if self.leases.is_on_trial(worker) {
            return None;
        }
        for (job, tiles) in self.leases.jobs().filter(|&(job, _)| self.may_begin(worker, job)) {
            if let Some(tile) = self.audit.work_for(job, worker) {
                return Some(Work::Audit(job, tile));
            }
            if tiles.has_suspect() && self.leases.is_without(worker) {
                return Some(Work::Suspect(job));
            }
            if tiles.free_count() > 0 {
                return Some(Work::Free(job));
            }
            if tiles.has_suspect() {
                return None;
            }
            if let Some(lease) = self.overdue(job, worker, now) {
                return Some(Work::Overdue(lease));
            }
        }
        None
    }

    /// A lease of another worker whose next tile of `job` should have come long ago.
    fn overdue(&self, job: JobId, worker: WorkerId, now: Instant) -> Option<LeaseId> {
        let predicted = self.leases.pace(job)?.mean()?;
        let mut quiet = self.leases.quietest(job);
        let overdue = quiet
            .find(|quiet| quiet.worker != worker)
            .filter(|quiet| quiet.last_tile + LONGEST_QUIET + predicted * OVERDUE <= now);
        overdue.map(|quiet| quiet.lease.id)
    }

    /// Says whether a worker may have tiles of a job: one under suspicion only if all are.
    fn may_render(&self, worker: WorkerId, job: JobId) -> bool {
        let Some(JobState { suspects, terms, .. }) = self.jobs.get(&job) else { return false };
        let bytes = terms.scene_byte_count;
        let is_suspect = |worker| suspects.contains(&worker);
        self.members.may_hold(worker, bytes)
            && (!is_suspect(worker) || self.members.all(bytes, is_suspect))
    }

    /// From when on which waiting question can be answered with a tile of which quiet lease.
    fn next_second_rendering(&self) -> Option<(Instant, AskId, LeaseId)> {
        self.waiting.first()?;
        // With two that wait, the first lease of a job will do; with one, all but its own.
        let first_of = |job| {
            self.leases.quietest(job).find_map(|quiet| {
                let may = |worker| {
                    worker != quiet.worker
                        && !self.leases.is_on_trial(worker)
                        && self.may_begin(worker, job)
                };
                let (ask, _) = self.waiting.iter().find(|(_, ask)| may(ask.worker))?;
                Some((quiet.from, ask, quiet.lease.id))
            })
        };
        let firsts = self.leases.quiet_jobs().filter_map(first_of);
        firsts.min_by_key(|&(from, _, lease)| (from, lease))
    }

    // Rendering and stitching.

    /// Event: a worker says how far it is under its leases. Answers with those that it has lost.
    pub(crate) fn on_renew(
        &mut self,
        worker: WorkerId,
        renewals: &[Renewal],
        now: Instant,
    ) -> Result<Vec<LeaseName>, NoMember> {
        self.members.on_sign_of_life(worker, now)?;
        let lost = renewals.iter().filter(|renewal| !self.leases.on_renewal(worker, renewal, now));
        Ok(lost.map(|renewal| renewal.lease).collect())
    }

    /// Turns a number from the wire into a tile of a job that is being rendered.
    pub(crate) fn tile(&self, job: JobId, number: u32) -> Option<TileId> {
        self.leases.tiles(job)?.grid().tile(number)
    }

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
    fn stitch(&mut self, id: DeliveryId, delivery: Delivery, now: Instant) -> Option<Arrival> {
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

    // Jobs.

    /// Gives a number to a job to come.
    pub(crate) fn number_job(&mut self) -> JobId {
        self.last_job.0 += 1;
        self.last_job
    }

    /// Event: a picture is ordered under a number from [`Farm::number_job`]. Some of its tiles may be
    /// done already, the others are free.
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

    /// Event: a job that has ended so, and as long ago, is there for its clients, as an earlier start
    /// of the farm kept it.
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

    /// What a job has got so far: how long it has been rendered, and how many workers brought tiles.
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
    fn finish(&mut self, job: JobId, now: Instant) {
        if self.leases.tiles(job).is_some_and(Tiles::is_over) {
            self.finishing.entry(job).or_insert(now);
        }
    }

    /// Ends jobs of which each tile is in the picture or was set aside, and none is to be compared
    /// any more.
    fn end_what_is_over(&mut self, now: Instant, actions: &mut Vec<Action>) {
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

    fn fail(&mut self, job: JobId, reason: String, now: Instant, actions: &mut Vec<Action>) {
        if self.end(job, Outcome::Failed(reason.clone()), now, actions) {
            actions.push(Action::Log(Notice::JobFailed(job, reason)));
        }
    }

    /// Ends a job, unless it has ended; says whether it had not. What is being stored of it is
    /// not needed any more, and tiles of which nobody knows whether they are right are out of the
    /// picture.
    fn end(
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

    // Stopping.

    /// Event: there will be no more work. Workers are sent home.
    pub(crate) fn on_close(&mut self) -> Vec<Action> {
        let mut actions = Vec::new();
        if self.phase == Phase::Open {
            self.phase = Phase::Closing;
        }
        while let Some((id, ask)) = self.waiting.first() {
            self.waiting.remove(id);
            self.send_home(ask.worker, id, &mut actions);
        }
        actions
    }

    /// Event: the coordinator is to stop. Workers are sent home, and every job that will not be there
    /// again has ended.
    pub(crate) fn on_shut_down(&mut self, now: Instant) -> Vec<Action> {
        let mut actions = self.on_close();
        if !self.keeps_jobs {
            let jobs: Vec<JobId> = self.jobs.keys().copied().collect();
            for job in jobs {
                self.fail(job, STOPPED.to_owned(), now, &mut actions);
            }
        }
        self.phase = Phase::Farewell(now + FAREWELL);
        self.end_farewell(now, &mut actions);
        actions
    }

    /// Sends a worker home. Its leases end with it; since that is no misfortune, nobody is told.
    fn send_home(&mut self, worker: WorkerId, ask: AskId, actions: &mut Vec<Action>) {
        self.members.remove(worker);
        self.leases.on_worker_lost(worker, false);
        actions.push(Action::Answer(ask, Ok(Next::GoHome)));
    }

    fn end_farewell(&mut self, now: Instant, actions: &mut Vec<Action>) {
        if let Phase::Farewell(until) = self.phase
            && (self.members.is_empty() || until <= now)
        {
            self.phase = Phase::Stopped;
            actions.push(Action::Stop);
        }
    }
}

#[cfg(test)]
impl Farm {
    /// Event: a picture of these tiles, all of them free, is ordered.
    pub(crate) fn on_submit(&mut self, id: JobId, tiles: Tiles, now: Instant) -> Vec<Action> {
        self.on_order(id, tiles, Earlier::default(), Terms::default(), now)
    }

    /// Which start of the farm this is.
    pub(crate) fn incarnation(&self) -> Incarnation {
        self.identity.incarnation
    }

    /// Checks every invariant, at the price of a scan.
    pub(crate) fn check(&self) {
        let is_member = |worker| self.members.contains(worker);
        self.members.check();
        self.leases.check(is_member);
        self.waiting.check(is_member);
        self.audit.check(|job| self.leases.tiles(job).is_some());
        for (id, job) in &self.jobs {
            let tiles = self.leases.tiles(*id);
            assert_eq!(tiles.is_some(), job.progress.outcome.is_none());
            assert_eq!(job.ended_at.is_some(), job.progress.outcome.is_some());
            assert!(job.ended_at.is_none_or(|end| self.ended.contains(&(end, *id))));
            assert!(job.rest.is_none() || job.ended_at.is_some());
            let done = tiles.map_or(job.progress.tiles_done, Tiles::done_count);
            assert_eq!(done, job.progress.tiles_done);
            assert!(tiles.is_some() || job.storing.is_empty());
        }
        let ended = self.jobs.values().filter(|job| job.ended_at.is_some());
        assert_eq!(self.ended.len(), ended.count());
    }
}

mod history;
mod queue;
mod trust;
mod watching;

use history::Given;
pub(crate) use history::{Attempt, Explanation};
pub use queue::Keeping;
pub(crate) use queue::{Change, JobEntry, Phase as JobPhase, Refused, Terms};
pub(crate) use watching::Arrived;

#[cfg(test)]
mod tests;
