//! The leaves of solids with x86-64's instructions: a line against the planes of a parallelepiped, and
//! rays side by side.

use std::arch::x86_64::{
    __m128d, __m256, __m256d, _CMP_EQ_OQ, _CMP_GE_OQ, _CMP_GT_OQ, _CMP_LE_OQ, _CMP_LT_OQ,
    _CMP_NEQ_UQ, _mm_add_pd, _mm_and_pd, _mm_andnot_pd, _mm_cmpeq_pd, _mm_cmpgt_pd, _mm_cmplt_pd,
    _mm_cvtsd_f64, _mm_cvtss_f32, _mm_div_pd, _mm_load_si128, _mm_loadu_pd, _mm_max_pd, _mm_max_ps,
    _mm_max_ss, _mm_min_pd, _mm_min_ps, _mm_min_ss, _mm_movehdup_ps, _mm_movehl_ps, _mm_mul_pd,
    _mm_or_pd, _mm_set1_pd, _mm_setzero_ps, _mm_store_si128, _mm_sub_pd, _mm_unpackhi_pd,
    _mm256_add_pd, _mm256_add_ps, _mm256_and_pd, _mm256_andnot_pd, _mm256_andnot_ps,
    _mm256_blendv_pd, _mm256_castpd256_pd128, _mm256_castps256_ps128, _mm256_castsi256_pd,
    _mm256_cmp_pd, _mm256_cmp_ps, _mm256_cvtepu32_epi64, _mm256_cvtpd_ps, _mm256_div_pd,
    _mm256_extractf128_pd, _mm256_extractf128_ps, _mm256_load_pd, _mm256_load_ps, _mm256_loadu_pd,
    _mm256_loadu_ps, _mm256_max_pd, _mm256_max_ps, _mm256_min_pd, _mm256_min_ps,
    _mm256_movemask_pd, _mm256_movemask_ps, _mm256_mul_pd, _mm256_mul_ps, _mm256_or_pd,
    _mm256_set_m128, _mm256_set1_pd, _mm256_set1_ps, _mm256_setzero_pd, _mm256_sqrt_pd,
    _mm256_store_pd, _mm256_store_ps, _mm256_storeu_pd, _mm256_sub_pd, _mm256_sub_ps,
    _mm256_xor_pd,
};

use super::{
    lanes::{Beam, LANES, RayGroup, Turn},
    ray::Ray,
    solid_rays::{
        LEAST_SLACK, MOST_LEAVES, Met, NOWHERE, SLACK, STEEP, Seen, SolidBeam, SolidRays, TOUCHED,
        least_chord,
    },
};
use crate::prepared::{
    node::Node,
    record::{BoxPlanes, LeafRecord, SolidRecord, Surface},
};

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

