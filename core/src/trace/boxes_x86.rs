//! The test of a ray against a node's boxes with x86-64's instructions, and those of several rays.

use std::arch::x86_64::{
    __m256, __m256d, _CMP_EQ_OQ, _CMP_GE_OQ, _CMP_GT_OQ, _CMP_LE_OQ, _CMP_LT_OQ, _MM_HINT_T0,
    _mm_add_ps, _mm_andnot_ps, _mm_cmple_ps, _mm_cvtss_f32, _mm_loadu_ps, _mm_max_ps, _mm_max_ss,
    _mm_min_ps, _mm_min_ss, _mm_movehdup_ps, _mm_movehl_ps, _mm_movemask_ps, _mm_mul_ps,
    _mm_prefetch, _mm_set1_ps, _mm_setzero_ps, _mm_storeu_ps, _mm_sub_ps, _mm256_add_pd,
    _mm256_add_ps, _mm256_and_pd, _mm256_and_ps, _mm256_andnot_pd, _mm256_andnot_ps,
    _mm256_blendv_pd, _mm256_castpd_ps, _mm256_castpd_si256, _mm256_castps_pd, _mm256_castps_si256,
    _mm256_castps256_ps128, _mm256_castsi256_pd, _mm256_castsi256_ps, _mm256_cmp_pd, _mm256_cmp_ps,
    _mm256_cmpeq_epi32, _mm256_cvtpd_ps, _mm256_cvtps_pd, _mm256_div_pd, _mm256_extractf128_ps,
    _mm256_load_pd, _mm256_load_ps, _mm256_loadu_pd, _mm256_loadu_ps, _mm256_max_pd, _mm256_max_ps,
    _mm256_min_pd, _mm256_min_ps, _mm256_movemask_pd, _mm256_movemask_ps, _mm256_mul_pd,
    _mm256_mul_ps, _mm256_or_pd, _mm256_or_ps, _mm256_permute2f128_pd, _mm256_permute4x64_pd,
    _mm256_set_m128, _mm256_set1_epi32, _mm256_set1_epi64x, _mm256_set1_pd, _mm256_set1_ps,
    _mm256_setr_pd, _mm256_setzero_pd, _mm256_shuffle_ps, _mm256_store_pd, _mm256_store_ps,
    _mm256_storeu_pd, _mm256_storeu_ps, _mm256_storeu_si256, _mm256_sub_pd, _mm256_sub_ps,
    _mm256_unpackhi_pd, _mm256_unpacklo_pd, _mm256_xor_pd,
};

use super::{
    box_ray::{BoxRay, FAR, LEAST_SLACK, NEAR, NEAR_FRAME, SLACK},
    boxes::{BoxKernel, KernelWork},
    gate::{Gate, Way},
    lanes::{
        Beam, CLASSES, Crossings, FACES, Focus, GROUPS, LANES, LEAST_COMPONENT, MOST_RAYS,
        RayGroup, SIEVED, Sieve, Turn, bounded, class_of,
    },
    parallelepiped_x86,
    ray::{Ray, Shear},
    solid_rays::{MOST_LEAVES, Met, Seen, SolidBeam, SolidRays},
};
use crate::{
    isa::Isa,
    prepared::{
        node::{Frame, Node},
        record::{BoxPlanes, LeafRecord, SolidRecord},
    },
};

/// The kernel with SSE2, four boxes at a time. Every x86-64 CPU has it.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sse2Boxes(());

impl Sse2Boxes {
    pub(crate) fn new() -> Self {
        Self(())
    }
}

impl BoxKernel for Sse2Boxes {
    #[inline(always)]
    fn test(self, node: &Node, ray: &BoxRay) -> ([f32; 8], u32) {
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
                    let far_inverse = _mm_set1_ps(ray.far_inverse[axis]);
                    leave = _mm_min_ps(_mm_mul_ps(far, far_inverse), leave);
                }
                _mm_storeu_ps(distances.as_mut_ptr().add(half), enter);
                let met = _mm_movemask_ps(_mm_cmple_ps(enter, leave));
                mask |= (met as u32) << half;
            }
        }
        (distances, mask)
    }

    #[inline(always)]
    fn cross_box(self, ray: &Ray, left_at: f64, planes: &BoxPlanes) -> ([f64; 2], f64) {
        parallelepiped_x86::cross_box(ray, left_at, planes)
    }
}

/// Asks for what is at an address, line by line.
#[inline(always)]
fn prefetch<T>(place: &T) {
    let first: *const i8 = std::ptr::from_ref(place).cast();
    for line in (0..size_of::<T>()).step_by(64) {
        // SAFETY: SSE is part of x86-64, and nothing is read.
        unsafe { _mm_prefetch::<_MM_HINT_T0>(first.wrapping_add(line)) };
    }
}

/// The kernel with AVX2, all eight boxes at once. [`Avx2Boxes::detect`] makes it on CPUs that have
/// all of [`Isa::Avx2`], and nothing else does.
#[derive(Debug, Clone, Copy)]
pub(super) struct Avx2Boxes(());

impl Avx2Boxes {
    /// `None` on a CPU without AVX2.
    pub(super) fn detect() -> Option<Self> {
        Isa::Avx2.is_supported().then_some(Self(()))
    }
}

impl BoxKernel for Avx2Boxes {
    fn run<Input>(self, input: &Input, work: &mut impl KernelWork<Input>) {
        #[target_feature(enable = "avx2,bmi1,bmi2,lzcnt,popcnt")]
        fn run_compiled_for_avx2<Input>(
            kernel: Avx2Boxes,
            input: &Input,
            work: &mut impl KernelWork<Input>,
        ) {
            work.run(input, kernel);
        }
        // SAFETY: a value of this type says that the CPU has AVX2 and the others.
        unsafe { run_compiled_for_avx2(self, input, work) }
    }

    #[inline(always)]
    fn cross_box(self, ray: &Ray, left_at: f64, planes: &BoxPlanes) -> ([f64; 2], f64) {
        // SAFETY: a value of this type says that the CPU has AVX2.
        unsafe { parallelepiped_x86::cross_box_with_avx2(ray, left_at, planes) }
    }

