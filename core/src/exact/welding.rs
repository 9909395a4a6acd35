//! Points in one place become one.

use hashbrown::{HashTable, hash_table::Entry};
use rayon::prelude::*;

use super::hash::{HashFunction, Repeated};

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
    fn entry_with_hash(
        &mut self,
        hash: u64,
        point: PointBits,
        point_at: impl Fn(u32) -> PointBits,
    ) -> Entry<'_, u32> {
        let Self { firsts, hasher } = self;
        firsts.entry(hash, |&index| point_at(index) == point, |&index| hasher.hash(point_at(index)))
    }
}

/// For every point, the first point in the same place, on rayon's threads.
pub(crate) fn find_firsts<P: Sync>(points: &[P], bits_of: fn(&P) -> PointBits) -> Vec<u32> {
    let hasher = PointHasher::new();
    let hashes = || points.par_iter().map(|point| hasher.hash(bits_of(point)));
    let repeated = Repeated::new(points.len(), hashes());
    let points_of_hashes: Vec<(u64, u32)> = (hashes().zip(0..points.len() as u32))
        .filter(|&(hash, _)| repeated.may_have(hash))
        .collect();
    // Each thread keeps the points of one share of all hashes; a point's share depends on its
    // coordinates alone, so the answer does not depend on the number of shares.
    let count = points_of_hashes.len();
    let shares = if count < 1 << 14 { 1 } else { rayon::current_num_threads() };
    let copies: Vec<Vec<(u32, u32)>> = (0..shares)
        .into_par_iter()
        .map(|share| {
            let mut table = PointTable::new(hasher.clone(), count / shares);
            let mut copies = Vec::new();
            for &(hash, point) in &points_of_hashes {
                if (hash >> 32) as usize % shares != share {
                    continue;
                }
                let bits_at = |point: u32| bits_of(&points[point as usize]);
                match table.entry_with_hash(hash, bits_at(point), bits_at) {
                    Entry::Occupied(first) => copies.push((point, *first.get())),
                    Entry::Vacant(place) => {
                        place.insert(point);
                    }
                }
            }
            copies
        })
        .collect();
    let mut firsts: Vec<u32> = (0..points.len() as u32).into_par_iter().collect();
    for (copy, first) in copies.into_iter().flatten() {
        firsts[copy as usize] = first;
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
            for (point, &first) in firsts.iter().enumerate() {
                assert_eq!(points[point], points[first as usize]);
                assert_eq!(first as usize, point % 7000);
            }
        }
    }
}
