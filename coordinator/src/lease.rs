//! Who renders which tiles of which job, and until when. Decisions alone: time is an argument,
//! nothing waits. A lease ends when its last tile has come, when it runs out, when its worker is
//! lost and when its job ends. A tile that stands still leaves its lease by itself.

use std::{
    cmp::Reverse,
    collections::{BTreeMap, BTreeSet},
    mem,
    time::{Duration, Instant},
};

use rtfarm_core::tile::TileId;
use rtfarm_proto::{JobId, LeaseId, LeaseName, Renewal, WorkerId};

use crate::{
    pace::Pace,
    tiles::{Arrival, PixelHash, Place, Rendering, Tiles},
};

/// The longest run of tiles in one lease. Workers ask for as many as they render in a moment: a
/// lost one costs no more than that.
const LONGEST_RUN: usize = 1024;

/// The longest run for each thread of a worker of which no tile of the job has come yet: nobody
/// knows how slow it is.
const FIRST_RUN: usize = 4;

/// How many times each thread of the farm will ask again, if runs go on at the present length:
/// runs shorten as the work does, so that all threads finish together.
const RUNS_PER_THREAD: usize = 2;

/// A lease from which no tile came for so many times what tiles of its job take has its tiles
/// rendered a second time, once nothing else is left to do.
const QUIET_TILES: u32 = 3;

/// But not earlier than this, since answers take their time on the way.
const SHORTEST_QUIET: Duration = Duration::from_millis(20);

/// And not later than this.
pub(crate) const LONGEST_QUIET: Duration = Duration::from_millis(400);

/// The leases of all jobs that are being rendered, and those jobs. Invariants: a lease holds at
/// least one tile, and those that it holds alone or shares are open; each lease has one entry in
/// `expiries`, `by_worker` and `by_job`, and one in its job's set in `quiet` exactly while it holds
/// a tile alone that is under no suspicion; no set there is empty; `with_free` has exactly the jobs
/// with a free tile, `with_suspects` those with a free tile under suspicion.
#[derive(Debug)]
pub(crate) struct Leases {
    term: Duration,
    last_id: LeaseId,
    jobs: BTreeMap<JobId, Job>,
    /// The same jobs in the order in which they are rendered.
    order: BTreeSet<(Reverse<i32>, JobId)>,
    with_free: BTreeSet<JobId>,
    with_suspects: BTreeSet<JobId>,
    held: BTreeMap<LeaseId, Lease>,
    expiries: BTreeSet<(Instant, LeaseId)>,
    /// By the last tile. (How long it may be silent depends on its job, and changes with each
    /// tile.)
    quiet: BTreeMap<JobId, BTreeSet<(Instant, LeaseId)>>,
    by_worker: BTreeSet<(WorkerId, LeaseId)>,
    by_job: BTreeSet<(JobId, LeaseId)>,
}

#[derive(Debug)]
struct Job {
    tiles: Tiles,
    priority: i32,
    pace: Pace,
    /// Every lease that was ever given, and what it covered.
    granted: BTreeMap<LeaseId, Grant>,
}

/// No tiles.
const NONE: BTreeSet<Place> = BTreeSet::new();

/// Who may bring which tiles under a lease, even after its end.
#[derive(Debug)]
struct Grant {
    worker: WorkerId,
    /// In ascending order.
    tiles: Box<[TileId]>,
}

#[derive(Debug)]
struct Lease {
    job: JobId,
    worker: WorkerId,
    threads: usize,
    /// Its one tile is under suspicion, and its worker has no other lease.
    is_lone: bool,
    /// Tiles that are in no other lease.
    alone: BTreeSet<Place>,
    /// Tiles that another lease holds too.
    shared: BTreeSet<Place>,
    /// Tiles that it renders again, to be compared with what came of them before.
    again: BTreeSet<Place>,
    /// Tiles of those on which threads of its worker are known to be.
    begun: BTreeMap<Place, Begun>,
    /// When it runs out, unless there is progress.
    until: Instant,
    /// The steps that brought its scene, as its worker has told.
    work: u64,
    /// When the lease began, or the last tile under it came.
    last_tile: Instant,
    /// Its entries in `expiries` and `quiet`.
    expires: Instant,
    quiet: Option<Instant>,
}

