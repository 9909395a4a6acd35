//! What the first samples tell of pixels: eight at a time, each as one pixel alone would be told.

use glam::{BVec3, DVec3};

use super::pixel::{
    Around, CERTAIN, CROSSED_BY_EDGE, HIDDEN, Neighbourhood, Pixel, SHADES, Wanted,
};
use crate::{
    isa::Isa,
    tile::Area,
    trace::kernels::{LaneWork, run_in_lanes},
};

/// Pixels that are told at once.
const AT_ONCE: usize = 8;

/// The pixels of a neighbourhood.
const NINE: usize = 9;

/// What one sample in each pixel of an area and of its rim tells of the area's pixels, row by row.
#[derive(Debug)]
pub(super) struct FirstRound {
    pub(super) around: Vec<Around>,
    pub(super) verdicts: Vec<Verdict>,
}

/// What follows for a pixel, as [`Pixel::is_done`], [`Pixel::is_suspect`] and [`Pixel::estimate`]
/// say.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Verdict {
    pub(super) is_done: bool,
    pub(super) is_suspect: bool,
    /// The variance of its mean, where neighbours have no more samples and nothing hides.
    pub(super) variance: Option<DVec3>,
}

impl FirstRound {
    /// Tells the pixels of `area`; `colors` are the samples of `wide`, which has their neighbours.
    pub(super) fn new(area: Area, wide: Area, colors: &[DVec3], wanted: &Wanted, isa: Isa) -> Self {
        let count = area.pixel_count();
        let no_verdict = Verdict { is_done: false, is_suspect: true, variance: None };
        let nothing = Around { variance: None, contrast: DVec3::ZERO, is_edge: BVec3::FALSE };
        let mut round = Self { around: vec![nothing; count], verdicts: vec![no_verdict; count] };
        let frame = area.frame();
        let inner = [(area.columns(), frame.width()), (area.rows(), frame.height())]
            .map(|(pixels, length)| pixels.start.max(1)..pixels.end.min(length.saturating_sub(1)));
        let [columns, rows] = &inner;
        let is_wide = columns.len() >= AT_ONCE;
        for (x, y) in area.pixels() {
            if !(is_wide && columns.contains(&x) && rows.contains(&y)) {
                round.tell_alone((x, y), area, wide, colors, wanted);
            }
        }
        if is_wide {
            let channel = |axis: usize| colors.iter().map(|color| color[axis]).collect();
            let planes: [Vec<f64>; 3] = [0, 1, 2].map(channel);
            let mut work = InLanes { area, wide, inner, planes, wanted, round: &mut round };
            run_in_lanes(isa, &mut work);
        }
        round
    }

    fn tell_alone(
        &mut self,
        (x, y): (u32, u32),
        area: Area,
        wide: Area,
        colors: &[DVec3],
        wanted: &Wanted,
    ) {
        let index = area.index_of(x, y) as usize;
        let around = Neighbourhood::new(wide, x, y, colors).around();
        let pixel = Pixel::new(colors[wide.index_of(x, y) as usize], around);
        self.around[index] = around;
        self.verdicts[index] = Verdict {
            is_done: pixel.is_done(wanted),
            is_suspect: pixel.is_suspect(wanted),
            variance: pixel.estimate(wanted).variance,
        };
    }
}

/// Pixels that have all eight neighbours.
struct InLanes<'a> {
    area: Area,
    wide: Area,
    /// Their columns, at least [`AT_ONCE`], and their rows.
    inner: [std::ops::Range<u32>; 2],
    /// The samples of `wide`, a plane for each channel.
    planes: [Vec<f64>; 3],
    wanted: &'a Wanted,
    round: &'a mut FirstRound,
}

impl LaneWork for InLanes<'_> {
    #[inline(always)]
    fn run(&mut self) {
        let [columns, rows] = self.inner.clone();
        let last = columns.end - AT_ONCE as u32;
        for y in rows {
            // The last lanes overlap those before them.
            for x in columns.clone().step_by(AT_ONCE).map(|x| x.min(last)) {
                self.tell(x, y);
            }
        }
    }
}

