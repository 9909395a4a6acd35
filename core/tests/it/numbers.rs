//! Numbers that are hard: shapes that are tiny, huge, far away, thin or grazed, and rays with
//! zeros, NaNs and numbers next to zero. Each case tells what it measured.

use glam::DVec3;
use rayon::prelude::*;
use rtfarm_core::{
    isa::Isa,
    language::{Severity, read_scene},
    prepare::prepare,
    prepared::{PreparedBytes, PreparedScene},
    render::{Settings, render_tile},
    scene::{Quadrangle, Scene, Sphere, Triangle},
    testing::{Probe, ProbeHit, Probing},
};
use rtfarm_oracle::{
    Oracle,
    closed_forms::sphere_outline,
    hard_case::{HardCase, few_rays, random, rays},
    random::Random,
    random_scene::{Aim, Recipe, Style, random_ray, random_scene},
};

use crate::support::{
    judge::check_against_oracle,
    studio::{picture, pixels, quality, read, settings, whole},
};

type Block = PreparedScene<PreparedBytes>;

fn opened(scene: &Scene) -> Block {
    PreparedScene::open(prepare(scene).expect("a plain scene")).expect("a valid block")
}

/// A viewport and materials, and nothing to see.
fn empty() -> Scene {
    let nothing = Recipe { spheres: 0, triangles: 0, quadrangles: 0, ..Recipe::new(Style::Plain) };
    random_scene(0, &Recipe { parallelepipeds: 0, lights: 0, ..nothing })
}

fn of_triangles(triangles: &[[DVec3; 3]]) -> Scene {
    let triangle = |(primitive, &vertices)| Triangle { vertices, material: 0, primitive };
    Scene { triangles: (0..).zip(triangles).map(triangle).collect(), ..empty() }
}

fn of_quadrangles(quadrangles: &[[DVec3; 4]]) -> Scene {
    let quadrangle = |(primitive, &vertices)| Quadrangle { vertices, material: 0, primitive };
    Scene { quadrangles: (0..).zip(quadrangles).map(quadrangle).collect(), ..empty() }
}

fn of_sphere(center: DVec3, radius: f64) -> Scene {
    Scene { spheres: vec![Sphere { center, radius, material: 0, primitive: 0 }], ..empty() }
}

fn probe(origin: DVec3, target: DVec3) -> Probe {
    Probe { origin, direction: (target - origin).normalize(), leaving: None }
}

/// The points and radii of balls and flat faces, changed.
fn changed(scene: &Scene, change: impl Fn(DVec3) -> DVec3, factor: f64) -> Scene {
    let mut scene = scene.clone();
    for sphere in &mut scene.spheres {
        (sphere.center, sphere.radius) = (change(sphere.center), sphere.radius * factor);
    }
    for face in &mut scene.triangles {
        face.vertices = face.vertices.map(&change);
    }
    for face in &mut scene.quadrangles {
        face.vertices = face.vertices.map(&change);
    }
    let viewport = scene.viewport.as_mut().expect("a viewport");
    for point in [
        &mut viewport.eye,
        &mut viewport.top_left,
        &mut viewport.bottom_left,
        &mut viewport.top_right,
    ] {
        *point = change(*point);
    }
    scene.lights.iter_mut().for_each(|light| light.position = change(light.position));
    scene
}

/// How rays fared against the oracle.
#[derive(Debug, Clone, Copy, Default)]
struct Score {
    same: usize,
    /// Answers that differ where a few roundings of f64 decide.
    close: usize,
    hits: usize,
    /// The largest error of t, in ulp of the larger of t and the origin's greatest coordinate:
    /// where the ray is steeper than 60° to the face, and across the face at any angle.
    steep: f64,
    across: f64,
    /// Of steep rays, relative to a t that is at least a hundredth of the origin's greatest
    /// coordinate.
    relative: f64,
}

impl Score {
    fn join(self, other: Self) -> Self {
        Self {
            same: self.same + other.same,
            close: self.close + other.close,
            hits: self.hits + other.hits,
            steep: self.steep.max(other.steep),
            across: self.across.max(other.across),
            relative: self.relative.max(other.relative),
        }
    }
}

/// Asks tracer and oracle about each ray.
fn compare(scene: &Scene, probes: &[Probe], what: &str) -> Score {
    let (block, oracle) = (opened(scene), Oracle::new(scene));
    let found = block.probe(probes, Isa::fastest());
    let score = |(probe, found): (&Probe, Option<ProbeHit>)| {
        if !check_against_oracle((scene, &oracle), probe, found, what) {
            return Score { close: 1, ..Score::default() };
        }
        let truth = oracle.first_hit(probe.origin, probe.direction, None);
        let (Some(found), Some(truth)) = (found, truth) else {
            return Score { same: 1, ..Score::default() };
        };
        let error = (found.t - truth.t).abs();
        let ulp = f64::EPSILON * truth.t.max(probe.origin.abs().max_element());
        let cosine = truth.normal.dot(probe.direction).abs();
        let is_steep = cosine > 0.5;
        let is_long = truth.t > probe.origin.abs().max_element() / 100.0;
        Score {
            same: 1,
            hits: 1,
            close: 0,
            steep: if is_steep { error / ulp } else { 0.0 },
            across: error * cosine / ulp,
            relative: if is_steep && is_long { error / truth.t } else { 0.0 },
        }
    };
    probes.par_iter().zip(found).map(score).reduce(Score::default, Score::join)
}

