//! The kernel with AVX-512: a triangle is tried on eight rays at once, its sieve on 16. Boxes are
//! AVX2's, eight lanes of f32.

use std::arch::x86_64::{
    _CMP_GT_OQ, _CMP_LE_OQ, _CMP_LT_OQ, _mm256_castps_pd, _mm256_load_ps, _mm512_abs_pd,
    _mm512_add_pd, _mm512_add_ps, _mm512_castpd_ps, _mm512_castpd256_pd512, _mm512_cmp_pd_mask,
    _mm512_cmp_ps_mask, _mm512_div_pd, _mm512_insertf64x4, _mm512_load_pd, _mm512_mask_cmp_ps_mask,
    _mm512_max_pd, _mm512_max_ps, _mm512_min_pd, _mm512_min_ps, _mm512_mul_pd, _mm512_mul_ps,
    _mm512_set1_pd, _mm512_set1_ps, _mm512_setzero_pd, _mm512_storeu_pd, _mm512_sub_pd,
};

use super::{
    box_ray::BoxRay,
    boxes::{BoxKernel, KernelWork},
    boxes_x86::Avx2Boxes,
    gate::{Gate, Way},
    lanes::{Beam, Crossings, FACES, Focus, GROUPS, LANES, MOST_RAYS, RayGroup, Sieve, Turn},
    ray::{Ray, Shear},
    solid_rays::{MOST_LEAVES, Met, Seen, SolidBeam, SolidRays},
};
use crate::prepared::{
    node::{Frame, Node},
    record::{BoxPlanes, LeafRecord, SolidRecord},
};

/// The kernel with AVX-512 (F and VL). [`Avx512Boxes::detect`] makes it on CPUs that have these,
/// and nothing else does.
#[derive(Debug, Clone, Copy)]
pub(super) struct Avx512Boxes(Avx2Boxes);

impl Avx512Boxes {
    /// `None` on a CPU without AVX-512.
    pub(super) fn detect() -> Option<Self> {
        let has_all = std::arch::is_x86_feature_detected!("avx512f")
            && std::arch::is_x86_feature_detected!("avx512vl");
        Avx2Boxes::detect().filter(|_| has_all).map(Self)
    }
}

impl BoxKernel for Avx512Boxes {
    fn run<Input>(self, input: &Input, work: &mut impl KernelWork<Input>) {
        #[target_feature(enable = "avx2,bmi1,bmi2,lzcnt,popcnt,avx512f,avx512vl")]
        fn run_compiled_for_avx512<Input>(
            kernel: Avx512Boxes,
            input: &Input,
            work: &mut impl KernelWork<Input>,
        ) {
            work.run(input, kernel);
        }
        // SAFETY: a value of this type says that the CPU has AVX-512, and the one in it AVX2.
        unsafe { run_compiled_for_avx512(self, input, work) }
    }

    #[inline(always)]
    fn cross_box(self, ray: &Ray, left_at: f64, planes: &BoxPlanes) -> ([f64; 2], f64) {
        self.0.cross_box(ray, left_at, planes)
    }

    #[inline(always)]
    fn face_at(self, rays: (&Ray, f64), planes: &BoxPlanes, t: f64, enters: bool) -> u32 {
        self.0.face_at(rays, planes, t, enters)
    }

    #[inline(always)]
    fn approach(
        self,
        rays: &mut SolidRays,
        group: (&RayGroup, &Turn),
        solid: &SolidRecord,
    ) -> bool {
        self.0.approach(rays, group, solid)
    }

    #[inline(always)]
    fn surround_near(self, rays: &[SolidRays], is_forward: [bool; 3]) -> SolidBeam {
        self.0.surround_near(rays, is_forward)
    }

    #[inline(always)]
    fn touch_beam(self, node: &Node, beam: &SolidBeam) -> u32 {
        self.0.touch_beam(node, beam)
    }

    #[inline(always)]
    fn touch(self, rays: &[SolidRays], asking: (&[(usize, u8)], u8), planes: [[f32; 3]; 2]) -> u8 {
        self.0.touch(rays, asking, planes)
    }

    #[inline(always)]
    fn meet_ball(
        self,
        rays: &SolidRays,
        leaf: &LeafRecord,
        (any_leaves, apart): (bool, f64),
        ends: &mut [[f64; LANES]; 2],
    ) -> Met {
        self.0.meet_ball(rays, leaf, (any_leaves, apart), ends)
    }

    #[inline(always)]
    fn meet_box(
        self,
        rays: &SolidRays,
        planes: &BoxPlanes,
        left: (bool, f64),
        ends: &mut [[f64; LANES]; 2],
    ) -> Met {
        self.0.meet_box(rays, planes, left, ends)
    }

    #[inline(always)]
    fn look(
        self,
        ends: &[[[f64; LANES]; 2]],
        places: (&[f64; LANES], &[f64; LANES], f64),
        inside: &mut [u8; MOST_LEAVES],
        next: &mut [f64; LANES],
    ) -> Seen {
        self.0.look(ends, places, inside, next)
    }

