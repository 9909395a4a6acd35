//! Who is on the farm. Decisions alone: time is an argument, nothing waits.

use std::{
    collections::{BTreeMap, BTreeSet},
    time::{Duration, Instant},
};

use rtfarm_proto::WorkerId;

/// A process that joins, as it describes itself.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct Process {
    /// Random, one for each start of a process.
    pub(crate) nonce: u64,
    /// Its number on its host.
    pub(crate) number: u32,
    pub(crate) threads: usize,
    pub(crate) host: String,
    pub(crate) isa: String,
    /// Bytes of a prepared scene that it can hold; `None`: any number.
    pub(crate) memory: Option<u64>,
}

/// What a farm remembers of a process though it is no member: how it was found to be, or was told
/// to work.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Mark {
    /// It lied, as this worker, and is kept out.
    Liar(WorkerId),
    /// Somebody decided that it is to be so.
    Stationed(Standing),
}

/// A number that is no member's: it never was one, or its worker has left or was silent too long.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("{0} is not a worker of this farm now; join again")]
pub(crate) struct NoMember(pub(crate) WorkerId);

/// A process that brought pixels which two other workers contradict. It gets no work any more.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("this process, as worker {0}, brought wrong pixels and is kept out of this farm")]
pub(crate) struct KeptOut(pub(crate) WorkerId);

/// The workers of a farm. Invariants: each member has one entry in every index; that in `checks`
/// is never later than the moment when its silence becomes too long.
#[derive(Debug)]
pub(crate) struct Members {
    longest_silence: Duration,
    last_id: WorkerId,
    by_id: BTreeMap<WorkerId, Member>,
    by_nonce: BTreeMap<u64, WorkerId>,
    by_process: BTreeSet<(u32, WorkerId)>,
    checks: BTreeSet<(Instant, WorkerId)>,
    draining: BTreeSet<WorkerId>,
    threads: usize,
    /// What the active members can hold.
    memories: BTreeSet<(u64, WorkerId)>,
    /// Liars, members once.
    liars: BTreeSet<WorkerId>,
    /// Processes of which something is remembered, by their nonces.
    marks: BTreeMap<u64, Mark>,
}

/// What a worker gets to do.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Standing {
    /// Tiles.
    Active,
    /// No more tiles; it goes home when it has brought those that it has.
    Draining,
    /// No more tiles, until it is active again.
    Disabled,
}

/// A worker as those see it who look after a farm.
#[derive(Debug, Clone)]
pub(crate) struct MemberEntry {
    pub(crate) worker: WorkerId,
    pub(crate) process: Process,
    pub(crate) standing: Standing,
    /// Tiles that it brought first.
    pub(crate) tiles_done: u64,
    /// Since it was heard of.
    pub(crate) silence: Duration,
}

#[derive(Debug)]
struct Member {
    process: Process,
    standing: Standing,
    tiles_done: u64,
    last_heard: Instant,
    /// When its silence is looked at. A sign of life does not move it, the look itself does: so
    /// one is as cheap as can be.
    check_at: Instant,
}

impl Member {
    /// Bytes of a scene that it can hold.
    fn memory(&self) -> u64 {
        self.process.memory.unwrap_or(u64::MAX)
    }
}

impl Members {
    /// Makes a farm without members; one that says nothing for `longest_silence` is forgotten.
    pub(crate) fn new(longest_silence: Duration) -> Self {
        Self {
            longest_silence,
            last_id: WorkerId(0),
            by_id: BTreeMap::new(),
            by_nonce: BTreeMap::new(),
            by_process: BTreeSet::new(),
            checks: BTreeSet::new(),
            draining: BTreeSet::new(),
            threads: 0,
            memories: BTreeSet::new(),
            liars: BTreeSet::new(),
            marks: BTreeMap::new(),
        }
    }