/// How far a tile is.
#[derive(Debug, Clone, Copy)]
struct Begun {
    /// The steps that its worker has told of.
    work: u64,
    /// When it stands still, unless there is progress.
    until: Instant,
}

/// A run of tiles for a worker, in the order of rendering.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Run {
    pub(crate) lease: LeaseName,
    pub(crate) tiles: Vec<TileId>,
}

/// Tiles of a lease that its worker no longer has.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Loss {
    pub(crate) lease: LeaseName,
    pub(crate) worker: WorkerId,
    /// The tiles that had not come, in the order of rendering.
    pub(crate) tiles: Vec<TileId>,
    /// Those of them that were in work when too many workers were lost, and are set aside.
    pub(crate) aside: Vec<TileId>,
    /// Those of them that were to be compared with what came of them before.
    pub(crate) again: Vec<TileId>,
}

/// A lease of which a tile may be rendered a second time.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Quiet {
    pub(crate) lease: LeaseName,
    pub(crate) worker: WorkerId,
    /// From when on.
    pub(crate) from: Instant,
    /// When it began, or its last tile came.
    pub(crate) last_tile: Instant,
}

impl Leases {
    /// Makes the leases of a farm without jobs. One lives for `term` after the last progress.
    pub(crate) fn new(term: Duration) -> Self {
        Self {
            term,
            last_id: LeaseId(0),
            jobs: BTreeMap::new(),
            order: BTreeSet::new(),
            with_free: BTreeSet::new(),
            with_suspects: BTreeSet::new(),
            held: BTreeMap::new(),
            expiries: BTreeSet::new(),
            quiet: BTreeMap::new(),
            by_worker: BTreeSet::new(),
            by_job: BTreeSet::new(),
        }
    }

    /// The tiles of a job, as long as it is rendered.
    pub(crate) fn tiles(&self, job: JobId) -> Option<&Tiles> {
        self.jobs.get(&job).map(|job| &job.tiles)
    }

    /// What the tiles of a job cost, as long as it is rendered.
    pub(crate) fn pace(&self, job: JobId) -> Option<&Pace> {
        self.jobs.get(&job).map(|job| &job.pace)
    }

    /// When the next lease runs out, or a tile of one.
    pub(crate) fn next_expiry(&self) -> Option<Instant> {
        self.expiries.first().map(|&(until, _)| until)
    }

    /// The jobs of which a tile may be rendered a second time.
    pub(crate) fn quiet_jobs(&self) -> impl Iterator<Item = JobId> {
        self.quiet.keys().copied()
    }

    /// The leases of a job of which a tile may be rendered a second time, the quietest first.
    pub(crate) fn quietest(&self, job: JobId) -> impl Iterator<Item = Quiet> {
        let silence = self.pace(job).and_then(Pace::mean).map(|mean| mean * QUIET_TILES);
        let silence = silence.map_or(LONGEST_QUIET, |it| it.clamp(SHORTEST_QUIET, LONGEST_QUIET));
        self.quiet.get(&job).into_iter().flatten().map(move |&(last_tile, id)| Quiet {
            lease: LeaseName { job, id },
            worker: self.held[&id].worker,
            from: last_tile + silence,
            last_tile,
        })
    }

    /// The jobs that are being rendered and their tiles: those of the highest priority first, of
    /// these the earliest.
    pub(crate) fn jobs(&self) -> impl Iterator<Item = (JobId, &Tiles)> {
        self.order.iter().map(|&(_, id)| (id, &self.jobs[&id].tiles))
    }

    /// The workers that have leases of a job.
    pub(crate) fn workers_of(&self, job: JobId) -> BTreeSet<WorkerId> {
        let of_job = (job, LeaseId(0))..=(job, LeaseId(u64::MAX));
        self.by_job.range(of_job).map(|(_, id)| self.held[id].worker).collect()
    }

