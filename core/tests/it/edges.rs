//! Closed surfaces let no ray through at their edges and corners, wherever they stand and however
//! large they are.

use glam::DVec3;
use rayon::prelude::*;
use rtfarm_core::{
    isa::Isa,
    prepare::prepare,
    prepared::{PreparedBytes, PreparedScene},
    scene::{Operation, Parallelepiped, Quadrangle, Scene, Solid, SolidNode, Triangle},
    testing::{Probe, Probing},
};
use rtfarm_oracle::{
    Oracle,
    hard_case::{HardCase, few_rays, random, rays},
    random::Random,
    random_scene::{Recipe, Style, random_scene},
};

/// Where surfaces stand and how large they are.
const PLACES: [(f64, f64); 6] = [
    (0.0, 1.0),
    (1e3, 1.0),
    (1e6, 1.0),
    (1e9, 1.0),
    (0.0, 1_099_511_627_776.0),
    (0.0, 1.0 / 1_099_511_627_776.0),
];

/// Of what a surface is made.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Patches {
    Triangles,
    Quadrangles,
    Mixed,
}

/// A closed surface, its corners and edges, and points inside it.
struct Surface {
    scene: Scene,
    edges: Vec<[DVec3; 2]>,
    inside: Vec<DVec3>,
    /// Its walls are solid: a ray from inside crosses both sides of one.
    is_thick: bool,
}

fn empty() -> Scene {
    let nothing = Recipe { spheres: 0, triangles: 0, quadrangles: 0, ..Recipe::new(Style::Plain) };
    random_scene(0, &Recipe { parallelepipeds: 0, lights: 0, ..nothing })
}

/// A ring of around x along patches, each flat, so that it can be one quadrangle.
fn ring(patches: Patches, around: usize, along: usize, (offset, scale): (f64, f64)) -> Surface {
    let turn = |k: usize, of: usize| {
        // A rational point of the circle: no sine needed.
        let t = (k % of) as f64 / of as f64 * 8.0 - 4.0;
        let t = if t.abs() < 1.0 { t } else { t * t * t.signum() };
        ((1.0 - t * t) / (1.0 + t * t), 2.0 * t / (1.0 + t * t))
    };
    let at = |i: usize, radius: f64, height: f64| {
        let (c, s) = turn(i, around);
        DVec3::new(radius * c, height, radius * s) * scale + offset
    };
    let corner = |i: usize, j: usize| {
        let (d, e) = turn(j, along);
        at(i, 2.0 + 0.7 * d, 0.7 * e)
    };
    let mut scene = empty();
    let mut edges = Vec::new();
    for j in 0..along {
        for i in 0..around {
            let vertices =
                [(i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)].map(|(i, j)| corner(i, j));
            let [a, b, c, d] = vertices;
            let primitive = (scene.triangles.len() + scene.quadrangles.len()) as u32;
            edges.extend([[a, b], [a, d]]);
            if patches == Patches::Quadrangles || (patches == Patches::Mixed && (i + j) % 2 == 0) {
                scene.quadrangles.push(Quadrangle { vertices, material: 0, primitive });
                continue;
            }
            edges.push([a, c]);
            for (primitive, vertices) in (primitive..).zip([[a, b, c], [a, c, d]]) {
                scene.triangles.push(Triangle { vertices, material: 0, primitive });
            }
        }
    }
    Surface {
        scene,
        edges,
        inside: (0..around).map(|i| at(i, 2.0, 0.0)).collect(),
        is_thick: false,
    }
}

