//! What rays are told of a solid, held against the plain evaluation of all its leaves.

use glam::DVec3;
use rtfarm_oracle::{
    hard_case::{few_rays, random},
    random::Random,
};

use super::*;
use crate::{
    isa::Isa,
    prepare::prepare,
    prepared::{PreparedBytes, PreparedScene, face::Part},
    scene::{Material, Operation, Parallelepiped, Scene, Solid, SolidNode, Sphere, Viewport},
    trace::{
        boxes::KernelWork,
        kernels::run_with_kernel,
        lanes::{CLASSES, GROUPS, LANES, RayGroup, Turn, class_of},
        solid_rays::{MOST_LEAVES, SolidRays},
    },
};

/// The plain evaluation of every leaf and every node, whatever the ray touches.
fn plain(course: &Course<'_>, node: u32) -> Vec<End> {
    let record = &course.nodes[node as usize];
    if record.kind == SolidNodeKind::LEAF {
        return course.meet_leaf(record.first_child).map_or(Vec::new(), Vec::from);
    }
    let children = (0..node).filter(|&child| course.nodes[child as usize].parent == node);
    let mut ends: Vec<(usize, End)> = children
        .enumerate()
        .flat_map(|(k, child)| plain(course, child).into_iter().map(move |end| (k, end)))
        .collect();
    ends.sort_by(|a, b| a.1.low.total_cmp(&b.1.low));
    let is_in = |operands: &[bool]| match record.kind {
        SolidNodeKind::UNION => operands.contains(&true),
        SolidNodeKind::INTERSECTION => !operands.contains(&false),
        _ => operands[0] && !operands[1..].contains(&true),
    };
    let mut operands = vec![false; record.operands as usize];
    let mut found = Vec::new();
    let mut next = 0;
    while next < ends.len() {
        let (from, mut high) = (next, f64::NEG_INFINITY);
        while next < ends.len() && (next == from || ends[next].1.low <= high) {
            high = high.max(ends[next].1.high);
            next += 1;
        }
        let step = &ends[from..next];
        let before = operands.clone();
        for &(k, _) in step {
            operands[k] = !operands[k];
        }
        let enters = is_in(&operands);
        if is_in(&before) == enters {
            continue;
        }
        let is_taken = |k: usize| record.kind == SolidNodeKind::DIFFERENCE && k > 0;
        let operand = (0..operands.len())
            .find(|&k| before[k] != operands[k] && operands[k] == (enters ^ is_taken(k)))
            .unwrap();
        let end = step.iter().find(|(k, _)| *k == operand).unwrap().1;
        let pinned = |pin| step.iter().map(|(_, end)| end).find(|end| end.pin == pin);
        let place = pinned(Pin::Start).or_else(|| pinned(Pin::Goal)).unwrap_or(&end);
        let End { t, low, high, pin, .. } = *place;
        found.push(End { t, low, high, enters, pin, ..end });
    }
    found
}

/// All crossings up to `reach` by the plain evaluation.
fn plain_crossings(course: &Course<'_>, reach: f64) -> Vec<Crossing> {
    let ends = plain(course, course.nodes.len() as u32 - 1);
    ends.iter()
        .filter(|end| end.t <= reach - course.start)
        .map(|end| course.crossing(end))
        .filter(|crossing| crossing.t >= 0.0)
        .collect()
}

/// How the numbers of a solid are drawn.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Style {
    Plain,
    /// Multiples of 1/4: shared planes and spheres, tangent faces, rays in planes.
    Grid,
    /// Far from the origin.
    Far,
    /// Sizes from 1e-4 to 1e4.
    Extreme,
}

fn place(random: &mut Random, style: Style) -> DVec3 {
    let place = random.in_cube();
    if style == Style::Grid { (place * 4.0).round() / 4.0 } else { place }
}

