//! Who renders which tile of one job. Decisions alone: time is an argument, nothing waits.

use std::{
    collections::{BTreeMap, BTreeSet},
    time::{Duration, Instant},
};

use rtfarm_core::tile::{TileGrid, TileId};
use rtfarm_proto::{LeaseId, WorkerId};

/// A finished tile's BLAKE3 hash.
pub(crate) type PixelHash = [u8; 32];

/// The longest run of tiles in one lease: a lost worker costs no more than its rendering.
const LONGEST_RUN: usize = 64;

/// How many times each thread of the farm will ask again, if runs go on at the present length:
/// runs shorten as the work does, so that all threads finish together.
const RUNS_PER_THREAD: usize = 2;

/// A lease from which no tile came for this long has its tiles rendered a second time, once
/// nothing else is left to do.
const SLOW: Duration = Duration::from_millis(400);

/// The leases of one job's tiles. Invariants: a tile that is `Done` stays so; a tile is in `free`
/// exactly while it is neither done nor in a lease; each lease has one entry in `expiries`.
#[derive(Debug)]
pub(crate) struct Leases {
    grid: TileGrid,
    term: Duration,
    /// Every tile in the order of rendering; the index is the tile's place.
    order: Vec<TileId>,
    /// By tile number.
    tiles: Vec<Tile>,
    /// The places of free tiles.
    free: BTreeSet<u32>,
    held: BTreeMap<LeaseId, Lease>,
    expiries: BTreeSet<(Instant, LeaseId)>,
}

#[derive(Debug, Clone, Copy)]
enum Tile {
    /// In so many leases; free when in none.
    Open { place: u32, leases: u8 },
    /// Its first pixels had this hash.
    Done(PixelHash),
}

#[derive(Debug)]
struct Lease {
    worker: WorkerId,
    /// Tiles not yet done, by place.
    tiles: BTreeSet<u32>,
    until: Instant,
    /// When the lease began, or the last tile under it came.
    last_tile: Instant,
}

/// A run of tiles for a worker.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Run {
    pub(crate) lease: LeaseId,
    pub(crate) tiles: Vec<TileId>,
}

/// What a worker gets when no tile is free.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Again {
    /// A tile that another worker has been silent about.
    Render(Run),
    /// Nothing now; perhaps then, or when something changes.
    Wait(Option<Instant>),
}

/// What is to be done with pixels that came.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Verdict {
    /// They are the tile's first.
    Stitch,
    /// The same as the first.
    Duplicate,
    /// Not the same as the first, which were these: something is broken.
    Differs(PixelHash),
}

/// A lease that its worker no longer has.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Loss {
    pub(crate) worker: WorkerId,
    pub(crate) lease: LeaseId,
    /// The tiles that had not come, in the order of rendering.
    pub(crate) tiles: Vec<TileId>,
}

impl Leases {
    /// All tiles of `grid`, free; leases live for `term` after the last sign of progress.
    pub(crate) fn new(grid: TileGrid, term: Duration) -> Self {
        let order = grid.render_order();
        let mut tiles = vec![Tile::Done([0; 32]); order.len()];
        for (place, tile) in (0..).zip(&order) {
            tiles[tile.index()] = Tile::Open { place, leases: 0 };
        }
        let free = (0..grid.count()).collect();
        Self { grid, term, order, tiles, free, held: BTreeMap::new(), expiries: BTreeSet::new() }
    }

    /// The tiles that there are.
    pub(crate) fn grid(&self) -> TileGrid {
        self.grid
    }

    /// Event: `worker`, with `threads` of the farm's `all_threads`, has nothing to do and would
    /// take up to `most` tiles, under a lease named `id`. `None` when no tile is free.
    pub(crate) fn on_idle(
        &mut self,
        worker: WorkerId,
        (threads, all_threads): (usize, usize),
        most: usize,
        id: LeaseId,
        now: Instant,
    ) -> Option<Run> {
        let shared_out = self.free.len() * threads / (RUNS_PER_THREAD * all_threads.max(1));
        let count = shared_out.clamp(1, LONGEST_RUN).min(most.max(1));
        let places: BTreeSet<u32> = self.free.iter().copied().take(count).collect();
        (!places.is_empty()).then(|| self.grant(worker, places, id, now))
    }

    /// Event: as [`Leases::on_idle`], and no job has a free tile: `worker` may render one a second
    /// time. It is the last tile, which its holder comes to last, of the lease that has been
    /// silent for longest.
    pub(crate) fn on_idle_at_the_end(
        &mut self,
        worker: WorkerId,
        id: LeaseId,
        now: Instant,
    ) -> Again {
        let slowest = self
            .held
            .values()
            .filter(|lease| lease.worker != worker)
            .filter_map(|lease| {
                let once = |place: &&u32| self.lease_count(**place) == 1;
                Some((lease.last_tile + SLOW, *lease.tiles.iter().rev().find(once)?))
            })
            .min();
        match slowest {
            Some((is_slow_at, place)) if is_slow_at <= now => {
                Again::Render(self.grant(worker, BTreeSet::from([place]), id, now))
            }
            slowest => Again::Wait(slowest.map(|(is_slow_at, _)| is_slow_at)),
        }
    }

