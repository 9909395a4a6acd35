//! The choice of the kernel that an instruction set has.

use super::boxes::{BoxKernel, KernelWork, ScalarBoxes};
#[cfg(target_arch = "x86_64")]
use super::{
    boxes_avx512::Avx512Boxes,
    boxes_x86::{Avx2Boxes, Sse2Boxes},
};
use crate::isa::Isa;

/// Does work with the kernel of an instruction set, which this CPU must have.
pub(super) fn run_with_kernel<Input>(isa: Isa, input: &Input, work: &mut impl KernelWork<Input>) {
    const LACKING: &str = "instruction sets are chosen among those that the CPU has";
    match isa {
        Isa::Scalar => work.run(input, ScalarBoxes),
        #[cfg(target_arch = "x86_64")]
        Isa::Sse2 => work.run(input, Sse2Boxes::new()),
        #[cfg(target_arch = "x86_64")]
        Isa::Avx2 => Avx2Boxes::detect().expect(LACKING).run(input, work),
        #[cfg(target_arch = "x86_64")]
        Isa::Avx512 => Avx512Boxes::detect().expect(LACKING).run(input, work),
        #[cfg(not(target_arch = "x86_64"))]
        Isa::Sse2 | Isa::Avx2 | Isa::Avx512 => panic!("{LACKING}"),
    }
}

/// Work on numbers side by side, in plain Rust, that is compiled once for each instruction set.
pub(crate) trait LaneWork {
    fn run(&mut self);
}

struct WithAnyKernel<'a, W>(&'a mut W);

impl<W: LaneWork> KernelWork<()> for WithAnyKernel<'_, W> {
    #[inline(always)]
    fn run(&mut self, (): &(), _kernel: impl BoxKernel) {
        self.0.run();
    }
}

/// Does work with an instruction set, which this CPU must have.
pub(crate) fn run_in_lanes(isa: Isa, work: &mut impl LaneWork) {
    run_with_kernel(isa, &(), &mut WithAnyKernel(work));
}

#[cfg(test)]
mod tests {
    use glam::DVec3;
    use rtfarm_oracle::random::Random;

    use super::*;
    use crate::{
        prepared::{
            node::{Child, Frame, Node},
            record::Surface,
        },
        trace::{
            box_ray::BoxRay,
            boxes::BoxKernel,
            lanes::{CLASSES, Crossings, FACES, LANES, MOST_RAYS, RayGroup, Sieve, class_of},
            packet::Packet,
            ray::{Ray, Shear},
            triangle::hit_triangle,
        },
    };

    /// Nodes with boxes of all kinds: thick, flat, touching, far away, unused.
    fn random_node(random: &mut Random) -> Node {
        let mut node = Node::EMPTY;
        for child in 0..8 {
            if random.below(6) == 0 {
                continue; // It stays unused.
            }
            for axis in 0..3 {
                let low = grid_or_any(random);
                let thin = [0.0, f64::from(f32::EPSILON), 0.25];
                let thickness = thin.get(random.below(8)).copied().unwrap_or(1.0);
                node.planes[axis][child] = low as f32;
                node.planes[axis + 3][child] = (low + thickness) as f32;
            }
            node.children[child] = Child::leaf(child, 1);
        }
        node
    }

    /// A number among few, so that rays start on planes and graze edges, or any number.
    fn grid_or_any(random: &mut Random) -> f64 {
        match random.below(3) {
            0 => random.between(-1.0, 1.0),
            _ => random.below(9) as f64 / 4.0 - 1.0,
        }
    }

    /// Rays from everywhere, of any reach: most towards the boxes, some along axes and planes, some
    /// from afar, some that stand still.
    fn random_ray(random: &mut Random) -> BoxRay {
        let mut point = || DVec3::from_array([(); 3].map(|()| grid_or_any(random)));
        let (mut origin, target) = (point(), point());
        let mut direction = target - origin;
        match random.below(8) {
            0 => origin -= 1e9 * direction,
            1 => direction.x = 0.0,
            2 => (direction.y, direction.z) = (-0.0, 0.0),
            _ => {}
        }
        let length = direction.length();
        let direction = if length > 0.0 { direction / length } else { direction };
        let reach = [f64::INFINITY, 0.5, 3.0, f64::MIN_POSITIVE][random.below(4)];
        BoxRay::new(origin, direction, reach, &Frame { origin: [0.0; 3], scale: 1.0 })
    }

