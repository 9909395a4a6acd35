//! Points in one place become one.

use std::sync::atomic::{AtomicU32, Ordering};

use hashbrown::{HashTable, hash_table::Entry};
use rayon::prelude::*;

use super::hash::{HashFunction, groups_of_equal};

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

    /// Finds the entry of a point's place: occupied by the index of the first point there, or
    /// vacant. `point_at` gives the points whose indices the table holds.
    #[inline(always)]
    pub(crate) fn entry(
        &mut self,
        point: PointBits,
        point_at: impl Fn(u32) -> PointBits,
    ) -> Entry<'_, u32> {
        let Self { firsts, hasher } = self;
        let hash = hasher.hash(point);
        firsts.entry(hash, |&index| point_at(index) == point, |&index| hasher.hash(point_at(index)))
    }
}

/// For every point, the first point in the same place, on rayon's threads. There are fewer than
/// 2^32.
pub(crate) fn find_firsts<P: Sync>(points: &[P], bits_of: fn(&P) -> PointBits) -> Vec<u32> {
    let hasher = PointHasher::new();
    find_firsts_by(points, bits_of, |point| hasher.hash(point))
}

fn find_firsts_by<P: Sync>(
    points: &[P],
    bits_of: fn(&P) -> PointBits,
    hash: impl Fn(PointBits) -> u64 + Sync,
) -> Vec<u32> {
    let bits_at = |point: u32| bits_of(&points[point as usize]);
    let count = points.len() as u32;
    let firsts: Vec<AtomicU32> = (0..count).into_par_iter().map(AtomicU32::new).collect();
    let hash = |point| Some(hash(bits_at(point)));
    groups_of_equal(
        count,
        hash,
        |_| false,
        |group, _: &mut Vec<()>| {
            for &point in &group[1..] {
                firsts[point as usize].store(group[0], Ordering::Relaxed);
            }
        },
    );
    let mut firsts: Vec<u32> = firsts.into_iter().map(AtomicU32::into_inner).collect();
    // Points are compared in their own order, in which equal ones are mostly near each other in
    // memory.
    let strangers: Vec<u32> = (firsts.par_iter().zip(0..count))
        .filter(|&(&first, point)| bits_at(first) != bits_at(point))
        .map(|(_, point)| point)
        .collect();
    let mut table = PointTable::new(PointHasher::new(), strangers.len());
    for point in strangers {
        firsts[point as usize] = match table.entry(bits_at(point), bits_at) {
            Entry::Occupied(first) => *first.get(),
            Entry::Vacant(place) => *place.insert(point).get(),
        };
    }
    firsts
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn equal_points_get_the_first_ones_number() {
        let points: Vec<PointBits> = (0..100_000).map(|k| [k % 1000, k % 7, 1]).collect();
        for threads in [1, 2, 5] {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let firsts = pool.install(|| find_firsts(&points, |&point| point));
            let colliding =
                pool.install(|| find_firsts_by(&points, |&point| point, |[_, y, _]| y << 61));
            assert_eq!(firsts, colliding);
            for (point, &first) in firsts.iter().enumerate() {
                assert_eq!(points[point], points[first as usize]);
                assert_eq!(first as usize, point % 7000);
            }
        }
    }
}