    /// The tiles of a job that workers have and have not brought, and whether they are known to
    /// have begun them.
    pub(crate) fn in_work(&self, job: JobId) -> impl Iterator<Item = (TileId, WorkerId, bool)> {
        let of_job = (job, LeaseId(0))..=(job, LeaseId(u64::MAX));
        let leases = self.by_job.range(of_job).map(|(_, id)| &self.held[id]);
        leases.flat_map(|lease| {
            let tiles = &self.jobs[&lease.job].tiles;
            let places = lease.alone.iter().chain(&lease.shared).chain(&lease.again);
            places.map(|place| (tiles.tile(*place), lease.worker, lease.begun.contains_key(place)))
        })
    }

    /// How many tiles a worker has.
    pub(crate) fn tile_count(&self, worker: WorkerId) -> usize {
        self.of(worker).map(|id| self.held[&id].count()).sum()
    }

    /// Says whether any job has a free tile, be it under suspicion.
    pub(crate) fn has_free(&self) -> bool {
        !self.with_free.is_empty() || !self.with_suspects.is_empty()
    }

    /// The leases of a worker, the earliest first.
    fn of(&self, worker: WorkerId) -> impl Iterator<Item = LeaseId> {
        let of_worker = (worker, LeaseId(0))..=(worker, LeaseId(u64::MAX));
        self.by_worker.range(of_worker).map(|&(_, id)| id)
    }

    /// Says whether a worker has no lease.
    pub(crate) fn is_without(&self, worker: WorkerId) -> bool {
        self.of(worker).next().is_none()
    }

    /// Says whether a worker has a tile under suspicion, besides which it gets no other.
    pub(crate) fn is_on_trial(&self, worker: WorkerId) -> bool {
        self.of(worker).any(|id| self.held[&id].is_lone)
    }

    /// Event: a job is to be rendered, of which no tile is in a lease.
    pub(crate) fn on_submit(&mut self, id: JobId, tiles: Tiles, priority: i32) {
        let (pace, granted) = (Pace::default(), BTreeMap::new());
        self.jobs.insert(id, Job { tiles, priority, pace, granted });
        self.order.insert((Reverse(priority), id));
        self.index_job(id);
    }

    /// Event: a job is to be rendered before those of lower priority.
    pub(crate) fn on_priority(&mut self, id: JobId, priority: i32) {
        let Some(job) = self.jobs.get_mut(&id) else { return };
        self.order.remove(&(Reverse(job.priority), id));
        job.priority = priority;
        self.order.insert((Reverse(priority), id));
    }

    /// Event: nobody is to render a job any longer. Answers with its tiles, if it was rendered.
    pub(crate) fn on_end(&mut self, job: JobId) -> Option<Tiles> {
        let of_job = (job, LeaseId(0))..=(job, LeaseId(u64::MAX));
        let ended: Vec<LeaseId> = self.by_job.range(of_job).map(|&(_, id)| id).collect();
        for id in ended {
            self.remove(id);
        }
        let ended = self.jobs.remove(&job);
        self.index_job(job);
        let Job { tiles, priority, .. } = ended?;
        self.order.remove(&(Reverse(priority), job));
        Some(tiles)
    }

    /// Event: `worker`, with `threads` of the farm's `all_threads`, would render up to `most` free
    /// tiles of `job` that are under no suspicion. `None` when that has none.
    pub(crate) fn on_idle(
        &mut self,
        worker: WorkerId,
        job: JobId,
        (threads, all_threads): (usize, usize),
        most: usize,
        now: Instant,
    ) -> Option<Run> {
        let Job { tiles, pace, .. } =
            self.jobs.get_mut(&job).filter(|job| job.tiles.free_count() > 0)?;
        let share = tiles.free_count() * threads / (RUNS_PER_THREAD * all_threads.max(1));
        let count = match pace.speed(worker) {
            Some(speed) => (share as f64 * speed.min(1.0)) as usize,
            None => share.min(FIRST_RUN * threads),
        };
        self.last_id.0 += 1;
        let places = tiles.take_free(count.clamp(1, LONGEST_RUN).min(most.max(1)), self.last_id);
        self.index_job(job);
        Some(self.grant((worker, threads), job, [places, NONE, NONE], now))
    }

