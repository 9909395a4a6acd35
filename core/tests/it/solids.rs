//! Solids, ray by ray: the algebra of sets, closed forms, and places where faces meet.
//!
//! `RTFARM_RAYS=100` takes a hundred times as many rays.

use std::{f64::consts::PI, thread};

use glam::{DMat3, DVec3};
use rayon::prelude::*;
use rtfarm_core::{
    isa::Isa,
    language::read_scene,
    prepare::prepare,
    prepared::{PreparedBytes, PreparedScene},
    scene::{Scene, SolidNode},
    testing::{Probe, ProbeHit, Probing},
};
use rtfarm_oracle::{
    Oracle,
    hard_case::{HardCase, few_rays, random, rays},
    random::Random,
    random_scene::{Recipe, Style, random_scene},
};

use crate::support::{
    judge::check_against_oracle,
    parts::{join, parallelepiped, sphere, upright},
};

/// Rays in a batch.
const BATCH: usize = 10_000;

/// A scene of this geometry alone.
fn read(geometry: &str) -> Scene {
    let text = format!(
        "viewport origin 0 0 5 topleft -1 1 0 bottomleft -1 -1 0 topright 1 1 0 endviewport
        materials entry name m endentry entry name other endentry endmaterials
        geometry {geometry} endgeometry"
    );
    let nothing = |_: &str| Err(std::io::ErrorKind::NotFound.into());
    let reading = read_scene(text.as_bytes(), &nothing);
    assert!(reading.diagnostics.is_empty(), "{:?}", reading.diagnostics);
    reading.scene.unwrap()
}

type Prepared = PreparedScene<PreparedBytes>;

fn opened(geometry: &str) -> Prepared {
    PreparedScene::open(prepare(&read(geometry)).unwrap()).unwrap()
}

/// Everything that each probe crosses, found by going on from every hit.
fn crossings(scene: &Prepared, probes: &[Probe]) -> Vec<Vec<ProbeHit>> {
    let mut found = vec![Vec::new(); probes.len()];
    let mut going: Vec<(usize, f64, Probe)> =
        probes.iter().enumerate().map(|(k, probe)| (k, 0.0, *probe)).collect();
    while !going.is_empty() {
        let batch: Vec<Probe> = going.iter().map(|&(_, _, probe)| probe).collect();
        let hits = scene.probe(&batch, Isa::fastest());
        let next = going.iter().zip(hits).filter_map(|(&(k, start, probe), hit)| {
            let hit = hit?;
            let t = start + hit.t;
            found[k].push(ProbeHit { t, ..hit });
            assert!(found[k].len() < 10_000, "{:?} never ends", probes[k]);
            let origin = probe.origin + hit.t * probe.direction;
            let leaving = Some((hit.primitive, hit.face));
            Some((k, t, Probe { origin, leaving, ..probe }))
        });
        going = next.collect();
    }
    found
}

fn times(crossings: &[ProbeHit]) -> Vec<f64> {
    crossings.iter().map(|hit| hit.t).collect()
}

/// The stretches of a ray that are inside, but for those too short to tell.
fn stretches(crossings: &[ProbeHit]) -> Vec<f64> {
    let mut times = times(crossings);
    let mut k = 0;
    while k + 1 < times.len() {
        if times[k + 1] - times[k] < SHORT {
            times.drain(k..=k + 1);
            k = k.saturating_sub(1);
        } else {
            k += 1;
        }
    }
    times
}

const SHORT: f64 = 1e-7;

fn probe(origin: DVec3, target: DVec3) -> Probe {
    Probe { origin, direction: (target - origin).normalize(), leaving: None }
}

/// Rays through the middle of things; every fourth runs along an axis in the planes and edges of
/// what is drawn in quarters.
fn random_rays(random: &mut Random, count: usize) -> Vec<Probe> {
    let ray = |k| {
        if k % 4 > 0 {
            return probe(random.direction() * 5.0, random.in_cube());
        }
        let axis = random.below(3);
        let mut origin = (random.in_cube() * 4.0).round() / 4.0;
        let ahead = random.sign();
        origin[axis] = -5.0 * ahead;
        Probe { origin, direction: DVec3::AXES[axis] * ahead, leaving: None }
    };
    (0..count).map(ray).collect()
}

fn snapped(random: &mut Random, is_snapped: bool) -> DVec3 {
    let point = random.in_cube();
    if is_snapped { (point * 4.0).round() / 4.0 } else { point }
}

fn random_leaf(random: &mut Random, is_snapped: bool) -> String {
    if random.chance(0.5) {
        let radius = random.between(0.3, 1.0);
        let radius = if is_snapped { (radius * 4.0).round() / 4.0 } else { radius };
        return sphere(snapped(random, is_snapped) / 2.0, radius.max(0.25), "m");
    }
    if is_snapped {
        let low = snapped(random, true);
        let size = ((random.in_cube() + 1.0) * 4.0).round() / 4.0;
        return upright(low, low + size.max(DVec3::splat(0.25)), "m");
    }
    loop {
        let edges = [random.in_cube(), random.in_cube(), random.in_cube()].map(|edge| edge * 1.5);
        if edges[0].dot(edges[1].cross(edges[2])).abs() > 0.1 {
            let corner = random.in_cube() * 0.3 - (edges[0] + edges[1] + edges[2]) / 2.0;
            return parallelepiped(corner, edges, "m");
        }
    }
}

