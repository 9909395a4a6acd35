//! Packets: rays that go the same way are taken through the hierarchy together.
//!
//! A ray meets the same boxes and the same faces as alone, bit for bit; only the order may be
//! another, on which no answer depends. Where few rays of a packet are left they go on alone.
//!
//! Sources: Wald, Slusallek, Benthin & Wagner, "Interactive Rendering with Coherent Ray Tracing"
//! (2001); a beam of intervals that rejects boxes for all rays, Boulos, Wald & Shirley, "Geometric
//! and Arithmetic Culling Methods for Entire Ray Packets" (2006); going on alone, Benthin, Wald,
//! Woop, Ernst & Mark, "Combining Single and Packet-Ray Tracing for Arbitrary Ray Distributions
//! on the Intel MIC Architecture" (2012).

use super::{
    box_ray::BoxRay,
    boxes::BoxKernel,
    gate::{Gate, Way},
    lane_faces::{cross_plane, cross_sphere, cross_sphere_again, leaves, pass_quadrangle},
    lanes::{
        Beam, Focus, GROUPS, LANES, MOST_RAYS, RayGroup, Turn, groups, larger, places, shear_at,
    },
    lone::step,
    meeting::Meeting,
    ray::{Ray, Shear},
    traversal::{STACK, Stack, Step},
};
use crate::prepared::{
    layout::View,
    node::{Child, Frame, Node},
    record::{Item, Kind},
};

/// So many rays, or fewer, go on alone.
const FEW: u32 = 2;

/// So many rays, or fewer, are not sifted before they are tried on a triangle.
const FEW_TO_SIFT: u32 = 8;

/// Fewer rays of a group than this meet a solid each alone.
const FEWEST_IN_SOLID: u32 = 4;

/// Lines that pass by a point by no more than this part of the frame have it as a focus.
const MOST_SPREAD: f64 = 1.0 / (1_u64 << 20) as f64;

/// Up to [`MOST_RAYS`] rays of one class.
#[derive(Debug)]
pub(super) struct Packet {
    pub(super) groups: [RayGroup; GROUPS],
    pub(super) beam: Beam,
    /// Where the rays cross a triangle.
    pub(super) crossings: [[f64; LANES]; GROUPS],
    pub(super) turn: Turn,
    /// The rays that still look for something, a bit each.
    pub(super) alive: u64,
    /// Whether all rays start at one place.
    has_one_start: bool,
    /// What sieves are made from, if rays have it.
    pub(super) focus: Option<Focus>,
    /// What their ends are to it, if that is asked.
    pub(super) way: Option<Way>,
    /// The groups with rays that reach less far than boxes know, a bit each.
    shortened: u64,
}

/// Room for children that wait, each with where it begins and the rays that enter it, and for a
/// node.
#[derive(Debug)]
pub(super) struct PacketStack([(f32, Child, u64); STACK], Node);

impl Default for PacketStack {
    fn default() -> Self {
        Self([(0.0, Child::NONE, 0); STACK], Node::EMPTY)
    }
}

impl Default for Packet {
    /// A packet of no rays.
    fn default() -> Self {
        Self {
            groups: [RayGroup::EMPTY; GROUPS],
            beam: Beam::EMPTY,
            crossings: [[0.0; LANES]; GROUPS],
            turn: Turn {
                frame: Frame { origin: [0.0; 3], scale: 1.0 },
                reach: BoxRay::NOWHERE,
                is_forward: [false; 3],
                axes: [0; 3],
            },
            alive: 0,
            has_one_start: false,
            focus: None,
            way: None,
            shortened: 0,
        }
    }
}

