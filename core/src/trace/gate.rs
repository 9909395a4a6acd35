//! Gates: rays that certainly cross a triangle between their ends, told in f32.
//!
//! A shadow ray only asks whether anything is in its way. Where f32 tells for certain what the f64
//! test would say of a triangle, that test is left out; `docs/proof.md`, boxes, has the bounds.

use super::lanes::{Focus, GROUPS, LANES, RayGroup, by_groups, larger, smaller};

/// What rays that have ends are to a focus.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Way {
    /// 1 where they go forward along their depth axis, else -1.
    pub(super) forward: f64,
    /// No end is farther from the focus than this, in depth.
    pub(super) longest: f64,
}

/// What decides in f32 whether rays cross a triangle's plane between their ends: with the normal n
/// and the depth z of an end behind the focus, the end is on the side of the plane that the sign of
/// height - z (n · slopes) tells.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Gate {
    /// Twice the area long, in the order of the axes of the rays' `Shear`.
    pub(super) normal: [f32; 3],
    /// How far the plane is in front of the focus, on the way of the rays, times the normal's
    /// length.
    pub(super) height: f32,
    /// An end that is further than this from 0 is on the side that f64 finds.
    pub(super) bound: f32,
    /// The surface that is the triangle's alone: rays that leave it do not meet it.
    pub(super) surface: u32,
}

/// What f32 rounding takes from an end's distance from a plane, as a part of depth times normal and
/// of the height: see `docs/proof.md`, boxes.
const GATED: [f64; 2] = [16.0 / (1_u64 << 24) as f64, 4.0 / (1_u64 << 24) as f64];

impl Gate {
    /// The gate of a triangle; its corners are in the order of the rays' axes.
    #[inline(always)]
    pub(super) fn new(
        [a, b, c]: &[[f64; 3]; 3],
        surface: u32,
        focus: &Focus,
        Way { forward, longest }: Way,
    ) -> Self {
        let (mut right, mut left, mut seen) = ([0.0; 3], [0.0; 3], [0.0; 3]);
        for axis in 0..3 {
            right[axis] = b[axis] - a[axis];
            left[axis] = c[axis] - a[axis];
            seen[axis] = a[axis] - focus.point[axis];
        }
        let normal = [
            right[1] * left[2] - right[2] * left[1],
            right[2] * left[0] - right[0] * left[2],
            right[0] * left[1] - right[1] * left[0],
        ];
        let [x, y, z] = normal;
        let height = forward * (x * seen[0] + y * seen[1] + z * seen[2]);
        let size = x.abs() + y.abs() + z.abs();
        let [by_depth, by_height] = GATED;
        let rounded = size * (longest * by_depth + focus.spread * 2.0) + height.abs() * by_height;
        let bound = ((rounded + 4.0 * focus.most * focus.blur) * 1.001) as f32 + f32::MIN_POSITIVE;
        Self { normal: [x as f32, y as f32, z as f32], height: height as f32, bound, surface }
    }
}

/// `BoxKernel::find_ends` in plain Rust.
#[inline(always)]
pub(super) fn find_ends(groups: &mut [RayGroup], focus: &Focus, axis: usize) -> Way {
    let forward = 1.0_f64.copysign(groups[0].direction[axis][0]);
    let mut longest: f64 = 0.0;
    for group in groups {
        for lane in 0..LANES {
            let start = forward * (group.origin[2][lane] - focus.point[2]);
            let length = group.reach[lane] * group.direction[axis][lane].abs();
            let end = start + length.min(2.0 * focus.most);
            group.ends[0][lane] = start as f32;
            group.ends[1][lane] = end as f32;
            longest = longest.max(start.abs()).max(end.abs());
        }
    }
    Way { forward, longest }
}

