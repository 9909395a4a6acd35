//! A ray as a test against boxes needs it.
//!
//! Boxes are f32, relative to the scene's f64 frame and rounded outward. Source of the rounding:
//! Ize, "Robust BVH Ray Traversal" (2013).

use glam::DVec3;

use crate::{
    exact::float::{above, below},
    prepared::node::Frame,
};

/// A ray ready to meet boxes, in the boxes' frame.
#[derive(Debug, Clone, Copy, bytemuck::Zeroable)]
pub(super) struct BoxRay {
    /// Which of a node's planes is met first on each axis, and which last.
    pub(super) near: [usize; 3],
    pub(super) far: [usize; 3],
    /// The ray's start, rounded so that near planes come nearer and far planes go farther.
    pub(super) near_origin: [f32; 3],
    pub(super) far_origin: [f32; 3],
    pub(super) inverse: [f32; 3],
    /// The same times [`FAR`], for far planes.
    pub(super) far_inverse: [f32; 3],
    /// The stretch of the ray that counts; `high` is NaN for a ray that meets nothing.
    pub(super) low: f32,
    pub(super) high: f32,
    /// Turns a distance along the ray into the boxes' frame: (t - start) · scale.
    pub(super) start: f64,
    pub(super) scale: f64,
    /// What f64 rounding may have taken from a hit's distance, in the boxes' frame.
    pub(super) slack: f64,
}

/// Far planes are moved out by 4 ulp: 2 for the rounding of f32 (Ize 2013), the rest covers that
/// of the f64 tests, which is 2^29 times finer.
pub(super) const FAR: f32 = 1.0 + 4.0 * f32::EPSILON;

/// Three f32 roundings may move a near plane by 1.5 ulp away: so much more is within reach, with
/// what rounding to f32 and adding this takes.
pub(super) const NEAR: f32 = 4.0 * f32::EPSILON;

/// A start that is rounded to f32 is moved by this part of it, which is more than rounding took,
/// and by [`LEAST_SLACK`].
pub(super) const SLACK: f32 = 2.0 * f32::EPSILON;

/// Covers numbers that are too small for f32.
pub(super) const LEAST_SLACK: f32 = 1e-25;

/// A ray that starts nearer to its frame than this is taken as it is.
pub(super) const NEAR_FRAME: f64 = 8.0;

/// How much of the numbers around it a grazed plane's distance may be off: see `docs/proof.md`,
/// boxes.
const GRAZED: f64 = 1.0 / (1_u64 << 27) as f64;

impl BoxRay {
    /// A ray that meets nothing.
    pub(super) const NOWHERE: Self = Self {
        near: [0; 3],
        far: [0; 3],
        near_origin: [0.0; 3],
        far_origin: [0.0; 3],
        inverse: [0.0; 3],
        far_inverse: [0.0; 3],
        low: 0.0,
        high: f32::NAN,
        start: 0.0,
        scale: 1.0,
        slack: 0.0,
    };

    #[inline(always)]
    pub(crate) fn new(origin: DVec3, direction: DVec3, reach: f64, frame: &Frame) -> Self {
        let mut relative = (origin - DVec3::from_array(frame.origin)) * frame.scale;
        // Seen from afar the scene is a speck in f32: start where it begins. All of it lies
        // within sqrt(3) of the frame's origin.
        let mut start = 0.0;
        let mut blur = 0.0;
        let distance = relative.length();
        if distance > NEAR_FRAME {
            start = distance - 2.0;
            relative += start * direction;
            blur = 4.0 * f64::EPSILON * distance;
        }
        let mut ray = Self {
            low: below(-start),
            start: start / frame.scale,
            scale: frame.scale,
            slack: Self::slack(frame, distance),
            ..Self::NOWHERE
        };
        ray.shorten(reach);
        let (o, d) = (relative.to_array(), direction.to_array());
        for axis in 0..3 {
            // Along an axis on which the ray as good as stands still, only its place counts.
            let still = d[axis].abs() < 1e-30;
            let blur = if still { 1e-25 } else { blur };
            let inverse = if still { f64::INFINITY.copysign(d[axis]) } else { 1.0 / d[axis] };
            let place = o[axis] as f32;
            let slack = SLACK * place.abs() + (1.000_001 * blur + f64::from(LEAST_SLACK)) as f32;
            let (low, high) = (place - slack, place + slack);
            let forward = inverse > 0.0;
            ray.inverse[axis] = inverse as f32;
            ray.far_inverse[axis] = ray.inverse[axis] * FAR;
            ray.near[axis] = if forward { axis } else { axis + 3 };
            ray.far[axis] = if forward { axis + 3 } else { axis };
            ray.near_origin[axis] = if forward { high } else { low };
            ray.far_origin[axis] = if forward { low } else { high };
        }
        // A ray that is nowhere, or goes nowhere, meets nothing, above all no boxes of unused
        // children: with a NaN or an infinity it would.
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

    /// A ray that starts not far from the frame, without its start and its direction.
    pub(super) fn near_frame(frame: &Frame) -> Self {
        Self { scale: frame.scale, slack: Self::slack(frame, NEAR_FRAME), ..Self::NOWHERE }
    }

    /// What rounding takes from the distance of a plane that is all but grazed, by the plane's
    /// own bound, for a ray that starts at a distance from the frame.
    #[inline(always)]
    fn slack(frame: &Frame, distance: f64) -> f64 {
        let [x, y, z] = frame.origin.map(f64::abs);
        GRAZED * (distance + 2.0 + (x + y + z) * frame.scale)
    }

    /// The same ray for boxes in another frame, for boxes that it enters before `reach` and leaves
    /// after `from`. It may start elsewhere: at `origin`, not far from the frame.
    #[inline(always)]
    pub(super) fn in_frame(&self, origin: DVec3, [from, reach]: [f64; 2], frame: &Frame) -> Self {
        let relative = (origin - DVec3::from_array(frame.origin)) * frame.scale;
        let mut ray = Self { start: 0.0, scale: frame.scale, slack: 0.0, ..*self };
        for axis in 0..3 {
            // More than rounding to f32 takes, without a look at how it rounds.
            let place = relative[axis] as f32;
            let slack = SLACK * place.abs() + LEAST_SLACK;
            let (low, high) = (place - slack, place + slack);
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
        self.high = self.reach(t);
    }

    /// How far a ray that ends at `t` reaches in the boxes' frame.
    #[inline(always)]
    pub(super) fn reach(&self, t: f64) -> f32 {
        let reach = ((t - self.start) * self.scale + self.slack) as f32;
        reach + reach.abs() * NEAR
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
