//! Hashes of numbers for tables of indices, of which nothing that is kept depends, and of content.

use std::hash::{BuildHasher, Hasher, RandomState};

use foldhash::{SharedSeed, fast::FoldHasher};

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

/// The BLAKE3 hash of some bytes, which names their content; on rayon's threads where it is long.
pub(crate) fn content_hash(bytes: &[u8]) -> blake3::Hash {
    blake3::Hasher::new().update_rayon(bytes).finalize()
}
