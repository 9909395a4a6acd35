//! PNG, in bands that are filtered and deflated apart from each other.

use std::{
    io::{self, Write},
    ops::Range,
};

use fdeflate::Compressor;
use png::{BitDepth, ColorType, Encoder, SrgbRenderingIntent, chunk::IDAT};
use rtfarm_core::transfer::Transfer;

use crate::{Notes, Picture, filter::RowFilter, pixels::Pixels};

/// A zlib stream whose blocks are the bands': deflate with a window of 32 KiB, made in haste.
const ZLIB_HEADER: [u8; 2] = [0x78, 0x01];

/// A last block of deflate that has nothing in it.
const EMPTY_BLOCK: [u8; 2] = [0x03, 0x00];

/// A checksum's bytes.
const ADLER_BYTES: usize = 4;

/// Filtered bytes that are compressed at once, about.
const AT_ONCE: usize = 1 << 16;

/// Rows of a band: about 1 MiB, so that what a band costs of its own, 70 bytes, is little even
/// where the picture is flat; whole tiles of 16 rows, so that few tiles are in two bands. They
/// depend on nothing but what a row takes, and the bytes of a file on them.
pub(crate) fn band_rows(row_bytes: usize) -> u32 {
    let rows = (1 << 20) / row_bytes as u32;
    if rows < 16 { rows.max(1) } else { rows / 16 * 16 }
}

/// Writes a picture whose bytes are those of a PNG of this depth, band by band.
pub(crate) fn encode(
    picture: &Picture,
    notes: &Notes,
    depth: BitDepth,
    out: impl Write,
) -> io::Result<()> {
    let mut encoder = Encoder::new(out, picture.size().width(), picture.size().height());
    encoder.set_color(ColorType::Rgb);
    encoder.set_depth(depth);
    if picture.transfer() == Transfer::Srgb {
        encoder.set_source_srgb(SrgbRenderingIntent::Perceptual);
    }
    for (keyword, text) in [("Software", &notes.software), ("rtfarm", &notes.provenance)] {
        if !text.is_empty() {
            encoder.add_text_chunk(keyword.to_owned(), text.clone())?;
        }
    }
    let mut writer = encoder.write_header()?;
    let mut checksum = 1;
    picture.each_band(|rows, mut band| {
        let of_band = band.split_off(band.len() - ADLER_BYTES);
        let of_band = u32::from_be_bytes(of_band.try_into().expect("it has so many bytes"));
        let byte_count = rows.len() as u64 * (1 + picture.pixels().row_bytes() as u64);
        checksum = join_adler32(checksum, of_band, byte_count);
        if rows.start == 0 {
            drop(band.splice(..0, ZLIB_HEADER));
        }
        if rows.end == picture.size().height() {
            band.extend(EMPTY_BLOCK);
            band.extend(checksum.to_be_bytes());
        }
        io::Result::Ok(writer.write_chunk(IDAT, &band)?)
    })?;
    writer.finish()?;
    Ok(())
}

/// A band's blocks of deflate, none of which is the last one and which refer to nothing before
/// them, up to a byte's end; then the Adler-32 of what is in them. Nor do its filters refer to the
/// rows before.
pub(crate) fn pack(pixels: &Pixels, rows: Range<u32>) -> io::Result<Vec<u8>> {
    let (row_bytes, pixel_bytes) = (pixels.row_bytes(), pixels.format().bytes_per_pixel());
    let (mut above, mut row) = (Vec::new(), Vec::new());
    let mut filter = RowFilter::default();
    let mut compressor = Compressor::new(Vec::with_capacity(rows.len() * row_bytes / 4))?;
    let byte_count = rows.len() * (1 + row_bytes);
    let mut waiting = Vec::with_capacity(byte_count.min(AT_ONCE + row_bytes));
    for y in rows.clone() {
        row.clear();
        pixels.read_rows(y..y + 1, &mut row)?;
        waiting.extend_from_slice(if y == rows.start {
            filter.filter_first(&row, pixel_bytes)
        } else {
            filter.filter(&above, &row, pixel_bytes)
        });
        // A run of zeros ends with what is compressed at once.
        if waiting.len() >= AT_ONCE {
            compressor.write_data(&waiting)?;
            waiting.clear();
        }
        std::mem::swap(&mut above, &mut row);
    }
    compressor.write_data(&waiting)?;
    open_end(compressor.finish()?)
        .ok_or_else(|| io::Error::other("the deflated band is not as fdeflate writes it"))
}

