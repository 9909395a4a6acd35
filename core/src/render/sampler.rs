//! How many samples pixels get, and when.

use std::ops::{ControlFlow, Range};

use glam::DVec3;

use super::{
    camera_rays::CameraSample,
    first_round::FirstRound,
    pixel::{Estimate, Pixel, Runs, Wanted},
    settings::{Quality, Sampling},
    tally::Tally,
    unseen::{FirstSamples, UnseenFaces, UnseenSearch},
    wavefront::Wavefront,
};
use crate::{
    isa::Isa,
    prepared::layout::View,
    sample::{FEWEST_FOR_ERROR, Samples},
    tile::Area,
    trace::ray::Hit,
};

/// Camera rays in a batch: enough to fill the queues, few enough to stay in the cache.
const BATCH: usize = 512;

/// The side of what an adaptive sample sees of a texture, as a share of the square that it stands
/// for. What a filter takes from beyond the square is in all samples and no difference of theirs
/// tells it, so adaptive pixels would stop at that. With half the side this error is a fourth, and
/// some more noise is told.
const SHARPENED: f64 = 0.5;

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
    pub(super) fn sample(&mut self, area: Area) -> ControlFlow<(), Vec<Estimate>> {
        match self.quality.sampling {
            Sampling::Fixed(count) => self.sample_evenly(area, count.get()),
            Sampling::Adaptive { error, most } => {
                let full_light = if self.quality.clips { 1.0 } else { f64::INFINITY };
                let wanted = Wanted { error: error.get(), full_light };
                self.sample_as_needed(area, &wanted, most.get())
            }
        }
    }

    /// The pixels of `area` with `count` samples each.
    fn sample_evenly(&mut self, area: Area, count: u32) -> ControlFlow<(), Vec<Estimate>> {
        let all = pixels_by_blocks(area);
        let mut pixels = vec![Runs::default(); all.len()];
        self.extend(area, &all, 0..count, count, None, |place, color| {
            pixels[all[place] as usize].add(color);
        })?;
        ControlFlow::Continue(pixels.iter().map(Runs::estimate).collect())
    }

    /// The pixels of `area` with samples until each one is what is wanted: one each at first, more
    /// where the neighbourhood's samples or the faces in the beam ask for them.
    fn sample_as_needed(
        &mut self,
        area: Area,
        wanted: &Wanted,
        most: u32,
    ) -> ControlFlow<(), Vec<Estimate>> {
        let near = area.with_rim();
        let far = near.with_rim();
        let wide = far.with_rim();
        let seed = self.quality.seed;
        let all = pixels_by_blocks(wide);
        let mut colors = vec![DVec3::ZERO; all.len()];
        let mut hits_by_blocks = Vec::with_capacity(all.len());
        self.extend(
            wide,
            &all,
            0..1,
            FEWEST_FOR_ERROR,
            Some(&mut hits_by_blocks),
            |place, color| {
                colors[all[place] as usize] = color;
            },
        )?;
        let mut search =
            UnseenSearch::new(self.view, area.frame(), self.quality.flat, wanted.error, self.isa);
        let found = match &mut search {
            Some(search) => {
                let mut hits = hits_by_blocks.clone();
                for (&pixel, hit) in all.iter().zip(hits_by_blocks) {
                    hits[pixel as usize] = hit;
                }
                let firsts = FirstSamples::new(wide, seed, &colors, &hits, self.isa);
                self.find_unseen(search, area, &firsts)?
            }
            None => Vec::new(),
        };

        // Where the first samples lie apart the pixels around get more, and what these see opens
        // the pixels beside them: an edge may cross a corner that no first sample met.
        let round = FirstRound::new(far, wide, &colors, wanted, self.isa);
        let mut is_near_suspect = vec![false; far.pixel_count()];
        for ((x, y), _) in far.pixels().zip(&round.verdicts).filter(|(_, told)| told.is_suspect) {
            far.neighbours(x, y).for_each(|index| is_near_suspect[index as usize] = true);
        }
        let new_pixel = |(x, y)| {
            let around = round.around[far.index_of(x, y) as usize];
            Pixel::new(colors[wide.index_of(x, y) as usize], around)
        };
        let mut chosen = Vec::new();
        let mut place_of = vec![None; far.pixel_count()];
        let mut is_near_extended = vec![false; far.pixel_count()];
        for (x, y) in near.pixels() {
            let index = far.index_of(x, y);
            if round.verdicts[index as usize].is_done && !is_near_suspect[index as usize] {
                continue;
            }
            place_of[index as usize] = Some(chosen.len());
            far.neighbours(x, y).for_each(|index| is_near_extended[index as usize] = true);
            chosen.push(index);
        }
        let mut pixels: Vec<Pixel> =
            chosen.iter().map(|&index| new_pixel(far.pixel_at(index))).collect();
        self.extend(far, &chosen, 1..FEWEST_FOR_ERROR, FEWEST_FOR_ERROR, None, |place, color| {
            pixels[place].add(color);
        })?;
        let extended = |index: u32| place_of[index as usize].map(|place: usize| &pixels[place]);
        let mut found = found.into_iter().peekable();
        let mut estimates = Vec::with_capacity(area.pixel_count());
        let mut open = Vec::new();
        for (index, (x, y)) in (0..).zip(area.pixels()) {
            let here = far.index_of(x, y);
            let unseen = found.next_if(|&(at, _)| at == index).map(|(_, unseen)| unseen);
            // Where no neighbour has more than one sample and nothing hides the verdict stands.
            if !is_near_extended[here as usize] && unseen.is_none() {
                let (mean, variance) =
                    (colors[wide.index_of(x, y) as usize], round.verdicts[here as usize].variance);
                estimates.push(Estimate { mean, variance });
                continue;
            }
            let around = far.neighbours(x, y);
            let own = extended(here);
            let mut pixel = own.copied().unwrap_or_else(|| new_pixel((x, y)));
            if is_near_extended[here as usize] {
                let first = |index| {
                    let (x, y) = far.pixel_at(index);
                    [colors[wide.index_of(x, y) as usize]; 2]
                };
                let range = |index| extended(index).map_or_else(|| first(index), Pixel::range);
                pixel.set_contrast(around.clone().map(range));
                if around.clone().all(|index| extended(index).is_some()) {
                    pixel.set_noise(&around.filter_map(extended));
                }
            }
            let mut pixel = OpenPixel { index, pixel, unseen };
            pixel.note_samples(search.as_ref(), area, seed, 1);
            estimates.push(pixel.pixel.estimate(wanted));
            if !pixel.pixel.is_done(wanted) {
                open.push(pixel);
            }
        }
        drop(pixels);

        self.sample_open(area, wanted, most, search.as_ref(), open, &mut estimates)?;
        ControlFlow::Continue(estimates)
    }

    /// Gives the pixels of `area` that are open after their first samples rounds of more, until
    /// each one is what is wanted or has `most`.
    fn sample_open(
        &mut self,
        area: Area,
        wanted: &Wanted,
        most: u32,
        search: Option<&UnseenSearch<'a>>,
        mut open: Vec<OpenPixel>,
        estimates: &mut [Estimate],
    ) -> ControlFlow<()> {
        let seed = self.quality.seed;
        let mut count = 1;
        while !open.is_empty() && count < most {
            let next = most.min((2 * count).max(FEWEST_FOR_ERROR));
            let mut behind: Vec<&mut OpenPixel> =
                open.iter_mut().filter(|open| open.pixel.count() == count).collect();
            let chosen: Vec<u32> = behind.iter().map(|open| open.index).collect();
            self.extend(area, &chosen, count..next, next, None, |place, color| {
                behind[place].pixel.add(color);
            })?;
            for open in behind {
                open.note_samples(search, area, seed, count);
                estimates[open.index as usize] = open.pixel.estimate(wanted);
            }
            open.retain(|open| !open.pixel.is_done(wanted));
            count = next;
        }
        self.tally.capped += open.len() as u64;
        ControlFlow::Continue(())
    }

    /// Finds the faces in the pixels of `area` that none of the first samples has met: for some
    /// pixels, by their places in `area`, in order.
    fn find_unseen(
        &mut self,
        search: &mut UnseenSearch<'a>,
        area: Area,
        firsts: &FirstSamples,
    ) -> ControlFlow<(), Vec<(u32, UnseenFaces)>> {
        let mut found = Vec::new();
        for block in area.blocks(32) {
            (self.on_progress)()?;
            search.search(block, firsts, &mut |x, y, unseen| {
                found.push((area.index_of(x, y), unseen));
            });
        }
        self.tally.rays += search.rays();
        // In the order in which they were found, for sums round.
        found.sort_by_key(|&(index, _)| index);
        found.dedup_by(|(later, more), (index, unseen)| {
            let is_same = later == index;
            if is_same {
                unseen.join(std::mem::take(more));
            }
            is_same
        });
        ControlFlow::Continue(found)
    }

    /// Gives each of the `chosen` pixels of `area` the samples of these numbers, out of `count`;
    /// `add` takes what each sees, with the pixel's place among the chosen ones and in the order of
    /// numbers, and `hits` what its camera ray meets.
    fn extend(
        &mut self,
        area: Area,
        chosen: &[u32],
        numbers: Range<u32>,
        count: u32,
        mut hits: Option<&mut Vec<Hit>>,
        mut add: impl FnMut(usize, DVec3),
    ) -> ControlFlow<()> {
        let seed = self.quality.seed;
        let width = match self.quality.sampling {
            Sampling::Fixed(_) => 1.0,
            Sampling::Adaptive { .. } => SHARPENED,
        } / f64::from(count).sqrt();
        let most_pixels = (BATCH / numbers.len()).max(1);
        for (batch, pixels) in chosen.chunks(most_pixels).enumerate() {
            for first in numbers.clone().step_by(BATCH) {
                let part = first..numbers.end.min(first + BATCH as u32);
                let samples = pixels.iter().flat_map(|&pixel| {
                    let (x, y) = area.pixel_at(pixel);
                    let samples = Samples::new(count, seed, x, y);
                    part.clone().map(move |number| {
                        let sample = samples.sample(number);
                        CameraSample { x, y, sample, width }
                    })
                });
                self.wavefront.start(self.view, self.quality, self.isa, area.frame(), samples);
                self.tally.samples += (pixels.len() * part.len()) as u64;
                self.tally.rays +=
                    self.wavefront.run(self.view, self.quality, self.isa, self.on_progress)?;
                let of_pixels = self.wavefront.colors().chunks_exact(part.len());
                for (place, colors) in (batch * most_pixels..).zip(of_pixels) {
                    for &color in colors {
                        add(place, color);
                    }
                }
                if let Some(hits) = &mut hits {
                    hits.extend_from_slice(self.wavefront.first_hits());
                }
                for &weight in self.wavefront.untraced() {
                    self.tally.untraced += weight;
                    self.tally.most_untraced = self.tally.most_untraced.max(weight);
                }
            }
        }
        ControlFlow::Continue(())
    }
}

