//! The coordinator's one machine: members, leases, stitching, counting, ending and waiting.
//! Decisions alone: every event is a method that takes the time, and answers with what its shell
//! is to do; nothing here waits, writes or logs.

use std::{
    collections::{BTreeMap, BTreeSet, VecDeque},
    time::{Duration, Instant},
};

use rtfarm_core::{render::Tally, tile::TileId};
use rtfarm_job::{Outcome, Progress};
use rtfarm_proto::{Incarnation, JobId, LONGEST_WAIT, LeaseId, LeaseName, Renewal, WorkerId};

use crate::{
    identity::{Identity, Stranger},
    lease::{Leases, Loss, Run},
    members::{Members, NoMember, Process},
    tiles::{Arrival, PixelHash, Tiles},
    waiting::{Ask, AskId, Waiting},
};

/// A worker that says nothing for this long is a member no more. One without work asks again
/// after each wait at the latest.
const LONGEST_SILENCE: Duration = LONGEST_WAIT.saturating_mul(6);

/// Jobs that have ended and are kept for their clients.
const KEPT_AFTER_END: usize = 16;

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
    term: Duration,
    members: Members,
    leases: Leases,
    waiting: Waiting,
    jobs: BTreeMap<JobId, JobState>,
    /// Jobs that have ended and are kept, in the order of their ends.
    ended: VecDeque<JobId>,
    last_job: JobId,
    phase: Phase,
}

/// What is counted of a job.
#[derive(Debug)]
struct JobState {
    started: Instant,
    progress: Progress,
    contributors: BTreeSet<WorkerId>,
    /// What its tiles took one thread, together; nobody is believed more than the job's age.
    thread_time: Duration,
    /// Workers that brought pixels that make no sense. They get no more tiles of this job while
    /// there is another worker.
    suspects: BTreeSet<WorkerId>,
    /// Tiles of which such pixels came: who brought the last, under which lease.
    senseless: BTreeMap<TileId, (WorkerId, LeaseId)>,
    storing: BTreeMap<TileId, Storing>,
}

/// A tile whose pixels are on their way into the picture.
#[derive(Debug)]
struct Storing {
    id: DeliveryId,
    first: Delivery,
    /// Copies that came meanwhile. They are answered when the first is safe.
    copies: Vec<DeliveryId>,
}

/// What there is to do for a worker that waits.
#[derive(Debug, Clone, Copy)]
enum Work {
    /// Free tiles of a job.
    Free(JobId),
    /// A tile of a lease that another worker has.
    Overdue(LeaseId),
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
    /// A lease is lost, for that reason.
    LeaseLost(Loss, String),
    /// A tile is in the picture, as the last of those in `progress`, so long after the job's
    /// start.
    TileDone { delivery: Delivery, progress: Progress, elapsed: Duration },
    /// A second copy of a tile has another hash than the first.
    CopiesDiffer { second: Delivery, first: PixelHash },
    /// A job failed, for that reason.
    JobFailed(JobId, String),
    /// A client cancelled a job.
    JobCancelled(JobId),
    /// Pixels came of a tile that their worker was never to render under that lease, as the last of
    /// so many.
    NotGranted { worker: WorkerId, lease: LeaseName, tile: TileId, count: u64 },
    /// A worker brought pixels that make no sense, for that reason.
    Suspect { worker: WorkerId, job: JobId, tile: TileId, reason: String },
    /// So many calls were refused, since they were meant for another incarnation.
    Strangers(u64),
}

impl Farm {
    /// Makes a farm without members and jobs. A lease lives for `term` after the last progress.
    pub(crate) fn new(identity: Identity, term: Duration) -> Self {
        Self {
            identity,
            stranger_count: 0,
            ungranted_count: 0,
            term,
            members: Members::new(LONGEST_SILENCE.max(term)),
            leases: Leases::new(term),
            waiting: Waiting::default(),
            jobs: BTreeMap::new(),
            ended: VecDeque::new(),
            last_job: identity.job_before_first(),
            phase: Phase::Open,
        }
    }

    /// When [`Farm::on_time`] is to be called next, at the latest.
    pub(crate) fn next_wake(&self) -> Option<Instant> {
        let farewell = if let Phase::Farewell(until) = self.phase { Some(until) } else { None };
        let deadline = self.waiting.next_deadline().map(|(until, _)| until);
        let second = self.next_second_rendering().map(|(from, ..)| from);
        let times =
            [self.leases.next_expiry(), self.members.next_check(), deadline, second, farewell];
        times.into_iter().flatten().min()
    }