fn random_tree(random: &mut Random, is_snapped: bool, depth: u32) -> String {
    if depth == 0 || random.chance(0.3) {
        return random_leaf(random, is_snapped);
    }
    let operation = ["union", "intersection", "difference"][random.below(3)];
    let operands: Vec<String> =
        (0..2 + random.below(2)).map(|_| random_tree(random, is_snapped, depth - 1)).collect();
    join(operation, &operands.iter().map(String::as_str).collect::<Vec<_>>())
}

/// Two ways to write one set are crossed alike by random rays.
fn check_equal_sets(what: &str, write: impl Fn([&str; 3]) -> [String; 2]) {
    let trees = 50;
    let each = few_rays(100_000) / trees;
    let mut crossed = 0;
    for seed in 0..trees as u64 {
        let mut random = random(seed);
        let is_snapped = seed % 2 == 1;
        let [a, b, c] = [0, 1, 2].map(|_| random_tree(&mut random, is_snapped, 2));
        let [left, right] = write([&a, &b, &c]);
        let [left, right] = [opened(&left), opened(&right)];
        let mut rest = each;
        while rest > 0 {
            let probes = random_rays(&mut random, rest.min(BATCH));
            rest -= probes.len();
            let found = crossings(&left, &probes).into_iter().zip(crossings(&right, &probes));
            for (probe, (left, right)) in probes.iter().zip(found) {
                let (left, right) = (stretches(&left), stretches(&right));
                let is_same = left.len() == right.len()
                    && left.iter().zip(&right).all(|(l, r)| (l - r).abs() < SHORT);
                assert!(is_same, "{what}, {seed}: {probe:?}: {left:?} but {right:?}");
                crossed += left.len();
            }
        }
    }
    assert!(crossed > few_rays(4_000), "{what}: {crossed} crossings in all");
}

/// A box around everything: what is not in a set is in this less the set.
fn all() -> String {
    upright(DVec3::splat(-4.0), DVec3::splat(4.0), "m")
}

fn without(set: &str) -> String {
    join("difference", &[&all(), set])
}

#[test]
fn a_difference_is_the_intersection_with_the_complement() {
    check_equal_sets("A less B", |[a, b, _]| {
        [join("difference", &[a, b]), join("intersection", &[a, &without(b)])]
    });
    check_equal_sets("A less B and C", |[a, b, c]| {
        [join("difference", &[a, b, c]), join("intersection", &[a, &without(b), &without(c)])]
    });
}

#[test]
fn the_complement_of_a_union_is_the_intersection_of_complements() {
    check_equal_sets("not (A or B)", |[a, b, _]| {
        [without(&join("union", &[a, b])), join("intersection", &[&without(a), &without(b)])]
    });
    check_equal_sets("not (A and B)", |[a, b, _]| {
        [without(&join("intersection", &[a, b])), join("union", &[&without(a), &without(b)])]
    });
}

/// A leaf alone is no solid; cut by a box around it, it is.
fn alone(set: &str) -> String {
    join("intersection", &[set, &all()])
}

#[test]
fn a_set_absorbs_its_parts() {
    check_equal_sets("A or (A and B)", |[a, b, _]| {
        [join("union", &[a, &join("intersection", &[a, b])]), alone(a)]
    });
    check_equal_sets("A and (A or B)", |[a, b, _]| {
        [join("intersection", &[a, &join("union", &[a, b])]), alone(a)]
    });
}

#[test]
fn unions_and_intersections_do_not_depend_on_brackets_or_order() {
    for operation in ["union", "intersection"] {
        check_equal_sets(operation, |[a, b, c]| {
            [
                join(operation, &[&join(operation, &[a, b]), c]),
                join(operation, &[a, &join(operation, &[b, c])]),
            ]
        });
        check_equal_sets(operation, |[a, b, c]| {
            [join(operation, &[a, b, c]), join(operation, &[c, a, b])]
        });
    }
    check_equal_sets("distributed", |[a, b, c]| {
        [
            join("intersection", &[a, &join("union", &[b, c])]),
            join("union", &[&join("intersection", &[a, b]), &join("intersection", &[a, c])]),
        ]
    });
}

/// Both are crossed at the same distances to the bit.
fn check_same_bits(what: &str, left: &str, right: &str, random: &mut Random, count: usize) {
    let [left, right] = [opened(left), opened(right)];
    let mut rest = count;
    while rest > 0 {
        let probes = random_rays(random, rest.min(BATCH));
        rest -= probes.len();
        let found = crossings(&left, &probes).into_iter().zip(crossings(&right, &probes));
        for (probe, (left, right)) in probes.iter().zip(found) {
            assert_eq!(times(&left), times(&right), "{what}: {probe:?}");
        }
    }
}