/// A box less a smaller, sheared one: rays start in the cavity. The walls are of two boxes, which
/// touch.
fn shell((offset, scale): (f64, f64)) -> Surface {
    let offset = DVec3::splat(offset);
    let make = |corner: DVec3, edges: [DVec3; 3]| Parallelepiped {
        corner: corner * scale + offset,
        edges: edges.map(|edge| edge * scale),
        material: 0,
        primitive: 0,
    };
    let straight = [DVec3::X * 2.0, DVec3::Y * 4.0, DVec3::Z * 4.0];
    let sheared =
        [DVec3::new(2.5, 0.25, 0.0), DVec3::new(-0.25, 2.0, 0.5), DVec3::new(0.125, 0.5, 2.25)];
    let low = DVec3::new(-2.0, -2.0, -2.0);
    let hole = make(-(sheared[0] + sheared[1] + sheared[2]) / 2.0, sheared);
    let halves = [make(low, straight), make(low + straight[0], straight)];
    let operation = |operation, operands| SolidNode::Operation { operation, operands };
    let mut nodes: Vec<SolidNode> = halves.map(SolidNode::Parallelepiped).to_vec();
    nodes.push(operation(Operation::Union, 2));
    nodes.push(SolidNode::Parallelepiped(hole));
    nodes.push(operation(Operation::Difference, 2));
    let mut edges = Vec::new();
    for cuboid in [hole, halves[0], halves[1]] {
        for k in 0..3 {
            let [e, f, g] = [0, 1, 2].map(|axis| cuboid.edges[(k + axis) % 3]);
            for start in [DVec3::ZERO, f, g, f + g] {
                edges.push([cuboid.corner + start, cuboid.corner + start + e]);
            }
        }
    }
    let mut scene = empty();
    scene.solids.push(Solid { nodes, primitive: 0 });
    Surface { scene, edges, inside: vec![offset, offset + 0.1 * scale], is_thick: true }
}

fn opened(scene: &Scene) -> PreparedScene<PreparedBytes> {
    PreparedScene::open(prepare(scene).expect("a plain scene")).expect("a valid block")
}

/// A corner if asked for one, else a point of an edge.
fn target(surface: &Surface, is_corner: bool, random: &mut Random) -> DVec3 {
    let [a, b] = surface.edges[random.below(surface.edges.len())];
    match random.below(3) {
        _ if is_corner => a,
        0 => (a + b) / 2.0,
        _ => a + (b - a) * random.unit(),
    }
}

/// How many of the rays at edges, or at corners, get out of the surface or cross it an odd number
/// of times.
fn leaks(surface: &Surface, scale: f64, is_corner: bool, count: usize, stream: u64) -> usize {
    let block = opened(&surface.scene);
    let batches = count.div_ceil(10_000) as u64;
    let of_batch = |batch: u64| {
        let mut random = random(stream * 1_000_000 + batch);
        let mut rays = |is_inside: bool| -> Vec<Probe> {
            let ray = |_| {
                let target = target(surface, is_corner, &mut random);
                let inside = surface.inside[random.below(surface.inside.len())];
                let outside = surface.inside[0] + 9.0 * scale * random.direction();
                let origin = if is_inside { inside } else { outside };
                Probe { origin, direction: (target - origin).normalize(), leaving: None }
            };
            (0..count / batches as usize / 2).map(ray).collect()
        };
        let (from_inside, from_outside) = (rays(true), rays(false));
        let mut leaks = 0;
        for isa in Isa::ALL.into_iter().filter(|isa| isa.is_supported()) {
            leaks += block.probe(&from_inside, isa).iter().filter(|hit| hit.is_none()).count();
        }
        let odd = u32::from(surface.is_thick);
        leaks += block.count_crossings(&from_inside).iter().filter(|&n| n % 2 == odd).count();
        leaks + block.count_crossings(&from_outside).iter().filter(|&n| n % 2 == 1).count()
    };
    (0..batches).into_par_iter().map(of_batch).sum()
}

type Make = fn((f64, f64)) -> Surface;

/// At edges or at corners of every kind of surface in every place.
fn check_no_leaks(case: HardCase, what: &str, is_corner: bool, kinds: &[(&str, Make)]) {
    let runs = kinds.len() * PLACES.len();
    let each = rays(500_000) / runs;
    let mut stream = u64::from(case.row()) * 100;
    for (kind, make) in kinds {
        for place in PLACES {
            stream += 1;
            let leaks = leaks(&make(place), place.1, is_corner, each, stream);
            assert_eq!(leaks, 0, "{kind}, moved by {}, scaled by {}", place.0, place.1);
        }
    }
    case.tell(what, format!("0 leaks of {} rays", each * runs));
}

const KINDS: [(&str, Make); 4] = [
    ("triangles", |place| ring(Patches::Triangles, 40, 20, place)),
    ("quadrangles", |place| ring(Patches::Quadrangles, 40, 20, place)),
    ("mixed", |place| ring(Patches::Mixed, 40, 20, place)),
    ("a solid", shell),
];

#[test]
fn closed_surfaces_have_no_leaks_at_their_edges() {
    check_no_leaks(
        HardCase::SharedEdge,
        "no ray gets through at an edge, with every instruction set",
        false,
        &KINDS,
    );
}

