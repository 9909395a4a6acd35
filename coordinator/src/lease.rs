//! Who renders which tiles of which job, and until when. Decisions alone: time is an argument,
//! nothing waits. A lease ends when its last tile has come, when it runs out, when its worker is
//! lost and when its job ends.

use std::{
    collections::{BTreeMap, BTreeSet},
    time::{Duration, Instant},
};

use rtfarm_core::tile::TileId;
use rtfarm_proto::{JobId, LeaseId, LeaseName, Renewal, WorkerId};

use crate::tiles::{Arrival, PixelHash, Place, Tiles};

/// The longest run of tiles in one lease. Workers ask for as many as they render in a moment: a lost one
/// costs no more than that.
const LONGEST_RUN: usize = 1024;

/// How many times each thread of the farm will ask again, if runs go on at the present length:
/// runs shorten as the work does, so that all threads finish together.
const RUNS_PER_THREAD: usize = 2;

/// A lease from which no tile came for this long has its tiles rendered a second time, once
/// nothing else is left to do.
const QUIET: Duration = Duration::from_millis(400);

/// The leases of all jobs that are being rendered, and those jobs' tiles. Invariants: a lease
/// holds at least one tile, and all its tiles are open; each lease has one entry in `expiries`,
/// `by_worker` and `by_job`, and one in `last_tiles` exactly while it holds a tile alone;
/// `with_free` has exactly the jobs with a free tile.
#[derive(Debug)]
pub(crate) struct Leases {
    term: Duration,
    last_id: LeaseId,
    jobs: BTreeMap<JobId, Tiles>,
    with_free: BTreeSet<JobId>,
    held: BTreeMap<LeaseId, Lease>,
    expiries: BTreeSet<(Instant, LeaseId)>,
    last_tiles: BTreeSet<(Instant, LeaseId)>,
    by_worker: BTreeSet<(WorkerId, LeaseId)>,
    by_job: BTreeSet<(JobId, LeaseId)>,
    /// Every lease that was ever given of these jobs, and what it covered.
    granted: BTreeMap<JobId, BTreeMap<LeaseId, Grant>>,
}

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
    /// Tiles that are in no other lease.
    alone: BTreeSet<Place>,
    /// Tiles that another lease holds too.
    shared: BTreeSet<Place>,
    until: Instant,
    /// The work that its worker has told of.
    work: u64,
    /// When the lease began, or the last tile under it came.
    last_tile: Instant,
}

/// A run of tiles for a worker, in the order of rendering.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Run {
    pub(crate) lease: LeaseName,
    pub(crate) tiles: Vec<TileId>,
}

/// A lease that its worker no longer has.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Loss {
    pub(crate) lease: LeaseName,
    pub(crate) worker: WorkerId,
    /// The tiles that had not come, in the order of rendering.
    pub(crate) tiles: Vec<TileId>,
}

impl Leases {
    /// Makes the leases of a farm without jobs. One lives for `term` after the last progress.
    pub(crate) fn new(term: Duration) -> Self {
        Self {
            term,
            last_id: LeaseId(0),
            jobs: BTreeMap::new(),
            with_free: BTreeSet::new(),
            held: BTreeMap::new(),
            expiries: BTreeSet::new(),
            last_tiles: BTreeSet::new(),
            by_worker: BTreeSet::new(),
            by_job: BTreeSet::new(),
            granted: BTreeMap::new(),
        }
    }

    /// The tiles of a job, as long as it is rendered.
    pub(crate) fn tiles(&self, job: JobId) -> Option<&Tiles> {
        self.jobs.get(&job)
    }

    /// When the next lease runs out.
    pub(crate) fn next_expiry(&self) -> Option<Instant> {
        self.expiries.first().map(|&(until, _)| until)
    }

    /// Leases of which a tile may be rendered a second time, the quietest first: from when on,
    /// whose it is and of which job.
    pub(crate) fn quietest(&self) -> impl Iterator<Item = (Instant, WorkerId, LeaseName)> {
        self.last_tiles.iter().map(|&(last_tile, id)| {
            let Lease { worker, job, .. } = self.held[&id];
            (last_tile + QUIET, worker, LeaseName { job, id })
        })
    }

    /// The jobs that are being rendered, the earliest first, and how many free tiles each has.
    pub(crate) fn jobs(&self) -> impl Iterator<Item = (JobId, usize)> {
        self.jobs.iter().map(|(&job, tiles)| (job, tiles.free_count()))
    }