/// Rays of every aim at the shapes of a scene.
fn aimed(scene: &Scene, random: &mut Random, count: usize) -> Vec<Probe> {
    let ray = |k: usize| {
        let (origin, direction) = random_ray(scene, Aim::ALL[k % Aim::ALL.len()], random);
        Probe { origin, direction: direction.normalize(), leaving: None }
    };
    (0..count).map(ray).collect()
}

/// Triangles of a rough ball around the middle.
fn ball_of_triangles() -> Vec<[DVec3; 3]> {
    let mut faces = Vec::new();
    for axis in 0..3 {
        for side in [-1.0, 1.0] {
            let at = |u: f64, v: f64| {
                let mut point = DVec3::ZERO;
                (point[axis], point[(axis + 1) % 3], point[(axis + 2) % 3]) = (side, u, v);
                point.normalize()
            };
            for i in -2..2 {
                for j in -2..2 {
                    let [u, v] = [f64::from(i) / 2.0, f64::from(j) / 2.0];
                    let (a, b) = (at(u, v), at(u + 0.5, v));
                    let (c, d) = (at(u + 0.5, v + 0.5), at(u, v + 0.5));
                    faces.extend([[a, b, c], [a, c, d]]);
                }
            }
        }
    }
    faces
}

#[test]
fn a_mesh_far_from_the_origin_is_met_within_four_ulp() {
    let mut total = Score::default();
    for (stream, offset) in (400..).zip([0.0, 1e3, 1e6, 1e9]) {
        let mut random = random(stream);
        let scene = of_triangles(&ball_of_triangles());
        let scene = changed(&scene, |point| point + offset, 1.0);
        let middle = DVec3::splat(offset);
        let probes: Vec<Probe> = (0..few_rays(5_000))
            .map(|_| probe(middle + 3.0 * random.direction(), middle + random.in_cube() * 0.7))
            .collect();
        let score = compare(&scene, &probes, &format!("moved by {offset}"));
        assert!(score.close * 1000 <= score.same, "moved by {offset}: {score:?}");
        total = total.join(score);
    }
    HardCase::FarMesh.tell(
        "a mesh moved by 0 to 1e9 is met at the oracle's t",
        format!("{} hits, within {:.2} ulp of max(|o|, t)", total.hits, total.steep),
    );
    assert!(total.steep <= 4.0 && total.across <= 4.0, "{total:?}");
}

#[test]
fn scenes_of_any_size_are_met_within_a_millionth_of_a_millionth() {
    let mut total = Score::default();
    for (stream, factor) in (700..).zip([1e-12, 1e12, 1e-100, 1e100]) {
        for seed in 0..10 {
            let mut random = random(stream * 100 + seed);
            let recipe = Recipe { parallelepipeds: 0, ..Recipe::new(Style::Plain) };
            let scene = changed(&random_scene(seed, &recipe), |point| point * factor, factor);
            let probes = aimed(&scene, &mut random, few_rays(400));
            total = total.join(compare(&scene, &probes, &format!("scaled by {factor:e}")));
        }
    }
    HardCase::TinyAndHugeScenes.tell(
        "scenes scaled by 1e-12 and 1e12, 1e-100 and 1e100 are met at the oracle's t",
        // Relative to a t that is tiny beside the coordinates nothing can be exact.
        format!(
            "{} hits, error {:.1e} of max(|o|, t); {:.1e} of t from a hundredth of |o| on",
            total.hits,
            total.steep * f64::EPSILON,
            total.relative
        ),
    );
    assert!(total.relative <= 1e-12 && total.steep * f64::EPSILON <= 1e-13, "{total:?}");
    assert!(total.close * 5 <= total.same, "{total:?}");
}

#[test]
fn a_skinny_triangle_that_is_grazed_is_not_met_outside_itself() {
    let mut random = random(8);
    let (mut hits, mut outside, mut worst) = (0, 0, 0.0_f64);
    for _ in 0..200 {
        let (place, along) = (random.in_cube(), random.direction());
        let aside = along.any_orthonormal_vector() * random.log_uniform(1e-12, 1e-3);
        let [a, b, c] = [place, place + along, place + along * random.unit() + aside];
        let block = opened(&of_triangles(&[[a, b, c]]));
        let probes: Vec<Probe> = (0..rays(100_000) / 200)
            .map(|_| {
                // Nearly along its long side, at a point in or near it.
                let (u, v) = (random.unit(), random.unit());
                let target = a + (b - a) * u + (c - a) * v * (1.0 - u);
                let away = along + random.direction() * random.log_uniform(1e-14, 1e-2);
                probe(target - away * random.between(1.0, 5.0), target)
            })
            .collect();
        let (low, high) = (a.min(b).min(c), a.max(b).max(c));
        for (probe, hit) in probes.iter().zip(block.probe(&probes, Isa::fastest())) {
            let Some(hit) = hit else { continue };
            let point = probe.origin + hit.t * probe.direction;
            let beyond = (low - point).max(point - high).max_element().max(0.0);
            let scale = probe.origin.abs().max_element().max(hit.t);
            worst = worst.max(beyond / (f64::EPSILON * scale));
            outside += usize::from(beyond > 8.0 * f64::EPSILON * scale);
            hits += 1;
        }
    }
    HardCase::GrazedSkinnyTriangle.tell(
        "a skinny triangle, grazed, is met inside its box",
        format!("{outside} of {hits} hits outside; {worst:.1} ulp at most"),
    );
    assert!(outside == 0 && hits > rays(10_000));
}