    /// What a kernel finds in a node: the mask, and the bits of the distances of what is met.
    type Found = (u32, [u32; 8]);

    impl KernelWork<(Node, BoxRay)> for Option<Found> {
        fn run(&mut self, (node, ray): &(Node, BoxRay), kernel: impl BoxKernel) {
            let (distances, mask) = kernel.test(node, ray);
            let mut bits = distances.map(f32::to_bits);
            for (child, bits) in bits.iter_mut().enumerate() {
                *bits *= mask >> child & 1;
            }
            *self = Some((mask, bits));
        }
    }

    #[test]
    fn every_kernel_meets_the_same_boxes_at_the_same_distances() {
        let random = &mut Random::new(17);
        let mut met = 0;
        for _ in 0..20_000 {
            let input = (random_node(random), random_ray(random));
            let find = |isa| {
                let mut found = None;
                run_with_kernel(isa, &input, &mut found);
                found.expect("the kernel ran")
            };
            let scalar = find(Isa::Scalar);
            met += scalar.0.count_ones();
            for isa in Isa::ALL.into_iter().filter(|isa| isa.is_supported()) {
                assert_eq!(find(isa), scalar, "{isa}: {input:?}");
            }
        }
        assert!(met > 2_000, "{met} of 160,000 boxes are met");
    }

    /// Rays of one class, with the triangles and boxes that they are tried on: grids and
    /// shared starts, so that edges, corners and planes are met.
    struct Group {
        frame: Frame,
        /// Rays of all classes.
        all: Vec<Ray>,
        rays: Vec<Ray>,
        packet: Packet,
        corners: [[f64; 3]; 3],
        node: Node,
        mask: u64,
    }

    impl Group {
        fn random(random: &mut Random) -> Self {
            let frame = Frame { origin: [0.0; 3], scale: 1.0 };
            let mut point = || DVec3::from_array([(); 3].map(|()| grid_or_any(random)));
            let eye = point();
            let (a, b, c) = (point(), point(), point());
            let size = [1.0, 1e-2, 1e-5][random.below(3)];
            let corners = [a, a + size * (b - a), a + size * (c - a)];
            let mut rays = Vec::new();
            // From one place, from several, or towards one place.
            let kind = random.below(3);
            for _ in 0..MOST_RAYS {
                let [a, b, c] = corners;
                let target = match random.below(4) {
                    0 => corners[random.below(3)],
                    1 => a + random.unit() * (b - a),
                    _ => a + random.unit() * (b - a) + random.unit() * (c - a),
                };
                let origin = match kind {
                    0 => eye,
                    1 if random.chance(0.7) => eye,
                    1 => eye + 0.1 * random.in_cube(),
                    _ => target + random.between(-0.5, 1.0) * (target - eye),
                };
                let reach = match kind {
                    2 => (eye - origin).length(),
                    _ => [f64::INFINITY, 0.5, 3.0][random.below(3)],
                };
                let (leaving, after) = (Surface::NONE, Ray::NOTHING_AHEAD);
                let aim = if kind == 2 { eye } else { target };
                let direction = (aim - origin).normalize();
                let direction = if direction.is_finite() { direction } else { DVec3::Y };
                rays.push(Ray { origin, direction, reach, leaving, after });
            }
            let all = rays.clone();
            let class = class_of(&rays[0], &frame);
            rays.retain(|ray| class < CLASSES as u64 && class_of(ray, &frame) == class);
            let mut packet = Packet::default();
            if !rays.is_empty() {
                let members: Vec<u16> = (0..rays.len() as u16).collect();
                packet.fill(ScalarBoxes, &frame, &rays, (&members, true));
            }
            let [x, y, z] = packet.turn.axes;
            let corners = corners.map(|corner| [corner[x], corner[y], corner[z]]);
            let node = random_node(random);
            let mask = random.bits() & packet.alive;
            Self { frame, all, rays, packet, corners, node, mask }
        }

        fn planes(&self, child: usize) -> [[f32; 3]; 2] {
            [self.packet.beam.near, self.packet.beam.far]
                .map(|sides| sides.map(|side| self.node.planes[side][child]))
        }
    }