    /// Says whether any job has a free tile.
    pub(crate) fn has_free(&self) -> bool {
        !self.with_free.is_empty()
    }

    /// Event: a job is to be rendered, of which all tiles are free.
    pub(crate) fn on_submit(&mut self, job: JobId, tiles: Tiles) {
        self.jobs.insert(job, tiles);
        self.with_free.insert(job);
    }

    /// Event: nobody is to render a job any longer.
    pub(crate) fn on_end(&mut self, job: JobId) {
        let of_job = (job, LeaseId(0))..=(job, LeaseId(u64::MAX));
        let ended: Vec<LeaseId> = self.by_job.range(of_job).map(|&(_, id)| id).collect();
        for id in ended {
            self.remove(id);
        }
        self.jobs.remove(&job);
        self.with_free.remove(&job);
        self.granted.remove(&job);
    }

    /// Event: `worker`, with `threads` of the farm's `all_threads`, would render up to `most` free
    /// tiles of `job`. `None` when that has none.
    pub(crate) fn on_idle(
        &mut self,
        worker: WorkerId,
        job: JobId,
        (threads, all_threads): (usize, usize),
        most: usize,
        now: Instant,
    ) -> Option<Run> {
        let tiles = self.jobs.get_mut(&job).filter(|tiles| tiles.free_count() > 0)?;
        let shared_out = tiles.free_count() * threads / (RUNS_PER_THREAD * all_threads.max(1));
        let count = shared_out.clamp(1, LONGEST_RUN).min(most.max(1));
        self.last_id.0 += 1;
        let places = tiles.take_free(count, self.last_id);
        if tiles.free_count() == 0 {
            self.with_free.remove(&job);
        }
        Some(self.grant(worker, job, (places, BTreeSet::new()), now))
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
        if lease.alone.is_empty() {
            self.last_tiles.remove(&(lease.last_tile, quiet));
        }
        self.last_id.0 += 1;
        self.jobs.get_mut(&job)?.share(place, self.last_id);
        Some(self.grant(worker, job, (BTreeSet::new(), BTreeSet::from([place])), now))
    }

    /// Enters a lease with the last number given; its tiles know of it already.
    fn grant(
        &mut self,
        worker: WorkerId,
        job: JobId,
        (alone, shared): (BTreeSet<Place>, BTreeSet<Place>),
        now: Instant,
    ) -> Run {
        let id = self.last_id;
        let tiles = &self.jobs[&job];
        let run = Run {
            lease: LeaseName { job, id },
            tiles: tiles.at(if alone.is_empty() { &shared } else { &alone }),
        };
        let mut granted: Box<[TileId]> = run.tiles.as_slice().into();
        granted.sort_unstable();
        self.granted.entry(job).or_default().insert(id, Grant { worker, tiles: granted });
        let until = now + self.term;
        self.expiries.insert((until, id));
        self.by_worker.insert((worker, id));
        self.by_job.insert((job, id));
        if !alone.is_empty() {
            self.last_tiles.insert((now, id));
        }
        self.held.insert(id, Lease { job, worker, alone, shared, until, work: 0, last_tile: now });
        run
    }

    /// Event: `worker` says how far it is under a lease, which lives on if that is further than it
    /// ever was. Says whether it still has that lease.
    pub(crate) fn on_renewal(&mut self, worker: WorkerId, renewal: Renewal, now: Instant) -> bool {
        let Renewal { lease: LeaseName { job, id }, work } = renewal;
        let held = self.held.get_mut(&id);
        let Some(lease) = held.filter(|lease| lease.worker == worker && lease.job == job) else {
            return false;
        };
        if work > lease.work {
            lease.work = work;
            self.renew(id, now);
        }
        true
    }

    /// Has a lease run out a term from now.
    fn renew(&mut self, id: LeaseId, now: Instant) {
        let until = now + self.term;
        // Tiles of one message come at one time.
        if let Some(lease) = self.held.get_mut(&id)
            && lease.until != until
        {
            self.expiries.remove(&(lease.until, id));
            lease.until = until;
            self.expiries.insert((until, id));
        }
    }