fn random_leaf(random: &mut Random, style: Style, scale: f64, primitive: u32) -> SolidNode {
    let shift = if style == Style::Far { DVec3::new(1e6, -2e6, 3e5) } else { DVec3::ZERO };
    let scale = if style == Style::Extreme { scale * random.log_uniform(1e-4, 1e4) } else { scale };
    let center = shift + place(random, style);
    let size = random.between(0.1, 1.0) * scale;
    let size = if style == Style::Grid { (size * 4.0).ceil() / 4.0 } else { size };
    if random.chance(0.5) {
        return SolidNode::Sphere(Sphere { center, radius: size, material: 0, primitive });
    }
    let mut edges = [DVec3::X, DVec3::Y, DVec3::Z].map(|axis| axis * size);
    if style != Style::Grid && random.chance(0.5) {
        edges = edges.map(|edge| edge + random.in_cube() * 0.3 * size);
    }
    let corner = center - edges.iter().sum::<DVec3>() / 2.0;
    SolidNode::Parallelepiped(Parallelepiped { corner, edges, material: 0, primitive })
}

/// A solid of so many leaves; a nested one is as deep as they are many.
fn random_solid(random: &mut Random, style: Style, leaf_count: u32, is_nested: bool) -> Solid {
    let mut nodes: Vec<SolidNode> = Vec::new();
    let (mut ready, mut leaves) = (0, Vec::new());
    for primitive in 0..leaf_count {
        // The first is large: there is something to take away from. Others return.
        let scale = if primitive == 0 { 2.0 } else { 2.0 / f64::from(leaf_count).cbrt() };
        let leaf = match leaves.get(random.below(4 * leaf_count as usize)) {
            Some(&leaf) => leaf,
            None => random_leaf(random, style, scale, primitive),
        };
        leaves.push(leaf);
        nodes.push(leaf);
        ready += 1;
        // An intersection of many things is empty.
        let operations = [Operation::Union, Operation::Difference, Operation::Intersection];
        let may_intersect = leaf_count < 9 || random.chance(0.02);
        let choice = random.below(if may_intersect { 3 } else { 2 });
        if ready >= 2 && (is_nested || random.chance(0.4)) {
            let most = ready.min(4) as usize;
            let operands = if is_nested { 2 } else { 2 + random.below(most - 1) as u32 };
            nodes.push(SolidNode::Operation { operation: operations[choice], operands });
            ready -= operands - 1;
        }
    }
    if ready > 1 {
        let operation = if random.chance(0.5) { Operation::Union } else { Operation::Difference };
        nodes.push(SolidNode::Operation { operation, operands: ready });
    }
    Solid { nodes, primitive: 0 }
}

/// A scene of this solid alone.
fn opened(solid: Solid) -> PreparedScene<PreparedBytes> {
    opened_with(solid, Vec::new())
}

/// A scene of this solid and some spheres.
fn opened_with(solid: Solid, spheres: Vec<Sphere>) -> PreparedScene<PreparedBytes> {
    let viewport = Viewport {
        eye: DVec3::Z * 5.0,
        top_left: DVec3::new(-1.0, 1.0, 0.0),
        bottom_left: DVec3::new(-1.0, -1.0, 0.0),
        top_right: DVec3::new(1.0, 1.0, 0.0),
    };
    let material = Material {
        name: "m".into(),
        color: DVec3::ONE,
        alpha: 1.0,
        reflect: 0.0,
        refract: 0.0,
        texture: None,
    };
    let scene = Scene {
        viewport: Some(viewport),
        materials: vec![material],
        solids: vec![solid],
        spheres,
        ..Scene::default()
    };
    PreparedScene::open(prepare(&scene).unwrap()).unwrap()
}

