//! The bytes of a prepared scene.

use std::ops::Range;

use rtfarm_core::prepared::SECTION_NAMES;

/// Where the table of sections begins, behind the hash of all that follows it.
pub(crate) const TABLE: usize = 8 + 4 + 4 + 32;

/// The hash of the block is that of these bytes again.
pub(crate) fn hash_again(block: &mut [u8]) {
    let hash = blake3::hash(&block[TABLE..]);
    block[TABLE - 32..TABLE].copy_from_slice(hash.as_bytes());
}

/// A number of 8 bytes.
pub(crate) fn number(block: &[u8], at: usize) -> usize {
    u64::from_le_bytes(block[at..at + 8].try_into().unwrap()) as usize
}

/// Where the table has a section.
pub(crate) fn entry(name: &str) -> usize {
    let index = SECTION_NAMES.iter().position(|known| *known == name);
    TABLE + 16 * index.unwrap_or_else(|| panic!("there is no section {name}"))
}

/// The bytes of a section, and of the gap that follows it.
pub(crate) fn section(block: &[u8], name: &str) -> Range<usize> {
    let at = entry(name);
    let is_last = SECTION_NAMES.last() == Some(&name);
    number(block, at)..if is_last { block.len() } else { number(block, at + 16) }
}