    /// Says whether `worker` was ever to render `tile` under a lease of a job that has not ended.
    pub(crate) fn is_granted(&self, worker: WorkerId, name: LeaseName, tile: TileId) -> bool {
        let grant = self.granted.get(&name.job).and_then(|granted| granted.get(&name.id));
        grant
            .is_some_and(|grant| grant.worker == worker && grant.tiles.binary_search(&tile).is_ok())
    }

    /// Event: pixels of `tile` came from `worker`. Tiles are deterministic: the first copy wins,
    /// however late. `None` when the job is over or the worker was not granted the tile.
    pub(crate) fn on_pixels(
        &mut self,
        worker: WorkerId,
        name: LeaseName,
        tile: TileId,
        hash: PixelHash,
        now: Instant,
    ) -> Option<Arrival> {
        if !self.is_granted(worker, name, tile) {
            return None;
        }
        let tiles = self.jobs.get_mut(&name.job)?;
        let arrival = tiles.on_pixels(tile, hash);
        if let Arrival::First(place, holders) = arrival {
            if tiles.free_count() == 0 {
                self.with_free.remove(&name.job);
            }
            self.on_tile(name.id, now);
            for holder in holders.iter() {
                self.drop_tile(holder, place, now);
            }
        }
        Some(arrival)
    }

    /// Event: the pixels of `tile` are in the picture. Answers with the number of such tiles;
    /// `None` when the job is over.
    pub(crate) fn on_stored(&mut self, job: JobId, tile: TileId) -> Option<u32> {
        let tiles = self.jobs.get_mut(&job)?;
        tiles.on_stored(tile);
        Some(tiles.done_count())
    }

    /// Event: a tile came under a lease, which is not quiet therefore and lives on.
    fn on_tile(&mut self, id: LeaseId, now: Instant) {
        self.renew(id, now);
        if let Some(lease) = self.held.get_mut(&id)
            && lease.last_tile != now
        {
            if self.last_tiles.remove(&(lease.last_tile, id)) {
                self.last_tiles.insert((now, id));
            }
            lease.last_tile = now;
        }
    }

    /// Takes a tile whose pixels came out of a lease, which ends with its last tile.
    fn drop_tile(&mut self, id: LeaseId, place: Place, now: Instant) {
        let Some(lease) = self.held.get_mut(&id) else { return };
        lease.shared.remove(&place);
        if lease.alone.remove(&place) && lease.alone.is_empty() {
            self.last_tiles.remove(&(lease.last_tile, id));
        }
        if lease.alone.is_empty() && lease.shared.is_empty() {
            let of_worker = (lease.worker, id)..=(lease.worker, LeaseId(u64::MAX));
            self.remove(id);
            // The turn of the next comes now.
            let later: Vec<LeaseId> = self.by_worker.range(of_worker).map(|&(_, id)| id).collect();
            for next in later {
                self.renew(next, now);
            }
        }
    }

    /// Event: time passes. Leases that ran out are lost and their tiles free again.
    pub(crate) fn on_time(&mut self, now: Instant) -> Vec<Loss> {
        let mut losses = Vec::new();
        while let Some(&(until, id)) = self.expiries.first()
            && until <= now
        {
            // Its worker comes to it after what it was leased before.
            let worker = self.held[&id].worker;
            let earlier = self.by_worker.range((worker, LeaseId(0))..(worker, id)).next();
            if earlier.is_some() {
                self.renew(id, now);
            } else {
                losses.extend(self.lose(id));
            }
        }
        losses
    }

    /// Event: `worker` is gone and will not come back.
    pub(crate) fn on_worker_lost(&mut self, worker: WorkerId) -> Vec<Loss> {
        let of_worker = (worker, LeaseId(0))..=(worker, LeaseId(u64::MAX));
        let lost: Vec<LeaseId> = self.by_worker.range(of_worker).map(|&(_, id)| id).collect();
        lost.into_iter().filter_map(|id| self.lose(id)).collect()
    }

    /// Event: `worker` is to render no tile of `job` that it has not brought.
    pub(crate) fn on_suspicion(&mut self, worker: WorkerId, job: JobId) -> Vec<Loss> {
        let of_worker = (worker, LeaseId(0))..=(worker, LeaseId(u64::MAX));
        let leases = self.by_worker.range(of_worker).map(|&(_, id)| id);
        let lost: Vec<LeaseId> = leases.filter(|id| self.held[id].job == job).collect();
        lost.into_iter().filter_map(|id| self.lose(id)).collect()
    }

