//! A pixel on its way: the sums of its samples, and how far off their mean may be.

use glam::{BVec3, DVec3, FloatExt};

use crate::{
    sample::{FEWEST_FOR_ERROR, RUNS},
    tile::Area,
};

/// What is known of a pixel.
#[derive(Debug, Clone, Copy)]
pub(super) struct Estimate {
    /// The mean of its samples.
    pub(super) mean: DVec3,
    /// The estimated variance of the mean, per channel; `None` where there is too little to go by.
    pub(super) variance: Option<DVec3>,
}

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

    /// The mean of all samples, and its variance from how far the means of the runs lie apart,
    /// which is unbiased.
    pub(super) fn estimate(&self) -> Estimate {
        Estimate { mean: self.mean(), variance: self.variance() }
    }

    fn mean(&self) -> DVec3 {
        let [a, b, c, d] = self.sums;
        ((a + b) + (c + d)) / f64::from(self.count)
    }

    fn variance(&self) -> Option<DVec3> {
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

/// What the first samples of a pixel and of its neighbours tell, channel by channel.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Around {
    /// The variance of one sample; `None` where there are too few.
    pub(super) variance: Option<DVec3>,
    /// How far they lie apart.
    pub(super) contrast: DVec3,
    /// Where they tell an edge between two shades.
    pub(super) is_edge: BVec3,
}

/// The first samples of a pixel and of its neighbours in the frame, one each, row by row.
#[derive(Debug)]
pub(super) struct Neighbourhood {
    colors: [DVec3; 9],
    width: usize,
    height: usize,
}

impl Neighbourhood {
    /// That of the pixel (x, y) of the frame; `colors` are those of `area`, which has all
    /// neighbours.
    pub(super) fn new(area: Area, x: u32, y: u32, colors: &[DVec3]) -> Self {
        let [columns, rows] = [(x, area.columns()), (y, area.rows())]
            .map(|(middle, all)| all.start.max(middle.saturating_sub(1))..all.end.min(middle + 2));
        let (width, height) = (columns.len(), rows.len());
        let mut neighbourhood = Self { colors: [DVec3::ZERO; 9], width, height };
        for (row, y) in rows.enumerate() {
            let first = area.index_of(columns.start, y) as usize;
            neighbourhood.colors[row * width..][..width]
                .copy_from_slice(&colors[first..first + width]);
        }
        neighbourhood
    }

    fn colors(&self) -> &[DVec3] {
        &self.colors[..self.width * self.height]
    }

    /// What they tell.
    pub(super) fn around(&self) -> Around {
        Around { variance: self.variance(), contrast: self.contrast(), is_edge: self.is_edge() }
    }

    /// How far the samples lie apart, channel by channel.
    fn contrast(&self) -> DVec3 {
        let colors = self.colors().iter().copied();
        let low = colors.clone().fold(DVec3::INFINITY, DVec3::min);
        colors.fold(DVec3::NEG_INFINITY, DVec3::max) - low
    }

    /// In which channels the samples tell an edge between two shades: all lie at either end of
    /// them.
    fn is_edge(&self) -> BVec3 {
        let colors = self.colors().iter().copied();
        let low = colors.clone().fold(DVec3::INFINITY, DVec3::min);
        let contrast = self.contrast();
        colors.fold(BVec3::TRUE, |is_edge, color| {
            let inside = (color - low).min(low + contrast - color);
            is_edge & (SHADES * inside).cmple(contrast)
        })
    }