    /// Event: `worker`, which has no lease, would render a free tile of `job` that is under
    /// suspicion.
    pub(crate) fn on_trial(&mut self, worker: WorkerId, job: JobId, now: Instant) -> Option<Run> {
        self.last_id.0 += 1;
        let place = self.jobs.get_mut(&job)?.tiles.take_suspect(self.last_id)?;
        self.index_job(job);
        let run = self.grant((worker, 1), job, [BTreeSet::from([place]), NONE, NONE], now);
        let lease = self.held.get_mut(&run.lease.id)?;
        lease.is_lone = true;
        self.index(run.lease.id);
        Some(run)
    }

    /// Event: `worker` has pixels of these tiles of `job`. It gets those that are free; `None` when
    /// none is.
    pub(crate) fn on_offer(
        &mut self,
        (worker, threads): (WorkerId, usize),
        job: JobId,
        offered: &[TileId],
        now: Instant,
    ) -> Option<Run> {
        let id = LeaseId(self.last_id.0 + 1);
        let places = self.jobs.get_mut(&job)?.tiles.take(offered, id);
        self.index_job(job);
        if places.is_empty() {
            return None;
        }
        self.last_id = id;
        Some(self.grant((worker, threads), job, [places, NONE, NONE], now))
    }

    /// Event: `worker` would render a tile of the lease `quiet` a second time. It gets the last
    /// one that is in no other lease, since the holder comes to that last.
    pub(crate) fn on_idle_at_the_end(
        &mut self,
        worker: WorkerId,
        quiet: LeaseId,
        now: Instant,
    ) -> Option<Run> {
        let lease = self.held.get_mut(&quiet)?;
        let place = lease.alone.pop_last()?;
        lease.shared.insert(place);
        let job = lease.job;
        self.index(quiet);
        self.last_id.0 += 1;
        self.jobs.get_mut(&job)?.tiles.share(place, self.last_id);
        Some(self.grant((worker, 1), job, [NONE, BTreeSet::from([place]), NONE], now))
    }

    /// Event: `worker` would render a tile of `job` again, to be compared with what is in the
    /// picture.
    pub(crate) fn on_audit(
        &mut self,
        worker: WorkerId,
        job: JobId,
        tile: TileId,
        now: Instant,
    ) -> Option<Run> {
        let place = self.tiles(job)?.place(tile);
        self.last_id.0 += 1;
        Some(self.grant((worker, 1), job, [NONE, NONE, BTreeSet::from([place])], now))
    }

    /// Enters a lease with the last number given; its tiles know of it already.
    fn grant(
        &mut self,
        (worker, threads): (WorkerId, usize),
        job: JobId,
        [alone, shared, again]: [BTreeSet<Place>; 3],
        now: Instant,
    ) -> Run {
        let id = self.last_id;
        let Job { tiles, granted, .. } = self.jobs.get_mut(&job).expect("it has these tiles");
        let places = alone.iter().chain(&shared).chain(&again).copied().collect();
        let run = Run { lease: LeaseName { job, id }, tiles: tiles.at(&places) };
        let mut covered: Box<[TileId]> = run.tiles.as_slice().into();
        covered.sort_unstable();
        granted.insert(id, Grant { worker, tiles: covered });
        self.by_worker.insert((worker, id));
        self.by_job.insert((job, id));
        let until = now + self.term;
        let lease = Lease {
            job,
            worker,
            threads,
            is_lone: false,
            alone,
            shared,
            again,
            begun: BTreeMap::new(),
            until,
            work: 0,
            last_tile: now,
            expires: until,
            quiet: None,
        };
        self.expiries.insert((until, id));
        self.held.insert(id, lease);
        self.index(id);
        run
    }

