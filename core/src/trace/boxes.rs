//! A node of the 8-wide hierarchy and the kernels that test a ray against its boxes.
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
pub(crate) struct BoxRay {
    /// Which of a node's planes is met first on each axis, and which last.
    near: [usize; 3],
    far: [usize; 3],
    /// The ray's start, rounded so that near planes come nearer and far planes go farther.
    near_origin: [f32; 3],
    far_origin: [f32; 3],
    inverse: [f32; 3],
    /// The stretch of the ray that counts; `high` is NaN for a ray that meets nothing.
    low: f32,
    high: f32,
    /// Turns a distance along the ray into the boxes' frame: (t - start) · scale.
    start: f64,
    scale: f64,
    /// What f64 rounding may have taken from a hit's distance, in the boxes' frame.
    slack: f64,
}

/// Far planes are moved out by 4 ulp: 2 for the rounding of f32 (Ize 2013), the rest covers that
/// of the f64 tests, which is 2^29 times finer.
const FAR: f32 = 1.0 + 4.0 * f32::EPSILON;

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

    /// Boxes that begin beyond `t` no longer count, nor may those that begin just there be lost:
    /// what is in them may come first in the file.
    #[inline(always)]
    pub(crate) fn shorten(&mut self, t: f64) {
        let reach = (t - self.start) * self.scale + self.slack;
        self.high = above(reach + reach.abs() * NEAR);
    }

    /// Whether a box that begins at `near` still counts.
    #[inline(always)]
    pub(crate) fn reaches(&self, near: f32) -> bool {
        near <= self.high
    }
}

/// Tests a ray against a node's eight boxes: the distances at which it enters them, and which of
/// them it meets, a bit each. Distances of boxes that are not met mean nothing.
pub(crate) trait BoxKernel {
    fn test(node: &Node, ray: &BoxRay) -> ([f32; 8], u32);
}

/// Plain Rust.
pub(crate) struct ScalarBoxes;

impl BoxKernel for ScalarBoxes {
    #[inline(always)]
    fn test(node: &Node, ray: &BoxRay) -> ([f32; 8], u32) {
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

#[cfg(target_arch = "x86_64")]
#[expect(unsafe_code, reason = "SIMD intrinsics")]
pub(crate) mod x86 {
    //! The same with SSE2 and AVX2.

    use std::arch::x86_64::{
        _CMP_LE_OQ, _mm_cmple_ps, _mm_loadu_ps, _mm_max_ps, _mm_min_ps, _mm_movemask_ps,
        _mm_mul_ps, _mm_set1_ps, _mm_storeu_ps, _mm_sub_ps, _mm256_cmp_ps, _mm256_loadu_ps,
        _mm256_max_ps, _mm256_min_ps, _mm256_movemask_ps, _mm256_mul_ps, _mm256_set1_ps,
        _mm256_storeu_ps, _mm256_sub_ps,
    };

    use super::{BoxKernel, BoxRay, FAR, Node};

    /// Four boxes at a time.
    pub(crate) struct Sse2Boxes;

    impl BoxKernel for Sse2Boxes {
        #[inline(always)]
        fn test(node: &Node, ray: &BoxRay) -> ([f32; 8], u32) {
            let mut distances = [0.0; 8];
            let mut mask = 0;
            for half in [0, 4] {
                // SAFETY: SSE2 is part of x86-64. The loads read `planes[_][half..half + 4]` and
                // the store writes `distances[half..half + 4]`, both within 8 floats.
                unsafe {
                    let mut enter = _mm_set1_ps(ray.low);
                    let mut leave = _mm_set1_ps(ray.high);
                    for axis in 0..3 {
                        let near = _mm_loadu_ps(node.planes[ray.near[axis]].as_ptr().add(half));
                        let far = _mm_loadu_ps(node.planes[ray.far[axis]].as_ptr().add(half));
                        let inverse = _mm_set1_ps(ray.inverse[axis]);
                        let near = _mm_sub_ps(near, _mm_set1_ps(ray.near_origin[axis]));
                        let far = _mm_sub_ps(far, _mm_set1_ps(ray.far_origin[axis]));
                        enter = _mm_max_ps(_mm_mul_ps(near, inverse), enter);
                        let far = _mm_mul_ps(_mm_mul_ps(far, inverse), _mm_set1_ps(FAR));
                        leave = _mm_min_ps(far, leave);
                    }
                    _mm_storeu_ps(distances.as_mut_ptr().add(half), enter);
                    let met = _mm_movemask_ps(_mm_cmple_ps(enter, leave));
                    mask |= (met as u32) << half;
                }
            }
            (distances, mask)
        }
    }

    /// All eight at once. Only for code that [`crate::isa::Isa::is_supported`] lets through.
    pub(crate) struct Avx2Boxes;

    impl BoxKernel for Avx2Boxes {
        #[inline(always)]
        fn test(node: &Node, ray: &BoxRay) -> ([f32; 8], u32) {
            let mut distances = [0.0; 8];
            // SAFETY: the loads and the store cover exactly 8 floats. Callers run this only on
            // CPUs with AVX2: `trace` hands it out through `trace_avx2`, whose caller has asked.
            let mask = unsafe {
                let mut enter = _mm256_set1_ps(ray.low);
                let mut leave = _mm256_set1_ps(ray.high);
                for axis in 0..3 {
                    let near = _mm256_loadu_ps(node.planes[ray.near[axis]].as_ptr());
                    let far = _mm256_loadu_ps(node.planes[ray.far[axis]].as_ptr());
                    let inverse = _mm256_set1_ps(ray.inverse[axis]);
                    let near = _mm256_sub_ps(near, _mm256_set1_ps(ray.near_origin[axis]));
                    let far = _mm256_sub_ps(far, _mm256_set1_ps(ray.far_origin[axis]));
                    enter = _mm256_max_ps(_mm256_mul_ps(near, inverse), enter);
                    let far = _mm256_mul_ps(_mm256_mul_ps(far, inverse), _mm256_set1_ps(FAR));
                    leave = _mm256_min_ps(far, leave);
                }
                _mm256_storeu_ps(distances.as_mut_ptr(), enter);
                _mm256_movemask_ps(_mm256_cmp_ps::<_CMP_LE_OQ>(enter, leave)) as u32
            };
            (distances, mask)
        }
    }
}