    /// Event: time passes.
    pub(crate) fn on_time(&mut self, now: Instant) -> Vec<Action> {
        let mut actions = Vec::new();
        for loss in self.leases.on_time(now) {
            let reason = format!("no progress for {:.1} s", self.term.as_secs_f64());
            actions.push(Action::Log(Notice::LeaseLost(loss, reason)));
        }
        for worker in self.members.on_time(now) {
            let reason = format!("silent for {} s", LONGEST_SILENCE.max(self.term).as_secs());
            self.lose_worker(worker, &reason, &mut actions);
        }
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
    pub(crate) fn on_join(&mut self, process: Process, now: Instant) -> (WorkerId, Vec<Action>) {
        let (worker, is_new) = self.members.on_join(&process, now);
        let joined = is_new.then_some(Action::Log(Notice::Joined(worker, process)));
        (worker, joined.into_iter().collect())
    }

    /// Event: a worker leaves, for that reason.
    pub(crate) fn on_leave(&mut self, worker: WorkerId, reason: &str, now: Instant) -> Vec<Action> {
        let mut actions = Vec::new();
        self.lose_worker(worker, reason, &mut actions);
        self.serve(now, &mut actions);
        self.end_farewell(now, &mut actions);
        actions
    }

    /// Event: a process on this machine, which may be a worker, has ended for that reason.
    pub(crate) fn on_process_exit(
        &mut self,
        process: u32,
        reason: &str,
        now: Instant,
    ) -> Vec<Action> {
        let worker = self.members.in_process(process);
        worker.map_or_else(Vec::new, |worker| self.on_leave(worker, reason, now))
    }

    fn lose_worker(&mut self, worker: WorkerId, reason: &str, actions: &mut Vec<Action>) {
        let was_member = self.members.remove(worker);
        if let Some(ask) = self.waiting.of(worker) {
            self.waiting.remove(ask);
            actions.push(Action::Answer(ask, Err(NoMember(worker))));
        }
        let losses = self.leases.on_worker_lost(worker);
        if was_member && losses.is_empty() {
            actions.push(Action::Log(Notice::Gone(worker, reason.to_owned())));
        }
        let log = |loss| Action::Log(Notice::LeaseLost(loss, reason.to_owned()));
        actions.extend(losses.into_iter().map(log));
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

    /// Event: nobody waits for the answer to a question any longer.
    pub(crate) fn on_hang_up(&mut self, ask: AskId) {
        self.waiting.remove(ask);
    }

    /// Answers the questions for which there is an answer now: free tiles go to those who wait
    /// longest, then quiet leases are rendered a second time, then the rest may have waited
    /// long enough.
    fn serve(&mut self, now: Instant, actions: &mut Vec<Action>) {
        while let Some((id, ask, work)) = self.next_work(now) {
            self.waiting.remove(id);
            let run = match work {
                Work::Free(job) => {
                    let threads = self.members.threads(ask.worker);
                    self.leases.on_idle(ask.worker, job, threads, ask.most, now)
                }
                Work::Overdue(lease) => self.leases.on_idle_at_the_end(ask.worker, lease, now),
            };
            let run = run.expect("the job has a free tile, or the lease one that is in no other");
            actions.push(Action::Answer(id, Ok(Next::Render(run))));
        }
        while let Some((from, id, quiet)) = self.next_second_rendering()
            && from <= now
            && let Some(ask) = self.waiting.remove(id)
        {
            let run = self.leases.on_idle_at_the_end(ask.worker, quiet, now);
            let run = run.expect("a quiet lease holds a tile that no other lease holds");
            actions.push(Action::Answer(id, Ok(Next::Render(run))));
        }
        while let Some((until, id)) = self.waiting.next_deadline()
            && until <= now
        {
            self.waiting.remove(id);
            actions.push(Action::Answer(id, Ok(Next::Nothing)));
        }
    }

    /// What the worker that waits longest of those that may have some gets, while there are free
    /// tiles: free tiles of the earliest job that has any, unless one before it has a tile that is
    /// overdue.
    fn next_work(&self, now: Instant) -> Option<(AskId, Ask, Work)> {
        if !self.leases.has_free() {
            return None;
        }
        self.waiting.iter().find_map(|(id, ask)| {
            let mut jobs = self.leases.jobs().filter(|&(job, _)| self.may_render(ask.worker, job));
            let work = jobs.find_map(|(job, free_count)| match free_count {
                0 => self.overdue(job, ask.worker, now).map(Work::Overdue),
                _ => Some(Work::Free(job)),
            });
            Some((id, ask, work?))
        })
    }

    /// A lease of another worker whose next tile of `job` should have come long ago.
    fn overdue(&self, job: JobId, worker: WorkerId, now: Instant) -> Option<LeaseId> {
        let JobState { thread_time, progress, .. } = self.jobs.get(&job)?;
        let predicted = thread_time.checked_div(progress.tiles_done)?;
        let quiet = self.leases.quietest().take_while(|&(from, ..)| from <= now);
        let mut overdue = quiet.filter(|&(from, holder, lease)| {
            lease.job == job && holder != worker && from + predicted * OVERDUE <= now
        });
        overdue.next().map(|(.., lease)| lease.id)
    }

    /// Says whether a worker may have tiles of a job: one under suspicion only if all are.
    fn may_render(&self, worker: WorkerId, job: JobId) -> bool {
        self.jobs.get(&job).is_none_or(|JobState { suspects, .. }| {
            !suspects.contains(&worker) || self.members.all(|member| suspects.contains(&member))
        })
    }

    /// From when on which waiting question can be answered with a tile of which quiet lease.
    fn next_second_rendering(&self) -> Option<(Instant, AskId, LeaseId)> {
        self.waiting.first()?;
        // With two that wait, the first lease will do; with one, all but its own.
        self.leases.quietest().find_map(|(from, holder, quiet)| {
            let mut asks = self.waiting.iter();
            let (ask, _) = asks
                .find(|(_, ask)| ask.worker != holder && self.may_render(ask.worker, quiet.job))?;
            Some((from, ask, quiet.id))
        })
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
        let lost =
            renewals.iter().filter(|&&renewal| !self.leases.on_renewal(worker, renewal, now));
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
        let Delivery { worker, lease, tile, hash, .. } = delivery;
        if self.leases.tiles(lease.job).is_some() && !self.leases.is_granted(worker, lease, tile) {
            let mut actions = vec![Action::Acknowledge(id, Verdict::Rejected)];
            actions.extend(self.on_ungranted(worker, lease, tile));
            return actions;
        }
        // The worker may have been given up meanwhile.
        let _ = self.members.on_sign_of_life(worker, now);
        let arrival = self.leases.on_pixels(worker, lease, tile, hash, now);
        let (Some(arrival), Some(job)) = (arrival, self.jobs.get_mut(&lease.job)) else {
            return vec![Action::Acknowledge(id, Verdict::Rejected)];
        };
        let mut actions = Vec::new();
        let (Arrival::WhileStoring(first) | Arrival::AfterDone(first)) = arrival else {
            job.storing.insert(tile, Storing { id, first: delivery, copies: Vec::new() });
            return vec![Action::Store(id, lease.job, tile)];
        };
        if first != hash {
            job.progress.differing_tiles += 1;
            actions.push(Action::Publish(lease.job, job.progress.clone()));
            actions.push(Action::Log(Notice::CopiesDiffer { second: delivery, first }));
        }
        match job.storing.get_mut(&tile) {
            Some(storing) => storing.copies.push(id),
            None => actions.push(Action::Acknowledge(id, Verdict::Duplicate)),
        }
        actions
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
                self.fail(lease.job, reason, &mut actions);
            }
            None => {
                job.suspects.insert(worker);
                let (job, reason) = (lease.job, reason.to_owned());
                actions.push(Action::Log(Notice::Suspect { worker, job, tile, reason }));
                let losses = self.leases.on_suspicion(worker, job);
                let reason = "its worker brought pixels that make no sense";
                let log = |loss| Action::Log(Notice::LeaseLost(loss, reason.to_owned()));
                actions.extend(losses.into_iter().map(log));
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
        job.contributors.insert(delivery.worker);
        job.progress.tiles_done = done;
        job.progress.tally.add(&delivery.tally);
        let thread_time = Duration::try_from_secs_f64(delivery.seconds).unwrap_or_default();
        job.thread_time += thread_time.min(now - job.started);
        job.progress.worker_count = job.contributors.len() as u32;
        let (progress, elapsed) = (job.progress.clone(), now - job.started);
        let mut actions = vec![Action::Acknowledge(storing.id, Verdict::Accepted)];
        let copies = storing.copies.into_iter();
        actions.extend(copies.map(|copy| Action::Acknowledge(copy, Verdict::Duplicate)));
        let is_last = progress.tiles_done == progress.tile_count;
        actions.push(Action::Publish(id, progress.clone()));
        actions.push(Action::Log(Notice::TileDone { delivery, progress, elapsed }));
        if is_last {
            self.end(id, Outcome::Finished(elapsed), &mut actions);
        }
        actions
    }

    /// Event: the pixels of a tile cannot be written, for that reason.
    pub(crate) fn on_store_failed(&mut self, job: JobId, reason: String) -> Vec<Action> {
        let mut actions = Vec::new();
        self.fail(job, reason, &mut actions);
        actions
    }

    // Jobs.

    /// Gives a number to a job to come.
    pub(crate) fn number_job(&mut self) -> JobId {
        self.last_job.0 += 1;
        self.last_job
    }

    /// Event: a picture of these tiles, all of them free, is ordered under a number from
    /// [`Farm::number_job`].
    pub(crate) fn on_submit(&mut self, id: JobId, tiles: Tiles, now: Instant) -> Vec<Action> {
        let progress = Progress { tile_count: tiles.grid().count(), ..Progress::default() };
        let job = JobState {
            started: now,
            progress,
            contributors: BTreeSet::new(),
            thread_time: Duration::ZERO,
            suspects: BTreeSet::new(),
            senseless: BTreeMap::new(),
            storing: BTreeMap::new(),
        };
        self.jobs.insert(id, job);
        self.leases.on_submit(id, tiles);
        let mut actions = Vec::new();
        if self.phase == Phase::Open {
            self.serve(now, &mut actions);
        } else {
            self.fail(id, STOPPED.to_owned(), &mut actions);
        }
        actions
    }

    /// Event: nobody wants a job's picture any more.
    pub(crate) fn on_cancel(&mut self, job: JobId) -> Vec<Action> {
        let mut actions = Vec::new();
        if self.end(job, Outcome::Failed("it was cancelled".to_owned()), &mut actions) {
            actions.push(Action::Log(Notice::JobCancelled(job)));
        }
        self.ended.retain(|&ended| ended != job);
        self.forget(job, &mut actions);
        actions
    }

    fn fail(&mut self, job: JobId, reason: String, actions: &mut Vec<Action>) {
        if self.end(job, Outcome::Failed(reason.clone()), actions) {
            actions.push(Action::Log(Notice::JobFailed(job, reason)));
        }
    }

    /// Ends a job, unless it has ended; says whether it had not. What is being stored of it is
    /// not needed any more.
    fn end(&mut self, id: JobId, outcome: Outcome, actions: &mut Vec<Action>) -> bool {
        let Some(job) = self.jobs.get_mut(&id) else { return false };
        if job.progress.outcome.is_some() {
            return false;
        }
        job.progress.outcome = Some(outcome);
        actions.push(Action::Publish(id, job.progress.clone()));
        for storing in std::mem::take(&mut job.storing).into_values() {
            let deliveries = std::iter::once(storing.id).chain(storing.copies);
            actions.extend(deliveries.map(|id| Action::Acknowledge(id, Verdict::Rejected)));
        }
        self.leases.on_end(id);
        self.ended.push_back(id);
        if self.ended.len() > KEPT_AFTER_END
            && let Some(oldest) = self.ended.pop_front()
        {
            self.forget(oldest, actions);
        }
        true
    }

    fn forget(&mut self, job: JobId, actions: &mut Vec<Action>) {
        if self.jobs.remove(&job).is_some() {
            actions.push(Action::Forget(job));
        }
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

    /// Event: the coordinator is to stop. Workers are sent home, and every job has ended.
    pub(crate) fn on_shut_down(&mut self, now: Instant) -> Vec<Action> {
        let mut actions = self.on_close();
        let jobs: Vec<JobId> = self.jobs.keys().copied().collect();
        for job in jobs {
            self.fail(job, STOPPED.to_owned(), &mut actions);
        }
        self.phase = Phase::Farewell(now + FAREWELL);
        self.end_farewell(now, &mut actions);
        actions
    }

    /// Sends a worker home. Its leases end with it; since that is no misfortune, nobody is told.
    fn send_home(&mut self, worker: WorkerId, ask: AskId, actions: &mut Vec<Action>) {
        self.members.remove(worker);
        self.leases.on_worker_lost(worker);
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
        for (id, job) in &self.jobs {
            let tiles = self.leases.tiles(*id);
            assert_eq!(tiles.is_some(), job.progress.outcome.is_none());
            assert_eq!(self.ended.contains(id), job.progress.outcome.is_some());
            let done = tiles.map_or(job.progress.tiles_done, Tiles::done_count);
            assert_eq!(done, job.progress.tiles_done);
            assert!(tiles.is_some() || job.storing.is_empty());
        }
        assert!(self.ended.len() <= KEPT_AFTER_END);
    }
}

#[cfg(test)]
mod tests;