    #[inline(always)]
    fn face_at(self, (ray, left_at): (&Ray, f64), planes: &BoxPlanes, t: f64, enters: bool) -> u32 {
        // SAFETY: a value of this type says that the CPU has AVX2.
        unsafe { parallelepiped_x86::face_at_with_avx2((ray, left_at), planes, t, enters) }
    }

    #[inline(always)]
    fn approach(
        self,
        rays: &mut SolidRays,
        group: (&RayGroup, &Turn),
        solid: &SolidRecord,
    ) -> bool {
        // SAFETY: a value of this type says that the CPU has AVX2.
        unsafe { parallelepiped_x86::approach_with_avx2(rays, group, solid) }
    }

    #[inline(always)]
    fn surround_near(self, rays: &[SolidRays], is_forward: [bool; 3]) -> SolidBeam {
        // SAFETY: a value of this type says that the CPU has AVX2.
        unsafe { parallelepiped_x86::surround_near_with_avx2(rays, is_forward) }
    }

    #[inline(always)]
    fn touch_beam(self, node: &Node, beam: &SolidBeam) -> u32 {
        // SAFETY: a value of this type says that the CPU has AVX2.
        unsafe { parallelepiped_x86::touch_beam_with_avx2(node, beam) }
    }

    #[inline(always)]
    fn touch(self, rays: &[SolidRays], asking: (&[(usize, u8)], u8), planes: [[f32; 3]; 2]) -> u8 {
        // SAFETY: a value of this type says that the CPU has AVX2.
        unsafe { parallelepiped_x86::touch_with_avx2(rays, asking, planes) }
    }

    #[inline(always)]
    fn meet_ball(
        self,
        rays: &SolidRays,
        leaf: &LeafRecord,
        (any_leaves, apart): (bool, f64),
        ends: &mut [[f64; LANES]; 2],
    ) -> Met {
        // SAFETY: a value of this type says that the CPU has AVX2.
        unsafe {
            if any_leaves {
                parallelepiped_x86::meet_ball_with_avx2::<true>(rays, leaf, apart, ends)
            } else {
                parallelepiped_x86::meet_ball_with_avx2::<false>(rays, leaf, apart, ends)
            }
        }
    }

    #[inline(always)]
    fn meet_box(
        self,
        rays: &SolidRays,
        planes: &BoxPlanes,
        (any_leaves, apart): (bool, f64),
        ends: &mut [[f64; LANES]; 2],
    ) -> Met {
        // SAFETY: a value of this type says that the CPU has AVX2.
        unsafe {
            if any_leaves {
                parallelepiped_x86::meet_box_with_avx2::<true>(rays, planes, apart, ends)
            } else {
                parallelepiped_x86::meet_box_with_avx2::<false>(rays, planes, apart, ends)
            }
        }
    }

    #[inline(always)]
    fn look(
        self,
        ends: &[[[f64; LANES]; 2]],
        places: (&[f64; LANES], &[f64; LANES], f64),
        inside: &mut [u8; MOST_LEAVES],
        next: &mut [f64; LANES],
    ) -> Seen {
        // SAFETY: a value of this type says that the CPU has AVX2.
        unsafe { parallelepiped_x86::look_with_avx2(ends, places, inside, next) }
    }

    #[inline(always)]
    fn take_out(self, four: &mut [f64; 4], t: f64, least: &mut [f64; 4]) -> u32 {
        // SAFETY: a value of this type says that the CPU has AVX2. Loads and stores are of arrays
        // of exactly 4 numbers.
        unsafe {
            let numbers = _mm256_loadu_pd(four.as_ptr());
            let is_taken = _mm256_cmp_pd::<_CMP_EQ_OQ>(numbers, _mm256_set1_pd(t));
            let left = _mm256_blendv_pd(numbers, _mm256_set1_pd(f64::INFINITY), is_taken);
            _mm256_storeu_pd(four.as_mut_ptr(), left);
            let least_yet = _mm256_loadu_pd(least.as_ptr());
            _mm256_storeu_pd(least.as_mut_ptr(), _mm256_min_pd(left, least_yet));
            _mm256_movemask_pd(is_taken) as u32
        }
    }

