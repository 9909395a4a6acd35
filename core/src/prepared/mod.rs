//! The prepared scene: one flat, position-independent, versioned, checksummed block of bytes that
//! is built once and mapped by every process that renders from it.
//!
//! The block is a header and sections of plain records, each section aligned to 64 bytes.
//! Coordinates are the scene's times a power of two that brings the largest of them into 0.5..1,
//! so that no scale can overflow or underflow and a scaled scene gives the same bits. Loading
//! checks every index, bound and number once; after that nothing is checked twice.

pub(crate) mod bytes;
mod check;
pub(crate) mod face;
pub(crate) mod layout;
pub(crate) mod node;
pub(crate) mod record;
pub(crate) mod solid_tree;

pub use bytes::{PreparedBytes, SceneHash};
#[doc(hidden)]
pub use layout::SECTION_NAMES;

use self::layout::{BYTE_ORDER, HASHED_FROM, Header, MAGIC, RECORD_SIZES, Sections, VERSION, View};
use crate::exact::hash::content_hash;

/// Why bytes are no prepared scene.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum PreparedError {
    /// Too short, another file type, or another version.
    #[error("not a prepared scene of this version: {0}")]
    Foreign(&'static str),
    /// The bytes are not those that were written.
    #[error("a damaged prepared scene: its hash does not match")]
    Damaged,
    /// A record that no scene leads to.
    #[error("a malformed prepared scene: {0}")]
    Malformed(&'static str),
}

/// A prepared scene whose every index, bound and number has been checked.
#[derive(Debug)]
pub struct PreparedScene<B> {
    bytes: B,
}

impl<B: AsRef<[u8]>> PreparedScene<B> {
    /// Checks `bytes`, which must be aligned to 64 (as [`PreparedBytes`] and memory maps are), and
    /// makes them usable. No bytes whatever can make a later reader go out of bounds, loop or meet
    /// a NaN. Their hash is made on rayon's threads.
    pub fn open(bytes: B) -> Result<Self, PreparedError> {
        Self::open_by(bytes, content_hash)
    }

    /// [`PreparedScene::open`] on this thread alone, calling `on_step` after every 16 MiB, some 10
    /// ms of work.
    pub fn open_in_steps(bytes: B, on_step: &mut dyn FnMut()) -> Result<Self, PreparedError> {
        Self::open_by(bytes, |data| {
            let mut hasher = blake3::Hasher::new();
            for step in data.chunks(1 << 24) {
                hasher.update(step);
                on_step();
            }
            hasher.finalize()
        })
    }

    fn open_by(bytes: B, hash: impl FnOnce(&[u8]) -> blake3::Hash) -> Result<Self, PreparedError> {
        let data = bytes.as_ref();
        let header = data.get(..size_of::<Header>()).ok_or(PreparedError::Foreign("too short"))?;
        let header: &Header = bytemuck::try_from_bytes(header)
            .map_err(|_| PreparedError::Foreign("not aligned in memory"))?;
        if header.magic != MAGIC || header.version != VERSION || header.byte_order != BYTE_ORDER {
            return Err(PreparedError::Foreign("another kind, version or byte order"));
        }
        if hash(&data[HASHED_FROM..]) != header.hash {
            return Err(PreparedError::Damaged);
        }
        for (section, size) in header.sections.iter().zip(RECORD_SIZES) {
            let end = (section.count.checked_mul(size as u64))
                .and_then(|length| length.checked_add(section.offset));
            if section.offset % 64 != 0 || end.is_none_or(|end| end > data.len() as u64) {
                return Err(PreparedError::Malformed("a section out of bounds"));
            }
        }
        let scene = Self { bytes };
        check::check(&scene.view()).map_err(PreparedError::Malformed)?;
        Ok(scene)
    }

    /// The scene's address.
    pub fn hash(&self) -> SceneHash {
        SceneHash(self.view().header.hash)
    }

    /// How many bytes the block has.
    pub fn byte_count(&self) -> usize {
        self.bytes.as_ref().len()
    }

    pub(crate) fn view(&self) -> View<'_> {
        let data = self.bytes.as_ref();
        let header: &Header = bytemuck::from_bytes(&data[..size_of::<Header>()]);
        let mut sections = header.sections.iter().zip(RECORD_SIZES).map(|(section, size)| {
            let offset = section.offset as usize;
            &data[offset..offset + section.count as usize * size]
        });
        let sections = std::array::from_fn(|_| sections.next().expect("as many as there are"));
        View { header, sections: Sections::from_bytes(sections) }
    }
}
