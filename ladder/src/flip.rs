//! How different two pictures look when one flips between them on a screen.
//!
//! Source: Andersson, Nilsson, Akenine-Möller, Oskarsson, Åström & Fairchild, "FLIP: A Difference
//! Evaluator for Alternating Images" (2020), with its own constants. The crates for it bind C++.

#![expect(clippy::disallowed_methods, reason = "a difference of pictures reaches no pixel")]

use std::f64::consts::{PI, SQRT_2};

use rtfarm_core::tile::Size;

/// Pixels a degree: a screen of 0.7 m and 3840 pixels, 0.7 m away.
const PIXELS_A_DEGREE: f64 = 3840.0 * PI / 180.0;

/// The sensitivity to contrast as sums of Gaussians, (height, width): lightness, red to green, blue
/// to yellow.
const SENSITIVITY: [&[(f64, f64)]; 3] =
    [&[(1.0, 0.0047)], &[(1.0, 0.0053)], &[(34.1, 0.04), (13.5, 0.025)]];

/// The width of the widest of them.
const WIDEST: f64 = 0.04;

/// The width of the detector of edges and points, in degrees.
const FEATURE_WIDTH: f64 = 0.082;

/// The exponents of a difference in colour and of one in features.
const COLOR_EXPONENT: f64 = 0.7;
const FEATURE_EXPONENT: f64 = 0.5;

/// Up to this share of the largest difference in colour takes up this share of the scale.
const KNEE: (f64, f64) = (0.4, 0.95);

/// sRGB's primaries, and the white that they add up to.
const TO_XYZ: [[f64; 3]; 3] = [
    [10_135_552.0 / 24_577_794.0, 8_788_810.0 / 24_577_794.0, 4_435_075.0 / 24_577_794.0],
    [2_613_072.0 / 12_288_897.0, 8_788_810.0 / 12_288_897.0, 887_015.0 / 12_288_897.0],
    [1_425_312.0 / 73_733_382.0, 8_788_810.0 / 73_733_382.0, 70_074_185.0 / 73_733_382.0],
];

type Channel = Vec<f64>;

/// A picture as the eye takes it in.
#[derive(Debug)]
pub(crate) struct Seen {
    size: Size,
    /// Hunt-adjusted L*a*b*, without the detail that is too fine for the eye.
    colors: Vec<[f64; 3]>,
    /// How much of an edge and of a point there is.
    features: [Channel; 2],
}

impl Seen {
    /// A picture of 8 bits a channel on an sRGB screen, row by row.
    pub(crate) fn new(pixels: &[[u8; 3]], size: Size) -> Self {
        let opponent: Vec<[f64; 3]> = (pixels.iter())
            .map(|pixel| to_opponent(to_xyz(pixel.map(|value| to_linear(value.into())))))
            .collect();
        let channel = |c: usize| -> Channel { opponent.iter().map(|color| color[c]).collect() };
        let filtered: [Channel; 3] = [0, 1, 2].map(|c| filter_contrast(&channel(c), c, size));
        let colors = (0..pixels.len())
            .map(|k| {
                let linear = to_rgb(from_opponent([0, 1, 2].map(|c| filtered[c][k])));
                hunt_adjusted(to_lab(to_xyz(linear.map(|value| value.clamp(0.0, 1.0)))))
            })
            .collect();
        let lightness: Channel = opponent.iter().map(|color| (color[0] + 16.0) / 116.0).collect();
        Self { size, colors, features: features(&lightness, size) }
    }

    /// The mean difference of two pictures of one size: 0 is none, 1 the largest.
    pub(crate) fn mean_difference(&self, other: &Self) -> f64 {
        assert_eq!(self.size, other.size);
        let primary = |rgb| hunt_adjusted(to_lab(to_xyz(rgb)));
        let largest = color_distance(primary([0.0, 1.0, 0.0]), primary([0.0, 0.0, 1.0]));
        let largest = largest.powf(COLOR_EXPONENT);
        let differences = self.colors.iter().zip(&other.colors).enumerate().map(|(k, (&a, &b))| {
            let color = color_distance(a, b).powf(COLOR_EXPONENT);
            let (knee, at_knee) = (KNEE.0 * largest, KNEE.1);
            let color = if color < knee {
                color * at_knee / knee
            } else {
                at_knee + (color - knee) / (largest - knee) * (1.0 - at_knee)
            };
            let feature = [0, 1].map(|f| (self.features[f][k] - other.features[f][k]).abs());
            let feature = (feature[0].max(feature[1]) / SQRT_2).powf(FEATURE_EXPONENT);
            color.powf(1.0 - feature)
        });
        differences.sum::<f64>() / self.colors.len() as f64
    }
}