#[test]
fn a_set_with_itself_is_itself_exactly_and_less_itself_nothing() {
    for seed in 0..20 {
        let mut random = random(seed);
        let a = random_leaf(&mut random, seed % 2 == 1);
        let count = rays(100_000) / 20;
        let alone = alone(&a);
        for operation in ["union", "intersection"] {
            let with_itself = join(operation, &[&a, &a]);
            check_same_bits(operation, &with_itself, &alone, &mut random, count);
        }
        let nothing = opened(&join("difference", &[&a, &a]));
        for probes in random_rays(&mut random, count).chunks(BATCH) {
            let hits = nothing.probe(probes, Isa::fastest());
            assert!(hits.iter().all(Option::is_none), "{seed}: a skin is left");
        }
    }
    HardCase::SolidWithItself
        .tell("A with A is A to the bit, A less A nothing", format!("{} rays", 3 * rays(100_000)));
}

#[test]
fn a_box_cut_with_a_box_is_a_box() {
    let mut random = random(2);
    for _ in 0..20 {
        let [a, b] = [random.in_cube() * 0.3, random.in_cube() * 0.3];
        let (low, high) = (a - 1.0, b + 1.0);
        let cut = join(
            "intersection",
            &[&upright(low, DVec3::splat(2.0), "m"), &upright(DVec3::splat(-2.0), high, "m")],
        );
        // The same planes: not `low + (high - low)`, which rounds.
        let single = [opened(&cut), opened(&upright(low, high, "m"))];
        for probes in random_rays(&mut random, rays(100_000) / 20).chunks(BATCH) {
            let found = single.each_ref().map(|scene| crossings(scene, probes));
            for (k, probe) in probes.iter().enumerate() {
                let [cut, single] = [stretches(&found[0][k]), stretches(&found[1][k])];
                // A ray in the plane of a face may count as inside or not, but in one way.
                assert!(cut.len() % 2 == 0 && single.len() % 2 == 0, "{probe:?}");
                let is_same = cut.len() == single.len()
                    && cut.iter().zip(&single).all(|(c, s)| (c - s).abs() < 1e-9);
                assert!(is_same, "{probe:?}: {cut:?} but {single:?}");
            }
        }
    }
}

/// Turns that are no quarter turns.
fn turn(random: &mut Random) -> DMat3 {
    let z = random.direction();
    let x = z.any_orthonormal_vector();
    DMat3::from_cols(x, z.cross(x), z)
}

/// A box in a turned frame.
fn turned(turn: &DMat3, low: DVec3, high: DVec3) -> String {
    let [x, y, z] = (high - low).to_array();
    let edges = [turn.x_axis * x, turn.y_axis * y, turn.z_axis * z];
    parallelepiped(*turn * low, edges, "m")
}

#[test]
fn solids_that_touch_have_no_face_between_them() {
    for seed in 0..20 {
        let mut random = random(seed);
        let turn = if seed == 0 { DMat3::IDENTITY } else { turn(&mut random) };
        let (low, high) = (DVec3::splat(-1.0), DVec3::new(0.9, 1.1, 0.7));
        let seams = [random.between(-0.8, 0.0), random.between(0.1, 0.6)];
        let piece = |from: f64, to: f64| {
            turned(&turn, DVec3::new(from, low.y, low.z), DVec3::new(to, high.y, high.z))
        };
        let pieces = join(
            "union",
            &[&piece(low.x, seams[0]), &piece(seams[0], seams[1]), &piece(seams[1], high.x)],
        );
        let whole = join("intersection", &[&turned(&turn, low, high), &all()]);
        let [pieces, whole] = [opened(&pieces), opened(&whole)];
        let mut probes = random_rays(&mut random, rays(100_000) / 20);
        for (k, probe) in probes.iter_mut().enumerate() {
            if k % 2 == 0 {
                // Through a seam, at any angle.
                let [_, y, z] = (random.in_cube() * 0.6).to_array();
                let target = turn * DVec3::new(seams[k / 2 % 2], y, z);
                *probe = self::probe(probe.origin, target);
            }
        }
        for probes in probes.chunks(BATCH) {
            let found = crossings(&pieces, probes).into_iter().zip(crossings(&whole, probes));
            for (probe, (pieces, whole)) in probes.iter().zip(found) {
                let [pieces, whole] = [times(&pieces), times(&whole)];
                let is_same = pieces.len() == whole.len()
                    && pieces.iter().zip(&whole).all(|(p, w)| (p - w).abs() < 1e-9);
                assert!(is_same, "{seed}: {probe:?}: {pieces:?} but {whole:?}");
            }
        }
    }
    HardCase::TouchingSolids.tell(
        "solids that touch have no face between them",
        format!("0 inner hits of {} rays", rays(100_000)),
    );
}

