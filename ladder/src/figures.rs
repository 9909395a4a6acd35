//! What is measured: how far pictures are from the truth, and what many runs have in common.

use std::fmt;

use rtfarm_core::tile::Size;

use crate::flip::Seen;

/// A true picture.
#[derive(Debug)]
pub struct Truth {
    /// The mean over each pixel, linear, row by row.
    pub pixels: Vec<[f64; 3]>,
    /// Its width and height.
    pub size: Size,
    /// It as the eye takes it in.
    seen: Seen,
}

impl Truth {
    /// Takes the mean over each pixel, linear, row by row, 1 being full light.
    pub fn new(pixels: Vec<[f64; 3]>, size: Size) -> Self {
        let seen = Seen::new(&in_8_bits(pixels.as_flattened().iter().copied()), size);
        Self { pixels, size, seen }
    }
}

/// As a PNG of 8 bits a channel has it.
fn in_8_bits(channels: impl Iterator<Item = f64>) -> Vec<[u8; 3]> {
    let bytes: Vec<u8> = channels.map(|x| (255.0 * x.clamp(0.0, 1.0)).round() as u8).collect();
    bytes.as_chunks().0.to_vec()
}

/// How far a picture is off. Channels count alike; 1 is full light.
#[derive(Debug, Clone)]
pub struct Errors {
    /// The root of the mean square.
    pub rmse: f64,
    /// The mean of square / (truth² + 0.01).
    pub relative: f64,
    /// The same as `rmse`, after both were clamped and rounded to 8 bits.
    pub rmse_8_bit: f64,
    /// The mean difference to the eye, 0 to 1, of what is left in 8 bits.
    pub flip: f64,
    /// The mean difference, with its sign.
    pub mean: f64,
    /// The largest difference of a channel.
    pub worst: f64,
    /// The difference that one channel in a thousand exceeds.
    pub high: f64,
    /// The share of pixels further off than three times the error that was asked for.
    pub wrongly_stopped: Option<f64>,
}

impl Errors {
    /// Compares the linear pixels of a picture with the truth of its size. `asked` is the error
    /// that was asked for.
    pub fn new(pixels: &[[f32; 3]], truth: &Truth, asked: Option<f64>) -> Self {
        let pairs: Vec<(f64, f64)> = (pixels.as_flattened().iter())
            .zip(truth.pixels.as_flattened())
            .map(|(&found, &truth)| (f64::from(found), truth))
            .collect();
        let mean_of = |of: &dyn Fn(f64, f64) -> f64| {
            pairs.iter().map(|&(found, truth)| of(found, truth)).sum::<f64>() / pairs.len() as f64
        };
        let square = |x: f64| x * x;
        let step = |x: f64| (255.0 * x.clamp(0.0, 1.0)).round() / 255.0;
        let mut sizes: Vec<f64> =
            pairs.iter().map(|(found, truth)| (found - truth).abs()).collect();
        sizes.sort_by(f64::total_cmp);
        Self {
            rmse: mean_of(&|found, truth| square(found - truth)).sqrt(),
            relative: mean_of(&|found, truth| square(found - truth) / (truth * truth + 0.01)),
            rmse_8_bit: mean_of(&|found, truth| square(step(found) - step(truth))).sqrt(),
            flip: Seen::new(&in_8_bits(pairs.iter().map(|pair| pair.0)), truth.size)
                .mean_difference(&truth.seen),
            mean: mean_of(&|found, truth| found - truth),
            worst: sizes[sizes.len() - 1],
            high: sizes[(sizes.len() * 999 / 1000).min(sizes.len() - 1)],
            wrongly_stopped: asked.map(|asked| {
                let far = sizes.iter().filter(|&&size| size > 3.0 * asked).count();
                far as f64 / sizes.len() as f64
            }),
        }
    }
}

/// Where the middle of some values lies, and the middle half of them.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Quartiles {
    /// A quarter of the values is below.
    pub low: f64,
    /// Half of the values is below.
    pub median: f64,
    /// Three quarters of the values are below.
    pub high: f64,
}