/// A pixel that may get more samples.
struct OpenPixel {
    /// Its place in the area.
    index: u32,
    pixel: Pixel,
    /// The faces in its beam that none of its samples has met or passed.
    unseen: Option<UnseenFaces>,
}

impl OpenPixel {
    /// Notes where its samples lie from that of number `first` on.
    fn note_samples(
        &mut self,
        search: Option<&UnseenSearch<'_>>,
        area: Area,
        seed: u64,
        first: u32,
    ) {
        let (Some(search), Some(unseen)) = (search, &mut self.unseen) else { return };
        let (count, (x, y)) = (self.pixel.count(), area.pixel_at(self.index));
        if first < count {
            let samples = Samples::new(count, seed, x, y);
            let places = (first..count).map(|number| samples.sample(number).place(x, y));
            search.note_samples(unseen, places, count);
        }
        let (variance, feared) = (unseen.variance(count), unseen.feared_variance(count));
        self.pixel.set_unseen(variance, feared, unseen.passed_share());
    }
}

/// The places of the pixels of an area, block by block: the rays of a block go the same way and are
/// traced together.
fn pixels_by_blocks(area: Area) -> Vec<u32> {
    let mut all = Vec::with_capacity(area.pixel_count());
    for block in area.blocks(8) {
        for y in block.rows() {
            all.extend(block.columns().map(|x| area.index_of(x, y)));
        }
    }
    all
}