/// A point on a leaf, on an edge or a corner too, and a direction there along the leaf.
fn point_on(random: &mut Random, leaf: &SolidNode) -> (DVec3, DVec3) {
    match leaf {
        SolidNode::Sphere(sphere) => {
            let normal = random.direction();
            let (a, b) = normal.any_orthonormal_pair();
            let along = random.between(-1.0, 1.0) * a + random.between(-1.0, 1.0) * b;
            (sphere.center + normal * sphere.radius, along)
        }
        SolidNode::Parallelepiped(solid) => {
            let mut point = solid.corner;
            for edge in solid.edges {
                point += edge * [0.0, 1.0, random.unit()][random.below(3)];
            }
            let [a, b, _] = solid.edges;
            (point, random.between(-1.0, 1.0) * a + random.between(-1.0, 1.0) * b)
        }
        SolidNode::Operation { .. } => (DVec3::ZERO, DVec3::X),
    }
}

/// A ray at a leaf, from near or far: at a point of it, along it, along an axis.
fn random_ray(random: &mut Random, solid: &Solid, style: Style) -> (DVec3, DVec3) {
    let node = &solid.nodes[random.below(solid.nodes.len())];
    let (target, along) = point_on(random, node);
    let direction = match random.below(4) {
        0 => along,
        1 => DVec3::AXES[random.below(3)] * random.sign(),
        2 if style == Style::Grid => place(random, style) + DVec3::X,
        _ => random.direction(),
    };
    let direction = direction / direction.length();
    let direction = if direction.is_finite() { direction } else { DVec3::Y };
    let back = [0.25, 5.0, random.log_uniform(1e-6, 1e6)][random.below(3)];
    (target - back * direction, direction)
}

/// A ray without an end, in the units of the prepared scene, that leaves no surface.
fn endless_ray(view: &View<'_>, (origin, direction): (DVec3, DVec3)) -> Ray {
    Ray {
        origin: origin * view.header.scale,
        direction,
        reach: f64::INFINITY,
        leaving: Surface::NONE,
        after: Ray::NOTHING_AHEAD,
    }
}

/// What a ray is told of, with the kernel of an instruction set.
struct Told<'a> {
    solid: &'a SolidRecord,
    scratch: &'a mut Scratch,
    ray: &'a Ray,
    ending_on: &'a [Surface],
    most: usize,
    found: Vec<Crossing>,
}

impl KernelWork<View<'_>> for Told<'_> {
    fn run(&mut self, view: &View<'_>, kernel: impl BoxKernel) {
        let Self { solid, ray, most, .. } = *self;
        let box_ray = BoxRay::new(ray.origin, ray.direction, ray.reach, &view.header.frame);
        let rays = (ray, &box_ray);
        self.scratch.cross((view, solid), kernel, rays, self.ending_on, ray.reach, |crossing| {
            self.found.push(crossing);
            self.found.len() == most
        });
    }
}

/// The crossings of the plain evaluation, which are those that a ray is told of.
fn check(
    view: &View<'_>,
    (isa, scratch): (Isa, &mut Scratch),
    ray: &Ray,
    ending_on: &[Surface],
    what: &str,
) -> Vec<Crossing> {
    let solid = &view.solids[0];
    let truth = plain_crossings(&Course::new(view, solid, ray, ending_on), ray.reach);
    let bits = |crossings: &[Crossing]| {
        crossings.iter().map(|it| (it.t.to_bits(), it.part)).collect::<Vec<_>>()
    };
    // Told to stop at one of them, it tells of no other; told of all, it has told of all.
    for most in [1, truth.len() / 2 + 1, truth.len() + 1] {
        let mut told = Told { solid, scratch, ray, ending_on, most, found: Vec::new() };
        run_with_kernel(isa, view, &mut told);
        let found = told.found;
        let expected = &truth[..most.min(truth.len())];
        assert_eq!(bits(&found), bits(expected), "{what}: {ray:?}: {found:?}, {truth:?}");
    }
    truth
}