    #[inline(always)]
    fn test(self, node: &Node, ray: &BoxRay) -> ([f32; 8], u32) {
        let mut distances = [0.0; 8];
        // SAFETY: a value of this type says that the CPU has AVX2. The loads read `planes[_]` and
        // the store writes `distances`, exactly 8 floats each.
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
                let far_inverse = _mm256_set1_ps(ray.far_inverse[axis]);
                leave = _mm256_min_ps(_mm256_mul_ps(far, far_inverse), leave);
            }
            _mm256_storeu_ps(distances.as_mut_ptr(), enter);
            _mm256_movemask_ps(_mm256_cmp_ps::<_CMP_LE_OQ>(enter, leave)) as u32
        };
        (distances, mask)
    }

    #[inline(always)]
    fn classify(self, rays: [&Ray; 4], frame: &Frame) -> [u64; 4] {
        let mut classes = [0; 4];
        // SAFETY: a value of this type says that the CPU has AVX2. The store writes four numbers of
        // 64 bits.
        unsafe {
            let numbers = self.numbers_of(rays);
            let (mut distance, mut bits) = (_mm256_setzero_pd(), _mm256_setzero_pd());
            let mut is_plain = _mm256_cmp_pd::<_CMP_EQ_OQ>(distance, distance);
            let mut size = [distance; 3];
            for axis in 0..3 {
                let relative = self.turned(numbers[axis], axis, frame);
                distance = _mm256_add_pd(distance, _mm256_mul_pd(relative, relative));
                let d = numbers[3 + axis];
                size[axis] = _mm256_andnot_pd(_mm256_set1_pd(-0.0), d);
                let least = _mm256_set1_pd(LEAST_COMPONENT);
                is_plain = _mm256_and_pd(is_plain, _mm256_cmp_pd::<_CMP_GE_OQ>(size[axis], least));
                let is_forward = _mm256_cmp_pd::<_CMP_GT_OQ>(d, _mm256_setzero_pd());
                bits = _mm256_or_pd(bits, _mm256_and_pd(is_forward, self.bits_of(1 << axis)));
            }
            let [x, y, z] = size;
            let is_y = _mm256_cmp_pd::<_CMP_GT_OQ>(y, z);
            let is_x = _mm256_cmp_pd::<_CMP_GT_OQ>(x, z);
            let x_or_z = _mm256_andnot_pd(is_x, self.bits_of(2 * 8));
            let y_or_z = _mm256_blendv_pd(self.bits_of(2 * 8), self.bits_of(8), is_y);
            let axis = _mm256_blendv_pd(y_or_z, x_or_z, _mm256_cmp_pd::<_CMP_GT_OQ>(x, y));
            let most = _mm256_set1_pd(NEAR_FRAME * NEAR_FRAME);
            let is_near = _mm256_cmp_pd::<_CMP_LE_OQ>(distance, most);
            let class = _mm256_or_pd(axis, bits);
            let is_in = _mm256_and_pd(is_plain, is_near);
            let class = _mm256_blendv_pd(self.bits_of(CLASSES as u64), class, is_in);
            _mm256_storeu_si256(classes.as_mut_ptr().cast(), _mm256_castpd_si256(class));
        }
        classes
    }

    #[inline(always)]
    fn common_class(self, rays: &[Ray], frame: &Frame) -> Option<u64> {
        let first = rays.first()?;
        let class = class_of(first, frame);
        let is_common = match class / 8 {
            0 => self.are_like::<0b00_00_00_00, 0b0110>(rays, frame),
            1 => self.are_like::<0b01_01_01_01, 0b0101>(rays, frame),
            2 => self.are_like::<0b10_10_10_10, 0b0011>(rays, frame),
            _ => false,
        };
        is_common.then_some(class)
    }

    #[inline(always)]
    fn fill(self, group: &mut RayGroup, rays: [&Ray; LANES], turn: &Turn) {
        match turn.axes[2] {
            0 => self.fill_along::<0>(group, rays, turn),
            1 => self.fill_along::<1>(group, rays, turn),
            _ => self.fill_along::<2>(group, rays, turn),
        }
    }

    #[inline(always)]
    fn shorten(self, group: &mut RayGroup, turn: &Turn) {
        // SAFETY: a value of this type says that the CPU has AVX2. The loads and the store, aligned
        // as the group is, take arrays of exactly 8 numbers, those of f64 by halves.
        unsafe {
            let reach = group.reach.as_ptr();
            let reach = [_mm256_load_pd(reach), _mm256_load_pd(reach.add(4))];
            let before = _mm256_load_ps(group.high.as_ptr());
            let high = _mm256_min_ps(self.high(&reach, &turn.reach), before);
            _mm256_store_ps(group.high.as_mut_ptr(), high);
        }
    }

    #[inline(always)]
    fn surround(self, groups: &[RayGroup], is_forward: [bool; 3]) -> Beam {
        let mut beam = Beam::EMPTY;
        // SAFETY: a value of this type says that the CPU has AVX2. The loads, aligned as the groups
        // are, read arrays of exactly 8 floats.
        unsafe {
            let [least, greatest] = [f32::INFINITY, f32::NEG_INFINITY].map(|x| _mm256_set1_ps(x));
            let mut high = greatest;
            for group in groups {
                high = _mm256_max_ps(_mm256_load_ps(group.high.as_ptr()), high);
            }
            beam.high = self.greatest(high);
            for (axis, forward) in is_forward.into_iter().enumerate() {
                let load = |lanes: &[[f32; LANES]; 3]| _mm256_load_ps(lanes[axis].as_ptr());
                let mut inverses = [least, greatest];
                // The greatest near start and the least far one, or the other way round.
                let mut starts = [greatest, least];
                for group in groups {
                    let inverse = load(&group.inverse);
                    inverses[0] = _mm256_min_ps(inverse, inverses[0]);
                    inverses[1] = _mm256_max_ps(inverse, inverses[1]);
                    let (near, far) = (load(&group.near_origin), load(&group.far_origin));
                    let (upper, lower) = if forward { (near, far) } else { (far, near) };
                    starts[0] = _mm256_max_ps(upper, starts[0]);
                    starts[1] = _mm256_min_ps(lower, starts[1]);
                }
                let [upper, lower] = [self.greatest(starts[0]), self.least(starts[1])];
                let starts = if forward { [upper, lower] } else { [lower, upper] };
                let inverses = [self.least(inverses[0]), self.greatest(inverses[1])];
                beam.set_axis((axis, forward), starts, inverses);
            }
        }
        beam
    }

    #[inline(always)]
    fn enter<const ONE: bool>(
        self,
        groups: &[RayGroup; GROUPS],
        [near, far]: [[f32; 3]; 2],
        mask: u64,
    ) -> u64 {
        let mut met = 0;
        // SAFETY: a value of this type says that the CPU has AVX2. The loads read arrays of
        // exactly 8 floats.
        unsafe {
            let splat =
                |x: [f32; 3]| [_mm256_set1_ps(x[0]), _mm256_set1_ps(x[1]), _mm256_set1_ps(x[2])];
            let (near, far) = (splat(near), splat(far));
            let mut left = mask;
            while left != 0 {
                let first = left.trailing_zeros() as usize & (MOST_RAYS - LANES);
                let group = &groups[first / LANES];
                left &= !(0xFF << first);
                let mut enter = _mm256_set1_ps(-0.0);
                let mut leave = _mm256_load_ps(group.high.as_ptr());
                for axis in 0..3 {
                    let load = |lanes: &[[f32; LANES]; 3]| _mm256_load_ps(lanes[axis].as_ptr());
                    let (mut to_near, mut to_far) = (near[axis], far[axis]);
                    if !ONE {
                        to_near = _mm256_sub_ps(to_near, load(&group.near_origin));
                        to_far = _mm256_sub_ps(to_far, load(&group.far_origin));
                    }
                    enter = _mm256_max_ps(_mm256_mul_ps(to_near, load(&group.inverse)), enter);
                    let to_far = _mm256_mul_ps(to_far, load(&group.far_inverse));
                    leave = _mm256_min_ps(to_far, leave);
                }
                let is_met = _mm256_cmp_ps::<_CMP_LE_OQ>(enter, leave);
                met |= (_mm256_movemask_ps(is_met) as u64) << first;
            }
        }
        met & mask
    }

    #[inline(always)]
    fn meet_beam(self, node: &Node, beam: &Beam) -> ([f32; 8], u32, u32) {
        let mut distances = [0.0; 8];
        // SAFETY: a value of this type says that the CPU has AVX2. The loads read `planes[_]` and
        // the store writes `distances`, exactly 8 floats each.
        let [mask, within] = unsafe {
            let mut enter = _mm256_set1_ps(-0.0);
            let mut leave = _mm256_set1_ps(beam.high);
            let (mut all_enter, mut first_leaves) = (enter, leave);
            for axis in 0..3 {
                let near = _mm256_loadu_ps(node.planes[beam.near[axis]].as_ptr());
                let far = _mm256_loadu_ps(node.planes[beam.far[axis]].as_ptr());
                let near_origin = _mm256_set1_ps(beam.near_origin[axis]);
                let far_origin = _mm256_set1_ps(beam.far_origin[axis]);
                let products = |way, [a, b]: [f32; 2]| {
                    [_mm256_mul_ps(way, _mm256_set1_ps(a)), _mm256_mul_ps(way, _mm256_set1_ps(b))]
                };
                let [a, b] = products(_mm256_sub_ps(near, near_origin), beam.inverse[axis]);
                enter = _mm256_max_ps(_mm256_min_ps(a, b), enter);
                // The start that is nearest to a far plane is farthest from a near one.
                let [a, b] = products(_mm256_sub_ps(near, far_origin), beam.inverse[axis]);
                all_enter = _mm256_max_ps(_mm256_max_ps(a, b), all_enter);
                let [a, b] = products(_mm256_sub_ps(far, far_origin), beam.far_inverse[axis]);
                leave = _mm256_min_ps(_mm256_max_ps(a, b), leave);
                let [a, b] = products(_mm256_sub_ps(far, near_origin), beam.far_inverse[axis]);
                first_leaves = _mm256_min_ps(_mm256_min_ps(a, b), first_leaves);
            }
            _mm256_storeu_ps(distances.as_mut_ptr(), enter);
            let not_after = |a, b| _mm256_movemask_ps(_mm256_cmp_ps::<_CMP_LE_OQ>(a, b)) as u32;
            [not_after(enter, leave), not_after(all_enter, first_leaves)]
        };
        (distances, mask, within)
    }

    #[inline(always)]
    fn cross(
        self,
        groups: &[RayGroup; GROUPS],
        corners: &[[f64; 3]; 3],
        mask: u64,
        distances: &mut [[f64; LANES]; GROUPS],
    ) -> Crossings {
        let mut crossings = Crossings::default();
        // Half a group at a time.
        let mut left = mask;
        while left != 0 {
            let half = left.trailing_zeros() as usize / 4 % (2 * GROUPS);
            let asking = left >> (4 * half) & 0xF;
            left &= !(0xF << (4 * half));
            let (group, first) = (&groups[half / 2], 4 * (half % 2));
            // SAFETY: a value of this type says that the CPU has AVX2. The loads and the store
            // take 4 of 8 numbers, from the first or from the fifth on.
            let [possible, certain, within] = unsafe {
                let load = |lanes: &[f64; LANES]| _mm256_load_pd(lanes.as_ptr().add(first));
                let slopes = [&group.slopes[0], &group.slopes[1], &group.slopes[2]];
                let zero = _mm256_setzero_pd();
                let [mut x, mut y, mut z] = [[zero; 3]; 3];
                for (corner, at) in corners.iter().enumerate() {
                    let seen = |axis: usize| {
                        let place = _mm256_set1_pd(at[axis]);
                        _mm256_sub_pd(place, load(&group.origin[axis]))
                    };
                    let (right, up, depth) = (seen(0), seen(1), seen(2));
                    x[corner] = _mm256_sub_pd(right, _mm256_mul_pd(load(slopes[0]), depth));
                    y[corner] = _mm256_sub_pd(up, _mm256_mul_pd(load(slopes[1]), depth));
                    z[corner] = _mm256_mul_pd(load(slopes[2]), depth);
                }
                let four = &mut distances.as_flattened_mut().as_chunks_mut().0[half];
                let [possible, certain] = self.cross_seen([x, y, z], asking, four);
                let mut within = certain;
                if certain != 0 {
                    let t = _mm256_loadu_pd(four.as_ptr());
                    let is_ahead = _mm256_cmp_pd::<_CMP_GT_OQ>(t, zero);
                    let is_near = _mm256_cmp_pd::<_CMP_LE_OQ>(t, load(&group.reach));
                    within &= _mm256_movemask_pd(_mm256_and_pd(is_ahead, is_near)) as u64;
                }
                [possible, certain, within]
            };
            crossings.within |= within << (4 * half);
            crossings.possible |= possible << (4 * half);
            crossings.certain |= certain << (4 * half);
        }
        crossings
    }

    #[inline(always)]
    fn spread(self, groups: &[RayGroup], point: &[f64; 3]) -> f64 {
        let mut spread = [0.0; 4];
        // SAFETY: a value of this type says that the CPU has AVX2. The loads, aligned as the groups
        // are, take 4 of 8 numbers, from the first or from the fifth on; the store takes an array
        // of exactly 4.
        unsafe {
            let sign = _mm256_set1_pd(-0.0);
            let mut greatest = _mm256_setzero_pd();
            for group in groups {
                for half in [0, 4] {
                    let load = |lanes: &[f64; LANES]| _mm256_load_pd(lanes.as_ptr().add(half));
                    let seen = |axis: usize| {
                        _mm256_sub_pd(_mm256_set1_pd(point[axis]), load(&group.origin[axis]))
                    };
                    let depth = seen(2);
                    for axis in 0..2 {
                        let slope = _mm256_mul_pd(load(&group.slopes[axis]), depth);
                        let place = _mm256_sub_pd(seen(axis), slope);
                        greatest = _mm256_max_pd(_mm256_andnot_pd(sign, place), greatest);
                    }
                }
            }
            _mm256_storeu_pd(spread.as_mut_ptr(), greatest);
        }
        let [a, b, c, d] = spread;
        a.max(b).max(c.max(d))
    }

    #[inline(always)]
    fn sieve(self, corners: &[[f64; 3]; 3], focus: &Focus) -> Sieve {
        let mut sieve = Sieve { factors: [[0.0; 4]; 3], bound: 0.0 };
        let mut bounds = [0.0; 4];
        // SAFETY: a value of this type says that the CPU has AVX2. The stores take arrays of
        // exactly 4 numbers.
        unsafe {
            let [a, b, c] = corners;
            let zero = _mm256_setzero_pd();
            let [mut from, mut to] = [[zero; 3]; 2];
            for axis in 0..3 {
                let places = _mm256_setr_pd(a[axis], b[axis], c[axis], a[axis]);
                from[axis] = _mm256_sub_pd(places, _mm256_set1_pd(focus.point[axis]));
                // The next corner: the second, the third, the first, the second.
                to[axis] = _mm256_permute4x64_pd::<0b01_00_10_01>(from[axis]);
            }
            let sign = _mm256_set1_pd(-0.0);
            let mut sizes = _mm_setzero_ps();
            let mut length = zero;
            for axis in 0..3 {
                let (next, last) = ((axis + 1) % 3, (axis + 2) % 3);
                let factor = _mm256_sub_pd(
                    _mm256_mul_pd(from[next], to[last]),
                    _mm256_mul_pd(from[last], to[next]),
                );
                let factor = _mm256_cvtpd_ps(factor);
                _mm_storeu_ps(sieve.factors[axis].as_mut_ptr(), factor);
                sizes = _mm_add_ps(sizes, _mm_andnot_ps(_mm_set1_ps(-0.0), factor));
                let step = _mm256_sub_pd(to[axis], from[axis]);
                length = _mm256_add_pd(length, _mm256_andnot_pd(sign, step));
            }
            let sizes = _mm256_mul_pd(_mm256_cvtps_pd(sizes), _mm256_set1_pd(SIEVED));
            let length = _mm256_mul_pd(length, _mm256_set1_pd(2.0 * focus.spread));
            _mm256_storeu_pd(bounds.as_mut_ptr(), _mm256_add_pd(sizes, length));
        }
        let [a, b, c, _] = bounds;
        sieve.bound = bounded(a.max(b).max(c), focus);
        sieve
    }

    #[inline(always)]
    fn sift<const CERTAIN: bool>(
        self,
        groups: &[RayGroup; GROUPS],
        sieve: &Sieve,
        mask: u64,
    ) -> [u64; 2] {
        let [mut past, mut certain] = [0; 2];
        // SAFETY: a value of this type says that the CPU has AVX2. The loads, aligned as the groups
        // are, read arrays of exactly 8 floats.
        unsafe {
            let splat = |factors: &[f32; 4]| {
                [_mm256_set1_ps(factors[0]), _mm256_set1_ps(factors[1]), _mm256_set1_ps(factors[2])]
            };
            let [first, second, last] =
                [splat(&sieve.factors[0]), splat(&sieve.factors[1]), splat(&sieve.factors[2])];
            let (below, above) = (_mm256_set1_ps(-sieve.bound), _mm256_set1_ps(sieve.bound));
            let mut left = mask;
            while left != 0 {
                let start = left.trailing_zeros() as usize & (MOST_RAYS - LANES);
                left &= !(0xFF << start);
                let [right, up] = &groups[start / LANES].rounded_slopes;
                let right = _mm256_load_ps(right.as_ptr());
                let up = _mm256_load_ps(up.as_ptr());
                let area = |edge: usize| {
                    let nearly = _mm256_add_ps(last[edge], _mm256_mul_ps(right, first[edge]));
                    _mm256_add_ps(nearly, _mm256_mul_ps(up, second[edge]))
                };
                let areas = [area(0), area(1), area(2)];
                let least = _mm256_min_ps(areas[0], _mm256_min_ps(areas[1], areas[2]));
                let most = _mm256_max_ps(areas[0], _mm256_max_ps(areas[1], areas[2]));
                let is_below = _mm256_cmp_ps::<_CMP_LT_OQ>(least, below);
                let is_above = _mm256_cmp_ps::<_CMP_GT_OQ>(most, above);
                let is_past = _mm256_and_ps(is_below, is_above);
                past |= (_mm256_movemask_ps(is_past) as u64) << start;
                if CERTAIN {
                    let is_inside = _mm256_or_ps(
                        _mm256_cmp_ps::<_CMP_LT_OQ>(most, below),
                        _mm256_cmp_ps::<_CMP_GT_OQ>(least, above),
                    );
                    certain |= (_mm256_movemask_ps(is_inside) as u64) << start;
                }
            }
        }
        [mask & !past, mask & certain]
    }

    #[inline(always)]
    fn find_ends(self, groups: &mut [RayGroup], focus: &Focus, axis: usize) -> Way {
        let forward = 1.0_f64.copysign(groups[0].direction[axis][0]);
        let mut longest = [0.0; 4];
        // SAFETY: a value of this type says that the CPU has AVX2. The loads and stores, aligned
        // as the groups are, take arrays of exactly 8 numbers, those of f64 by halves; the last
        // store takes an array of exactly 4.
        unsafe {
            let sign = _mm256_set1_pd(-0.0);
            let mut greatest = _mm256_setzero_pd();
            for group in groups {
                let [mut starts, mut goals] = [[greatest; 2]; 2];
                for (half, (at_start, at_end)) in starts.iter_mut().zip(&mut goals).enumerate() {
                    let load = |lanes: &[f64; LANES]| _mm256_load_pd(lanes.as_ptr().add(4 * half));
                    let start =
                        _mm256_sub_pd(load(&group.origin[2]), _mm256_set1_pd(focus.point[2]));
                    let start = _mm256_mul_pd(_mm256_set1_pd(forward), start);
                    let ahead = _mm256_andnot_pd(sign, load(&group.direction[axis]));
                    let length = _mm256_mul_pd(load(&group.reach), ahead);
                    let length = _mm256_min_pd(length, _mm256_set1_pd(2.0 * focus.most));
                    let end = _mm256_add_pd(start, length);
                    let (near, far) = (_mm256_andnot_pd(sign, start), _mm256_andnot_pd(sign, end));
                    greatest = _mm256_max_pd(_mm256_max_pd(near, far), greatest);
                    (*at_start, *at_end) = (start, end);
                }
                for (rounded, [low, high]) in group.ends.iter_mut().zip([starts, goals]) {
                    _mm256_store_ps(rounded.as_mut_ptr(), self.single(low, high));
                }
            }
            _mm256_storeu_pd(longest.as_mut_ptr(), greatest);
        }
        let [a, b, c, d] = longest;
        Way { forward, longest: a.max(b).max(c.max(d)) }
    }

    #[inline(always)]
    fn pass_gate(self, groups: &[RayGroup; GROUPS], gate: &Gate, mask: u64) -> [u64; 2] {
        let [mut between, mut outside] = [0; 2];
        // SAFETY: a value of this type says that the CPU has AVX2. The loads, aligned as the groups
        // are, read arrays of exactly 8 numbers of 32 bits, any of which is a float.
        unsafe {
            let [x, y, z] = gate.normal;
            let [x, y, z] = [_mm256_set1_ps(x), _mm256_set1_ps(y), _mm256_set1_ps(z)];
            let height = _mm256_set1_ps(gate.height);
            let (below, above) = (_mm256_set1_ps(-gate.bound), _mm256_set1_ps(gate.bound));
            let surface = _mm256_set1_epi32(gate.surface.cast_signed());
            let mut left = mask;
            while left != 0 {
                let first = left.trailing_zeros() as usize & (MOST_RAYS - LANES);
                left &= !(0xFF << first);
                let group = &groups[first / LANES];
                let load = |lanes: &[f32; LANES]| _mm256_load_ps(lanes.as_ptr());
                let [right, up] = [load(&group.rounded_slopes[0]), load(&group.rounded_slopes[1])];
                let slope = _mm256_add_ps(z, _mm256_mul_ps(right, x));
                let slope = _mm256_add_ps(slope, _mm256_mul_ps(up, y));
                let start = _mm256_sub_ps(height, _mm256_mul_ps(load(&group.ends[0]), slope));
                let end = _mm256_sub_ps(height, _mm256_mul_ps(load(&group.ends[1]), slope));
                let (least, most) = (_mm256_min_ps(start, end), _mm256_max_ps(start, end));
                let is_between = _mm256_and_ps(
                    _mm256_cmp_ps::<_CMP_LT_OQ>(least, below),
                    _mm256_cmp_ps::<_CMP_GT_OQ>(most, above),
                );
                let is_outside = _mm256_or_ps(
                    _mm256_cmp_ps::<_CMP_GT_OQ>(least, above),
                    _mm256_cmp_ps::<_CMP_LT_OQ>(most, below),
                );
                let surfaces = _mm256_load_ps(group.leaving.as_ptr().cast());
                let leaves = _mm256_cmpeq_epi32(_mm256_castps_si256(surfaces), surface);
                let is_outside = _mm256_or_ps(is_outside, _mm256_castsi256_ps(leaves));
                let passed = _mm256_movemask_ps(_mm256_andnot_ps(is_outside, is_between)) as u64;
                between |= passed << first;
                outside |= (_mm256_movemask_ps(is_outside) as u64) << first;
            }
        }
        [mask & between, mask & outside]
    }

    #[inline(always)]
    fn cross_four(
        self,
        shear: &Shear,
        corners: &[[&[f64; 3]; 3]; FACES],
        distances: &mut [f64; FACES],
    ) -> Crossings {
        let [a, b, c, d] = corners;
        let [x, y, z] = shear.axes;
        assert!(x < 3 && y < 3 && z < 3);
        // SAFETY: a value of this type says that the CPU has AVX2. A corner has three numbers, and
        // axes are below 3.
        let [possible, certain] = unsafe {
            let zero = _mm256_setzero_pd();
            let [mut x, mut y, mut z] = [[zero; 3]; 3];
            for corner in 0..3 {
                let mut seen = [zero; 3];
                for (k, seen) in seen.iter_mut().enumerate() {
                    let axis = shear.axes[k];
                    let at = |corners: &[&[f64; 3]; 3]| *corners[corner].get_unchecked(axis);
                    let places = _mm256_setr_pd(at(a), at(b), at(c), at(d));
                    *seen = _mm256_sub_pd(places, _mm256_set1_pd(shear.origin[k]));
                }
                let [right, up, depth] = seen;
                let slope = |k: usize| _mm256_mul_pd(_mm256_set1_pd(shear.slopes[k]), depth);
                x[corner] = _mm256_sub_pd(right, slope(0));
                y[corner] = _mm256_sub_pd(up, slope(1));
                z[corner] = slope(2);
            }
            self.cross_seen([x, y, z], 0xF, distances)
        };
        Crossings { possible, certain, within: 0 }
    }

    #[inline(always)]
    fn prefetch<T>(self, place: &T) {
        prefetch(place);
    }
}

