//! Reading a picture's file band by band, so that its size is not limited by memory.

use std::{
    fs::File,
    io::{self, BufReader},
    path::Path,
};

use ::exr::{
    block::{self, UncompressedBlock, reader::ChunksReader},
    error::Error as ExrError,
};
use ::png::{BitDepth, ColorType, Decoder, Limits, Reader};
use rtfarm_core::tile::Size;

use crate::{Notes, PictureFormat};

/// A picture's file that is read row by row.
pub struct PictureReader {
    size: Size,
    format: PictureFormat,
    notes: Notes,
    rows: Rows,
    /// Bytes that were read and not taken.
    waiting: Vec<u8>,
}

enum Rows {
    Png(Box<Reader<BufReader<File>>>),
    Exr(Box<dyn Iterator<Item = Result<UncompressedBlock, ExrError>>>),
}

impl PictureReader {
    /// Opens a file as this program writes them; others are refused.
    pub fn open(path: &Path) -> io::Result<Self> {
        let is_exr = path.extension().is_some_and(|end| end.eq_ignore_ascii_case("exr"));
        let file = BufReader::new(File::open(path)?);
        if is_exr { Self::open_exr(file) } else { Self::open_png(file) }
    }

    fn open_png(file: BufReader<File>) -> io::Result<Self> {
        // A row of the widest picture has less.
        let reader = Decoder::new_with_limits(file, Limits { bytes: 1 << 24 }).read_info()?;
        let info = reader.info();
        let format = match (info.color_type, info.bit_depth) {
            (ColorType::Rgb, BitDepth::Eight) => PictureFormat::Png8,
            (ColorType::Rgb, BitDepth::Sixteen) => PictureFormat::Png16,
            _ => return Err(io::Error::other("it has no three colours of 8 or 16 bits")),
        };
        let note = |keyword: &str| {
            let chunk = info.uncompressed_latin1_text.iter().find(|text| text.keyword == keyword);
            chunk.map(|text| text.text.clone()).unwrap_or_default()
        };
        let notes = Notes { software: note("Software"), provenance: note("rtfarm") };
        let size = size_of(info.width, info.height)?;
        Ok(Self { size, format, notes, rows: Rows::Png(Box::new(reader)), waiting: Vec::new() })
    }

    fn open_exr(file: BufReader<File>) -> io::Result<Self> {
        let reader = block::read(file, true).map_err(from_exr)?;
        let [header] = reader.headers() else { return Err(io::Error::other("it has layers")) };
        let names: Vec<String> =
            header.channels.list.iter().map(|channel| channel.name.to_string()).collect();
        let is_float = header
            .channels
            .list
            .iter()
            .all(|channel| channel.sample_type == ::exr::meta::attribute::SampleType::F32);
        if names != ["B", "G", "R"] || !is_float || header.deep {
            return Err(io::Error::other("it has no three colours of 32 bits"));
        }
        let text = |text: &Option<::exr::meta::attribute::Text>| {
            text.as_ref().map(ToString::to_string).unwrap_or_default()
        };
        let attributes = &header.own_attributes;
        let notes = Notes {
            software: text(&attributes.software_name),
            provenance: text(&attributes.comments),
        };
        let size = size_of(header.layer_size.0 as u32, header.layer_size.1 as u32)?;
        let chunks = reader.all_chunks(true).map_err(from_exr)?;
        let rows = Rows::Exr(Box::new(chunks.sequential_decompressor(true)));
        Ok(Self { size, format: PictureFormat::ExrF32, notes, rows, waiting: Vec::new() })
    }

    /// What the picture measures.
    pub fn size(&self) -> Size {
        self.size
    }

    /// How its numbers are written.
    pub fn format(&self) -> PictureFormat {
        self.format
    }

    /// What the file says of it.
    pub fn notes(&self) -> &Notes {
        &self.notes
    }

