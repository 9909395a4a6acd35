//! A tile of a prepared scene into pixels.
//!
//! A pixel's samples are added in their own order, and each is a pure function of (scene,
//! settings, pixel, sample): a pixel is the same to the bit whatever the tile, the batch, the
//! thread or the CPU.

use std::ops::ControlFlow;

use glam::DVec3;

use crate::{
    isa::Isa,
    prepared::PreparedScene,
    sample::Samples,
    tile::{Area, Size},
    wavefront::{Batch, CameraSample},
};

/// What a picture depends on besides the scene.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Settings {
    /// The frame in pixels.
    pub size: Size,
    /// Samples in every pixel, `1..=`[`crate::sample::MOST_SAMPLES`].
    pub samples: u32,
    /// Chooses the random numbers.
    pub seed: u64,
    /// Every surface shows its plain colour, as in a scene without light.
    pub flat: bool,
    /// A mirrored or transmitted branch whose weight in its sample is below this is not traced:
    /// it counts as background. 0..=1.
    pub cutoff: f64,
}

/// The cut-off where nobody chose one: a sixteenth of an 8-bit step.
pub const DEFAULT_CUTOFF: f64 = 1.0 / 4096.0;

/// A rendered tile.
#[derive(Debug, Clone, PartialEq)]
pub struct RenderedTile {
    /// Linear red, green and blue, 1.0 for 255 in the file, `[y][x]`, row by row.
    pub pixels: Vec<[f32; 3]>,
    /// Rays traced, of all kinds.
    pub rays: u64,
    /// The largest sum of weights of branches that were not traced, in any sample. 0..=1.
    pub cut: f64,
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
    let samples = u64::from(settings.samples);
    let sample_count = area.pixel_count() as u64 * samples;
    let mut sums = vec![DVec3::ZERO; area.pixel_count()];
    let mut batch = Batch::default();
    let (mut rays, mut cut) = (0, 0.0_f64);
    let mut first = 0;
    while first < sample_count {
        let last = sample_count.min(first + BATCH as u64);
        let wanted = (first..last).map(|index| {
            let pixel = (index / samples) as u32;
            let (x, y) = (area.x0 + pixel % area.width, area.y0 + pixel / area.width);
            let of_pixel = Samples::new(settings.samples, settings.seed, x, y);
            CameraSample { x, y, sample: of_pixel.sample((index % samples) as u32) }
        });
        batch.start(&view.header.camera, settings, wanted);
        match batch.run(&view, settings, isa, on_progress) {
            ControlFlow::Continue(count) => rays += count,
            ControlFlow::Break(()) => return None,
        }
        cut = batch.cut.iter().fold(cut, |largest, &cut| largest.max(cut));
        for (sample, color) in (first..last).zip(&batch.colors) {
            sums[(sample / samples) as usize] += *color;
        }
        first = last;
    }
    let count = f64::from(settings.samples);
    let pixels = sums.into_iter().map(|sum| (sum / count).to_array().map(|x| x as f32)).collect();
    Some(RenderedTile { pixels, rays, cut })
}