impl Packet {
    /// Takes in the `members` of `rays`, which are of one class: at least one. Whether something is
    /// between their ends can be told at once only if that is said here.
    #[inline(always)]
    pub(super) fn fill(
        &mut self,
        kernel: impl BoxKernel,
        frame: &Frame,
        rays: &[Ray],
        (members, has_walls): (&[u16], bool),
    ) {
        self.alive = u64::MAX >> (MOST_RAYS - members.len());
        self.turn = Turn::new(&rays[usize::from(members[0])], frame);
        let count = members.len().div_ceil(LANES);
        let (full, rest) = members.as_chunks::<LANES>();
        let mut padded = [0; LANES];
        if let Some(last) = rest.last() {
            // Lanes without a ray have the last one.
            padded = [*last; LANES];
            padded[..rest.len()].copy_from_slice(rest);
        }
        let rest = (!rest.is_empty()).then_some(&padded);
        for (group, members) in self.groups.iter_mut().zip(full.iter().chain(rest)) {
            let [a, b, c, d, e, f, g, h] = *members;
            let ray = |member: u16| &rays[usize::from(member)];
            let of_lanes = [ray(a), ray(b), ray(c), ray(d), ray(e), ray(f), ray(g), ray(h)];
            kernel.fill(group, of_lanes, &self.turn);
        }
        let groups = &self.groups[..count];
        self.has_one_start = start_together(groups);
        // Where rays start at one place that is their focus, or else where the first of them ends.
        let Ray { origin, direction, reach, .. } = &rays[usize::from(members[0])];
        let place = if self.has_one_start { *origin } else { *origin + *reach * *direction };
        let [x, y, z] = self.turn.axes;
        let place = [place[x], place[y], place[z]];
        let spread =
            if place[0].is_finite() { kernel.spread(groups, &place) } else { f64::INFINITY };
        self.beam = kernel.surround(groups, self.turn.is_forward);
        self.focus = (spread * frame.scale < MOST_SPREAD).then(|| {
            Focus::new(place, spread, (frame, self.beam.farthest_start()), self.turn.axes)
        });
        self.way = match &self.focus {
            Some(focus) if has_walls => Some(kernel.find_ends(&mut self.groups[..count], focus, z)),
            _ => None,
        };
    }

    /// Which rays of a mask meet the child of a node at this place.
    #[inline(always)]
    pub(super) fn enter(
        &self,
        kernel: impl BoxKernel,
        node: &Node,
        child: usize,
        mask: u64,
    ) -> u64 {
        let planes = |sides: [usize; 3]| sides.map(|side| node.planes[side][child]);
        let [mut near, mut far] = [planes(self.beam.near), planes(self.beam.far)];
        if !self.has_one_start {
            return kernel.enter::<false>(&self.groups, [near, far], mask);
        }
        for axis in 0..3 {
            near[axis] -= self.beam.near_origin[axis];
            far[axis] -= self.beam.far_origin[axis];
        }
        kernel.enter::<true>(&self.groups, [near, far], mask)
    }

    /// A ray as boxes want it.
    #[inline(always)]
    fn box_ray(&self, place: usize) -> BoxRay {
        let (group, lane) = (&self.groups[place / LANES], place % LANES);
        let mut ray = self.turn.reach;
        (ray.near, ray.far) = (self.beam.near, self.beam.far);
        for axis in 0..3 {
            ray.near_origin[axis] = group.near_origin[axis][lane];
            ray.far_origin[axis] = group.far_origin[axis][lane];
            ray.inverse[axis] = group.inverse[axis][lane];
            ray.far_inverse[axis] = group.far_inverse[axis][lane];
        }
        ray.high = group.high[lane];
        ray
    }

    /// A ray as flat faces want it.
    #[inline(always)]
    fn shear(&self, place: usize) -> Shear {
        shear_at(&self.groups[place / LANES], place % LANES, self.turn.axes)
    }

    /// Notes what an item has meant for a ray; whether it ended or reaches less far.
    #[inline(always)]
    fn take(&mut self, place: usize, step: &Step) -> bool {
        match *step {
            Step::Past => return false,
            Step::On(reach) => {
                self.groups[place / LANES].reach[place % LANES] = reach;
                self.shortened |= 1 << (place / LANES);
            }
            Step::Enough => self.alive &= !(1 << place),
        }
        true
    }

    /// Finds anew how far the farthest ray reaches.
    #[inline(always)]
    fn shorten_beam(&mut self) {
        let mut most = [f32::NEG_INFINITY; LANES];
        for (k, group) in self.groups.iter().enumerate() {
            if self.alive >> (LANES * k) & 0xFF != 0 {
                for (most, &high) in most.iter_mut().zip(&group.high) {
                    *most = larger(high, *most);
                }
            }
        }
        self.beam.high = most.into_iter().fold(f32::NEG_INFINITY, larger);
    }

