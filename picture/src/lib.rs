//! The picture: finished tiles in a file, in the output's own number format.

use std::{
    fs::File,
    io::{self, Seek, Write},
    os::unix::fs::FileExt,
};

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

use rtfarm_core::{
    tile::{Area, Size},
    transfer::Transfer,
};

/// How a picture is written. All light is on channels where 1.0 stands for 255 in a scene.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum PictureFormat {
    /// PNG with 8 bits a channel: clamped once, rounded once.
    Png8,
    /// PNG with 16 bits a channel: clamped once, rounded once.
    Png16,
    /// `OpenEXR` with 32-bit floats, never clamped.
    ExrF32,
}

impl PictureFormat {
    /// Bytes that a pixel takes in the picture's file.
    pub fn bytes_per_pixel(self) -> usize {
        match self {
            Self::Png8 => 3,
            Self::Png16 => 6,
            Self::ExrF32 => 12,
        }
    }

    /// Appends a pixel as the picture's file holds it.
    fn append(self, bytes: &mut Vec<u8>, pixel: [f32; 3], transfer: Transfer) {
        for channel in pixel {
            match self {
                Self::Png8 => bytes.push(quantize(channel, transfer, 255.0) as u8),
                // PNG has the high byte first.
                Self::Png16 => {
                    let step = quantize(channel, transfer, 65_535.0) as u16;
                    bytes.extend(step.to_be_bytes());
                }
                Self::ExrF32 => bytes.extend(channel.to_ne_bytes()),
            }
        }
    }
}

/// Clamps to `0..=1`, encodes and rounds to the nearest step, halves upwards.
fn quantize(channel: f32, transfer: Transfer, steps: f64) -> f64 {
    (transfer.encode(f64::from(channel).clamp(0.0, 1.0)) * steps + 0.5).floor()
}

/// Why a tile cannot be put into a picture.
#[derive(Debug, thiserror::Error)]
pub enum PutError {
    /// The tile has another number of pixels than its area.
    #[error("a tile of {expected} pixels came with {found}")]
    PixelCount {
        /// Pixels in the area.
        expected: usize,
        /// Pixels that came.
        found: usize,
    },
    /// A channel of this pixel is not a number.
    #[error("the pixel ({x}, {y}) is not a number")]
    NotANumber {
        /// Its column.
        x: u32,
        /// Its row.
        y: u32,
    },
    /// The file cannot be written.
    #[error("cannot write the picture's file: {0}")]
    Io(#[from] io::Error),
}

/// A picture in a file, row by row from the top left. Tiles may be put from several threads; the
/// picture itself takes no memory.
#[derive(Debug)]
pub struct Picture {
    file: File,
    size: Size,
    format: PictureFormat,
    transfer: Transfer,
}

impl Picture {
    /// Makes `file`, which must be empty and open for reading and writing, a black picture. As a
    /// PNG it is encoded by `transfer`.
    pub fn new(
        file: File,
        size: Size,
        format: PictureFormat,
        transfer: Transfer,
    ) -> io::Result<Self> {
        file.set_len(Self::byte_count(size, format))?;
        Ok(Self { file, size, format, transfer })
    }

    /// Bytes that the file of such a picture takes.
    pub fn byte_count(size: Size, format: PictureFormat) -> u64 {
        size.pixel_count() * format.bytes_per_pixel() as u64
    }

    /// The picture's size in pixels.
    pub fn size(&self) -> Size {
        self.size
    }

    /// What [`Picture::encode`] writes.
    pub fn format(&self) -> PictureFormat {
        self.format
    }

    /// Writes the pixels of `area`, `[y][x]` row by row. The area must lie inside the picture.
    pub fn put(&self, area: Area, pixels: &[[f32; 3]]) -> Result<(), PutError> {
        assert!(area.x0 + area.width <= self.size.width(), "the area is inside the picture");
        assert!(area.y0 + area.height <= self.size.height(), "the area is inside the picture");
        check_pixels(area, pixels)?;
        let mut bytes = Vec::with_capacity(area.width as usize * self.format.bytes_per_pixel());
        for (y, row) in (area.y0..).zip(pixels.chunks_exact(area.width as usize)) {
            bytes.clear();
            for &pixel in row {
                self.format.append(&mut bytes, pixel, self.transfer);
            }
            self.file.write_all_at(&bytes, self.offset(area.x0, y))?;
        }
        Ok(())
    }

    /// Writes the whole picture as a file of its format. The same picture gives the same bytes.
    /// A few bands of rows are in memory at a time.
    pub fn encode(&self, out: impl Write + Seek) -> io::Result<()> {
        match self.format {
            PictureFormat::Png8 => self.encode_png(out, png::BitDepth::Eight),
            PictureFormat::Png16 => self.encode_png(out, png::BitDepth::Sixteen),
            PictureFormat::ExrF32 => self.encode_exr(out),
        }
    }