#[test]
fn a_hole_whose_ends_are_flush_has_no_skin() {
    for seed in 0..20 {
        let mut random = random(seed);
        let turn = if seed == 0 { DMat3::IDENTITY } else { turn(&mut random) };
        let plate = turned(&turn, DVec3::new(-1.0, -1.0, -0.3), DVec3::new(1.0, 1.0, 0.4));
        let plug = turned(&turn, DVec3::new(-0.5, -0.5, -0.3), DVec3::new(0.5, 0.5, 0.4));
        let pocket = turned(&turn, DVec3::new(-0.5, -0.5, 0.1), DVec3::new(0.5, 0.5, 0.4));
        let holed = opened(&join("difference", &[&plate, &plug]));
        let dented = opened(&join("difference", &[&plate, &pocket]));
        let probes: Vec<Probe> = (0..rays(100_000) / 20)
            .map(|_| {
                let [x, y, _] = (random.in_cube() * 0.49).to_array();
                let [u, v, _] = (random.in_cube() * 0.49).to_array();
                probe(turn * DVec3::new(x, y, 0.4), turn * DVec3::new(u, v, -0.3))
            })
            .map(|probe| Probe { origin: probe.origin - 2.0 * probe.direction, ..probe })
            .collect();
        for probes in probes.chunks(BATCH) {
            assert!(holed.probe(probes, Isa::fastest()).iter().all(Option::is_none), "{seed}");
            for (probe, hit) in probes.iter().zip(dented.probe(probes, Isa::fastest())) {
                let point = turn.transpose() * (probe.origin + hit.unwrap().t * probe.direction);
                assert!((point.z - 0.1).abs() < 1e-14, "{seed}: {probe:?} at {point}");
            }
        }
    }
    HardCase::FlushFaces.tell(
        "a hole whose ends are flush has no skin",
        format!("0 speckles of {} rays", 2 * rays(100_000)),
    );
}

#[test]
fn both_walls_of_a_shell_one_billionth_thick_are_met() {
    let thickness = 1e-9;
    let center = DVec3::new(0.1, 0.2, 0.3);
    let round =
        join("difference", &[&sphere(center, 1.0, "m"), &sphere(center, 1.0 - thickness, "m")]);
    let square = join(
        "difference",
        &[
            &upright(center - 1.0, center + 1.0, "m"),
            &upright(center - (1.0 - thickness), center + (1.0 - thickness), "m"),
        ],
    );
    let [round, square] = [opened(&round), opened(&square)];
    let mut random = random(6);
    let mut worst = 0.0_f64;
    for _ in 0..rays(100_000) / BATCH {
        let probes: Vec<Probe> = (0..BATCH)
            .map(|_| {
                probe(center + 5.0 * random.direction(), center + 0.99 * random.in_cube() * 0.57)
            })
            .collect();
        let found = crossings(&round, &probes).into_iter().zip(crossings(&square, &probes));
        for (probe, (round, square)) in probes.iter().zip(found) {
            let [round, square] = [times(&round), times(&square)];
            assert_eq!([round.len(), square.len()], [4, 4], "{probe:?}");
            let from = probe.origin - center;
            let aside = (from - from.dot(probe.direction) * probe.direction).length_squared();
            let cosine = (1.0 - aside).sqrt();
            for wall in round.chunks(2) {
                worst = worst.max(((wall[1] - wall[0]) * cosine - thickness).abs());
            }
        }
    }
    HardCase::ThinShell.tell(
        "both walls of a shell of 1e-9 are met",
        format!("its thickness is right within {worst:.1e}"),
    );
    assert!(worst < 1e-14);
}

#[test]
fn a_solid_nested_a_thousand_deep_is_crossed_at_each_level_on_a_small_stack() {
    // S1 less (S2 less (S3 ...)): every other shell.
    let depth = 1000;
    let radius = |k: usize| 1.0 - k as f64 / 1024.0;
    let center = DVec3::new(0.125, -0.25, 0.5);
    let mut right = sphere(center, radius(depth), "m");
    for k in (0..depth).rev() {
        right = join("difference", &[&sphere(center, radius(k), "m"), &right]);
    }
    // The same set, nested on the left, from outside in: put in, taken away, put in.
    let mut left = sphere(center, radius(0), "m");
    for k in 1..=depth {
        let operation = if k % 2 == 1 { "difference" } else { "union" };
        left = join(operation, &[&left, &sphere(center, radius(k), "m")]);
    }
    let scenes = [opened(&right), opened(&left)];
    let trace = move || {
        let mut random = random(1);
        for scene in scenes {
            for _ in 0..5 {
                let direction = random.direction();
                let probe = Probe { origin: center - 3.0 * direction, direction, leaving: None };
                assert_eq!(scene.count_crossings(&[probe])[0] as usize, 2 * (depth + 1));
                // Between two spheres, inwards to the one, outwards to the other.
                let (k, between) = (random.below(depth), random.between(0.1, 0.9));
                let gap = radius(k) - radius(k + 1);
                let origin = center - (radius(k) - between * gap) * direction;
                for (direction, truth) in [(direction, 1.0 - between), (-direction, between)] {
                    let probe = Probe { origin, direction, leaving: None };
                    let hit = scene.probe(&[probe], Isa::fastest())[0].unwrap();
                    assert!((hit.t - truth * gap).abs() < 1e-14, "{k}: {hit:?}");
                }
            }
        }
    };
    thread::Builder::new().stack_size(128 << 10).spawn(trace).unwrap().join().unwrap();
    HardCase::DeepNesting
        .tell("a solid nested 1000 deep is crossed at each level", "on a small stack");
}