#[test]
fn slivers_are_met_where_the_oracle_meets_them() {
    let mut total = Score::default();
    for seed in 0..100 {
        let mut random = random(900 + seed);
        let (place, along) = (random.in_cube(), random.direction());
        let aspect = [1e-6, 1e-9, 1e-3, 1e-6, 1e-12][seed as usize % 5];
        let aside = along.any_orthonormal_vector() * aspect;
        let [a, b, c] = [place, place + along, place + along * random.unit() + aside];
        let scene = of_triangles(&[[a, b, c]]);
        let probes: Vec<Probe> = (0..few_rays(200))
            .map(|_| {
                let (u, v) = (random.between(-0.1, 1.1), random.between(-0.5, 1.5));
                let target = a + (b - a) * u + (c - a) * v * (1.0 - u);
                probe(target + random.direction() * random.between(0.5, 3.0), target)
            })
            .collect();
        total = total.join(compare(&scene, &probes, &format!("a sliver of 1:{aspect:e}")));
    }
    HardCase::Sliver.tell(
        "slivers down to an aspect of 1e-12 are met as the oracle says",
        format!(
            "{} of {} rays the same, {} hits",
            total.same,
            total.same + total.close,
            total.hits
        ),
    );
    assert!(total.hits > few_rays(4_000));
}

#[test]
fn a_huge_triangle_beside_tiny_ones_is_met_where_the_oracle_meets_it() {
    let mut total = Score::default();
    for seed in 0..20 {
        let mut random = random(1200 + seed);
        let mut faces =
            vec![[random.in_cube(), random.in_cube(), random.in_cube()].map(|p| p * 1e5)];
        for _ in 0..30 {
            let place = random.in_cube() * 3.0;
            faces.push([place, place + random.in_cube(), place + random.in_cube()]);
        }
        let scene = of_triangles(&faces);
        let probes = aimed(&scene, &mut random, few_rays(500));
        total = total.join(compare(&scene, &probes, "huge beside tiny"));
    }
    HardCase::HugeTriangle.tell(
        "a triangle of 1e5 beside those of 1 has no hit that the oracle lacks",
        format!("0 wrong of {} rays, {} more within rounding of an edge", total.same, total.close),
    );
}

#[test]
fn a_sphere_seen_from_a_million_keeps_its_outline() {
    let mut total = Score::default();
    for (stream, distance) in (1300..).zip([1e3, 1e5, 1e6, 1e7]) {
        let mut random = random(stream);
        let scene = of_sphere(DVec3::ZERO, 1.0);
        let probes: Vec<Probe> = (0..few_rays(25_000))
            .map(|k| {
                let ahead = random.direction();
                let (x, y) = ahead.any_orthonormal_pair();
                let spoke = random.direction();
                let aside = (x * spoke.x + y * spoke.y).normalize();
                // Anywhere within 1.02 radii, and every other one close to the outline.
                let off = if k % 2 == 0 {
                    1.02 * random.unit().sqrt()
                } else {
                    1.0 + random.sign() * random.log_uniform(1e-15 * distance, 1e-2)
                };
                let origin = -distance * ahead;
                probe(origin, aside * off)
            })
            .collect();
        let score = compare(&scene, &probes, &format!("from {distance}"));
        total = total.join(score);
    }
    HardCase::FarSphere.tell(
        "a sphere of 1 seen from 1e3 to 1e7 has the oracle's outline and t",
        format!(
            "{} of {} rays misclassified, relative error of t {:.1e}",
            total.close,
            total.same + total.close,
            total.relative
        ),
    );
    assert!(total.close == 0 && total.relative <= 1e-12, "{total:?}");
}

#[test]
fn a_camera_just_above_a_huge_sphere_keeps_its_height() {
    let mut worst = 0.0_f64;
    let (mut total, radius) = (Score::default(), 1e7);
    for seed in 0..20 {
        let mut random = random(1400 + seed);
        let center = if seed % 2 == 0 { DVec3::ZERO } else { random.in_cube() * 1e7 };
        let scene = of_sphere(center, radius);
        let (block, oracle) = (opened(&scene), Oracle::new(&scene));
        let probes: Vec<Probe> = (0..few_rays(5_000))
            .map(|_| {
                let up = random.direction();
                let height = random.log_uniform(1e-3, 100.0);
                let origin = center + up * (radius + height);
                let aside = random.direction() * height * random.log_uniform(0.1, 30.0);
                probe(origin, center + (origin + aside - center).normalize() * radius)
            })
            .collect();
        total = total.join(compare(&scene, &probes, "just above a huge sphere"));
        let found = block.probe(&probes, Isa::fastest());
        let error = |(probe, found): (&Probe, Option<ProbeHit>)| {
            let truth = oracle.first_hit(probe.origin, probe.direction, None)?;
            Some((found?.t - truth.t).abs() * truth.normal.dot(probe.direction).abs())
        };
        let errors: Vec<f64> = probes.par_iter().zip(found).filter_map(error).collect();
        worst = errors.into_iter().fold(worst, f64::max);
    }
    HardCase::HugeSphere.tell(
        "a sphere of 1e7 seen from just above it is met at its height",
        format!("{} hits, off by {worst:.1e} at most", total.hits),
    );
    assert!(worst <= 1e-8 && total.hits > few_rays(50_000));
}

