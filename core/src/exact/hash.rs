//! Hashes of numbers for tables of indices, of which nothing that is kept depends, and of content.

use std::{
    hash::{BuildHasher, Hasher, RandomState},
    sync::atomic::{AtomicU64, Ordering},
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

/// Tells which of some hashes may stand among them twice: all that do, and a few of the others. Most
/// vertices, triangles and planes of large meshes have no equal, and need not be sorted or put into tables.
///
/// Source: Bloom, "Space/Time Trade-offs in Hash Coding with Allowable Errors" (1970), with one
/// function of one hash.
pub(crate) struct Repeated {
    bits: Vec<AtomicU64>,
    /// The leading bits of a hash are its place.
    shift: u32,
}

impl Repeated {
    /// Looks at `count` hashes, whose leading bits are as good as random, on rayon's threads.
    pub(crate) fn new(count: usize, hashes: impl ParallelIterator<Item = u64>) -> Self {
        // So many bits that one hash in 16 or fewer has its place together with another.
        let places = (16 * count).next_power_of_two().max(64);
        let bits = || -> Vec<AtomicU64> { (0..places / 64).map(|_| AtomicU64::new(0)).collect() };
        let (seen, repeated) = (bits(), Self { bits: bits(), shift: 64 - places.trailing_zeros() });
        hashes.for_each(|hash| {
            let (word, bit) = repeated.place(hash);
            if seen[word].fetch_or(bit, Ordering::Relaxed) & bit != 0 {
                repeated.bits[word].fetch_or(bit, Ordering::Relaxed);
            }
        });
        repeated
    }

    /// Whether a hash may be there twice.
    #[inline]
    pub(crate) fn may_have(&self, hash: u64) -> bool {
        let (word, bit) = self.place(hash);
        self.bits[word].load(Ordering::Relaxed) & bit != 0
    }

    #[inline]
    fn place(&self, hash: u64) -> (usize, u64) {
        let place = (hash >> self.shift) as usize;
        (place / 64, 1 << (place % 64))
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
    fn all_hashes_that_are_there_twice_are_found_and_few_others() {
        let function = HashFunction { start: 7, seed: SharedSeed::from_u64(9) };
        let hashes: Vec<u64> = (0..100_000)
            .map(|k| function.hash([if k % 10 == 0 { k / 20 } else { k + 100_000 }]))
            .collect();
        let repeated = Repeated::new(hashes.len(), hashes.par_iter().copied());
        let found = |k: &usize| repeated.may_have(hashes[*k]);
        assert!((0..100_000).step_by(10).all(|k| found(&k)));
        let others = (0..100_000).filter(|k| k % 10 != 0).filter(found).count();
        assert!(others < 90_000 / 16, "{others}");
        let none = Repeated::new(0, rayon::iter::empty());
        assert!(!none.may_have(u64::MAX));
    }
}
