//! A tile of a prepared scene into pixels.
//!
//! A pixel's samples are added in their own order, and each is a pure function of (scene,
//! settings, pixel, sample); how many there are hangs on the first samples of the pixel and its
//! eight neighbours, on the faces in its beam, and on its own later samples. So a pixel is the same
//! to the bit whatever the tile, the batch, the thread or the CPU.

mod pixel;
mod settings;
mod unseen;
mod wavefront;

pub use self::settings::{
    DEFAULT_CUTOFF, DEFAULT_ERROR, DEFAULT_MOST_SAMPLES, Quality, Sampling, Settings,
};

use std::ops::ControlFlow;

use self::pixel::Pixel;
use self::unseen::{FirstSamples, UnseenFaces, UnseenSearch};
use self::wavefront::{Batch, CameraSample};

use glam::DVec3;

use crate::{
    isa::Isa,
    prepared::{PreparedScene, layout::View},
    sample::{FEWEST_FOR_ERROR, Samples},
    tile::{Area, Size},
    trace::ray::Hit,
};

/// A rendered tile.
#[derive(Debug, Clone, PartialEq)]
pub struct RenderedTile {
    /// Linear red, green and blue, 1.0 for 255 in the file, `[y][x]`, row by row.
    pub pixels: Vec<[f32; 3]>,
    /// What that took and how good it is.
    pub tally: Tally,
}

/// What rendering took and how good the pixels are.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Tally {
    /// Rays traced, of all kinds.
    pub rays: u64,
    /// Camera rays among them.
    pub samples: u64,
    /// The largest sum of weights of branches that were not traced, in any sample. 0..=1.
    pub cut: f64,
    /// Pixels whose error was estimated.
    pub estimated: u64,
    /// The sum of those pixels' estimated variances, each the mean of its channels'.
    pub variance: f64,
    /// Pixels that got the most samples that they may have and are not below the wanted error.
    pub capped: u64,
}

impl Tally {
    /// Takes that of other pixels in.
    pub fn add(&mut self, other: &Self) {
        self.rays += other.rays;
        self.samples += other.samples;
        self.cut = self.cut.max(other.cut);
        self.estimated += other.estimated;
        self.variance += other.variance;
        self.capped += other.capped;
    }

    /// The estimated root-mean-square error of a channel; `None` where no pixel had enough samples.
    pub fn error(&self) -> Option<f64> {
        (self.estimated > 0).then(|| (self.variance / self.estimated as f64).sqrt())
    }
}

/// Camera rays in a batch: enough to fill the queues, few enough to stay in the cache.
const BATCH: usize = 2048;

/// Renders `area` of the frame with the kernels of `isa`, which this machine must support.
/// `on_progress` is called from time to time (some milliseconds of work apart) and may stop the
/// work: then the answer is `None`.
pub fn render_tile<B: AsRef<[u8]>>(
    scene: &PreparedScene<B>,
    settings: &Settings,
    area: Area,
    isa: Isa,
    on_progress: &mut dyn FnMut() -> ControlFlow<()>,
) -> Option<RenderedTile> {
    let view = scene.view();
    let mut sampler = Sampler {
        view: &view,
        settings,
        isa,
        on_progress,
        batch: Batch::default(),
        tally: Tally::default(),
    };
    let rendered = match settings.quality.sampling {
        Sampling::Fixed(count) => sampler.sample_evenly(area, count),
        Sampling::Adaptive { error, most } => sampler.sample_as_needed(area, error, most),
    };
    let ControlFlow::Continue(pixels) = rendered else { return None };
    let mut tally = sampler.tally;
    for pixel in &pixels {
        if let Some(variance) = pixel.variance() {
            tally.estimated += 1;
            tally.variance += (variance.x + variance.y + variance.z) / 3.0;
        }
    }
    let pixels = pixels.iter().map(|pixel| pixel.mean().to_array().map(|x| x as f32)).collect();
    Some(RenderedTile { pixels, tally })
}

/// Gives pixels their samples, a batch at a time.
struct Sampler<'a> {
    view: &'a View<'a>,
    settings: &'a Settings,
    isa: Isa,
    on_progress: &'a mut dyn FnMut() -> ControlFlow<()>,
    batch: Batch,
    tally: Tally,
}