/// The volume by the lengths of parallel rays inside it.
fn measured_volume(solid: &str, along: DVec3, count: usize) -> f64 {
    let scene = opened(solid);
    let (x, y) = along.any_orthonormal_pair();
    // A multiple of 4, so that no row lies half in the cube.
    let side = ((count as f64).sqrt() as usize).next_multiple_of(4);
    let step = 4.0 / side as f64;
    let mut sum = 0.0;
    for row in 0..side {
        let probes: Vec<Probe> = (0..side)
            .map(|column| {
                let [u, v] = [column, row].map(|k| (k as f64 + 0.5) * step - 2.0);
                Probe { origin: u * x + v * y - 4.0 * along, direction: along, leaving: None }
            })
            .collect();
        for crossings in crossings(&scene, &probes) {
            assert!(crossings.len() % 2 == 0);
            sum += crossings.chunks(2).map(|pair| pair[1].t - pair[0].t).sum::<f64>();
        }
    }
    sum * step * step
}

#[test]
fn caps_lenses_and_bored_boxes_have_the_volumes_of_the_formulas() {
    let ball = sphere(DVec3::ZERO, 1.0, "m");
    let height = 0.4;
    let half_space = upright(DVec3::new(-2.0, -2.0, 1.0 - height), DVec3::splat(2.0), "m");
    let cap = PI * height * height * (3.0 - height) / 3.0;
    let (apart, small): (f64, f64) = (1.1, 0.7);
    let other = sphere(DVec3::X * apart, small, "m");
    let lens = PI
        * (1.0 + small - apart).powi(2)
        * (apart * apart + 2.0 * apart * (1.0 + small) - 3.0 * (1.0 - small).powi(2))
        / (12.0 * apart);
    let balls = 4.0 / 3.0 * PI * (1.0 + small.powi(3));
    let cube = upright(DVec3::splat(-1.0), DVec3::splat(1.0), "m");
    let corner = sphere(DVec3::splat(1.0), 0.5, "m");
    for (what, solid, truth) in [
        ("cap", join("intersection", &[&ball, &half_space]), cap),
        ("ball less cap", join("difference", &[&ball, &half_space]), 4.0 / 3.0 * PI - cap),
        ("lens", join("intersection", &[&ball, &other]), lens),
        ("two balls", join("union", &[&ball, &other]), balls - lens),
        ("cube less an eighth", join("difference", &[&cube, &corner]), 8.0 - PI / 48.0),
    ] {
        for along in [DVec3::Z, DVec3::new(0.36, 0.48, 0.8)] {
            let count = few_rays(100_000);
            let error = (measured_volume(&solid, along, count) / truth - 1.0).abs();
            eprintln!("{what}: {error:.1e} off with {count} rays");
            assert!(error < 100.0 / count as f64, "{what} along {along}: {error:e}");
        }
    }
}

#[test]
fn a_parallelepiped_has_no_cracks_at_its_edges_and_corners() {
    for seed in 0..50 {
        let mut random = random(seed);
        let edges = match seed % 3 {
            // Sheared until its edges are as good as one: a condition of 1e8.
            0 => [DVec3::X, DVec3::new(1.0, 1e-8, 0.0), DVec3::new(0.3, 0.2, 1.0)],
            _ => [random.in_cube(), random.in_cube(), random.in_cube()],
        };
        let corner = random.in_cube();
        let scene = opened(&parallelepiped(corner, edges, "m"));
        let probes: Vec<Probe> = (0..rays(100_000) / 50)
            .map(|k| {
                let mut target = corner;
                for (axis, edge) in edges.into_iter().enumerate() {
                    // To a corner, or along one edge from it.
                    let share = f64::from(random.chance(0.5));
                    target += edge * if k % 4 == axis { random.unit() } else { share };
                }
                probe(random.direction() * 5.0, target)
            })
            .collect();
        let leaks = scene.count_crossings(&probes).into_iter().filter(|n| n % 2 == 1).count();
        assert_eq!(leaks, 0, "{seed}");
    }
}

#[test]
fn a_sheared_box_is_met_where_the_oracle_meets_it_within_its_condition() {
    let runs = 100;
    let worst_of_run = |run: usize| {
        let mut random = random(run as u64);
        let condition = [1.0, 1e2, 1e4, 1e6, 1e8][run % 5];
        let [outer, inner] = [turn(&mut random), turn(&mut random)];
        let sizes =
            DVec3::new(1.0, random.log_uniform(1.0 / condition / 2.0, 1.0), 1.0 / condition);
        let edges = outer * DMat3::from_diagonal(sizes) * inner;
        let edges = [edges.x_axis, edges.y_axis, edges.z_axis];
        let corner = random.in_cube();
        let box_text = parallelepiped(corner, edges, "m");
        let text = if run.is_multiple_of(2) { box_text } else { alone(&box_text) };
        let scene = read(&text);
        let (block, oracle) = (opened(&text), Oracle::new(&scene));
        let probes: Vec<Probe> = (0..few_rays(100_000) / runs)
            .map(|_| {
                let inside: DVec3 = edges.into_iter().map(|edge| edge * random.unit()).sum();
                probe(random.direction() * 5.0, corner + inside)
            })
            .collect();
        let (mut worst, mut across) = (0.0_f64, 0.0_f64);
        for (probe, found) in probes.iter().zip(block.probe(&probes, Isa::fastest())) {
            let what = format!("a condition of {condition:e}");
            if !check_against_oracle((&scene, &oracle), probe, found, &what) {
                continue;
            }
            let (Some(found), Some(truth)) =
                (found, oracle.first_hit(probe.origin, probe.direction, None))
            else {
                continue;
            };
            let ulp = f64::EPSILON * truth.t.max(probe.origin.abs().max_element());
            let (error, cosine) =
                ((found.t - truth.t).abs() / ulp, truth.normal.dot(probe.direction).abs());
            // Along a face that is grazed the least rounding reaches far, whatever the box.
            if cosine > 0.5 {
                worst = worst.max(error / condition);
            }
            across = across.max(error * cosine);
        }
        (worst, across)
    };
    let worst = (0..runs).into_par_iter().map(worst_of_run);
    let (worst, across) = worst.reduce(|| (0.0, 0.0), |a, b| (a.0.max(b.0), a.1.max(b.1)));
    HardCase::ShearedBox.tell(
        "sheared boxes of a condition up to 1e8 are met at the oracle's t",
        format!(
            "{} rays, within {worst:.2} ulp a condition, {across:.1} ulp across the face",
            few_rays(100_000)
        ),
    );
    assert!(worst < 8.0 && across < 8.0);
}