#[expect(clippy::unused_self, reason = "a value says that the CPU has the instructions")]
impl Avx2Boxes {
    /// What the rays of a mask are to triangles that they see so, four lanes of corners on each
    /// axis: those that may cross them, and those that do for certain, whose distances are written.
    #[inline(always)]
    fn cross_seen(
        self,
        [x, y, z]: [[__m256d; 3]; 3],
        asking: u64,
        distances: &mut [f64; 4],
    ) -> [u64; 2] {
        // SAFETY: a value of this type says that the CPU has AVX2. The store takes an array of
        // exactly 4 numbers.
        unsafe {
            let zero = _mm256_setzero_pd();
            let edge = |a: usize, b: usize| {
                _mm256_sub_pd(_mm256_mul_pd(x[a], y[b]), _mm256_mul_pd(y[a], x[b]))
            };
            let over = [edge(1, 2), edge(2, 0), edge(0, 1)];
            let least = _mm256_min_pd(over[0], _mm256_min_pd(over[1], over[2]));
            let most = _mm256_max_pd(over[0], _mm256_max_pd(over[1], over[2]));
            let is_below = _mm256_cmp_pd::<_CMP_LT_OQ>(least, zero);
            let is_above = _mm256_cmp_pd::<_CMP_GT_OQ>(most, zero);
            let is_past = _mm256_and_pd(is_below, is_above);
            let possible = !(_mm256_movemask_pd(is_past) as u64) & asking;
            if possible == 0 {
                return [0; 2];
            }
            let sign = _mm256_set1_pd(-0.0);
            let size = |a| _mm256_andnot_pd(sign, a);
            let of_corner = |c: usize| _mm256_max_pd(size(x[c]), size(y[c]));
            let extent = _mm256_max_pd(of_corner(0), _mm256_max_pd(of_corner(1), of_corner(2)));
            let area = _mm256_add_pd(_mm256_add_pd(over[0], over[1]), over[2]);
            let bound = _mm256_mul_pd(_mm256_mul_pd(extent, extent), _mm256_set1_pd(0.125));
            let is_plain = _mm256_cmp_pd::<_CMP_GT_OQ>(size(area), bound);
            let is_one_sided = _mm256_or_pd(
                _mm256_cmp_pd::<_CMP_GT_OQ>(least, zero),
                _mm256_cmp_pd::<_CMP_LT_OQ>(most, zero),
            );
            let is_certain = _mm256_and_pd(is_plain, is_one_sided);
            let weighted = |k: usize| _mm256_mul_pd(over[k], z[k]);
            let sum = _mm256_add_pd(_mm256_add_pd(weighted(0), weighted(1)), weighted(2));
            let nearest = _mm256_min_pd(_mm256_min_pd(z[0], z[1]), z[2]);
            let farthest = _mm256_max_pd(_mm256_max_pd(z[0], z[1]), z[2]);
            let t = _mm256_max_pd(_mm256_div_pd(sum, area), nearest);
            let t = _mm256_min_pd(t, farthest);
            _mm256_storeu_pd(distances.as_mut_ptr(), t);
            [possible, _mm256_movemask_pd(is_certain) as u64 & possible]
        }
    }