    /// What a kernel finds: the rays that enter each box, the boxes that the beam may meet, and
    /// where rays cross the triangle.
    #[derive(Debug, PartialEq)]
    struct FoundByGroup {
        entering: [u64; 8],
        met: u32,
        within: u32,
        nears: [u32; 8],
        crossings: Crossings,
        distances: Vec<Option<u64>>,
        /// How far the lines pass by the packet's focus, the triangle's sieve and the rays that it
        /// lets through.
        sifted: Option<(u64, Sieve, [u64; 2])>,
        shortened: String,
        classes: Vec<u64>,
        filled: Option<String>,
        beam: String,
    }

    impl KernelWork<Group> for Option<FoundByGroup> {
        fn run(&mut self, group: &Group, kernel: impl BoxKernel) {
            let Group { packet, corners, node, mask, .. } = group;
            let mut entering = [0; 8];
            for (child, entering) in entering.iter_mut().enumerate() {
                *entering = kernel.enter::<false>(&packet.groups, group.planes(child), *mask);
                assert_eq!(packet.enter(kernel, node, child, *mask), *entering);
            }
            let count = group.rays.len().div_ceil(LANES);
            let (nears, met, within) = kernel.meet_beam(node, &packet.beam);
            let mut distances = packet.crossings;
            let crossings = kernel.cross(&packet.groups, corners, *mask, &mut distances);
            let distances = (distances.as_flattened().iter().enumerate())
                .map(|(k, t)| (crossings.certain >> k & 1 == 1).then_some(t.to_bits()))
                .collect();
            let sifted = packet.focus.map(|focus| {
                let spread = kernel.spread(&packet.groups[..count], &focus.point);
                let sieve = kernel.sieve(corners, &focus);
                (spread.to_bits(), sieve, kernel.sift::<true>(&packet.groups, &sieve, *mask))
            });
            let mut shortened = packet.groups[0];
            for (reach, t) in shortened.reach.iter_mut().zip(packet.groups[0].slopes[0]) {
                *reach = if t > 0.0 { t } else { *reach };
            }
            kernel.shorten(&mut shortened, &packet.turn);
            let shortened = format!("{:?}", shortened.high);
            let nears = nears.map(f32::to_bits);
            let classes = group.all.as_chunks().0.iter();
            let classes =
                classes.flat_map(|four| kernel.classify(four.each_ref(), &group.frame)).collect();
            let filled = group.rays.first_chunk().map(|rays: &[Ray; LANES]| {
                let mut filled = RayGroup::EMPTY;
                kernel.fill(&mut filled, rays.each_ref(), &packet.turn);
                format!("{filled:?}")
            });
            let beam = kernel.surround(&packet.groups[..count], packet.turn.is_forward);
            let beam = format!("{beam:?}");
            *self = Some(FoundByGroup {
                entering,
                met,
                within,
                nears,
                crossings,
                distances,
                sifted,
                shortened,
                classes,
                filled,
                beam,
            });
        }
    }