/// A channel as the eye sees it at its distance.
fn filter_contrast(channel: &[f64], which: usize, size: Size) -> Channel {
    let radius = (3.0 * (WIDEST / (2.0 * PI * PI)).sqrt() * PIXELS_A_DEGREE).ceil() as i32;
    let gaussians: Vec<(f64, Vec<f64>)> = (SENSITIVITY[which].iter())
        .map(|&(height, width)| {
            let weight = |k: i32| {
                let degrees = f64::from(k) / PIXELS_A_DEGREE;
                (-PI * PI * degrees * degrees / width).exp()
            };
            (height * (PI / width).sqrt(), (-radius..=radius).map(weight).collect())
        })
        .collect();
    let square = |weights: &[f64]| weights.iter().sum::<f64>() * weights.iter().sum::<f64>();
    let total: f64 = gaussians.iter().map(|(height, weights)| height * square(weights)).sum();
    let mut sum = vec![0.0; channel.len()];
    for (height, weights) in &gaussians {
        let part = convolve(channel, weights, weights, size);
        sum.iter_mut().zip(part).for_each(|(sum, part)| *sum += part * height / total);
    }
    sum
}

/// How strong an edge and a point are at each place.
fn features(lightness: &[f64], size: Size) -> [Channel; 2] {
    let deviation = 0.5 * FEATURE_WIDTH * PIXELS_A_DEGREE;
    let radius = (3.0 * deviation).ceil() as i32;
    let places = (-radius..=radius).map(f64::from);
    let bell = |x: f64| (-x * x / (2.0 * deviation * deviation)).exp();
    let smooth: Vec<f64> = places.clone().map(bell).collect();
    let total: f64 = smooth.iter().sum();
    let smooth: Vec<f64> = smooth.iter().map(|weight| weight / total).collect();
    let edge: Vec<f64> = places.clone().map(|x| -x * bell(x)).collect();
    let curve = |x: f64| (x * x / (deviation * deviation) - 1.0) * bell(x);
    let point: Vec<f64> = places.map(curve).collect();
    [edge, point].map(|weights| {
        let weights = balanced(&weights);
        let across = convolve(lightness, &weights, &smooth, size);
        let down = convolve(lightness, &smooth, &weights, size);
        across.iter().zip(down).map(|(x, y)| (x * x + y * y).sqrt()).collect()
    })
}

/// Weights whose positive ones add up to 1 and whose negative ones to -1.
fn balanced(weights: &[f64]) -> Vec<f64> {
    let above: f64 = weights.iter().filter(|weight| **weight > 0.0).sum();
    let below: f64 = -weights.iter().filter(|weight| **weight < 0.0).sum::<f64>();
    weights.iter().map(|weight| weight / if *weight > 0.0 { above } else { below }).collect()
}

/// A channel under weights along its rows and along its columns; beyond its border it goes on as
/// at the border.
fn convolve(channel: &[f64], across: &[f64], down: &[f64], size: Size) -> Channel {
    let (width, height) = (size.width() as usize, size.height() as usize);
    let reach = |weights: &[f64]| weights.len() / 2;
    let at = |k: usize, offset: usize, radius: usize, count: usize| {
        (k + offset).saturating_sub(radius).min(count - 1)
    };
    let mut rows = vec![0.0; channel.len()];
    for y in 0..height {
        let row = &channel[y * width..(y + 1) * width];
        for x in 0..width {
            let terms = across.iter().enumerate();
            rows[y * width + x] =
                terms.map(|(k, weight)| weight * row[at(x, k, reach(across), width)]).sum();
        }
    }
    let mut both = vec![0.0; channel.len()];
    for y in 0..height {
        for (k, weight) in down.iter().enumerate() {
            let from = at(y, k, reach(down), height) * width;
            let (to, from) = (&mut both[y * width..(y + 1) * width], &rows[from..from + width]);
            to.iter_mut().zip(from).for_each(|(to, from)| *to += weight * from);
        }
    }
    both
}

/// The light that an sRGB screen shows for a value of 8 bits.
fn to_linear(value: f64) -> f64 {
    let value = value / 255.0;
    if value > 0.040_45 { ((value + 0.055) / 1.055).powf(2.4) } else { value / 12.92 }
}

