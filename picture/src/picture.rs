//! The picture: finished tiles in a file, in the output's own number format.

use std::{
    fs::File,
    io::{self, Seek, Write},
    ops::Range,
    os::unix::fs::FileExt,
    path::Path,
};

use ::png::BitDepth;
use rayon::prelude::*;
use rtfarm_core::{
    tile::{Area, Size},
    transfer::Transfer,
};
use rustix::{
    fs::{FallocateFlags, fallocate},
    io::Errno,
};

use crate::{
    Disk, PictureFormat,
    bands::{Bands, Change},
    exr,
    pixels::Pixels,
    png,
};

/// Why a tile cannot be put into a picture.
#[derive(Debug, thiserror::Error)]
pub enum PutError {
    /// The pixels do not fill the tile's area.
    #[error("a tile of {expected} bytes came with {found}")]
    ByteCount {
        /// Bytes that the area's pixels take.
        expected: usize,
        /// Bytes that came.
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

/// What a picture's file says of it besides its pixels. Texts are ASCII; an empty one is not
/// written.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Notes {
    /// What made it.
    pub software: String,
    /// What it depends on, and how good it is.
    pub provenance: String,
}

/// A finished tile, as it travels and as it is put into a picture.
#[derive(Debug, Clone, Copy)]
pub struct TilePixels<'a> {
    /// Where it stands.
    pub area: Area,
    /// Red, green, blue as little-endian f32, `[y][x]` row by row.
    pub bytes: &'a [u8],
}

/// Bytes of a pixel in [`TilePixels`].
pub(crate) const PIXEL_BYTES: usize = 12;

/// Bytes of rows that are compressed at once when a picture is encoded: no more than four bands for
/// each core, and no fewer than one, of up to [`CORES`].
const BYTES_AT_ONCE: usize = 4 << 20;

/// Cores that are given a band however long it is.
const CORES: usize = 8;

