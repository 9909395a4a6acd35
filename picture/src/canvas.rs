//! A picture under way, which may outlive its process: then a record of each tile tells the next
//! one what is in it.

use std::{fs::File, io, os::unix::fs::FileExt, path::Path, sync::Mutex};

use rtfarm_core::{
    render::Tally,
    tile::{Area, TileGrid, TileId},
    transfer::Transfer,
};

use crate::{Disk, Picture, PictureFormat, PutError, TilePixels, picture::reserve};

/// Bytes of a record. They divide a disk's sector: a power cut tears none.
const RECORD_BYTES: usize = 128;

const CHECKSUM_BYTES: usize = 16;

/// Records that are read at once.
const READ_AT_ONCE: u32 = 512;

/// What a record's first byte says.
const DONE: u8 = 1;

/// Says what the key of a picture's records is for. Another layout needs another text.
const CONTEXT: &str = "rtfarm 2026-11-26 records of tiles in a picture";

/// The names of the files in a canvas's folder.
const PICTURE: &str = "picture";
const RECORDS: &str = "tiles";

/// A picture under way. Invariant: a tile's record is written after its pixels.
#[derive(Debug)]
pub struct Canvas {
    picture: Picture,
    grid: TileGrid,
    /// What its tiles took, by number, unless records have it.
    tallies: Mutex<Vec<Tally>>,
    /// `None` when all ends with this process.
    records: Option<Records>,
}

/// One record for each tile, by its number; of a tile that is not in the picture there is none.
#[derive(Debug)]
struct Records {
    file: File,
    /// Goes into every checksum: a record of another picture is none.
    key: [u8; 32],
    disk: Disk,
}

/// What is known of a tile in a picture.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TileRecord {
    /// The hash of the pixels as they came.
    pub arrived: [u8; 32],
    /// What the tile took and how good it is.
    pub tally: Tally,
    /// Time on one thread, in seconds.
    pub seconds: f32,
    /// From the start of the rendering to this tile, in seconds in which a process was there for
    /// it.
    pub elapsed: f32,
    /// Workers that had brought tiles by then.
    pub worker_count: u32,
}

/// A tile to be put into a canvas.
#[derive(Debug, Clone, Copy)]
pub struct CanvasTile<'a> {
    /// Which one.
    pub tile: TileId,
    /// Its pixels as [`TilePixels`] has them.
    pub bytes: &'a [u8],
    /// What is known of it.
    pub record: TileRecord,
}

impl Canvas {
    /// Begins a picture in a file of `folder` that has no name: nothing stays behind.
    pub fn new_in(
        folder: &Path,
        grid: TileGrid,
        format: PictureFormat,
        transfer: Transfer,
    ) -> io::Result<Self> {
        let picture = Picture::new_in(folder, grid.window(), format, transfer)?;
        let picture = picture.packed_early(folder);
        let tallies = vec![Tally::default(); grid.count() as usize].into();
        Ok(Self { picture, grid, tallies, records: None })
    }

    /// Begins a picture that outlives its process, in two files of `folder`, whose bytes are
    /// reserved: a full disk is an error now, not later. `subject` is this picture's alone.
    pub fn create(
        folder: &Path,
        grid: TileGrid,
        (format, transfer): (PictureFormat, Transfer),
        subject: &[u8],
        disk: &Disk,
    ) -> io::Result<Self> {
        let create = |name, byte_count| -> io::Result<File> {
            let mut options = File::options();
            options.read(true).write(true).create_new(true);
            let file = disk.change(|| options.open(folder.join(name)))?;
            disk.change(|| reserve(&file, byte_count))?;
            Ok(file)
        };
        let file = create(PICTURE, Picture::byte_count(grid.window().size(), format))?;
        let picture = Picture::with(file, grid.window(), format, transfer, disk.clone());
        let picture = picture.packed_early(beside(folder));
        let file = create(RECORDS, record_offset(grid.count()))?;
        let key = blake3::derive_key(CONTEXT, subject);
        let records = Some(Records { file, key, disk: disk.clone() });
        let canvas = Self { picture, grid, tallies: Mutex::default(), records };
        canvas.sync()?;
        Ok(canvas)
    }

