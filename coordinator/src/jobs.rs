//! The farm's members and its jobs, first come first served. Decisions alone, as in `lease`.

use std::{
    collections::BTreeMap,
    time::{Duration, Instant},
};

use rtfarm_core::tile::{TileGrid, TileId};
use rtfarm_proto::{JobId, LONGEST_WAIT, LeaseId, LeaseName, WorkerId};

use crate::lease::{Again, Leases, Loss, PixelHash, Run, Verdict};

/// A worker that says nothing for this long is a member no more. One without work asks again
/// after each long poll at the latest.
const LONGEST_SILENCE: Duration = LONGEST_WAIT.saturating_mul(6);

/// Who is on the farm and what is rendered. Invariant: every lease belongs to a member.
#[derive(Debug)]
pub(crate) struct Jobs {
    term: Duration,
    members: BTreeMap<WorkerId, Member>,
    queue: BTreeMap<JobId, Leases>,
    worker_count: u32,
    job_count: u64,
    last_lease: u64,
}

#[derive(Debug)]
struct Member {
    nonce: u64,
    threads: usize,
    last_heard: Instant,
}

/// What a worker without work gets.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Next {
    Render(JobId, Run),
    /// Nothing now; perhaps then, or when something changes.
    Wait(Option<Instant>),
}

/// A number that is none of a member's: it was never one, or was silent for too long.
#[derive(Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0} is no worker of this farm now; join again")]
pub(crate) struct NoMember(pub(crate) WorkerId);

impl Jobs {
    /// A farm without members and jobs.
    pub(crate) fn new(term: Duration) -> Self {
        Self {
            term,
            members: BTreeMap::new(),
            queue: BTreeMap::new(),
            worker_count: 0,
            job_count: 0,
            last_lease: 0,
        }
    }

    /// Event: a process with `threads` threads joins. Its nonce tells a repeated question from a
    /// new process.
    pub(crate) fn on_join(&mut self, nonce: u64, threads: usize, now: Instant) -> WorkerId {
        let known = self.members.iter_mut().find(|(_, member)| member.nonce == nonce);
        if let Some((&worker, member)) = known {
            member.last_heard = now;
            return worker;
        }
        self.worker_count += 1;
        let worker = WorkerId(self.worker_count);
        let threads = threads.max(1);
        self.members.insert(worker, Member { nonce, threads, last_heard: now });
        worker
    }

    /// A number for a job to come.
    pub(crate) fn number_job(&mut self) -> JobId {
        self.job_count += 1;
        JobId(self.job_count)
    }

    /// Event: a picture is ordered, under a number from [`Jobs::number_job`].
    pub(crate) fn on_submit(&mut self, job: JobId, grid: TileGrid) {
        self.queue.insert(job, Leases::new(grid, self.term));
    }

    /// Event: a job is finished, failed or cancelled: nobody is to render it any longer.
    pub(crate) fn on_end(&mut self, job: JobId) {
        self.queue.remove(&job);
    }

    /// Event: `worker` has nothing to do and would take up to `most` tiles.
    pub(crate) fn on_idle(
        &mut self,
        worker: WorkerId,
        most: usize,
        now: Instant,
    ) -> Result<Next, NoMember> {
        let member = self.on_sign_of_life(worker, now)?;
        let threads = member.threads;
        let all_threads = self.members.values().map(|member| member.threads).sum();
        let id = LeaseId(self.last_lease + 1);
        for (&job, leases) in &mut self.queue {
            let run = leases.on_idle(worker, (threads, all_threads), most, id, now);
            if let Some(run) = run {
                self.last_lease = id.0;
                return Ok(Next::Render(job, run));
            }
        }
        let mut ask_again: Option<Instant> = None;
        for (&job, leases) in &mut self.queue {
            match leases.on_idle_at_the_end(worker, id, now) {
                Again::Render(run) => {
                    self.last_lease = id.0;
                    return Ok(Next::Render(job, run));
                }
                Again::Wait(until) => ask_again = ask_again.into_iter().chain(until).min(),
            }
        }
        Ok(Next::Wait(ask_again))
    }

    /// Event: `worker` goes on rendering under `leases`. Answers with those that it has lost.
    pub(crate) fn on_progress(
        &mut self,
        worker: WorkerId,
        leases: &[LeaseName],
        now: Instant,
    ) -> Result<Vec<LeaseName>, NoMember> {
        self.on_sign_of_life(worker, now)?;
        let is_lost = |name: &&LeaseName| match self.queue.get_mut(&name.job) {
            Some(leases) => !leases.on_progress(worker, name.id, now),
            None => true,
        };
        Ok(leases.iter().filter(is_lost).copied().collect())
    }

    /// Turns a number from the wire into a tile of a job that is being rendered.
    pub(crate) fn tile(&self, job: JobId, number: u32) -> Option<TileId> {
        self.queue.get(&job)?.grid().tile(number)
    }

