//! Equal vertices become one.

use std::{
    collections::HashMap,
    hash::{BuildHasherDefault, Hasher},
};

use glam::DVec3;
use rayon::prelude::*;

/// For every corner, the first corner with the same coordinates, bit for bit.
pub(crate) fn weld(corners: &[DVec3]) -> Vec<u32> {
    // Each thread keeps the corners of one share of all hashes; a corner's share depends on its
    // coordinates alone, so the answer does not depend on the number of shares.
    let shares = if corners.len() < 1 << 14 { 1 } else { rayon::current_num_threads() as u64 };
    let hashes: Vec<u64> = corners.par_iter().map(hash).collect();
    let parts: Vec<Vec<(u32, u32)>> = (0..shares)
        .into_par_iter()
        .map(|share| {
            let mut first: HashMap<u64, Vec1, BuildHasherDefault<Given>> = HashMap::default();
            let mut copies = Vec::new();
            for (corner, &hash) in (0_u32..).zip(&hashes) {
                if (hash >> 32) % shares != share {
                    continue;
                }
                let same =
                    |&other: &u32| is_same(corners[corner as usize], corners[other as usize]);
                match first.entry(hash) {
                    std::collections::hash_map::Entry::Vacant(free) => {
                        free.insert(Vec1 { first: corner, rest: Vec::new() });
                    }
                    std::collections::hash_map::Entry::Occupied(mut taken) => {
                        let taken = taken.get_mut();
                        if same(&taken.first) {
                            copies.push((corner, taken.first));
                        } else if let Some(&other) = taken.rest.iter().find(|other| same(other)) {
                            copies.push((corner, other));
                        } else {
                            taken.rest.push(corner);
                        }
                    }
                }
            }
            copies
        })
        .collect();
    let mut firsts: Vec<u32> = (0..corners.len() as u32).collect();
    for (copy, first) in parts.into_iter().flatten() {
        firsts[copy as usize] = first;
    }
    firsts
}

/// Corners whose hashes agree: hardly ever more than one.
struct Vec1 {
    first: u32,
    rest: Vec<u32>,
}

fn is_same(a: DVec3, b: DVec3) -> bool {
    a.to_array().map(f64::to_bits) == b.to_array().map(f64::to_bits)
}

fn hash(corner: &DVec3) -> u64 {
    corner.to_array().into_iter().fold(0, |hash: u64, x| {
        let mixed = (hash.rotate_left(29) ^ x.to_bits()).wrapping_mul(0x9E37_79B9_7F4A_7C15);
        mixed ^ mixed >> 32
    })
}

/// Passes on a hash that was made before.
#[derive(Default)]
struct Given(u64);

impl Hasher for Given {
    fn finish(&self) -> u64 {
        self.0
    }

    fn write(&mut self, _: &[u8]) {
        unreachable!("only u64 keys")
    }

    fn write_u64(&mut self, value: u64) {
        self.0 = value;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn equal_corners_get_the_first_ones_number() {
        let corners: Vec<DVec3> =
            (0..100_000).map(|k| DVec3::new(f64::from(k % 1000), f64::from(k % 7), 0.1)).collect();
        let firsts = weld(&corners);
        for (corner, &first) in firsts.iter().enumerate() {
            assert_eq!(corners[corner], corners[first as usize]);
            assert_eq!(first as usize, corner % 7000);
        }
    }
}