    /// Brings the entries of a lease in `expiries` and `quiet` up to date.
    fn index(&mut self, id: LeaseId) {
        let Some(lease) = self.held.get_mut(&id) else { return };
        let tiles = lease.begun.values().map(|begun| begun.until);
        let expires = tiles.chain([lease.until]).min().expect("there is one at least");
        // Tiles of one message come at one time.
        if lease.expires != expires {
            self.expiries.remove(&(lease.expires, id));
            lease.expires = expires;
            self.expiries.insert((expires, id));
        }

        let quiet = (!lease.alone.is_empty() && !lease.is_lone).then_some(lease.last_tile);
        if lease.quiet != quiet {
            let (job, before) = (lease.job, mem::replace(&mut lease.quiet, quiet));
            self.index_quiet((job, id), before, quiet);
        }
    }

    /// Moves the entry of a lease in `quiet`.
    fn index_quiet(
        &mut self,
        (job, id): (JobId, LeaseId),
        before: Option<Instant>,
        now: Option<Instant>,
    ) {
        let leases = self.quiet.entry(job).or_default();
        if let Some(last_tile) = before {
            leases.remove(&(last_tile, id));
        }
        leases.extend(now.map(|last_tile| (last_tile, id)));
        if leases.is_empty() {
            self.quiet.remove(&job);
        }
    }

    /// Brings the entries of a job in `with_free` and `with_suspects` up to date.
    fn index_job(&mut self, id: JobId) {
        let tiles = self.jobs.get(&id).map(|job| &job.tiles);
        let has = [
            (tiles.is_some_and(|tiles| tiles.free_count() > 0), &mut self.with_free),
            (tiles.is_some_and(Tiles::has_suspect), &mut self.with_suspects),
        ];
        for (has_some, jobs) in has {
            if has_some {
                jobs.insert(id)
            } else {
                jobs.remove(&id)
            };
        }
    }

    /// Event: `worker` says how far it is under a lease, which lives on if that is further than it
    /// ever was, and so does each of its tiles. Says whether it still has that lease.
    pub(crate) fn on_renewal(&mut self, worker: WorkerId, renewal: &Renewal, now: Instant) -> bool {
        let LeaseName { job, id } = renewal.lease;
        let held = self.held.get_mut(&id);
        let Some(lease) = held.filter(|lease| lease.worker == worker && lease.job == job) else {
            return false;
        };
        let until = now + self.term;
        let mut goes_on = renewal.work > lease.work;
        lease.work = lease.work.max(renewal.work);
        let tiles = &self.jobs[&job].tiles;
        for &(number, work) in &renewal.tiles {
            let Some(place) = tiles.grid().tile(number).map(|tile| tiles.place(tile)) else {
                continue;
            };
            let is_further = lease.begun.get(&place).is_none_or(|begun| work > begun.work);
            if is_further && lease.holds(place) {
                lease.begun.insert(place, Begun { work, until });
                goes_on = true;
            }
        }
        if goes_on {
            self.renew(id, now);
        }
        true
    }

    /// Has a lease run out a term from now.
    fn renew(&mut self, id: LeaseId, now: Instant) {
        if let Some(lease) = self.held.get_mut(&id) {
            lease.until = now + self.term;
            self.index(id);
        }
    }

    /// Says whether `worker` was ever to render `tile` under a lease of a job that has not ended.
    pub(crate) fn is_granted(&self, worker: WorkerId, name: LeaseName, tile: TileId) -> bool {
        let grant = self.jobs.get(&name.job).and_then(|job| job.granted.get(&name.id));
        grant
            .is_some_and(|grant| grant.worker == worker && grant.tiles.binary_search(&tile).is_ok())
    }

