//! Hashes of coordinates for tables of indices. Nobody can write a file whose hashes collide, as
//! the key differs from run to run; what is kept does not hang on it.

use std::hash::{BuildHasher, RandomState};

/// A key that cannot be foreseen.
pub(crate) fn random_key() -> u64 {
    RandomState::new().hash_one(0)
}

/// Mixes `word` into a hash: both halves of a product, which hang on all bits of both factors.
pub(crate) fn mix(hash: u64, word: u64) -> u64 {
    let product = u128::from(hash ^ word) * 0x9e37_79b9_7f4a_7c15;
    (product as u64) ^ (product >> 64) as u64
}

/// Half a hash as a whole one: tables take the place from the low bits and a tag from the high.
pub(crate) fn spread(half: u32) -> u64 {
    u64::from(half) | u64::from(half) << 32
}