/// The ends of what is left of one stretch of a ray where another is taken from it; a stretch that
/// ends before it begins is empty.
fn less(stretch: [f64; 2], taken: [f64; 2]) -> Vec<f64> {
    let [low, high] = stretch;
    let pieces = if taken[0] < taken[1] {
        vec![[low, high.min(taken[0])], [low.max(taken[1]), high]]
    } else {
        vec![stretch]
    };
    pieces.into_iter().filter(|[low, high]| high - low > SHORT).flatten().collect()
}

/// Where a ray that runs in the plane across `axis` is in the rectangle of an upright box.
fn chord(probe: &Probe, axis: usize, low: DVec3, high: DVec3) -> [f64; 2] {
    let mut ends = [f64::NEG_INFINITY, f64::INFINITY];
    for other in (0..3).filter(|&other| other != axis) {
        let [a, b] = [low, high].map(|end| (end - probe.origin)[other] / probe.direction[other]);
        ends = [ends[0].max(a.min(b)), ends[1].min(a.max(b))];
    }
    ends
}

#[test]
fn a_ray_in_the_plane_of_a_face_goes_in_and_out_or_neither() {
    let runs = 40;
    let [mut count, mut inside] = [0; 2];
    for seed in 0..runs as u64 {
        let mut random = random(seed);
        let mut cuboid = || {
            let low = snapped(&mut random, true);
            (low, low + ((random.in_cube() + 1.25) * 4.0).ceil() / 4.0)
        };
        let ((low, high), (mut low_taken, mut high_taken)) = (cuboid(), cuboid());
        let axis = seed as usize % 3;
        let is_high = random.chance(0.5);
        // What is taken away is flush with the plane, on either side of it.
        let plane = if is_high { high[axis] } else { low[axis] };
        let side = random.sign() / 2.0;
        low_taken[axis] = plane.min(plane + side);
        high_taken[axis] = plane.max(plane + side);
        let (a, b) = (upright(low, high, "m"), upright(low_taken, high_taken, "other"));
        let far = sphere(DVec3::splat(50.0), 1.0, "m");
        let alone = opened(&a);
        let closed = [
            join("intersection", &[&a, &all()]),
            join("union", &[&a, &far]),
            join("difference", &[&a, &far]),
            join("union", &[&a, &a]),
        ]
        .map(|text| opened(&text));
        let flush = opened(&join("difference", &[&a, &b]));
        let probes: Vec<Probe> = (0..rays(100_000) / runs)
            .map(|_| {
                let [mut origin, mut target] = [random.direction(), random.in_cube() * 1.5];
                origin[axis] = 0.0;
                origin *= 6.0 / origin.length();
                (origin[axis], target[axis]) = (plane, plane);
                probe(origin, target)
            })
            .collect();
        for (probe, found) in probes.iter().zip(crossings(&alone, &probes)) {
            let truth = less(chord(probe, axis, low, high), [0.0, 0.0]);
            let found = stretches(&found);
            assert!(found.is_empty() || is_close(&found, &truth), "{probe:?}: {found:?}");
        }
        for scene in &closed {
            for (probe, found) in probes.iter().zip(crossings(scene, &probes)) {
                let truth = less(chord(probe, axis, low, high), [0.0, 0.0]);
                let found = stretches(&found);
                assert!(is_close(&found, &truth), "{probe:?}: {found:?}, truly {truth:?}");
                (count, inside) = (count + 1, inside + found.len() / 2);
            }
        }
        for (probe, found) in probes.iter().zip(crossings(&flush, &probes)) {
            let taken = chord(probe, axis, low_taken, high_taken);
            let truth = less(chord(probe, axis, low, high), taken);
            let found = stretches(&found);
            assert!(is_close(&found, &truth), "{probe:?}: {found:?}, truly {truth:?}");
        }
    }
    HardCase::RayInFacePlane.tell(
        "a ray in the plane of a face goes in and out or neither",
        format!("{count} rays, {inside} stretches inside"),
    );
    assert!(inside > count / 10);
}

fn is_close(found: &[f64], truth: &[f64]) -> bool {
    found.len() == truth.len() && found.iter().zip(truth).all(|(f, t)| (f - t).abs() < 1e-12)
}