    /// Event: pixels of `tile` came from `worker`, which took `time` on a thread. Tiles are
    /// deterministic: the first copy wins, however late. `None` when the job is over or the worker
    /// was not granted the tile.
    pub(crate) fn on_pixels(
        &mut self,
        worker: WorkerId,
        name: LeaseName,
        (tile, time): (TileId, Duration),
        hash: PixelHash,
        now: Instant,
    ) -> Option<Arrival> {
        if !self.is_granted(worker, name, tile) {
            return None;
        }
        let Job { tiles, pace, .. } = self.jobs.get_mut(&name.job)?;
        let arrival = tiles.on_pixels(tile, Rendering { worker, hash });
        let place = tiles.place(tile);
        let is_again = self.held.get(&name.id).is_some_and(|lease| lease.again.contains(&place));
        if let Arrival::First(_, holders) = arrival {
            pace.on_tile(worker, time);
            self.index_job(name.job);
            self.on_tile(name.id, now);
            for holder in holders.iter() {
                self.drop_tile(holder, place, now);
            }
        }
        if is_again {
            self.on_tile(name.id, now);
            self.drop_tile(name.id, place, now);
        }
        Some(arrival)
    }

    /// Event: another worker made the same of a tile in the picture.
    pub(crate) fn confirm(&mut self, job: JobId, tile: TileId) {
        if let Some(job) = self.jobs.get_mut(&job) {
            job.tiles.confirm(tile);
        }
    }

    /// Frees the tiles in the picture of a job that `worker` rendered and no other confirmed.
    pub(crate) fn take_back(&mut self, job: JobId, worker: WorkerId) -> Vec<TileId> {
        let taken = self.jobs.get_mut(&job).map(|job| job.tiles.take_back(worker));
        self.index_job(job);
        taken.unwrap_or_default()
    }

    /// Event: the pixels of `tile` are in the picture. Answers with the number of such tiles;
    /// `None` when the job is over.
    pub(crate) fn on_stored(&mut self, job: JobId, tile: TileId) -> Option<u32> {
        let tiles = &mut self.jobs.get_mut(&job)?.tiles;
        tiles.on_stored(tile);
        Some(tiles.done_count())
    }

    /// Event: a tile came under a lease, which is not quiet therefore and lives on.
    fn on_tile(&mut self, id: LeaseId, now: Instant) {
        if let Some(lease) = self.held.get_mut(&id) {
            lease.last_tile = now;
            self.renew(id, now);
        }
    }

    /// Takes a tile whose pixels came out of a lease, which ends with its last tile.
    fn drop_tile(&mut self, id: LeaseId, place: Place, now: Instant) {
        let Some(lease) = self.held.get_mut(&id) else { return };
        lease.drop_place(place);
        if lease.count() == 0 {
            let worker = lease.worker;
            self.remove(id);
            // The turn of the next comes now.
            let later: Vec<LeaseId> = self.of(worker).filter(|&other| other > id).collect();
            for next in later {
                self.renew(next, now);
            }
        } else {
            self.index(id);
        }
    }

    /// Event: time passes. Leases that ran out are lost and their tiles free again, and so are
    /// tiles that stand still.
    pub(crate) fn on_time(&mut self, now: Instant) -> Vec<Loss> {
        let mut losses = Vec::new();
        while let Some(&(expires, id)) = self.expiries.first()
            && expires <= now
        {
            let lease = &self.held[&id];
            // Its worker comes to it after what it was leased before.
            let is_waiting = self.of(lease.worker).next() != Some(id);
            let lives = is_waiting || lease.until > now;
            let stands = lease.begun.iter().filter(|(_, begun)| begun.until <= now);
            let standing: BTreeSet<Place> = stands.map(|(&place, _)| place).collect();
            if standing.len() == lease.count() || !lives {
                losses.extend(self.on_standstill(id));
            } else if standing.is_empty() {
                self.renew(id, now);
            } else {
                losses.extend(self.lose_tiles(id, standing));
            }
        }
        losses
    }

