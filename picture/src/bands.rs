//! A picture's bands are compressed while its tiles come in, and wait on disk until it is written.

use std::{
    collections::VecDeque,
    fs::File,
    io,
    ops::Range,
    os::unix::fs::FileExt,
    path::{Path, PathBuf},
    sync::{Arc, LazyLock, Mutex, MutexGuard},
};

use rayon::{ThreadPool, ThreadPoolBuilder};
use rtfarm_core::tile::Area;

use crate::pixels::Pixels;

/// A picture with less is encoded at once when it is asked for.
const LEAST_BYTES: u64 = 1 << 20;

/// What threads may hold of one picture at a time.
const MOST_BYTES_IN_WORK: usize = 64 << 20;

/// The threads that compress, of all pictures together. Whatever else wants a core goes before
/// them: what they leave is compressed when the picture is asked for. Without threads, all is.
static PACKERS: LazyLock<Option<ThreadPool>> = LazyLock::new(|| {
    let name = |number| format!("packer {number}");
    ThreadPoolBuilder::new().thread_name(name).start_handler(|_| stand_back()).build().ok()
});

/// Has all others go before the calling thread.
fn stand_back() {
    #[cfg(target_os = "linux")]
    {
        // There it is the thread's own and not its process's. Without it, it is a thread like
        // others.
        let _ = rustix::process::nice(19);
    }
}

/// The bands of a picture under way. Invariant: what is kept of a band is what its rows are.
///
/// A band is compressed when all its pixels have come and nobody is writing to it. Each write
/// makes what was kept of its bands stale before it begins, so it does not matter whether "all have
/// come" is right: that says when it is worth while.
#[derive(Debug)]
pub(crate) struct Bands {
    shared: Arc<Shared>,
}

#[derive(Debug)]
struct Shared {
    pixels: Pixels,
    /// Where the file is made that keeps bands.
    folder: PathBuf,
    state: Mutex<State>,
}

#[derive(Debug, Default)]
struct State {
    bands: Vec<Band>,
    /// Bands to be compressed, the first first, and some that are not any more.
    waiting: VecDeque<u32>,
    /// Threads that compress.
    packers: usize,
    /// Compressed bands, one behind the other, also stale ones. It has no name.
    file: Option<Arc<File>>,
    file_bytes: u64,
    /// Nobody will ask for the picture any more.
    is_over: bool,
}

#[derive(Debug)]
struct Band {
    /// Pixels that have not come.
    missing: u64,
    /// Writes under way.
    writers: u32,
    /// Writes that began.
    version: u64,
    is_waiting: bool,
    /// Where the file has it.
    kept: Option<(u64, usize)>,
}

/// What a write does to the pixels of an area.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Change {
    /// They have come.
    Came,
    /// They are to come again.
    Left,
}

impl Bands {
    /// Bands of a picture none of whose pixels count as come yet, to be kept in a file of `folder`;
    /// `None` when the picture is small.
    pub(crate) fn new(pixels: &Pixels, folder: &Path) -> Option<Self> {
        let byte_count = pixels.row_bytes() as u64 * u64::from(pixels.window().height());
        if byte_count < LEAST_BYTES {
            return None;
        }
        let band = |band| Band {
            missing: pixels.rows_of_band(band).len() as u64 * u64::from(pixels.window().width()),
            writers: 0,
            version: 0,
            is_waiting: false,
            kept: None,
        };
        let bands = (0..pixels.band_count()).map(band).collect();
        let state = Mutex::new(State { bands, ..State::default() });
        let shared = Shared { pixels: pixels.clone(), folder: folder.to_owned(), state };
        Some(Self { shared: Arc::new(shared) })
    }

    /// Has `write` write to these areas.
    pub(crate) fn change<T>(
        &self,
        areas: &[Area],
        change: Change,
        write: impl FnOnce() -> io::Result<T>,
    ) -> io::Result<T> {
        let pixels = &self.shared.pixels;
        let touched = || {
            areas.iter().flat_map(|&area| {
                let count =
                    move |band| pixel_count(&pixels.rows_of_band(band), pixels.window(), area);
                pixels.bands_of(area).map(move |band| (band, count(band)))
            })
        };
        {
            let mut state = self.shared.state();
            for (index, _) in touched() {
                let band = &mut state.bands[index as usize];
                band.writers += 1;
                band.version += 1;
                band.kept = None;
            }
        }
        let written = write();
        let state = &mut *self.shared.state();
        for (index, count) in touched() {
            let band = &mut state.bands[index as usize];
            band.writers -= 1;
            match change {
                Change::Came if written.is_ok() => {
                    band.missing = band.missing.saturating_sub(count);
                }
                Change::Came => {}
                Change::Left => band.missing += count,
            }
            if band.missing == 0 && band.writers == 0 && !band.is_waiting {
                band.is_waiting = true;
                state.waiting.push_back(index);
            }
        }
        self.shared.start_packers(state);
        written
    }

