//! Hashes of numbers for tables of indices, of which nothing that is kept depends, and of content.

use std::{
    hash::{BuildHasher, Hasher, RandomState},
    ops::Range,
};

use foldhash::{SharedSeed, fast::FoldHasher};
use rayon::prelude::*;

/// A hash function that differs from run to run: nobody can write a file of which many hashes
/// collide. The seeds come from the standard library, which takes them from the system; foldhash's
/// own would come from addresses and a clock.
#[derive(Debug, Clone)]
pub(crate) struct HashFunction {
    start: u64,
    seed: SharedSeed,
}

impl HashFunction {
    /// Chooses a function that cannot be foreseen.
    pub(crate) fn random() -> Self {
        let random = RandomState::new();
        Self { start: random.hash_one(0), seed: SharedSeed::from_u64(random.hash_one(1)) }
    }

    /// Hashes some words in their order. Hashes of different counts of words have no relation.
    #[inline]
    pub(crate) fn hash<const N: usize>(&self, words: [u64; N]) -> u64 {
        self.extend(self.start, words)
    }

    /// Hashes the words of an earlier `hash` and some more.
    #[inline]
    pub(crate) fn extend<const N: usize>(&self, hash: u64, words: [u64; N]) -> u64 {
        let mut hasher = FoldHasher::with_seed(hash, &self.seed);
        // Two at once: foldhash would put single words together with many instructions.
        for pair in words.chunks(2) {
            let [low, high] = [pair[0], pair.get(1).copied().unwrap_or(0)];
            hasher.write_u128(u128::from(low) | u128::from(high) << 64);
        }
        hasher.finish()
    }
}

/// Finds the indices below `count` whose hashes are equal, on rayon's threads: `tell` is called
/// with those of each hash that two or more have, or that one has which `may_be_alone`, in
/// ascending order, and adds what follows from them to a list. The lists come in the order of the
/// hashes. Leading bits have to be as good as random, and only 32 of them and a few more are
/// compared: now and then indices come together whose hashes are nearly equal.
///
/// Most vertices, triangles and planes of large meshes have no equal; these are found by bits, one
/// in 16 or fewer of which are set, and are not sorted.
///
/// Sources: Bloom, "Space/Time Trade-offs in Hash Coding with Allowable Errors" (1970), with one
/// function of one hash; shared out into parts that fit the nearest cache as by Manegold, Boncz &
/// Kersten, "Optimizing Main-Memory Join on Modern Hardware" (2002).
pub(crate) fn groups_of_equal<R: Send>(
    count: u32,
    hash: impl Fn(u32) -> Option<u64> + Sync,
    may_be_alone: impl Fn(u32) -> bool + Sync,
    tell: impl Fn(&[u32], &mut Vec<R>) + Sync,
) -> Vec<Vec<R>> {
    let bits = (count as usize / PART).max(1).ilog2().min(11);
    let starts = (0..count).into_par_iter().step_by(RUN);
    let runs: Vec<Run> = starts
        .map(|start| Run::new(start..count.min(start.saturating_add(RUN as u32)), &hash, bits))
        .collect();
    let of_part = |part: usize| {
        let mut keys = Vec::with_capacity(2 * PART);
        for run in &runs {
            keys.extend_from_slice(run.part(part));
        }
        let places = (16 * keys.len()).next_power_of_two().clamp(64, 1 << 20);
        let place = |key: u64| (key >> (64 - places.trailing_zeros())) as usize;
        let (mut seen, mut repeated) = (vec![0_u64; places / 64], vec![0_u64; places / 64]);
        for &key in &keys {
            let (word, bit) = (place(key) / 64, 1 << (place(key) % 64));
            repeated[word] |= seen[word] & bit;
            seen[word] |= bit;
        }
        keys.retain(|&key| {
            let is_repeated = repeated[place(key) / 64] >> (place(key) % 64) & 1 == 1;
            is_repeated || may_be_alone(key as u32)
        });
        keys.sort_unstable();
        let (mut told, mut group) = (Vec::new(), Vec::new());
        for keys in keys.chunk_by(|a, b| a >> 32 == b >> 32) {
            if keys.len() > 1 || may_be_alone(keys[0] as u32) {
                group.clear();
                group.extend(keys.iter().map(|&key| key as u32));
                tell(&group, &mut told);
            }
        }
        told
    };
    (0..1 << bits).into_par_iter().map(of_part).collect()
}