    /// Event: pixels came. `None` when the job is over.
    pub(crate) fn on_pixels(
        &mut self,
        worker: WorkerId,
        lease: LeaseName,
        tile: TileId,
        hash: PixelHash,
        now: Instant,
    ) -> Option<Verdict> {
        let leases = self.queue.get_mut(&lease.job)?;
        let verdict = leases.on_pixels(worker, lease.id, tile, hash, now);
        // Pixels are welcome from anyone: a worker may have been given up meanwhile.
        let _ = self.on_sign_of_life(worker, now);
        Some(verdict)
    }

    /// Event: `worker` has left or is known to be dead.
    pub(crate) fn on_worker_lost(&mut self, worker: WorkerId) -> Vec<(JobId, Loss)> {
        self.members.remove(&worker);
        let losses = |(&job, leases): (&JobId, &mut Leases)| {
            leases.on_worker_lost(worker).into_iter().map(move |loss| (job, loss)).collect()
        };
        self.queue.iter_mut().flat_map(|entry| -> Vec<_> { losses(entry) }).collect()
    }

    /// Event: time passes. Answers with the leases that ran out.
    pub(crate) fn on_tick(&mut self, now: Instant) -> Vec<(JobId, Loss)> {
        let mut losses = Vec::new();
        for (&job, leases) in &mut self.queue {
            losses.extend(leases.on_tick(now).into_iter().map(|loss| (job, loss)));
        }
        let silent: Vec<WorkerId> = self
            .members
            .iter()
            .filter(|(_, member)| member.last_heard + LONGEST_SILENCE.max(self.term) <= now)
            .map(|(&worker, _)| worker)
            .collect();
        for worker in silent {
            losses.extend(self.on_worker_lost(worker));
        }
        losses
    }

    fn on_sign_of_life(&mut self, worker: WorkerId, now: Instant) -> Result<&mut Member, NoMember> {
        let member = self.members.get_mut(&worker).ok_or(NoMember(worker))?;
        member.last_heard = now;
        Ok(member)
    }
}

#[cfg(test)]
mod tests {
    use std::collections::VecDeque;

    use rtfarm_core::tile::Size;

    use super::*;

    const TERM: Duration = Duration::from_secs(4);

    fn grid(columns: u64, rows: u64) -> TileGrid {
        TileGrid::new(Size::new(columns * 16, rows * 16).unwrap(), 16).unwrap()
    }

    #[expect(clippy::disallowed_methods, reason = "any instant will do")]
    fn start() -> Instant {
        Instant::now()
    }

    fn submit(jobs: &mut Jobs, grid: TileGrid) -> JobId {
        let job = jobs.number_job();
        jobs.on_submit(job, grid);
        job
    }

    #[test]
    fn joining_again_with_the_same_nonce_changes_nothing() {
        let mut jobs = Jobs::new(TERM);
        let first = jobs.on_join(7, 1, start());
        assert_eq!(jobs.on_join(7, 1, start()), first);
        assert_ne!(jobs.on_join(8, 1, start()), first);
    }

    #[test]
    fn a_later_job_starts_when_the_earlier_has_no_free_tile() {
        let (mut jobs, now) = (Jobs::new(TERM), start());
        let worker = jobs.on_join(1, 1, now);
        let (first, second) = (submit(&mut jobs, grid(1, 1)), submit(&mut jobs, grid(1, 1)));
        for expected in [first, second] {
            let next = jobs.on_idle(worker, 9, now);
            assert!(matches!(next, Ok(Next::Render(job, _)) if job == expected), "{next:?}");
        }
        assert_eq!(jobs.on_idle(worker, 9, now), Ok(Next::Wait(None)));
    }

    #[test]
    fn a_silent_worker_is_forgotten_and_told_so() {
        let (mut jobs, now) = (Jobs::new(TERM), start());
        let worker = jobs.on_join(1, 1, now);
        jobs.on_tick(now + LONGEST_SILENCE);
        assert_eq!(jobs.on_idle(worker, 9, now), Err(NoMember(worker)));
    }

    #[test]
    fn the_leases_of_a_cancelled_job_are_lost() {
        let (mut jobs, now) = (Jobs::new(TERM), start());
        let worker = jobs.on_join(1, 1, now);
        let job = submit(&mut jobs, grid(2, 2));
        let Ok(Next::Render(_, run)) = jobs.on_idle(worker, 9, now) else { panic!("a run") };
        let lease = LeaseName { job, id: run.lease };
        assert_eq!(jobs.on_progress(worker, &[lease], now), Ok(vec![]));
        jobs.on_end(job);
        assert_eq!(jobs.on_progress(worker, &[lease], now), Ok(vec![lease]));
        assert_eq!(jobs.on_pixels(worker, lease, run.tiles[0], [0; 32], now), None);
    }