    /// What is kept of a band, which is not compressed early any more unless somebody writes to
    /// it. The caller compresses it where nothing is kept.
    pub(crate) fn take(&self, index: u32) -> Option<Vec<u8>> {
        let (file, (offset, byte_count)) = {
            let mut state = self.shared.state();
            let band = &mut state.bands[index as usize];
            band.is_waiting = false;
            let kept = band.kept?;
            (state.file.clone()?, kept)
        };
        let mut bytes = vec![0; byte_count];
        file.read_exact_at(&mut bytes, offset).ok()?;
        Some(bytes)
    }
}

impl Drop for Bands {
    fn drop(&mut self) {
        self.shared.state().is_over = true;
    }
}

impl Shared {
    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().expect("nothing that holds it panics")
    }

    /// Has as many threads compress as there are bands, cores and memory for.
    fn start_packers(self: &Arc<Self>, state: &mut State) {
        if state.packers >= state.waiting.len() {
            return;
        }
        let Some(pool) = &*PACKERS else { return };
        // Rows as they are, as they are compressed, and the result.
        let rows = self.pixels.rows_of_band(0).len();
        let most = MOST_BYTES_IN_WORK / (3 * rows * self.pixels.row_bytes());
        let most = most.clamp(1, pool.current_num_threads()).min(state.waiting.len());
        while state.packers < most {
            state.packers += 1;
            let shared = Arc::clone(self);
            pool.spawn(move || shared.pack_bands());
        }
    }

    fn pack_bands(&self) {
        while let Some((index, version)) = self.next() {
            // Who encodes the picture meets the same error, and tells of it.
            if let Ok(bytes) = self.pixels.pack(index) {
                self.keep(index, version, &bytes);
            }
        }
    }

    /// The next band to be compressed; without one, the caller is a packer no more.
    fn next(&self) -> Option<(u32, u64)> {
        let state = &mut *self.state();
        while let Some(index) = state.waiting.pop_front().filter(|_| !state.is_over) {
            let band = &mut state.bands[index as usize];
            // Who writes to it has it wait again.
            if std::mem::take(&mut band.is_waiting) && band.writers == 0 {
                return Some((index, band.version));
            }
        }
        state.packers -= 1;
        None
    }

    /// Keeps a band, unless it was written to since it had this version. A disk that is full only
    /// makes the end later.
    fn keep(&self, index: u32, version: u64, bytes: &[u8]) {
        let is_current = |state: &State| {
            let band = &state.bands[index as usize];
            band.version == version && !state.is_over
        };
        let (file, offset) = {
            let mut state = self.state();
            // With bands that are written again and again it does not grow without end.
            let all = self.pixels.row_bytes() as u64 * u64::from(self.pixels.window().height());
            if !is_current(&state) || state.file_bytes + bytes.len() as u64 > 2 * all {
                return;
            }
            let file = if let Some(file) = &state.file {
                Arc::clone(file)
            } else {
                let Ok(file) = tempfile::tempfile_in(&self.folder) else { return };
                Arc::clone(state.file.insert(Arc::new(file)))
            };
            let offset = state.file_bytes;
            state.file_bytes += bytes.len() as u64;
            (file, offset)
        };
        if file.write_all_at(bytes, offset).is_ok() {
            let mut state = self.state();
            if is_current(&state) {
                state.bands[index as usize].kept = Some((offset, bytes.len()));
            }
        }
    }
}

/// How many pixels of an area stand in these rows of the window.
fn pixel_count(rows: &Range<u32>, window: Area, area: Area) -> u64 {
    let [start, end] = [area.rows().start, area.rows().end].map(|y| y - window.y0());
    u64::from(end.min(rows.end) - start.max(rows.start)) * u64::from(area.width())
}

#[cfg(test)]
impl Bands {
    /// Waits until nothing is left to be compressed; answers how many bands are kept.
    pub(crate) fn settle(&self) -> usize {
        while self.shared.state().packers > 0 {
            std::thread::yield_now();
        }
        self.shared.state().bands.iter().filter(|band| band.kept.is_some()).count()
    }
}