    /// The numbers of four rays side by side: starts, directions, reaches, and bits that mean no
    /// number.
    #[inline(always)]
    fn numbers_of(self, rays: [&Ray; 4]) -> [__m256d; 8] {
        // SAFETY: a value of this type says that the CPU has AVX2. A ray is 64 bytes without
        // padding, and any bytes are a number.
        unsafe {
            let mut numbers = [_mm256_setzero_pd(); 8];
            for half in [0, 4] {
                let load =
                    |ray: &Ray| _mm256_loadu_pd(std::ptr::from_ref(ray).cast::<f64>().add(half));
                let [a, b, c, d] = [load(rays[0]), load(rays[1]), load(rays[2]), load(rays[3])];
                let (even, odd) = (_mm256_unpacklo_pd(a, b), _mm256_unpackhi_pd(a, b));
                let (later_even, later_odd) = (_mm256_unpacklo_pd(c, d), _mm256_unpackhi_pd(c, d));
                numbers[half] = _mm256_permute2f128_pd::<0x20>(even, later_even);
                numbers[half + 1] = _mm256_permute2f128_pd::<0x20>(odd, later_odd);
                numbers[half + 2] = _mm256_permute2f128_pd::<0x31>(even, later_even);
                numbers[half + 3] = _mm256_permute2f128_pd::<0x31>(odd, later_odd);
            }
            numbers
        }
    }