    /// The next `count` rows, as a [`Picture`](crate::Picture) has them.
    pub fn read_rows(&mut self, count: u32) -> io::Result<Vec<u8>> {
        let row_bytes = self.size.width() as usize * self.format.bytes_per_pixel();
        let wanted = row_bytes * count as usize;
        while self.waiting.len() < wanted {
            match &mut self.rows {
                Rows::Png(reader) => {
                    let row = reader.next_row()?.ok_or(io::ErrorKind::UnexpectedEof)?;
                    self.waiting.extend_from_slice(row.data());
                }
                Rows::Exr(blocks) => {
                    let block = blocks.next().ok_or(io::ErrorKind::UnexpectedEof)?;
                    let block = block.map_err(from_exr)?;
                    // A row has its blues, then its greens, then its reds.
                    for row in block.data.chunks_exact(row_bytes) {
                        let channel = |at: usize| row[at * row_bytes / 3..].chunks_exact(4);
                        let pixels = channel(2).zip(channel(1)).zip(channel(0));
                        for ((red, green), blue) in pixels.take(self.size.width() as usize) {
                            self.waiting.extend([red, green, blue].into_iter().flatten());
                        }
                    }
                }
            }
        }
        let rest = self.waiting.split_off(wanted);
        Ok(std::mem::replace(&mut self.waiting, rest))
    }
}

fn size_of(width: u32, height: u32) -> io::Result<Size> {
    Size::new(width.into(), height.into()).map_err(io::Error::other)
}

fn from_exr(error: ExrError) -> io::Error {
    match error {
        ExrError::Io(error) => error,
        other => io::Error::other(other),
    }
}

#[cfg(test)]
mod tests {
    use rtfarm_core::{
        tile::{Area, TileGrid},
        transfer::Transfer,
    };

    use super::*;
    use crate::Picture;

    #[test]
    fn what_was_written_is_read_row_by_row() {
        let size = Size::new(37, 45).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let notes =
            Notes { software: "a program".to_owned(), provenance: "a line\nand more\n".to_owned() };
        for (name, format) in [
            ("a.png", PictureFormat::Png8),
            ("b.png", PictureFormat::Png16),
            ("c.exr", PictureFormat::ExrF32),
        ] {
            let picture =
                Picture::new(tempfile::tempfile().unwrap(), size, format, Transfer::None).unwrap();
            let ramp = |(x, y)| [x as f32 / 40.0, y as f32 / 50.0, (x * y) as f32 / 2000.0];
            let pixels: Vec<[f32; 3]> = Area::whole(size).pixels().map(ramp).collect();
            picture.put(Area::whole(size), &pixels).unwrap();
            let path = folder.path().join(name);
            let mut file = File::create(&path).unwrap();
            picture.encode(&notes, &mut file).unwrap();

            let mut reader = PictureReader::open(&path).unwrap();
            assert_eq!((reader.size(), reader.format()), (size, format));
            assert_eq!(reader.notes(), &notes);
            let grid = TileGrid::new(size, 17).unwrap();
            for y in (0..size.height()).step_by(grid.side() as usize) {
                let count = grid.side().min(size.height() - y);
                let mut expected = Vec::new();
                picture.pixels().read_rows(y..y + count, &mut expected).unwrap();
                assert_eq!(reader.read_rows(count).unwrap(), expected);
            }
            let end = reader.read_rows(1).unwrap_err();
            assert_eq!(end.kind(), io::ErrorKind::UnexpectedEof);
        }
    }

    #[test]
    fn what_is_no_picture_of_this_program_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        for name in ["a.png", "a.exr"] {
            let path = folder.path().join(name);
            std::fs::write(&path, b"hello").unwrap();
            assert!(PictureReader::open(&path).is_err());
        }
        let path = folder.path().join("grey.png");
        image::GrayImage::new(4, 4).save(&path).unwrap();
        let refused = PictureReader::open(&path).err().unwrap();
        assert!(refused.to_string().contains("three colours"), "{refused}");
    }
}
