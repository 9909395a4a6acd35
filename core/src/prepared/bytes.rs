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
        let mut lines = Vec::new();
        push_bytes(&mut lines, bytes);
        Self { lines, length: bytes.len() }
    }

    /// Bytes that `read` puts into places, of which it is told where among all `length` they begin;
    /// it is called on rayon's threads.
    pub fn read<E: Send>(
        length: usize,
        read: impl Fn(&mut [u8], usize) -> Result<(), E> + Sync,
    ) -> Result<Self, E> {
        let empty = (0..length.div_ceil(64)).into_par_iter().with_min_len(COPIED_AT_ONCE);
        let mut block = Self { lines: empty.map(|_| Line([0; 64])).collect(), length };
        let piece = 64 * COPIED_AT_ONCE;
        let pieces = block.bytes_mut().par_chunks_mut(piece).enumerate();
        pieces.try_for_each(|(k, place)| read(place, k * piece))?;
        Ok(block)
    }

    /// The scene's address.
    pub fn hash(&self) -> SceneHash {
        let header: &Header = bytemuck::from_bytes(&self.as_ref()[..size_of::<Header>()]);
        SceneHash(header.hash)
    }

    fn bytes_mut(&mut self) -> &mut [u8] {
        &mut bytemuck::cast_slice_mut(&mut self.lines)[..self.length]
    }
}

impl AsRef<[u8]> for PreparedBytes {
    fn as_ref(&self) -> &[u8] {
        &bytemuck::cast_slice(&self.lines)[..self.length]
    }
}

/// A thread copies at least so many lines in one go.
const COPIED_AT_ONCE: usize = 1 << 13;

/// Adds bytes, and zeros to the end of a line, on rayon's threads: each clears and fills pages of
/// its own.
fn push_bytes(lines: &mut Vec<Line>, bytes: &[u8]) {
    let (whole, rest) = bytes.as_chunks();
    lines.par_extend(whole.par_iter().with_min_len(COPIED_AT_ONCE).map(|&line| Line(line)));
    if !rest.is_empty() {
        let mut last = [0; 64];
        last[..rest.len()].copy_from_slice(rest);
        lines.push(Line(last));
    }
}

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
    let mut lines = Vec::with_capacity(end.div_ceil(64));
    push_bytes(&mut lines, bytemuck::bytes_of(&header));
    for section in sections {
        push_bytes(&mut lines, section);
    }
    let mut block = PreparedBytes { lines, length: end };
    let bytes = block.bytes_mut();
    let hash = content_hash(&bytes[HASHED_FROM..]);
    bytes[HASHED_FROM - 32..HASHED_FROM].copy_from_slice(hash.as_bytes());
    block
}
