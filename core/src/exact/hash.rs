//! Hashes of numbers for tables of indices. What is kept does not depend on them.

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

    /// The hash of some words in their order.
    pub(crate) fn hash(&self, words: impl IntoIterator<Item = u64>) -> u64 {
        self.extend(self.start, words)
    }

    /// The hash of the words of an earlier `hash` and some more.
    pub(crate) fn extend(&self, hash: u64, words: impl IntoIterator<Item = u64>) -> u64 {
        let mut hasher = FoldHasher::with_seed(hash, &self.seed);
        words.into_iter().for_each(|word| hasher.write_u64(word));
        hasher.finish()
    }
}