/// A picture in a file, row by row from the top left. Tiles may be put from several threads; the
/// picture itself takes no memory.
#[derive(Debug)]
pub struct Picture {
    pixels: Pixels,
    disk: Disk,
    /// Its bands, where they are compressed while tiles come in.
    bands: Option<Bands>,
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
        Ok(Self::with(file, window, format, transfer, Disk::default()))
    }

    /// Takes a file that has the length of such a picture.
    pub(crate) fn with(
        file: File,
        window: Area,
        format: PictureFormat,
        transfer: Transfer,
        disk: Disk,
    ) -> Self {
        Self { pixels: Pixels::new(file, window, format, transfer), disk, bands: None }
    }

    /// The same black picture, whose bands are compressed as soon as all their pixels have come,
    /// and kept in a file of `folder` that has no name. Nothing of it shows but when it is encoded.
    pub(crate) fn packed_early(self, folder: &Path) -> Self {
        Self { bands: Bands::new(&self.pixels, folder), ..self }
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
        reserve(&file, Self::byte_count(window.size(), format))?;
        Self::new(file, window, format, transfer)
    }

    /// Bytes that the file of such a picture takes.
    pub fn byte_count(size: Size, format: PictureFormat) -> u64 {
        size.pixel_count() * format.bytes_per_pixel() as u64
    }

    /// The picture's size in pixels.
    pub fn size(&self) -> Size {
        self.pixels.window().size()
    }

    /// What [`Picture::encode`] writes.
    pub fn format(&self) -> PictureFormat {
        self.pixels.format()
    }

    /// The curve by which a PNG is encoded.
    pub fn transfer(&self) -> Transfer {
        self.pixels.transfer()
    }

    #[cfg(test)]
    pub(crate) fn bands(&self) -> Option<&Bands> {
        self.bands.as_ref()
    }

    /// What its file says.
    pub(crate) fn pixels(&self) -> &Pixels {
        &self.pixels
    }

    /// Writes the pixels of `area`, `[y][x]` row by row. The picture's window must have them all.
    pub fn put(&self, area: Area, pixels: &[[f32; 3]]) -> Result<(), PutError> {
        self.put_all(&[TilePixels { area, bytes: pixel_bytes(pixels) }])
    }

    /// Writes tiles, all of which the picture's window must have. Those that stand side by side are
    /// written together, a row at a time, or all rows at once when they are as wide as the picture.
    pub fn put_all(&self, tiles: &[TilePixels<'_>]) -> Result<(), PutError> {
        let encoded = tiles.iter().map(|tile| Ok((tile.area, self.encode_tile(tile)?)));
        Ok(self.write(encoded.collect::<Result<_, PutError>>()?)?)
    }

    /// The bytes of a tile, row by row, as the picture's file holds them.
    pub(crate) fn encode_tile(&self, tile: &TilePixels<'_>) -> Result<Vec<u8>, PutError> {
        assert!(self.pixels.window().has(tile.area), "the area is one of the picture's");
        tile.check()?;
        Ok(self.format().encode(tile.bytes, self.transfer()))
    }

    /// Writes tiles as the picture's file holds them.
    pub(crate) fn write(&self, tiles: Vec<(Area, Vec<u8>)>) -> io::Result<()> {
        self.change(tiles, Change::Came)
    }

    /// Makes an area black, whose pixels are to come again.
    pub(crate) fn clear(&self, area: Area) -> Result<(), PutError> {
        let black = vec![[0.0; 3]; area.pixel_count()];
        let black = self.encode_tile(&TilePixels { area, bytes: pixel_bytes(&black) })?;
        Ok(self.change(vec![(area, black)], Change::Left)?)
    }

    /// Has pixels count as come that an earlier process put.
    pub(crate) fn find(&self, areas: &[Area]) -> io::Result<()> {
        self.bands.as_ref().map_or(Ok(()), |bands| bands.change(areas, Change::Came, || Ok(())))
    }

    fn change(&self, tiles: Vec<(Area, Vec<u8>)>, change: Change) -> io::Result<()> {
        let Some(bands) = &self.bands else { return self.write_rows(tiles) };
        let areas: Vec<Area> = tiles.iter().map(|(area, _)| *area).collect();
        bands.change(&areas, change, || self.write_rows(tiles))
    }

    fn write_rows(&self, mut tiles: Vec<(Area, Vec<u8>)>) -> io::Result<()> {
        tiles.sort_unstable_by_key(|(area, _)| (area.rows().start, area.x0()));
        let is_beside = |(left, _): &(Area, _), (right, _): &(Area, _)| {
            left.rows() == right.rows() && left.columns().end == right.x0()
        };
        let mut bytes = Vec::new();
        for side_by_side in tiles.chunk_by(is_beside) {
            let (x0, rows) = (side_by_side[0].0.x0(), side_by_side[0].0.rows());
            bytes.clear();
            for y in 0..rows.len() {
                for (_, tile) in side_by_side {
                    let row_bytes = tile.len() / rows.len();
                    bytes.extend_from_slice(&tile[y * row_bytes..][..row_bytes]);
                }
            }
            let row_bytes = bytes.len() / rows.len();
            let at_once =
                if row_bytes == self.pixels.row_bytes() { bytes.len() } else { row_bytes };
            for (y, run) in rows.zip(bytes.chunks_exact(at_once)) {
                let offset = self.pixels.offset_in_frame(x0, y);
                self.disk.write_at(self.pixels.file(), run, offset)?;
            }
        }
        Ok(())
    }

    /// The bytes of `area`, row by row.
    pub(crate) fn read_area(&self, area: Area) -> io::Result<Vec<u8>> {
        let mut bytes = vec![0; area.pixel_count() * self.format().bytes_per_pixel()];
        let row_bytes = area.width() as usize * self.format().bytes_per_pixel();
        for (y, row) in area.rows().zip(bytes.chunks_exact_mut(row_bytes)) {
            let offset = self.pixels.offset_in_frame(area.x0(), y);
            self.pixels.file().read_exact_at(row, offset)?;
        }
        Ok(bytes)
    }

    /// The bytes of some pixels of a row of the frame.
    pub(crate) fn read_row(&self, y: u32, columns: Range<u32>) -> io::Result<Vec<u8>> {
        let mut bytes = vec![0; columns.len() * self.format().bytes_per_pixel()];
        let offset = self.pixels.offset_in_frame(columns.start, y);
        self.pixels.file().read_exact_at(&mut bytes, offset)?;
        Ok(bytes)
    }

    /// Makes what was written outlive a power cut.
    pub(crate) fn sync(&self) -> io::Result<()> {
        self.disk.sync(self.pixels.file())
    }

    /// Writes the whole picture as a file of its format, which says `notes`. The same picture with
    /// the same notes gives the same bytes. A few bands of rows are in memory at a time.
    pub fn encode(&self, notes: &Notes, out: impl Write + Seek) -> io::Result<()> {
        match self.format() {
            PictureFormat::Png8 => png::encode(self, notes, BitDepth::Eight, out),
            PictureFormat::Png16 => png::encode(self, notes, BitDepth::Sixteen, out),
            PictureFormat::ExrF32 => exr::encode(self, notes, out),
        }
    }

    /// Has `write` write the bands, the uppermost first, each with its rows and compressed. While
    /// it writes some, all cores compress the next that are not kept.
    pub(crate) fn each_band<E: From<io::Error>>(
        &self,
        mut write: impl FnMut(Range<u32>, Vec<u8>) -> Result<(), E>,
    ) -> Result<(), E> {
        let pixels = &self.pixels;
        let pack = |band: u32| {
            let kept = self.bands.as_ref().and_then(|bands| bands.take(band));
            kept.map_or_else(|| pixels.pack(band), Ok)
        };
        let (count, band_bytes) =
            (pixels.band_count(), pixels.rows_of_band(0).len() * pixels.row_bytes());
        let cores = rayon::current_num_threads();
        let at_once = BYTES_AT_ONCE / band_bytes;
        let at_once = at_once.clamp(cores.min(CORES), 4 * cores) as u32;
        let pack_some = |first: u32| -> io::Result<Vec<Vec<u8>>> {
            let some = first..count.min(first + at_once);
            if some.len() == 1 {
                some.map(pack).collect()
            } else {
                some.into_par_iter().map(pack).collect()
            }
        };
        let mut packed = pack_some(0);
        for first in (0..count).step_by(at_once as usize) {
            let bands = (first..).zip(packed?);
            packed = Ok(Vec::new());
            let next = first + at_once;
            rayon::in_place_scope(|scope| {
                if next < count {
                    scope.spawn(|_| packed = pack_some(next));
                }
                bands
                    .into_iter()
                    .try_for_each(|(band, bytes)| write(pixels.rows_of_band(band), bytes))
            })?;
        }
        Ok(())
    }
}

