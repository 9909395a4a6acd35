//! Pictures against the truth, in numbers.

use rtfarm_core::render::Sampling;

/// How far a picture is off. Channels count alike; 1 is full light.
#[derive(Debug, Clone)]
pub(super) struct Errors {
    /// The root of the mean square.
    pub(super) rmse: f64,
    /// The mean of square / (truth² + 0.01).
    pub(super) relative: f64,
    /// The same as `rmse`, after both were clamped and rounded to 8 bits.
    pub(super) rmse_8_bit: f64,
    /// The mean, with its sign.
    pub(super) mean: f64,
    /// The largest.
    pub(super) worst: f64,
    /// What one channel in a thousand exceeds.
    pub(super) high: f64,
    /// The share of pixels further off than three times the error that was asked for.
    pub(super) wrongly_stopped: Option<f64>,
}

impl Errors {
    pub(super) fn new(pixels: &[[f32; 3]], truth: &[[f64; 3]], sampling: Sampling) -> Self {
        let pairs: Vec<(f64, f64)> = (pixels.as_flattened().iter())
            .zip(truth.as_flattened())
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
        let asked = match sampling {
            Sampling::Adaptive { error, .. } => Some(error),
            Sampling::Fixed(_) => None,
        };
        Self {
            rmse: mean_of(&|found, truth| square(found - truth)).sqrt(),
            relative: mean_of(&|found, truth| square(found - truth) / (truth * truth + 0.01)),
            rmse_8_bit: mean_of(&|found, truth| square(step(found) - step(truth))).sqrt(),
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

/// The middle one.
pub(super) fn median(values: impl IntoIterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.into_iter().collect();
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

/// The mean and half the width of its 95 % band, by the normal law.
pub(super) fn mean_and_band(values: impl IntoIterator<Item = f64>) -> (f64, f64) {
    let values: Vec<f64> = values.into_iter().collect();
    let count = values.len() as f64;
    let mean = values.iter().sum::<f64>() / count;
    let squares: f64 = values.iter().map(|value| (value - mean) * (value - mean)).sum();
    (mean, 1.96 * (squares / (count - 1.0).max(1.0) / count).sqrt())
}

/// The slope of the line that fits the points (x, y) best in logarithms; `None` with fewer than
/// two points above zero.
#[expect(clippy::disallowed_methods, reason = "a slope reaches no pixel")]
pub(super) fn slope(points: impl IntoIterator<Item = (f64, f64)>) -> Option<f64> {
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
        let (found, truth) = ([[0.5, 0.5, 2.0]], [[0.5, 0.0, 1.5]]);
        let sampling = Sampling::Adaptive { error: 0.1, most: 8 };
        let errors = Errors::new(&found, &truth, sampling);
        assert!((errors.rmse - (0.5_f64 / 3.0).sqrt()).abs() < 1e-15);
        assert!((errors.relative - (25.0 + 0.25 / 2.26) / 3.0).abs() < 1e-12);
        // What is brighter than white is white.
        let half = 128.0 / 255.0;
        assert!((errors.rmse_8_bit - f64::sqrt(half * half / 3.0)).abs() < 1e-15);
        assert_eq!((errors.worst, errors.wrongly_stopped), (0.5, Some(2.0 / 3.0)));
    }

    #[test]
    fn a_power_law_has_its_slope() {
        let points = [1.0, 2.0, 4.0, 8.0].map(|x: f64| (x, 3.0 / (x * x.sqrt())));
        assert!((slope(points).unwrap() + 1.5).abs() < 1e-12);
        assert_eq!(slope([(1.0, 1.0)]), None);
    }
}