    /// Opens a picture that an earlier process made by [`Canvas::create`] with the same arguments.
    pub fn open(
        folder: &Path,
        grid: TileGrid,
        (format, transfer): (PictureFormat, Transfer),
        subject: &[u8],
        disk: &Disk,
    ) -> io::Result<Self> {
        let open = |name: &str, byte_count| {
            let file = File::options().read(true).write(true).open(folder.join(name));
            match file.and_then(|file| Ok((file.metadata()?.len(), file))) {
                Ok((length, file)) if length == byte_count => Ok(file),
                Ok(_) => Err(io::Error::other(format!("{name} has another length than it must"))),
                Err(error) => Err(io::Error::new(error.kind(), format!("{name}: {error}"))),
            }
        };
        let file = open(PICTURE, Picture::byte_count(grid.window().size(), format))?;
        let picture = Picture::with(file, grid.window(), format, transfer, disk.clone());
        let picture = picture.packed_early(beside(folder));
        let file = open(RECORDS, record_offset(grid.count()))?;
        let key = blake3::derive_key(CONTEXT, subject);
        let records = Some(Records { file, key, disk: disk.clone() });
        Ok(Self { picture, grid, tallies: Mutex::default(), records })
    }

    /// Says whether it outlives its process.
    pub fn is_kept(&self) -> bool {
        self.records.is_some()
    }

    /// The tiles in a picture that outlives its process. What does not match its record is not in
    /// it.
    pub fn done(&self) -> io::Result<Vec<(TileId, TileRecord)>> {
        let Some(records) = &self.records else { return Ok(Vec::new()) };
        let done = records.read(self.grid, &self.picture)?;
        let areas: Vec<Area> = done.iter().map(|&(tile, _)| self.grid.area(tile)).collect();
        self.picture.find(&areas)?;
        Ok(done)
    }

    /// What the tiles took that are in the picture. They are summed by their numbers: floats that
    /// are summed in another order give another sum.
    pub fn tally(&self) -> io::Result<Tally> {
        let mut sum = Tally::default();
        if self.records.is_none() {
            self.tallies
                .lock()
                .expect("nothing here panics")
                .iter()
                .for_each(|tally| sum.add(tally));
            return Ok(sum);
        }
        for number in 0..self.grid.count() {
            let tile = self.grid.tile(number).expect("the grid has so many tiles");
            if let Some(record) = self.record(tile)? {
                sum.add(&record.tally);
            }
        }
        Ok(sum)
    }

    /// What is kept of a tile, if it is.
    pub fn record(&self, tile: TileId) -> io::Result<Option<TileRecord>> {
        let Some(records) = &self.records else { return Ok(None) };
        let mut bytes = [0; RECORD_BYTES];
        records.file.read_exact_at(&mut bytes, record_offset(tile.number()))?;
        Ok((bytes[0] == DONE).then(|| TileRecord::from_bytes(&bytes)))
    }

    /// The picture.
    pub fn picture(&self) -> &Picture {
        &self.picture
    }

    /// How the frame is cut into tiles.
    pub fn grid(&self) -> TileGrid {
        self.grid
    }

    /// Puts tiles into the picture, then the records of those that belong to a canvas that outlives
    /// its process.
    pub fn put_all(&self, tiles: &[CanvasTile<'_>]) -> Result<(), PutError> {
        let encode = |tile: &CanvasTile<'_>| {
            let pixels = TilePixels { area: self.grid.area(tile.tile), bytes: tile.bytes };
            Ok((pixels.area, self.picture.encode_tile(&pixels)?))
        };
        let encoded: Vec<_> = tiles.iter().map(encode).collect::<Result<_, PutError>>()?;
        let Some(records) = &self.records else {
            self.picture.write(encoded)?;
            let mut tallies = self.tallies.lock().expect("nothing here panics");
            for finished in tiles {
                tallies[finished.tile.index()] = finished.record.tally;
            }
            return Ok(());
        };
        let recorded = std::iter::zip(tiles, &encoded).map(|(finished, (_, bytes))| {
            (finished.tile, finished.record.to_bytes(&records.key, finished.tile, bytes))
        });
        let recorded: Vec<_> = recorded.collect();
        self.picture.write(encoded)?;
        Ok(records.write(recorded)?)
    }

    /// Takes tiles out of the picture, which is black there then: what was put of them is not what
    /// it is to show.
    pub fn clear(&self, tiles: &[TileId]) -> Result<(), PutError> {
        if let Some(records) = &self.records {
            records.write(tiles.iter().map(|&tile| (tile, [0; RECORD_BYTES])).collect())?;
        } else {
            let mut tallies = self.tallies.lock().expect("nothing here panics");
            for tile in tiles {
                tallies[tile.index()] = Tally::default();
            }
        }
        tiles.iter().try_for_each(|&tile| self.picture.clear(self.grid.area(tile)))
    }