    fn grant(&mut self, worker: WorkerId, places: BTreeSet<u32>, id: LeaseId, now: Instant) -> Run {
        for &place in &places {
            self.free.remove(&place);
            *self.lease_count_mut(place) += 1;
        }
        let tiles = places.iter().map(|&place| self.order[place as usize]).collect();
        let until = now + self.term;
        self.held.insert(id, Lease { worker, tiles: places, until, last_tile: now });
        self.expiries.insert((until, id));
        Run { lease: id, tiles }
    }

    fn lease_count(&self, place: u32) -> u8 {
        match self.tiles[self.order[place as usize].index()] {
            Tile::Open { leases, .. } => leases,
            Tile::Done(_) => 0,
        }
    }

    fn lease_count_mut(&mut self, place: u32) -> &mut u8 {
        match &mut self.tiles[self.order[place as usize].index()] {
            Tile::Open { leases, .. } => leases,
            Tile::Done(_) => unreachable!("a tile that is done is in no lease"),
        }
    }

    /// Event: `worker` goes on rendering under `id`. Says whether the lease still is its own.
    pub(crate) fn on_progress(&mut self, worker: WorkerId, id: LeaseId, now: Instant) -> bool {
        match self.held.get_mut(&id) {
            Some(lease) if lease.worker == worker => {
                self.expiries.remove(&(lease.until, id));
                lease.until = now + self.term;
                self.expiries.insert((lease.until, id));
                true
            }
            _ => false,
        }
    }

    /// Event: pixels of `tile` came. Tiles are deterministic: the first copy wins, however late
    /// and whoever sent it.
    pub(crate) fn on_pixels(
        &mut self,
        worker: WorkerId,
        id: LeaseId,
        tile: TileId,
        hash: PixelHash,
        now: Instant,
    ) -> Verdict {
        self.on_progress(worker, id, now);
        let (place, lease_count) = match self.tiles[tile.index()] {
            Tile::Done(first) if first == hash => return Verdict::Duplicate,
            Tile::Done(first) => return Verdict::Differs(first),
            Tile::Open { place, leases } => (place, leases),
        };
        self.tiles[tile.index()] = Tile::Done(hash);
        self.free.remove(&place);
        let mut left = lease_count;
        if let Some(lease) = self.held.get_mut(&id) {
            lease.last_tile = now;
            left -= u8::from(self.drop_from_lease(place, id));
        }
        if left > 0 {
            // Rendered twice, or under a lease that was lost: seldom enough to look at them all.
            let others: Vec<LeaseId> = self.held.keys().copied().collect();
            for other in others {
                self.drop_from_lease(place, other);
            }
        }
        Verdict::Stitch
    }

    /// Takes a tile that is done out of a lease, which ends with its last tile.
    fn drop_from_lease(&mut self, place: u32, id: LeaseId) -> bool {
        let Some(lease) = self.held.get_mut(&id) else { return false };
        let was_in = lease.tiles.remove(&place);
        if lease.tiles.is_empty() {
            self.expiries.remove(&(lease.until, id));
            self.held.remove(&id);
        }
        was_in
    }

    /// Event: time passes. Leases that ran out are lost and their tiles free again.
    pub(crate) fn on_tick(&mut self, now: Instant) -> Vec<Loss> {
        let mut losses = Vec::new();
        while let Some(&(until, id)) = self.expiries.first()
            && until <= now
        {
            losses.extend(self.lose(id));
        }
        losses
    }

    /// Event: `worker` is gone and will not come back.
    pub(crate) fn on_worker_lost(&mut self, worker: WorkerId) -> Vec<Loss> {
        let lost = self.held.iter().filter(|(_, lease)| lease.worker == worker);
        let lost: Vec<LeaseId> = lost.map(|(&id, _)| id).collect();
        lost.into_iter().filter_map(|id| self.lose(id)).collect()
    }

    fn lose(&mut self, id: LeaseId) -> Option<Loss> {
        let lease = self.held.remove(&id)?;
        self.expiries.remove(&(lease.until, id));
        for &place in &lease.tiles {
            let lease_count = self.lease_count_mut(place);
            *lease_count -= 1;
            if *lease_count == 0 {
                self.free.insert(place);
            }
        }
        let tiles = lease.tiles.iter().map(|&place| self.order[place as usize]).collect();
        Some(Loss { worker: lease.worker, lease: id, tiles })
    }
}

