//! PNG, as a stream.

use std::io::{self, Write};

use png::{BitDepth, ColorType, Compression, Encoder, SrgbRenderingIntent};
use rtfarm_core::transfer::Transfer;

use crate::{Notes, Picture};

/// Writes a picture whose bytes are those of a PNG of this depth, row by row.
pub(crate) fn encode(
    picture: &Picture,
    notes: &Notes,
    depth: BitDepth,
    out: impl Write,
) -> io::Result<()> {
    const CHUNK_BYTES: usize = 1 << 16;
    let mut encoder = Encoder::new(out, picture.size().width(), picture.size().height());
    encoder.set_color(ColorType::Rgb);
    encoder.set_depth(depth);
    encoder.set_compression(Compression::Fast);
    if picture.transfer() == Transfer::Srgb {
        encoder.set_source_srgb(SrgbRenderingIntent::Perceptual);
    }
    for (keyword, text) in [("Software", &notes.software), ("rtfarm", &notes.provenance)] {
        if !text.is_empty() {
            encoder.add_text_chunk(keyword.to_owned(), text.clone())?;
        }
    }
    let mut writer = encoder.write_header()?;
    let mut stream = writer.stream_writer_with_size(CHUNK_BYTES)?;
    for y in 0..picture.size().height() {
        stream.write_all(&picture.read_rows(y, 1)?)?;
    }
    stream.finish()?;
    writer.finish()?;
    Ok(())
}