impl InLanes<'_> {
    /// Tells the pixels from (x, y) to the right.
    #[expect(clippy::needless_bitwise_bool, reason = "lanes have no branches")]
    #[inline(always)]
    fn tell(&mut self, x: u32, y: u32) {
        let Wanted { error, full_light } = *self.wanted;
        let (mut variances, mut contrasts) = ([[0.0; AT_ONCE]; 3], [[0.0; AT_ONCE]; 3]);
        let mut edges = [[false; AT_ONCE]; 3];
        let (mut clipped, mut told) = ([[0.0; AT_ONCE]; 3], [[0.0; AT_ONCE]; 3]);
        for channel in 0..3 {
            let mut nine = [[0.0; AT_ONCE]; NINE];
            for (k, lanes) in nine.iter_mut().enumerate() {
                let (x, y) = (x + k as u32 % 3 - 1, y + k as u32 / 3 - 1);
                let first = self.wide.index_of(x, y) as usize;
                lanes.copy_from_slice(&self.planes[channel][first..first + AT_ONCE]);
            }
            for lane in 0..AT_ONCE {
                let colors: [f64; NINE] = std::array::from_fn(|k| nine[k][lane]);
                let low = colors.iter().copied().fold(f64::INFINITY, least);
                let contrast = colors.iter().copied().fold(f64::NEG_INFINITY, most) - low;
                contrasts[channel][lane] = contrast;
                edges[channel][lane] = colors.iter().fold(true, |is_edge, color| {
                    let inside = least(color - low, low + contrast - color);
                    is_edge & (SHADES * inside <= contrast)
                });
                variances[channel][lane] = variance_about_plane(&colors);
            }
        }
        for lane in 0..AT_ONCE {
            let is_even = contrasts.iter().all(|lanes| lanes[lane] == 0.0);
            let middle = self.wide.index_of(x, y) as usize + lane;
            for channel in 0..3 {
                let variance = if is_even { 0.0 } else { variances[channel][lane] };
                variances[channel][lane] = variance;
                let least = self.planes[channel][middle] - CERTAIN * variance.sqrt();
                let clip = |variance: f64| {
                    if least >= full_light { 0.0 } else { variance.min(full_light * full_light) }
                };
                let crossed = if edges[channel][lane] { CROSSED_BY_EDGE } else { 1.0 };
                clipped[channel][lane] = clip(variance);
                told[channel][lane] = clip(variance * crossed);
            }
        }
        let first = self.area.index_of(x, y) as usize;
        for lane in 0..AT_ONCE {
            let vector = |lanes: &[[f64; AT_ONCE]; 3]| {
                DVec3::new(lanes[0][lane], lanes[1][lane], lanes[2][lane])
            };
            self.round.around[first + lane] = Around {
                variance: Some(vector(&variances)),
                contrast: vector(&contrasts),
                is_edge: BVec3::new(edges[0][lane], edges[1][lane], edges[2][lane]),
            };
            let most = vector(&clipped).max_element();
            self.round.verdicts[first + lane] = Verdict {
                is_done: most < error * error,
                is_suspect: HIDDEN * most > error * error,
                variance: Some(vector(&told)),
            };
        }
    }
}

#[inline(always)]
fn least(a: f64, b: f64) -> f64 {
    if a < b { a } else { b }
}

#[inline(always)]
fn most(a: f64, b: f64) -> f64 {
    if a > b { a } else { b }
}

/// How far nine samples, row by row, lie from the plane that fits them best, as [`Neighbourhood`]
/// tells it channel by channel.
#[inline(always)]
fn variance_about_plane(colors: &[f64; NINE]) -> f64 {
    let (mut sum, mut across_slope, mut down_slope) = (0.0, 0.0, 0.0);
    let places: [(f64, f64); NINE] =
        std::array::from_fn(|k| ((k % 3) as f64 - 1.0, (k / 3) as f64 - 1.0));
    for (color, (across, down)) in colors.iter().zip(places) {
        sum += color;
        across_slope += across * color;
        down_slope += down * color;
    }
    let mean = sum / 9.0;
    (across_slope, down_slope) = (across_slope / 6.0, down_slope / 6.0);
    let mut rest = 0.0;
    for (color, (across, down)) in colors.iter().zip(places) {
        let off = color - mean - across * across_slope - down * down_slope;
        rest += off * off;
    }
    rest / 6.0
}

#[cfg(test)]
mod tests {
    use rtfarm_oracle::random::Random;

    use super::*;
    use crate::tile::Size;

    #[test]
    fn pixels_in_lanes_are_told_as_each_alone() {
        let mut random = Random::new(1);
        let frame = Size::new(23, 19).unwrap();
        let areas = [([0, 0], [23, 19]), ([3, 2], [9, 8]), ([5, 5], [3, 4]), ([14, 11], [9, 8])];
        for (at, size) in areas {
            let area = Area::new(frame, at, size).unwrap();
            let wide = area.with_rim();
            // Even, shaded, in two shades, bright and noisy places.
            let colors: Vec<DVec3> = wide
                .pixels()
                .map(|(x, y)| {
                    let noise = DVec3::new(random.unit(), random.unit(), random.unit());
                    match (x / 4 + y / 4) % 5 {
                        0 => DVec3::splat(0.25),
                        1 => DVec3::new(f64::from(x), f64::from(y), 1.0) / 64.0,
                        2 => DVec3::splat(f64::from(x % 2)),
                        3 => DVec3::splat(0.99) + 0.05 * noise,
                        _ => noise,
                    }
                })
                .collect();
            for (error, full_light) in [(1.0 / 255.0, 1.0), (0.1, f64::INFINITY), (0.3, 1.0)] {
                let wanted = Wanted { error, full_light };
                for isa in Isa::ALL.into_iter().filter(|isa| isa.is_supported()) {
                    let round = FirstRound::new(area, wide, &colors, &wanted, isa);
                    let mut alone = FirstRound::new(area, wide, &colors, &wanted, isa);
                    for pixel in area.pixels() {
                        alone.tell_alone(pixel, area, wide, &colors, &wanted);
                    }
                    assert_eq!(round.around, alone.around);
                    assert_eq!(round.verdicts, alone.verdicts);
                }
            }
        }
    }
}
