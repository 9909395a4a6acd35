//! Whole pictures.

use glam::DVec3;
use rayon::prelude::*;
use rtfarm_core::{
    scene::{Scene, Viewport},
    tile::Size,
};

use crate::{oracle::Oracle, radiance::Settings};

/// The samples of a pixel: places in it, from (0, 0) at its top left to (1, 1).
pub type Positions<'a> = dyn Fn(u32, u32) -> Vec<(f64, f64)> + Sync + 'a;

/// Each pixel as the mean over its samples, row by row from the top left. The scene has a
/// viewport.
pub fn reference_picture(
    scene: &Scene,
    size: Size,
    positions: &Positions<'_>,
    settings: &Settings,
) -> Vec<[f64; 3]> {
    let viewport = scene.viewport.expect("a picture needs a viewport");
    let oracle = Oracle::new(scene);
    (0..size.pixel_count())
        .into_par_iter()
        .map(|pixel| {
            let width = u64::from(size.width());
            let (x, y) = ((pixel % width) as u32, (pixel / width) as u32);
            let samples = positions(x, y);
            let radiance = |&(sx, sy): &(f64, f64)| {
                let direction =
                    eye_direction(&viewport, size, f64::from(x) + sx, f64::from(y) + sy);
                oracle.radiance(viewport.eye, direction, settings)
            };
            let sum: DVec3 = samples.iter().map(radiance).sum();
            (sum / samples.len() as f64).to_array()
        })
        .collect()
}

/// The `side` x `side` centres of a regular grid in a pixel, for [`reference_picture`].
pub fn grid_positions(side: u32) -> Vec<(f64, f64)> {
    let center = |k: u32| (f64::from(k) + 0.5) / f64::from(side);
    (0..side * side).map(|k| (center(k % side), center(k / side))).collect()
}

/// From the eye to the point (x, y) of the screen, in pixels from its top left.
pub fn eye_direction(viewport: &Viewport, size: Size, x: f64, y: f64) -> DVec3 {
    let (u, v) = (x / f64::from(size.width()), y / f64::from(size.height()));
    let right = viewport.top_right - viewport.top_left;
    let down = viewport.bottom_left - viewport.top_left;
    (viewport.top_left - viewport.eye) + u * right + v * down
}