#[test]
fn a_tangent_ray_is_told_right_but_for_four_ulp() {
    let (mut count, mut wrong, mut worst) = (0, 0, 0.0_f64);
    for seed in 0..100 {
        let mut random = random(1500 + seed);
        let radius = random.log_uniform(1e-3, 1e3);
        let block = opened(&of_sphere(DVec3::ZERO, radius));
        let mut probes = Vec::new();
        let mut offs = Vec::new();
        for _ in 0..rays(100_000) / 100 {
            // Along an axis, so that how far the ray passes the centre is known to the bit.
            let axis = random.below(3);
            let steps = random.below(200) as f64 - 100.0;
            let off = radius + steps * (radius.next_up() - radius);
            let mut origin = DVec3::ZERO;
            origin[axis] = -radius * random.log_uniform(1.1, 100.0);
            origin[(axis + 1) % 3] = off * random.sign();
            probes.push(Probe { origin, direction: DVec3::AXES[axis], leaving: None });
            offs.push(off);
        }
        for (off, hit) in offs.into_iter().zip(block.probe(&probes, Isa::fastest())) {
            count += 1;
            if hit.is_some() != (off < radius) {
                wrong += 1;
                worst = worst.max((off - radius).abs() / (f64::EPSILON * radius));
            }
        }
    }
    HardCase::TangentRay.tell(
        "rays within 100 ulp of touching a sphere are told right",
        format!("{wrong} of {count} wrong, none farther than {worst:.1} ulp of the radius"),
    );
    assert!(worst <= 4.0);
}

const VIEWPORT: &str = "viewport origin 0 0 5 topleft -1 1 4 bottomleft -1 -1 4 topright 1 1 4
    endviewport materials entry name white endentry endmaterials ";

/// At z = 0 the screen of eight pixels is 10 wide.
const PIXEL: f64 = 1.25;

/// What a picture shows in all of small things, one moved about in each of side x side cells,
/// against the pixels that they cover, in standard errors of as many independent samples.
fn check_energy(
    (case, what): (HardCase, &str),
    (side, size, area): (u32, [f64; 2], f64),
    place: impl Fn(DVec3, &mut Scene, u32) -> f64,
) {
    let samples = 1024;
    let runs = rays(1_000_000) / (64 * samples as usize);
    let (mut seen, mut covered) = (0.0, 0.0);
    let cell = 8.0 * PIXEL / f64::from(side);
    for run in 0..runs as u64 {
        let mut random = random(u64::from(case.row()) * 100_000 + run);
        let mut scene = read(VIEWPORT);
        for k in 0..side * side {
            let room = size.map(|size| (cell - size).max(0.0));
            let corner = [k % side, k / side].map(|k| f64::from(k) * cell - 4.0 * PIXEL);
            let [x, y] = [0, 1].map(|axis| corner[axis] + room[axis] * random.unit());
            covered += place(DVec3::new(x, y, 0.0), &mut scene, k);
        }
        let settings = Settings { quality: quality(samples, run), ..settings(8, 8, 1) };
        seen += picture(&scene, &settings).iter().map(|pixel| f64::from(pixel[0])).sum::<f64>();
    }
    let (seen, covered) = (seen * f64::from(samples), covered * f64::from(samples));
    let off = (seen - covered) / covered.sqrt();
    case.tell(
        &format!("{what} of {area:.0e} pixels have their energy"),
        format!("{off:+.2} sigma: {seen:.0} samples hit of {covered:.0} expected"),
    );
    // Spheres hold to 3 sigma. Quadrangles are asked for no number of them: one seed in 370 is
    // beyond 3.
    let most = if case == HardCase::SubpixelSphere { 3.0 } else { 4.0 };
    assert!(off.abs() <= most, "{what}: {seen}, truly {covered}");
}

#[test]
fn spheres_far_smaller_than_a_pixel_have_their_energy() {
    for (side, area) in [(16, 1e-2), (64, 1e-4), (64, 1e-6)] {
        let radius = PIXEL * (area / std::f64::consts::PI).sqrt();
        let viewport = read(VIEWPORT).viewport.unwrap();
        let cells = (side, [2.0 * radius; 2], area);
        check_energy((HardCase::SubpixelSphere, "spheres"), cells, |corner, scene, primitive| {
            let center = corner + DVec3::new(radius, radius, 0.0);
            scene.spheres.push(Sphere { center, radius, material: 0, primitive });
            let outline = sphere_outline(&viewport, settings(8, 8, 1).size, center, radius);
            outline.expect("before the eye").area()
        });
    }
}

#[test]
fn quadrangles_with_an_edge_of_a_ten_thousandth_are_seen() {
    for [wide, high] in [[1e-4, 0.15], [0.15, 1e-4]] {
        let area = wide * high / (PIXEL * PIXEL);
        let what = format!("quadrangles of {wide:e} x {high:e},");
        check_energy(
            (HardCase::SubpixelQuadrangle, &what),
            (64, [wide, high], area),
            |corner, scene, primitive| {
                let (u, v) = (DVec3::X * wide, DVec3::Y * high);
                let vertices = [corner, corner + u, corner + u + v, corner + v];
                scene.quadrangles.push(Quadrangle { vertices, material: 0, primitive });
                area
            },
        );
    }
}