    /// Whether rays move along all axes, start near the frame, and have the signs and the largest
    /// component in common, with nothing left in doubt: `LARGEST` has that component's number in
    /// each pair of bits, `OTHERS` a bit for each of the others.
    #[inline(always)]
    fn are_like<const LARGEST: i32, const OTHERS: i32>(self, rays: &[Ray], frame: &Frame) -> bool {
        // A cube in the ball that rays of packets start in.
        let nearest = 0.57 * NEAR_FRAME / frame.scale;
        let [x, y, z] = frame.origin;
        // SAFETY: a value of this type says that the CPU has AVX2. A ray is 64 bytes without
        // padding, of which numbers 0 to 3 and 3 to 6 are read.
        unsafe {
            let sign = _mm256_set1_pd(-0.0);
            let middle = _mm256_setr_pd(x, y, z, 0.0);
            let of = |ray: &Ray| std::ptr::from_ref(ray).cast::<f64>();
            let first = _mm256_loadu_pd(of(&rays[0]).add(3));
            for rays in rays.chunks(MOST_RAYS) {
                let mut turned = _mm256_setzero_pd();
                let mut least = _mm256_set1_pd(f64::INFINITY);
                let mut is_along = _mm256_cmp_pd::<_CMP_EQ_OQ>(turned, turned);
                let mut is_near = is_along;
                for ray in rays {
                    let start = _mm256_sub_pd(middle, _mm256_loadu_pd(of(ray)));
                    let distance = _mm256_andnot_pd(sign, start);
                    let near = _mm256_cmp_pd::<_CMP_LE_OQ>(distance, _mm256_set1_pd(nearest));
                    is_near = _mm256_and_pd(is_near, near);
                    let direction = _mm256_loadu_pd(of(ray).add(3));
                    turned = _mm256_or_pd(turned, _mm256_xor_pd(direction, first));
                    let size = _mm256_andnot_pd(sign, direction);
                    least = _mm256_min_pd(size, least);
                    let largest = _mm256_permute4x64_pd::<LARGEST>(size);
                    let is_less = _mm256_cmp_pd::<_CMP_GT_OQ>(largest, size);
                    is_along = _mm256_and_pd(is_along, is_less);
                }
                let least = _mm256_cmp_pd::<_CMP_GE_OQ>(least, _mm256_set1_pd(LEAST_COMPONENT));
                let is_plain = _mm256_andnot_pd(turned, _mm256_and_pd(least, is_near));
                if _mm256_movemask_pd(is_plain) & 0b0111 != 0b0111
                    || _mm256_movemask_pd(is_along) & OTHERS != OTHERS
                {
                    return false;
                }
            }
        }
        true
    }

