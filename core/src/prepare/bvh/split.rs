//! Where a range of primitives is split in two: a binned surface area heuristic for many, every
//! split between neighbours for few.
//!
//! Source: Wald, "On fast Construction of SAH-based Bounding Volume Hierarchies" (2007).

use std::ops::Range;

use glam::Vec4;
use rayon::prelude::*;

use super::primitive::{Bounds, BuildPrimitive};

/// A range of no more primitives is built by one thread.
pub(super) const SERIAL: usize = 4096;

const BINS: usize = 16;

/// Ranges of up to this many primitives have half as many bins.
const MOST_IN_HALF_THE_BINS: usize = 32;

/// Ranges of up to this many primitives are split where it is cheapest of all.
const MOST_SWEPT: usize = 8;

/// One side of a split: a run of primitives.
#[derive(Debug, Clone, Copy)]
pub(super) struct Side {
    /// How many items there are.
    pub(super) count: usize,
    pub(super) bounds: Bounds,
    /// The bounds of twice the centres.
    pub(super) centers: Bounds,
}

impl Side {
    pub(super) fn of(primitives: &[BuildPrimitive]) -> Self {
        let nothing = || Self { count: 0, bounds: Bounds::NONE, centers: Bounds::NONE };
        let measure = |chunk: &[BuildPrimitive]| {
            chunk.iter().fold(nothing(), |mut side, primitive| {
                side.centers.add(primitive.0.twice_center());
                side.bounds = side.bounds.join(&primitive.0);
                side.count += primitive.count() as usize;
                side
            })
        };
        if primitives.len() <= 8 * SERIAL {
            return measure(primitives);
        }
        primitives.par_chunks(SERIAL).map(measure).reduce(nothing, |a, b| Self {
            count: a.count + b.count,
            bounds: a.bounds.join(&b.bounds),
            centers: a.centers.join(&b.centers),
        })
    }
}

/// Room to work in.
pub(super) type Scratch = Vec<BuildPrimitive>;

/// Brings the primitives that make up `whole`, two at least, to the two sides of the cheapest
/// split; how many stand before it, and what is on each side.
pub(super) fn split(
    primitives: &mut [BuildPrimitive],
    whole: &Side,
    scratch: &mut Scratch,
) -> (usize, [Side; 2]) {
    if primitives.len() <= MOST_SWEPT {
        return sweep_split(primitives);
    }
    let found = if primitives.len() <= MOST_IN_HALF_THE_BINS {
        BinnedSplit::cheapest::<{ BINS / 2 }>(primitives, whole)
    } else {
        BinnedSplit::cheapest::<BINS>(primitives, whole)
    };
    let Some(found) = found else {
        // Nothing tells them apart.
        return halve(primitives);
    };
    let at = found.partition(primitives, scratch);
    let (before, behind) = primitives.split_at(at);
    let mut sides = found.sides;
    sides[0].centers = centers_of(before);
    sides[1].centers = centers_of(behind);
    (at, sides)
}

/// Splits primitives in the middle of their order.
pub(super) fn halve(primitives: &[BuildPrimitive]) -> (usize, [Side; 2]) {
    let at = primitives.len() / 2;
    let (before, behind) = primitives.split_at(at);
    (at, [before, behind].map(Side::of))
}

#[inline(always)]
fn centers_of(primitives: &[BuildPrimitive]) -> Bounds {
    let mut centers = Bounds::NONE;
    if primitives.len() > MOST_SWEPT {
        for primitive in primitives {
            centers.add(primitive.0.twice_center());
        }
    }
    centers
}