/// `BoxKernel::pass_gate` in plain Rust.
#[inline(always)]
pub(super) fn pass_gate(groups: &[RayGroup; GROUPS], gate: &Gate, mask: u64) -> [u64; 2] {
    let Gate { normal: [x, y, z], height, bound, surface } = *gate;
    let mut between = 0;
    let outside = by_groups(mask, |k| {
        let group = &groups[k];
        let mut outside = 0;
        for lane in 0..LANES {
            let [right, up] = [0, 1].map(|axis| group.rounded_slopes[axis][lane]);
            let slope = (z + right * x) + up * y;
            let [start, end] = [0, 1].map(|end| height - group.ends[end][lane] * slope);
            let (least, most) = (smaller(start, end), larger(start, end));
            let is_between = least < -bound && most > bound;
            between |= u64::from(is_between) << (LANES * k + lane);
            let leaves = group.leaving[lane] == surface;
            outside |= u64::from(least > bound || most < -bound || leaves) << lane;
        }
        outside
    });
    [between & mask & !outside, outside]
}

#[cfg(test)]
mod tests {
    use glam::DVec3;
    use rtfarm_oracle::random::Random;

    use super::*;
    use crate::{
        isa::Isa,
        prepared::{node::Frame, record::Surface},
        trace::{
            boxes::{BoxKernel, KernelWork, ScalarBoxes},
            kernels::run_with_kernel,
            lanes::{CLASSES, MOST_RAYS, class_of},
            packet::Packet,
            ray::{Ray, Shear},
            triangle::hit_triangle,
        },
    };

    const SURFACE: u32 = 7;

    /// Rays of one class that go to one place, or start there, and a triangle near to which some of
    /// them start, end, or pass an edge.
    struct Case {
        rays: Vec<Ray>,
        packet: Packet,
        corners: [[f64; 3]; 3],
        mask: u64,
    }

    impl Case {
        fn random(random: &mut Random) -> Self {
            let frame = Frame { origin: [0.0; 3], scale: 1.0 };
            let is_from_one = random.chance(0.3);
            let any_or_grid = |random: &mut Random| {
                let place = random.in_cube();
                if random.chance(0.3) { (4.0 * place).round() / 4.0 } else { place }
            };
            let focus = [1.0, 3.0][random.below(2)] * any_or_grid(random);
            let a = any_or_grid(random);
            let size = [1.0, 1e-1, 1e-2, 1e-3, 1e-5][random.below(5)];
            let (u, mut v) = (size * random.in_cube(), size * random.in_cube());
            match random.below(8) {
                // A needle, a point, a triangle that is seen edge-on or all but so.
                0 => v = random.unit() * u + random.log_uniform(1e-12, 1e-3) * v,
                1 => v = u * random.below(2) as f64,
                2 => v = size * (a - focus) + random.log_uniform(1e-14, 1e-3) * v,
                _ => {}
            }
            let corners = [a, a + u, a + v];
            let little = |random: &mut Random| {
                let little = random.log_uniform(1e-17, 1e-2);
                [little, -little, 0.0][random.below(3)]
            };
            let mut rays = Vec::new();
            for _ in 0..MOST_RAYS {
                let [mut s, mut t] = [random.unit(), random.unit()];
                if s + t > 1.0 && random.chance(0.8) {
                    (s, t) = (1.0 - s, 1.0 - t);
                }
                match random.below(4) {
                    0 => s = little(random),
                    1 => t = 1.0 - s + little(random),
                    _ => {}
                }
                let target = a + s * u + t * v;
                let way = target - focus;
                // How far from the triangle the other end is.
                let beyond = match random.below(3) {
                    0 => little(random),
                    _ => random.between(-0.8, 0.5),
                };
                let other = target + beyond * way;
                let (origin, end) = if is_from_one { (focus, other) } else { (other, focus) };
                let direction = (end - origin).normalize();
                let direction = if direction.is_finite() { direction } else { DVec3::Y };
                let reach = match random.below(8) {
                    0 => f64::INFINITY,
                    1 => (target - origin).length() * (1.0 + little(random)),
                    _ => (end - origin).length(),
                };
                let leaving = if random.chance(0.05) { Surface(SURFACE) } else { Surface::NONE };
                let after = Ray::NOTHING_AHEAD;
                rays.push(Ray { origin, direction, reach, leaving, after });
            }
            let class = class_of(&rays[0], &frame);
            rays.retain(|ray| class < CLASSES as u64 && class_of(ray, &frame) == class);
            let mut packet = Packet::default();
            if !rays.is_empty() {
                let members: Vec<u16> = (0..rays.len() as u16).collect();
                packet.fill(ScalarBoxes, &frame, &rays, (&members, true));
            }
            let [x, y, z] = packet.turn.axes;
            let corners = corners.map(|corner| [corner[x], corner[y], corner[z]]);
            let mask = random.bits() & packet.alive;
            Self { rays, packet, corners, mask }
        }
    }

