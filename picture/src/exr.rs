//! `OpenEXR`, in bands of blocks.

use std::io::{self, Seek, Write};

use exr::{
    block::{self, BlockIndex, UncompressedBlock, writer::ChunksWriter},
    compression::Compression,
    math::Vec2,
    meta::{
        BlockDescription,
        attribute::{ChannelDescription, LineOrder, SampleType, Text},
        header::Header,
    },
};
use rayon::prelude::*;

use crate::{Notes, Picture};

/// Writes a picture of 32-bit floats, in compressed blocks of 16 rows; some are compressed at once.
pub(crate) fn encode(picture: &Picture, notes: &Notes, out: impl Write + Seek) -> io::Result<()> {
    const BLOCKS_AT_ONCE: usize = 8;
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
    block::write(out, [header].into_iter().collect(), true, |meta, writer| {
        let blocks: Vec<(usize, BlockIndex)> =
            block::enumerate_ordered_header_block_indices(&meta.headers).collect();
        for band in blocks.chunks(BLOCKS_AT_ONCE) {
            let chunks: Vec<_> = band
                .par_iter()
                .map(|&(place, index)| {
                    let block = UncompressedBlock { index, data: block_of(picture, index)? };
                    Ok((place, block.compress_to_chunk(&meta.headers)?))
                })
                .collect::<exr::error::Result<_>>()?;
            for (place, chunk) in chunks {
                writer.write_chunk(place, chunk)?;
            }
        }
        Ok(())
    })
    .map_err(|error| match error {
        exr::error::Error::Io(error) => error,
        other => io::Error::other(other),
    })
}

/// The samples of some rows, `[y][channel][x]`, blue first.
fn block_of(picture: &Picture, index: BlockIndex) -> io::Result<Vec<u8>> {
    let rows = picture.read_rows(index.pixel_position.1 as u32, index.pixel_size.1 as u32)?;
    let mut block = Vec::with_capacity(rows.len());
    for row in rows.chunks_exact(picture.row_bytes()) {
        for channel in [2, 1, 0] {
            for pixel in row.chunks_exact(12) {
                block.extend_from_slice(&pixel[channel * 4..][..4]);
            }
        }
    }
    Ok(block)
}