    /// The rays of a mask meet the items of a leaf.
    #[inline(always)]
    fn meet_leaf<M: Meeting>(
        &mut self,
        kernel: impl BoxKernel,
        view: &View<'_>,
        (leaf, mask): (Child, u64),
        meeting: &mut M,
    ) {
        let mut is_changed = false;
        for item in view.items(leaf.items()) {
            let mask = mask & self.alive;
            let vertices = match item.kind() {
                Some(Kind::Triangle | Kind::Coplanar) => &view.faces[item.index()].vertices,
                Some(Kind::Sphere) if meeting.is_plain(item) => {
                    is_changed |= self.meet_sphere(view, (item, mask), meeting);
                    continue;
                }
                Some(Kind::Quadrangle) if meeting.is_plain(item) => {
                    is_changed |= self.meet_quadrangle(view, (item, mask), meeting);
                    continue;
                }
                Some(Kind::Solid) => {
                    is_changed |= self.meet_solid((item, mask), meeting);
                    continue;
                }
                _ => {
                    for place in places(mask) {
                        let shear = self.shear(place);
                        let step = meeting.ask(place, item, &shear, &BoxRay::NOWHERE);
                        is_changed |= self.take(place, &step);
                    }
                    continue;
                }
            };
            let [x, y, z] = self.turn.axes;
            let mut corners = [[0.0; 3]; 3];
            for (corner, vertex) in corners.iter_mut().zip(view.corners(vertices)) {
                *corner = [vertex[x], vertex[y], vertex[z]];
            }
            let mut mask = mask;
            if mask.count_ones() > FEW_TO_SIFT
                && let Some(focus) = &self.focus
            {
                let sieve = kernel.sieve(&corners, focus);
                if let Some(way) = self.way {
                    let [possible, certain] = kernel.sift::<true>(&self.groups, &sieve, mask);
                    mask = possible;
                    if mask != 0
                        && let Some(wall) = meeting.wall(item)
                    {
                        let gate = Gate::new(&corners, wall, focus, way);
                        let [between, outside] = kernel.pass_gate(&self.groups, &gate, mask);
                        let stopped = certain & between;
                        meeting.stop(stopped);
                        is_changed |= stopped != 0;
                        self.alive &= !stopped;
                        mask &= !(outside | stopped);
                    }
                } else {
                    [mask, _] = kernel.sift::<false>(&self.groups, &sieve, mask);
                }
                if mask == 0 {
                    continue;
                }
            }
            let met = kernel.cross(&self.groups, &corners, mask, &mut self.crossings);
            for (k, crossing) in groups(met.certain) {
                let group = (&mut self.groups[k], LANES * k);
                let crossing = [crossing, met.within >> (LANES * k) & 0xFF];
                let counts = meeting.cross_group(group, crossing, item, &self.crossings[k]);
                if counts != 0 && M::ENDS {
                    self.alive &= !(counts << (LANES * k));
                } else if counts != 0 {
                    self.shortened |= 1 << k;
                }
                is_changed |= counts != 0;
            }
            for place in places(met.possible & !met.certain) {
                let step = meeting.ask(place, item, &self.shear(place), &BoxRay::NOWHERE);
                is_changed |= self.take(place, &step);
            }
        }
        for k in places(std::mem::take(&mut self.shortened)) {
            kernel.shorten(&mut self.groups[k % GROUPS], &self.turn);
        }
        if is_changed {
            self.shorten_beam();
        }
    }

    /// The rays of a mask meet a sphere; whether one reaches less far than before.
    #[inline(always)]
    fn meet_sphere(
        &mut self,
        view: &View<'_>,
        (item, mask): (Item, u64),
        meeting: &mut impl Meeting,
    ) -> bool {
        let sphere = &view.spheres[item.index()];
        let mut is_changed = false;
        for (k, asking) in groups(mask) {
            let group = &self.groups[k];
            let (leaves, ahead) = leaves(group, sphere.surface, sphere.rank);
            let asked = asking & ahead;
            if asking & leaves & !ahead != 0 {
                let again = cross_sphere_again(group, self.turn.axes, &sphere.center);
                for lane in lanes(asking & leaves & !ahead) {
                    let step =
                        meeting.cross_sphere(LANES * k + lane, item, [again[lane], f64::INFINITY]);
                    is_changed |= self.take(LANES * k + lane, &step);
                }
            }
            for lane in lanes(asked) {
                let place = LANES * k + lane;
                let step = meeting.ask(place, item, &self.shear(place), &BoxRay::NOWHERE);
                is_changed |= self.take(place, &step);
            }
            if asking & !leaves == 0 {
                continue;
            }
            let group = &self.groups[k];
            let ends = cross_sphere(group, self.turn.axes, &sphere.center, sphere.radius);
            for lane in lanes(asking & !leaves & ends.met) {
                let place = LANES * k + lane;
                let step = meeting.cross_sphere(place, item, [ends.near[lane], ends.far[lane]]);
                is_changed |= self.take(place, &step);
            }
        }
        is_changed
    }