/// The cheapest of all splits between neighbours in the order of their centres on an axis. The
/// bounds of centres are left out: ranges of so few do without.
fn sweep_split(primitives: &mut [BuildPrimitive]) -> (usize, [Side; 2]) {
    let all: [BuildPrimitive; MOST_SWEPT] =
        std::array::from_fn(|k| primitives[k.min(primitives.len() - 1)]);
    let count = primitives.len();
    let mut best = (f32::INFINITY, 1, std::array::from_fn(|k| k));
    if count > 2 {
        let mut keys = [[0.0; MOST_SWEPT]; 3];
        for (k, primitive) in all.iter().enumerate() {
            let [x, y, z, _] = primitive.0.twice_center().to_array();
            (keys[0][k], keys[1][k], keys[2][k]) = (x, y, z);
        }
        for keys in &keys {
            let order = order_of(keys, count);
            let mut right_cost = [0.0; MOST_SWEPT];
            let (mut side, mut items) = (Bounds::NONE, 0);
            for k in (1..count).rev() {
                let primitive = &all[order[k] % MOST_SWEPT];
                side = side.join(&primitive.0);
                items += primitive.count();
                right_cost[k] = side.half_area() * items as f32;
            }
            (side, items) = (Bounds::NONE, 0);
            for k in 1..count {
                let primitive = &all[order[k - 1] % MOST_SWEPT];
                side = side.join(&primitive.0);
                items += primitive.count();
                let cost = side.half_area() * items as f32 + right_cost[k];
                if cost < best.0 {
                    best = (cost, k, order);
                }
            }
        }
    }
    let (_, at, order) = best;
    let mut sides = [Side { count: 0, bounds: Bounds::NONE, centers: Bounds::NONE }; 2];
    for (k, primitive) in primitives.iter_mut().enumerate() {
        *primitive = all[order[k] % MOST_SWEPT];
        let side = &mut sides[usize::from(k >= at)];
        side.bounds = side.bounds.join(&primitive.0);
        side.count += primitive.count() as usize;
    }
    (at, sides)
}

/// The first `count` numbers in the order of their keys, equal ones in their own.
#[inline(always)]
fn order_of(keys: &[f32; MOST_SWEPT], count: usize) -> [usize; MOST_SWEPT] {
    let mut ranks = [0_u32; MOST_SWEPT];
    for (k, key) in keys.iter().enumerate().take(count) {
        for (other, rank) in ranks.iter_mut().enumerate() {
            let is_before = if k < other { *key <= keys[other] } else { *key < keys[other] };
            *rank += u32::from(is_before);
        }
    }
    let mut order = [0; MOST_SWEPT];
    for (k, rank) in ranks.into_iter().enumerate().take(count) {
        order[rank as usize % MOST_SWEPT] = k;
    }
    order
}

/// The bins of primitives on each axis.
#[derive(Clone, Copy)]
struct Bins<const COUNT: usize> {
    bounds: [[Bounds; COUNT]; 3],
    /// How many items.
    counts: [[u32; COUNT]; 3],
}

/// How the centres of primitives are dealt into bins.
#[derive(Clone, Copy)]
struct Binning {
    low: Vec4,
    scale: Vec4,
    /// The number of the last bin, all ones in binary.
    last: usize,
}

/// The split before a bin.
struct BinnedSplit {
    axis: usize,
    bin: usize,
    /// What is on each side, without the bounds of centres.
    sides: [Side; 2],
    binning: Binning,
}

/// From here to 2^24 neighbouring floats are 1 apart: a small number that is added is rounded to an
/// integer, ties to even ones, which is in the low bits then. [`Binning::bins`] and
/// [`Binning::bin`] round alike.
const ONES: f32 = (3 << 22) as f32;

impl Binning {
    /// The bin of a box on each axis.
    #[inline(always)]
    fn bins(&self, bounds: &Bounds) -> [usize; 3] {
        let at = (bounds.twice_center() - self.low) * self.scale;
        let [x, y, z, _] = (at - 0.5 + ONES).to_array();
        [x, y, z].map(|x| x.to_bits() as usize & self.last)
    }

    /// The same on one axis.
    #[inline(always)]
    fn bin(&self, bounds: &Bounds, axis: usize) -> usize {
        let on_axis = |corner: &Vec4| corner.as_ref()[axis % 4];
        let twice_center = on_axis(&bounds.min) + on_axis(&bounds.max);
        let at = (twice_center - on_axis(&self.low)) * on_axis(&self.scale);
        (at - 0.5 + ONES).to_bits() as usize & self.last
    }

    fn fill<const COUNT: usize>(&self, primitives: &[BuildPrimitive]) -> Bins<COUNT> {
        let mut bins = Bins { bounds: [[Bounds::NONE; COUNT]; 3], counts: [[0; COUNT]; 3] };
        let mut add = |primitive: &BuildPrimitive| {
            for (axis, bin) in self.bins(&primitive.0).into_iter().enumerate() {
                let bounds = &mut bins.bounds[axis][bin % COUNT];
                *bounds = bounds.join(&primitive.0);
                bins.counts[axis][bin % COUNT] += primitive.count();
            }
        };
        // Neighbours often share a bin, and an update waits for the one before it: they are taken
        // from both halves by turns.
        let (first_half, second_half) = primitives.split_at(primitives.len() / 2);
        for (one, other) in first_half.iter().zip(second_half) {
            add(one);
            add(other);
        }
        second_half[first_half.len()..].iter().for_each(add);
        bins
    }
}