#[test]
fn numbers_next_to_zero_change_nothing() {
    // Denormal coordinates and components in place of zeros.
    let tiny = [5e-324, 1e-310, -3e-320, -1e-308];
    let nudged = |point: DVec3, k: usize| {
        DVec3::from_array(point.to_array().map(|x| if x == 0.0 { tiny[k % 4] } else { x }))
    };
    let text = format!(
        "{VIEWPORT} lights point coords 0 3 4 power 20 endpoint endlights geometry
        sphere coords 0 0 0 radius 1 material white endsphere
        triangle vertex -3 0 1 vertex 0 -2 0 vertex 0 0 2 material white endtriangle
        quadrangle vertex -4 -3 0 vertex 4 -3 0 vertex 4 -3 -5 vertex -4 -3 -5 material white
            endquadrangle endgeometry"
    );
    let scene = read(&text);
    let settings = settings(64, 64, 4);
    let plain = picture(&scene, &settings);
    let mut count = 0;
    for k in 0..4 {
        let changed = changed(&scene, |point| nudged(point, k), 1.0);
        for isa in Isa::ALL.into_iter().filter(|isa| isa.is_supported()) {
            let go_on = &mut || std::ops::ControlFlow::Continue(());
            let area = whole(settings.size);
            let tile = render_tile(&opened(&changed), &settings.quality, area, isa, go_on).unwrap();
            assert!(tile.pixels == plain, "{k}, {isa}");
            count += tile.pixels.len();
        }
    }
    let block = opened(&scene);
    let mut random = random(24);
    for k in 0..rays(10_000) {
        let mut direction = random.in_cube();
        direction[k % 3] = 0.0;
        let probe =
            probe(direction * -5.0 / direction.length() + random.in_cube() * 0.1, DVec3::ZERO);
        let mut straight = probe.direction;
        straight[k % 3] = 0.0;
        let bent = nudged(straight, k);
        let hits = [straight, bent]
            .map(|direction| block.probe(&[Probe { direction, ..probe }], Isa::fastest()));
        assert_eq!(hits[0], hits[1], "{probe:?}");
        count += 1;
    }
    HardCase::Denormal.tell(
        "denormal coordinates and directions give the picture and the hits of zeros",
        format!("{count} pixels and rays, all the same"),
    );
}

#[test]
fn a_ray_without_a_direction_is_not_traced() {
    let scene = random_scene(26, &Recipe { solids: 2, ..Recipe::new(Style::Plain) });
    let block = opened(&scene);
    let mut count = 0;
    for bad in [0.0, f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
        for axes in 1..8 {
            let mut random = random(26);
            let mut direction = if bad == 0.0 { DVec3::ZERO } else { random.direction() };
            for axis in (0..3).filter(|axis| axes >> axis & 1 == 1) {
                direction[axis] = bad;
            }
            let probe = Probe { origin: random.in_cube() * 0.1, direction, leaving: None };
            for isa in Isa::ALL.into_iter().filter(|isa| isa.is_supported()) {
                assert_eq!(block.probe(&[probe], isa), [None], "{probe:?}");
            }
            let lost = Probe { origin: direction, direction: DVec3::X, leaving: None };
            assert!(block.count_visits(&[probe])[0] <= 1, "{probe:?}");
            if bad != 0.0 {
                assert!(block.count_visits(&[lost])[0] <= 1, "{lost:?}");
            }
            count += 1;
        }
    }
    HardCase::WrongDirection.tell(
        "rays with a direction of zero, NaN or infinity visit no box",
        format!("{count} rays"),
    );
}

#[test]
fn a_hundred_thousand_triangles_in_one_place_are_one_to_the_eye() {
    let [a, b, c] = [DVec3::new(-1.0, -1.0, 0.0), DVec3::new(1.0, -1.0, 0.0), DVec3::Y];
    let corners = [[a, b, c], [b, c, a], [c, a, b], [a, c, b], [c, b, a], [b, a, c]];
    let faces: Vec<_> = (0..100_000).map(|k| corners[k % 6]).collect();
    let many = opened(&of_triangles(&faces));
    let one = opened(&of_triangles(&faces[..1]));
    let mut random = random(28);
    let probes: Vec<Probe> = (0..200)
        .map(|_| probe(random.direction() * 3.0, DVec3::new(random.unit() - 0.5, -0.5, 0.0)))
        .collect();
    let [many_hits, one_hits] = [&many, &one].map(|block| block.probe(&probes, Isa::fastest()));
    for (many, one) in many_hits.into_iter().zip(one_hits) {
        let (many, one) = (many.unwrap(), one.unwrap());
        // In a plane of its own a triangle's distance is interpolated.
        assert!(many.primitive == 0 && (many.t - one.t).abs() < 1e-14, "{many:?}, not {one:?}");
    }
    let visits = many.count_visits(&probes).into_iter().max().unwrap();
    HardCase::ManyFacesInOnePlace.tell(
        "of 100 000 triangles in one place the first is met, through a tree of bounded depth",
        format!("{} rays, at most {visits} nodes each", probes.len()),
    );
}