#[cfg(test)]
mod tests {
    use rtfarm_core::tile::Size;

    use super::*;

    const TERM: Duration = Duration::from_secs(4);
    const A: WorkerId = WorkerId(1);
    const B: WorkerId = WorkerId(2);

    /// A row of tiles, of which the first worker has leased all under lease 1.
    fn all_leased(tile_count: u64) -> (Leases, Vec<TileId>, Instant) {
        let grid = TileGrid::new(Size::new(tile_count * 16, 16).unwrap(), 16).unwrap();
        let mut leases = Leases::new(grid, TERM);
        #[expect(clippy::disallowed_methods, reason = "any instant will do")]
        let start = Instant::now();
        let run = leases.on_idle(A, (8, 1), 64, LeaseId(1), start).unwrap();
        assert_eq!(run.tiles.len() as u64, tile_count);
        (leases, run.tiles, start)
    }

    #[test]
    fn a_lease_without_progress_is_lost_and_its_tiles_go_to_others() {
        let (mut leases, tiles, start) = all_leased(5);
        leases.on_pixels(A, LeaseId(1), tiles[0], [0; 32], start);
        assert_eq!(leases.on_tick(start + TERM / 2), []);
        assert!(leases.on_progress(A, LeaseId(1), start + TERM / 2));
        assert_eq!(leases.on_tick(start + TERM), [], "progress renews it");

        let lost = leases.on_tick(start + TERM * 3 / 2);
        let rest = tiles[1..].to_vec();
        assert_eq!(lost, [Loss { worker: A, lease: LeaseId(1), tiles: rest.clone() }]);
        assert!(!leases.on_progress(A, LeaseId(1), start + TERM * 2));
        let run = leases.on_idle(B, (8, 1), 64, LeaseId(2), start + TERM * 2).unwrap();
        assert_eq!(run.tiles, rest);
    }

    #[test]
    fn late_pixels_of_a_lost_lease_are_the_first_copy() {
        let (mut leases, tiles, start) = all_leased(2);
        leases.on_worker_lost(A);
        assert_eq!(leases.on_pixels(A, LeaseId(1), tiles[0], [7; 32], start), Verdict::Stitch);
        let run = leases.on_idle(B, (8, 1), 64, LeaseId(2), start).unwrap();
        assert_eq!(run.tiles, tiles[1..]);
    }

    #[test]
    fn a_second_copy_is_compared_with_the_first() {
        let (mut leases, tiles, start) = all_leased(1);
        let mut deliver = |hash| leases.on_pixels(A, LeaseId(1), tiles[0], [hash; 32], start);
        assert_eq!(deliver(1), Verdict::Stitch);
        assert_eq!(deliver(1), Verdict::Duplicate);
        assert_eq!(deliver(2), Verdict::Differs([1; 32]));
    }

    #[test]
    fn a_silent_lease_is_rendered_twice_from_its_end_and_once_only() {
        let (mut leases, tiles, start) = all_leased(2);
        assert_eq!(leases.on_idle(B, (1, 1), 1, LeaseId(2), start), None);
        let later = start + SLOW;
        assert_eq!(leases.on_idle_at_the_end(B, LeaseId(2), start), Again::Wait(Some(later)));
        assert_eq!(leases.on_idle_at_the_end(A, LeaseId(2), later), Again::Wait(None));
        for (id, &tile) in (2..).zip(tiles.iter().rev()) {
            let run = Run { lease: LeaseId(id), tiles: vec![tile] };
            assert_eq!(leases.on_idle_at_the_end(B, run.lease, later), Again::Render(run));
        }
        assert_eq!(leases.on_idle_at_the_end(B, LeaseId(9), later), Again::Wait(None));

        for (id, &tile) in (2..).zip(tiles.iter().rev()) {
            leases.on_pixels(B, LeaseId(id), tile, [0; 32], later);
        }
        assert!(leases.held.is_empty() && leases.expiries.is_empty(), "nothing is left open");
    }

    #[test]
    fn runs_shorten_towards_the_end() {
        let grid = TileGrid::new(Size::new(1600, 160).unwrap(), 16).unwrap();
        let mut leases = Leases::new(grid, TERM);
        let (_, _, start) = all_leased(1);
        let lengths: Vec<usize> = (0..)
            .map_while(|id| leases.on_idle(A, (1, 4), 1000, LeaseId(id), start))
            .map(|run| run.tiles.len())
            .collect();
        assert!(lengths.is_sorted_by(|a, b| a >= b), "{lengths:?}");
        assert_eq!(lengths[0], LONGEST_RUN);
        assert_eq!(lengths.last(), Some(&1));
        assert_eq!(lengths.iter().sum::<usize>(), 1000);
    }
}