    fn lose(&mut self, id: LeaseId) -> Option<Loss> {
        let Lease { job, worker, alone, shared, .. } = self.remove(id)?;
        let tiles = self.jobs.get_mut(&job)?;
        for &place in alone.iter().chain(&shared) {
            let Some(other) = tiles.give_back(place, id) else { continue };
            // The other lease now holds the tile alone.
            if let Some(lease) = self.held.get_mut(&other) {
                lease.shared.remove(&place);
                lease.alone.insert(place);
                self.last_tiles.insert((lease.last_tile, other));
            }
        }
        if tiles.free_count() > 0 {
            self.with_free.insert(job);
        }
        let places = alone.into_iter().chain(shared).collect();
        Some(Loss { lease: LeaseName { job, id }, worker, tiles: tiles.at(&places) })
    }

    /// Takes a lease out of the table and every index.
    fn remove(&mut self, id: LeaseId) -> Option<Lease> {
        let lease = self.held.remove(&id)?;
        self.expiries.remove(&(lease.until, id));
        self.last_tiles.remove(&(lease.last_tile, id));
        self.by_worker.remove(&(lease.worker, id));
        self.by_job.remove(&(lease.job, id));
        Some(lease)
    }
}

#[cfg(test)]
impl Leases {
    /// Checks every invariant, at the price of a scan.
    pub(crate) fn check(&self, is_member: impl Fn(WorkerId) -> bool) {
        assert!(self.held.values().all(|lease| is_member(lease.worker)));
        let mut held: BTreeMap<LeaseId, [BTreeSet<Place>; 2]> = BTreeMap::new();
        for (job, tiles) in &self.jobs {
            for (place, holders) in tiles.check() {
                let is_shared = usize::from(holders.iter().count() == 2);
                for holder in holders.iter() {
                    assert_eq!(self.held[&holder].job, *job);
                    held.entry(holder).or_default()[is_shared].insert(place);
                }
            }
            assert_eq!(self.with_free.contains(job), tiles.free_count() > 0);
        }
        assert!(self.with_free.iter().all(|job| self.jobs.contains_key(job)));
        assert_eq!(held.len(), self.held.len(), "a lease holds at least one tile");
        for (id, lease) in &self.held {
            assert_eq!([&lease.alone, &lease.shared], held[id].each_ref());
        }
        let leases = || self.held.iter();
        assert!(self.expiries == leases().map(|(&id, lease)| (lease.until, id)).collect());
        assert!(self.by_worker == leases().map(|(&id, lease)| (lease.worker, id)).collect());
        assert!(self.by_job == leases().map(|(&id, lease)| (lease.job, id)).collect());
        assert!(self.granted.keys().all(|job| self.jobs.contains_key(job)));
        for (id, lease) in &self.held {
            let places = lease.alone.union(&lease.shared).copied().collect();
            for tile in self.jobs[&lease.job].at(&places) {
                assert!(self.is_granted(lease.worker, LeaseName { job: lease.job, id: *id }, tile));
            }
        }
        let alone = leases().filter(|(_, lease)| !lease.alone.is_empty());
        assert!(self.last_tiles == alone.map(|(&id, lease)| (lease.last_tile, id)).collect());
    }

    fn is_empty(&self) -> bool {
        self.held.is_empty()
    }
}

#[cfg(test)]
mod tests {
    use rtfarm_core::tile::{Size, TileGrid};

    use super::*;

    const TERM: Duration = Duration::from_secs(4);
    const JOB: JobId = JobId(1);
    const A: WorkerId = WorkerId(1);
    const B: WorkerId = WorkerId(2);

    fn lease(id: u64) -> LeaseName {
        LeaseName { job: JOB, id: LeaseId(id) }
    }

    fn renewal(id: u64, work: u64) -> Renewal {
        Renewal { lease: lease(id), work }
    }

    /// A job of `columns` x `rows` tiles.
    fn job(columns: u64, rows: u64) -> (Leases, Instant) {
        let grid = TileGrid::new(Size::new(columns * 16, rows * 16).unwrap(), 16).unwrap();
        let mut leases = Leases::new(TERM);
        leases.on_submit(JOB, Tiles::new(grid));
        #[expect(clippy::disallowed_methods, reason = "any instant will do")]
        let start = Instant::now();
        (leases, start)
    }