#[cfg(test)]
mod tests {
    use std::io::Cursor;

    use rtfarm_core::{
        tile::{Size, TileGrid, TileId},
        transfer::Transfer,
    };

    use super::*;
    use crate::{Notes, Picture, PictureFormat};

    const FORMATS: [PictureFormat; 3] =
        [PictureFormat::Png8, PictureFormat::Png16, PictureFormat::ExrF32];

    /// Several bands of each format, the last of them narrower, and tiles that lie across bands.
    fn grid() -> TileGrid {
        TileGrid::new(Size::new(1000, 1090).unwrap(), 72).unwrap()
    }

    /// Something flat, something smooth and noise.
    fn pixel(x: u32, y: u32) -> [f32; 3] {
        if x < 300 {
            [0.25, 0.5, 1.0]
        } else if x < 600 {
            [x as f32 / 1000.0, y as f32 / 1100.0, (x + y) as f32 / 3000.0]
        } else {
            let mut rng = fastrand::Rng::with_seed(u64::from(y) << 32 | u64::from(x));
            [rng.f32(), rng.f32(), rng.f32()]
        }
    }

    fn put(picture: &Picture, tile: TileId) {
        let area = grid().area(tile);
        let pixels: Vec<[f32; 3]> = area.pixels().map(|(x, y)| pixel(x, y)).collect();
        picture.put(area, &pixels).unwrap();
    }

    fn encoded(picture: &Picture) -> Vec<u8> {
        let mut out = Cursor::new(Vec::new());
        picture.encode(&Notes::default(), &mut out).unwrap();
        out.into_inner()
    }

    fn picture_of(format: PictureFormat) -> Picture {
        let file = tempfile::tempfile().unwrap();
        Picture::new(file, grid().window(), format, Transfer::None).unwrap()
    }

    /// What a picture is to be that nobody compressed early.
    fn expected(format: PictureFormat) -> Vec<u8> {
        let picture = picture_of(format);
        grid().render_order().into_iter().for_each(|tile| put(&picture, tile));
        encoded(&picture)
    }

    fn settle(picture: &Picture) -> usize {
        picture.bands().unwrap().settle()
    }