    /// `BoxKernel::fill` for rays with this depth axis.
    #[inline(always)]
    fn fill_along<const Z: usize>(self, group: &mut RayGroup, rays: [&Ray; LANES], turn: &Turn) {
        let [a, b, c, d, e, f, g, h] = rays;
        let (x, y) = ((Z + 1) % 3, (Z + 2) % 3);
        // SAFETY: a value of this type says that the CPU has AVX2. The stores write arrays of
        // exactly 8 numbers, those of f64 by halves.
        unsafe {
            let halves = [self.numbers_of([a, b, c, d]), self.numbers_of([e, f, g, h])];
            let one = _mm256_set1_pd(1.0);
            for axis in 0..3 {
                let low = self.turned(halves[0][axis], axis, &turn.frame);
                let high = self.turned(halves[1][axis], axis, &turn.frame);
                let place = self.single(low, high);
                let size = _mm256_andnot_ps(_mm256_set1_ps(-0.0), place);
                let slack = _mm256_mul_ps(size, _mm256_set1_ps(SLACK));
                let slack = _mm256_add_ps(slack, _mm256_set1_ps(LEAST_SLACK));
                let way = if turn.is_forward[axis] { 1.0 } else { -1.0 };
                let ahead = _mm256_mul_ps(slack, _mm256_set1_ps(way));
                _mm256_store_ps(group.near_origin[axis].as_mut_ptr(), _mm256_add_ps(place, ahead));
                _mm256_store_ps(group.far_origin[axis].as_mut_ptr(), _mm256_sub_ps(place, ahead));
                let [low, high] = [
                    _mm256_div_pd(one, halves[0][3 + axis]),
                    _mm256_div_pd(one, halves[1][3 + axis]),
                ];
                if axis == Z {
                    _mm256_store_pd(group.slopes[2].as_mut_ptr(), low);
                    _mm256_store_pd(group.slopes[2].as_mut_ptr().add(4), high);
                }
                let inverse = self.single(low, high);
                _mm256_store_ps(group.inverse[axis].as_mut_ptr(), inverse);
                let far_inverse = _mm256_mul_ps(inverse, _mm256_set1_ps(FAR));
                _mm256_store_ps(group.far_inverse[axis].as_mut_ptr(), far_inverse);
            }
            for (half, numbers) in halves.iter().enumerate() {
                let store = |lanes: &mut [f64; LANES], numbers| {
                    _mm256_store_pd(lanes.as_mut_ptr().add(4 * half), numbers);
                };
                for axis in 0..3 {
                    store(&mut group.direction[axis], numbers[3 + axis]);
                }
                store(&mut group.origin[0], numbers[x]);
                store(&mut group.origin[1], numbers[y]);
                store(&mut group.origin[2], numbers[Z]);
                store(&mut group.reach, numbers[6]);
            }
            for (k, axis) in [x, y].into_iter().enumerate() {
                let [low, high] = [
                    _mm256_div_pd(halves[0][3 + axis], halves[0][3 + Z]),
                    _mm256_div_pd(halves[1][3 + axis], halves[1][3 + Z]),
                ];
                _mm256_store_pd(group.slopes[k].as_mut_ptr(), low);
                _mm256_store_pd(group.slopes[k].as_mut_ptr().add(4), high);
                _mm256_store_ps(group.rounded_slopes[k].as_mut_ptr(), self.single(low, high));
            }
            let [low, high] = [_mm256_castpd_ps(halves[0][7]), _mm256_castpd_ps(halves[1][7])];
            let even = _mm256_castps_pd(_mm256_shuffle_ps::<0x88>(low, high));
            let odd = _mm256_castps_pd(_mm256_shuffle_ps::<0xDD>(low, high));
            let leaving = _mm256_permute4x64_pd::<0xD8>(even);
            let after = _mm256_permute4x64_pd::<0xD8>(odd);
            _mm256_store_pd(group.leaving.as_mut_ptr().cast(), leaving);
            _mm256_store_pd(group.after.as_mut_ptr().cast(), after);
            let high = self.high(&[halves[0][6], halves[1][6]], &turn.reach);
            _mm256_store_ps(group.high.as_mut_ptr(), high);
        }
    }

