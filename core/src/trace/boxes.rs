//! The test of a ray against the eight boxes of a node.
//!
//! Boxes are f32, relative to the scene's f64 frame and rounded outward; a test only ever decides
//! what may be skipped. Source of the rounding: Ize, "Robust BVH Ray Traversal" (2013). Every
//! kernel does the same operations in the same order, so all give the same bits.

use glam::DVec3;

use crate::{
    exact::float::{above, below},
    prepared::node::{Frame, Node},
};

/// A ray ready to meet boxes, in the boxes' frame.
#[derive(Debug, Clone, Copy)]
pub(super) struct BoxRay {
    /// Which of a node's planes is met first on each axis, and which last.
    pub(super) near: [usize; 3],
    pub(super) far: [usize; 3],
    /// The ray's start, rounded so that near planes come nearer and far planes go farther.
    pub(super) near_origin: [f32; 3],
    pub(super) far_origin: [f32; 3],
    pub(super) inverse: [f32; 3],
    /// The stretch of the ray that counts; `high` is NaN for a ray that meets nothing.
    pub(super) low: f32,
    pub(super) high: f32,
    /// Turns a distance along the ray into the boxes' frame: (t - start) · scale.
    start: f64,
    scale: f64,
    /// What f64 rounding may have taken from a hit's distance, in the boxes' frame.
    slack: f64,
}

/// Far planes are moved out by 4 ulp: 2 for the rounding of f32 (Ize 2013), the rest covers that
/// of the f64 tests, which is 2^29 times finer.
pub(super) const FAR: f32 = 1.0 + 4.0 * f32::EPSILON;

/// Three f32 roundings may move a near plane by 1.5 ulp away: so much more is within reach.
const NEAR: f64 = 2.0 * f32::EPSILON as f64;

impl BoxRay {
    #[inline(always)]
    pub(crate) fn new(origin: DVec3, direction: DVec3, reach: f64, frame: &Frame) -> Self {
        let mut relative = (origin - DVec3::from_array(frame.origin)) * frame.scale;
        // Seen from afar the scene is a speck in f32: start where it begins. All of it lies
        // within sqrt(3) of the frame's origin.
        let mut start = 0.0;
        let mut blur = 0.0;
        let distance = relative.length();
        if distance > 8.0 {
            start = distance - 2.0;
            relative += start * direction;
            blur = 4.0 * f64::EPSILON * distance;
        }
        let mut ray = Self {
            near: [0; 3],
            far: [0; 3],
            near_origin: [0.0; 3],
            far_origin: [0.0; 3],
            inverse: [0.0; 3],
            low: below(-start),
            high: 0.0,
            start: start / frame.scale,
            scale: frame.scale,
            slack: 16.0 * f64::EPSILON * (distance + 2.0),
        };
        ray.shorten(reach);
        let (o, d) = (relative.to_array(), direction.to_array());
        for axis in 0..3 {
            // Along an axis on which the ray as good as stands still, only its place counts.
            let still = d[axis].abs() < 1e-30;
            let blur = if still { 1e-25 } else { blur };
            let inverse = if still { f64::INFINITY.copysign(d[axis]) } else { 1.0 / d[axis] };
            let (low, high) = (below(o[axis] - blur), above(o[axis] + blur));
            let forward = inverse > 0.0;
            ray.inverse[axis] = inverse as f32;
            ray.near[axis] = if forward { axis } else { axis + 3 };
            ray.far[axis] = if forward { axis + 3 } else { axis };
            ray.near_origin[axis] = if forward { high } else { low };
            ray.far_origin[axis] = if forward { low } else { high };
        }
        // A ray that is nowhere, or goes nowhere, meets nothing, above all no boxes of unused children: with a NaN
        // or an infinity it would.
        let is_somewhere = |axis: usize| {
            ray.inverse[axis].abs() > 0.0
                && ray.near_origin[axis].is_finite()
                && ray.far_origin[axis].is_finite()
        };
        if direction == DVec3::ZERO || !(0..3).all(is_somewhere) {
            ray.high = f32::NAN;
        }
        ray
    }

