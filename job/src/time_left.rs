//! How long a job will take yet.

use std::time::Duration;

/// How long a job will take yet, if the tiles that are left are like those that are done.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TimeLeft {
    /// The most likely time.
    pub mean: Duration,
    /// One standard deviation of it.
    pub error: Duration,
}

/// What the tiles of a job took that were rendered by this process or its workers.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct TileCosts {
    count: u32,
    /// Of seconds on one thread, and of their squares.
    sums: [f64; 2],
}

impl TileCosts {
    /// Takes a tile in that took so many seconds on one thread.
    pub fn add(&mut self, seconds: f64) {
        self.count += 1;
        self.sums = [self.sums[0] + seconds, self.sums[1] + seconds * seconds];
    }

    /// How long `tiles_left` tiles will take when these took `elapsed`; `None` before the second
    /// tile.
    ///
    /// The sum of m tiles drawn from those that n tiles were drawn from has the variance v (m + m^2
    /// / n), where v is that of one tile: they scatter, and their mean is not known better.
    pub fn time_left(&self, tiles_left: u32, elapsed: Duration) -> Option<TimeLeft> {
        let (done, left) = (f64::from(self.count), f64::from(tiles_left));
        let [sum, squares] = self.sums;
        if self.count < 2 || sum <= 0.0 {
            return None;
        }
        let mean = sum / done;
        let variance = ((squares - sum * mean) / (done - 1.0)).max(0.0);
        // Seconds on the clock for one on a thread.
        let pace = elapsed.as_secs_f64() / sum;
        let error = (variance * (left + left * left / done)).sqrt();
        let [mean, error] = [mean * left, error]
            .map(|seconds| Duration::try_from_secs_f64(seconds * pace).unwrap_or(Duration::MAX));
        Some(TimeLeft { mean, error })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn equal_tiles_leave_no_doubt_and_others_one_of_their_size() {
        let mut costs = TileCosts::default();
        let second = Duration::from_secs(1);
        assert_eq!(costs.time_left(10, second), None);
        costs.add(2.0);
        assert_eq!(costs.time_left(10, second), None);
        costs.add(2.0);
        // Four seconds of two threads' work in two on the clock.
        let left = costs.time_left(10, 2 * second).unwrap();
        assert_eq!((left.mean, left.error), (10 * second, Duration::ZERO));
        let left = costs.time_left(0, 2 * second).unwrap();
        assert_eq!((left.mean, left.error), (Duration::ZERO, Duration::ZERO));
    }

    #[test]
    fn the_error_is_that_of_what_comes_true() {
        // Of many halves of jobs, how often does the second half lie within what the first half
        // told?
        let mut random = 1_u64;
        let mut cost = || {
            random = random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            (random >> 40) as f64 / f64::from(1 << 24)
        };
        let mut within = 0;
        for _ in 0..1000 {
            let mut costs = TileCosts::default();
            let first: f64 = (0..30).map(|_| cost()).inspect(|&cost| costs.add(cost)).sum();
            let second: f64 = (0..50).map(|_| cost()).sum();
            let left = costs.time_left(50, Duration::from_secs_f64(first)).unwrap();
            let off = (second - left.mean.as_secs_f64()).abs();
            within += u32::from(off <= left.error.as_secs_f64());
        }
        // A standard deviation has 68 % of a normal distribution.
        assert!((630..=730).contains(&within), "{within} of 1000");
    }
}
