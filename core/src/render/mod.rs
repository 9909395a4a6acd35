//! A tile of a prepared scene into pixels.
//!
//! A pixel's samples are added in their own order, and each is a pure function of (scene, quality,
//! pixel, sample); how many there are hangs on the first samples of the pixels at most three away
//! and the first eight of those beside it, on the faces in its beam, and on its own later samples.
//! So a pixel is the same to the bit whatever the tile, the batch, the thread or the CPU.

mod camera_rays;
mod first_round;
mod pixel;
mod sampler;
mod settings;
mod tally;
pub(crate) mod trees;
mod unseen;
mod wavefront;

use std::ops::ControlFlow;

use self::{sampler::Sampler, wavefront::Wavefront};

pub use self::{tally::Tally, wavefront::DEEPEST};
use crate::{isa::Isa, prepared::PreparedScene, tile::Area};

pub use self::settings::{Quality, SampleCount, SampleLimit, Sampling, Settings, StandardError};

/// A rendered tile.
#[derive(Debug, Clone, PartialEq)]
pub struct RenderedTile {
    /// Linear red, green and blue, 1.0 for 255 in the file, `[y][x]`, row by row.
    pub pixels: Vec<[f32; 3]>,
    /// What that took and how good it is.
    pub tally: Tally,
}

/// Renders an area of its frame with the kernels of `isa`, which this machine must support.
/// `on_progress` is called from time to time (some milliseconds of work apart) and may stop the
/// work: then the answer is `None`.
pub fn render_tile<B: AsRef<[u8]>>(
    scene: &PreparedScene<B>,
    quality: &Quality,
    area: Area,
    isa: Isa,
    on_progress: &mut dyn FnMut() -> ControlFlow<()>,
) -> Option<RenderedTile> {
    render(scene, quality, area, isa, None, on_progress)
}

/// Renders as [`render_tile`] does. With a cut-off there is no roulette: branches below that weight
/// count as background, which is biased.
fn render<B: AsRef<[u8]>>(
    scene: &PreparedScene<B>,
    quality: &Quality,
    area: Area,
    isa: Isa,
    cutoff: Option<f64>,
    on_progress: &mut dyn FnMut() -> ControlFlow<()>,
) -> Option<RenderedTile> {
    let view = scene.view();
    let mut sampler = Sampler::new(&view, quality, isa, Wavefront::new(cutoff), on_progress);
    let ControlFlow::Continue(pixels) = sampler.sample(area) else { return None };
    let mut tally = sampler.tally();
    for variance in pixels.iter().filter_map(|pixel| pixel.variance) {
        tally.estimated += 1;
        tally.variance += (variance.x + variance.y + variance.z) / 3.0;
    }
    let pixels = pixels.iter().map(|pixel| pixel.mean.to_array().map(|x| x as f32)).collect();
    Some(RenderedTile { pixels, tally })
}