/// Rays at a solid: from anywhere, on from every crossing, and towards a surface. How many
/// crossings there were.
fn check_solid(
    random: &mut Random,
    solid: &Solid,
    style: Style,
    count: usize,
    what: &str,
) -> usize {
    let prepared = opened(solid.clone());
    let view = prepared.view();
    let mut scratch = Scratch::default();
    let isas: Vec<Isa> = Isa::ALL.into_iter().filter(|isa| isa.is_supported()).collect();
    let mut crossed = 0;
    for k in 0..count {
        let mut check = |ray: &Ray, ending_on: &[Surface]| {
            let truth = check(&view, (isas[k % isas.len()], &mut scratch), ray, ending_on, what);
            crossed += truth.len();
            truth
        };
        let ray = endless_ray(&view, random_ray(random, solid, style));
        let direction = ray.direction;
        let truth = check(&ray, &[]);
        let Some(&Crossing { t, part }) = truth.get(random.below(truth.len().max(1))) else {
            continue;
        };
        let surface = part.leaf_of(&view, &view.solids[0]).surface(part.face());
        // Up to there, and up to there as to a light on the surface.
        let short = Ray { reach: t.max(f64::MIN_POSITIVE), ..ray };
        check(&short, &[]);
        check(&short, &[surface]);
        // From there, on and elsewhere, and along a leaf.
        let origin = ray.origin + t * ray.direction;
        let along = random_ray(random, solid, style).1;
        for direction in [direction, random.direction(), along] {
            check(&Ray { origin, direction, leaving: surface, ..ray }, &[]);
        }
    }
    crossed
}

const STYLES: [Style; 4] = [Style::Plain, Style::Grid, Style::Far, Style::Extreme];

#[test]
fn what_is_passed_over_changes_no_bit() {
    let mut crossed = 0;
    for seed in 0..few_rays(8_000) as u64 {
        let random = &mut random(seed);
        let style = STYLES[seed as usize % 4];
        let leaf_count = 2 + random.below(7) as u32;
        let solid = random_solid(random, style, leaf_count, seed % 5 == 0);
        crossed += check_solid(random, &solid, style, 15, &format!("{style:?} solid {seed}"));
    }
    eprintln!("{crossed} crossings of small solids");
    assert!(crossed > 100_000);
}

#[test]
fn what_is_passed_over_in_large_and_deep_solids_changes_no_bit() {
    let mut crossed = 0;
    for seed in 0..few_rays(400) as u64 {
        let random = &mut random(seed);
        let style = STYLES[seed as usize % 4];
        let leaf_count = random.log_uniform(9.0, 300.0) as u32;
        let solid = random_solid(random, style, leaf_count, seed % 3 == 0);
        let what = format!("{style:?} solid of {leaf_count}, {seed}");
        crossed += check_solid(random, &solid, style, 20, &what);
    }
    eprintln!("{crossed} crossings of large solids");
    assert!(crossed > 10_000);
}

/// What rays of a group are told of, with the kernel of an instruction set.
struct ToldTogether<'a> {
    solid: &'a SolidRecord,
    lanes: &'a mut SolidLanes,
    rays: &'a [Ray],
    skips_start: bool,
    most: usize,
    found: Vec<Vec<(u64, Part)>>,
    in_doubt: u64,
}

impl KernelWork<View<'_>> for ToldTogether<'_> {
    fn run(&mut self, view: &View<'_>, kernel: impl BoxKernel) {
        let Self { solid, rays, most, found, .. } = self;
        let turn = Turn::new(&rays[0], &view.header.frame);
        let of_lanes = std::array::from_fn(|lane| &rays[lane.min(rays.len() - 1)]);
        let mut groups = [RayGroup::EMPTY; GROUPS];
        kernel.fill(&mut groups[0], of_lanes, &turn);
        let asking = (u64::MAX >> (64 - rays.len()), self.skips_start);
        let take = |lane: usize, Crossing { t, part }| {
            found[lane].push((t.to_bits(), part));
            found[lane].len() == *most
        };
        self.in_doubt = self.lanes.cross((view, solid), kernel, (&groups, &turn), asking, take);
    }
}