impl<'a> Sampler<'a> {
    /// The pixels of `area` with `count` samples each.
    fn sample_evenly(&mut self, area: Area, count: u32) -> ControlFlow<(), Vec<Pixel>> {
        let mut pixels = vec![Pixel::default(); area.pixel_count()];
        let all: Vec<u32> = (0..pixels.len() as u32).collect();
        self.extend(area, &mut pixels, &all, count, None)?;
        ControlFlow::Continue(pixels)
    }

    /// The pixels of `area` with samples until each one's standard error is below `error`.
    fn sample_as_needed(
        &mut self,
        area: Area,
        error: f64,
        most: u32,
    ) -> ControlFlow<(), Vec<Pixel>> {
        let (wide, inner) = with_apron(area, self.settings.size);
        let mut pixels = vec![Pixel::default(); wide.pixel_count()];
        let all: Vec<u32> = (0..pixels.len() as u32).collect();
        let mut hits = Vec::with_capacity(all.len() * FEWEST_FOR_ERROR as usize);
        self.extend(wide, &mut pixels, &all, FEWEST_FOR_ERROR, Some(&mut hits))?;

        // What one pixel's first samples missed its neighbours' may have found.
        let contrasts: Vec<DVec3> = inner
            .iter()
            .map(|&pixel| {
                let ranges = neighbourhood(wide, pixel).map(|k| pixels[k as usize].range());
                let range = ranges.reduce(|a, b| [a[0].min(b[0]), a[1].max(b[1])]);
                let [low, high] = range.expect("a pixel is its own neighbour");
                high - low
            })
            .collect();
        for (&pixel, contrast) in inner.iter().zip(contrasts) {
            pixels[pixel as usize].set_contrast(contrast);
        }
        let quality = &self.settings.quality;
        let beams = UnseenSearch::new(self.view, self.settings.size, quality.flat, error);
        let mut hidden = match beams {
            Some(beams) => self.find_hidden(beams, area, wide, &mut pixels, &hits)?,
            None => Hidden::default(),
        };
        drop(hits);
        let is_open = |pixels: &[Pixel], pixel: u32| !pixels[pixel as usize].is_below(error);
        let mut open = inner.clone();
        open.retain(|&pixel| is_open(&pixels, pixel));
        let mut count = FEWEST_FOR_ERROR;
        while !open.is_empty() && count < most {
            count = most.min(2 * count);
            self.extend(wide, &mut pixels, &open, count, None)?;
            hidden.pass(wide, &mut pixels, quality.seed);
            open.retain(|&pixel| is_open(&pixels, pixel));
        }
        self.tally.capped += open.len() as u64;
        ControlFlow::Continue(inner.iter().map(|&pixel| pixels[pixel as usize]).collect())
    }