    /// Eight numbers in two halves, rounded.
    #[inline(always)]
    fn single(self, low: __m256d, high: __m256d) -> __m256 {
        // SAFETY: a value of this type says that the CPU has AVX2.
        unsafe { _mm256_set_m128(_mm256_cvtpd_ps(high), _mm256_cvtpd_ps(low)) }
    }

    /// `BoxRay::reach` of a ray that ends at each of these distances, in two halves.
    #[inline(always)]
    fn high(self, reach: &[__m256d; 2], ray: &BoxRay) -> __m256 {
        // SAFETY: a value of this type says that the CPU has AVX2.
        unsafe {
            let mut high = [_mm256_setzero_pd(); 2];
            for (high, &reach) in high.iter_mut().zip(reach) {
                let from_start = _mm256_sub_pd(reach, _mm256_set1_pd(ray.start));
                let scaled = _mm256_mul_pd(from_start, _mm256_set1_pd(ray.scale));
                *high = _mm256_add_pd(scaled, _mm256_set1_pd(ray.slack));
            }
            let plain = self.single(high[0], high[1]);
            let size = _mm256_andnot_ps(_mm256_set1_ps(-0.0), plain);
            _mm256_add_ps(plain, _mm256_mul_ps(size, _mm256_set1_ps(NEAR)))
        }
    }

    /// The least of eight numbers.
    #[inline(always)]
    fn least(self, numbers: __m256) -> f32 {
        // SAFETY: a value of this type says that the CPU has AVX2.
        unsafe {
            let (low, high) =
                (_mm256_castps256_ps128(numbers), _mm256_extractf128_ps::<1>(numbers));
            let four = _mm_min_ps(low, high);
            let two = _mm_min_ps(four, _mm_movehl_ps(four, four));
            _mm_cvtss_f32(_mm_min_ss(two, _mm_movehdup_ps(two)))
        }
    }

    /// The greatest of eight numbers.
    #[inline(always)]
    fn greatest(self, numbers: __m256) -> f32 {
        // SAFETY: a value of this type says that the CPU has AVX2.
        unsafe {
            let (low, high) =
                (_mm256_castps256_ps128(numbers), _mm256_extractf128_ps::<1>(numbers));
            let four = _mm_max_ps(low, high);
            let two = _mm_max_ps(four, _mm_movehl_ps(four, four));
            _mm_cvtss_f32(_mm_max_ss(two, _mm_movehdup_ps(two)))
        }
    }

    /// Coordinates on an axis in the frame of the boxes.
    #[inline(always)]
    fn turned(self, coordinates: __m256d, axis: usize, frame: &Frame) -> __m256d {
        // SAFETY: a value of this type says that the CPU has AVX2.
        unsafe {
            let relative = _mm256_sub_pd(coordinates, _mm256_set1_pd(frame.origin[axis]));
            _mm256_mul_pd(relative, _mm256_set1_pd(frame.scale))
        }
    }

    /// The bits of a whole number in each lane.
    #[inline(always)]
    fn bits_of(self, value: u64) -> __m256d {
        // SAFETY: a value of this type says that the CPU has AVX2.
        unsafe { _mm256_castsi256_pd(_mm256_set1_epi64x(value.cast_signed())) }
    }
}