    /// Event: a process joins. Its nonce tells a repeated question from a new process. Says also
    /// whether the member is new.
    pub(crate) fn on_join(
        &mut self,
        process: &Process,
        now: Instant,
    ) -> Result<(WorkerId, bool), KeptOut> {
        let standing = match self.marks.get(&process.nonce) {
            Some(&Mark::Liar(liar)) => return Err(KeptOut(liar)),
            Some(&Mark::Stationed(standing)) => standing,
            None => Standing::Active,
        };
        if let Some(&worker) = self.by_nonce.get(&process.nonce) {
            let is_member = self.on_sign_of_life(worker, now).is_ok();
            debug_assert!(is_member, "the index has members only");
            return Ok((worker, false));
        }
        self.last_id.0 += 1;
        let worker = self.last_id;
        let process = Process { threads: process.threads.max(1), ..process.clone() };
        self.by_nonce.insert(process.nonce, worker);
        self.by_process.insert((process.number, worker));
        self.threads += process.threads;
        let member = Member {
            process,
            standing: Standing::Active,
            tiles_done: 0,
            last_heard: now,
            check_at: now + self.longest_silence,
        };
        self.checks.insert((member.check_at, worker));
        self.by_id.insert(worker, member);
        self.set_standing(worker, standing);
        Ok((worker, true))
    }

    /// Event: a worker is found to lie. Nothing that it brings is taken any more, and its process
    /// is kept out once it is removed.
    pub(crate) fn on_lie(&mut self, liar: WorkerId) {
        self.liars.insert(liar);
        if let Some(member) = self.by_id.get(&liar) {
            self.marks.insert(member.process.nonce, Mark::Liar(liar));
        }
    }

    /// What is remembered of processes, by their nonces.
    pub(crate) fn marks(&self) -> &BTreeMap<u64, Mark> {
        &self.marks
    }

    /// Remembers what an earlier start of the farm did.
    pub(crate) fn remember(&mut self, marks: BTreeMap<u64, Mark>) {
        self.marks = marks;
    }

    /// Says whether a worker was found to lie.
    pub(crate) fn is_liar(&self, worker: WorkerId) -> bool {
        self.liars.contains(&worker)
    }

    /// The members from which something was heard at that time or later.
    pub(crate) fn heard_since(&self, time: Instant) -> impl Iterator<Item = WorkerId> {
        let members = self.by_id.iter().filter(move |(_, member)| member.last_heard >= time);
        members.map(|(&worker, _)| worker)
    }

    /// Event: a worker says something.
    pub(crate) fn on_sign_of_life(
        &mut self,
        worker: WorkerId,
        now: Instant,
    ) -> Result<(), NoMember> {
        let member = self.by_id.get_mut(&worker).ok_or(NoMember(worker))?;
        member.last_heard = now;
        Ok(())
    }

    /// Removes a worker; says whether it was a member.
    pub(crate) fn remove(&mut self, worker: WorkerId) -> bool {
        let Some(member) = self.by_id.remove(&worker) else { return false };
        self.by_nonce.remove(&member.process.nonce);
        self.by_process.remove(&(member.process.number, worker));
        self.checks.remove(&(member.check_at, worker));
        self.draining.remove(&worker);
        self.memories.remove(&(member.memory(), worker));
        self.threads -= member.process.threads;
        true
    }

    /// Event: a worker goes home that was drained: its process will not come again.
    pub(crate) fn on_drained(&mut self, worker: WorkerId) {
        if let Some(member) = self.by_id.get(&worker) {
            self.marks.remove(&member.process.nonce);
        }
    }

    /// Event: time passes. Answers with members that have been silent for too long; the caller
    /// removes them.
    pub(crate) fn on_time(&mut self, now: Instant) -> Vec<WorkerId> {
        let mut silent = Vec::new();
        while let Some(&(check_at, worker)) = self.checks.first()
            && check_at <= now
        {
            self.checks.pop_first();
            let Some(member) = self.by_id.get_mut(&worker) else { continue };
            member.check_at = member.last_heard + self.longest_silence;
            if member.check_at <= now {
                silent.push(worker);
            } else {
                self.checks.insert((member.check_at, worker));
            }
        }
        silent
    }

    /// When [`Members::on_time`] is to be called next, at the latest.
    pub(crate) fn next_check(&self) -> Option<Instant> {
        self.checks.first().map(|&(check_at, _)| check_at)
    }

    /// The threads of a worker, and those of all members.
    pub(crate) fn threads(&self, worker: WorkerId) -> (usize, usize) {
        (self.by_id.get(&worker).map_or(0, |member| member.process.threads), self.threads)
    }

    /// What a member's machine is called.
    pub(crate) fn host(&self, worker: WorkerId) -> Option<&str> {
        self.by_id.get(&worker).map(|member| member.process.host.as_str())
    }