#[test]
fn closed_surfaces_have_no_leaks_at_their_corners() {
    check_no_leaks(
        HardCase::SharedVertex,
        "no ray gets through at a corner, with every instruction set",
        true,
        &KINDS,
    );
}

#[test]
fn halves_of_a_solid_keep_their_walls_for_rays_along_the_plane_that_they_share() {
    for (stream, place) in (0..).zip(PLACES) {
        let surface = shell(place);
        let block = opened(&surface.scene);
        let mut random = random(120 + stream);
        let probes: Vec<Probe> = (0..rays(5_000))
            .map(|_| {
                let along = random.direction() * DVec3::new(0.0, 1.0, 1.0);
                let off = random.sign() * random.log_uniform(1e-12, 1e-3);
                let direction = (along.normalize() + off * DVec3::X).normalize();
                Probe { origin: surface.inside[0], direction, leaving: None }
            })
            .collect();
        let crossings = block.count_crossings(&probes);
        for (probe, count) in probes.iter().zip(crossings) {
            assert_eq!(count, 2, "moved by {}, scaled by {}: {probe:?}", place.0, place.1);
        }
    }
}

#[test]
fn surfaces_of_triangles_and_quadrangles_have_no_leaks_where_they_join() {
    let what = "no ray gets through where quadrangles and triangles join";
    check_no_leaks(HardCase::MixedSharedEdge, what, false, &KINDS[1..3]);
}

#[test]
fn closed_surfaces_are_crossed_as_often_as_the_oracle_counts() {
    let (mut same, mut close) = (0, 0);
    for (run, patches) in
        [Patches::Triangles, Patches::Quadrangles, Patches::Mixed].into_iter().enumerate()
    {
        // Numbers that are round, so that rays meet corners and edges exactly, and others.
        let surface = ring(patches, 8, 6, (0.0, 1.0));
        let (block, oracle) = (opened(&surface.scene), Oracle::new(&surface.scene));
        let mut random = random(300 + run as u64);
        let probes: Vec<Probe> = (0..few_rays(6_000))
            .map(|k| {
                let target = target(&surface, k % 3 == 0, &mut random);
                let origin = if k % 2 == 0 {
                    5.0 * random.direction()
                } else {
                    (random.direction() * 20.0).round() / 4.0
                };
                Probe { origin, direction: (target - origin).normalize(), leaving: None }
            })
            .collect();
        let counts = block.count_crossings(&probes);
        let results: Vec<bool> = probes
            .par_iter()
            .zip(counts)
            .map(|(probe, count)| {
                let hits = oracle.all_hits(probe.origin, probe.direction, None);
                assert_eq!((count % 2, hits.len() % 2), (0, 0), "{patches:?}: {probe:?}");
                let is_same = count as usize == hits.len();
                let margin = || oracle.miss_margin(probe.origin, probe.direction, None);
                assert!(is_same || margin() < 1e-9, "{patches:?}: {probe:?}: {count}");
                is_same
            })
            .collect();
        same += results.iter().filter(|&&is_same| is_same).count();
        close += results.iter().filter(|&&is_same| !is_same).count();
    }
    HardCase::CountedTwice.tell(
        "closed surfaces are crossed an even number of times, as often as the oracle counts",
        format!("{same} rays; {close} more graze an edge within rounding"),
    );
}

#[test]
fn rounded_products_suffice_but_for_rays_at_edges() {
    let share = |make: Make, aim: Option<bool>| {
        let surface = make((0.0, 1.0));
        let mut random = random(400);
        let probes: Vec<Probe> = (0..few_rays(20_000))
            .map(|_| {
                let target = match aim {
                    Some(is_corner) => target(&surface, is_corner, &mut random),
                    None => surface.inside[0] + random.direction(),
                };
                let origin = surface.inside[0] + 9.0 * random.direction();
                Probe { origin, direction: (target - origin).normalize(), leaving: None }
            })
            .collect();
        let tests = opened(&surface.scene).count_face_tests(&probes);
        assert!(tests.all >= probes.len() as u64 / 2, "{tests:?}");
        tests.in_doubt as f64 / tests.all as f64
    };
    for (kind, make) in &KINDS[..3] {
        let [random, edges, corners] = [None, Some(false), Some(true)].map(|aim| share(*make, aim));
        eprintln!(
            "{kind}: tests in doubt: {random:.1e} of all, {edges:.1e} at edges, {corners:.1e} at corners"
        );
        assert!(random < 1e-2 && corners > 0.0, "{kind}: {random} {corners}");
    }
}