/// `solid_rays::approach` with AVX2.
///
/// # Safety
///
/// The CPU has AVX2.
#[inline(always)]
pub(super) unsafe fn approach_with_avx2(
    rays: &mut SolidRays,
    (group, turn): (&RayGroup, &Turn),
    solid: &SolidRecord,
) -> bool {
    // SAFETY: the caller says that the CPU has AVX2. Loads and stores, aligned as groups and rays
    // are, take arrays of exactly 8 numbers, those of 64 bits by halves.
    unsafe {
        let splat = |x: f64| _mm256_set1_pd(x);
        let near = &mut rays.near;
        let (scale, sign) = (splat(solid.frame.scale), splat(-0.0));
        let margins = splat(2.0 * solid.margin);
        let [x, y, z] = solid.frame.origin;
        let middle = [splat(x), splat(y), splat(z)];
        let mut rounded = [[_mm_setzero_ps(); 5]; 2];
        let mut leaves_none = 0xF;
        for (half, rounded) in rounded.iter_mut().enumerate() {
            let load = |lanes: &[f64; LANES]| _mm256_load_pd(lanes.as_ptr().add(4 * half));
            let store = |lanes: &mut [f64; LANES], numbers| {
                _mm256_store_pd(lanes.as_mut_ptr().add(4 * half), numbers);
            };
            let [x, y, z] = &group.direction;
            let direction = [load(x), load(y), load(z)];
            let mut origin = direction;
            for (axis, starts) in turn.axes.into_iter().zip(&group.origin) {
                origin[axis % 3] = load(starts);
            }
            let way = |axis: usize| {
                _mm256_mul_pd(_mm256_sub_pd(middle[axis], origin[axis]), direction[axis])
            };
            let ahead = _mm256_add_pd(_mm256_add_pd(way(0), way(1)), way(2));
            let size = _mm256_mul_pd(_mm256_andnot_pd(sign, ahead), scale);
            let start = _mm256_and_pd(ahead, _mm256_cmp_pd::<_CMP_GT_OQ>(size, splat(8.0)));
            for axis in 0..3 {
                store(&mut near.direction[axis], direction[axis]);
                let moved = _mm256_add_pd(origin[axis], _mm256_mul_pd(start, direction[axis]));
                store(&mut near.origin[axis], moved);
                let place = _mm256_mul_pd(_mm256_sub_pd(moved, middle[axis]), scale);
                rounded[axis] = _mm256_cvtpd_ps(place);
            }
            let left_at = _mm256_xor_pd(start, sign);
            store(&mut rays.left_at, left_at);
            let first = _mm256_mul_pd(_mm256_sub_pd(left_at, margins), scale);
            rounded[3] = _mm256_cvtpd_ps(first);
            let reach = _mm256_sub_pd(load(&group.reach), start);
            store(&mut near.reach, reach);
            let last = _mm256_mul_pd(_mm256_add_pd(reach, margins), scale);
            rounded[4] = _mm256_cvtpd_ps(last);
            let leaving = _mm_load_si128(group.leaving.as_ptr().add(4 * half).cast());
            _mm_store_si128(near.leaving.as_mut_ptr().add(4 * half).cast(), leaving);
            // 32 bits as the last digits of 2^52.
            let base = splat((1_u64 << 52) as f64);
            let digits = _mm256_castsi256_pd(_mm256_cvtepu32_epi64(leaving));
            let leaving = _mm256_or_pd(digits, base);
            let leaving = _mm256_sub_pd(leaving, base);
            store(&mut rays.leaving, leaving);
            let none = splat(f64::from(Surface::NONE.0));
            leaves_none &= _mm256_movemask_pd(_mm256_cmp_pd::<_CMP_EQ_OQ>(leaving, none));
        }
        let widened = |k: usize| {
            let number = _mm256_set_m128(rounded[1][k], rounded[0][k]);
            let size = _mm256_andnot_ps(_mm256_set1_ps(-0.0), number);
            let slack = _mm256_mul_ps(size, _mm256_set1_ps(SLACK));
            let slack = _mm256_add_ps(slack, _mm256_set1_ps(LEAST_SLACK));
            [_mm256_sub_ps(number, slack), _mm256_add_ps(number, slack)]
        };
        let store = |lanes: &mut [f32; LANES], numbers| {
            _mm256_store_ps(lanes.as_mut_ptr(), numbers);
        };
        for axis in 0..3 {
            let [low, high] = widened(axis);
            let [first, last] = if turn.is_forward[axis] { [high, low] } else { [low, high] };
            store(&mut near.near_origin[axis], first);
            store(&mut near.far_origin[axis], last);
            store(&mut near.inverse[axis], _mm256_load_ps(group.inverse[axis].as_ptr()));
            let far_inverse = _mm256_load_ps(group.far_inverse[axis].as_ptr());
            store(&mut near.far_inverse[axis], far_inverse);
        }
        store(&mut rays.low, widened(3)[0]);
        store(&mut near.high, widened(4)[1]);
        leaves_none != 0xF
    }
}

/// `solid_rays::surround_near` with AVX2.
///
/// # Safety
///
/// The CPU has AVX2.
#[inline(always)]
pub(super) unsafe fn surround_near_with_avx2(
    rays: &[SolidRays],
    is_forward: [bool; 3],
) -> SolidBeam {
    let mut beam = Beam::EMPTY;
    // SAFETY: the caller says that the CPU has AVX2. The loads, aligned as the rays are, read
    // arrays of exactly 8 floats.
    unsafe {
        let least = |x: __m256| {
            let x = _mm_min_ps(_mm256_castps256_ps128(x), _mm256_extractf128_ps::<1>(x));
            let x = _mm_min_ps(x, _mm_movehl_ps(x, x));
            _mm_cvtss_f32(_mm_min_ss(x, _mm_movehdup_ps(x)))
        };
        let greatest = |x: __m256| {
            let x = _mm_max_ps(_mm256_castps256_ps128(x), _mm256_extractf128_ps::<1>(x));
            let x = _mm_max_ps(x, _mm_movehl_ps(x, x));
            _mm_cvtss_f32(_mm_max_ss(x, _mm_movehdup_ps(x)))
        };
        let (infinity, none) = (_mm256_set1_ps(f32::INFINITY), _mm256_set1_ps(f32::NEG_INFINITY));
        let (mut low, mut high) = (infinity, none);
        for rays in rays {
            low = _mm256_min_ps(_mm256_load_ps(rays.low.as_ptr()), low);
            high = _mm256_max_ps(_mm256_load_ps(rays.near.high.as_ptr()), high);
        }
        beam.high = greatest(high);
        for (axis, forward) in is_forward.into_iter().enumerate() {
            let load = |lanes: &[[f32; LANES]; 3]| _mm256_load_ps(lanes[axis].as_ptr());
            let (mut inverses, mut starts) = ([infinity, none], [none, infinity]);
            for SolidRays { near, .. } in rays {
                let inverse = load(&near.inverse);
                inverses[0] = _mm256_min_ps(inverse, inverses[0]);
                inverses[1] = _mm256_max_ps(inverse, inverses[1]);
                let (first, last) = (load(&near.near_origin), load(&near.far_origin));
                let (upper, lower) = if forward { (first, last) } else { (last, first) };
                starts[0] = _mm256_max_ps(upper, starts[0]);
                starts[1] = _mm256_min_ps(lower, starts[1]);
            }
            let [upper, lower] = [greatest(starts[0]), least(starts[1])];
            let starts = if forward { [upper, lower] } else { [lower, upper] };
            let inverses = [least(inverses[0]), greatest(inverses[1])];
            beam.set_axis((axis, forward), starts, inverses);
        }
        SolidBeam { beam, low: least(low) }
    }
}