    /// Finds what may hide in the pixels of `area`, from the first samples of `wide`.
    fn find_hidden(
        &mut self,
        mut beams: UnseenSearch<'a>,
        area: Area,
        wide: Area,
        pixels: &mut [Pixel],
        hits: &[Hit],
    ) -> ControlFlow<(), Hidden<'a>> {
        let seed = self.settings.quality.seed;
        let mut found = Vec::new();
        for part in unseen::blocks(area, 32) {
            (self.on_progress)()?;
            let look = |x: u32, y: u32| {
                let pixel = index_of(wide, x, y);
                let first = pixel as usize * FEWEST_FOR_ERROR as usize;
                FirstSamples {
                    hits: &hits[first..first + FEWEST_FOR_ERROR as usize],
                    samples: Samples::new(FEWEST_FOR_ERROR, seed, x, y),
                    mean: pixels[pixel as usize].mean(),
                }
            };
            beams.search(part, &look, &mut |x, y, unseen| {
                found.push((index_of(wide, x, y), FEWEST_FOR_ERROR, unseen));
            });
        }
        for (pixel, count, unseen) in &found {
            pixels[*pixel as usize].set_hidden(unseen.variance(*count));
        }
        ControlFlow::Continue(Hidden { beams: Some(beams), found })
    }

    /// Brings the `chosen` ones among the pixels of `area`, which all have as many samples, to
    /// `count` samples each; `hits` takes what the new camera rays meet.
    fn extend(
        &mut self,
        area: Area,
        pixels: &mut [Pixel],
        chosen: &[u32],
        count: u32,
        mut hits: Option<&mut Vec<Hit>>,
    ) -> ControlFlow<()> {
        let seed = self.settings.quality.seed;
        let had = chosen.first().map_or(0, |&pixel| pixels[pixel as usize].count());
        let each = u64::from(count - had);
        let wanted = chosen.len() as u64 * each;
        let pixel_of = |index: u64| chosen[(index / each) as usize];
        let spread = 1.0 / f64::from(count).sqrt();
        for first in (0..wanted).step_by(BATCH) {
            let run = first..wanted.min(first + BATCH as u64);
            let samples = run.clone().map(|index| {
                let pixel = pixel_of(index);
                let (x, y) = (area.x0 + pixel % area.width, area.y0 + pixel / area.width);
                let number = had + (index % each) as u32;
                let sample = Samples::new(count, seed, x, y).sample(number);
                CameraSample { x, y, sample, spread }
            });
            self.batch.start(self.view, self.settings, samples);
            self.tally.samples += run.end - run.start;
            self.tally.rays +=
                self.batch.run(self.view, &self.settings.quality, self.isa, self.on_progress)?;
            for (index, &color) in run.zip(&self.batch.colors) {
                pixels[pixel_of(index) as usize].add(color);
            }
            if let Some(hits) = &mut hits {
                hits.extend_from_slice(&self.batch.first_hits);
            }
            let cut = self.batch.cut.iter().copied();
            self.tally.cut = cut.fold(self.tally.cut, f64::max);
        }
        ControlFlow::Continue(())
    }
}

/// What may hide in pixels.
#[derive(Default)]
struct Hidden<'a> {
    beams: Option<UnseenSearch<'a>>,
    /// Pixels, by how many of their samples they are up to, and what none of those passed.
    found: Vec<(u32, u32, UnseenFaces)>,
}

impl Hidden<'_> {
    /// Notes where the latest samples of the pixels of `area` have passed.
    fn pass(&mut self, area: Area, pixels: &mut [Pixel], seed: u64) {
        let Some(beams) = &self.beams else { return };
        for (index, had, unseen) in &mut self.found {
            let pixel = &mut pixels[*index as usize];
            let (x, y) = (area.x0 + *index % area.width, area.y0 + *index / area.width);
            let samples = Samples::new(pixel.count(), seed, x, y);
            if *had == pixel.count() || unseen.is_empty() {
                continue;
            }
            let places = (*had..pixel.count()).map(|number| samples.sample(number).place(x, y));
            beams.note_samples(unseen, places, pixel.count());
            *had = pixel.count();
            pixel.set_hidden(unseen.variance(*had));
        }
    }
}

/// The area and the pixels around it that the frame has, and where the area's own are among them.
fn with_apron(area: Area, frame: Size) -> (Area, Vec<u32>) {
    let (x0, y0) = (area.x0.saturating_sub(1), area.y0.saturating_sub(1));
    let width = frame.width().min(area.x0 + area.width + 1) - x0;
    let height = frame.height().min(area.y0 + area.height + 1) - y0;
    let (left, top) = (area.x0 - x0, area.y0 - y0);
    let inner = (0..area.height)
        .flat_map(|y| (0..area.width).map(move |x| (top + y) * width + left + x))
        .collect();
    (Area { x0, y0, width, height }, inner)
}

/// A pixel of the frame by its number in the area.
fn index_of(area: Area, x: u32, y: u32) -> u32 {
    (y - area.y0) * area.width + (x - area.x0)
}

/// A pixel and its neighbours, by their numbers in the area.
fn neighbourhood(area: Area, pixel: u32) -> impl Iterator<Item = u32> {
    let (x, y) = (pixel % area.width, pixel / area.width);
    let rows = y.saturating_sub(1)..=area.height.min(y + 2) - 1;
    rows.flat_map(move |row| {
        let columns = x.saturating_sub(1)..=area.width.min(x + 2) - 1;
        columns.map(move |column| row * area.width + column)
    })
}
