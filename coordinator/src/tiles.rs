//! The tiles of one job, from free to done.

use std::collections::BTreeSet;

use rtfarm_core::tile::{TileGrid, TileId};
use rtfarm_proto::LeaseId;

/// The hash of a tile's pixels as they travel, which covers job, scene, settings and tile too.
pub(crate) type PixelHash = [u8; 32];

/// The position of a tile in its job's order of rendering, from 0.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct Place(u32);

/// The leases that an open tile is in: its first, and that of its second rendering.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Holders([Option<LeaseId>; 2]);

/// Which tiles of a job are free, leased, being stored and done. Invariants: a tile moves from
/// open to storing to done and never back; `free` has exactly the open tiles without holders.
#[derive(Debug)]
pub(crate) struct Tiles {
    grid: TileGrid,
    /// Every tile, in the order of rendering; the index is its place.
    order: Vec<TileId>,
    /// By tile number.
    states: Vec<State>,
    free: BTreeSet<Place>,
    done_count: u32,
}

#[derive(Debug, Clone, Copy)]
enum State {
    /// No pixels have come.
    Open { place: Place, holders: Holders },
    /// Pixels with this hash have come and are not in the picture yet.
    Storing(PixelHash),
    /// Pixels with this hash are in the picture.
    Done(PixelHash),
}

/// What a tile was when pixels of it came.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Arrival {
    /// Open, in the leases of these holders: the pixels are its first and must be stored.
    First(Place, Holders),
    /// Pixels with this hash were being stored.
    WhileStoring(PixelHash),
    /// Pixels with this hash were in the picture.
    AfterDone(PixelHash),
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
        let mut states = vec![State::Storing([0; 32]); order.len()];
        for (place, tile) in (0..).map(Place).zip(&order) {
            states[tile.index()] = State::Open { place, holders: Holders::NONE };
        }
        let free = (0..grid.count()).map(Place).collect();
        Self { grid, order, states, free, done_count: 0 }
    }

    /// The frame and how it is cut into these tiles.
    pub(crate) fn grid(&self) -> TileGrid {
        self.grid
    }

    /// How many tiles are free.
    pub(crate) fn free_count(&self) -> usize {
        self.free.len()
    }

    /// How many tiles are in the picture.
    pub(crate) fn done_count(&self) -> u32 {
        self.done_count
    }

    /// The tiles at these places, in the order of rendering.
    pub(crate) fn at(&self, places: &BTreeSet<Place>) -> Vec<TileId> {
        places.iter().map(|&place| self.tile(place)).collect()
    }

    fn tile(&self, place: Place) -> TileId {
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

    /// Puts a tile that is in one lease into `lease` as well.
    pub(crate) fn share(&mut self, place: Place, lease: LeaseId) {
        let holders = self.holders_mut(place);
        let first = holders.only().expect("only a tile in one lease is rendered a second time");
        *holders = Holders([Some(first), Some(lease)]);
    }

    /// Takes an open tile out of `lease`. It is free when no other lease has it; answers with
    /// that other lease.
    pub(crate) fn give_back(&mut self, place: Place, lease: LeaseId) -> Option<LeaseId> {
        let holders = self.holders_mut(place);
        holders.0 = holders.0.map(|holder| holder.filter(|&holder| holder != lease));
        let other = holders.only();
        if other.is_none() {
            self.free.insert(place);
        }
        other
    }

    fn holders_mut(&mut self, place: Place) -> &mut Holders {
        let tile = self.tile(place);
        match &mut self.states[tile.index()] {
            State::Open { holders, .. } => holders,
            _ => unreachable!("a tile whose pixels have come is in no lease"),
        }
    }

    /// Event: pixels of `tile` came. An open tile is now being stored and in no lease; the caller
    /// tells the leases.
    pub(crate) fn on_pixels(&mut self, tile: TileId, hash: PixelHash) -> Arrival {
        let state = &mut self.states[tile.index()];
        match *state {
            State::Open { place, holders } => {
                *state = State::Storing(hash);
                self.free.remove(&place);
                Arrival::First(place, holders)
            }
            State::Storing(first) => Arrival::WhileStoring(first),
            State::Done(first) => Arrival::AfterDone(first),
        }
    }

    /// Event: the pixels of `tile` are in the picture.
    pub(crate) fn on_stored(&mut self, tile: TileId) {
        let state = &mut self.states[tile.index()];
        let State::Storing(hash) = *state else {
            unreachable!("a tile is stored once, after its pixels came");
        };
        *state = State::Done(hash);
        self.done_count += 1;
    }
}

#[cfg(test)]
impl Tiles {
    /// The leases of every open tile, by place; checks `free` against them.
    pub(crate) fn check(&self) -> Vec<(Place, Holders)> {
        let open = |state: &State| match *state {
            State::Open { place, holders } => Some((place, holders)),
            _ => None,
        };
        let open: Vec<(Place, Holders)> = self.states.iter().filter_map(open).collect();
        let free = open.iter().filter(|(_, holders)| *holders == Holders::NONE);
        let free: BTreeSet<Place> = free.map(|&(place, _)| place).collect();
        assert_eq!(free, self.free);
        open
    }
}