#[test]
fn needles_and_concave_quadrangles_are_met_where_the_oracle_meets_them() {
    let (mut needles, mut concave) = (Score::default(), Score::default());
    for seed in 0..100 {
        let mut random = random(3200 + seed);
        let (place, along) = (random.in_cube(), random.direction());
        let (x, y) = along.any_orthonormal_pair();
        let width = random.log_uniform(1e-9, 1e-2);
        let needle = [place, place + along, place + along + x * width, place + x * width];
        // A dart: its third corner is drawn in, beyond the line between its neighbours.
        let inward = place + (x + y) * random.between(0.02, 0.45);
        let dart = [place, place + x, inward, place + y];
        for (quadrangle, score) in [(needle, &mut needles), (dart, &mut concave)] {
            let scene = of_quadrangles(&[quadrangle]);
            let [a, b, _, d] = quadrangle;
            let probes: Vec<Probe> = (0..few_rays(100))
                .map(|_| {
                    let (u, v) = (random.between(-0.1, 1.1), random.between(-0.2, 1.2));
                    let target = a + (b - a) * u + (d - a) * v;
                    probe(target + random.direction() * random.between(0.5, 3.0), target)
                })
                .collect();
            *score = score.join(compare(&scene, &probes, "a quadrangle"));
        }
    }
    for (case, what, score) in [
        (HardCase::Needle, "needles of quadrangles", needles),
        (HardCase::ConcaveQuadrangle, "concave quadrangles", concave),
    ] {
        case.tell(
            &format!("{what} are met as the oracle says"),
            format!(
                "{} of {} rays the same, {} hits",
                score.same,
                score.same + score.close,
                score.hits
            ),
        );
        assert!(score.hits > few_rays(500) && score.close * 100 <= score.same, "{score:?}");
    }
}

#[test]
fn a_quadrangle_with_three_corners_in_a_line_is_a_triangle() {
    let (mut count, mut hits, mut close) = (0, 0, 0);
    let (mut worst, mut farthest) = (0.0_f64, 0.0_f64);
    for seed in 0..100 {
        let mut random = random(3500 + seed);
        // Round numbers, so that the corner in between is in the line exactly.
        let round = |point: DVec3| (point * 64.0).round() / 64.0;
        let [a, b, c] = [0, 1, 2].map(|_| round(random.in_cube()));
        if (b - a).cross(c - a).length() < 0.05 {
            continue;
        }
        let middle = (b + c) / 2.0;
        let mut corners = [a, b, middle, c];
        corners.rotate_left(seed as usize % 4);
        let flat = opened(&of_quadrangles(&[corners]));
        let scene = of_triangles(&[[a, b, c]]);
        let (triangle, oracle) = (opened(&scene), Oracle::new(&scene));
        let probes: Vec<Probe> = (0..rays(100_000) / 100)
            .map(|k| {
                let (u, v) = (random.between(-0.1, 1.1), random.between(-0.1, 1.1));
                // Some at the edges and the corners themselves.
                let (u, v) = if k % 4 == 0 { (u.round(), v) } else { (u, v) };
                let target = a + (b - a) * u * (1.0 - v) + (c - a) * v;
                probe(random.direction() * 3.0, target)
            })
            .collect();
        let found = flat.probe(&probes, Isa::fastest());
        for (k, truth) in triangle.probe(&probes, Isa::fastest()).into_iter().enumerate() {
            if found[k].is_some() != truth.is_some() {
                // The corner in between is rounded on its way to the screen, as all corners are.
                let Probe { origin, direction, .. } = probes[k];
                farthest = farthest.max(oracle.miss_margin(origin, direction, None));
                close += 1;
            }
            if let (Some(found), Some(truth)) = (found[k], truth) {
                let normal = (b - a).cross(c - a).normalize();
                let error = (found.t - truth.t).abs() * normal.dot(probes[k].direction).abs();
                worst = worst.max(error / (f64::EPSILON * truth.t.max(3.0)));
                hits += 1;
            }
            count += 1;
        }
    }
    HardCase::CollinearCorners.tell(
        "a quadrangle with three corners in a line has the triangle's hits",
        format!(
            "{count} rays, {hits} hits, t within {worst:.1} ulp across the face; {close} of the \
             rays at the halved edge fall to its other side, {farthest:.1e} from it at most"
        ),
    );
    assert!(worst <= 8.0 && farthest <= 4.0 * f64::EPSILON);
}

#[test]
fn planes_a_ten_millionth_apart_are_met_in_their_order() {
    let square = |z: f64| {
        [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)].map(|(x, y)| DVec3::new(x, y, z))
    };
    let mut count = 0;
    for (stream, turned) in (6000..).zip([false, true]) {
        let mut random = random(stream);
        let up = if turned { random.direction() } else { DVec3::Z };
        let (x, y) = up.any_orthonormal_pair();
        let place = |point: DVec3| point.x * x + point.y * y + point.z * up;
        let quadrangles = [square(0.0), square(1e-7)].map(|corners| corners.map(place));
        let triangles = quadrangles.map(|[a, b, c, d]| [[a, b, c], [a, c, d]]);
        for scene in [of_quadrangles(&quadrangles), of_triangles(triangles.as_flattened())] {
            let per_plane = if scene.triangles.is_empty() { 1 } else { 2 };
            let block = opened(&scene);
            let probes: Vec<Probe> = (0..rays(100_000) / 4)
                .map(|_| {
                    let target = place(random.in_cube() * DVec3::new(0.9, 0.9, 0.0));
                    probe(target + random.direction() * random.log_uniform(1e-2, 1e2), target)
                })
                .collect();
            for (probe, hit) in probes.iter().zip(block.probe(&probes, Isa::fastest())) {
                // Rays that all but run along the planes leave them before they cross both.
                if probe.direction.dot(up).abs() < 1e-4 {
                    continue;
                }
                let upper = u32::from(probe.direction.dot(up) < 0.0);
                let hit = hit.unwrap_or_else(|| panic!("{probe:?} meets nothing"));
                assert_eq!(hit.primitive / per_plane, upper, "{probe:?}");
                count += 1;
            }
        }
    }
    HardCase::NearParallelPlanes
        .tell("of planes 1e-7 apart the nearer is met first", format!("0 wrong of {count} rays"));
}