    /// A lease ran out. What its worker has not come to yet is lost with it.
    fn on_standstill(&mut self, id: LeaseId) -> Vec<Loss> {
        let worker = self.held[&id].worker;
        let is_idle = |id: &LeaseId| self.held[id].work == 0 && self.held[id].begun.is_empty();
        let idle: Vec<LeaseId> =
            self.of(worker).filter(|&later| later > id).filter(is_idle).collect();
        let in_work = self.held[&id].in_work();
        let lost = self.lose(id, &in_work);
        lost.into_iter()
            .chain(idle.into_iter().filter_map(|id| self.lose(id, &BTreeSet::new())))
            .collect()
    }

    /// Event: `worker` is gone and will not come back. Tiles that it had in work come under
    /// suspicion if it `died`.
    pub(crate) fn on_worker_lost(&mut self, worker: WorkerId, died: bool) -> Vec<Loss> {
        let lost: Vec<LeaseId> = self.of(worker).collect();
        // Where its threads were is not known before it tells; they begin with its first lease.
        let is_known = lost.iter().any(|id| !self.held[id].begun.is_empty());
        let mut losses = Vec::new();
        for (index, id) in lost.into_iter().enumerate() {
            let lease = &self.held[&id];
            let may_be = if is_known { !lease.begun.is_empty() } else { index == 0 };
            let in_work = if died && may_be { lease.in_work() } else { BTreeSet::new() };
            losses.extend(self.lose(id, &in_work));
        }
        losses
    }

    /// Event: `worker` is to render no tile of `job` that it has not brought.
    pub(crate) fn on_suspicion(&mut self, worker: WorkerId, job: JobId) -> Vec<Loss> {
        let lost: Vec<LeaseId> = self.of(worker).filter(|id| self.held[id].job == job).collect();
        lost.into_iter().filter_map(|id| self.lose(id, &BTreeSet::new())).collect()
    }

    /// Ends a lease; those of its tiles that were `in_work` come under suspicion.
    fn lose(&mut self, id: LeaseId, in_work: &BTreeSet<Place>) -> Option<Loss> {
        let Lease { job, worker, alone, shared, again, .. } = self.remove(id)?;
        let places = alone.into_iter().chain(shared).collect();
        self.give_back(LeaseName { job, id }, worker, [&places, &again], in_work)
    }

    /// Takes some tiles that stand still out of a lease that has others.
    fn lose_tiles(&mut self, id: LeaseId, places: BTreeSet<Place>) -> Option<Loss> {
        let lease = self.held.get_mut(&id)?;
        let is_again = |place: &Place| lease.again.contains(place);
        let (again, places) = places.into_iter().partition::<BTreeSet<Place>, _>(is_again);
        for &place in places.iter().chain(&again) {
            lease.drop_place(place);
        }
        let (job, worker) = (lease.job, lease.worker);
        self.index(id);
        self.give_back(LeaseName { job, id }, worker, [&places, &again], &places)
    }

    /// Frees tiles that a lease does not hold any more.
    fn give_back(
        &mut self,
        lease: LeaseName,
        worker: WorkerId,
        [places, again]: [&BTreeSet<Place>; 2],
        in_work: &BTreeSet<Place>,
    ) -> Option<Loss> {
        let tiles = &mut self.jobs.get_mut(&lease.job)?.tiles;
        let mut others = Vec::new();
        for &place in places {
            if in_work.contains(&place) {
                tiles.suspect(place);
            }
            others.extend(tiles.give_back(place, lease.id).map(|other| (place, other)));
        }
        let lost = tiles.at(&places.union(again).copied().collect());
        let aside = tiles.aside().into_iter().filter(|tile| lost.contains(tile)).collect();
        let again = tiles.at(again);
        for (place, other) in others {
            // The other lease now holds the tile alone.
            if let Some(other) = self.held.get_mut(&other) {
                other.shared.remove(&place);
                other.alone.insert(place);
            }
            self.index(other);
        }
        self.index_job(lease.job);
        Some(Loss { lease, worker, tiles: lost, aside, again })
    }

    /// Takes a lease out of the table and every index.
    fn remove(&mut self, id: LeaseId) -> Option<Lease> {
        let lease = self.held.remove(&id)?;
        self.expiries.remove(&(lease.expires, id));
        self.index_quiet((lease.job, id), lease.quiet, None);
        self.by_worker.remove(&(lease.worker, id));
        self.by_job.remove(&(lease.job, id));
        Some(lease)
    }
}

