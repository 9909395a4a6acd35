//! Writes `tile.png` to standard output: a painted tile, with a sun in its upper left corner and a
//! mark below its middle, so that one sees which way it stands.
//!
//!     cargo run --example make_tile > scenes/tile.png

use std::io::{Cursor, Write as _};

use image::{ImageFormat, Rgb, RgbImage};

/// Texels a side, and the points a side that each is the mean of.
const SIDE: u32 = 128;
const POINTS: u32 = 8;

const GLAZE: [f64; 3] = [238.0, 232.0, 214.0];
const BLUE: [f64; 3] = [38.0, 74.0, 150.0];
const SKY: [f64; 3] = [120.0, 164.0, 208.0];
const SUN: [f64; 3] = [236.0, 168.0, 44.0];
const RED: [f64; 3] = [190.0, 62.0, 46.0];

/// The paint at a place, x from left and y from the top, each in 0..1.
fn paint(x: f64, y: f64) -> [f64; 3] {
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

fn main() -> std::io::Result<()> {
    let tile = RgbImage::from_fn(SIDE, SIDE, |x, y| {
        let mut sum = [0.0; 3];
        for k in 0..POINTS * POINTS {
            let at = |texel: u32, k: u32| {
                let point = f64::from(texel * POINTS + k) + 0.5;
                point / f64::from(SIDE * POINTS)
            };
            let color = paint(at(x, k % POINTS), at(y, k / POINTS));
            sum = [0, 1, 2].map(|c| sum[c] + color[c]);
        }
        Rgb(sum.map(|c| (c / f64::from(POINTS * POINTS)).round() as u8))
    });
    let mut png = Cursor::new(Vec::new());
    tile.write_to(&mut png, ImageFormat::Png).map_err(std::io::Error::other)?;
    std::io::stdout().write_all(png.get_ref())
}