    /// The rays of a mask meet a quadrangle; whether one reaches less far than before.
    #[inline(always)]
    fn meet_quadrangle(
        &mut self,
        view: &View<'_>,
        (item, mask): (Item, u64),
        meeting: &mut impl Meeting,
    ) -> bool {
        let face = &view.quadrangles[item.index()];
        let [x, y, z] = self.turn.axes;
        let mut corners = [[0.0; 3]; 4];
        for (corner, vertex) in corners.iter_mut().zip(view.corners(&face.vertices)) {
            *corner = [vertex[x], vertex[y], vertex[z]];
        }
        let mut is_changed = false;
        for (k, asking) in groups(mask) {
            let group = &self.groups[k];
            let (leaves, ahead) = leaves(group, face.plane.surface().0, face.rank);
            let asking = asking & !(leaves & !ahead);
            if asking == 0 {
                continue;
            }
            let (inside, in_doubt) = pass_quadrangle(group, &corners);
            if asking & (inside | in_doubt) == 0 {
                continue;
            }
            let plane = &view.planes[face.plane.index()];
            let (crosses, t) = cross_plane(group, self.turn.axes, [&plane.point, &plane.normal]);
            let asked = in_doubt | leaves | !crosses;
            for lane in lanes(asking & (inside | in_doubt)) {
                let place = LANES * k + lane;
                let step = if asked >> lane & 1 == 1 {
                    meeting.ask(place, item, &self.shear(place), &BoxRay::NOWHERE)
                } else if t[lane] > 0.0 {
                    meeting.cross_quadrangle(place, item, t[lane])
                } else {
                    Step::Past
                };
                is_changed |= self.take(place, &step);
            }
        }
        is_changed
    }

    /// The rays of a mask meet a solid; whether one has ended or reaches less far than before.
    #[inline(always)]
    fn meet_solid<M: Meeting>(&mut self, (item, mask): (Item, u64), meeting: &mut M) -> bool {
        let mut together = 0;
        for (k, asking) in groups(mask) {
            if asking.count_ones() >= FEWEST_IN_SOLID {
                together |= asking << (LANES * k);
            }
        }
        let [mut counts, mut in_doubt] = [0; 2];
        if together != 0 {
            [counts, in_doubt] = meeting.cross_solid(&mut self.groups, &self.turn, together, item);
        }
        if M::ENDS {
            self.alive &= !counts;
        } else {
            for (k, _) in groups(counts) {
                self.shortened |= 1 << k;
            }
        }
        let mut is_changed = counts != 0;
        for place in places(mask & !together | in_doubt) {
            let (shear, box_ray) = (self.shear(place), self.box_ray(place));
            let step = meeting.ask(place, item, &shear, &box_ray);
            is_changed |= self.take(place, &step);
        }
        is_changed
    }

    /// A ray goes on alone in a child.
    #[inline(always)]
    fn visit_alone(
        &mut self,
        kernel: impl BoxKernel,
        view: &View<'_>,
        (child, place): (Child, usize),
        stack: &mut Stack,
        meeting: &mut impl Meeting,
    ) {
        let (box_ray, shear) = (self.box_ray(place), self.shear(place));
        let Stack(traversal, room) = stack;
        traversal.start(box_ray, child);
        let is_known = loop {
            if let Some(is_known) =
                step::<false>(kernel, view, (traversal, room), (place, &shear), meeting)
            {
                break is_known;
            }
        };
        if is_known {
            self.alive &= !(1 << place);
        }
        self.groups[place / LANES].high[place % LANES] = traversal.box_ray.high;
    }
}

/// Whether all rays of some groups start at one place.
#[inline(always)]
fn start_together(groups: &[RayGroup]) -> bool {
    let first = &groups[0].origin;
    let mut differences = 0;
    for group in groups {
        for (starts, first) in group.origin.iter().zip(first) {
            let mut in_lanes = 0;
            for start in starts {
                in_lanes |= start.to_bits() ^ first[0].to_bits();
            }
            differences |= in_lanes;
        }
        if differences != 0 {
            return false;
        }
    }
    true
}

/// The lanes of a group's part of a mask.
#[inline(always)]
fn lanes(asking: u64) -> impl Iterator<Item = usize> {
    places(asking).map(|place| place % LANES)
}

