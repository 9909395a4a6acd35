//! The tiles of one job, from free to done.

use std::collections::{BTreeMap, BTreeSet};

use rtfarm_core::tile::{TileGrid, TileId};
use rtfarm_proto::{LeaseId, WorkerId};

/// A tile with which so many workers were lost is set aside.
pub(crate) const MOST_LOSSES: u32 = 3;

/// The hash of a tile's pixels as they travel, which covers job, scene, settings and tile too.
pub(crate) type PixelHash = [u8; 32];

/// What a worker made of a tile.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Rendering {
    pub(crate) worker: WorkerId,
    pub(crate) hash: PixelHash,
}

/// The position of a tile in its job's order of rendering, from 0.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct Place(u32);

/// The leases that an open tile is in: its first, and that of its second rendering.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Holders([Option<LeaseId>; 2]);

/// Which tiles of a job are free, leased, being stored and done. Invariants: a tile moves from open
/// to storing to done, and back only when its worker is known to lie; each open tile without
/// holders is in exactly one of `free`, `suspects` and `aside`, by its losses.
#[derive(Debug)]
pub(crate) struct Tiles {
    grid: TileGrid,
    /// Every tile, in the order of rendering; the index is its place.
    order: Vec<TileId>,
    by_number: Vec<Tile>,
    free: BTreeSet<Place>,
    /// Free tiles that may have been the end of a worker: each is rendered by one that has no
    /// other.
    suspects: BTreeSet<Place>,
    /// Tiles that nobody is to render any more.
    aside: BTreeSet<Place>,
    /// Open tiles that were in work when their worker was lost or they stood still, and how often.
    losses: BTreeMap<Place, u32>,
    done_count: u32,
}

#[derive(Debug, Clone, Copy)]
struct Tile {
    place: Place,
    state: State,
}

#[derive(Debug, Clone, Copy)]
enum State {
    /// No pixels have come.
    Open(Holders),
    /// These have come and are not in the picture yet.
    Storing(Rendering),
    /// These are in the picture, confirmed by another worker or not.
    Done { rendering: Rendering, is_confirmed: bool },
}

/// What a tile was when pixels of it came.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Arrival {
    /// Open, in the leases of these holders: the pixels are its first and must be stored.
    First(Place, Holders),
    /// These were being stored.
    WhileStoring(Rendering),
    /// These were in the picture.
    AfterDone(Rendering),
}

impl Holders {
    const NONE: Self = Self([None; 2]);

    /// The leases, one after the other.
    pub(crate) fn iter(self) -> impl Iterator<Item = LeaseId> {
        self.0.into_iter().flatten()
    }

    /// The lease, when there is exactly one.
    fn only(self) -> Option<LeaseId> {
        match self.0 {
            [Some(only), None] | [None, Some(only)] => Some(only),
            _ => None,
        }
    }
}

impl Tiles {
    /// Makes all tiles of `grid`, each of them free.
    pub(crate) fn new(grid: TileGrid) -> Self {
        let order = grid.render_order();
        let open = Tile { place: Place(0), state: State::Open(Holders::NONE) };
        let mut by_number = vec![open; order.len()];
        for (place, tile) in (0..).map(Place).zip(&order) {
            by_number[tile.index()].place = place;
        }
        let free = (0..grid.count()).map(Place).collect();
        let (suspects, aside, losses) = (BTreeSet::new(), BTreeSet::new(), BTreeMap::new());
        Self { grid, order, by_number, free, suspects, aside, losses, done_count: 0 }
    }

    /// Says of a free tile that pixels with this hash are in the picture already.
    pub(crate) fn set_done(&mut self, tile: TileId, hash: PixelHash) {
        // Of a worker of an earlier start of the farm: it has no number now.
        self.on_pixels(tile, Rendering { worker: WorkerId(0), hash });
        self.on_stored(tile);
    }

    /// The frame and how it is cut into these tiles.
    pub(crate) fn grid(&self) -> TileGrid {
        self.grid
    }

    /// How many tiles are free, and are under no suspicion.
    pub(crate) fn free_count(&self) -> usize {
        self.free.len()
    }

    /// Says whether a free tile is under suspicion of being the end of workers.
    pub(crate) fn has_suspect(&self) -> bool {
        !self.suspects.is_empty()
    }

