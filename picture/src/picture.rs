//! The picture: finished tiles in a file, in the output's own number format.

use std::{
    fs::File,
    io::{self, Seek, Write},
    os::unix::fs::FileExt,
    path::Path,
};

use ::png::BitDepth;
use rtfarm_core::{
    tile::{Area, Size},
    transfer::Transfer,
};
use rustix::{
    fs::{FallocateFlags, fallocate},
    io::Errno,
};

use crate::{PictureFormat, exr, png};

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
    window: Area,
    format: PictureFormat,
    transfer: Transfer,
}

impl Picture {
    /// Makes `file`, which must be empty and open for reading and writing, a black picture of
    /// `window`, or of the whole of a frame. As a PNG it is encoded by `transfer`.
    pub fn new(
        file: File,
        window: impl Into<Area>,
        format: PictureFormat,
        transfer: Transfer,
    ) -> io::Result<Self> {
        let window = window.into();
        file.set_len(Self::byte_count(window.size(), format))?;
        Ok(Self { file, window, format, transfer })
    }

    /// Makes a black picture in a file of `folder` that has no name, so that nothing stays behind
    /// however the process ends. Its bytes are reserved: a full disk is an error now, not later.
    pub fn new_in(
        folder: &Path,
        window: impl Into<Area>,
        format: PictureFormat,
        transfer: Transfer,
    ) -> io::Result<Self> {
        let file = tempfile::tempfile_in(folder)?;
        let window = window.into();
        let byte_count = Self::byte_count(window.size(), format);
        loop {
            match fallocate(&file, FallocateFlags::empty(), 0, byte_count) {
                Ok(()) | Err(Errno::OPNOTSUPP) => break,
                Err(Errno::INTR) => {}
                Err(error) => return Err(error.into()),
            }
        }
        Self::new(file, window, format, transfer)
    }

    /// Bytes that the file of such a picture takes.
    pub fn byte_count(size: Size, format: PictureFormat) -> u64 {
        size.pixel_count() * format.bytes_per_pixel() as u64
    }

    /// The picture's size in pixels.
    pub fn size(&self) -> Size {
        self.window.size()
    }

    /// What [`Picture::encode`] writes.
    pub fn format(&self) -> PictureFormat {
        self.format
    }

    /// The curve by which a PNG is encoded.
    pub(crate) fn transfer(&self) -> Transfer {
        self.transfer
    }

    /// Writes the pixels of `area`, `[y][x]` row by row. The picture's window must have them all.
    pub fn put(&self, area: Area, pixels: &[[f32; 3]]) -> Result<(), PutError> {
        assert!(self.window.has(area), "the area is one of the picture's");
        check_pixels(area, pixels)?;
        let mut bytes = Vec::with_capacity(area.width() as usize * self.format.bytes_per_pixel());
        for (y, row) in area.rows().zip(pixels.chunks_exact(area.width() as usize)) {
            bytes.clear();
            for &pixel in row {
                self.format.append(&mut bytes, pixel, self.transfer);
            }
            let offset = self.offset(area.x0() - self.window.x0(), y - self.window.y0());
            self.file.write_all_at(&bytes, offset)?;
        }
        Ok(())
    }

    /// Writes the whole picture as a file of its format. The same picture gives the same bytes.
    /// A few bands of rows are in memory at a time.
    pub fn encode(&self, out: impl Write + Seek) -> io::Result<()> {
        match self.format {
            PictureFormat::Png8 => png::encode(self, BitDepth::Eight, out),
            PictureFormat::Png16 => png::encode(self, BitDepth::Sixteen, out),
            PictureFormat::ExrF32 => exr::encode(self, out),
        }
    }

    /// The bytes of `count` rows from `y` on.
    pub(crate) fn read_rows(&self, y: u32, count: u32) -> io::Result<Vec<u8>> {
        let mut bytes = vec![0; self.row_bytes() * count as usize];
        self.file.read_exact_at(&mut bytes, self.offset(0, y))?;
        Ok(bytes)
    }

    /// Bytes that a row takes.
    pub(crate) fn row_bytes(&self) -> usize {
        self.window.width() as usize * self.format.bytes_per_pixel()
    }

    fn offset(&self, x: u32, y: u32) -> u64 {
        let pixels = u64::from(y) * u64::from(self.window.width()) + u64::from(x);
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
            let (x, y) = area.pixel_at(index as u32);
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
            let pixels: Vec<[f32; 3]> = area.pixels().map(|(x, y)| pixel(x, y)).collect();
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
    fn an_encoded_png_says_so_and_an_exr_stays_light() {
        let srgb = |format| {
            let size = Size::new(1, 1).unwrap();
            let file = tempfile::tempfile().unwrap();
            let picture = Picture::new(file, size, format, Transfer::Srgb).unwrap();
            picture.put(Area::whole(size), &[[0.5, 7.0, -1.0]]).unwrap();
            let mut out = Cursor::new(Vec::new());
            picture.encode(&mut out).unwrap();
            out.into_inner()
        };
        for format in [PictureFormat::Png8, PictureFormat::Png16] {
            let file = srgb(format);
            let reader = ::png::Decoder::new(Cursor::new(&file)).read_info().unwrap();
            assert_eq!(reader.info().srgb, Some(::png::SrgbRenderingIntent::Perceptual));
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
        let area = Area::new(size, [1, 2], [2, 1]).unwrap();
        let error = picture.put(area, &[[0.0; 3], [0.0, f32::NAN, 0.0]]).unwrap_err();
        assert_eq!(error.to_string(), "the pixel (2, 2) is not a number");
        let error = picture.put(area, &[[0.0; 3]]).unwrap_err();
        assert_eq!(error.to_string(), "a tile of 2 pixels came with 1");
    }

    #[test]
    fn a_picture_in_a_folder_has_no_name_there() {
        let folder = tempfile::tempdir().unwrap();
        let size = Size::new(2, 1).unwrap();
        let (format, transfer) = (PictureFormat::Png8, Transfer::None);
        let picture = Picture::new_in(folder.path(), size, format, transfer).unwrap();
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
        let mut out = Cursor::new(Vec::new());
        picture.encode(&mut out).unwrap();
        let image = image::load_from_memory(out.get_ref()).unwrap().into_rgb8();
        assert_eq!(image.into_raw(), [0; 6], "it is black");
        let missing = folder.path().join("missing");
        Picture::new_in(&missing, size, format, transfer).unwrap_err();
    }
}