/// Takes a packet through the hierarchy: every ray meets the items in the leaves that it enters.
#[inline(always)]
pub(super) fn visit_packet(
    kernel: impl BoxKernel,
    view: &View<'_>,
    packet: &mut Packet,
    (PacketStack(stack, room), alone): (&mut PacketStack, &mut Stack),
    meeting: &mut impl Meeting,
) {
    let mut waiting = 0;
    let (mut current, mut mask) = (Child::ROOT, packet.alive);
    loop {
        if current.is_leaf() {
            packet.meet_leaf(kernel, view, (current, mask), meeting);
        } else if mask.count_ones() <= FEW {
            for place in places(mask) {
                packet.visit_alone(kernel, view, (current, place), alone, meeting);
            }
            packet.shorten_beam();
        } else {
            let node = view.node(current.node(), room);
            let (nears, mut met, within) = kernel.meet_beam(node, &packet.beam);
            if met.is_power_of_two() {
                // Boxes further down tell which rays enter them.
                let child = node.children[met.trailing_zeros() as usize & 7];
                if !child.is_leaf() {
                    current = child;
                    continue;
                }
            }
            let first = waiting;
            while met != 0 {
                let child = met.trailing_zeros() as usize & 7;
                met &= met - 1;
                let is_within = within >> child & 1 == 1;
                let entering =
                    if is_within { mask } else { packet.enter(kernel, node, child, mask) };
                if entering == 0 {
                    continue;
                }
                // Insert so that the nearest ends on top.
                let mut at = waiting;
                while at > first && stack[at - 1].0 < nears[child] {
                    stack[at] = stack[at - 1];
                    at -= 1;
                }
                stack[at] = (nears[child], node.children[child], entering);
                waiting += 1;
            }
        }
        loop {
            if waiting == 0 {
                return;
            }
            waiting -= 1;
            let (near, child, entering) = stack[waiting];
            (current, mask) = (child, entering & packet.alive);
            if near <= packet.beam.high && mask != 0 {
                break;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use glam::DVec3;
    use rtfarm_oracle::random::Random;

    use crate::{
        isa::Isa,
        prepare::prepare,
        prepared::PreparedScene,
        scene::{Quadrangle, Scene, Sphere, Triangle, Viewport},
        trace::probe::{Probe, Probing},
    };

    /// Triangles small and large, some of them in one plane, quadrangles and spheres.
    fn scene(random: &mut Random) -> Scene {
        let mut scene = Scene {
            viewport: Some(Viewport {
                eye: DVec3::ZERO,
                top_left: DVec3::Z,
                bottom_left: DVec3::Y,
                top_right: DVec3::X,
            }),
            ..Scene::default()
        };
        let mut primitive = 0..;
        let mut next = || primitive.next().expect("many numbers");
        for _ in 0..2_000 {
            let middle = random.in_cube();
            let size = random.log_uniform(0.01, 0.5);
            let mut corner = || {
                let corner = middle + size * random.in_cube();
                if random.chance(0.3) { DVec3::new(corner.x, corner.y, 0.25) } else { corner }
            };
            let vertices = [corner(), corner(), corner()];
            scene.triangles.push(Triangle { vertices, material: 0, primitive: next() });
        }
        for _ in 0..50 {
            let (center, radius) = (random.in_cube(), random.log_uniform(0.01, 0.2));
            scene.spheres.push(Sphere { center, radius, material: 0, primitive: next() });
            let [a, u, v] = [(); 3].map(|()| random.in_cube());
            let vertices = [a, a + 0.2 * u, a + 0.2 * (u + v), a + 0.2 * v];
            scene.quadrangles.push(Quadrangle { vertices, material: 0, primitive: next() });
        }
        scene.materials.push(crate::scene::Material {
            name: String::new(),
            color: DVec3::ONE,
            alpha: 1.0,
            reflect: 0.0,
            refract: 0.0,
            texture: None,
        });
        scene
    }

    #[test]
    fn rays_of_a_packet_meet_what_each_meets_alone() {
        let random = &mut Random::new(19);
        let scene = scene(random);
        let prepared = PreparedScene::open(prepare(&scene).unwrap()).unwrap();
        let mut probes = Vec::new();
        for _ in 0..40 {
            let (eye, middle) = (2.0 * random.in_cube(), random.in_cube());
            let spread = random.log_uniform(0.001, 1.0);
            for _ in 0..60 {
                let target = match random.below(3) {
                    0 => scene.triangles[random.below(scene.triangles.len())].vertices[0],
                    _ => middle + spread * random.in_cube(),
                };
                let origin = if random.chance(0.7) { eye } else { eye + 0.1 * random.in_cube() };
                let direction = (target - origin).normalize();
                probes.push(Probe { origin, direction, leaving: None });
            }
        }
        let truth = prepared.probe_all_faces(&probes);
        assert!(truth.iter().filter(|hit| hit.is_some()).count() > probes.len() / 4);
        for isa in Isa::ALL.into_iter().filter(|isa| isa.is_supported()) {
            assert_eq!(prepared.probe(&probes, isa), truth, "{isa}");
            for (probe, hit) in probes.iter().zip(&truth) {
                assert_eq!(prepared.probe(&[*probe], isa), [*hit], "{isa}: {probe:?}");
            }
        }
    }
}