    /// Tiles that were set aside, in the order of rendering.
    pub(crate) fn aside(&self) -> Vec<TileId> {
        self.at(&self.aside)
    }

    /// Says whether each tile is in the picture or was set aside.
    pub(crate) fn is_over(&self) -> bool {
        self.done_count as usize + self.aside.len() == self.order.len()
    }

    /// How many tiles are in the picture.
    pub(crate) fn done_count(&self) -> u32 {
        self.done_count
    }

    /// Says whether a tile is in the picture.
    pub(crate) fn is_done(&self, tile: TileId) -> bool {
        matches!(self.by_number[tile.index()].state, State::Done { .. })
    }

    /// The tiles at these places, in the order of rendering.
    pub(crate) fn at(&self, places: &BTreeSet<Place>) -> Vec<TileId> {
        places.iter().map(|&place| self.tile(place)).collect()
    }

    /// The tile at a place.
    pub(crate) fn tile(&self, place: Place) -> TileId {
        self.order[place.0 as usize]
    }

    /// Puts the first `count` free tiles, or as many as there are, into `lease`.
    pub(crate) fn take_free(&mut self, count: usize, lease: LeaseId) -> BTreeSet<Place> {
        let places: BTreeSet<Place> = self.free.iter().copied().take(count).collect();
        for &place in &places {
            self.free.remove(&place);
            *self.holders_mut(place) = Holders([Some(lease), None]);
        }
        places
    }

    /// Says whether no pixels of a tile have come, or what came was taken back.
    pub(crate) fn is_open(&self, tile: TileId) -> bool {
        matches!(self.by_number[tile.index()].state, State::Open(_))
    }

    /// Puts those of these tiles that are free into `lease`.
    pub(crate) fn take(&mut self, tiles: &[TileId], lease: LeaseId) -> BTreeSet<Place> {
        let mut taken = BTreeSet::new();
        for tile in tiles {
            let Tile { place, state } = &mut self.by_number[tile.index()];
            if self.free.remove(place) {
                *state = State::Open(Holders([Some(lease), None]));
                taken.insert(*place);
            }
        }
        taken
    }

    /// Puts the first free tile that is under suspicion into `lease`.
    pub(crate) fn take_suspect(&mut self, lease: LeaseId) -> Option<Place> {
        let place = self.suspects.pop_first()?;
        *self.holders_mut(place) = Holders([Some(lease), None]);
        Some(place)
    }

    /// Puts a tile that is in one lease into `lease` as well.
    pub(crate) fn share(&mut self, place: Place, lease: LeaseId) {
        let holders = self.holders_mut(place);
        let first = holders.only().expect("only a tile in one lease is rendered a second time");
        *holders = Holders([Some(first), Some(lease)]);
    }

    /// Puts an open tile under suspicion: it was in work when its worker was lost, or it stood
    /// still.
    pub(crate) fn suspect(&mut self, place: Place) {
        *self.losses.entry(place).or_default() += 1;
    }

    /// Takes an open tile out of `lease`. When no other lease has it, it is free, or set aside
    /// after too many losses; answers with that other lease.
    pub(crate) fn give_back(&mut self, place: Place, lease: LeaseId) -> Option<LeaseId> {
        let holders = self.holders_mut(place);
        holders.0 = holders.0.map(|holder| holder.filter(|&holder| holder != lease));
        let other = holders.only();
        if other.is_none() {
            let set = match self.losses.get(&place) {
                None => &mut self.free,
                Some(..MOST_LOSSES) => &mut self.suspects,
                Some(_) => &mut self.aside,
            };
            set.insert(place);
        }
        other
    }

    fn holders_mut(&mut self, place: Place) -> &mut Holders {
        let tile = self.tile(place);
        match &mut self.by_number[tile.index()].state {
            State::Open(holders) => holders,
            _ => unreachable!("a tile whose pixels have come is in no lease"),
        }
    }

    /// Where a tile stands in the order of rendering.
    pub(crate) fn place(&self, tile: TileId) -> Place {
        self.by_number[tile.index()].place
    }