    #[test]
    fn any_order_of_tiles_and_any_number_of_threads_give_the_same_file() {
        for format in FORMATS {
            let expected = expected(format);
            for (seed, threads) in [(1, 1), (2, 5)] {
                let folder = tempfile::tempdir().unwrap();
                let picture = picture_of(format).packed_early(folder.path());
                let mut rng = fastrand::Rng::with_seed(seed);
                let mut tiles = grid().render_order();
                rng.shuffle(&mut tiles);
                let wrong = tiles[..20].to_vec();
                let taken_back = tiles[10..40].to_vec();
                let pool = ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
                pool.scope(|scope| {
                    for &tile in &tiles {
                        let (picture, wrong) = (&picture, &wrong);
                        scope.spawn(move |_| {
                            if wrong.contains(&tile) {
                                let area = grid().area(tile);
                                picture.put(area, &vec![[9.0; 3]; area.pixel_count()]).unwrap();
                            }
                            put(picture, tile);
                        });
                    }
                    // One that is fetched under way.
                    scope.spawn(|_| drop(encoded(&picture)));
                });
                for &tile in &taken_back {
                    picture.clear(grid().area(tile)).unwrap();
                }
                assert!(encoded(&picture) != expected, "{format:?}, {seed}: some are missing");
                pool.scope(|scope| {
                    for &tile in &taken_back {
                        let picture = &picture;
                        scope.spawn(move |_| put(picture, tile));
                    }
                });
                // At once, whatever is kept by now, and when all is kept.
                assert!(pool.install(|| encoded(&picture)) == expected, "{format:?}, {seed}");
                grid().render_order().into_iter().for_each(|tile| put(&picture, tile));
                assert_eq!(settle(&picture), picture.pixels().band_count() as usize);
                assert!(pool.install(|| encoded(&picture)) == expected, "{format:?}, {seed}");
                assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0, "it has no name");
            }
        }
    }

    #[test]
    fn a_band_is_compressed_when_its_last_tile_comes_and_anew_when_one_is_replaced() {
        let folder = tempfile::tempdir().unwrap();
        for format in FORMATS {
            let expected = expected(format);
            let picture = picture_of(format).packed_early(folder.path());
            let all = picture.pixels().band_count() as usize;
            let mut tiles = grid().render_order();
            tiles.sort_unstable();
            let (last, others) = tiles.split_last().unwrap();
            for row in others.chunks(grid().columns() as usize) {
                for &tile in row {
                    put(&picture, tile);
                }
            }
            // The last tile's rows are in these.
            let lacking = picture.pixels().bands_of(grid().area(*last)).len();
            assert_eq!(settle(&picture), all - lacking, "{format:?}");
            put(&picture, *last);
            assert_eq!(settle(&picture), all);
            assert!(encoded(&picture) == expected);

            let area = grid().area(tiles[17]);
            picture.put(area, &vec![[0.5; 3]; area.pixel_count()]).unwrap();
            assert!(encoded(&picture) != expected, "it shows what was put last");
            settle(&picture);
            assert!(encoded(&picture) != expected, "it shows what was put last");
            picture.clear(area).unwrap();
            let lacking = picture.pixels().bands_of(area).len();
            assert_eq!(settle(&picture), all - lacking, "{format:?}");
            put(&picture, tiles[17]);
            assert!(encoded(&picture) == expected);
        }
    }

    #[test]
    fn a_band_does_not_depend_on_the_one_above() {
        let folder = tempfile::tempdir().unwrap();
        for format in FORMATS {
            let picture = picture_of(format).packed_early(folder.path());
            for band in (0..picture.pixels().band_count()).rev() {
                let rows = picture.pixels().rows_of_band(band);
                let size = grid().window().size();
                let sides = [size.width(), rows.len() as u32];
                let area = Area::new(size, [0, rows.start], sides).unwrap();
                let pixels: Vec<[f32; 3]> = area.pixels().map(|(x, y)| pixel(x, y)).collect();
                picture.put(area, &pixels).unwrap();
                settle(&picture);
            }
            assert!(encoded(&picture) == expected(format), "{format:?}");
        }
    }

    #[test]
    fn bands_that_cannot_be_kept_are_compressed_at_the_end() {
        let folder = tempfile::tempdir().unwrap();
        let missing = folder.path().join("missing");
        let picture = picture_of(PictureFormat::Png16).packed_early(&missing);
        grid().render_order().into_iter().for_each(|tile| put(&picture, tile));
        assert_eq!(settle(&picture), 0);
        assert!(encoded(&picture) == expected(PictureFormat::Png16));
        let small = Area::whole(Size::new(300, 300).unwrap());
        let file = tempfile::tempfile().unwrap();
        let small = Picture::new(file, small, PictureFormat::Png8, Transfer::None).unwrap();
        assert!(small.packed_early(folder.path()).bands().is_none(), "it is not worth while");
    }

    #[test]
    fn other_readers_find_the_pixels_and_files_are_no_larger_than_those_of_other_writers() {
        for format in FORMATS {
            let file = expected(format);
            let image = image::load_from_memory(&file).unwrap();
            let (size, at) = (grid().window().size(), |x, y| pixel(x, y));
            assert_eq!((image.width(), image.height()), (size.width(), size.height()));
            let other = match format {
                PictureFormat::ExrF32 => {
                    for (x, y, found) in image.to_rgb32f().enumerate_pixels() {
                        assert_eq!(found.0, at(x, y), "({x}, {y})");
                    }
                    let mut other = Cursor::new(Vec::new());
                    image.write_to(&mut other, image::ImageFormat::OpenExr).unwrap();
                    other.into_inner().len()
                }
                PictureFormat::Png8 | PictureFormat::Png16 => {
                    let mut pixels = Vec::new();
                    let picture = picture_of(format);
                    grid().render_order().into_iter().for_each(|tile| put(&picture, tile));
                    picture.pixels().read_rows(0..size.height(), &mut pixels).unwrap();
                    let mut reader = png::Decoder::new(Cursor::new(&file)).read_info().unwrap();
                    let mut found = vec![0; pixels.len()];
                    reader.next_frame(&mut found).unwrap();
                    assert!(found == pixels, "{format:?}");
                    let mut other = Vec::new();
                    let mut encoder = png::Encoder::new(&mut other, size.width(), size.height());
                    encoder.set_color(png::ColorType::Rgb);
                    encoder.set_depth(reader.info().bit_depth);
                    encoder.set_compression(png::Compression::Fast);
                    let mut writer = encoder.write_header().unwrap();
                    let mut rows = writer.stream_writer().unwrap();
                    io::Write::write_all(&mut rows, &pixels).unwrap();
                    rows.finish().unwrap();
                    drop(writer);
                    other.len()
                }
            };
            assert!(file.len() <= other + other / 100, "{format:?}: {} and {other}", file.len());
        }
    }
}