    /// A job of a row of tiles, of which the first worker has leased all under lease 1.
    fn all_leased(tile_count: u64) -> (Leases, Vec<TileId>, Instant) {
        let (mut leases, start) = job(tile_count, 1);
        let run = leases.on_idle(A, JOB, (8, 1), 64, start).unwrap();
        assert_eq!((run.lease, run.tiles.len() as u64), (lease(1), tile_count));
        assert!(!leases.has_free());
        (leases, run.tiles, start)
    }

    /// Pixels of a tile that is open, and whose pixels are stored at once.
    fn deliver(leases: &mut Leases, worker: WorkerId, id: u64, tile: TileId, now: Instant) {
        let arrival = leases.on_pixels(worker, lease(id), tile, [7; 32], now);
        assert!(matches!(arrival, Some(Arrival::First(..))), "{arrival:?}");
        leases.on_stored(JOB, tile).unwrap();
        leases.check(|_| true);
    }

    /// From when on `worker` may render a tile of the quietest lease of others again.
    fn quiet_for(leases: &Leases, worker: WorkerId) -> Option<(Instant, LeaseId)> {
        let mut others = leases.quietest().filter(|&(_, holder, _)| holder != worker);
        others.next().map(|(from, _, name)| (from, name.id))
    }

    #[test]
    fn a_lease_without_progress_is_lost_and_its_tiles_go_to_others() {
        let (mut leases, tiles, start) = all_leased(5);
        deliver(&mut leases, A, 1, tiles[0], start);
        assert_eq!(leases.on_time(start + TERM / 2), []);
        assert!(leases.on_renewal(A, renewal(1, 1), start + TERM / 2));
        assert_eq!(leases.on_time(start + TERM), [], "progress renews it");
        assert_eq!(leases.next_expiry(), Some(start + TERM * 3 / 2));

        let lost = leases.on_time(start + TERM * 3 / 2);
        let rest = tiles[1..].to_vec();
        assert_eq!(lost, [Loss { lease: lease(1), worker: A, tiles: rest.clone() }]);
        leases.check(|_| true);
        assert!(!leases.on_renewal(A, renewal(1, 2), start + TERM * 2));
        let run = leases.on_idle(B, JOB, (8, 1), 64, start + TERM * 2).unwrap();
        assert_eq!(run.tiles, rest);
    }

    #[test]
    fn a_renewal_without_new_work_keeps_no_lease_alive() {
        let (mut leases, _, start) = all_leased(2);
        assert!(leases.on_renewal(A, renewal(1, 7), start + TERM / 4));
        for (work, quarter) in [(7, 2), (0, 3), (6, 4)] {
            assert!(leases.on_renewal(A, renewal(1, work), start + TERM * quarter / 4));
        }
        assert_eq!(leases.on_time(start + TERM * 5 / 4).len(), 1);
    }

    #[test]
    fn one_lease_does_not_live_on_the_work_of_another() {
        let (mut leases, start) = job(4, 1);
        for id in 1..=2 {
            assert_eq!(leases.on_idle(A, JOB, (1, 1), 1, start).unwrap().lease, lease(id));
        }
        assert!(leases.on_renewal(A, renewal(2, 1), start + TERM / 2));
        let lost = leases.on_time(start + TERM);
        assert_eq!(lost.iter().map(|loss| loss.lease).collect::<Vec<_>>(), [lease(1)]);
    }

    #[test]
    fn a_lease_waits_for_those_that_its_worker_got_before() {
        let (mut leases, start) = job(4, 1);
        for id in 1..=2 {
            assert_eq!(leases.on_idle(A, JOB, (1, 1), 1, start).unwrap().lease, lease(id));
        }
        for work in 1..9 {
            let now = start + TERM * work / 2;
            assert!(leases.on_renewal(A, renewal(1, work.into()), now));
            assert_eq!(leases.on_time(now), [], "its tiles are not begun");
            leases.check(|_| true);
        }
        assert_eq!(leases.on_time(start + TERM * 6).len(), 2, "nothing goes on");
    }

    #[test]
    fn a_lease_whose_turn_comes_has_a_whole_term() {
        let (mut leases, start) = job(4, 1);
        let runs = [(); 2].map(|()| leases.on_idle(A, JOB, (1, 1), 1, start).unwrap());
        deliver(&mut leases, A, 1, runs[0].tiles[0], start + TERM * 3 / 4);
        assert_eq!(leases.on_time(start + TERM), []);
        assert_eq!(leases.on_time(start + TERM * 7 / 4).len(), 1);
    }