/// `count` x `count` squares that fill -1..1 in the plane at `z`.
fn tiled_plane(count: usize, z: f64) -> Vec<[DVec3; 4]> {
    let at = |k: usize| 2.0 * k as f64 / count as f64 - 1.0;
    let corners = |k: usize| {
        let (x, y) = (k % count, k / count);
        [(x, y), (x + 1, y), (x + 1, y + 1), (x, y + 1)].map(|(x, y)| DVec3::new(at(x), at(y), z))
    };
    (0..count * count).map(corners).collect()
}

/// Faces closer together than a box can tell: which is met must not hang on whose box comes first.
#[test]
fn of_faces_in_many_boxes_the_first_is_met() {
    let z = 0.377;
    let strip = |k: usize| {
        let x = 2.0 * k as f64 / 50.0 - 1.0;
        [(x, -1.0), (x + 0.01, -1.0), (x + 0.03, 1.0), (x + 0.02, 1.0)]
            .map(|(x, y)| DVec3::new(x, y, z))
    };
    let strips: Vec<[DVec3; 4]> = (0..50).map(strip).collect();
    let mut scenes = Vec::new();
    for wall in [tiled_plane(1, z), tiled_plane(12, z)] {
        scenes.push((HardCase::CoincidentFaces, [strips.clone(), wall.clone()].concat()));
        scenes.push((HardCase::CoincidentFaces, [wall, strips.clone()].concat()));
    }
    for gap in [1e-7, 1e-9] {
        scenes.push((
            HardCase::NearParallelPlanes,
            [tiled_plane(13, z), tiled_plane(11, z + gap)].concat(),
        ));
        scenes.push((
            HardCase::NearParallelPlanes,
            [tiled_plane(1, z), tiled_plane(12, z + gap)].concat(),
        ));
    }
    let (mut counts, mut hits) = ([0, 0], 0);
    for (stream, (case, faces)) in (6600..).zip(&scenes) {
        let block = opened(&of_quadrangles(faces));
        let mut random = random(stream);
        let probes: Vec<Probe> = (0..rays(100_000) / 8)
            .map(|_| {
                let target = (random.in_cube() * DVec3::new(1.0, 1.0, 0.0)).with_z(z);
                probe(target + random.direction() * random.log_uniform(1e-2, 1e2), target)
            })
            .collect();
        let truth = block.probe_all_faces(&probes);
        hits += truth.iter().flatten().count();
        for isa in Isa::ALL.into_iter().filter(|isa| isa.is_supported()) {
            for (k, found) in block.probe(&probes, isa).into_iter().enumerate() {
                assert_eq!(found, truth[k], "{isa}: {:?}", probes[k]);
            }
        }
        counts[usize::from(*case == HardCase::CoincidentFaces)] += probes.len();
    }
    assert!(hits > rays(50_000));
    let [apart, coincident] = counts;
    HardCase::NearParallelPlanes.tell(
        "of planes 1e-7 and 1e-9 apart in many boxes the nearer is met, as without boxes",
        format!("0 wrong of {apart} rays"),
    );
    HardCase::CoincidentFaces.tell(
        "of coincident faces in many boxes the first is met, as without boxes",
        format!("0 wrong of {coincident} rays"),
    );
}

#[test]
fn pictures_do_not_depend_on_instructions_or_threads() {
    let (mut count, mut blocks) = (0, 0);
    for style in [Style::Plain, Style::Grid, Style::Extreme, Style::Far] {
        for seed in 0..3 {
            let counts =
                Recipe { spheres: 40, triangles: 400, quadrangles: 40, ..Recipe::new(style) };
            let recipe = Recipe { solids: 3, clear: true, ..counts };
            let scene = random_scene(seed, &recipe);
            let build = |threads| {
                let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
                pool.install(|| prepare(&scene).expect("a plain scene").as_ref().to_vec())
            };
            let block = build(1);
            assert!([2, 8].into_iter().all(|threads| build(threads) == block), "{style:?} {seed}");
            blocks += 1;
            let (block, settings) = (opened(&scene), settings(32, 24, 1));
            let picture = |isa| {
                let go_on = &mut || std::ops::ControlFlow::Continue(());
                let area = whole(settings.size);
                let tile =
                    render_tile(&block, &settings.quality, area, isa, go_on).expect("nobody stops");
                tile.pixels.into_iter().flatten().map(f32::to_bits).collect::<Vec<_>>()
            };
            let scalar = picture(Isa::Scalar);
            for isa in Isa::ALL.into_iter().filter(|isa| isa.is_supported()) {
                assert!(picture(isa) == scalar, "{style:?} {seed}: {isa}");
                count += scalar.len() / 3;
            }
        }
    }
    HardCase::AnyMachine.tell(
        "every instruction set and 1, 2 and 8 threads give the same bits",
        format!("{count} pixels, {blocks} prepared scenes"),
    );
}