    /// Steele, Lea & Flood, "Fast Splittable Pseudorandom Number Generators" (2014).
    struct SplitMix64(u64);

    impl SplitMix64 {
        fn below(&mut self, end: u64) -> u64 {
            self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
            let mut z = self.0;
            z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
            z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
            (z ^ (z >> 31)) % end
        }

        fn one_in(&mut self, n: u64) -> bool {
            self.below(n) == 0
        }
    }

    /// A process that renders, and its misfortunes.
    struct Process {
        worker: WorkerId,
        queue: VecDeque<(LeaseName, TileId)>,
        stopped_until: Instant,
    }

    const TILES: usize = 7 * 5;

    /// How often each tile of two jobs was stitched on a farm where processes die, stall, and
    /// deliver late, twice or never.
    fn simulate(seed: u64) -> [[u32; TILES]; 2] {
        let mut random = SplitMix64(seed);
        let mut now = start();
        let mut nonce = 0;
        let mut jobs = Jobs::new(TERM);
        let ids = [submit(&mut jobs, grid(7, 5)), submit(&mut jobs, grid(5, 7))];
        let mut stitched = [[0; TILES]; 2];
        let mut processes: Vec<Process> = Vec::new();
        // Pixels under way: when they arrive, from whom, what.
        let mut post: Vec<(Instant, WorkerId, LeaseName, TileId)> = Vec::new();

        for _ in 0..100_000 {
            if stitched.iter().flatten().all(|&count| count > 0) {
                return stitched;
            }
            now += Duration::from_millis(random.below(300));
            jobs.on_tick(now);
            if processes.len() < 1 + (seed % 5) as usize {
                nonce += 1;
                let worker = jobs.on_join(nonce, 1 + random.below(3) as usize, now);
                processes.push(Process { worker, queue: VecDeque::new(), stopped_until: now });
            }
            let index = random.below(processes.len() as u64) as usize;
            match random.below(40) {
                0 => {
                    let dead = processes.swap_remove(index);
                    if random.one_in(2) {
                        jobs.on_worker_lost(dead.worker);
                    }
                    continue;
                }
                1 => processes[index].stopped_until = now + TERM * random.below(4) as u32,
                _ => {}
            }
            let process = &mut processes[index];
            if process.stopped_until <= now {
                step(process, &mut jobs, &mut post, &mut random, now, &mut nonce);
            }
            post.retain(|&(arrival, worker, lease, tile)| {
                if arrival > now {
                    return true;
                }
                let hash = [tile.number() as u8; 32];
                match jobs.on_pixels(worker, lease, tile, hash, now) {
                    Some(Verdict::Stitch) => {
                        let job = ids.iter().position(|&id| id == lease.job).unwrap();
                        stitched[job][tile.index()] += 1;
                    }
                    Some(Verdict::Duplicate) | None => {}
                    Some(Verdict::Differs(_)) => panic!("seed {seed}: tiles are deterministic"),
                }
                false
            });
        }
        panic!("seed {seed}: no end");
    }

    fn step(
        process: &mut Process,
        jobs: &mut Jobs,
        post: &mut Vec<(Instant, WorkerId, LeaseName, TileId)>,
        random: &mut SplitMix64,
        now: Instant,
        nonce: &mut u64,
    ) {
        if let Some((lease, tile)) = process.queue.pop_front() {
            let copies = [1, 1, 1, 1, 1, 0, 2][random.below(7) as usize];
            for _ in 0..copies {
                let delay = if random.one_in(10) { TERM * 3 } else { Duration::from_millis(9) };
                post.push((now + delay, process.worker, lease, tile));
            }
            let names: Vec<LeaseName> = process.queue.iter().map(|&(lease, _)| lease).collect();
            match jobs.on_progress(process.worker, &names, now) {
                Ok(lost) => process.queue.retain(|(lease, _)| !lost.contains(lease)),
                Err(NoMember(_)) => process.queue.clear(),
            }
            return;
        }
        match jobs.on_idle(process.worker, 1 + random.below(9) as usize, now) {
            // One answer in ten is lost on its way.
            Ok(Next::Render(job, run)) if !random.one_in(10) => {
                let lease = LeaseName { job, id: run.lease };
                process.queue.extend(run.tiles.into_iter().map(|tile| (lease, tile)));
            }
            Ok(_) => {}
            Err(NoMember(_)) => {
                *nonce += 1;
                process.worker = jobs.on_join(*nonce, 1, now);
            }
        }
    }

    #[test]
    fn every_tile_is_stitched_once_though_workers_die_stall_and_repeat() {
        for seed in 0..500 {
            assert_eq!(simulate(seed), [[1; TILES]; 2], "seed {seed}");
        }
    }
}