    /// Event: pixels of `tile` came. An open tile is now being stored and in no lease; the caller
    /// tells the leases.
    pub(crate) fn on_pixels(&mut self, tile: TileId, rendering: Rendering) -> Arrival {
        let Tile { place, state } = &mut self.by_number[tile.index()];
        match *state {
            State::Open(holders) => {
                *state = State::Storing(rendering);
                for set in [&mut self.free, &mut self.suspects, &mut self.aside] {
                    set.remove(place);
                }
                self.losses.remove(place);
                Arrival::First(*place, holders)
            }
            State::Storing(first) => Arrival::WhileStoring(first),
            State::Done { rendering: first, .. } => Arrival::AfterDone(first),
        }
    }

    /// Event: the pixels of `tile` are in the picture.
    pub(crate) fn on_stored(&mut self, tile: TileId) {
        let state = &mut self.by_number[tile.index()].state;
        let State::Storing(rendering) = *state else {
            unreachable!("a tile is stored once, after its pixels came");
        };
        *state = State::Done { rendering, is_confirmed: false };
        self.done_count += 1;
    }

    /// Event: another worker made the same of a tile.
    pub(crate) fn confirm(&mut self, tile: TileId) {
        if let State::Done { is_confirmed, .. } = &mut self.by_number[tile.index()].state {
            *is_confirmed = true;
        }
    }

    /// Frees every tile that is not in the picture, and those that are but are `wrong`. Nobody
    /// holds any, or is to hold it.
    pub(crate) fn reopen(&mut self, wrong: &BTreeSet<TileId>) {
        (self.suspects, self.aside, self.losses) = Default::default();
        for (&id, place) in self.order.iter().zip((0..).map(Place)) {
            let state = &mut self.by_number[id.index()].state;
            let is_done = matches!(state, State::Done { .. });
            if !is_done || wrong.contains(&id) {
                *state = State::Open(Holders::NONE);
                self.free.insert(place);
                self.done_count -= u32::from(is_done);
            }
        }
    }

    /// Frees the tiles in the picture that `worker` rendered and no other confirmed.
    pub(crate) fn take_back(&mut self, worker: WorkerId) -> Vec<TileId> {
        let mut taken = Vec::new();
        for (&id, place) in self.order.iter().zip((0..).map(Place)) {
            let state = &mut self.by_number[id.index()].state;
            if let State::Done { rendering, is_confirmed: false } = state
                && rendering.worker == worker
            {
                *state = State::Open(Holders::NONE);
                self.free.insert(place);
                taken.push(id);
            }
        }
        self.done_count -= taken.len() as u32;
        taken
    }
}

#[cfg(test)]
impl Tiles {
    /// The leases of every open tile, by place; checks the sets of those that are in none.
    pub(crate) fn check(&self) -> Vec<(Place, Holders)> {
        let open = |tile: &Tile| match tile.state {
            State::Open(holders) => Some((tile.place, holders)),
            _ => None,
        };
        let open: Vec<(Place, Holders)> = self.by_number.iter().filter_map(open).collect();
        let [mut free, mut suspects, mut aside] = [(); 3].map(|()| BTreeSet::new());
        for &(place, _) in open.iter().filter(|(_, holders)| *holders == Holders::NONE) {
            match self.losses.get(&place) {
                None => free.insert(place),
                Some(..MOST_LOSSES) => suspects.insert(place),
                Some(_) => aside.insert(place),
            };
        }
        assert_eq!([&free, &suspects, &aside], [&self.free, &self.suspects, &self.aside]);
        let is_open = |place: &Place| open.iter().any(|(open, _)| open == place);
        assert!(self.losses.keys().all(is_open));
        open
    }
}

#[cfg(test)]
mod tests {
    use rtfarm_core::tile::Size;

    use super::*;

    #[test]
    fn what_another_worker_confirmed_is_not_taken_back() {
        let grid = TileGrid::new(Size::new(48, 16).unwrap(), 16).unwrap();
        let (mut tiles, ids) = (Tiles::new(grid), [0, 1, 2].map(|tile| grid.tile(tile).unwrap()));
        for (tile, worker) in ids.into_iter().zip([1, 1, 2].map(WorkerId)) {
            tiles.on_pixels(tile, Rendering { worker, hash: [7; 32] });
            tiles.on_stored(tile);
        }
        tiles.confirm(ids[0]);
        assert_eq!(tiles.take_back(WorkerId(1)), [ids[1]]);
        assert_eq!((tiles.done_count(), tiles.free_count()), (2, 1));
        tiles.check();
    }
}