#[test]
fn a_scene_of_any_size_is_seen_through_a_screen_of_one() {
    // A sky so far that the screen is nothing beside it.
    let mut count = 0;
    for radius in [1e8, 1e30, 1e100, 1e200, 1e300] {
        let scene = read(&format!(
            "{VIEWPORT} geometry sphere coords 0 0 0 radius {radius:?} material white endsphere
            endgeometry"
        ));
        let settings = settings(32, 32, 1);
        let seen = pixels(&opened(&scene), &settings, whole(settings.size));
        assert!(seen.iter().all(|pixel| *pixel == [1.0; 3]), "a sky of {radius:e}");
        count += seen.len();
    }
    HardCase::HugeSky
        .tell("skies of 1e8 to 1e300 are seen", format!("{count} pixels, all of them"));
}

/// A viewport, materials and what follows: the message of the first error.
fn refusal(viewport: &str, geometry: &str) -> String {
    let text = format!(
        "viewport {viewport} endviewport materials entry name m endentry endmaterials
        geometry {geometry} endgeometry"
    );
    let nothing = |_: &str| Err(std::io::ErrorKind::NotFound.into());
    let reading = read_scene(text.as_bytes(), &nothing);
    let errors = reading.diagnostics.iter().filter(|told| told.severity == Severity::Error);
    let errors: Vec<&str> = errors.map(|told| told.message.as_str()).collect();
    assert!(reading.scene.is_none() && errors.len() == 1, "{text}: {errors:?}");
    errors[0].to_owned()
}

const SCREEN: &str = "origin 0 0 5 topleft -1 1 4 bottomleft -1 -1 4 topright 1 1 4";

#[test]
fn what_no_picture_can_show_is_refused() {
    let ball = |radius: &str| format!("sphere coords 0 0 0 radius {radius} material m endsphere");
    let quadrangle = |corners: [&str; 4]| {
        format!("quadrangle vertex {} material m endquadrangle", corners.join(" vertex "))
    };
    let flat = "parallelepiped vertex 0 0 0 vertex 1 0 0 vertex 0 1 0 vertex 1 1 0 material m
        endparallelepiped";
    for (case, what, viewport, geometry) in [
        (HardCase::WrongRadius, "a radius of 0", SCREEN, ball("0")),
        (HardCase::WrongRadius, "a negative radius", SCREEN, ball("-1")),
        (HardCase::WrongRadius, "a radius that is NaN", SCREEN, ball("nan")),
        (HardCase::NotFinite, "an infinite radius", SCREEN, ball("inf")),
        (HardCase::NotFinite, "a number beyond all", SCREEN, ball("1e999")),
        (
            HardCase::SelfCrossingQuadrangle,
            "a quadrangle that crosses itself",
            SCREEN,
            quadrangle(["0 0 0", "1 1 0", "1 0 0", "0 1 0"]),
        ),
        (
            HardCase::BentQuadrangle,
            "a bent quadrangle",
            SCREEN,
            quadrangle(["0 0 0", "1 0 0", "1 1 0.1", "0 1 0"]),
        ),
        (HardCase::BoxWithoutVolume, "a box without a volume", SCREEN, flat.to_owned()),
        (
            HardCase::WrongScreen,
            "screen corners in a line",
            "origin 0 0 5 topleft -1 1 4 bottomleft 0 1 4 topright 1 1 4",
            ball("1"),
        ),
        (
            HardCase::WrongScreen,
            "an eye in the screen's plane",
            "origin 5 5 4 topleft -1 1 4 bottomleft -1 -1 4 topright 1 1 4",
            ball("1"),
        ),
    ] {
        case.tell(&format!("{what} is refused"), refusal(viewport, &geometry));
    }
}

#[test]
fn triangles_without_area_are_dropped_and_counted() {
    let triangle = |corners: &str| format!("triangle {corners} material m endtriangle ");
    let whole = triangle("vertex -1 -1 0 vertex 1 -1 0 vertex 0 1 0");
    let line = triangle("vertex 0 0 1 vertex 1 1 1 vertex 0.5 0.5 1");
    let point = triangle("vertex 0.1 0.1 1 vertex 0.1 0.1 1 vertex 0.1 0.1 1");
    let materials = "materials entry name m endentry endmaterials";
    let scene = |faces: &str| {
        read(&format!("viewport {SCREEN} endviewport {materials} geometry {faces} endgeometry"))
    };
    let alone = picture(&scene(&whole), &settings(64, 64, 4));
    for (case, what, nothing) in [
        (HardCase::TriangleWithoutArea, "a triangle of no area", &line),
        (HardCase::TriangleOfOnePoint, "a triangle of three equal corners", &point),
    ] {
        let scene = scene(&format!("{nothing}{whole}{nothing}"));
        assert_eq!((scene.dropped.zero_area, scene.triangles.len()), (2, 1), "{what}");
        assert!(picture(&scene, &settings(64, 64, 4)) == alone, "{what}");
        case.tell(&format!("{what} is dropped and counted"), "the picture is the same to the bit");
    }
}