fn times(matrix: &[[f64; 3]; 3], vector: [f64; 3]) -> [f64; 3] {
    matrix.map(|row| row[0] * vector[0] + row[1] * vector[1] + row[2] * vector[2])
}

/// Relative to white: it is 1, 1, 1.
fn to_xyz(rgb: [f64; 3]) -> [f64; 3] {
    let (xyz, white) = (times(&TO_XYZ, rgb), times(&TO_XYZ, [1.0; 3]));
    [0, 1, 2].map(|c| xyz[c] / white[c])
}

fn to_rgb(relative: [f64; 3]) -> [f64; 3] {
    let white = times(&TO_XYZ, [1.0; 3]);
    let xyz = [0, 1, 2].map(|c| relative[c] * white[c]);
    let columns = glam::DMat3::from_cols_array_2d(&TO_XYZ).transpose();
    (columns.inverse() * glam::DVec3::from_array(xyz)).to_array()
}

/// Lightness, red to green and blue to yellow, all linear in light.
fn to_opponent([x, y, z]: [f64; 3]) -> [f64; 3] {
    [116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)]
}

fn from_opponent([lightness, red, blue]: [f64; 3]) -> [f64; 3] {
    let y = (lightness + 16.0) / 116.0;
    [y + red / 500.0, y, y - blue / 200.0]
}

fn to_lab(xyz: [f64; 3]) -> [f64; 3] {
    let delta = 6.0 / 29.0_f64;
    let root = |t: f64| {
        if t > delta * delta * delta { t.cbrt() } else { t / (3.0 * delta * delta) + 4.0 / 29.0 }
    };
    let [x, y, z] = xyz.map(root);
    [116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)]
}

/// Colours look paler where it is dark.
fn hunt_adjusted([lightness, a, b]: [f64; 3]) -> [f64; 3] {
    [lightness, 0.01 * lightness * a, 0.01 * lightness * b]
}

/// Source: Abasi, Tehran & Fairchild, "Distance Metrics for Very Large Color Differences" (2020).
fn color_distance(a: [f64; 3], b: [f64; 3]) -> f64 {
    let [lightness, x, y] = [0, 1, 2].map(|c| a[c] - b[c]);
    lightness.abs() + (x * x + y * y).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn seen(color: impl Fn(i32, i32) -> [i32; 3]) -> Seen {
        let size = Size::new(24, 16).unwrap();
        let pixels: Vec<[u8; 3]> =
            (0..24 * 16).map(|k| color(k % 24, k / 24).map(|value| (value % 256) as u8)).collect();
        Seen::new(&pixels, size)
    }

    fn disc(x: i32, y: i32) -> [i32; 3] {
        [if (x - 12) * (x - 12) + (y - 8) * (y - 8) < 30 { 255 } else { 0 }; 3]
    }

    fn ramp(x: i32, y: i32) -> [i32; 3] {
        [x * 10 % 256, y * 15 % 256, x * y * 7 % 256]
    }

    /// The figures are those of the authors' own program, `flip-evaluator` 1.7, which computes in
    /// single precision.
    #[test]
    fn differences_are_those_that_the_authors_program_finds() {
        for (what, a, b, expected) in [
            ("itself", seen(ramp), seen(ramp), 0.0),
            ("its negative", seen(ramp), seen(|x, y| ramp(x, y).map(|v| 255 - v)), 0.915_813),
            (
                "noise",
                seen(ramp),
                seen(|x, y| {
                    let [r, g, b] = ramp(x, y);
                    [r + (x * 31 + y * 17) % 9, g + (x * 13 + y * 7) % 9, b]
                }),
                0.131_535,
            ),
            ("a step aside", seen(disc), seen(|x, y| disc(x - 1, y)), 0.233_839),
            ("a step brighter", seen(|_, _| [128; 3]), seen(|_, _| [129; 3]), 0.029_863),
            ("black and white", seen(|_, _| [0; 3]), seen(|_, _| [255; 3]), 0.967_388),
            ("green and blue", seen(|_, _| [0, 255, 0]), seen(|_, _| [0, 0, 255]), 1.0),
        ] {
            let found = a.mean_difference(&b);
            assert!((found - expected).abs() < 5e-5, "{what}: {found}, not {expected}");
            assert_eq!(found, b.mean_difference(&a), "{what}");
        }
    }
}
