//! Points in one place become one.

use hashbrown::{HashTable, hash_table::Entry};

use super::hash::HashFunction;

/// The bits of a point's coordinates. Points are in one place where all their bits are equal, so
/// zeros of either sign are two places.
pub(crate) type PointBits = [u64; 3];

/// Hashes points. All copies of one hasher give the same point the same hash.
#[derive(Debug, Clone)]
pub(crate) struct PointHasher {
    function: HashFunction,
}

impl PointHasher {
    /// Chooses a hasher whose hashes nobody can foresee.
    pub(crate) fn new() -> Self {
        Self { function: HashFunction::random() }
    }

    /// Hashes a point.
    #[inline(always)]
    pub(crate) fn hash(&self, point: PointBits) -> u64 {
        self.function.hash(point)
    }
}

/// Finds the first point at each place. It holds the indices of points; the points themselves are
/// kept by its owner.
#[derive(Debug)]
pub(crate) struct PointTable {
    firsts: HashTable<u32>,
    hasher: PointHasher,
}

impl PointTable {
    /// Makes an empty table that may grow to so many places without moving.
    pub(crate) fn new(hasher: PointHasher, capacity: usize) -> Self {
        Self { firsts: HashTable::with_capacity(capacity), hasher }
    }

    /// Finds the entry of a point's place: occupied by the index of the first point there, or vacant.
    /// `point_at` gives the points whose indices the table holds.
    #[inline(always)]
    pub(crate) fn entry(
        &mut self,
        point: PointBits,
        point_at: impl Fn(u32) -> PointBits,
    ) -> Entry<'_, u32> {
        self.entry_with_hash(self.hasher.hash(point), point, point_at)
    }

    /// Does the same for a point whose hash by the table's hasher is known.
    #[inline(always)]
    pub(crate) fn entry_with_hash(
        &mut self,
        hash: u64,
        point: PointBits,
        point_at: impl Fn(u32) -> PointBits,
    ) -> Entry<'_, u32> {
        let Self { firsts, hasher } = self;
        firsts.entry(hash, |&index| point_at(index) == point, |&index| hasher.hash(point_at(index)))
    }
}