    /// The bits of the ends, the way, and the rays that cross for certain, between their ends, and
    /// that do not.
    type Found = (Vec<u32>, Way, [u64; 2], [u64; 2]);

    impl KernelWork<Case> for Option<Found> {
        fn run(&mut self, case: &Case, kernel: impl BoxKernel) {
            let Case { rays, packet, corners, mask } = case;
            *self = packet.focus.map(|focus| {
                let mut groups = packet.groups;
                let count = rays.len().div_ceil(LANES);
                let way = kernel.find_ends(&mut groups[..count], &focus, packet.turn.axes[2]);
                let ends = groups[..count].iter().flat_map(|group| group.ends.as_flattened());
                let sifted = kernel.sift::<true>(&groups, &kernel.sieve(corners, &focus), *mask);
                let gate = Gate::new(corners, SURFACE, &focus, way);
                let passed = kernel.pass_gate(&groups, &gate, *mask);
                (ends.map(|end| end.to_bits()).collect(), way, sifted, passed)
            });
        }
    }

    #[test]
    fn what_f32_is_sure_of_is_what_f64_finds() {
        let random = &mut Random::new(23);
        let [mut stopped, mut let_past, mut asked] = [0; 3];
        for _ in 0..20_000 {
            let case = Case::random(random);
            let find = |isa| {
                let mut found = None;
                run_with_kernel(isa, &case, &mut found);
                found
            };
            let found = find(Isa::Scalar);
            for isa in Isa::ALL.into_iter().filter(|isa| isa.is_supported()) {
                assert_eq!(find(isa), found, "{isa}");
            }
            let Some((_, _, [possible, certain], [between, outside])) = found else { continue };
            let [x, y, z] = case.packet.turn.axes;
            let corners = case.corners.map(|corner| {
                let mut plain = [0.0; 3];
                (plain[x], plain[y], plain[z]) = (corner[0], corner[1], corner[2]);
                plain
            });
            for (k, ray) in case.rays.iter().enumerate() {
                let is = |mask: u64| mask >> k & 1 == 1;
                if !is(case.mask) {
                    continue;
                }
                let shear = Shear::new(ray.origin, ray.direction);
                let t = hit_triangle(shear.project_all(&corners));
                let blocks =
                    ray.leaving != Surface(SURFACE) && t.is_some_and(|t| t > 0.0 && t < ray.reach);
                let what = || format!("{ray:?}, {corners:?}: {t:?}");
                assert!(is(possible) || t.is_none(), "{}", what());
                assert!(!is(certain) || t.is_some(), "{}", what());
                assert!(!is(certain & between) || blocks, "{}", what());
                assert!(!is(outside) || !blocks, "{}", what());
                stopped += u32::from(is(certain & between));
                let_past += u32::from(is(possible & outside));
                asked += u32::from(is(possible & !outside & !(certain & between)));
            }
        }
        assert!(
            stopped > 20_000 && let_past > 50_000 && asked > 50_000,
            "{stopped} rays are stopped, {let_past} let past and {asked} left to f64"
        );
    }
}