/// Gives an empty file its length, and reserves its bytes where the file system can.
pub(crate) fn reserve(file: &File, byte_count: u64) -> io::Result<()> {
    loop {
        match fallocate(file, FallocateFlags::empty(), 0, byte_count) {
            Ok(()) => return Ok(()),
            Err(Errno::OPNOTSUPP) => return file.set_len(byte_count),
            Err(Errno::INTR) => {}
            Err(error) => return Err(error.into()),
        }
    }
}

impl TilePixels<'_> {
    /// Says why [`Picture::put_all`] would refuse these pixels, whatever the state of its file.
    pub fn check(&self) -> Result<(), PutError> {
        let Self { area, bytes } = *self;
        let (pixels, rest) = bytes.as_chunks::<PIXEL_BYTES>();
        if pixels.len() != area.pixel_count() || !rest.is_empty() {
            let expected = area.pixel_count() * PIXEL_BYTES;
            return Err(PutError::ByteCount { expected, found: bytes.len() });
        }
        match pixels.iter().position(|pixel| channels(pixel).iter().any(|light| light.is_nan())) {
            Some(index) => {
                let (x, y) = area.pixel_at(index as u32);
                Err(PutError::NotANumber { x, y })
            }
            None => Ok(()),
        }
    }
}

/// Pixels as [`TilePixels`] has them, without a copy.
pub fn pixel_bytes(pixels: &[[f32; 3]]) -> &[u8] {
    const { assert!(cfg!(target_endian = "little"), "a prepared scene and pixels travel as they are") };
    bytemuck::cast_slice(pixels)
}

/// A pixel's channels.
pub(crate) fn channels(pixel: &[u8; PIXEL_BYTES]) -> [f32; 3] {
    let channel = |index: usize| {
        f32::from_le_bytes([pixel[index], pixel[index + 1], pixel[index + 2], pixel[index + 3]])
    };
    [channel(0), channel(4), channel(8)]
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
            picture.encode(&Notes::default(), &mut out).unwrap();
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
            picture.encode(&Notes::default(), &mut out).unwrap();
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
        assert_eq!(error.to_string(), "a tile of 24 bytes came with 12");
    }

    #[test]
    fn tiles_put_together_are_where_they_were_put_one_by_one() {
        let size = Size::new(101, 67).unwrap();
        let grid = TileGrid::new(size, 16).unwrap();
        let tiles = grid.render_order();
        let pixels: Vec<Vec<[f32; 3]>> = tiles
            .iter()
            .map(|&tile| grid.area(tile).pixels().map(|(x, y)| ramp(x, y)).collect())
            .collect();
        let encoded = |format, at_once| {
            let file = tempfile::tempfile().unwrap();
            let picture = Picture::new(file, size, format, Transfer::None).unwrap();
            let tiles: Vec<TilePixels> = std::iter::zip(&tiles, &pixels)
                .map(|(&tile, pixels)| TilePixels {
                    area: grid.area(tile),
                    bytes: pixel_bytes(pixels),
                })
                .collect();
            for tiles in tiles.chunks(at_once) {
                picture.put_all(tiles).unwrap();
            }
            let mut out = Cursor::new(Vec::new());
            picture.encode(&Notes::default(), &mut out).unwrap();
            out.into_inner()
        };
        for format in [PictureFormat::Png8, PictureFormat::Png16, PictureFormat::ExrF32] {
            let one_by_one = encoded(format, 1);
            for at_once in [3, 8, tiles.len()] {
                assert!(encoded(format, at_once) == one_by_one, "{format:?}, {at_once} at once");
            }
        }
    }

    #[test]
    fn a_picture_in_a_folder_has_no_name_there() {
        let folder = tempfile::tempdir().unwrap();
        let size = Size::new(2, 1).unwrap();
        let (format, transfer) = (PictureFormat::Png8, Transfer::None);
        let picture = Picture::new_in(folder.path(), size, format, transfer).unwrap();
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
        let mut out = Cursor::new(Vec::new());
        picture.encode(&Notes::default(), &mut out).unwrap();
        let image = image::load_from_memory(out.get_ref()).unwrap().into_rgb8();
        assert_eq!(image.into_raw(), [0; 6], "it is black");
        let missing = folder.path().join("missing");
        Picture::new_in(&missing, size, format, transfer).unwrap_err();
    }
}