    /// The variance of one sample, channel by channel, from how far the samples lie from the plane
    /// over the pixels' middles that fits them best. As each lies anywhere in its pixel, that is
    /// right for light that grows evenly as for noise. `None` where there are too few.
    fn variance(&self) -> Option<DVec3> {
        let freedom = (self.width * self.height)
            .checked_sub(1 + usize::from(self.width > 1) + usize::from(self.height > 1))
            .filter(|&freedom| freedom > 0)?;
        let colors = self.colors();
        if colors.iter().all(|color| *color == colors[0]) {
            return Some(DVec3::ZERO);
        }
        let offset = |at: usize, length: usize| at as f64 - (length - 1) as f64 / 2.0;
        let places = || {
            (0..self.height).flat_map(|row| {
                (0..self.width)
                    .map(move |column| (offset(column, self.width), offset(row, self.height)))
            })
        };
        let (mut sum, mut slopes, mut squares) = (DVec3::ZERO, [DVec3::ZERO; 2], [0.0; 2]);
        for (&color, (across, down)) in colors.iter().zip(places()) {
            sum += color;
            slopes = [slopes[0] + across * color, slopes[1] + down * color];
            squares = [squares[0] + across * across, squares[1] + down * down];
        }
        let mean = sum / colors.len() as f64;
        let [across_slope, down_slope] =
            [0, 1].map(|k| if squares[k] > 0.0 { slopes[k] / squares[k] } else { DVec3::ZERO });
        let mut rest = DVec3::ZERO;
        for (&color, (across, down)) in colors.iter().zip(places()) {
            let off = color - mean - across * across_slope - down * down_slope;
            rest += off * off;
        }
        Some(rest / freedom as f64)
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
    /// What the neighbourhood's first samples tell.
    around: Around,
    /// How far apart all samples lie that the pixel and its neighbours got first.
    contrast: DVec3,
    /// The variance that faces add which no sample has met.
    unseen: DVec3,
    /// What such faces add in the decision to stop.
    feared: DVec3,
    /// The share of the pixel, 0..=1, of those that later samples met.
    passed_share: f64,
    /// The noise of the pixels beside it, where that is alike.
    noise: Option<Noise>,
}

/// What the first round of the pixels beside one tells of its noise, channel by channel.
#[derive(Debug, Clone, Copy)]
struct Noise {
    /// The variance of one sample.
    of_one: DVec3,
    /// The variance of the mean of [`FEWEST_FOR_ERROR`] samples, as runs tell it.
    of_round: DVec3,
}

/// Pixels in a common noise have variances of one sample within about this factor of each other: of
/// eight samples of a normal law one in 300 has less than an eighth. Beside an edge they have not.
const ALIKE: f64 = 8.0;

/// The variance of the mean where an edge crosses a pixel is about this times the samples' own
/// variance times n^-1.5. Measured on outlines of spheres and polygons.
const EDGE: f64 = 0.65;

/// What a contrast that none of n samples has met adds to the expected variance: this times its
/// square times n^-3. An edge that covers a share c of the pixel, all c as likely, is missed by n
/// samples with (1 - c)^n, and the mean of c² over these is 2 n^-3; some pixels beside an edge
/// have none.
pub(super) const UNSEEN: f64 = 1.5;

/// How much the runs' variance counts in the decision to stop. The more it does the more pixels
/// stop where runs agree by chance; without it thin wires do while too few samples have met them.
const DECISION_OF_RUNS: f64 = 1.0 / 4.0;

/// The share of the variance of a neighbourhood's first samples that their neighbours may hide: an
/// edge that crosses a corner of a pixel, met by no first sample around.
pub(super) const HIDDEN: f64 = 1.0 / 128.0;

/// What counts of a missed contrast in the error that is told, while decisions fear all of it: of
/// the pixels that stay beside an edge it crosses some only. Later it also stands for what pixels
/// hide that stopped where samples agree by chance; in the first round few do.
const CROSSED: f64 = 0.75;
const CROSSED_AT_FIRST: f64 = 0.3;

/// What counts of the variance that a neighbourhood tells which an edge between two shades crosses,
/// in the error that is told of one sample. A straight edge with the contrast c crosses one pixel
/// in each row, whose sample's variance is c²/6 on average. The plane through samples around it
/// takes it for noise of all three pixels beside it, which adds up to 1.67 times as much: measured
/// on spheres and polygons.
pub(super) const CROSSED_BY_EDGE: f64 = 0.6;

/// Two shades lie this many times as far apart as what they differ in themselves, or more.
pub(super) const SHADES: f64 = 16.0;

/// A channel is certainly above full light if its mean is by so many standard errors.
pub(super) const CERTAIN: f64 = 4.0;

/// What a pixel is to come to.
#[derive(Debug, Clone, Copy)]
pub(super) struct Wanted {
    /// Its standard error is to be below this in each channel.
    pub(super) error: f64,
    /// Channels that are certainly above this are good enough; it may be infinite.
    pub(super) full_light: f64,
}

/// What covers less of a pixel is thin: few samples meet it, by chance more or less.
const THIN_SHARE: f64 = 1.0 / 4.0;

/// A thing that covers a small share of a pixel may have so many times the variance of one sample
/// that is expected of it, where samples happened to meet it too often.
const THIN: f64 = 3.0;

/// As long as it is more probable than this that all samples miss a thing, what the mean lacks
/// without it counts [`FEAR`] times.
const MOST_MISSED: f64 = 1.0 / 7.0;
const FEAR: f64 = 4.0;

/// How probable it is that so many samples miss what covers this share of their pixel, 0..=1.
pub(super) fn missed(share: f64, count: u32) -> f64 {
    power(1.0 - share, count)
}

/// Raises `base` to a whole power by squaring.
fn power(base: f64, exponent: u32) -> f64 {
    let (mut product, mut square, mut left) = (1.0, base, exponent);
    while left > 0 {
        if left & 1 == 1 {
            product *= square;
        }
        square *= square;
        left >>= 1;
    }
    product
}

/// The variance that something adds in the decision to stop, whether samples met it or not: where
/// pixels in which they did go on and others stop, light is lacking. It covers this share of the
/// pixel, and the mean lacks so much if no sample meets it.
pub(super) fn feared(share: f64, lack: DVec3, count: u32) -> DVec3 {
    let (n, missed) = (f64::from(count), missed(share, count));
    let expected = (EDGE / (n * n.sqrt())).lerp(1.0 / n, DECISION_OF_RUNS) * (1.0 - share) / share;
    let feared = match share {
        ..THIN_SHARE if missed > MOST_MISSED => FEAR,
        ..THIN_SHARE => expected.max(missed).min(FEAR),
        _ => missed,
    };
    lack * lack * feared
}

/// What a pixel shows of a contrast that runs evenly through its neighbourhood, as of a shade: a
/// fourth. What is beyond that is unseen.
const EVEN: f64 = 4.0;

impl Pixel {
    /// A pixel whose first sample saw `color`.
    pub(super) fn new(color: DVec3, around: Around) -> Self {
        let mut runs = Runs::default();
        runs.add(color);
        Self {
            runs,
            squares: color * color,
            range: [color; 2],
            around,
            contrast: around.contrast,
            unseen: DVec3::ZERO,
            feared: DVec3::ZERO,
            passed_share: 0.0,
            noise: None,
        }
    }