    fn encode_png(&self, out: impl Write, depth: png::BitDepth) -> io::Result<()> {
        const CHUNK_BYTES: usize = 1 << 16;
        let mut encoder = png::Encoder::new(out, self.size.width(), self.size.height());
        encoder.set_color(png::ColorType::Rgb);
        encoder.set_depth(depth);
        encoder.set_compression(png::Compression::Fast);
        if self.transfer == Transfer::Srgb {
            encoder.set_source_srgb(png::SrgbRenderingIntent::Perceptual);
        }
        let mut writer = encoder.write_header()?;
        let mut stream = writer.stream_writer_with_size(CHUNK_BYTES)?;
        for y in 0..self.size.height() {
            stream.write_all(&self.read_rows(y, 1)?)?;
        }
        stream.finish()?;
        writer.finish()?;
        Ok(())
    }

    fn encode_exr(&self, out: impl Write + Seek) -> io::Result<()> {
        const BLOCKS_AT_ONCE: usize = 8;
        // The format wants channels in alphabetical order.
        let channels = ["B", "G", "R"]
            .map(|name| ChannelDescription::named(Text::new_or_panic(name), SampleType::F32));
        let size = Vec2(self.size.width() as usize, self.size.height() as usize);
        let header =
            Header::new(Text::new_or_panic("rtfarm"), size, channels.into_iter().collect())
                .with_encoding(
                    Compression::ZIP16,
                    BlockDescription::ScanLines,
                    LineOrder::Increasing,
                );
        block::write(out, [header].into_iter().collect(), true, |meta, writer| {
            let blocks: Vec<(usize, BlockIndex)> =
                block::enumerate_ordered_header_block_indices(&meta.headers).collect();
            for band in blocks.chunks(BLOCKS_AT_ONCE) {
                let chunks: Vec<_> = band
                    .par_iter()
                    .map(|&(place, index)| {
                        let block = UncompressedBlock { index, data: self.exr_block(index)? };
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
    fn exr_block(&self, index: BlockIndex) -> io::Result<Vec<u8>> {
        let rows = self.read_rows(index.pixel_position.1 as u32, index.pixel_size.1 as u32)?;
        let mut block = Vec::with_capacity(rows.len());
        for row in rows.chunks_exact(self.row_bytes()) {
            for channel in [2, 1, 0] {
                for pixel in row.chunks_exact(12) {
                    block.extend_from_slice(&pixel[channel * 4..][..4]);
                }
            }
        }
        Ok(block)
    }

    fn read_rows(&self, y: u32, count: u32) -> io::Result<Vec<u8>> {
        let mut bytes = vec![0; self.row_bytes() * count as usize];
        self.file.read_exact_at(&mut bytes, self.offset(0, y))?;
        Ok(bytes)
    }

    fn row_bytes(&self) -> usize {
        self.size.width() as usize * self.format.bytes_per_pixel()
    }

    fn offset(&self, x: u32, y: u32) -> u64 {
        let pixels = u64::from(y) * u64::from(self.size.width()) + u64::from(x);
        pixels * self.format.bytes_per_pixel() as u64
    }
}

/// Says why [`Picture::put`] would refuse `pixels`, whatever the state of its file.
pub fn check_pixels(area: Area, pixels: &[[f32; 3]]) -> Result<(), PutError> {
    if pixels.len() != area.pixel_count() {
        return Err(PutError::PixelCount { expected: area.pixel_count(), found: pixels.len() });
    }
    match pixels.iter().position(|pixel| pixel.iter().any(|channel| channel.is_nan())) {
        Some(index) => {
            let index = index as u32;
            let (x, y) = (area.x0 + index % area.width, area.y0 + index / area.width);
            Err(PutError::NotANumber { x, y })
        }
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use std::io::Cursor;

    use rtfarm_core::tile::TileGrid;

    use super::*;

    /// A picture put tile by tile and encoded, read back by another reader of the format.
    fn round_trip(
        size: (u64, u64),
        (format, transfer): (PictureFormat, Transfer),
        pixel: impl Fn(u32, u32) -> [f32; 3],
    ) -> image::DynamicImage {
        let size = Size::new(size.0, size.1).unwrap();
        let grid = TileGrid::new(size, 16).unwrap();
        let picture = Picture::new(tempfile::tempfile().unwrap(), size, format, transfer).unwrap();
        for tile in grid.render_order() {
            let area = grid.area(tile);
            let pixels: Vec<[f32; 3]> = (area.y0..area.y0 + area.height)
                .flat_map(|y| (area.x0..area.x0 + area.width).map(move |x| (x, y)))
                .map(|(x, y)| pixel(x, y))
                .collect();
            picture.put(area, &pixels).unwrap();
        }
        let encode = || {
            let mut out = Cursor::new(Vec::new());
            picture.encode(&mut out).unwrap();
            out.into_inner()
        };
        let bytes = encode();
        assert_eq!(bytes, encode(), "the same bytes always");
        image::load_from_memory(&bytes).unwrap()
    }

    fn ramp(x: u32, y: u32) -> [f32; 3] {
        [x as f32 / 100.0, y as f32 / 50.0, 1.0 - x as f32 / 200.0]
    }

    #[test]
    fn eight_bits_are_rounded_once() {
        let image = round_trip((101, 67), (PictureFormat::Png8, Transfer::None), ramp).into_rgb8();
        assert_eq!(image.dimensions(), (101, 67));
        for (x, y, pixel) in image.enumerate_pixels() {
            let expected = ramp(x, y).map(|c| (f64::from(c).min(1.0) * 255.0).round() as u8);
            assert_eq!(pixel.0, expected, "({x}, {y})");
        }
    }

    #[test]
    fn sixteen_bits_are_rounded_once() {
        let image = round_trip((33, 19), (PictureFormat::Png16, Transfer::None), ramp).into_rgb16();
        for (x, y, pixel) in image.enumerate_pixels() {
            let expected = ramp(x, y).map(|c| (f64::from(c).min(1.0) * 65_535.0).round() as u16);
            assert_eq!(pixel.0, expected, "({x}, {y})");
        }
    }

    #[test]
    fn floats_are_kept_bit_for_bit() {
        let wild = |x: u32, y: u32| [x as f32 * 1e30, -(y as f32), 1e-40];
        for size in [(1, 1), (101, 67), (17, 300), (300, 16)] {
            let image =
                round_trip(size, (PictureFormat::ExrF32, Transfer::None), wild).into_rgb32f();
            assert_eq!(image.dimensions(), (size.0 as u32, size.1 as u32));
            for (x, y, pixel) in image.enumerate_pixels() {
                assert_eq!(pixel.0.map(f32::to_bits), wild(x, y).map(f32::to_bits), "({x}, {y})");
            }
        }
    }

    #[test]
    fn png_is_clamped_to_its_range() {
        let wild = |_, _| [-3.0, f32::INFINITY, 1.0001];
        let image = round_trip((5, 3), (PictureFormat::Png8, Transfer::None), wild).into_rgb8();
        assert!(image.pixels().all(|pixel| pixel.0 == [0, 255, 255]));
    }

    #[test]
    fn encoding_gives_the_nearest_step() {
        for steps in [255.0, 65_535.0] {
            let count = steps as u32;
            for step in 0..count {
                let (below, above) = (f64::from(step), f64::from(step + 1));
                let found = |light: f32| quantize(light, Transfer::Srgb, steps);
                assert_eq!(found(Transfer::Srgb.decode(below / steps) as f32), below);
                // The numbers next to where the curve is half-way between two steps.
                let number = (below + 0.5) / steps;
                let middle = if number <= 0.040_45 {
                    number / 12.92
                } else {
                    libm::pow((number + 0.055) / 1.055, 2.4)
                };
                let nearest = middle as f32;
                let is_above = f64::from(nearest) > middle;
                let (low, high) = if is_above {
                    (nearest.next_down(), nearest)
                } else {
                    (nearest, nearest.next_up())
                };
                assert_eq!((found(low), found(high)), (below, above), "{step} of {count}");
            }
            assert_eq!(quantize(1.0, Transfer::Srgb, steps), steps);
        }
    }

    #[test]
    fn an_encoded_png_says_so_and_an_exr_stays_light() {
        let srgb = |format| {
            let size = Size::new(1, 1).unwrap();
            let file = tempfile::tempfile().unwrap();
            let picture = Picture::new(file, size, format, Transfer::Srgb).unwrap();
            let area = Area { x0: 0, y0: 0, width: 1, height: 1 };
            picture.put(area, &[[0.5, 7.0, -1.0]]).unwrap();
            let mut out = Cursor::new(Vec::new());
            picture.encode(&mut out).unwrap();
            out.into_inner()
        };
        for format in [PictureFormat::Png8, PictureFormat::Png16] {
            let file = srgb(format);
            let reader = png::Decoder::new(Cursor::new(&file)).read_info().unwrap();
            assert_eq!(reader.info().srgb, Some(png::SrgbRenderingIntent::Perceptual));
            // 188 of 255 is half the light of white.
            let image = image::load_from_memory(&file).unwrap();
            assert_eq!(image.into_rgb8().get_pixel(0, 0).0, [188, 255, 0]);
        }
        let image = image::load_from_memory(&srgb(PictureFormat::ExrF32)).unwrap();
        assert_eq!(image.into_rgb32f().get_pixel(0, 0).0, [0.5, 7.0, -1.0]);
    }

    #[test]
    fn what_is_no_number_or_has_a_wrong_length_is_refused() {
        let size = Size::new(4, 4).unwrap();
        let file = tempfile::tempfile().unwrap();
        let picture = Picture::new(file, size, PictureFormat::Png8, Transfer::None).unwrap();
        let area = Area { x0: 1, y0: 2, width: 2, height: 1 };
        let error = picture.put(area, &[[0.0; 3], [0.0, f32::NAN, 0.0]]).unwrap_err();
        assert_eq!(error.to_string(), "the pixel (2, 2) is not a number");
        let error = picture.put(area, &[[0.0; 3]]).unwrap_err();
        assert_eq!(error.to_string(), "a tile of 2 pixels came with 1");
    }
}
