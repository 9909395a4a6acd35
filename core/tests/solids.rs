//! Solids, ray by ray: the algebra of sets, closed forms, and places where faces meet.
//!
//! `RTFARM_RAYS=100` takes a hundred times as many rays.

mod parts;

use std::{f64::consts::PI, thread};

use glam::{DMat3, DVec3};
use parts::{join, parallelepiped, rays, sphere, upright};
use rtfarm_core::{
    isa::Isa,
    prepare::prepare,
    prepared::{PreparedBytes, PreparedScene},
    read::read_scene,
    scene::Scene,
    trace::{Probe, ProbeHit},
};
use rtfarm_oracle::random::Random;

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
    let each = rays(100_000) / trees;
    let mut crossed = 0;
    for seed in 0..trees as u64 {
        let mut random = Random::new(seed);
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
    assert!(crossed > rays(5_000), "{what}: {crossed} crossings in all");
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
        let mut random = Random::new(seed);
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
}

#[test]
fn a_box_cut_with_a_box_is_a_box() {
    let mut random = Random::new(2);
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
        let mut random = Random::new(seed);
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
}

#[test]
fn a_hole_whose_ends_are_flush_has_no_skin() {
    for seed in 0..20 {
        let mut random = Random::new(seed);
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
    let mut random = Random::new(6);
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
    eprintln!("the thickness of the shell is right within {worst:.1e}");
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
        let mut random = Random::new(1);
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
            let count = rays(100_000);
            let error = (measured_volume(&solid, along, count) / truth - 1.0).abs();
            eprintln!("{what}: {error:.1e} off with {count} rays");
            assert!(error < 100.0 / count as f64, "{what} along {along}: {error:e}");
        }
    }
}

#[test]
fn a_parallelepiped_has_no_cracks_at_its_edges_and_corners() {
    for seed in 0..50 {
        let mut random = Random::new(seed);
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