/// A die: a box in a ball, less a pip for each eye.
fn die(place: DVec3, turn: &DMat3, corner: f64, pip: f64) -> String {
    let mut parts = vec![join(
        "intersection",
        &[&parallelepiped_around(place, turn), &sphere(place, corner, "m")],
    )];
    for (axis, eyes) in [[1, 6], [2, 5], [3, 4]].into_iter().enumerate() {
        for (eyes, side) in eyes.into_iter().zip([1.0, -1.0]) {
            for &(u, v) in EYES[eyes - 1] {
                let mut at = DVec3::ZERO;
                (at[axis], at[(axis + 1) % 3], at[(axis + 2) % 3]) = (side, u * 0.5, v * 0.5);
                parts.push(sphere(place + *turn * at, pip, "other"));
            }
        }
    }
    join("difference", &parts.iter().map(String::as_str).collect::<Vec<_>>())
}

fn parallelepiped_around(place: DVec3, turn: &DMat3) -> String {
    let edges = [turn.x_axis, turn.y_axis, turn.z_axis].map(|axis| axis * 2.0);
    parallelepiped(place - (edges[0] + edges[1] + edges[2]) / 2.0, edges, "m")
}

/// Where a die's eyes are.
const EYES: [&[(f64, f64)]; 6] = [
    &[(0., 0.)],
    &[(-1., -1.), (1., 1.)],
    &[(-1., -1.), (0., 0.), (1., 1.)],
    &[(-1., -1.), (-1., 1.), (1., -1.), (1., 1.)],
    &[(-1., -1.), (-1., 1.), (0., 0.), (1., -1.), (1., 1.)],
    &[(-1., -1.), (-1., 0.), (-1., 1.), (1., -1.), (1., 0.), (1., 1.)],
];

/// Asks the tracer and the oracle about rays, and tells how many answers are the same and how many
/// too close to call.
fn compare_with_oracle(scene: &Scene, probes: &[Probe], what: &str) -> [usize; 2] {
    let block = PreparedScene::open(prepare(scene).unwrap()).unwrap();
    let oracle = Oracle::new(scene);
    let found = block.probe(probes, Isa::fastest());
    let same = probes
        .par_iter()
        .zip(found)
        .filter(|(probe, found)| check_against_oracle((scene, &oracle), probe, *found, what))
        .count();
    [same, probes.len() - same]
}

/// The same for rays that go on from where those hit, anywhere.
fn compare_leaving(scene: &Scene, probes: &[Probe], random: &mut Random, what: &str) -> [usize; 2] {
    let block = PreparedScene::open(prepare(scene).unwrap()).unwrap();
    let hits = block.probe(probes, Isa::fastest());
    let leaving = probes.iter().zip(hits).filter_map(|(probe, hit)| {
        let hit = hit?;
        let origin = probe.origin + hit.t * probe.direction;
        let leaving = Some((hit.primitive, hit.face));
        Some(Probe { origin, direction: random.direction(), leaving })
    });
    let leaving: Vec<Probe> = leaving.collect();
    compare_with_oracle(scene, &leaving, what)
}

fn add(sum: &mut [usize; 2], more: [usize; 2]) {
    *sum = [sum[0] + more[0], sum[1] + more[1]];
}

#[test]
fn a_die_with_round_corners_and_pips_is_met_where_the_oracle_meets_it() {
    let mut counts = [0; 2];
    for seed in 0..10 {
        let mut random = random(seed);
        let turn = if seed == 0 { DMat3::IDENTITY } else { turn(&mut random) };
        let place = random.in_cube() * if seed % 2 == 0 { 0.0 } else { 3.0 };
        // Pips that touch nothing, or one another and the corners.
        let (corner, pip) = (random.between(1.35, 1.6), random.between(0.1, 0.3));
        let scene = read(&die(place, &turn, corner, pip));
        let probes: Vec<Probe> = (0..few_rays(100_000) / 20)
            .map(|_| probe(place + random.direction() * 5.0, place + random.in_cube() * 1.1))
            .collect();
        add(&mut counts, compare_with_oracle(&scene, &probes, "a die"));
        add(&mut counts, compare_leaving(&scene, &probes, &mut random, "leaving a die"));
    }
    let [same, close] = counts;
    eprintln!("a die: {same} answers are the oracle's, {close} too close to call");
    assert!(same > few_rays(70_000) && close * 1000 < same);
}

#[test]
fn a_ray_that_starts_inside_solids_meets_what_the_oracle_meets() {
    for style in [Style::Plain, Style::Grid, Style::Far] {
        let mut counts = [0; 2];
        for seed in 0..20 {
            let recipe = Recipe { solids: 3, parallelepipeds: 2, ..Recipe::new(style) };
            let scene = random_scene(seed, &recipe);
            let mut random = random(seed);
            let middle = if style == Style::Far { FAR } else { DVec3::ZERO };
            let probes: Vec<Probe> = (0..few_rays(100_000) / 60)
                .map(|k| {
                    let origin = middle + snapped(&mut random, style == Style::Grid && k % 2 == 0);
                    Probe { origin, direction: random.direction(), leaving: None }
                })
                .collect();
            let what = format!("{style:?} scene {seed}, from inside");
            add(&mut counts, compare_with_oracle(&scene, &probes, &what));
        }
        let [same, close] = counts;
        eprintln!("{style:?}: {same} answers are the oracle's, {close} too close to call");
    }
}