/// `solid_rays::touch_beam` with AVX2.
///
/// # Safety
///
/// The CPU has AVX2.
#[inline(always)]
pub(super) unsafe fn touch_beam_with_avx2(node: &Node, beam: &SolidBeam) -> u32 {
    let SolidBeam { beam, low } = beam;
    // SAFETY: the caller says that the CPU has AVX2. The loads read arrays of exactly 8 floats.
    unsafe {
        let (mut enter, mut leave) = (_mm256_set1_ps(*low), _mm256_set1_ps(beam.high));
        for axis in 0..3 {
            let near = _mm256_loadu_ps(node.planes[beam.near[axis]].as_ptr());
            let far = _mm256_loadu_ps(node.planes[beam.far[axis]].as_ptr());
            let near = _mm256_sub_ps(near, _mm256_set1_ps(beam.near_origin[axis]));
            let far = _mm256_sub_ps(far, _mm256_set1_ps(beam.far_origin[axis]));
            let [a, b] = beam.inverse[axis];
            let (a, b) = (_mm256_set1_ps(a), _mm256_set1_ps(b));
            let first = _mm256_min_ps(_mm256_mul_ps(near, a), _mm256_mul_ps(near, b));
            enter = _mm256_max_ps(first, enter);
            let [a, b] = beam.far_inverse[axis];
            let (a, b) = (_mm256_set1_ps(a), _mm256_set1_ps(b));
            let last = _mm256_max_ps(_mm256_mul_ps(far, a), _mm256_mul_ps(far, b));
            leave = _mm256_min_ps(last, leave);
        }
        _mm256_movemask_ps(_mm256_cmp_ps::<_CMP_LE_OQ>(enter, leave)) as u32
    }
}

/// `solid_rays::touch` with AVX2.
///
/// # Safety
///
/// The CPU has AVX2.
#[inline(always)]
pub(super) unsafe fn touch_with_avx2(
    rays: &[SolidRays],
    (groups, asking): (&[(usize, u8)], u8),
    [near, far]: [[f32; 3]; 2],
) -> u8 {
    let mut touching = 0;
    // SAFETY: the caller says that the CPU has AVX2. The loads, aligned as the rays are, read
    // arrays of exactly 8 floats.
    unsafe {
        let splat =
            |x: [f32; 3]| [_mm256_set1_ps(x[0]), _mm256_set1_ps(x[1]), _mm256_set1_ps(x[2])];
        let (near, far) = (splat(near), splat(far));
        for (k, (rays, (_, of_group))) in rays.iter().zip(groups).enumerate() {
            if asking >> k & 1 == 0 {
                continue;
            }
            let group = &rays.near;
            let mut enter = _mm256_load_ps(rays.low.as_ptr());
            let mut leave = _mm256_load_ps(group.high.as_ptr());
            for axis in 0..3 {
                let load = |lanes: &[[f32; LANES]; 3]| _mm256_load_ps(lanes[axis].as_ptr());
                let to_near = _mm256_sub_ps(near[axis], load(&group.near_origin));
                enter = _mm256_max_ps(_mm256_mul_ps(to_near, load(&group.inverse)), enter);
                let to_far = _mm256_sub_ps(far[axis], load(&group.far_origin));
                leave = _mm256_min_ps(_mm256_mul_ps(to_far, load(&group.far_inverse)), leave);
            }
            let met = _mm256_movemask_ps(_mm256_cmp_ps::<_CMP_LE_OQ>(enter, leave)) as u8;
            touching |= u8::from(met & of_group != 0) << k;
        }
    }
    touching
}

