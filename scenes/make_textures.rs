//! Writes one of the scenes' images to standard output: `tile`, `label` or `planks`.
//!
//!     cargo run --example make_textures tile > scenes/tile.png

#![expect(clippy::disallowed_methods, reason = "colours are rounded to a 255th")]

use std::{
    env,
    io::{Cursor, Error, Write as _},
};

use image::{ImageFormat, Rgb, RgbImage};

/// Points a side of a texel, which is their mean.
const POINTS: u32 = 8;

const GLAZE: [f64; 3] = [238.0, 232.0, 214.0];
const BLUE: [f64; 3] = [38.0, 74.0, 150.0];
const SKY: [f64; 3] = [120.0, 164.0, 208.0];
const SUN: [f64; 3] = [236.0, 168.0, 44.0];
const RED: [f64; 3] = [190.0, 62.0, 46.0];
const PAPER: [f64; 3] = [248.0, 238.0, 212.0];
const INK: [f64; 3] = [72.0, 46.0, 40.0];

/// The paint at a place, x from left and y from the top.
type Paint = fn(f64, f64) -> [f64; 3];

fn main() -> std::io::Result<()> {
    let name = env::args().nth(1);
    // Texels, and the places that they show: as many a unit both ways.
    let (width, height, wide, paint): (u32, u32, f64, Paint) = match name.as_deref() {
        Some("tile") => (128, 128, 1.0, tile),
        Some("label") => (256, 192, 4.0 / 3.0, label),
        Some("planks") => (128, 256, 1.0, planks),
        _ => return Err(Error::other("which one: tile, label or planks?")),
    };
    let image = RgbImage::from_fn(width, height, |x, y| {
        let mut sum = [0.0; 3];
        for k in 0..POINTS * POINTS {
            let at = |texel: u32, k: u32| {
                let point = f64::from(texel * POINTS + k) + 0.5;
                point / f64::from(width * POINTS) * wide
            };
            let color = paint(at(x, k % POINTS), at(y, k / POINTS));
            sum = [0, 1, 2].map(|c| sum[c] + color[c]);
        }
        Rgb(sum.map(|c| (c / f64::from(POINTS * POINTS)).round() as u8))
    });
    let mut png = Cursor::new(Vec::new());
    image.write_to(&mut png, ImageFormat::Png).map_err(Error::other)?;
    std::io::stdout().write_all(png.get_ref())
}

/// A painted tile, 1 x 1, with a sun in its upper left corner and a mark below its middle, so that
/// one sees which way it stands.
fn tile(x: f64, y: f64) -> [f64; 3] {
    let to_edge = x.min(y).min(1.0 - x).min(1.0 - y);
    if to_edge < 0.03 {
        return BLUE;
    }
    if (0.05..0.065).contains(&to_edge) {
        return SKY;
    }
    if (x - 0.22).powi(2) + (y - 0.22).powi(2) < 0.09_f64.powi(2) {
        return SUN;
    }
    if (0.43..0.57).contains(&x) && (0.82..0.88).contains(&y) {
        return RED;
    }
    // Four petals, each where two discs meet; a disc in the middle.
    let (x, y) = (x - 0.5, y - 0.5);
    if x * x + y * y < 0.06_f64.powi(2) {
        return SUN;
    }
    let disc = |x: f64, y: f64| x * x + y * y < 0.24_f64.powi(2);
    let petal = |x: f64, y: f64| disc(x - 0.24, y) && disc(x, y - 0.24);
    let is_petal = petal(x, y) || petal(-x, y) || petal(x, -y) || petal(-x, -y);
    let (u, v) = ((x + y) / 1.414, (x - y) / 1.414);
    let is_leaf = petal(u, v) || petal(-u, v) || petal(u, -v) || petal(-u, -v);
    match (is_petal, is_leaf) {
        (true, _) => BLUE,
        (_, true) => SKY,
        _ => GLAZE,
    }
}

