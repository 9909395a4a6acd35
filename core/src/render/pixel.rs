//! A pixel on its way: the sums of its samples, and how far off their mean may be.

use glam::DVec3;

use crate::sample::{FEWEST_FOR_ERROR, RUNS};

/// The samples that a pixel has received, a sum for each run.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Runs {
    sums: [DVec3; RUNS as usize],
    count: u32,
}

impl Runs {
    /// Takes in what the next sample saw: they come in the order of their numbers.
    pub(super) fn add(&mut self, color: DVec3) {
        self.sums[(self.count % RUNS) as usize] += color;
        self.count += 1;
    }

    /// The mean of all samples.
    pub(super) fn mean(&self) -> DVec3 {
        let [a, b, c, d] = self.sums;
        ((a + b) + (c + d)) / f64::from(self.count)
    }

    /// The estimated variance of the mean, per channel, from how far the means of the runs lie
    /// apart: unbiased. `None` with too few samples.
    pub(super) fn variance(&self) -> Option<DVec3> {
        (self.count >= FEWEST_FOR_ERROR).then(|| {
            let mean = self.mean();
            let total = f64::from(self.count);
            let mut sum = DVec3::ZERO;
            for (run, &of_run) in (0..).zip(&self.sums) {
                let share = f64::from((self.count + RUNS - 1 - run) / RUNS);
                let difference = (of_run - share * mean) / total;
                sum += difference * difference;
            }
            sum * (f64::from(RUNS) / f64::from(RUNS - 1))
        })
    }
}

/// A pixel that gets samples until its error is small, and what tells that error.
#[derive(Debug, Clone, Copy)]
pub(super) struct Pixel {
    runs: Runs,
    /// The sum of the samples' squares.
    squares: DVec3,
    /// The least and the largest sample, channel by channel.
    range: [DVec3; 2],
    /// How far apart the first samples of the pixel and its neighbours lie.
    contrast: DVec3,
    /// The variance that faces add which no sample has met.
    unseen: DVec3,
}

/// The variance of the mean where an edge crosses a pixel is about this times the samples' own
/// variance times n^-1.5. Measured on outlines of spheres and polygons.
const EDGE: f64 = 0.65;

/// What a contrast that none of n samples has met adds to the expected variance: this times its
/// square times n^-3. An edge that covers a share c of the pixel, all c as likely, is missed by n
/// samples with (1 - c)^n, and the mean of c² over these is 2 n^-3; some pixels beside an edge
/// have none.
pub(super) const UNSEEN: f64 = 1.5;

/// What a pixel shows of a contrast that runs evenly through its neighbourhood, as of a shade: a
/// fourth. What is beyond that is unseen.
const EVEN: f64 = 4.0;

impl Default for Pixel {
    fn default() -> Self {
        Self {
            runs: Runs::default(),
            squares: DVec3::ZERO,
            range: [DVec3::INFINITY, DVec3::NEG_INFINITY],
            contrast: DVec3::ZERO,
            unseen: DVec3::ZERO,
        }
    }
}

impl Pixel {
    /// Takes in what the next sample saw: they come in the order of their numbers.
    pub(super) fn add(&mut self, color: DVec3) {
        self.runs.add(color);
        self.squares += color * color;
        self.range = [self.range[0].min(color), self.range[1].max(color)];
    }

    /// How many samples there are.
    pub(super) fn count(&self) -> u32 {
        self.runs.count
    }

    /// The mean of all samples.
    pub(super) fn mean(&self) -> DVec3 {
        self.runs.mean()
    }

    /// The least and the largest sample, channel by channel.
    pub(super) fn range(&self) -> [DVec3; 2] {
        self.range
    }

    /// Notes how far apart the first samples of the pixel and its neighbours lie.
    pub(super) fn set_contrast(&mut self, contrast: DVec3) {
        self.contrast = contrast;
    }

    /// Notes the variance that faces add to the mean which no sample has met.
    pub(super) fn set_unseen(&mut self, variance: DVec3) {
        self.unseen = variance;
    }

    /// Whether the estimated standard error is below `error` in each channel.
    pub(super) fn is_below(&self, error: f64) -> bool {
        self.variance().is_some_and(|variance| variance.max_element() < error * error)
    }

    /// The estimated variance of the mean, per channel, to decide by; `None` with too few samples.
    /// Four runs agree by chance now and then, and whoever stops there is wrong. So their variance,
    /// which is worth three numbers, counts as much as that of an edge with the same samples, and
    /// what the neighbours met and this pixel did not yet is added, and what nobody met.
    pub(super) fn variance(&self) -> Option<DVec3> {
        let of_runs = self.runs.variance()?;
        let n = f64::from(self.count());
        let mean = self.mean();
        let variance = (self.squares / n - mean * mean).max(DVec3::ZERO) * (n / (n - 1.0));
        let of_edge = variance * (EDGE / (n * n.sqrt()));
        let missed = (self.contrast - EVEN * (self.range[1] - self.range[0])).max(DVec3::ZERO);
        let of_contrast = missed * missed * (UNSEEN / (n * n * n));
        Some((of_runs + of_edge) / 2.0 + of_contrast + self.unseen)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pixel(colors: impl IntoIterator<Item = f64>) -> Pixel {
        let mut pixel = Pixel::default();
        colors.into_iter().for_each(|color| pixel.add(DVec3::splat(color)));
        pixel
    }

    #[test]
    fn the_variance_of_runs_is_that_of_their_means() {
        // Runs 1 5, 2 6, 3 7, 4 8: means 3, 4, 5, 6 with the variance 5/3.
        let eight = pixel([1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0]).runs;
        assert_eq!(eight.mean(), DVec3::splat(4.5));
        assert!((eight.variance().unwrap().x - 5.0 / 3.0 / 4.0).abs() < 1e-15);
        assert_eq!(pixel([1.0; 7]).runs.variance(), None);
        assert_eq!(pixel([1.0; 9]).runs.variance(), Some(DVec3::ZERO));
    }

    #[test]
    fn what_only_a_neighbour_saw_keeps_a_pixel_open() {
        let mut plain = pixel([0.5; 8]);
        plain.set_contrast(DVec3::ZERO);
        assert!(plain.is_below(1e-9));
        plain.set_contrast(DVec3::X);
        assert!(!plain.is_below(1.0 / 255.0));
        let mut long = pixel([0.5; 64]);
        long.set_contrast(DVec3::X);
        assert!(long.is_below(1.0 / 255.0));
    }

    #[test]
    fn runs_that_agree_by_chance_do_not_close_a_pixel() {
        let mut edge = pixel([0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 1.0]);
        edge.set_contrast(DVec3::ONE);
        assert_eq!(edge.runs.variance(), Some(DVec3::ZERO));
        assert!(!edge.is_below(8.0 / 255.0));
    }
}
