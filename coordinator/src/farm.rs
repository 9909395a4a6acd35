//! The coordinator's one machine: members, leases, stitching, counting, ending and waiting.
//! Decisions alone: every event is a method that takes the time, and answers with what its shell
//! is to do; nothing here waits, writes or logs.

use std::{
    collections::{BTreeMap, BTreeSet},
    time::{Duration, Instant},
};

use rtfarm_core::tile::TileId;
use rtfarm_proto::{Incarnation, JobId, LONGEST_WAIT, LeaseId, LeaseName, Renewal, WorkerId};

use crate::{
    audit::Audit,
    identity::{Identity, Stranger},
    lease::{LONGEST_QUIET, Leases, Loss, Run},
    members::{KeptOut, Members, NoMember, Process},
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

    /// Event: a worker has pixels of these tiles of a job, which it rendered for an earlier start
    /// of this farm. Those that are free are leased to it, as any tile is.
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

    /// What a worker that waits may begin: a tile to compare or free tiles of the first job that
    /// has any, unless one before it has a tile that is overdue, or a suspect, for which the worker
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

    /// Event: the coordinator is to stop. Workers are sent home, and every job that will not be
    /// there again has ended.
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
    pub(crate) fn on_submit(
        &mut self,
        id: JobId,
        tiles: crate::tiles::Tiles,
        now: Instant,
    ) -> Vec<Action> {
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
            let done = tiles.map_or(job.progress.tiles_done, crate::tiles::Tiles::done_count);
            assert_eq!(done, job.progress.tiles_done);
            assert!(tiles.is_some() || job.storing.is_empty());
        }
        let ended = self.jobs.values().filter(|job| job.ended_at.is_some());
        assert_eq!(self.ended.len(), ended.count());
    }
}

mod action;
mod history;
mod jobs;
mod pixels;
mod queue;
mod trust;
mod watching;

pub(crate) use action::{Action, Delivery, DeliveryId, Next, Notice, Verdict};
pub(crate) use history::{Attempt, Explanation};
pub(crate) use jobs::Earlier;
use jobs::{JobState, Storing};
pub use queue::Keeping;
pub(crate) use queue::{Change, JobEntry, Phase as JobPhase, Refused, Terms};
pub(crate) use watching::Arrived;

#[cfg(test)]
mod tests;
