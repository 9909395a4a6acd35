//! The third step: corners in one place become one vertex.

use glam::DVec3;
use hashbrown::hash_table::Entry;
use rayon::prelude::*;

use super::{flat::FlatFaces, scale::Scaled, solid_trees::SolidTrees};
use crate::{
    exact::welding::{PointBits, PointHasher, PointTable},
    prepared::record::SphereRecord,
};

/// All faces of a scene, with the corners that they share.
pub(super) struct Welded {
    pub(super) flat: FlatFaces,
    pub(super) spheres: Vec<SphereRecord>,
    pub(super) solids: SolidTrees,
    /// For every corner of a flat face, the first corner in the same place.
    pub(super) first_corners: Vec<u32>,
}

impl Scaled {
    /// Finds the corners that faces share.
    pub(super) fn weld(self) -> Welded {
        let Self { flat, spheres, solids, .. } = self;
        let first_corners = find_first_corners(&flat.corners);
        Welded { flat, spheres, solids, first_corners }
    }
}

/// For every corner, the first corner with the same coordinates, bit for bit.
fn find_first_corners(corners: &[DVec3]) -> Vec<u32> {
    // Each thread keeps the corners of one share of all hashes; a corner's share depends on its
    // coordinates alone, so the answer does not depend on the number of shares.
    let shares = if corners.len() < 1 << 14 { 1 } else { rayon::current_num_threads() as u64 };
    let hasher = PointHasher::new();
    let hashes: Vec<u64> = corners.par_iter().map(|&corner| hasher.hash(bits_of(corner))).collect();
    let copies: Vec<Vec<(u32, u32)>> = (0..shares)
        .into_par_iter()
        .map(|share| {
            let mut table = PointTable::new(hasher.clone(), 0);
            let mut copies = Vec::new();
            for (corner, &hash) in (0_u32..).zip(&hashes) {
                if (hash >> 32) % shares != share {
                    continue;
                }
                let bits_at = |corner: u32| bits_of(corners[corner as usize]);
                match table.entry_with_hash(hash, bits_at(corner), bits_at) {
                    Entry::Occupied(first) => copies.push((corner, *first.get())),
                    Entry::Vacant(place) => {
                        place.insert(corner);
                    }
                }
            }
            copies
        })
        .collect();
    let mut firsts: Vec<u32> = (0..corners.len() as u32).collect();
    for (copy, first) in copies.into_iter().flatten() {
        firsts[copy as usize] = first;
    }
    firsts
}

fn bits_of(corner: DVec3) -> PointBits {
    corner.to_array().map(f64::to_bits)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn equal_corners_get_the_first_ones_number() {
        let corners: Vec<DVec3> =
            (0..100_000).map(|k| DVec3::new(f64::from(k % 1000), f64::from(k % 7), 0.1)).collect();
        for threads in [1, 2, 5] {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let firsts = pool.install(|| find_first_corners(&corners));
            for (corner, &first) in firsts.iter().enumerate() {
                assert_eq!(corners[corner], corners[first as usize]);
                assert_eq!(first as usize, corner % 7000);
            }
        }
    }
}