    /// Makes what was put so far outlive a power cut.
    pub fn sync(&self) -> io::Result<()> {
        let Some(Records { file, disk, .. }) = &self.records else { return Ok(()) };
        self.picture.sync()?;
        disk.sync(file)
    }
}

impl Records {
    /// Writes records, those of tiles with consecutive numbers at once.
    fn write(&self, mut records: Vec<(TileId, [u8; RECORD_BYTES])>) -> io::Result<()> {
        records.sort_unstable_by_key(|(tile, _)| *tile);
        for run in records.chunk_by(|(a, _), (b, _)| a.number() + 1 == b.number()) {
            let bytes: Vec<u8> = run.iter().flat_map(|(_, bytes)| *bytes).collect();
            self.disk.write_at(&self.file, &bytes, record_offset(run[0].0.number()))?;
        }
        Ok(())
    }

    /// The tiles with a record that their pixels in the picture match.
    fn read(&self, grid: TileGrid, picture: &Picture) -> io::Result<Vec<(TileId, TileRecord)>> {
        let mut done = Vec::new();
        let mut block = vec![0; RECORD_BYTES * READ_AT_ONCE as usize];
        for first in (0..grid.count()).step_by(READ_AT_ONCE as usize) {
            let count = READ_AT_ONCE.min(grid.count() - first);
            block.truncate(RECORD_BYTES * count as usize);
            self.file.read_exact_at(&mut block, record_offset(first))?;
            for (number, bytes) in (first..).zip(block.as_chunks::<RECORD_BYTES>().0) {
                let tile = grid.tile(number).expect("the grid has so many tiles");
                if bytes[0] != DONE {
                    continue;
                }
                let record = TileRecord::from_bytes(bytes);
                let pixels = picture.read_area(grid.area(tile))?;
                if record.to_bytes(&self.key, tile, &pixels) == *bytes {
                    done.push((tile, record));
                }
            }
        }
        Ok(done)
    }
}