/// Where scenes of the style [`Style::Far`] are.
const FAR: DVec3 = DVec3::new(1e6, -2e6, 3e5);

/// A shell with a die in it, all of it `scale` times its size, and a sphere at 1.
fn tiny_solid(random: &mut Random, scale: f64, thickness: f64) -> Scene {
    let turn = turn(random);
    let place = random.in_cube();
    let shell = join(
        "difference",
        &[&sphere(place, 2.0, "m"), &sphere(place, 2.0 * (1.0 - thickness), "m")],
    );
    let solid = join("union", &[&shell, &die(place, &turn, 1.4, 0.2)]);
    let mut scene = read(&(solid + &sphere(DVec3::ONE, 0.1, "m")));
    for node in &mut scene.solids[0].nodes {
        match node {
            SolidNode::Sphere(sphere) => {
                sphere.center *= scale;
                sphere.radius *= scale;
            }
            SolidNode::Parallelepiped(solid) => {
                solid.corner *= scale;
                solid.edges = solid.edges.map(|edge| edge * scale);
            }
            SolidNode::Operation { .. } => {}
        }
    }
    scene
}

#[test]
fn a_solid_of_a_billionth_of_its_scene_keeps_its_walls() {
    let (scale, thickness) = (1e-9, 1e-6);
    let mut counts = [0; 2];
    for seed in 0..10 {
        let mut random = random(seed);
        let scene = tiny_solid(&mut random, scale, thickness);
        let aim = |random: &mut Random, distance: f64| {
            let target = random.in_cube() * 1.5 * scale;
            probe(target + random.direction() * distance, target)
        };
        let probes: Vec<Probe> = (0..few_rays(100_000) / 50)
            .map(|k| aim(&mut random, if k % 4 == 0 { 1.0 } else { 5.0 * scale }))
            .collect();
        add(&mut counts, compare_with_oracle(&scene, &probes, "a tiny solid"));
        add(&mut counts, compare_leaving(&scene, &probes, &mut random, "leaving a tiny solid"));
        // Straight in: both walls, whatever is behind them.
        let block = PreparedScene::open(prepare(&scene).unwrap()).unwrap();
        let SolidNode::Sphere(outside) = scene.solids[0].nodes[0] else { panic!("the shell") };
        let straight: Vec<Probe> = (0..few_rays(10_000) / 10)
            .map(|_| probe(outside.center + random.direction() * 5.0 * scale, outside.center))
            .collect();
        for (probe, hits) in straight.iter().zip(crossings(&block, &straight)) {
            let wall = (hits[1].t - hits[0].t) / (2.0 * scale);
            assert!((wall - thickness).abs() < 1e-14, "{probe:?}: a wall of {wall:e}");
        }
    }
    let [same, close] = counts;
    HardCase::TinySolid.tell(
        "a solid of 1e-9 of its scene with walls of 1e-6 of it is met as the oracle says",
        format!("{same} rays the same, {close} too close to call"),
    );
    assert!(close * 1000 < same);
}

/// A block less many balls that overlap. Nested, one is taken away after another, and every other
/// one put back; else they are taken from the block at once.
fn sponge(random: &mut Random, ball_count: usize, is_nested: bool) -> String {
    let radius = 0.8 / (ball_count as f64).cbrt();
    let balls = (0..ball_count).map(|_| sphere(random.in_cube(), radius, "other"));
    let block = upright(DVec3::splat(-1.0), DVec3::splat(1.0), "m");
    if !is_nested {
        let parts: Vec<String> = std::iter::once(block).chain(balls).collect();
        return join("difference", &parts.iter().map(String::as_str).collect::<Vec<_>>());
    }
    let mut whole = block;
    for (k, balls) in balls.collect::<Vec<_>>().chunks(2).enumerate() {
        let operation = ["difference", "union"][k % 2];
        let parts: Vec<&str> = std::iter::once(&whole).chain(balls).map(String::as_str).collect();
        whole = join(operation, &parts);
    }
    whole
}

#[test]
fn a_solid_of_a_thousand_leaves_is_met_as_the_oracle_says_however_it_is_nested() {
    let mut counts = [0; 2];
    for is_nested in [false, true] {
        let mut random = random(u64::from(is_nested));
        let scene = read(&sponge(&mut random, 1000, is_nested));
        let probes: Vec<Probe> = (0..few_rays(100_000) / 200)
            .map(|_| probe(random.direction() * 5.0, random.in_cube()))
            .collect();
        add(&mut counts, compare_with_oracle(&scene, &probes, "a sponge"));
        add(&mut counts, compare_leaving(&scene, &probes, &mut random, "leaving a sponge"));
    }
    let [same, close] = counts;
    HardCase::LargeSolid.tell(
        "a solid of 1001 leaves, flat or nested 500 deep, is met as the oracle says",
        format!("{same} rays the same, {close} too close to call"),
    );
    assert!(same > few_rays(1_500) && close * 100 < same);
}