    /// The same ray for boxes in another frame, for boxes that it enters before `reach` and leaves
    /// after `from`. It may start elsewhere: at `origin`, not far from the frame.
    #[inline(always)]
    pub(super) fn in_frame(&self, origin: DVec3, [from, reach]: [f64; 2], frame: &Frame) -> Self {
        let relative = (origin - DVec3::from_array(frame.origin)) * frame.scale;
        let mut ray = Self { start: 0.0, scale: frame.scale, slack: 0.0, ..*self };
        for axis in 0..3 {
            let (low, high) = (below(relative[axis] - 1e-25), above(relative[axis] + 1e-25));
            let forward = ray.near[axis] == axis;
            ray.near_origin[axis] = if forward { high } else { low };
            ray.far_origin[axis] = if forward { low } else { high };
        }
        ray.low = below(from * frame.scale);
        ray.high = if self.high.is_nan() { f32::NAN } else { above(reach * frame.scale) };
        ray
    }

    /// Boxes that begin beyond `t` no longer count, nor may those that begin just there be lost:
    /// what is in them may come first in the file.
    #[inline(always)]
    pub(super) fn shorten(&mut self, t: f64) {
        let reach = (t - self.start) * self.scale + self.slack;
        self.high = above(reach + reach.abs() * NEAR);
    }

    /// Where a box that begins at `near` begins along the ray, within rounding.
    #[inline(always)]
    pub(super) fn distance(&self, near: f32) -> f64 {
        f64::from(near) / self.scale + self.start
    }

    /// Whether a box that begins at `near` still counts.
    #[inline(always)]
    pub(super) fn reaches(&self, near: f32) -> bool {
        near <= self.high
    }
}

/// Tests a ray against a node's eight boxes: the distances at which it enters them, and which of
/// them it meets, a bit each. Distances of boxes that are not met mean nothing.
///
/// A kernel is a value, and only a CPU that runs it has one.
pub(super) trait BoxKernel: Copy {
    /// The kernel for code that is compiled for every CPU of the kind.
    type Plain: BoxKernel;

    fn plain(self) -> Self::Plain;

    fn test(self, node: &Node, ray: &BoxRay) -> ([f32; 8], u32);
}

/// The kernel in plain Rust, for every CPU.
#[derive(Debug, Clone, Copy)]
pub(super) struct ScalarBoxes;

impl BoxKernel for ScalarBoxes {
    type Plain = Self;

    #[inline(always)]
    fn plain(self) -> Self {
        self
    }

    #[inline(always)]
    fn test(self, node: &Node, ray: &BoxRay) -> ([f32; 8], u32) {
        // As the SIMD instructions have it: of a NaN (an origin on the plane of a box that the
        // ray runs along) and a number, the second operand is taken.
        let larger = |a: f32, b: f32| if a > b { a } else { b };
        let smaller = |a: f32, b: f32| if a < b { a } else { b };
        let mut distances = [ray.low; 8];
        let mut mask = 0;
        for (child, enter) in distances.iter_mut().enumerate() {
            let mut leave = ray.high;
            for axis in 0..3 {
                let near = node.planes[ray.near[axis]][child] - ray.near_origin[axis];
                let far = node.planes[ray.far[axis]][child] - ray.far_origin[axis];
                *enter = larger(near * ray.inverse[axis], *enter);
                leave = smaller(far * ray.inverse[axis] * FAR, leave);
            }
            mask |= u32::from(*enter <= leave) << child;
        }
        (distances, mask)
    }
}

/// Work that is compiled once for each instruction set.
///
/// What it reads all the time is an argument of its own: the compiler knows of an argument that
/// nothing else changes it, and keeps what it has loaded.
pub(super) trait KernelWork<Input> {
    fn run(&mut self, input: &Input, kernel: impl BoxKernel);
}
