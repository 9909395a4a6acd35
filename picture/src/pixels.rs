//! The numbers of a picture in its file.

use std::{fs::File, io, ops::Range, os::unix::fs::FileExt, sync::Arc};

use rtfarm_core::{tile::Area, transfer::Transfer};

use crate::{PictureFormat, exr, png};

/// A picture's file, row by row from the top left, and what its bytes mean. A clone is the same
/// one.
#[derive(Debug, Clone)]
pub(crate) struct Pixels {
    file: Arc<File>,
    window: Area,
    format: PictureFormat,
    transfer: Transfer,
}

impl Pixels {
    /// Takes a file that has the length of such a picture.
    pub(crate) fn new(file: File, window: Area, format: PictureFormat, transfer: Transfer) -> Self {
        Self { file: Arc::new(file), window, format, transfer }
    }

    pub(crate) fn file(&self) -> &File {
        &self.file
    }

    pub(crate) fn window(&self) -> Area {
        self.window
    }

    pub(crate) fn format(&self) -> PictureFormat {
        self.format
    }

    pub(crate) fn transfer(&self) -> Transfer {
        self.transfer
    }

    /// Bytes that a row takes.
    pub(crate) fn row_bytes(&self) -> usize {
        self.window.width() as usize * self.format.bytes_per_pixel()
    }

    /// Appends rows of the window to `bytes`, as the file has them.
    pub(crate) fn read_rows(&self, rows: Range<u32>, bytes: &mut Vec<u8>) -> io::Result<()> {
        let at = bytes.len();
        bytes.resize(at + self.row_bytes() * rows.len(), 0);
        self.file.read_exact_at(&mut bytes[at..], self.offset(0, rows.start))
    }

    /// Where the file has a pixel of the frame.
    pub(crate) fn offset_in_frame(&self, x: u32, y: u32) -> u64 {
        self.offset(x - self.window.x0(), y - self.window.y0())
    }

    fn offset(&self, x: u32, y: u32) -> u64 {
        let pixels = u64::from(y) * u64::from(self.window.width()) + u64::from(x);
        pixels * self.format.bytes_per_pixel() as u64
    }

    /// How many bands of rows are compressed apart from each other.
    pub(crate) fn band_count(&self) -> u32 {
        self.window.height().div_ceil(self.band_rows())
    }

    /// The rows of the window that a band has.
    pub(crate) fn rows_of_band(&self, band: u32) -> Range<u32> {
        let rows = self.band_rows();
        band * rows..((band + 1) * rows).min(self.window.height())
    }

    /// The bands that have rows of an area of the frame.
    pub(crate) fn bands_of(&self, area: Area) -> Range<u32> {
        let rows = area.rows().start - self.window.y0()..area.rows().end - self.window.y0();
        rows.start / self.band_rows()..rows.end.div_ceil(self.band_rows())
    }

    fn band_rows(&self) -> u32 {
        match self.format {
            PictureFormat::Png8 | PictureFormat::Png16 => png::band_rows(self.row_bytes()),
            PictureFormat::ExrF32 => exr::BAND_ROWS,
        }
    }

    /// Compresses a band: what comes of it depends on the band's pixels alone.
    pub(crate) fn pack(&self, band: u32) -> io::Result<Vec<u8>> {
        let rows = self.rows_of_band(band);
        match self.format {
            PictureFormat::Png8 | PictureFormat::Png16 => png::pack(self, rows),
            PictureFormat::ExrF32 => exr::pack(self, rows),
        }
    }
}
