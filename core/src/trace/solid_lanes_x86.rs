//! The rays of a group in a solid with x86-64's instructions.

use std::arch::x86_64::{
    __m256d, _CMP_EQ_OQ, _CMP_GE_OQ, _CMP_GT_OQ, _CMP_LE_OQ, _CMP_LT_OQ, _mm256_add_pd,
    _mm256_and_pd, _mm256_andnot_pd, _mm256_blendv_pd, _mm256_cmp_pd, _mm256_cmp_ps, _mm256_div_pd,
    _mm256_load_pd, _mm256_load_ps, _mm256_loadu_pd, _mm256_max_pd, _mm256_max_ps, _mm256_min_pd,
    _mm256_min_ps, _mm256_movemask_pd, _mm256_movemask_ps, _mm256_mul_pd, _mm256_mul_ps,
    _mm256_or_pd, _mm256_set1_pd, _mm256_set1_ps, _mm256_setzero_pd, _mm256_storeu_pd,
    _mm256_sub_pd, _mm256_sub_ps,
};

use super::{
    course::STEEP,
    lanes::LANES,
    solid_lanes::{MOST_LEAVES, Met, NOWHERE, Seen, SolidRays},
};
use crate::prepared::{node::Node, record::BoxPlanes};

/// `solid_lanes::touch` with AVX2.
///
/// # Safety
///
/// The CPU has AVX2.
#[inline(always)]
pub(super) unsafe fn touch_with_avx2(
    rays: &SolidRays,
    node: &Node,
    [near, far]: [[usize; 3]; 2],
    asking: u64,
) -> u32 {
    let group = &rays.near;
    let mut touched = 0;
    for (child, _) in node.children.iter().enumerate() {
        // SAFETY: the caller says that the CPU has AVX2. The loads, aligned as the rays are, read
        // arrays of exactly 8 floats.
        let met = unsafe {
            let mut enter = _mm256_load_ps(rays.low.as_ptr());
            let mut leave = _mm256_load_ps(group.high.as_ptr());
            for axis in 0..3 {
                let load = |lanes: &[[f32; LANES]; 3]| _mm256_load_ps(lanes[axis].as_ptr());
                let to_near = _mm256_set1_ps(node.planes[near[axis]][child]);
                let to_near = _mm256_sub_ps(to_near, load(&group.near_origin));
                enter = _mm256_max_ps(_mm256_mul_ps(to_near, load(&group.inverse)), enter);
                let to_far = _mm256_set1_ps(node.planes[far[axis]][child]);
                let to_far = _mm256_sub_ps(to_far, load(&group.far_origin));
                leave = _mm256_min_ps(_mm256_mul_ps(to_far, load(&group.far_inverse)), leave);
            }
            _mm256_movemask_ps(_mm256_cmp_ps::<_CMP_LE_OQ>(enter, leave)) as u64
        };
        touched |= u32::from(met & asking != 0) << child;
    }
    touched
}