    #[test]
    fn nobody_renews_the_lease_of_another_worker_or_job() {
        let (mut leases, _, start) = all_leased(2);
        assert!(!leases.on_renewal(B, renewal(1, 1), start));
        let other_job = LeaseName { job: JobId(2), ..lease(1) };
        assert!(!leases.on_renewal(A, Renewal { lease: other_job, work: 1 }, start));
        assert_eq!(leases.on_time(start + TERM).len(), 1);
    }

    #[test]
    fn late_pixels_of_a_lost_lease_are_the_first_copy() {
        let (mut leases, tiles, start) = all_leased(2);
        leases.on_worker_lost(A);
        deliver(&mut leases, A, 1, tiles[0], start);
        let run = leases.on_idle(B, JOB, (8, 1), 64, start).unwrap();
        assert_eq!(run.tiles, tiles[1..]);
    }

    #[test]
    fn a_second_copy_meets_the_first_ones_hash() {
        let (mut leases, tiles, start) = all_leased(1);
        let copy =
            |leases: &mut Leases, hash| leases.on_pixels(A, lease(1), tiles[0], [hash; 32], start);
        assert!(matches!(copy(&mut leases, 1), Some(Arrival::First(..))));
        assert_eq!(copy(&mut leases, 2), Some(Arrival::WhileStoring([1; 32])));
        assert_eq!(leases.on_stored(JOB, tiles[0]), Some(1));
        assert_eq!(copy(&mut leases, 2), Some(Arrival::AfterDone([1; 32])));
    }

    #[test]
    fn a_quiet_lease_is_rendered_twice_from_its_end_and_once_only() {
        let (mut leases, tiles, start) = all_leased(2);
        let later = start + QUIET;
        assert_eq!(quiet_for(&leases, B), Some((later, LeaseId(1))));
        assert_eq!(quiet_for(&leases, A), None, "it is its own");
        for (id, &tile) in (2..).zip(tiles.iter().rev()) {
            let run = Run { lease: lease(id), tiles: vec![tile] };
            assert_eq!(leases.on_idle_at_the_end(B, LeaseId(1), later), Some(run));
            leases.check(|_| true);
        }
        assert_eq!(leases.on_idle_at_the_end(B, LeaseId(1), later), None);
        assert_eq!(quiet_for(&leases, B), None);

        for (id, &tile) in (2..).zip(tiles.iter().rev()) {
            deliver(&mut leases, B, id, tile, later);
        }
        assert!(leases.is_empty(), "nothing is left open");
    }

    #[test]
    fn a_tile_whose_second_rendering_is_lost_may_have_another() {
        let (mut leases, tiles, start) = all_leased(1);
        leases.on_idle_at_the_end(B, LeaseId(1), start).unwrap();
        assert_eq!(leases.on_worker_lost(B).len(), 1);
        leases.check(|_| true);
        assert!(!leases.has_free(), "its first holder still has it");
        let run = leases.on_idle_at_the_end(B, LeaseId(1), start).unwrap();
        assert_eq!(leases.on_worker_lost(A).len(), 1);
        leases.check(|_| true);
        deliver(&mut leases, B, run.lease.id.0, tiles[0], start);
        assert!(leases.is_empty());
    }

    #[test]
    fn the_leases_of_an_ended_job_are_lost() {
        let (mut leases, tiles, start) = all_leased(4);
        leases.on_end(JOB);
        leases.check(|_| true);
        assert!(leases.is_empty() && !leases.has_free());
        assert!(!leases.on_renewal(A, renewal(1, 1), start));
        assert_eq!(leases.on_pixels(A, lease(1), tiles[0], [0; 32], start), None);
        assert_eq!(leases.on_stored(JOB, tiles[0]), None);
    }

    #[test]
    fn runs_shorten_towards_the_end() {
        let (mut leases, start) = job(100, 10);
        let lengths: Vec<usize> =
            std::iter::from_fn(|| leases.on_idle(A, JOB, (1, 4), 1000, start))
                .map(|run| run.tiles.len())
                .collect();
        assert!(lengths.is_sorted_by(|a, b| a >= b), "{lengths:?}");
        assert_eq!(lengths[0], 1000 / 4 / RUNS_PER_THREAD);
        assert_eq!(lengths.last(), Some(&1));
        assert_eq!(lengths.iter().sum::<usize>(), 1000);
    }
}
