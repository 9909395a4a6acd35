//! A tile of a prepared scene into pixels.

use std::ops::ControlFlow;

use crate::{
    isa::Isa,
    prepared::PreparedScene,
    tile::{Area, Size},
};

/// What a picture depends on besides the scene.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Settings {
    /// The frame in pixels.
    pub size: Size,
    /// Samples in every pixel, `1..=65_536`.
    pub samples: u32,
    /// Chooses the random numbers.
    pub seed: u64,
    /// Every surface shows its plain colour, as in a scene without light.
    pub flat: bool,
}

/// A rendered tile.
#[derive(Debug, Clone, PartialEq)]
pub struct RenderedTile {
    /// Linear red, green and blue, 1.0 for 255 in the file, `[y][x]`, row by row.
    pub pixels: Vec<[f32; 3]>,
    /// Rays traced, of all kinds.
    pub rays: u64,
}

/// Renders `area` of the frame. `on_progress` is called from time to time (some 10 ms of work
/// apart) and may stop the work: then the answer is `None`.
pub fn render_tile<B: AsRef<[u8]>>(
    _scene: &PreparedScene<B>,
    _settings: &Settings,
    area: Area,
    _isa: Isa,
    on_progress: &mut dyn FnMut() -> ControlFlow<()>,
) -> Option<RenderedTile> {
    if on_progress().is_break() {
        return None;
    }
    let pixels = (0..area.pixel_count() as u32)
        .map(|k| {
            [
                (area.x0 + k % area.width) as f32 / 1000.0,
                (area.y0 + k / area.width) as f32 / 1000.0,
                0.5,
            ]
        })
        .collect();
    Some(RenderedTile { pixels, rays: area.pixel_count() as u64 })
}