/// `solid_rays::meet_ball` with AVX2, four rays at a time.
///
/// # Safety
///
/// The CPU has AVX2.
#[inline(always)]
pub(super) unsafe fn meet_ball_with_avx2<const LEAVE: bool>(
    rays: &SolidRays,
    leaf: &LeafRecord,
    apart: f64,
    [enters, exits]: &mut [[f64; LANES]; 2],
) -> Met {
    let mut met = Met::default();
    for half in [0, 4] {
        // SAFETY: the caller says that the CPU has AVX2. Loads and stores take 4 of 8 numbers, from
        // the first or from the fifth on; the loads are aligned as the rays are.
        unsafe {
            let splat = |x: f64| _mm256_set1_pd(x);
            let load = |lanes: &[f64; LANES]| _mm256_load_pd(lanes.as_ptr().add(half));
            let dot = |[ax, ay, az]: [__m256d; 3], [bx, by, bz]: [__m256d; 3]| {
                let sum = _mm256_add_pd(_mm256_mul_pd(ax, bx), _mm256_mul_pd(ay, by));
                _mm256_add_pd(sum, _mm256_mul_pd(az, bz))
            };
            let [x, y, z] = &rays.near.direction;
            let direction = [load(x), load(y), load(z)];
            let from = |axis: usize| {
                _mm256_sub_pd(load(&rays.near.origin[axis]), splat(leaf.center[axis]))
            };
            let place = [from(0), from(1), from(2)];
            let half_b = _mm256_xor_pd(dot(place, direction), splat(-0.0));
            let on =
                |axis: usize| _mm256_add_pd(place[axis], _mm256_mul_pd(half_b, direction[axis]));
            let closest = [on(0), on(1), on(2)];
            let square = dot(closest, closest);
            let (radius, zero) = (splat(leaf.radius), _mm256_setzero_pd());
            let mut is_left = zero;
            if LEAVE {
                let surface = splat(f64::from(leaf.surface));
                is_left = _mm256_cmp_pd::<_CMP_EQ_OQ>(load(&rays.leaving), surface);
            }
            let most = splat(leaf.radius * leaf.radius * TOUCHED);
            let may_meet = _mm256_cmp_pd::<_CMP_LE_OQ>(square, most);
            let (no_enter, no_exit) = (splat(NOWHERE[0]), splat(NOWHERE[1]));
            if _mm256_movemask_pd(_mm256_or_pd(may_meet, is_left)) == 0 {
                _mm256_storeu_pd(enters.as_mut_ptr().add(half), no_enter);
                _mm256_storeu_pd(exits.as_mut_ptr().add(half), no_exit);
                continue;
            }
            let product = |distance: __m256d| {
                _mm256_mul_pd(_mm256_sub_pd(distance, radius), _mm256_add_pd(distance, radius))
            };
            let closest = _mm256_sqrt_pd(square);
            let discriminant =
                _mm256_mul_pd(_mm256_sub_pd(radius, closest), _mm256_add_pd(radius, closest));
            let sign = _mm256_and_pd(half_b, splat(-0.0));
            let root = _mm256_or_pd(_mm256_sqrt_pd(discriminant), sign);
            let far = _mm256_add_pd(half_b, root);
            let other = _mm256_div_pd(product(_mm256_sqrt_pd(dot(place, place))), far);
            let mut enter = _mm256_min_pd(far, other);
            let mut exit = _mm256_max_pd(other, far);
            let mut is_met = _mm256_cmp_pd::<_CMP_GT_OQ>(discriminant, zero);
            if LEAVE {
                let again = _mm256_add_pd(half_b, half_b);
                enter = _mm256_blendv_pd(enter, _mm256_min_pd(again, zero), is_left);
                exit = _mm256_blendv_pd(exit, _mm256_max_pd(again, zero), is_left);
                is_met = _mm256_or_pd(is_met, is_left);
                let is_far = _mm256_cmp_pd::<_CMP_NEQ_UQ>(load(&rays.left_at), zero);
                let is_in_doubt = _mm256_movemask_pd(_mm256_and_pd(is_left, is_far));
                met.in_doubt |= (is_in_doubt as u64) << half;
            }
            is_met = _mm256_and_pd(is_met, _mm256_cmp_pd::<_CMP_LT_OQ>(enter, exit));
            let chord = _mm256_sub_pd(exit, enter);
            let is_short = _mm256_cmp_pd::<_CMP_LE_OQ>(chord, splat(least_chord(leaf, apart)));
            let bits = |mask| (_mm256_movemask_pd(mask) as u64) << half;
            met.met |= bits(is_met);
            met.in_doubt |= bits(_mm256_and_pd(is_met, is_short));
            let enter = _mm256_blendv_pd(no_enter, enter, is_met);
            _mm256_storeu_pd(enters.as_mut_ptr().add(half), enter);
            let exit = _mm256_blendv_pd(no_exit, exit, is_met);
            _mm256_storeu_pd(exits.as_mut_ptr().add(half), exit);
        }
    }
    met
}

/// `solid_rays::meet_box` with AVX2, four rays at a time.
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

/// `solid_rays::look` with AVX2.
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