/// All that a kernel finds of a group's rays at a solid.
impl KernelWork<View<'_>> for (&[Ray], Vec<String>) {
    fn run(&mut self, view: &View<'_>, kernel: impl BoxKernel) {
        let (rays, found) = self;
        let solid = &view.solids[0];
        let turn = Turn::new(&rays[0], &view.header.frame);
        let mut group = RayGroup::EMPTY;
        let of_lanes = std::array::from_fn(|lane| &rays[lane.min(rays.len() - 1)]);
        kernel.fill(&mut group, of_lanes, &turn);
        let mut near = [SolidRays::EMPTY];
        let any_leaves = kernel.approach(&mut near[0], (&group, &turn), solid);
        let beam = kernel.surround_near(&near, turn.is_forward);
        found.push(format!("{near:?} {any_leaves} {beam:?}"));
        for node in view.solid_boxes {
            found.push(format!("{:b}", kernel.touch_beam(node, &beam)));
            for child in 0..8 {
                let planes = |sides: [usize; 3]| sides.map(|side| node.planes[side][child]);
                let planes = [planes(beam.beam.near), planes(beam.beam.far)];
                found.push(format!("{}", kernel.touch(&near, (&[(0, u8::MAX)], 1), planes)));
            }
        }
        let mut all_ends = Vec::new();
        let apart = solid.margin / 1024.0;
        for leaf in view.solid_leaves(solid).iter().take(MOST_LEAVES) {
            let mut ends = [[0.0; LANES]; 2];
            let met = if leaf.is_sphere() {
                kernel.meet_ball(&near[0], leaf, (any_leaves, apart), &mut ends)
            } else {
                let planes = &view.box_planes[leaf.surface as usize];
                kernel.meet_box(&near[0], planes, (any_leaves, apart), &mut ends)
            };
            found.push(format!("{met:?}"));
            all_ends.push(ends);
        }
        let (mut at, mut next) = (near[0].left_at, [0.0; LANES]);
        for _ in 0..3 {
            let mut inside = [0; MOST_LEAVES];
            let places = (&at, &near[0].near.reach, apart);
            let seen = kernel.look(&all_ends, places, &mut inside, &mut next);
            found.push(format!("{seen:?} {inside:?} {next:?}"));
            at = next;
        }
        found.push(format!("{all_ends:?}"));
    }
}

/// Rays of a class, which are told of what each is told of by the plain evaluation, if they are
/// not in doubt: how many crossings they were told of, and how many are in doubt.
fn check_group(
    view: &View<'_>,
    lanes: &mut SolidLanes,
    (rays, skips_start): (&[Ray], bool),
    what: &str,
) -> [usize; 2] {
    let solid = &view.solids[0];
    let counts = |crossing: &Crossing| !skips_start || crossing.t > 0.0;
    let truths: Vec<Vec<_>> = rays
        .iter()
        .map(|ray| {
            let truth = plain_crossings(&Course::new(view, solid, ray, &[]), ray.reach);
            truth.into_iter().filter(counts).map(|it| (it.t.to_bits(), it.part)).collect()
        })
        .collect();
    let mut told = 0;
    let mut in_doubt = 0;
    for most in [1, 2, usize::MAX] {
        let mut first = None;
        for isa in Isa::ALL.into_iter().filter(|isa| isa.is_supported()) {
            let lanes = &mut *lanes;
            let found = vec![Vec::new(); rays.len()];
            let mut work =
                ToldTogether { solid, lanes, rays, skips_start, most, found, in_doubt: 0 };
            run_with_kernel(isa, view, &mut work);
            for (lane, (found, truth)) in work.found.iter().zip(&truths).enumerate() {
                let truth = &truth[..most.min(truth.len())];
                let is_in_doubt = work.in_doubt >> lane & 1 == 1;
                assert!(
                    is_in_doubt || found == truth,
                    "{what}, {isa}: {:?}: {found:?}, {truth:?}",
                    rays[lane]
                );
            }
            told += work.found.iter().map(Vec::len).sum::<usize>();
            in_doubt += work.in_doubt.count_ones() as usize;
            let this = (work.found, work.in_doubt);
            assert_eq!(first.get_or_insert(this.clone()), &this, "{what}, {isa}");
        }
    }
    [told, in_doubt]
}