    #[test]
    fn rays_of_a_group_meet_what_each_meets_alone() {
        let random = &mut Random::new(18);
        let [mut entered, mut crossed, mut doubted, mut held_back] = [0; 4];
        for _ in 0..2_000 {
            let group = Group::random(random);
            let find = |isa| {
                let mut found = None;
                run_with_kernel(isa, &group, &mut found);
                found.expect("the kernel ran")
            };
            let found = find(Isa::Scalar);
            for isa in Isa::ALL.into_iter().filter(|isa| isa.is_supported()) {
                assert_eq!(find(isa), found, "{isa}");
            }
            for (k, ray) in group.rays.iter().enumerate() {
                if group.mask >> k & 1 == 0 {
                    continue;
                }
                let box_ray = BoxRay::new(ray.origin, ray.direction, ray.reach, &group.frame);
                let (_, met) = ScalarBoxes.test(&group.node, &box_ray);
                for (child, entering) in found.entering.iter().enumerate() {
                    let enters = entering >> k & 1 == 1;
                    assert_eq!(enters, met >> child & 1 == 1, "{ray:?}");
                    assert!(!enters || found.met >> child & 1 == 1, "{ray:?}");
                    entered += u32::from(enters);
                }
                let [x, y, z] = group.packet.turn.axes;
                let corners = group.corners.map(|corner| {
                    let mut plain = [0.0; 3];
                    (plain[x], plain[y], plain[z]) = (corner[0], corner[1], corner[2]);
                    plain
                });
                let shear = Shear::new(ray.origin, ray.direction);
                let t = hit_triangle(shear.project_all(&corners)).map(f64::to_bits);
                let is = |mask: u64| mask >> k & 1 == 1;
                if is(found.crossings.certain) {
                    assert_eq!(found.distances[k], t, "{ray:?}");
                    let is_within =
                        t.map(f64::from_bits).is_some_and(|t| t > 0.0 && t <= ray.reach);
                    assert_eq!(is(found.crossings.within), is_within, "{ray:?}");
                }
                assert!(is(found.crossings.possible) || t.is_none(), "{ray:?}");
                if let Some((_, _, [sifted, _])) = found.sifted {
                    assert!(is(sifted) || t.is_none(), "{ray:?}");
                    held_back += u32::from(!is(sifted));
                }
                crossed += u32::from(is(found.crossings.certain));
                doubted += u32::from(is(found.crossings.possible & !found.crossings.certain));
            }
        }
        assert!(
            entered > 1_000 && crossed > 1_000 && doubted > 1_000,
            "{entered} boxes are entered, {crossed} triangles crossed, {doubted} in doubt"
        );
        assert!(held_back > 1_000, "{held_back} rays that pass by are held back");
    }

    /// A ray and four triangles.
    type Four = (Shear, [[[f64; 3]; 3]; FACES]);

    /// Which of them it may cross, which for certain, and the bits of these distances.
    type FoundOnFour = (Crossings, [Option<u64>; FACES]);

    impl KernelWork<Four> for Option<FoundOnFour> {
        fn run(&mut self, (shear, corners): &Four, kernel: impl BoxKernel) {
            let corners = corners.each_ref().map(<[[f64; 3]; 3]>::each_ref);
            let mut distances = [0.0; FACES];
            let met = kernel.cross_four(shear, &corners, &mut distances);
            let bits =
                |lane: usize| (met.certain >> lane & 1 == 1).then_some(distances[lane].to_bits());
            *self = Some((met, [0, 1, 2, 3].map(bits)));
        }
    }

    #[test]
    fn a_ray_is_to_four_triangles_what_it_is_to_each() {
        let seed = 21;
        let random = &mut Random::new(seed);
        let (mut crossed, mut doubted) = (0, 0);
        for case in 0..20_000 {
            let mut point = || DVec3::from_array([(); 3].map(|()| grid_or_any(random)));
            let corners = [(); FACES].map(|()| [(); 3].map(|()| point().to_array()));
            let (origin, elsewhere) = (point(), point());
            let [a, b, _] = corners[random.below(FACES)].map(DVec3::from_array);
            let target = [a, a + 0.5 * (b - a), elsewhere][random.below(3)];
            let direction = (target - origin).normalize();
            let direction = if direction.is_finite() { direction } else { DVec3::Y };
            let shear = Shear::new(origin, direction);
            let find = |isa| {
                let mut found = None;
                run_with_kernel(isa, &(shear, corners), &mut found);
                found.expect("the kernel ran")
            };
            let (met, distances) = find(Isa::Scalar);
            for isa in Isa::ALL.into_iter().filter(|isa| isa.is_supported()) {
                assert_eq!(find(isa), (met, distances), "seed {seed}, case {case}, {isa}");
            }
            for (lane, corners) in corners.iter().enumerate() {
                let t = hit_triangle(shear.project_all(corners)).map(f64::to_bits);
                let is = |mask: u64| mask >> lane & 1 == 1;
                let what = format!("seed {seed}, case {case}, lane {lane}");
                assert!(!is(met.certain) || distances[lane] == t, "{what}");
                assert!(is(met.possible) || t.is_none(), "{what}");
                crossed += u32::from(is(met.certain));
                doubted += u32::from(is(met.possible & !met.certain));
            }
        }
        assert!(crossed > 1_000 && doubted > 1_000, "{crossed} crossed, {doubted} in doubt");
    }
}