/// `solid_lanes::meet_box` with AVX2, four rays at a time.
///
/// # Safety
///
/// The CPU has AVX2.
#[inline(always)]
pub(super) unsafe fn meet_box_with_avx2<const LEAVE: bool>(
    rays: &SolidRays,
    planes: &BoxPlanes,
    apart: f64,
    [enters, exits]: &mut [[f64; LANES]; 2],
) -> Met {
    let mut met = Met::default();
    for half in [0, 4] {
        // SAFETY: the caller says that the CPU has AVX2. Loads and stores take 4 of 8 numbers, from
        // the first or from the fifth on; the loads are aligned as the rays are.
        unsafe {
            let load = |lanes: &[f64; LANES]| _mm256_load_pd(lanes.as_ptr().add(half));
            let dot = |[ax, ay, az]: [__m256d; 3], [bx, by, bz]: [__m256d; 3]| {
                let sum = _mm256_add_pd(_mm256_mul_pd(ax, bx), _mm256_mul_pd(ay, by));
                _mm256_add_pd(sum, _mm256_mul_pd(az, bz))
            };
            let [x, y, z] = &rays.near.origin;
            let origin = [load(x), load(y), load(z)];
            let [x, y, z] = &rays.near.direction;
            let direction = [load(x), load(y), load(z)];
            let infinity = _mm256_set1_pd(f64::INFINITY);
            let none = _mm256_set1_pd(f64::NEG_INFINITY);
            let (mut enter, mut leave, mut least) = (none, infinity, infinity);
            for face in 0..6 {
                let of = |numbers: &[f64; 6]| _mm256_set1_pd(numbers[face]);
                let [px, py, pz] = &planes.points;
                let to = [
                    _mm256_sub_pd(of(px), origin[0]),
                    _mm256_sub_pd(of(py), origin[1]),
                    _mm256_sub_pd(of(pz), origin[2]),
                ];
                let [nx, ny, nz] = &planes.normals;
                let normal = [of(nx), of(ny), of(nz)];
                let along = dot(normal, direction);
                let mut t = _mm256_div_pd(dot(normal, to), along);
                if LEAVE {
                    let surface = of(&planes.surfaces);
                    let is_left = _mm256_cmp_pd::<_CMP_EQ_OQ>(surface, load(&rays.leaving));
                    t = _mm256_blendv_pd(t, load(&rays.left_at), is_left);
                }
                // By the sign of `along`: inward or outward.
                enter = _mm256_max_pd(_mm256_blendv_pd(none, t, along), enter);
                leave = _mm256_min_pd(_mm256_blendv_pd(t, infinity, along), leave);
                least = _mm256_min_pd(_mm256_andnot_pd(_mm256_set1_pd(-0.0), along), least);
            }
            let is_met = _mm256_cmp_pd::<_CMP_LT_OQ>(enter, leave);
            let is_steep = _mm256_cmp_pd::<_CMP_GE_OQ>(least, _mm256_set1_pd(STEEP));
            let length = _mm256_sub_pd(leave, enter);
            let is_long = _mm256_cmp_pd::<_CMP_GT_OQ>(length, _mm256_set1_pd(apart));
            let is_in_doubt = _mm256_andnot_pd(_mm256_and_pd(is_steep, is_long), is_met);
            let is_along = _mm256_cmp_pd::<_CMP_EQ_OQ>(least, _mm256_setzero_pd());
            let bits = |mask| _mm256_movemask_pd(mask) as u64;
            met.met |= bits(is_met) << half;
            met.in_doubt |= (bits(is_in_doubt) | bits(is_along)) << half;
            let [no_enter, no_exit] = NOWHERE;
            let enter = _mm256_blendv_pd(_mm256_set1_pd(no_enter), enter, is_met);
            _mm256_storeu_pd(enters.as_mut_ptr().add(half), enter);
            let leave = _mm256_blendv_pd(_mm256_set1_pd(no_exit), leave, is_met);
            _mm256_storeu_pd(exits.as_mut_ptr().add(half), leave);
        }
    }
    met
}

/// `solid_lanes::look` with AVX2.
///
/// # Safety
///
/// The CPU has AVX2.
#[inline(always)]
pub(super) unsafe fn look_with_avx2(
    ends: &[[[f64; LANES]; 2]],
    (at, reach, apart): (&[f64; LANES], &[f64; LANES], f64),
    inside: &mut [u8; MOST_LEAVES],
    next: &mut [f64; LANES],
) -> Seen {
    // SAFETY: the caller says that the CPU has AVX2. Loads and stores take 4 of 8 numbers, from the
    // first or from the fifth on.
    unsafe {
        let halves = |lanes: &[f64; LANES]| {
            [_mm256_loadu_pd(lanes.as_ptr()), _mm256_loadu_pd(lanes.as_ptr().add(4))]
        };
        let infinity = _mm256_set1_pd(f64::INFINITY);
        let (at, mut nearest) = (halves(at), [infinity; 2]);
        for ([enters, exits], inside) in ends.iter().zip(inside) {
            let (enters, exits) = (halves(enters), halves(exits));
            let mut bits = 0;
            for half in 0..2 {
                let is_before = _mm256_cmp_pd::<_CMP_GT_OQ>(enters[half], at[half]);
                let is_behind = _mm256_cmp_pd::<_CMP_LE_OQ>(exits[half], at[half]);
                let end = _mm256_blendv_pd(exits[half], infinity, is_behind);
                let end = _mm256_blendv_pd(end, enters[half], is_before);
                nearest[half] = _mm256_min_pd(end, nearest[half]);
                // Neither before nor behind it.
                let is_outside = _mm256_or_pd(is_before, is_behind);
                bits |= (_mm256_movemask_pd(is_outside) as u8) << (4 * half);
            }
            *inside = !bits;
        }
        let reach = halves(reach);
        let mut seen = Seen::default();
        for half in 0..2 {
            _mm256_storeu_pd(next.as_mut_ptr().add(4 * half), nearest[half]);
            let is_within = _mm256_cmp_pd::<_CMP_LE_OQ>(nearest[half], reach[half]);
            let is_one = _mm256_cmp_pd::<_CMP_LT_OQ>(nearest[half], infinity);
            let way = _mm256_sub_pd(nearest[half], at[half]);
            let is_near = _mm256_cmp_pd::<_CMP_LE_OQ>(way, _mm256_set1_pd(apart));
            let bits = |mask| (_mm256_movemask_pd(mask) as u64) << (4 * half);
            seen.ahead |= bits(_mm256_and_pd(is_within, is_one));
            seen.near |= bits(is_near);
        }
        seen
    }
}