    /// The first member that runs in the process with that number.
    pub(crate) fn in_process(&self, process: u32) -> Option<WorkerId> {
        let of_process = (process, WorkerId(0))..=(process, WorkerId(u32::MAX));
        self.by_process.range(of_process).next().map(|&(_, worker)| worker)
    }

    /// Says whether something is true of every active member that can hold a scene of so many
    /// bytes.
    pub(crate) fn all(&self, bytes: u64, is_true: impl Fn(WorkerId) -> bool) -> bool {
        self.memories.range((bytes, WorkerId(0))..).all(|&(_, worker)| is_true(worker))
    }

    /// The bytes of the largest scene that an active member can hold; `None` when there is no such
    /// member.
    pub(crate) fn most_memory(&self) -> Option<u64> {
        self.memories.last().map(|&(memory, _)| memory)
    }

    /// Event: somebody decides what a worker is to get.
    pub(crate) fn on_station(
        &mut self,
        worker: WorkerId,
        standing: Standing,
    ) -> Result<(), NoMember> {
        let nonce = self.by_id.get(&worker).ok_or(NoMember(worker))?.process.nonce;
        if standing == Standing::Active {
            self.marks.remove(&nonce);
        } else {
            self.marks.insert(nonce, Mark::Stationed(standing));
        }
        self.set_standing(worker, standing);
        Ok(())
    }

    fn set_standing(&mut self, worker: WorkerId, standing: Standing) {
        let Some(member) = self.by_id.get_mut(&worker) else { return };
        member.standing = standing;
        if standing == Standing::Draining {
            self.draining.insert(worker);
        } else {
            self.draining.remove(&worker);
        }
        let memory = (member.memory(), worker);
        if standing == Standing::Active {
            self.memories.insert(memory);
        } else {
            self.memories.remove(&memory);
        }
    }

    /// Says whether a worker is a member that gets tiles, and can hold a scene of so many bytes.
    pub(crate) fn may_hold(&self, worker: WorkerId, bytes: u64) -> bool {
        let member = self.by_id.get(&worker);
        member.is_some_and(|member| member.standing == Standing::Active && member.memory() >= bytes)
    }

    /// The members that are to go home.
    pub(crate) fn draining(&self) -> impl Iterator<Item = WorkerId> {
        self.draining.iter().copied()
    }

    /// Event: the first pixels of a tile, which a worker brought, are in a picture.
    pub(crate) fn on_tile(&mut self, worker: WorkerId) {
        if let Some(member) = self.by_id.get_mut(&worker) {
            member.tiles_done += 1;
        }
    }

    /// All members, in the order of their numbers.
    pub(crate) fn entries(&self, now: Instant) -> impl Iterator<Item = MemberEntry> {
        self.by_id.iter().map(move |(&worker, member)| MemberEntry {
            worker,
            process: member.process.clone(),
            standing: member.standing,
            tiles_done: member.tiles_done,
            silence: now - member.last_heard,
        })
    }

    /// Says whether there is nobody.
    pub(crate) fn is_empty(&self) -> bool {
        self.by_id.is_empty()
    }
}

#[cfg(test)]
impl Members {
    pub(crate) fn contains(&self, worker: WorkerId) -> bool {
        self.by_id.contains_key(&worker)
    }