impl Lease {
    fn count(&self) -> usize {
        self.alone.len() + self.shared.len() + self.again.len()
    }

    fn holds(&self, place: Place) -> bool {
        [&self.alone, &self.shared, &self.again].iter().any(|places| places.contains(&place))
    }

    fn drop_place(&mut self, place: Place) {
        for places in [&mut self.alone, &mut self.shared, &mut self.again] {
            places.remove(&place);
        }
        self.begun.remove(&place);
    }

    /// Tiles on which its worker's threads are: those that it told of, or the first of all.
    fn in_work(&self) -> BTreeSet<Place> {
        let places = self.alone.union(&self.shared).copied();
        if self.begun.is_empty() {
            places.take(self.threads).collect()
        } else {
            self.begun.keys().copied().collect()
        }
    }
}

#[cfg(test)]
impl Leases {
    /// Checks every invariant, at the price of a scan.
    pub(crate) fn check(&self, is_member: impl Fn(WorkerId) -> bool) {
        assert!(self.held.values().all(|lease| is_member(lease.worker)));
        let mut held: BTreeMap<LeaseId, [BTreeSet<Place>; 2]> = BTreeMap::new();
        for (job, Job { tiles, .. }) in &self.jobs {
            for (place, holders) in tiles.check() {
                let is_shared = usize::from(holders.iter().count() == 2);
                for holder in holders.iter() {
                    assert_eq!(self.held[&holder].job, *job);
                    held.entry(holder).or_default()[is_shared].insert(place);
                }
            }
            assert_eq!(self.with_free.contains(job), tiles.free_count() > 0);
            assert_eq!(self.with_suspects.contains(job), tiles.has_suspect());
        }
        let order = self.jobs.iter().map(|(&id, job)| (Reverse(job.priority), id));
        assert!(self.order == order.collect());
        let mut with = self.with_free.union(&self.with_suspects);
        assert!(with.all(|job| self.jobs.contains_key(job)));
        for (id, lease) in &self.held {
            assert!(lease.count() > 0, "a lease holds at least one tile");
            let held = held.remove(id).unwrap_or_default();
            assert_eq!([&lease.alone, &lease.shared], held.each_ref());
            let tiles = lease.begun.values().map(|begun| begun.until);
            assert_eq!(Some(lease.expires), tiles.chain([lease.until]).min());
            assert!(lease.begun.keys().all(|&place| lease.holds(place)));
            assert!(!lease.is_lone || self.of(lease.worker).count() == 1, "it has another");
        }
        assert!(held.is_empty(), "a tile is in a lease that there is not");
        let leases = || self.held.iter();
        assert!(self.expiries == leases().map(|(&id, lease)| (lease.expires, id)).collect());
        assert!(self.by_worker == leases().map(|(&id, lease)| (lease.worker, id)).collect());
        assert!(self.by_job == leases().map(|(&id, lease)| (lease.job, id)).collect());
        for (id, lease) in &self.held {
            let places = lease.alone.iter().chain(&lease.shared).chain(&lease.again);
            let places = places.copied().collect();
            for tile in self.jobs[&lease.job].tiles.at(&places) {
                assert!(self.is_granted(lease.worker, LeaseName { job: lease.job, id: *id }, tile));
            }
        }
        let quiet = leases().filter(|(_, lease)| !lease.alone.is_empty() && !lease.is_lone);
        let mut by_job: BTreeMap<JobId, BTreeSet<_>> = BTreeMap::new();
        for (&id, lease) in quiet {
            assert_eq!(lease.quiet, Some(lease.last_tile));
            by_job.entry(lease.job).or_default().insert((lease.last_tile, id));
        }
        assert!(self.quiet == by_job);
    }

    fn is_empty(&self) -> bool {
        self.held.is_empty()
    }
}

#[cfg(test)]
mod tests;
