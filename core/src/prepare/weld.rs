//! The third step: corners in one place become one vertex.

use glam::DVec3;
use hashbrown::hash_table::Entry;
use rayon::prelude::*;

use super::{flat::FlatFaces, scale::Scaled, solid_trees::SolidTrees};
use crate::{
    exact::welding::{PointBits, PointHasher, PointTable},
    prepared::record::SphereRecord,
};

/// All faces of a scene; corners in one place have one point.
pub(super) struct Welded {
    pub(super) flat: FlatFaces,
    pub(super) spheres: Vec<SphereRecord>,
    pub(super) solids: SolidTrees,
}

impl Scaled {
    /// Finds the corners that faces share.
    pub(super) fn weld(self) -> Welded {
        let Self { mut flat, spheres, solids, .. } = self;
        let firsts = find_firsts(&flat.points);
        flat.corners.par_iter_mut().for_each(|corner| *corner = firsts[*corner as usize]);
        Welded { flat, spheres, solids }
    }
}

/// For every point, the first point with the same coordinates, bit for bit.
fn find_firsts(points: &[DVec3]) -> Vec<u32> {
    // Each thread keeps the points of one share of all hashes; a point's share depends on its
    // coordinates alone, so the answer does not depend on the number of shares.
    let shares = if points.len() < 1 << 14 { 1 } else { rayon::current_num_threads() as u64 };
    let hasher = PointHasher::new();
    let hashes: Vec<u64> = points.par_iter().map(|&point| hasher.hash(bits_of(point))).collect();
    let copies: Vec<Vec<(u32, u32)>> = (0..shares)
        .into_par_iter()
        .map(|share| {
            let mut table = PointTable::new(hasher.clone(), 0);
            let mut copies = Vec::new();
            for (point, &hash) in (0_u32..).zip(&hashes) {
                if (hash >> 32) % shares != share {
                    continue;
                }
                let bits_at = |point: u32| bits_of(points[point as usize]);
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
    let mut firsts: Vec<u32> = (0..points.len() as u32).collect();
    for (copy, first) in copies.into_iter().flatten() {
        firsts[copy as usize] = first;
    }
    firsts
}

fn bits_of(point: DVec3) -> PointBits {
    point.to_array().map(f64::to_bits)
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
            let firsts = pool.install(|| find_firsts(&corners));
            for (corner, &first) in firsts.iter().enumerate() {
                assert_eq!(corners[corner], corners[first as usize]);
                assert_eq!(first as usize, corner % 7000);
            }
        }
    }
}
