//! The test of a line against the planes of a parallelepiped with x86-64's instructions.

use std::arch::x86_64::{
    __m128d, __m256d, _CMP_EQ_OQ, _CMP_GT_OQ, _CMP_LT_OQ, _mm_add_pd, _mm_and_pd, _mm_andnot_pd,
    _mm_cmpeq_pd, _mm_cmpgt_pd, _mm_cmplt_pd, _mm_cvtsd_f64, _mm_div_pd, _mm_loadu_pd, _mm_max_pd,
    _mm_min_pd, _mm_mul_pd, _mm_or_pd, _mm_set1_pd, _mm_sub_pd, _mm_unpackhi_pd, _mm256_add_pd,
    _mm256_andnot_pd, _mm256_blendv_pd, _mm256_castpd256_pd128, _mm256_cmp_pd, _mm256_div_pd,
    _mm256_extractf128_pd, _mm256_loadu_pd, _mm256_max_pd, _mm256_min_pd, _mm256_movemask_pd,
    _mm256_mul_pd, _mm256_set1_pd, _mm256_setzero_pd, _mm256_sub_pd,
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

/// The operations of `PlaneCrossings`, for four faces at a time: where the line crosses the planes
/// of `face` and the three after it, and how fast it goes outward there.
///
/// # Safety
///
/// The CPU has AVX2.
#[inline(always)]
unsafe fn cross_four((ray, left_at): (&Ray, f64), planes: &BoxPlanes, face: usize) -> [__m256d; 2] {
    assert!(face <= 2, "six faces");
    // SAFETY: the caller says that the CPU has AVX2. The loads read `numbers[face..face + 4]`.
    unsafe {
        let dot = |[ax, ay, az]: [__m256d; 3], [bx, by, bz]: [__m256d; 3]| {
            let sum = _mm256_add_pd(_mm256_mul_pd(ax, bx), _mm256_mul_pd(ay, by));
            _mm256_add_pd(sum, _mm256_mul_pd(az, bz))
        };
        let four = |numbers: &[f64; 6]| _mm256_loadu_pd(numbers.as_ptr().add(face));
        let from = |numbers: &[f64; 6], x: f64| _mm256_sub_pd(four(numbers), _mm256_set1_pd(x));
        let [ox, oy, oz] = ray.origin.to_array();
        let [px, py, pz] = &planes.points;
        let to = [from(px, ox), from(py, oy), from(pz, oz)];
        let [nx, ny, nz] = &planes.normals;
        let normal = [four(nx), four(ny), four(nz)];
        let [dx, dy, dz] = ray.direction.to_array();
        let along = dot(normal, [_mm256_set1_pd(dx), _mm256_set1_pd(dy), _mm256_set1_pd(dz)]);
        let leaving = _mm256_set1_pd(f64::from(ray.leaving.0));
        let is_left = _mm256_cmp_pd::<_CMP_EQ_OQ>(four(&planes.surfaces), leaving);
        let t = _mm256_div_pd(dot(normal, to), along);
        [_mm256_blendv_pd(t, _mm256_set1_pd(left_at), is_left), along]
    }
}

/// What [`cross_box`] finds, four faces at a time; two of them twice.
///
/// # Safety
///
/// The CPU has AVX2.
#[inline(always)]
pub(super) unsafe fn cross_box_with_avx2(
    ray: &Ray,
    left_at: f64,
    planes: &BoxPlanes,
) -> ([f64; 2], f64) {
    // SAFETY: the caller says that the CPU has AVX2.
    unsafe {
        let infinity = _mm256_set1_pd(f64::INFINITY);
        let none = _mm256_set1_pd(f64::NEG_INFINITY);
        let (mut enter, mut leave, mut least) = (none, infinity, infinity);
        for face in [0, 2] {
            let [t, along] = cross_four((ray, left_at), planes, face);
            let inward = _mm256_cmp_pd::<_CMP_LT_OQ>(along, _mm256_setzero_pd());
            let outward = _mm256_cmp_pd::<_CMP_GT_OQ>(along, _mm256_setzero_pd());
            enter = _mm256_max_pd(enter, _mm256_blendv_pd(none, t, inward));
            leave = _mm256_min_pd(leave, _mm256_blendv_pd(infinity, t, outward));
            least = _mm256_min_pd(least, _mm256_andnot_pd(_mm256_set1_pd(-0.0), along));
        }
        let halves = |x| [_mm256_castpd256_pd128(x), _mm256_extractf128_pd::<1>(x)];
        let ([a, b], [c, d], [e, f]) = (halves(enter), halves(leave), halves(least));
        let (enter, leave, least) = (_mm_max_pd(a, b), _mm_min_pd(c, d), _mm_min_pd(e, f));
        let enter = _mm_cvtsd_f64(_mm_max_pd(enter, _mm_unpackhi_pd(enter, enter)));
        let leave = _mm_cvtsd_f64(_mm_min_pd(leave, _mm_unpackhi_pd(leave, leave)));
        let least = _mm_cvtsd_f64(_mm_min_pd(least, _mm_unpackhi_pd(least, least)));
        ([enter, leave], least)
    }
}

/// What `PlaneCrossings::face` finds.
///
/// # Safety
///
/// The CPU has AVX2.
#[inline(always)]
pub(super) unsafe fn face_at_with_avx2(
    rays: (&Ray, f64),
    planes: &BoxPlanes,
    t: f64,
    enters: bool,
) -> u32 {
    let mut faces = 0;
    for face in [0, 2] {
        // SAFETY: the caller says that the CPU has AVX2.
        let [there, inward] = unsafe {
            let [crossings, along] = cross_four(rays, planes, face);
            let is_there = _mm256_cmp_pd::<_CMP_EQ_OQ>(crossings, _mm256_set1_pd(t));
            let is_inward = _mm256_cmp_pd::<_CMP_LT_OQ>(along, _mm256_setzero_pd());
            [_mm256_movemask_pd(is_there), _mm256_movemask_pd(is_inward)]
        };
        faces |= (there & if enters { inward } else { !inward }) << face;
    }
    if faces == 0 { 0 } else { faces.trailing_zeros() }
}