/// About so many hashes are looked at together.
const PART: usize = 2048;

/// So many hashes are shared out into parts in one go.
const RUN: usize = 1 << 15;

/// The hashes of a run of indices, shared out by their leading bits.
struct Run {
    /// Part by part the next 32 bits of each hash, then the index.
    keys: Vec<u64>,
    /// Where each part ends.
    ends: Vec<u32>,
}

impl Run {
    fn new(indices: Range<u32>, hash: impl Fn(u32) -> Option<u64>, bits: u32) -> Self {
        let hashes: Vec<(usize, u64)> = indices
            .filter_map(|index| {
                let hash = hash(index)?;
                let key = hash << bits >> 32 << 32 | u64::from(index);
                Some(((hash.rotate_left(bits) & ((1 << bits) - 1)) as usize, key))
            })
            .collect();
        let mut ends = vec![0; 1 << bits];
        for (part, _) in &hashes {
            ends[*part] += 1;
        }
        let mut end = 0;
        for count in &mut ends {
            // First it is where the part begins.
            end += std::mem::replace(count, end);
        }
        let mut keys = vec![0; hashes.len()];
        for (part, key) in hashes {
            keys[ends[part] as usize] = key;
            ends[part] += 1;
        }
        Self { keys, ends }
    }

    fn part(&self, part: usize) -> &[u64] {
        let start = part.checked_sub(1).map_or(0, |before| self.ends[before]);
        &self.keys[start as usize..self.ends[part] as usize]
    }
}

/// The BLAKE3 hash of some bytes, which names their content; on rayon's threads where it is long.
pub(crate) fn content_hash(bytes: &[u8]) -> blake3::Hash {
    blake3::Hasher::new().update_rayon(bytes).finalize()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn equal_hashes_come_together_in_their_order() {
        let function = HashFunction { start: 7, seed: SharedSeed::from_u64(9) };
        for count in [0, 1, 2, 20, 100_000] {
            // Every tenth is there twice, and every seventh is left out.
            let hash = |k: u32| {
                let number = if k.is_multiple_of(10) { k / 20 } else { k + count };
                (!k.is_multiple_of(7)).then(|| function.hash([number.into()]))
            };
            let is_marked = |k: u32| k % 50 == 1;
            for threads in [1, 2, 5] {
                let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
                let groups = pool.install(|| {
                    groups_of_equal(count, hash, is_marked, |group, told| told.push(group.to_vec()))
                });
                let groups = groups.concat();
                let mut expected: Vec<(u64, Vec<u32>)> = (0..count)
                    .filter(|&k| k % 20 == 0 || is_marked(k))
                    .map(|k| if is_marked(k) { vec![k] } else { vec![k, k + 10] })
                    .map(|group| group.into_iter().filter(|&k| k < count && k % 7 != 0).collect())
                    .filter(|group: &Vec<u32>| {
                        group.len() > 1 || group.first().is_some_and(|&k| is_marked(k))
                    })
                    .map(|group| (hash(group[0]).unwrap(), group))
                    .collect();
                expected.sort_unstable();
                assert!(groups.iter().eq(expected.iter().map(|(_, group)| group)), "{count}");
            }
        }
    }

    #[test]
    fn one_hash_for_all_is_one_group() {
        let groups = groups_of_equal(
            100_000,
            |_| Some(u64::MAX),
            |_| false,
            |group, told| {
                told.push(group.len());
            },
        );
        assert_eq!(groups.concat(), [100_000]);
    }
}