    #[inline(always)]
    fn take_out(self, four: &mut [f64; 4], t: f64, least: &mut [f64; 4]) -> u32 {
        self.0.take_out(four, t, least)
    }

    #[inline(always)]
    fn test(self, node: &Node, ray: &BoxRay) -> ([f32; 8], u32) {
        self.0.test(node, ray)
    }

    #[inline(always)]
    fn classify(self, rays: [&Ray; 4], frame: &Frame) -> [u64; 4] {
        self.0.classify(rays, frame)
    }

    #[inline(always)]
    fn common_class(self, rays: &[Ray], frame: &Frame) -> Option<u64> {
        self.0.common_class(rays, frame)
    }

    #[inline(always)]
    fn fill(self, group: &mut RayGroup, rays: [&Ray; LANES], turn: &Turn) {
        self.0.fill(group, rays, turn);
    }

    #[inline(always)]
    fn shorten(self, group: &mut RayGroup, turn: &Turn) {
        self.0.shorten(group, turn);
    }

    #[inline(always)]
    fn surround(self, groups: &[RayGroup], is_forward: [bool; 3]) -> Beam {
        self.0.surround(groups, is_forward)
    }

    #[inline(always)]
    fn enter<const ONE: bool>(
        self,
        groups: &[RayGroup; GROUPS],
        planes: [[f32; 3]; 2],
        mask: u64,
    ) -> u64 {
        self.0.enter::<ONE>(groups, planes, mask)
    }

    #[inline(always)]
    fn meet_beam(self, node: &Node, beam: &Beam) -> ([f32; 8], u32, u32) {
        self.0.meet_beam(node, beam)
    }

    #[inline(always)]
    fn spread(self, groups: &[RayGroup], point: &[f64; 3]) -> f64 {
        self.0.spread(groups, point)
    }

    #[inline(always)]
    fn sieve(self, corners: &[[f64; 3]; 3], focus: &Focus) -> Sieve {
        self.0.sieve(corners, focus)
    }

    #[inline(always)]
    fn sift<const CERTAIN: bool>(
        self,
        groups: &[RayGroup; GROUPS],
        sieve: &Sieve,
        mask: u64,
    ) -> [u64; 2] {
        let [mut past, mut certain] = [0; 2];
        // SAFETY: a value of this type says that the CPU has AVX-512. The loads, aligned as the
        // groups are, read arrays of exactly 8 floats, of two groups.
        unsafe {
            let splat = |factors: &[f32; 4]| {
                [_mm512_set1_ps(factors[0]), _mm512_set1_ps(factors[1]), _mm512_set1_ps(factors[2])]
            };
            let [first, second, last] =
                [splat(&sieve.factors[0]), splat(&sieve.factors[1]), splat(&sieve.factors[2])];
            let (below, above) = (_mm512_set1_ps(-sieve.bound), _mm512_set1_ps(sieve.bound));
            let mut left = mask;
            while left != 0 {
                let start = left.trailing_zeros() as usize & (MOST_RAYS - 2 * LANES);
                left &= !(0xFFFF << start);
                let pair = &groups.as_chunks::<2>().0[start / (2 * LANES)];
                let both = |axis: usize| {
                    let load = |group: &RayGroup| {
                        _mm256_castps_pd(_mm256_load_ps(group.rounded_slopes[axis].as_ptr()))
                    };
                    let low = _mm512_castpd256_pd512(load(&pair[0]));
                    _mm512_castpd_ps(_mm512_insertf64x4::<1>(low, load(&pair[1])))
                };
                let (right, up) = (both(0), both(1));
                let area = |edge: usize| {
                    let nearly = _mm512_add_ps(last[edge], _mm512_mul_ps(right, first[edge]));
                    _mm512_add_ps(nearly, _mm512_mul_ps(up, second[edge]))
                };
                let areas = [area(0), area(1), area(2)];
                let least = _mm512_min_ps(areas[0], _mm512_min_ps(areas[1], areas[2]));
                let most = _mm512_max_ps(areas[0], _mm512_max_ps(areas[1], areas[2]));
                let is_below = _mm512_cmp_ps_mask::<_CMP_LT_OQ>(least, below);
                let is_past = _mm512_mask_cmp_ps_mask::<_CMP_GT_OQ>(is_below, most, above);
                past |= u64::from(is_past) << start;
                if CERTAIN {
                    let is_inside = _mm512_cmp_ps_mask::<_CMP_LT_OQ>(most, below)
                        | _mm512_cmp_ps_mask::<_CMP_GT_OQ>(least, above);
                    certain |= u64::from(is_inside) << start;
                }
            }
        }
        [mask & !past, mask & certain]
    }

