//! The test of a line against the planes of a parallelepiped with x86-64's instructions.

use std::arch::x86_64::{
    __m128d, _mm_add_pd, _mm_and_pd, _mm_andnot_pd, _mm_cmpgt_pd, _mm_cmplt_pd, _mm_cvtsd_f64,
    _mm_div_pd, _mm_max_pd, _mm_min_pd, _mm_mul_pd, _mm_or_pd, _mm_set_pd, _mm_set1_pd, _mm_sub_pd,
    _mm_unpackhi_pd,
};

use super::ray::Ray;
use crate::prepared::record::BoxPlanes;

/// The operations of [`PlaneCrossings`](super::parallelepiped::PlaneCrossings), for two faces at a
/// time. The numbers are the same.
#[inline(always)]
pub(super) fn cross_box(ray: &Ray, planes: &BoxPlanes) -> ([f64; 2], f64) {
    // SAFETY: SSE2 is part of x86-64.
    unsafe { cross_box_with_sse2(ray, planes) }
}

#[inline]
#[target_feature(enable = "sse2")]
fn cross_box_with_sse2(ray: &Ray, planes: &BoxPlanes) -> ([f64; 2], f64) {
    let dot = |[ax, ay, az]: [__m128d; 3], [bx, by, bz]: [__m128d; 3]| {
        let sum = _mm_add_pd(_mm_mul_pd(ax, bx), _mm_mul_pd(ay, by));
        _mm_add_pd(sum, _mm_mul_pd(az, bz))
    };
    let [ox, oy, oz] = ray.origin.to_array();
    let origin = [_mm_set1_pd(ox), _mm_set1_pd(oy), _mm_set1_pd(oz)];
    let [dx, dy, dz] = ray.direction.to_array();
    let direction = [_mm_set1_pd(dx), _mm_set1_pd(dy), _mm_set1_pd(dz)];
    let (zero, sign, infinity) = (_mm_set1_pd(0.0), _mm_set1_pd(-0.0), _mm_set1_pd(f64::INFINITY));
    let mut enter = _mm_set1_pd(f64::NEG_INFINITY);
    let (mut leave, mut least) = (infinity, infinity);
    for face in [0, 2, 4] {
        let pair = |numbers: &[f64; 6]| _mm_set_pd(numbers[face + 1], numbers[face]);
        let [px, py, pz] = &planes.points;
        let to = [
            _mm_sub_pd(pair(px), origin[0]),
            _mm_sub_pd(pair(py), origin[1]),
            _mm_sub_pd(pair(pz), origin[2]),
        ];
        let [nx, ny, nz] = &planes.normals;
        let normal = [pair(nx), pair(ny), pair(nz)];
        let along = dot(normal, direction);
        let t = _mm_div_pd(dot(normal, to), along);
        let (inward, outward) = (_mm_cmplt_pd(along, zero), _mm_cmpgt_pd(along, zero));
        let none = _mm_set1_pd(f64::NEG_INFINITY);
        let entered = _mm_or_pd(_mm_and_pd(inward, t), _mm_andnot_pd(inward, none));
        let left = _mm_or_pd(_mm_and_pd(outward, t), _mm_andnot_pd(outward, infinity));
        enter = _mm_max_pd(enter, entered);
        leave = _mm_min_pd(leave, left);
        least = _mm_min_pd(least, _mm_andnot_pd(sign, along));
    }
    let enter = _mm_cvtsd_f64(_mm_max_pd(enter, _mm_unpackhi_pd(enter, enter)));
    let leave = _mm_cvtsd_f64(_mm_min_pd(leave, _mm_unpackhi_pd(leave, leave)));
    let least = _mm_cvtsd_f64(_mm_min_pd(least, _mm_unpackhi_pd(least, least)));
    ([enter, leave], least)
}
