//! `OpenEXR`, in blocks that are compressed apart from each other.

use std::{
    io::{self, Seek, Write},
    ops::Range,
};

use exr::{
    block::{
        self,
        chunk::{Chunk, CompressedBlock, CompressedScanLineBlock},
        writer::ChunksWriter,
    },
    compression::Compression,
    error::Error as ExrError,
    math::Vec2,
    meta::{
        BlockDescription,
        attribute::{ChannelDescription, LineOrder, SampleType, Text},
        header::Header,
    },
};
use libdeflater::{CompressionLvl, Compressor};

use crate::{Notes, Picture, pixels::Pixels};

/// Rows of a block, as the format has them for this compression.
pub(crate) const BAND_ROWS: u32 = 16;

/// Files are as small as those of zlib's level 4, and flat pictures do not get larger.
const LEVEL: i32 = 4;

/// Writes a picture of 32-bit floats, in compressed blocks of 16 rows.
pub(crate) fn encode(picture: &Picture, notes: &Notes, out: impl Write + Seek) -> io::Result<()> {
    // The format wants channels in alphabetical order.
    let channels = ["B", "G", "R"]
        .map(|name| ChannelDescription::named(Text::new_or_panic(name), SampleType::F32));
    let size = Vec2(picture.size().width() as usize, picture.size().height() as usize);
    let mut header =
        Header::new(Text::new_or_panic("rtfarm"), size, channels.into_iter().collect())
            .with_encoding(Compression::ZIP16, BlockDescription::ScanLines, LineOrder::Increasing);
    let text = |text: &String| (!text.is_empty()).then(|| Text::new_or_panic(text));
    let attributes = &mut header.own_attributes;
    (attributes.software_name, attributes.comments) =
        (text(&notes.software), text(&notes.provenance));
    block::write(out, [header].into_iter().collect(), true, |_, writer| {
        picture.each_band(|rows, compressed_pixels_le| {
            let y_coordinate = rows.start.cast_signed();
            let block = CompressedScanLineBlock { y_coordinate, compressed_pixels_le };
            let compressed_block = CompressedBlock::ScanLine(block);
            let chunk = Chunk { layer_index: 0, compressed_block };
            writer.write_chunk((rows.start / BAND_ROWS) as usize, chunk)
        })
    })
    .map_err(|error| match error {
        ExrError::Io(error) => error,
        other => io::Error::other(other),
    })
}

/// A block's bytes: compressed, or as they are where that is not longer.
///
/// Source: Academy Software Foundation, "`OpenEXR` File Layout" and `internal_zip.c` of its
/// library: the bytes with even places, then those with odd ones; each, but the first, as its difference
/// from the one before plus 128; that as a zlib stream.
pub(crate) fn pack(pixels: &Pixels, rows: Range<u32>) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    pixels.read_rows(rows, &mut bytes)?;
    let block = planes_of(&bytes, pixels.row_bytes());
    let packed = &mut bytes;
    let (even, odd) = packed.split_at_mut(block.len() / 2);
    for ((pair, even), odd) in block.chunks_exact(2).zip(even).zip(odd) {
        [*even, *odd] = [pair[0], pair[1]];
    }
    let mut before = packed[0];
    for byte in &mut packed[1..] {
        let difference = byte.wrapping_sub(before).wrapping_add(128);
        before = std::mem::replace(byte, difference);
    }
    let level = CompressionLvl::new(LEVEL).expect("it is one of libdeflate's");
    let mut compressed = vec![0; block.len() - 1];
    match Compressor::new(level).zlib_compress(packed, &mut compressed) {
        Ok(byte_count) => {
            compressed.truncate(byte_count);
            compressed.shrink_to_fit();
            Ok(compressed)
        }
        // It would not be shorter.
        Err(_) => Ok(block),
    }
}

/// The samples of rows of pixels, `[y][channel][x]`, blue first, each little-endian.
fn planes_of(rows: &[u8], row_bytes: usize) -> Vec<u8> {
    let mut planes = Vec::with_capacity(rows.len());
    for row in rows.chunks_exact(row_bytes) {
        for channel in [2, 1, 0] {
            for pixel in row.as_chunks::<12>().0 {
                planes.extend_from_slice(&pixel[channel * 4..][..4]);
            }
        }
    }
    planes
}