impl Quartiles {
    /// Finds those of one value at least.
    pub fn new(values: &[f64]) -> Self {
        let mut sorted = values.to_vec();
        sorted.sort_by(f64::total_cmp);
        let at = |quarters: usize| sorted[(quarters * (sorted.len() - 1) + 2) / 4];
        Self { low: at(1), median: at(2), high: at(3) }
    }
}

/// The median and, in brackets, the quartiles: three digits of each.
impl fmt::Display for Quartiles {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let digits = decimals(self.median);
        let Self { low, median, high } = self;
        write!(f, "{median:.digits$} ({low:.digits$}–{high:.digits$})")
    }
}

/// How many digits after the point a number from 1 up is shown with: three digits in all.
pub fn decimals(number: f64) -> usize {
    [100.0, 10.0].iter().filter(|&&size| number < size).count()
}

/// The middle one of some values; there is one at least.
pub fn median(values: &[f64]) -> f64 {
    Quartiles::new(values).median
}

/// The mean of some values and half the width of its 95 % band, by the normal law.
pub fn mean_and_band(values: impl IntoIterator<Item = f64>) -> (f64, f64) {
    let values: Vec<f64> = values.into_iter().collect();
    let count = values.len() as f64;
    let mean = values.iter().sum::<f64>() / count;
    let squares: f64 = values.iter().map(|value| (value - mean) * (value - mean)).sum();
    (mean, 1.96 * (squares / (count - 1.0).max(1.0) / count).sqrt())
}

/// The slope of the line that fits the points (x, y) best in logarithms; `None` with fewer than
/// two points above zero.
#[expect(clippy::disallowed_methods, reason = "a slope reaches no pixel")]
pub fn slope(points: impl IntoIterator<Item = (f64, f64)>) -> Option<f64> {
    let points: Vec<(f64, f64)> = (points.into_iter())
        .filter(|&(x, y)| x > 0.0 && y > 0.0)
        .map(|(x, y)| (x.ln(), y.ln()))
        .collect();
    let count = points.len() as f64;
    let x = points.iter().map(|point| point.0).sum::<f64>() / count;
    let y = points.iter().map(|point| point.1).sum::<f64>() / count;
    let along: f64 = points.iter().map(|point| (point.0 - x) * (point.0 - x)).sum();
    let both: f64 = points.iter().map(|point| (point.0 - x) * (point.1 - y)).sum();
    (points.len() > 1 && along > 0.0).then(|| both / along)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_are_those_of_a_picture_worked_out_by_hand() {
        let truth = Truth::new(vec![[0.5, 0.0, 1.5]], Size::new(1, 1).unwrap());
        let found = [[0.5, 0.5, 2.0]];
        let errors = Errors::new(&found, &truth, Some(0.1));
        assert!((errors.rmse - (0.5_f64 / 3.0).sqrt()).abs() < 1e-15);
        assert!((errors.relative - (25.0 + 0.25 / 2.26) / 3.0).abs() < 1e-12);
        // What is brighter than white is white.
        let half = 128.0 / 255.0;
        assert!((errors.rmse_8_bit - f64::sqrt(half * half / 3.0)).abs() < 1e-15);
        assert_eq!((errors.worst, errors.wrongly_stopped), (0.5, Some(2.0 / 3.0)));
    }

    #[test]
    fn the_quartiles_part_the_values_in_four() {
        let quartiles = Quartiles::new(&[9.0, 1.0, 3.0, 5.0, 7.0]);
        assert_eq!(quartiles, Quartiles { low: 3.0, median: 5.0, high: 7.0 });
        assert_eq!(quartiles.to_string(), "5.00 (3.00–7.00)");
        assert_eq!(Quartiles::new(&[123.4]).to_string(), "123 (123–123)");
    }

    #[test]
    fn a_power_law_has_its_slope() {
        let points = [1.0, 2.0, 4.0, 8.0].map(|x: f64| (x, 3.0 / (x * x.sqrt())));
        assert!((slope(points).unwrap() + 1.5).abs() < 1e-12);
        assert_eq!(slope([(1.0, 1.0)]), None);
    }
}