    #[inline(always)]
    fn find_ends(self, groups: &mut [RayGroup], focus: &Focus, axis: usize) -> Way {
        self.0.find_ends(groups, focus, axis)
    }

    #[inline(always)]
    fn pass_gate(self, groups: &[RayGroup; GROUPS], gate: &Gate, mask: u64) -> [u64; 2] {
        self.0.pass_gate(groups, gate, mask)
    }

    #[inline(always)]
    fn cross_four(
        self,
        shear: &Shear,
        corners: &[[&[f64; 3]; 3]; FACES],
        distances: &mut [f64; FACES],
    ) -> Crossings {
        self.0.cross_four(shear, corners, distances)
    }

    #[inline(always)]
    fn prefetch<T>(self, place: &T) {
        self.0.prefetch(place);
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
        let mut left = mask;
        while left != 0 {
            let k = left.trailing_zeros() as usize / LANES % GROUPS;
            let asking = left >> (LANES * k) & 0xFF;
            left &= !(0xFF << (LANES * k));
            let group = &groups[k];
            // SAFETY: a value of this type says that the CPU has AVX-512. The loads, aligned as the
            // group is, and the store take arrays of exactly 8 numbers.
            let [possible, certain, within] = unsafe {
                let load = |lanes: &[f64; LANES]| _mm512_load_pd(lanes.as_ptr());
                let slopes = [load(&group.slopes[0]), load(&group.slopes[1])];
                let zero = _mm512_setzero_pd();
                let [mut x, mut y, mut depth] = [[zero; 3]; 3];
                for (corner, at) in corners.iter().enumerate() {
                    let seen = |axis: usize| {
                        let place = _mm512_set1_pd(at[axis]);
                        _mm512_sub_pd(place, load(&group.origin[axis]))
                    };
                    let (right, up) = (seen(0), seen(1));
                    depth[corner] = seen(2);
                    x[corner] = _mm512_sub_pd(right, _mm512_mul_pd(slopes[0], depth[corner]));
                    y[corner] = _mm512_sub_pd(up, _mm512_mul_pd(slopes[1], depth[corner]));
                }
                let edge = |a: usize, b: usize| {
                    _mm512_sub_pd(_mm512_mul_pd(x[a], y[b]), _mm512_mul_pd(y[a], x[b]))
                };
                let over = [edge(1, 2), edge(2, 0), edge(0, 1)];
                let least = _mm512_min_pd(over[0], _mm512_min_pd(over[1], over[2]));
                let most = _mm512_max_pd(over[0], _mm512_max_pd(over[1], over[2]));
                let is_below = _mm512_cmp_pd_mask::<_CMP_LT_OQ>(least, zero);
                let is_above = _mm512_cmp_pd_mask::<_CMP_GT_OQ>(most, zero);
                let possible = u64::from(!(is_below & is_above)) & asking;
                if possible == 0 {
                    continue;
                }
                let of_corner = |c: usize| _mm512_max_pd(_mm512_abs_pd(x[c]), _mm512_abs_pd(y[c]));
                let extent = _mm512_max_pd(of_corner(0), _mm512_max_pd(of_corner(1), of_corner(2)));
                let area = _mm512_add_pd(_mm512_add_pd(over[0], over[1]), over[2]);
                let bound = _mm512_mul_pd(_mm512_mul_pd(extent, extent), _mm512_set1_pd(0.125));
                let is_plain = _mm512_cmp_pd_mask::<_CMP_GT_OQ>(_mm512_abs_pd(area), bound);
                let is_one_sided = _mm512_cmp_pd_mask::<_CMP_GT_OQ>(least, zero)
                    | _mm512_cmp_pd_mask::<_CMP_LT_OQ>(most, zero);
                let slope = load(&group.slopes[2]);
                let z = depth.map(|depth| _mm512_mul_pd(slope, depth));
                let weighted = |k: usize| _mm512_mul_pd(over[k], z[k]);
                let sum = _mm512_add_pd(_mm512_add_pd(weighted(0), weighted(1)), weighted(2));
                let nearest = _mm512_min_pd(_mm512_min_pd(z[0], z[1]), z[2]);
                let farthest = _mm512_max_pd(_mm512_max_pd(z[0], z[1]), z[2]);
                let t = _mm512_max_pd(_mm512_div_pd(sum, area), nearest);
                let t = _mm512_min_pd(t, farthest);
                _mm512_storeu_pd(distances[k].as_mut_ptr(), t);
                let certain = u64::from(is_plain & is_one_sided) & possible;
                let is_ahead = _mm512_cmp_pd_mask::<_CMP_GT_OQ>(t, zero);
                let is_near = _mm512_cmp_pd_mask::<_CMP_LE_OQ>(t, load(&group.reach));
                [possible, certain, u64::from(is_ahead & is_near) & certain]
            };
            crossings.within |= within << (LANES * k);
            crossings.possible |= possible << (LANES * k);
            crossings.certain |= certain << (LANES * k);
        }
        crossings
    }
}
