//! The test of a line against the planes of a parallelepiped with x86-64's instructions.

use std::arch::x86_64::{
    __m128d, _mm_add_pd, _mm_and_pd, _mm_andnot_pd, _mm_cmpeq_pd, _mm_cmpgt_pd, _mm_cmplt_pd,
    _mm_cvtsd_f64, _mm_div_pd, _mm_loadu_pd, _mm_max_pd, _mm_min_pd, _mm_mul_pd, _mm_or_pd,
    _mm_set1_pd, _mm_sub_pd, _mm_unpackhi_pd,
};

use super::ray::Ray;
use crate::prepared::record::BoxPlanes;

/// The operations of `PlaneCrossings`, for two faces at a time. The numbers are the same.
#[inline(always)]
pub(super) fn cross_box(ray: &Ray, left_at: f64, planes: &BoxPlanes) -> ([f64; 2], f64) {
    // SAFETY: SSE2 is part of x86-64.
    unsafe { cross_box_with_sse2(ray, left_at, planes) }
}

#[inline]
#[target_feature(enable = "sse2")]
fn cross_box_with_sse2(ray: &Ray, left_at: f64, planes: &BoxPlanes) -> ([f64; 2], f64) {
    let dot = |[ax, ay, az]: [__m128d; 3], [bx, by, bz]: [__m128d; 3]| {
        let sum = _mm_add_pd(_mm_mul_pd(ax, bx), _mm_mul_pd(ay, by));
        _mm_add_pd(sum, _mm_mul_pd(az, bz))
    };
    let choose = |mask: __m128d, yes: __m128d, no: __m128d| {
        _mm_or_pd(_mm_and_pd(mask, yes), _mm_andnot_pd(mask, no))
    };
    let (leaving, left_at) = (_mm_set1_pd(f64::from(ray.leaving.0)), _mm_set1_pd(left_at));
    let [ox, oy, oz] = ray.origin.to_array();
    let origin = [_mm_set1_pd(ox), _mm_set1_pd(oy), _mm_set1_pd(oz)];
    let [dx, dy, dz] = ray.direction.to_array();
    let direction = [_mm_set1_pd(dx), _mm_set1_pd(dy), _mm_set1_pd(dz)];
    let (zero, sign, infinity) = (_mm_set1_pd(0.0), _mm_set1_pd(-0.0), _mm_set1_pd(f64::INFINITY));
    let none = _mm_set1_pd(f64::NEG_INFINITY);
    let mut enter = none;
    let (mut leave, mut least) = (infinity, infinity);
    for face in [0, 2, 4] {
        // SAFETY: it reads `numbers[face..face + 2]`, and `face` is 4 at most.
        let pair = |numbers: &[f64; 6]| unsafe { _mm_loadu_pd(numbers.as_ptr().add(face)) };
        let [px, py, pz] = &planes.points;
        let to = [
            _mm_sub_pd(pair(px), origin[0]),
            _mm_sub_pd(pair(py), origin[1]),
            _mm_sub_pd(pair(pz), origin[2]),
        ];
        let [nx, ny, nz] = &planes.normals;
        let normal = [pair(nx), pair(ny), pair(nz)];
        let along = dot(normal, direction);
        let t = choose(
            _mm_cmpeq_pd(pair(&planes.surfaces), leaving),
            left_at,
            _mm_div_pd(dot(normal, to), along),
        );
        let (inward, outward) = (_mm_cmplt_pd(along, zero), _mm_cmpgt_pd(along, zero));
        enter = _mm_max_pd(enter, choose(inward, t, none));
        leave = _mm_min_pd(leave, choose(outward, t, infinity));
        least = _mm_min_pd(least, _mm_andnot_pd(sign, along));
    }
    let enter = _mm_cvtsd_f64(_mm_max_pd(enter, _mm_unpackhi_pd(enter, enter)));
    let leave = _mm_cvtsd_f64(_mm_min_pd(leave, _mm_unpackhi_pd(leave, leave)));
    let least = _mm_cvtsd_f64(_mm_min_pd(least, _mm_unpackhi_pd(least, least)));
    ([enter, leave], least)
}
