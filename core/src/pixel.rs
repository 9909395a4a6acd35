//! A pixel on its way: the sums of its samples, and how far off their mean may be.

use glam::DVec3;

use crate::sample::{FEWEST_FOR_ERROR, RUNS};

/// The samples that a pixel has received.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Pixel {
    /// Of each run of samples.
    sums: [DVec3; RUNS as usize],
    count: u32,
    /// The smoothed estimate of the variance of the mean, per channel.
    smoothed: Option<DVec3>,
}

impl Pixel {
    /// Takes in what the next sample saw: they come in the order of their numbers.
    pub(crate) fn add(&mut self, color: DVec3) {
        self.sums[(self.count % RUNS) as usize] += color;
        self.count += 1;
    }

    /// How many samples there are.
    pub(crate) fn count(&self) -> u32 {
        self.count
    }

    /// The mean of all samples.
    pub(crate) fn mean(&self) -> DVec3 {
        let [a, b, c, d] = self.sums;
        ((a + b) + (c + d)) / f64::from(self.count)
    }

    /// The estimated variance of the mean, per channel; `None` with too few samples.
    pub(crate) fn variance(&self) -> Option<DVec3> {
        self.smoothed
    }

    /// Whether the estimated standard error is below `error` in each channel.
    pub(crate) fn is_below(&self, error: f64) -> bool {
        self.smoothed.is_some_and(|variance| variance.max_element() < error * error)
    }

    /// Estimates the variance anew, after a round of samples. Four runs alone say little, so half
    /// of what the round before let expect is taken in: at least half of its variance, for twice
    /// the samples have at most half of it.
    pub(crate) fn note_variance(&mut self) {
        if self.count < FEWEST_FOR_ERROR {
            return;
        }
        let now = self.variance_of_runs();
        self.smoothed = Some(match self.smoothed {
            Some(before) => (now + before / 2.0) / 2.0,
            None => now,
        });
    }

    /// The variance of the mean, from how far the means of the runs lie apart.
    fn variance_of_runs(&self) -> DVec3 {
        let mean = self.mean();
        let total = f64::from(self.count);
        let mut sum = DVec3::ZERO;
        for (run, &of_run) in (0..).zip(&self.sums) {
            let share = f64::from((self.count + RUNS - 1 - run) / RUNS);
            let difference = (of_run - share * mean) / total;
            sum += difference * difference;
        }
        sum * (f64::from(RUNS) / f64::from(RUNS - 1))
    }
}