    /// Notes the noise of a neighbourhood, which has this pixel too, if it is alike and all have
    /// had the first round. The own samples are left out: where they decide when to stop, those
    /// whose samples agree by chance stop, and that is a bias of their mean, as it hangs together
    /// with their variance, and of the error they tell.
    pub(super) fn set_noise<'a>(&mut self, around: &(impl Iterator<Item = &'a Self> + Clone)) {
        let count = around.clone().count();
        if count < 2 || around.clone().any(|pixel| pixel.count() < FEWEST_FOR_ERROR) {
            return;
        }
        let of_others = |variance: &dyn Fn(&Self) -> DVec3| {
            let of_all = around.clone().map(variance).sum::<DVec3>();
            (of_all - variance(self)).max(DVec3::ZERO) / (count - 1) as f64
        };
        let of_one = of_others(&Self::variance_of_one);
        if around.clone().all(|pixel| (ALIKE * pixel.variance_of_one()).cmpge(of_one).all()) {
            let of_round = of_others(&|pixel| pixel.runs.variance().unwrap_or_default());
            self.noise = Some(Noise { of_one, of_round });
        }
    }

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

    /// The least and the largest sample, channel by channel.
    pub(super) fn range(&self) -> [DVec3; 2] {
        self.range
    }

    /// Notes the ranges of the samples that the pixel and its neighbours have.
    pub(super) fn set_contrast(&mut self, ranges: impl Iterator<Item = [DVec3; 2]>) {
        let [low, high] = ranges
            .reduce(|a, b| [a[0].min(b[0]), a[1].max(b[1])])
            .expect("a pixel is its own neighbour");
        self.contrast = high - low;
    }

    /// Notes what faces that the first sample missed add to the variance of the mean, and in the
    /// decision to stop, and the share of the pixel, 0..=1, of those that later samples met.
    pub(super) fn set_unseen(&mut self, variance: DVec3, feared: DVec3, passed_share: f64) {
        (self.unseen, self.feared, self.passed_share) = (variance, feared, passed_share);
    }

    /// The mean of all samples and its variance. Of one sample the neighbourhood's first ones tell
    /// it, of more the runs, which have little part in the decision to stop: who stops where runs
    /// agree by chance is wrong, and then tells the contrary.
    pub(super) fn estimate(&self, wanted: &Wanted) -> Estimate {
        let missed = |crossed: f64| crossed * self.missed_variance();
        let variance = match self.runs.count {
            // Neighbours and faces tell of the same edge.
            1 => self.around.variance.map(|variance| {
                let crossed = DVec3::splat(CROSSED_BY_EDGE);
                let crossed = DVec3::select(self.around.is_edge, crossed, DVec3::ONE);
                (variance * crossed).max(self.unseen) + missed(CROSSED_AT_FIRST)
            }),
            n => self.runs.variance().map(|variance| {
                let is_first_round = n <= FEWEST_FOR_ERROR;
                let crossed = if is_first_round { CROSSED_AT_FIRST } else { CROSSED };
                variance + missed(crossed) + self.unseen
            }),
        };
        let variance = variance.map(|variance| self.unclipped(variance, wanted));
        Estimate { mean: self.runs.mean(), variance }
    }

    /// Whether the standard error is expected to be small enough in each channel: nearly that of
    /// an edge with the same samples, but runs that lie far apart keep the pixel open. In a common
    /// noise the neighbours' samples tell both, of thin things their share of the pixel.
    pub(super) fn is_done(&self, wanted: &Wanted) -> bool {
        let n = f64::from(self.runs.count);
        let contrast = self.range[1] - self.range[0];
        let of_thin = contrast * contrast * (self.passed_share * (1.0 - self.passed_share));
        let of_one = self.variance_of_one();
        let of_samples = if self.runs.count == 1 {
            self.around.variance
        } else if self.is_thin() && of_one.cmple(THIN * of_thin).all() {
            Some(DVec3::ZERO)
        } else {
            let noise = self.noise.filter(|noise| of_one.cmple(ALIKE * noise.of_one).all());
            let (of_one, of_runs) = match noise {
                Some(Noise { of_one, of_round }) => {
                    let rounds = n / f64::from(FEWEST_FOR_ERROR);
                    (of_one, Some(of_round / (rounds * rounds.sqrt())))
                }
                None => (of_one, self.runs.variance()),
            };
            let of_edge = of_one * (EDGE / (n * n.sqrt()));
            of_runs.map(|of_runs| of_edge.lerp(of_runs, DECISION_OF_RUNS))
        };
        of_samples.is_some_and(|variance| {
            let passed = feared(self.passed_share, self.passed_share * contrast, self.runs.count);
            let variance = variance + self.missed_variance() + self.feared + passed;
            self.unclipped(variance, wanted).max_element() < wanted.error * wanted.error
        })
    }

    /// Whether the faces that the first sample missed and later ones met are thin.
    fn is_thin(&self) -> bool {
        self.passed_share > 0.0 && self.passed_share < THIN_SHARE
    }

    /// The variance of one sample, channel by channel, from how far several lie apart.
    fn variance_of_one(&self) -> DVec3 {
        let (mean, n) = (self.runs.mean(), f64::from(self.runs.count));
        (self.squares / n - mean * mean).max(DVec3::ZERO) * (n / (n - 1.0))
    }

    /// `variance` of what is left of a pixel that is clipped at full light: 0 in the channels that
    /// are certainly above it, and nowhere more than the square of full light. Samples count as if
    /// they lay by chance, for nobody knows what follows.
    fn unclipped(&self, variance: DVec3, wanted: &Wanted) -> DVec3 {
        if wanted.full_light == f64::INFINITY {
            return variance;
        }
        let of_samples = match self.runs.count {
            1 => self.around.variance.unwrap_or(DVec3::INFINITY),
            n => self.variance_of_one() / f64::from(n),
        };
        let spread = of_samples + self.missed_variance() + self.unseen;
        let least = self.runs.mean() - CERTAIN * spread.map(f64::sqrt);
        let full_light = DVec3::splat(wanted.full_light);
        DVec3::select(least.cmpge(full_light), DVec3::ZERO, variance.min(full_light * full_light))
    }

    /// Whether the first samples of the neighbourhood lie so far apart that the pixels around may
    /// hide an edge worth more samples.
    pub(super) fn is_suspect(&self, wanted: &Wanted) -> bool {
        self.around.variance.is_none_or(|variance| {
            let variance = self.unclipped(variance, wanted);
            HIDDEN * variance.max_element() > wanted.error * wanted.error
        })
    }

    /// The variance that is added by what the neighbours met and this pixel did not yet.
    fn missed_variance(&self) -> DVec3 {
        let shown =
            if self.runs.count == 1 { self.around.contrast } else { self.range[1] - self.range[0] };
        let missed = (self.contrast - EVEN * shown).max(DVec3::ZERO);
        let n = f64::from(self.runs.count);
        missed * missed * (UNSEEN / (n * n * n))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tile::Size;

    fn frame(width: u64, height: u64) -> Area {
        Area::whole(Size::new(width, height).unwrap())
    }

    fn runs(colors: impl IntoIterator<Item = f64>) -> Runs {
        let mut runs = Runs::default();
        colors.into_iter().for_each(|color| runs.add(DVec3::splat(color)));
        runs
    }

    /// A pixel whose neighbours' first samples saw what its own did.
    fn pixel(first: f64, others: impl IntoIterator<Item = f64>) -> Pixel {
        let first = DVec3::splat(first);
        let mut pixel =
            Pixel::new(first, Neighbourhood::new(frame(3, 3), 1, 1, &[first; 9]).around());
        others.into_iter().for_each(|color| pixel.add(DVec3::splat(color)));
        pixel
    }

    fn wanted(error: f64) -> Wanted {
        Wanted { error, full_light: f64::INFINITY }
    }

    #[test]
    fn a_power_is_a_product() {
        assert_eq!(power(0.5, 0), 1.0);
        assert_eq!(power(0.5, 13), 1.0 / 8192.0);
        assert_eq!(power(0.0, 8), 0.0);
    }

    #[test]
    fn the_variance_of_runs_is_that_of_their_means() {
        // Runs 1 5, 2 6, 3 7, 4 8: means 3, 4, 5, 6 with the variance 5/3.
        let eight = runs([1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0]).estimate();
        assert_eq!(eight.mean, DVec3::splat(4.5));
        assert!((eight.variance.unwrap().x - 5.0 / 3.0 / 4.0).abs() < 1e-15);
        assert_eq!(runs([1.0; 7]).estimate().variance, None);
        assert_eq!(runs([1.0; 9]).estimate().variance, Some(DVec3::ZERO));
    }

    #[test]
    fn a_neighbourhood_tells_noise_and_steps_but_no_even_shade() {
        let variance = |size: Area, x, y, color: &dyn Fn(u32, u32) -> f64| {
            let colors: Vec<DVec3> =
                size.pixels().map(|(x, y)| DVec3::splat(color(x, y))).collect();
            Neighbourhood::new(size, x, y, &colors).variance().map(|variance| variance.x)
        };
        let shade = |x: u32, y: u32| 0.5 * f64::from(x) - 0.25 * f64::from(y);
        for (x, y) in [(0, 0), (1, 1), (2, 0), (1, 2)] {
            assert!(variance(frame(3, 3), x, y, &shade).unwrap() < 1e-30);
        }
        // A chequered neighbourhood of mean 5/9: 5 · 16/81 + 4 · 25/81 of 6 degrees of freedom.
        let chequered = |x: u32, y: u32| f64::from((x + y + 1) % 2);
        let found = variance(frame(3, 3), 1, 1, &chequered).unwrap();
        assert!((found - 20.0 / 9.0 / 6.0).abs() < 1e-15, "{found}");
        let step = |x: u32, _| if x < 1 { 0.0 } else { 1.0 };
        assert!(variance(frame(3, 3), 1, 1, &step).unwrap() > 0.05);
        assert!(variance(frame(3, 1), 1, 0, &step).unwrap() > 0.05);
        assert_eq!(variance(frame(2, 1), 0, 0, &shade), None);
        assert_eq!(variance(frame(1, 1), 0, 0, &shade), None);
    }

    #[test]
    fn what_only_a_neighbour_saw_keeps_a_pixel_open() {
        let mut one = pixel(0.5, []);
        assert!(one.is_done(&wanted(1e-9)) && !one.is_suspect(&wanted(1e-9)));
        let seen = [[DVec3::splat(0.5); 2], [DVec3::ZERO, DVec3::splat(0.5)]];
        one.set_contrast(seen.into_iter());
        assert!(!one.is_done(&wanted(16.0 / 255.0)));
        let mut eight = pixel(0.5, [0.5; 7]);
        assert!(eight.is_done(&wanted(1e-9)));
        eight.set_contrast(seen.into_iter());
        assert!(!eight.is_done(&wanted(1.0 / 255.0)));
        let mut long = pixel(0.5, [0.5; 63]);
        long.set_contrast(seen.into_iter());
        assert!(long.is_done(&wanted(1.0 / 255.0)));
    }

    #[test]
    fn runs_that_agree_by_chance_do_not_close_a_pixel() {
        let edge = pixel(0.0, [0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 1.0]);
        assert_eq!(edge.estimate(&wanted(1.0)).variance, Some(DVec3::ZERO));
        assert!(!edge.is_done(&wanted(8.0 / 255.0)));
    }

    #[test]
    fn in_a_common_noise_the_neighbours_decide() {
        let noisy = [0.9, 0.1, 0.8, 0.2, 0.9, 0.1, 0.7];
        let calm = [0.5, 0.51, 0.49, 0.5, 0.52, 0.5, 0.5];
        let decide = |own: &[f64], others: [&[f64]; 8], more: usize| {
            let mut own = pixel(0.5, own.iter().copied());
            let others = others.map(|others| pixel(0.5, others.iter().copied()));
            own.set_noise(&others.iter().chain([&own.clone()]));
            (0..more).for_each(|_| own.add(DVec3::splat(0.5)));
            own.is_done(&wanted(0.03))
        };
        // Whose samples agree by chance goes on as the others do, and stops when they would.
        let lucky = [0.3, 0.7, 0.4, 0.5, 0.7, 0.3, 0.6];
        assert!(pixel(0.5, lucky).is_done(&wanted(0.03)) && !decide(&lucky, [&noisy; 8], 0));
        assert!(decide(&noisy, [&noisy; 8], 56));
        // What another kind of pixel tells counts for nothing, on either side.
        let mut mixed = [&noisy[..]; 8];
        mixed[3] = &calm;
        assert!(decide(&lucky, mixed, 0) && !decide(&noisy, [&calm; 8], 0));
        // Nor does it where later samples see what no neighbour did.
        let mut surprised = pixel(0.5, [0.5; 7]);
        surprised.set_noise(&[pixel(0.5, [0.5; 7]); 9].iter());
        assert!(surprised.is_done(&wanted(0.03)));
        (0..8).for_each(|k| surprised.add(DVec3::splat(f64::from(k % 2))));
        assert!(!surprised.is_done(&wanted(0.03)));
    }

    #[test]
    fn what_is_certainly_above_full_light_is_done_where_it_is_clipped() {
        let clipped = Wanted { error: 1.0 / 255.0, full_light: 1.0 };
        let bright = pixel(2.5, [2.0, 3.0, 2.5, 2.0, 3.0, 2.5, 2.5]);
        assert!(bright.is_done(&clipped) && !bright.is_done(&wanted(1.0 / 255.0)));
        assert_eq!(bright.estimate(&clipped).variance, Some(DVec3::ZERO));
        assert!(bright.estimate(&wanted(1.0 / 255.0)).variance.unwrap().x > 0.0);
        // Its mean is above full light, but may not stay so.
        let doubtful = pixel(0.0, [3.0, 0.0, 3.0, 0.0, 3.0, 0.0, 3.0]);
        assert!(!doubtful.is_done(&clipped));
        // One channel is not.
        let mut yellow = bright;
        for _ in 0..2 {
            yellow.add(DVec3::new(2.5, 2.5, 0.0));
        }
        assert!(!yellow.is_done(&clipped));
        // What the neighbours saw may be in it too.
        let mut beside = pixel(1.2, []);
        assert!(beside.is_done(&clipped));
        beside.set_contrast([[DVec3::ZERO, DVec3::splat(1.2)]].into_iter());
        assert!(!beside.is_done(&clipped));
    }
}