#[test]
fn rays_of_a_group_are_told_what_each_is_told_alone() {
    let [mut told, mut in_doubt, mut groups] = [0; 3];
    let mut lanes = SolidLanes::default();
    for seed in 0..few_rays(6_000) as u64 {
        let random = &mut random(seed);
        let style = STYLES[seed as usize % 4];
        let most_leaves = if seed % 8 == 0 { 40.0 } else { 9.0 };
        let leaf_count = random.log_uniform(2.0, most_leaves) as u32;
        let solid = random_solid(random, style, leaf_count, seed % 5 == 0);
        // Some solids are small in their scene: rays come from far off.
        let (place, _) = random_ray(random, &solid, style);
        let center = place + 100.0 * random.direction();
        let far = Sphere { center, radius: 1.0, material: 0, primitive: 99 };
        let spheres = if random.chance(0.3) { vec![far] } else { Vec::new() };
        let prepared = opened_with(solid.clone(), spheres);
        let view = prepared.view();
        let record = &view.solids[0];
        if view.solid_nodes(record).len() > SolidNodeRecord::BITS {
            continue;
        }
        let mut classes = vec![Vec::new(); CLASSES];
        let mut class = |ray: Ray| {
            let class = class_of(&ray, &view.header.frame) as usize;
            if let Some(rays) = classes.get_mut(class) {
                rays.push(ray);
            }
        };
        for _ in 0..40 {
            let ray = endless_ray(&view, random_ray(random, &solid, style));
            let direction = ray.direction;
            class(ray);
            let truth = plain_crossings(&Course::new(&view, record, &ray, &[]), f64::INFINITY);
            let Some(&Crossing { t, part }) = truth.get(random.below(truth.len().max(1))) else {
                continue;
            };
            class(Ray { reach: t.max(f64::MIN_POSITIVE), ..ray });
            let leaving = part.leaf_of(&view, record).surface(part.face());
            let origin = ray.origin + t * ray.direction;
            let along = random_ray(random, &solid, style).1;
            for direction in [direction, random.direction(), along] {
                class(Ray { origin, direction, leaving, ..ray });
            }
        }
        for (k, rays) in classes.iter().flat_map(|rays| rays.chunks(LANES)).enumerate() {
            let what = format!("{style:?} solid {seed}");
            let found = check_group(&view, &mut lanes, (rays, k % 2 == 0), &what);
            told += found[0];
            in_doubt += found[1];
            if groups % 16 == 0 {
                let isas = Isa::ALL.into_iter().filter(|isa| isa.is_supported());
                let found = isas.map(|isa| {
                    let mut found = (rays, Vec::new());
                    run_with_kernel(isa, &view, &mut found);
                    found.1
                });
                let found: Vec<Vec<String>> = found.collect();
                assert!(found.iter().all(|it| *it == found[0]), "{what}: {found:#?}");
            }
            groups += 1;
        }
    }
    eprintln!("{groups} groups, {told} told, {in_doubt} in doubt");
    assert!(told > 100_000 && in_doubt > 1_000 && in_doubt < told, "{told}, {in_doubt}");
}

#[test]
fn a_ray_through_all_leaves_of_a_solid_with_a_bit_for_each_changes_no_bit() {
    let mut crossed = 0;
    for operands in [31, 32, 33, 63] {
        let sphere = |primitive: u32| {
            let radius = 1.0 + f64::from(primitive) / 64.0;
            SolidNode::Sphere(Sphere { center: DVec3::ZERO, radius, material: 0, primitive })
        };
        let operation = Operation::Union;
        let mut nodes: Vec<SolidNode> = (0..operands).map(sphere).collect();
        nodes.push(SolidNode::Operation { operation, operands });
        let solid = Solid { nodes, primitive: 0 };
        let what = format!("{operands} nested spheres");
        crossed += check_solid(&mut random(9), &solid, Style::Plain, 50, &what);
    }
    assert!(crossed > 100, "{crossed}");
}