/// Where a picture's compressed bands wait: its own folder may get another name meanwhile, and is
/// to hold nothing else.
fn beside(folder: &Path) -> &Path {
    folder.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

fn record_offset(number: u32) -> u64 {
    u64::from(number) * RECORD_BYTES as u64
}

impl TileRecord {
    /// A record as it is stored: what it says, and at its end a hash of that and of the tile's
    /// pixels as they are in the picture.
    fn to_bytes(self, key: &[u8; 32], tile: TileId, pixels: &[u8]) -> [u8; RECORD_BYTES] {
        let Self { arrived, tally, seconds, elapsed, worker_count } = self;
        let Tally { rays, samples, untraced, most_untraced, estimated, variance, capped } = tally;
        let sums = [untraced, most_untraced, variance].map(f64::to_bits);
        let mut bytes = Vec::with_capacity(RECORD_BYTES);
        bytes.extend([DONE, 0, 0, 0]);
        bytes.extend(worker_count.to_le_bytes());
        bytes.extend(seconds.to_le_bytes());
        bytes.extend(elapsed.to_le_bytes());
        bytes.extend(arrived);
        for count in [rays, samples, estimated, capped].into_iter().chain(sums) {
            bytes.extend(count.to_le_bytes());
        }
        bytes.resize(RECORD_BYTES - CHECKSUM_BYTES, 0);
        let mut hasher = blake3::Hasher::new_keyed(key);
        hasher.update(&tile.number().to_le_bytes());
        hasher.update(&bytes);
        hasher.update(pixels);
        bytes.extend(&hasher.finalize().as_bytes()[..CHECKSUM_BYTES]);
        bytes.try_into().expect("a record has its length")
    }

    /// What a record says, be it true or not.
    fn from_bytes(bytes: &[u8; RECORD_BYTES]) -> Self {
        fn field<const N: usize>(bytes: &[u8], at: usize) -> [u8; N] {
            bytes[at..at + N].try_into().expect("the field has its length")
        }
        let count = |k: usize| u64::from_le_bytes(field(bytes, 48 + 8 * k));
        Self {
            worker_count: u32::from_le_bytes(field(bytes, 4)),
            seconds: f32::from_le_bytes(field(bytes, 8)),
            elapsed: f32::from_le_bytes(field(bytes, 12)),
            arrived: field(bytes, 16),
            tally: Tally {
                rays: count(0),
                samples: count(1),
                estimated: count(2),
                capped: count(3),
                untraced: f64::from_bits(count(4)),
                most_untraced: f64::from_bits(count(5)),
                variance: f64::from_bits(count(6)),
            },
        }
    }
}

#[cfg(test)]
mod tests {
    use rtfarm_core::tile::Size;
    use tempfile::TempDir;

    use super::*;
    use crate::pixel_bytes;

    const FORMAT: (PictureFormat, Transfer) = (PictureFormat::Png16, Transfer::Srgb);
    const SUBJECT: &[u8] = b"the picture";

    fn grid() -> TileGrid {
        TileGrid::new(Size::new(40, 24).unwrap(), 16).unwrap()
    }

    fn record(tile: TileId) -> TileRecord {
        TileRecord {
            arrived: [tile.number() as u8; 32],
            tally: Tally {
                rays: 1,
                samples: 2,
                untraced: 0.3,
                most_untraced: 0.2,
                estimated: 4,
                variance: 0.5,
                capped: 6,
            },
            seconds: 0.25,
            elapsed: tile.number() as f32,
            worker_count: 3,
        }
    }

    /// Puts all tiles, as long as that goes well; answers with those that were put.
    fn put_all(folder: &Path, disk: &Disk) -> Vec<TileId> {
        let Ok(canvas) = Canvas::create(folder, grid(), FORMAT, SUBJECT, disk) else {
            return Vec::new();
        };
        let put = |&tile: &TileId| {
            let pixels = vec![[tile.number() as f32 / 9.0; 3]; grid().area(tile).pixel_count()];
            let bytes = pixel_bytes(&pixels);
            canvas.put_all(&[CanvasTile { tile, bytes, record: record(tile) }]).is_ok()
        };
        grid().render_order().into_iter().filter(put).collect()
    }

    fn reopen(folder: &Path, subject: &[u8]) -> io::Result<Vec<(TileId, TileRecord)>> {
        let mut done = Canvas::open(folder, grid(), FORMAT, subject, &Disk::default())?.done()?;
        done.sort_by_key(|(tile, _)| *tile);
        Ok(done)
    }

    fn check_done(folder: &Path, expected: &[TileId]) {
        let mut expected: Vec<_> = expected.iter().map(|&tile| (tile, record(tile))).collect();
        expected.sort_by_key(|(tile, _)| *tile);
        assert_eq!(reopen(folder, SUBJECT).unwrap(), expected);
    }

    #[test]
    fn a_process_that_stops_or_fails_at_any_change_loses_no_tile_that_was_put() {
        for disk_at in [Disk::stopping_at, Disk::failing_at] {
            for change in 0.. {
                let (folder, disk) = (TempDir::new().unwrap(), disk_at(change));
                let put = put_all(folder.path(), &disk);
                // One that was not begun whole is nobody's.
                if !put.is_empty() {
                    check_done(folder.path(), &put);
                }
                if !disk.has_failed() {
                    assert!(change > 6 + 2 * 24, "every row and every record is a change");
                    assert_eq!(put.len() as u32, grid().count());
                    break;
                }
                assert!((put.len() as u32) < grid().count(), "change {change}");
            }
        }
    }

    #[test]
    fn a_tile_whose_pixels_or_record_are_damaged_is_not_done() {
        let folder = TempDir::new().unwrap();
        let mut put = put_all(folder.path(), &Disk::default());
        put.sort();
        let damage = |name: &str, offset| {
            let file = File::options().write(true).open(folder.path().join(name)).unwrap();
            file.write_all_at(&[0xa5], offset).unwrap();
        };
        // A row has 40 pixels of 6 bytes.
        damage(PICTURE, (20 * 40 + 17) * 6);
        put.retain(|tile| tile.number() != 4);
        check_done(folder.path(), &put);
        let canvas = Canvas::open(folder.path(), grid(), FORMAT, SUBJECT, &Disk::default());
        let taken_back = put.pop().unwrap();
        let canvas = canvas.unwrap();
        let shown = || canvas.picture().read_area(grid().area(taken_back)).unwrap();
        assert!(shown().iter().any(|&byte| byte != 0));
        canvas.clear(&[taken_back]).unwrap();
        assert!(shown().iter().all(|&byte| byte == 0), "it is black");
        check_done(folder.path(), &put);
        for byte in [0, 1, 20, 100, 127] {
            damage(RECORDS, byte);
            put.retain(|tile| tile.number() != 0);
            check_done(folder.path(), &put);
        }
        assert_eq!(reopen(folder.path(), b"another").unwrap(), [], "they are another picture's");
        File::create(folder.path().join(PICTURE)).unwrap();
        let error = reopen(folder.path(), SUBJECT).unwrap_err().to_string();
        assert_eq!(error, "picture has another length than it must");
    }
}