    /// Checks every invariant, at the price of a scan.
    pub(crate) fn check(&self) {
        let members = || self.by_id.iter();
        assert!(
            self.by_nonce == members().map(|(&id, member)| (member.process.nonce, id)).collect()
        );
        let of_process = members().map(|(&id, member)| (member.process.number, id));
        assert!(self.by_process == of_process.collect());
        let is_draining = |member: &Member| member.standing == Standing::Draining;
        let draining = members().filter(|(_, member)| is_draining(member)).map(|(&id, _)| id);
        assert!(self.draining == draining.collect());
        let is_active = |member: &Member| member.standing == Standing::Active;
        let active = members().filter(|(_, member)| is_active(member));
        assert!(self.memories == active.map(|(&id, member)| (member.memory(), id)).collect());
        assert!(self.checks == members().map(|(&id, member)| (member.check_at, id)).collect());
        assert!(
            members()
                .all(|(_, member)| { member.check_at <= member.last_heard + self.longest_silence })
        );
        assert_eq!(
            self.threads,
            members().map(|(_, member)| member.process.threads).sum::<usize>()
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SILENCE: Duration = Duration::from_secs(60);

    fn process(nonce: u64) -> Process {
        Process { nonce, number: 7, threads: 2, ..Process::default() }
    }

    #[expect(clippy::disallowed_methods, reason = "any instant will do")]
    fn farm() -> (Members, Instant) {
        (Members::new(SILENCE), Instant::now())
    }

    #[test]
    fn joining_again_with_the_same_nonce_changes_nothing() {
        let (mut members, now) = farm();
        let (first, is_new) = members.on_join(&process(7), now).unwrap();
        assert!(is_new);
        assert_eq!(members.on_join(&process(7), now), Ok((first, false)));
        let (second, is_new) = members.on_join(&process(8), now).unwrap();
        assert!(is_new && second != first);
        assert_eq!(members.threads(first), (2, 4));
        members.check();
    }

    #[test]
    fn a_sign_of_life_puts_off_the_end_of_a_member() {
        let (mut members, now) = farm();
        let (worker, _) = members.on_join(&process(1), now).unwrap();
        members.on_sign_of_life(worker, now + SILENCE / 2).unwrap();
        assert_eq!(members.on_time(now + SILENCE), []);
        members.check();
        assert_eq!(members.next_check(), Some(now + SILENCE * 3 / 2));
        assert_eq!(members.on_time(now + SILENCE * 3 / 2), [worker]);
        assert!(members.remove(worker) && members.is_empty());
        assert_eq!(members.on_sign_of_life(worker, now), Err(NoMember(worker)));
        members.check();
    }

    #[test]
    fn a_member_is_known_by_its_process() {
        let (mut members, now) = farm();
        let (first, _) = members.on_join(&process(1), now).unwrap();
        let (second, _) = members.on_join(&process(2), now).unwrap();
        assert_eq!((members.in_process(7), members.in_process(8)), (Some(first), None));
        members.remove(first);
        assert_eq!(members.in_process(7), Some(second));
    }

    #[test]
    fn what_somebody_decided_of_a_worker_outlives_its_membership_and_the_farm() {
        let (mut members, now) = farm();
        let (first, _) = members.on_join(&process(1), now).unwrap();
        let (drained, _) = members.on_join(&process(2), now).unwrap();
        members.on_station(first, Standing::Disabled).unwrap();
        members.on_station(drained, Standing::Draining).unwrap();
        assert!(members.remove(first));
        let (again, is_new) = members.on_join(&process(1), now).unwrap();
        assert!(is_new && again != first && !members.may_hold(again, 0));
        members.check();

        let (mut later, now) = farm();
        later.remember(members.marks().clone());
        let (again, _) = later.on_join(&process(1), now).unwrap();
        assert!(!later.may_hold(again, 0));
        later.on_station(again, Standing::Active).unwrap();
        later.remove(again);
        let (again, _) = later.on_join(&process(1), now).unwrap();
        assert!(later.may_hold(again, 0));
        let (again, _) = later.on_join(&process(2), now).unwrap();
        assert_eq!(later.draining().collect::<Vec<_>>(), [again]);
        later.on_drained(again);
        assert!(later.marks().is_empty());
        later.check();
    }

    #[test]
    fn a_member_holds_what_it_has_memory_for() {
        let (mut members, now) = farm();
        assert_eq!(members.most_memory(), None);
        let small = Process { memory: Some(100), ..process(1) };
        let (small, _) = members.on_join(&small, now).unwrap();
        assert!(members.may_hold(small, 100) && !members.may_hold(small, 101));
        assert_eq!(members.most_memory(), Some(100));
        let (large, _) = members.on_join(&process(2), now).unwrap();
        assert!(members.all(101, |worker| worker == large));
        assert!(!members.all(100, |worker| worker == large));
        members.on_station(large, Standing::Disabled).unwrap();
        assert_eq!(members.most_memory(), Some(100));
        members.check();
    }

    #[test]
    fn the_process_of_a_liar_is_kept_out() {
        let (mut members, now) = farm();
        let (liar, _) = members.on_join(&process(1), now).unwrap();
        members.on_lie(liar);
        assert!(members.remove(liar) && members.is_liar(liar));
        assert_eq!(members.on_join(&process(1), now), Err(KeptOut(liar)));
        assert!(members.on_join(&process(2), now).is_ok());
        members.check();
    }
}