impl<const COUNT: usize> Bins<COUNT> {
    fn merge(mut self, other: &Self) -> Self {
        for axis in 0..3 {
            for bin in 0..COUNT {
                self.bounds[axis][bin] = self.bounds[axis][bin].join(&other.bounds[axis][bin]);
                self.counts[axis][bin] += other.counts[axis][bin];
            }
        }
        self
    }

    /// The bounds and the number of items in some bins of an axis.
    fn side(&self, axis: usize, bins: Range<usize>) -> Side {
        let (bounds, counts) = (&self.bounds[axis][bins.clone()], &self.counts[axis][bins]);
        Side {
            count: counts.iter().sum::<u32>() as usize,
            bounds: bounds.iter().fold(Bounds::NONE, Bounds::join),
            centers: Bounds::NONE,
        }
    }
}

impl BinnedSplit {
    /// The split between two bins with the least area x count on its sides; `None` where the
    /// centres do not differ enough for bins.
    fn cheapest<const COUNT: usize>(primitives: &[BuildPrimitive], whole: &Side) -> Option<Self> {
        let extent = (whole.centers.max - whole.centers.min).to_array();
        let mut scale = [0.0; 4];
        for axis in 0..3 {
            let fitting = COUNT as f32 * (1.0 - f32::EPSILON) / extent[axis];
            if extent[axis] > 0.0 && fitting.is_finite() {
                scale[axis] = fitting;
            }
        }
        let scales = Vec4::from_array(scale);
        let binning = Binning { low: whole.centers.min, scale: scales, last: COUNT - 1 };
        let bins: Bins<COUNT> = if primitives.len() > 8 * SERIAL {
            primitives
                .par_chunks(SERIAL)
                .map(|chunk| binning.fill(chunk))
                .reduce_with(|a, b| a.merge(&b))?
        } else {
            binning.fill(primitives)
        };
        // The cheapest: cost, axis and bin.
        let mut best = (f32::INFINITY, 0, 0);
        for axis in (0..3).filter(|&axis| scale[axis] > 0.0) {
            // The first bin and the last one hold the centres at the ends, so no side is empty.
            let mut right_cost = [0.0; COUNT];
            let (mut side, mut items) = (Bounds::NONE, 0);
            for bin in (1..COUNT).rev() {
                side = side.join(&bins.bounds[axis][bin]);
                items += bins.counts[axis][bin];
                right_cost[bin] = side.half_area() * items as f32;
            }
            (side, items) = (Bounds::NONE, 0);
            for (bin, right_cost) in (1..COUNT).zip(&right_cost[1..]) {
                side = side.join(&bins.bounds[axis][bin - 1]);
                items += bins.counts[axis][bin - 1];
                let cost = side.half_area() * items as f32 + right_cost;
                if cost < best.0 {
                    best = (cost, axis, bin);
                }
            }
        }
        let (cost, axis, bin) = best;
        (cost < f32::INFINITY).then(|| {
            let sides = [bins.side(axis, 0..bin), bins.side(axis, bin..COUNT)];
            Self { axis, bin, sides, binning }
        })
    }

    /// Brings those left of the split to the front; how many they are.
    fn partition(&self, primitives: &mut [BuildPrimitive], scratch: &mut Scratch) -> usize {
        let is_left =
            |primitive: &BuildPrimitive| self.binning.bin(&primitive.0, self.axis) < self.bin;
        let count = primitives.len();
        if count > SERIAL {
            return partition_in_place(primitives, is_left);
        }
        if scratch.len() < count {
            scratch.resize(count, primitives[0]);
        }
        let scratch = &mut scratch[..count];
        let (mut left, mut right) = (0, 0);
        for at in 0..count {
            // Both places are written, so that no branch is guessed wrong.
            let primitive = primitives[at];
            primitives[left] = primitive;
            scratch[right] = primitive;
            let is_left = usize::from(is_left(&primitive));
            (left, right) = (left + is_left, right + 1 - is_left);
        }
        primitives[left..].copy_from_slice(&scratch[..right]);
        left
    }
}

/// Brings those that are left to the front, by swapping; how many they are.
fn partition_in_place(
    primitives: &mut [BuildPrimitive],
    is_left: impl Fn(&BuildPrimitive) -> bool,
) -> usize {
    let (mut left, mut right) = (0, primitives.len());
    loop {
        while left < right && is_left(&primitives[left]) {
            left += 1;
        }
        while left < right && !is_left(&primitives[right - 1]) {
            right -= 1;
        }
        if left >= right {
            return left;
        }
        primitives.swap(left, right - 1);
    }
}
