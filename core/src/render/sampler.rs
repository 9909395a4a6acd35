//! How many samples pixels get, and when.

use std::ops::ControlFlow;

use glam::DVec3;

use super::{
    pixel::Pixel,
    settings::{Quality, Sampling},
    tally::Tally,
    unseen::{FirstSamples, UnseenFaces, UnseenSearch},
    wavefront::{CameraSample, Wavefront},
};
use crate::{
    isa::Isa,
    prepared::layout::View,
    sample::{FEWEST_FOR_ERROR, Samples},
    tile::Area,
    trace::ray::Hit,
};

/// Camera rays in a batch: enough to fill the queues, few enough to stay in the cache.
const BATCH: usize = 2048;

/// Gives pixels their samples, a batch at a time.
pub(super) struct Sampler<'a> {
    view: &'a View<'a>,
    quality: &'a Quality,
    isa: Isa,
    on_progress: &'a mut dyn FnMut() -> ControlFlow<()>,
    wavefront: Wavefront,
    tally: Tally,
}

impl<'a> Sampler<'a> {
    pub(crate) fn new(
        view: &'a View<'a>,
        quality: &'a Quality,
        isa: Isa,
        wavefront: Wavefront,
        on_progress: &'a mut dyn FnMut() -> ControlFlow<()>,
    ) -> Self {
        let tally = Tally::default();
        Self { view, quality, isa, on_progress, wavefront, tally }
    }

    /// What the work has taken so far.
    pub(super) fn tally(&self) -> Tally {
        self.tally
    }

    /// Gives the pixels of `area` all their samples. `Break` when the work was stopped.
    pub(super) fn sample(&mut self, area: Area) -> ControlFlow<(), Vec<Pixel>> {
        match self.quality.sampling {
            Sampling::Fixed(count) => self.sample_evenly(area, count.get()),
            Sampling::Adaptive { error, most } => {
                self.sample_as_needed(area, error.get(), most.get())
            }
        }
    }

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
        let wide = area.with_rim();
        let inner: Vec<u32> = area.pixels().map(|(x, y)| wide.index_of(x, y)).collect();
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
        let quality = self.quality;
        let search = UnseenSearch::new(self.view, area.frame(), quality.flat, error);
        let mut watch = match search {
            Some(search) => self.find_unseen(search, area, wide, &mut pixels, &hits)?,
            None => UnseenWatch::default(),
        };
        drop(hits);
        let is_open = |pixels: &[Pixel], pixel: u32| !pixels[pixel as usize].is_below(error);
        let mut open = inner.clone();
        open.retain(|&pixel| is_open(&pixels, pixel));
        let mut count = FEWEST_FOR_ERROR;
        while !open.is_empty() && count < most {
            count = most.min(2 * count);
            self.extend(wide, &mut pixels, &open, count, None)?;
            watch.note_samples(wide, &mut pixels, quality.seed);
            open.retain(|&pixel| is_open(&pixels, pixel));
        }
        self.tally.capped += open.len() as u64;
        ControlFlow::Continue(inner.iter().map(|&pixel| pixels[pixel as usize]).collect())
    }

    /// Finds the faces in the pixels of `area` that none of the first samples has met; `hits` has
    /// what the samples of `wide` met.
    fn find_unseen(
        &mut self,
        mut search: UnseenSearch<'a>,
        area: Area,
        wide: Area,
        pixels: &mut [Pixel],
        hits: &[Hit],
    ) -> ControlFlow<(), UnseenWatch<'a>> {
        let seed = self.quality.seed;
        let mut found = Vec::new();
        for block in area.blocks(32) {
            (self.on_progress)()?;
            let first_samples = |x: u32, y: u32| {
                let pixel = wide.index_of(x, y);
                let first = pixel as usize * FEWEST_FOR_ERROR as usize;
                FirstSamples {
                    hits: &hits[first..first + FEWEST_FOR_ERROR as usize],
                    samples: Samples::new(FEWEST_FOR_ERROR, seed, x, y),
                    mean: pixels[pixel as usize].mean(),
                }
            };
            search.search(block, &first_samples, &mut |x, y, unseen| {
                found.push((wide.index_of(x, y), FEWEST_FOR_ERROR, unseen));
            });
        }
        for (pixel, count, unseen) in &found {
            pixels[*pixel as usize].set_unseen(unseen.variance(*count));
        }
        ControlFlow::Continue(UnseenWatch { search: Some(search), found })
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
        let seed = self.quality.seed;
        let had = chosen.first().map_or(0, |&pixel| pixels[pixel as usize].count());
        let each = u64::from(count - had);
        let wanted = chosen.len() as u64 * each;
        let pixel_of = |index: u64| chosen[(index / each) as usize];
        let width = 1.0 / f64::from(count).sqrt();
        for first in (0..wanted).step_by(BATCH) {
            let run = first..wanted.min(first + BATCH as u64);
            let samples = run.clone().map(|index| {
                let pixel = pixel_of(index);
                let (x, y) = area.pixel_at(pixel);
                let number = had + (index % each) as u32;
                let sample = Samples::new(count, seed, x, y).sample(number);
                CameraSample { x, y, sample, width }
            });
            self.wavefront.start(self.view, self.quality, area.frame(), samples);
            self.tally.samples += run.end - run.start;
            self.tally.rays +=
                self.wavefront.run(self.view, self.quality, self.isa, self.on_progress)?;
            for (index, &color) in run.zip(self.wavefront.colors()) {
                pixels[pixel_of(index) as usize].add(color);
            }
            if let Some(hits) = &mut hits {
                hits.extend_from_slice(self.wavefront.first_hits());
            }
            for &weight in self.wavefront.untraced() {
                self.tally.untraced += weight;
                self.tally.most_untraced = self.tally.most_untraced.max(weight);
            }
        }
        ControlFlow::Continue(())
    }
}

/// Faces in pixels that no sample has met, watched until one does.
#[derive(Default)]
struct UnseenWatch<'a> {
    search: Option<UnseenSearch<'a>>,
    /// Pixels of the area, how many of their samples are noted, and the faces that none of those
    /// has met or passed.
    found: Vec<(u32, u32, UnseenFaces)>,
}

impl UnseenWatch<'_> {
    /// Notes where the latest samples of the pixels of `area` lie.
    fn note_samples(&mut self, area: Area, pixels: &mut [Pixel], seed: u64) {
        let Some(search) = &self.search else { return };
        for (index, noted, unseen) in &mut self.found {
            let pixel = &mut pixels[*index as usize];
            let (x, y) = area.pixel_at(*index);
            let samples = Samples::new(pixel.count(), seed, x, y);
            if *noted == pixel.count() || unseen.is_empty() {
                continue;
            }
            let places = (*noted..pixel.count()).map(|number| samples.sample(number).place(x, y));
            search.note_samples(unseen, places, pixel.count());
            *noted = pixel.count();
            pixel.set_unseen(unseen.variance(*noted));
        }
    }
}

/// A pixel and its neighbours, by their numbers in the area.
fn neighbourhood(area: Area, pixel: u32) -> impl Iterator<Item = u32> {
    let (x, y) = (pixel % area.width(), pixel / area.width());
    let rows = y.saturating_sub(1)..=area.height().min(y + 2) - 1;
    rows.flat_map(move |row| {
        let columns = x.saturating_sub(1)..=area.width().min(x + 2) - 1;
        columns.map(move |column| row * area.width() + column)
    })
}