/// A bottle's label, 4/3 x 1: a toadstool above the word ELIXIR.
fn label(x: f64, y: f64) -> [f64; 3] {
    // The letters' strokes, on a grid of 2 x 4 each.
    const WORD: [&[[f64; 4]]; 6] = [
        &[[0.0, 0.0, 0.0, 4.0], [0.0, 0.0, 2.0, 0.0], [0.0, 2.0, 1.6, 2.0], [0.0, 4.0, 2.0, 4.0]],
        &[[0.0, 0.0, 0.0, 4.0], [0.0, 4.0, 2.0, 4.0]],
        &[[1.0, 0.0, 1.0, 4.0]],
        &[[0.0, 0.0, 2.0, 4.0], [2.0, 0.0, 0.0, 4.0]],
        &[[1.0, 0.0, 1.0, 4.0]],
        &[
            [0.0, 0.0, 0.0, 4.0],
            [0.0, 0.0, 1.5, 0.0],
            [1.5, 0.0, 2.0, 0.6],
            [2.0, 0.6, 2.0, 1.4],
            [2.0, 1.4, 1.5, 2.0],
            [1.5, 2.0, 0.0, 2.0],
            [1.0, 2.0, 2.0, 4.0],
        ],
    ];
    let to_edge = x.min(y).min(4.0 / 3.0 - x).min(1.0 - y);
    if (0.035..0.06).contains(&to_edge) {
        return RED;
    }
    if (0.075..0.083).contains(&to_edge) {
        return INK;
    }
    let x = x - 2.0 / 3.0;
    let (right, down) = ((x + 0.5) / 0.045, (y - 0.7) / 0.045);
    for (letter, strokes) in (0..).zip(WORD) {
        let right = right - 4.05 * f64::from(letter);
        if strokes.iter().any(|stroke| to_stroke(right, down, *stroke) < 0.36) {
            return INK;
        }
    }
    toadstool(x, y - 0.4).unwrap_or(PAPER)
}

/// The distance from a point to a line between two others.
fn to_stroke(x: f64, y: f64, [x0, y0, x1, y1]: [f64; 4]) -> f64 {
    let (dx, dy) = (x1 - x0, y1 - y0);
    let t = ((x - x0) * dx + (y - y0) * dy) / (dx * dx + dy * dy);
    let t = t.clamp(0.0, 1.0);
    ((x - x0 - t * dx).powi(2) + (y - y0 - t * dy).powi(2)).sqrt()
}

/// A cap with spots on a stem; the middle of the cap's edge is at 0, 0.
fn toadstool(x: f64, y: f64) -> Option<[f64; 3]> {
    const SPOTS: [[f64; 3]; 5] = [
        [0.0, -0.19, 0.045],
        [-0.13, -0.1, 0.04],
        [0.12, -0.11, 0.05],
        [0.0, -0.05, 0.03],
        [-0.21, -0.03, 0.025],
    ];
    let disc =
        |cx: f64, cy: f64, radius: f64| (x - cx).powi(2) + (y - cy).powi(2) < radius * radius;
    if y < 0.0 && disc(0.0, 0.0, 0.26) {
        let is_spot = SPOTS.iter().any(|[cx, cy, radius]| disc(*cx, *cy, *radius));
        return Some(if is_spot { PAPER } else { RED });
    }
    if (0.0..0.22).contains(&y) && x.abs() < 0.06 + 0.4 * y * y {
        return Some(if x > 0.02 { [222.0, 200.0, 160.0] } else { [236.0, 220.0, 186.0] });
    }
    ((0.2..0.225).contains(&y) && x.abs() < 0.3).then_some([104.0, 140.0, 70.0])
}

/// Four planks side by side, 1 x 2 in all; it repeats both ways.
fn planks(x: f64, y: f64) -> [f64; 3] {
    const TONES: [f64; 4] = [0.0, 0.6, 0.25, 0.85];
    let plank = (x * 4.0) as usize % 4;
    let tone = TONES[plank];
    // Their ends are staggered.
    let across = (x * 4.0).fract();
    let along = (y / 2.0 + 0.37 * plank as f64).fract();
    if across.min(1.0 - across) < 0.02 || along.min(1.0 - along) < 0.0025 {
        return [132.0, 104.0, 76.0];
    }
    let turn = along * std::f64::consts::TAU;
    let bend = 0.5 * (turn + tone * 9.0).sin() + 0.3 * (2.0 * turn + 4.0 * tone).sin();
    let grain = (across * 14.0 + 3.0 * bend * (across - 0.4) + 20.0 * tone).sin();
    let shade = ((tone * 5.0).round() - if grain > 0.72 { 2.5 } else { 0.0 }) / 5.0;
    [226.0 - 14.0 * shade, 204.0 - 18.0 * shade, 170.0 - 20.0 * shade]
}