/// Takes the header off a zlib stream of one block as `fdeflate` writes it, has the block not be
/// the last one, and adds an empty stored block, which ends at a byte's end. `None` when the stream
/// is another one.
///
/// Source: Deutsch, "DEFLATE Compressed Data Format Specification", RFC 1951 (1996), section 3.2.
/// `fdeflate` has one Huffman code for everything, in which the end of a block is eight ones, three
/// zeros and a one; then come as many zeros as the last byte has room for.
fn open_end(mut stream: Vec<u8>) -> Option<Vec<u8>> {
    const END_BITS: u32 = 12;
    const END: u32 = 0x8ff;
    let checksum = stream.split_off(stream.len().checked_sub(ADLER_BYTES)?);
    let is_zlib = stream.drain(..ZLIB_HEADER.len().min(stream.len())).eq(ZLIB_HEADER);
    let first = stream.first_mut().filter(|first| is_zlib && **first & 0b111 == 0b101)?;
    *first &= !1;
    // The last bits, the very last one uppermost.
    let last = u32::from_le_bytes(*stream.last_chunk()?);
    let padding = last.leading_zeros();
    if padding > 7 || last << padding >> (u32::BITS - END_BITS) != END {
        return None;
    }
    // The head of the stored block: three zeros, then zeros to the byte's end; its length, 0, and
    // that inverted.
    if padding < 3 {
        stream.push(0);
    }
    stream.extend([0, 0, 0xff, 0xff]);
    stream.extend(checksum);
    Some(stream)
}

/// The Adler-32 of bytes that are joined: of the first, of the second, and how many the second are.
///
/// Source: Deutsch & Gailly, "ZLIB Compressed Data Format Specification", RFC 1950 (1996),
/// section 8.2: two sums modulo 65521, the first begins with 1.
fn join_adler32(first: u32, second: u32, second_byte_count: u64) -> u32 {
    const MODULUS: u64 = 65_521;
    let sums = |adler: u32| (u64::from(adler & 0xffff), u64::from(adler >> 16));
    let ((a1, b1), (a2, b2)) = (sums(first), sums(second));
    // The second part's first sum began with 1 and should have begun with `a1`: each of its bytes
    // adds so much more to the second sum.
    let missing = a1 + MODULUS - 1;
    let a = (missing + a2) % MODULUS;
    let b = (b1 + b2 + missing % MODULUS * (second_byte_count % MODULUS)) % MODULUS;
    (b << 16 | a) as u32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn checksums_are_joined() {
        let adler = |bytes: &[u8]| {
            let stream = fdeflate::compress_to_vec(bytes);
            u32::from_be_bytes(*stream.last_chunk().unwrap())
        };
        let mut rng = fastrand::Rng::with_seed(7);
        let bytes: Vec<u8> = (0..200_000).map(|_| rng.u8(..)).collect();
        for at in [0, 1, 2, 5552, 65_521, 100_000, 199_999, 200_000] {
            let (a, b) = bytes.split_at(at);
            assert_eq!(join_adler32(adler(a), adler(b), b.len() as u64), adler(&bytes), "{at}");
        }
        assert_eq!(join_adler32(1, adler(&bytes), 200_000), adler(&bytes));
    }

    #[test]
    fn bands_of_any_length_are_one_stream() {
        let mut rng = fastrand::Rng::with_seed(3);
        let (mut stream, mut bytes, mut checksum) = (ZLIB_HEADER.to_vec(), Vec::new(), 1);
        // The end of a band falls on each bit of a byte.
        for length in 0..300 {
            let most = [1, 3, 255][length % 3];
            let band: Vec<u8> = (0..length).map(|_| rng.u8(..=most)).collect();
            let mut packed = open_end(fdeflate::compress_to_vec(&band)).unwrap();
            let of_band = packed.split_off(packed.len() - ADLER_BYTES);
            let of_band = u32::from_be_bytes(of_band.try_into().unwrap());
            checksum = join_adler32(checksum, of_band, band.len() as u64);
            stream.extend(packed);
            bytes.extend(band);
        }
        stream.extend(EMPTY_BLOCK);
        stream.extend(checksum.to_be_bytes());
        assert_eq!(fdeflate::decompress_to_vec(&stream).unwrap(), bytes);
        let mut decompressor = libdeflater::Decompressor::new();
        let mut found = vec![0; bytes.len()];
        assert_eq!(decompressor.zlib_decompress(&stream, &mut found), Ok(bytes.len()));
        assert_eq!(found, bytes);
    }

    #[test]
    fn another_stream_is_not_taken_for_one_that_can_be_joined() {
        let stream = fdeflate::compress_to_vec(&[1, 2, 3]);
        assert!(open_end(stream.clone()).is_some());
        for (at, bits) in [(0, 1), (2, 1), (2, 2), (stream.len() - 5, 0xff)] {
            let mut other = stream.clone();
            other[at] ^= bits;
            assert_eq!(open_end(other), None, "{at}");
        }
        for length in 0..8 {
            assert_eq!(open_end(stream[..length].to_vec()), None);
        }
    }

    #[test]
    fn bands_depend_on_a_row_alone() {
        assert_eq!(band_rows(3), 349_520);
        assert_eq!(band_rows(2048 * 3), 160);
        assert_eq!(band_rows(4096 * 6), 32);
        assert_eq!(band_rows(65_535 * 6), 2);
    }
}
