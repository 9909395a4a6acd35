//! A prepared scene as bytes in memory.

use rayon::prelude::*;

use super::{
    layout::{BYTE_ORDER, HASHED_FROM, Header, MAGIC, RECORD_SIZES, Section, Sections, VERSION},
    node::Frame,
    record::{Camera, Features, Lighting},
};
use crate::exact::hash::content_hash;

/// The BLAKE3 hash of a prepared scene: its address on the farm.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct SceneHash(pub [u8; 32]);

impl std::fmt::Display for SceneHash {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&blake3::Hash::from_bytes(self.0).to_hex())
    }
}

/// A prepared scene in memory, aligned for use in place.
#[derive(Debug, Clone)]
pub struct PreparedBytes {
    lines: Vec<Line>,
    length: usize,
}

#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C, align(64))]
struct Line([u8; 64]);

impl PreparedBytes {
    /// Bytes that came from elsewhere, brought into alignment.
    pub fn copy_from(bytes: &[u8]) -> Self {
        let mut block = Self::zeroed(bytes.len());
        block.bytes_mut().copy_from_slice(bytes);
        block
    }

    /// The scene's address.
    pub fn hash(&self) -> SceneHash {
        let header: &Header = bytemuck::from_bytes(&self.as_ref()[..size_of::<Header>()]);
        SceneHash(header.hash)
    }

    pub(super) fn zeroed(length: usize) -> Self {
        Self { lines: bytemuck::zeroed_vec(length.div_ceil(64)), length }
    }

    pub(super) fn bytes_mut(&mut self) -> &mut [u8] {
        &mut bytemuck::cast_slice_mut(&mut self.lines)[..self.length]
    }
}

impl AsRef<[u8]> for PreparedBytes {
    fn as_ref(&self) -> &[u8] {
        &bytemuck::cast_slice(&self.lines)[..self.length]
    }
}

/// A thread copies so many bytes in one go.
const COPIED_AT_ONCE: usize = 1 << 20;

/// Lays the parts of a prepared scene out as one block.
pub(crate) fn assemble(
    camera: Camera,
    lighting: Lighting,
    frame: Frame,
    scale: f64,
    features: Features,
    sections: &Sections<'_>,
) -> PreparedBytes {
    let sections = sections.to_bytes();
    let mut header = Header {
        magic: MAGIC,
        version: VERSION,
        byte_order: BYTE_ORDER,
        camera: camera.with_screen_of_one(),
        lighting,
        frame,
        scale,
        features,
        ..bytemuck::Zeroable::zeroed()
    };
    let mut end = size_of::<Header>();
    for (k, section) in sections.iter().enumerate() {
        let offset = end.next_multiple_of(64);
        header.sections[k] =
            Section { offset: offset as u64, count: (section.len() / RECORD_SIZES[k]) as u64 };
        end = offset + section.len();
    }
    let mut block = PreparedBytes::zeroed(end);
    let bytes = block.bytes_mut();
    for (section, place) in sections.iter().zip(&header.sections) {
        let copy = &mut bytes[place.offset as usize..][..section.len()];
        let pieces = copy.par_chunks_mut(COPIED_AT_ONCE).zip(section.par_chunks(COPIED_AT_ONCE));
        pieces.for_each(|(copy, piece)| copy.copy_from_slice(piece));
    }
    bytes[..size_of::<Header>()].copy_from_slice(bytemuck::bytes_of(&header));
    let hash = content_hash(&bytes[HASHED_FROM..]);
    bytes[HASHED_FROM - 32..HASHED_FROM].copy_from_slice(hash.as_bytes());
    block
}
