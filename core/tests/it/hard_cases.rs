//! Light, faces and eyes in awkward places.

#![expect(clippy::float_cmp, reason = "what holds exactly is tested exactly")]

use std::fmt::Write;

use glam::DVec3;
use rtfarm_core::{
    isa::Isa,
    prepared::{PreparedBytes, PreparedScene},
    scene::{Quadrangle, Scene, Sphere},
    testing::{Probe, Probing},
    tile::Area,
};
use rtfarm_oracle::{
    Oracle,
    closed_forms::irradiance,
    eye_direction,
    hard_case::{HardCase, random, rays},
    random::Random,
};

use crate::support::{
    parts::{join, sphere, upright},
    studio::{picture, pixels, prepared, read, settings},
};

const BLACK: [f32; 3] = [0.0; 3];

/// White, red and green things before a black sky, seen from z = 5 through a screen of 2 x 2.
fn scene(lights: &str, geometry: &str) -> Scene {
    seen_from(5.0, lights, geometry)
}

fn seen_from(z: f64, lights: &str, geometry: &str) -> Scene {
    let screen = z - 2.5;
    read(&format!(
        "viewport origin 0 0 {z} topleft -1 1 {screen} bottomleft -1 -1 {screen}
            topright 1 1 {screen} endviewport
        materials entry name white endentry entry name red color 255 0 0 endentry
            entry name green color 0 255 0 endentry endmaterials
        lights {lights} endlights geometry {geometry} endgeometry"
    ))
}

/// A light of an intensity of 1.
fn lamp(x: f64, y: f64, z: f64) -> String {
    format!("point coords {x:?} {y:?} {z:?} power 1 endpoint ")
}

/// A triangle or a quadrangle.
fn polygon(corners: &[DVec3], material: &str) -> String {
    let word = if corners.len() == 3 { "triangle" } else { "quadrangle" };
    let mut text = format!("{word} ");
    for corner in corners {
        write!(text, "vertex {:?} {:?} {:?} ", corner.x, corner.y, corner.z).unwrap();
    }
    text + &format!("material {material} end{word} ")
}

/// A square at this z that faces the eye.
fn wall(z: f64, half: f64, material: &str) -> String {
    let corner = |x: f64, y: f64| DVec3::new(x * half, y * half, z);
    polygon(&[corner(-1.0, -1.0), corner(1.0, -1.0), corner(1.0, 1.0), corner(-1.0, 1.0)], material)
}

/// The side of a picture that takes this many rays, or more if asked for.
fn side(count: usize) -> u64 {
    rays(count).isqrt() as u64
}

/// What a pixel's middle sees: the point on the sphere.
fn point_on_sphere(scene: &Scene, size: u32, pixel: usize, sphere: &Sphere) -> Option<DVec3> {
    let viewport = scene.viewport.unwrap();
    let (x, y) = (pixel % size as usize, pixel / size as usize);
    let size = settings(u64::from(size), u64::from(size), 1).size;
    let direction = eye_direction(&viewport, size, x as f64 + 0.5, y as f64 + 0.5).normalize();
    let to_eye = viewport.eye - sphere.center;
    let half_b = to_eye.dot(direction);
    let closest = to_eye - half_b * direction;
    let discriminant = sphere.radius * sphere.radius - closest.length_squared();
    let root = discriminant.sqrt();
    let t = if -half_b - root > 0.0 { -half_b - root } else { -half_b + root };
    (discriminant > 0.0).then(|| viewport.eye + t * direction)
}

#[test]
fn a_light_on_a_flat_surface_gives_it_nothing() {
    // A tilted wall whose numbers are not round, as triangles, alone or two, and a quadrangle.
    let mut random = random(4);
    for seed in 0..20 {
        let (u, v) = (DVec3::new(2.0, 0.1, 0.3), DVec3::new(-0.2, 2.0, 0.5));
        let nudge = random.in_cube() * 0.1;
        let corner = |s: f64, t: f64| nudge + s * u + t * v;
        let square = [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)];
        let [a, b, c, d] = square.map(|(s, t)| corner(s, t));
        let one = [corner(-3.0, -2.0), corner(3.0, -2.0), corner(0.0, 5.0)];
        let two = polygon(&[a, b, c], "white") + &polygon(&[a, c, d], "white");
        let (s, t) = (random.between(-0.1, 0.1), random.between(-0.1, 0.1));
        for (what, light, faces) in [
            ("a triangle", corner(s, t), polygon(&one, "white")),
            ("an edge", corner(s, s), two),
            ("a quadrangle", corner(s, t), polygon(&[a, b, c, d], "white")),
        ] {
            let scene = scene(&lamp(light.x, light.y, light.z), &faces);
            for (k, pixel) in picture(&scene, &settings(40, 40, 4)).into_iter().enumerate() {
                assert_eq!(pixel, BLACK, "{what}, {seed}: pixel {k}");
            }
        }
    }
    HardCase::LightOnSurface
        .tell("a light on a flat surface gives it nothing", "60 surfaces of 1600 pixels");
}

#[test]
fn a_light_on_a_sphere_gives_it_nothing_outside_or_inside() {
    for center in [DVec3::ZERO, DVec3::new(0.1, 0.2, 4.3)] {
        let mut random = random(6);
        for seed in 0..20 {
            let light = center + random.direction();
            let scene = scene(&lamp(light.x, light.y, light.z), &sphere(center, 1.0, "white"));
            for (k, pixel) in picture(&scene, &settings(40, 40, 4)).into_iter().enumerate() {
                assert_eq!(pixel, BLACK, "{seed}: pixel {k}");
            }
        }
    }
    HardCase::LightOnSurface
        .tell("a light on a sphere gives it nothing", "40 spheres of 1600 pixels");
}

#[test]
fn a_light_at_a_point_that_a_ray_hits_gives_it_nothing() {
    // The middle pixel's ray runs along z.
    let scene = scene(&lamp(0.0, 0.0, 0.0), &wall(0.0, 9.0, "white"));
    assert!(picture(&scene, &settings(41, 41, 1)).into_iter().all(|pixel| pixel == BLACK));
    HardCase::LightAtEyeOrHit.tell(
        "a light at the point that a ray hits gives it nothing",
        "1681 pixels, all dark and finite",
    );
}

#[test]
fn a_light_on_a_surface_still_lights_what_faces_it() {
    let lit = |light: f64| {
        let back = wall(-1.0, 9.0, "white");
        let scene = scene(&lamp(0.0, 0.0, light), &(back + &wall(0.0, 0.25, "red")));
        let seen = picture(&scene, &settings(41, 41, 1));
        (seen[20], seen[3])
    };
    // On the small wall that hangs before the large one: that one gets its light from z = 0.
    let (edge, corner) = lit(0.0);
    let point = |x: f64, y: f64| DVec3::new(x, y, -1.0);
    let at = |k: usize, l: usize| {
        let [x, y] = [k, l].map(|k| (2.0 * (k as f64 + 0.5) / 41.0 - 1.0) * 6.0 / 2.5);
        irradiance(DVec3::ZERO, point(x, -y), DVec3::Z) as f32
    };
    for (found, truth) in [(edge, at(20, 0)), (corner, at(3, 0))] {
        assert!((found[0] - truth).abs() < 1e-6 * truth, "{found:?}, truly {truth}");
    }
    HardCase::LightOnItsSurface.tell(
        "a light on a surface lights what faces it, without a shadow of that surface",
        "right within 1e-6",
    );
}

#[test]
fn a_light_inside_an_opaque_sphere_leaves_all_outside_exactly_dark() {
    let mut random = random(2);
    let side = side(10_000 / 4);
    for seed in 0..30 {
        let (center, radius) = (random.in_cube() * 0.3, random.between(0.2, 1.0));
        // From the middle to a hair's breadth under the skin.
        let depth = [0.0, 0.5, 0.999, 1.0 - 1e-9, 1.0 - 1e-12][seed % 5];
        let light = center + random.direction() * radius * depth;
        let geometry = wall(-1.5, 9.0, "white") + &sphere(center, radius, "white");
        let scene = scene(&lamp(light.x, light.y, light.z), &geometry);
        for (k, pixel) in picture(&scene, &settings(side, side, 4)).into_iter().enumerate() {
            assert_eq!(pixel, BLACK, "{seed}: pixel {k}");
        }
    }
    HardCase::LightInOpaqueSolid.tell(
        "outside an opaque sphere that holds a light all is exactly dark",
        format!("{} pixels", 30 * side * side),
    );
}

#[test]
fn a_light_inside_an_opaque_sphere_lights_all_of_its_inside() {
    let mut random = random(3);
    let side = side(10_000);
    for seed in 0..10 {
        let center = DVec3::new(0.0, 0.0, 5.0) + random.in_cube() * 0.3;
        let light = center + random.in_cube() * 0.5;
        let scene = scene(&lamp(light.x, light.y, light.z), &sphere(center, 1.5, "white"));
        for (k, pixel) in picture(&scene, &settings(side, side, 1)).into_iter().enumerate() {
            let point = point_on_sphere(&scene, side as u32, k, &scene.spheres[0]).unwrap();
            let truth = irradiance(light, point, (center - point).normalize());
            let error = (f64::from(pixel[0]) - truth).abs() / truth;
            assert!(error < 1e-6, "{seed}: pixel {k} is {pixel:?}, truly {truth}");
        }
    }
}

/// Opaque shells around a cavity that holds `middle`, told by name.
fn shells(middle: DVec3) -> Vec<(&'static str, String)> {
    let ball = |radius: f64| sphere(middle, radius, "white");
    let cube = |half: f64| upright(middle - half, middle + half, "white");
    let lid = upright(middle - 1.2, middle + DVec3::new(1.2, 0.1, 1.2), "white");
    let rest = upright(middle - DVec3::new(1.2, 0.1, 1.2), middle + 1.2, "white");
    vec![
        ("ball in ball", join("difference", &[&ball(1.2), &ball(0.9)])),
        ("ball in box", join("difference", &[&cube(1.2), &ball(0.9)])),
        ("box in ball", join("difference", &[&ball(1.6), &cube(0.9)])),
        ("box in box", join("difference", &[&cube(1.2), &cube(0.9)])),
        ("two halves", join("difference", &[&join("union", &[&lid, &rest]), &ball(0.9)])),
    ]
}

#[test]
fn a_light_inside_a_shell_of_a_solid_leaves_all_outside_exactly_dark() {
    let mut random = random(12);
    let side = side(1000);
    let mut count = 0;
    for seed in 0..20 {
        let middle = random.in_cube() * 0.3;
        for (what, shell) in shells(middle) {
            // From the middle to a hair's breadth before the wall, and inside the wall.
            let depth = [0.0, 0.5, 1.0 - 1e-9, 1.0 - 1e-12, 1.1][seed % 5];
            let light = middle + DVec3::AXES[seed % 3] * 0.9 * depth * random.sign();
            let geometry = wall(-3.0, 9.0, "white") + &shell;
            let scene = scene(&lamp(light.x, light.y, light.z), &geometry);
            for (k, pixel) in picture(&scene, &settings(side, side, 1)).into_iter().enumerate() {
                assert_eq!(pixel, BLACK, "{what}, {seed}: pixel {k}");
                count += 1;
            }
        }
    }
    HardCase::LightInOpaqueSolid
        .tell("outside a shell that holds a light all is exactly dark", format!("{count} places"));
}

#[test]
fn a_light_inside_a_shell_of_a_solid_lights_all_of_its_inside() {
    let mut random = random(13);
    let side = side(2000);
    let (mut count, mut worst) = (0, 0.0_f64);
    for seed in 0..10 {
        let middle = DVec3::new(0.0, 0.0, 5.0) + random.in_cube() * 0.2;
        let light = middle + random.in_cube() * 0.4;
        for (what, shell) in shells(middle) {
            let scene = scene(&lamp(light.x, light.y, light.z), &shell);
            let cavity = Sphere { center: middle, radius: 0.9, material: 0, primitive: 0 };
            let settings = settings(side, side, 1);
            for (k, pixel) in picture(&scene, &settings).into_iter().enumerate() {
                assert!(pixel[0] > 0.0, "{what}, {seed}: pixel {k} is dark");
                count += 1;
                if shell.contains("radius 0.9") {
                    let point = point_on_sphere(&scene, side as u32, k, &cavity).unwrap();
                    let truth = irradiance(light, point, (middle - point).normalize());
                    worst = worst.max((f64::from(pixel[0]) - truth).abs() / truth);
                }
            }
        }
    }
    HardCase::LightInOpaqueSolid.tell(
        "inside a shell that holds a light all is lit",
        format!("{count} places, in round cavities right within {worst:.1e}"),
    );
    assert!(worst < 1e-6);
}

#[test]
fn a_light_at_the_eye_leaves_no_shadow_to_be_seen() {
    let geometry = wall(-1.0, 9.0, "white") + &wall(0.5, 0.7, "white");
    let scene = scene(&lamp(0.0, 0.0, 5.0), &geometry);
    let settings = settings(64, 64, 1);
    let seen = picture(&scene, &settings);
    for (k, pixel) in seen.into_iter().enumerate() {
        let (x, y) = ((k % 64) as f64 + 0.5, (k / 64) as f64 + 0.5);
        let direction = eye_direction(&scene.viewport.unwrap(), settings.size, x, y);
        let on_screen = direction / -direction.z;
        let depth = if on_screen.truncate().abs().max_element() * 4.5 < 0.7 { 4.5 } else { 6.0 };
        let truth = 1.0 / (depth * depth) / on_screen.length().powi(3);
        let error = (f64::from(pixel[0]) - truth).abs() / truth;
        assert!(error < 1e-6, "pixel {k} is {pixel:?}, truly {truth}");
    }
    HardCase::LightAtEyeOrHit
        .tell("a light at the eye leaves no shadow to be seen", "4096 pixels, right within 1e-6");
}

#[test]
fn a_sphere_has_no_acne_up_to_its_terminator() {
    for (what, z, radius, light) in [
        ("plain", 5.0, 1.5, DVec3::new(9.0, 3.0, 1.0)),
        ("lit from behind", 5.0, 1.5, DVec3::new(4.0, 0.0, -3.0)),
        ("light near", 5.0, 1.5, DVec3::new(1.2, 1.2, 0.3)),
        ("seen from afar", 1e6, 1e5, DVec3::new(2e5, 1e5, 1e5)),
        ("huge", 1e7 + 3.0, 1e7, DVec3::new(-3.0, 0.0, 1e7 + 0.01)),
    ] {
        let geometry = sphere(DVec3::ZERO, radius, "white");
        let mut scene = seen_from(z, &lamp(light.x, light.y, light.z), &geometry);
        scene.lights[0].intensity *= light.length_squared();
        let mut lit = 0;
        for (k, pixel) in picture(&scene, &settings(96, 96, 1)).into_iter().enumerate() {
            let Some(point) = point_on_sphere(&scene, 96, k, &scene.spheres[0]) else { continue };
            let truth = irradiance(light, point, point / radius) * light.length_squared();
            lit += u32::from(truth > 0.0);
            // The angle of the light to the surface is known as well as the place of either.
            let distance = light.distance(point);
            let angle = 8.0 * f64::EPSILON * z.max(light.length()) / distance;
            let blur = 1e-6 * truth + angle * light.length_squared() / (distance * distance);
            let error = (f64::from(pixel[0]) - truth).abs();
            assert!(error <= blur, "{what}: pixel {k} is {pixel:?}, truly {truth}");
        }
        assert!(lit > 50, "{what}: {lit} pixels are lit");
    }
    HardCase::Terminator.tell(
        "a sphere has no acne up to its terminator",
        "5 spheres of 9216 pixels, no wrong pixel",
    );
}

/// Of faces in one place only the first is seen, without speckles or acne: the picture is that of
/// the first alone.
fn check_first_wins(what: &str, first: &str, others: &str) {
    let lights = lamp(1.0, 2.0, 4.0) + &lamp(-2.0, -1.0, 3.0) + &lamp(0.5, 0.0, -3.0);
    let both = scene(&lights, &(first.to_owned() + others));
    let alone = scene(&lights, first);
    let settings = settings(80, 80, 2);
    let mut covered = 0;
    for (k, (both, alone)) in
        picture(&both, &settings).into_iter().zip(picture(&alone, &settings)).enumerate()
    {
        covered += u32::from(alone != BLACK);
        let is_same = both.iter().zip(alone).all(|(b, a)| (b - a).abs() <= 1e-6 * a.max(1.0));
        assert!(is_same, "{what}: pixel {k} is {both:?}, not {alone:?}");
    }
    assert!(covered > 200, "{what}: {covered} pixels are covered");
}

/// The corners of a square, round numbers first, then tilted in the second half.
fn squares() -> Vec<(String, [DVec3; 4])> {
    let mut random = random(9);
    let square = |place: DVec3, u: DVec3, v: DVec3| [place, place + u, place + u + v, place + v];
    let straight = square(DVec3::new(-1.0, -1.0, 0.0), DVec3::X * 2.0, DVec3::Y * 2.0);
    let round = square(DVec3::new(-1.0, -1.0, 0.5), DVec3::new(2.0, 0.25, -1.0), DVec3::Y * 2.0);
    let mut squares = vec![("straight".to_owned(), straight), ("round".to_owned(), round)];
    for k in 0..20 {
        let (u, v) = (DVec3::X * 2.0 + random.in_cube(), DVec3::Y * 2.0 + random.in_cube());
        let place = random.in_cube() * 0.2 - (u + v) / 2.0;
        squares.push((format!("tilted {k}"), square(place, u, v)));
    }
    squares
}

#[test]
fn the_first_of_equal_spheres_wins() {
    let mut random = random(8);
    for _ in 0..5 {
        let (center, radius) = (random.in_cube() * 0.5, random.between(0.5, 1.5));
        let [red, green] = ["red", "green"].map(|material| sphere(center, radius, material));
        check_first_wins("spheres", &red, &(green.clone() + &green));
        check_first_wins("spheres", &green, &red);
    }
    HardCase::CoincidentFaces
        .tell("of equal spheres the first is seen", "10 pictures, no wrong pixel");
}

#[test]
fn the_first_of_equal_triangles_wins_wherever_its_corners_begin() {
    for (what, [a, b, c, _]) in squares() {
        let copies = polygon(&[b, c, a], "green")
            + &polygon(&[c, a, b], "white")
            + &polygon(&[c, b, a], "green");
        check_first_wins(&what, &polygon(&[a, b, c], "red"), &copies);
        check_first_wins(&what, &polygon(&[a, c, b], "red"), &copies);
    }
    HardCase::CoincidentFaces
        .tell("of equal triangles the first is seen", "44 pictures, no wrong pixel");
}

#[test]
fn the_first_of_equal_quadrangles_wins_wherever_its_corners_begin() {
    for (what, [a, b, c, d]) in squares() {
        let copies = polygon(&[b, c, d, a], "green") + &polygon(&[d, c, b, a], "white");
        check_first_wins(&what, &polygon(&[a, b, c, d], "red"), &copies);
    }
    HardCase::CoincidentFaces
        .tell("of equal quadrangles the first is seen", "22 pictures, no wrong pixel");
}

#[test]
fn the_first_wins_of_a_quadrangle_and_triangles_over_it() {
    for (what, [a, b, c, d]) in squares() {
        let quadrangle = polygon(&[a, b, c, d], "red");
        let triangles = polygon(&[a, b, c], "green") + &polygon(&[c, d, a], "green");
        check_first_wins(&what, &quadrangle, &triangles);
        check_first_wins(&what, &triangles, &quadrangle);
        // A label: smaller, inside, the other way round.
        let middle = (a + c) / 2.0;
        let label = [b, a, d].map(|corner| middle + (corner - middle) / 4.0);
        check_first_wins(&what, &quadrangle, &polygon(&label, "white"));
    }
    HardCase::CoincidentFaces.tell(
        "of a quadrangle and triangles over it the first is seen",
        "66 pictures, no wrong pixel",
    );
}

/// Labels are seen from so far away.
const LABEL_DISTANCE: f64 = 0.5;

/// A wall and a label on it, in thousandths, so that both are in one plane in decimals. For each
/// unit of `apart` the label is moved by a rounding: of the coordinates across the plane, or of
/// what a ray measures if that is more, its own length and its start's distance from the middle of
/// the wall.
fn wall_and_label(random: &mut Random, apart: f64) -> ([DVec3; 4], [DVec3; 4]) {
    let whole = |size: f64, random: &mut Random| (random.in_cube() * size).round();
    let place = whole(900.0, random);
    // Both are multiples of 8: a label may begin and end at eighths.
    let (u, v) = loop {
        let (u, v) = (8.0 * whole(100.0, random), 8.0 * whole(100.0, random));
        if u.cross(v).length() > 0.3 * u.length() * v.length() {
            break (u, v);
        }
    };
    let normal = u.cross(v).normalize();
    let at = |s: f64, t: f64| (place + u * (s / 8.0) + v * (t / 8.0)) / 1000.0;
    let square = |from: f64, to: f64| [at(from, from), at(to, from), at(to, to), at(from, to)];
    let wall = square(0.0, 8.0);
    let extent = wall.iter().fold(DVec3::ZERO, |most, corner| most.max(corner.abs()));
    let label = square(3.0, 5.0);
    let half = label[0].distance(label[2]).max(label[1].distance(label[3])) / 2.0;
    let rounding = f64::EPSILON / 2.0 * normal.abs().dot(extent).max(half + 2.0 * LABEL_DISTANCE);
    (wall, label.map(|corner| corner + apart * rounding * normal))
}

fn quadrangles(faces: [[DVec3; 4]; 2]) -> Scene {
    let mut scene = scene("", "");
    scene.quadrangles = (0..)
        .zip(faces)
        .map(|(primitive, vertices)| Quadrangle { vertices, material: 0, primitive })
        .collect();
    scene
}

/// Rays at inner places of a label, from the side that its normal points to times `side`.
fn rays_at_label(label: &[DVec3; 4], side: f64, random: &mut Random) -> Vec<Probe> {
    let [a, b, _, d] = *label;
    let (u, v) = (b - a, d - a);
    let normal = side * u.cross(v).normalize();
    (0..100)
        .map(|_| {
            let place = a + u * random.between(0.01, 0.99) + v * random.between(0.01, 0.99);
            let away = (normal + random.in_cube() * 0.5).normalize();
            Probe { origin: place + away * LABEL_DISTANCE, direction: -away, leaving: None }
        })
        .collect()
}

#[test]
fn a_label_in_a_tilted_wall_has_no_speckles_whichever_comes_first() {
    let mut random = random(71);
    let mut count = 0;
    while count < rays(100_000) {
        let (wall, label) = wall_and_label(&mut random, 0.0);
        for faces in [[wall, label], [label, wall]] {
            let block = prepared(&quadrangles(faces));
            for side in [1.0, -1.0] {
                let probes = rays_at_label(&label, side, &mut random);
                let hits = block.probe(&probes, Isa::fastest());
                assert!(hits.iter().all(|hit| hit.is_some_and(|hit| hit.primitive == 0)));
                count += probes.len();
            }
        }
    }
    HardCase::LabelWithinRounding.tell(
        "of a label and its tilted wall the first is seen",
        format!("{count} rays, no speckle"),
    );
}

#[test]
fn a_label_sixteen_roundings_before_its_wall_stays_there() {
    let mut random = random(72);
    let (mut count, mut wrong) = (0, 0);
    while count < rays(100_000) {
        let (wall, label) = wall_and_label(&mut random, 16.0);
        let block = prepared(&quadrangles([wall, label]));
        for (side, seen) in [(1.0, 1), (-1.0, 0)] {
            let probes = rays_at_label(&label, side, &mut random);
            for hit in block.probe(&probes, Isa::fastest()) {
                wrong += usize::from(hit.unwrap().primitive != seen);
                count += 1;
            }
        }
    }
    HardCase::LabelWithinRounding.tell(
        "a label 16 roundings before its wall is before it",
        format!("{count} rays, {wrong} see the other"),
    );
    assert_eq!(wrong, 0);
}

#[test]
fn of_planes_that_are_nearly_one_the_nearer_is_seen_and_shades_the_other() {
    for (near, far) in [("red", "green"), ("green", "red")] {
        let far = wall(0.0, 1.0, far);
        let near = wall(1e-7, 1.0, near);
        // In front, behind and grazing: the eye's side alone is lit.
        let lights = lamp(0.5, 0.2, 3.0) + &lamp(0.0, 0.0, -3.0) + &lamp(-4.0, 0.0, 0.02);
        let settings = settings(80, 80, 2);
        let both = picture(&scene(&lights, &(far + &near)), &settings);
        let alone = picture(&scene(&lights, &near), &settings);
        assert!(both == alone);
    }
    HardCase::NearParallelPlanes
        .tell("of planes 1e-7 apart the nearer is seen and lit", "12 800 pixels, no wrong pixel");
}

#[test]
fn a_sky_of_a_hundred_million_is_seen() {
    let sky = sphere(DVec3::ZERO, 1e8, "green") + &sphere(DVec3::ZERO, 1.0, "red");
    let scene = scene("ambient 0.5 ", &sky);
    let seen = picture(&scene, &settings(64, 64, 1));
    let red = seen.iter().filter(|pixel| **pixel == [0.5, 0.0, 0.0]).count();
    let green = seen.iter().filter(|pixel| **pixel == [0.0, 0.5, 0.0]).count();
    assert_eq!((seen[0], seen[32 * 64 + 32]), ([0.0, 0.5, 0.0], [0.5, 0.0, 0.0]));
    assert_eq!(red + green, seen.len());
    HardCase::HugeSky.tell("a sky of 1e8 is seen", "4096 pixels, no wrong pixel");
}

/// The six sides of a cube around the eye of [`scene`], turned outwards.
fn room(half: f64) -> String {
    let mut text = String::new();
    for axis in 0..3 {
        for side in [-1.0, 1.0] {
            let (mut n, mut u, mut v) = (DVec3::ZERO, DVec3::ZERO, DVec3::ZERO);
            (n[axis], u[(axis + 1) % 3], v[(axis + 2) % 3]) = (half * side, half * side, half);
            let corners = [n - u - v, n + u - v, n + u + v, n - u + v];
            text += &polygon(&corners.map(|corner| corner + DVec3::Z * 5.0), "white");
        }
    }
    text
}

#[test]
fn inside_a_closed_solid_no_light_from_outside_is_seen() {
    for walls in [room(1.0), sphere(DVec3::Z * 5.0, 1.0, "white")] {
        let outside = lamp(3.0, 4.0, 9.0) + &lamp(0.0, 0.0, 3.5) + &lamp(1.001, 1.001, 6.001);
        let seen = picture(&scene(&outside, &walls), &settings(64, 64, 4));
        assert!(seen.into_iter().all(|pixel| pixel == BLACK));
        let inside = lamp(0.3, 0.2, 5.1);
        let seen = picture(&scene(&inside, &walls), &settings(64, 64, 4));
        assert!(seen.into_iter().all(|pixel| pixel[0] > 0.1), "an inner side is dark");
    }
}

#[test]
fn a_needle_of_a_quadrangle_is_whole() {
    for width in [1e-3, 1e-6, 1e-9, 1e-12] {
        // The screen is as narrow as the needle and shows it with a margin of a quarter.
        let mut scene = scene("", &wall(0.0, 1.0, "white"));
        let stretch = |point: DVec3| DVec3::new(point.x * width, point.y, point.z);
        let face = &mut scene.quadrangles[0];
        face.vertices = face.vertices.map(stretch);
        let viewport = scene.viewport.as_mut().unwrap();
        for corner in [&mut viewport.top_left, &mut viewport.bottom_left, &mut viewport.top_right] {
            *corner = stretch(*corner);
        }
        let seen = picture(&scene, &settings(64, 64, 1));
        let white = seen.iter().filter(|pixel| **pixel == [1.0; 3]).count();
        // At z = 0 the screen is 4 x 4: the needle takes the middle half of it.
        assert_eq!(white, 32 * 32, "{width}");
    }
    HardCase::Needle.tell("needles of quadrangles down to 1e-12 wide are whole", "no pixel lacks");
}

/// The faces of boxes without thickness and rays that run in their planes or straight at them.
#[test]
fn rays_along_the_axes_meet_flat_boxes_whatever_the_sign_of_their_zeros() {
    let mut faces = Scene { viewport: scene("", "").viewport, ..scene("", &wall(0.0, 1.0, "red")) };
    faces.quadrangles.clear();
    let mut primitive = 0;
    for axis in 0..3 {
        for place in [-1.0, 0.0, 0.5] {
            let (mut n, mut u, mut v) = (DVec3::ZERO, DVec3::ZERO, DVec3::ZERO);
            (n[axis], u[(axis + 1) % 3], v[(axis + 2) % 3]) = (place, 1.0, 1.0);
            let vertices = [n - u - v, n + u - v, n + u + v, n - u + v];
            faces.quadrangles.push(Quadrangle { vertices, material: 0, primitive });
            primitive += 1;
        }
    }
    let (block, oracle) = (prepared(&faces), Oracle::new(&faces));
    let mut probes = Vec::new();
    let places = [-1.0, 0.0, 0.25];
    for index in 0..27 {
        let place = [0, 1, 2].map(|axis| places[index / 3_usize.pow(axis) % 3]);
        for axis in 0..3 {
            for (ahead, zero) in [(1.0, 0.0), (1.0, -0.0), (-1.0, 0.0), (-1.0, -0.0)] {
                let mut direction = DVec3::splat(zero);
                direction[axis] = ahead;
                for back in [0.0, 3.0] {
                    let origin = DVec3::from_array(place) - back * ahead * DVec3::AXES[axis];
                    probes.push(Probe { origin, direction, leaving: None });
                }
            }
        }
    }
    let brute = block.probe_all_faces(&probes);
    for isa in Isa::ALL.into_iter().filter(|isa| isa.is_supported()) {
        assert_eq!(block.probe(&probes, isa), brute, "{isa}");
    }
    for (probe, found) in probes.iter().zip(brute) {
        let with_plus = Probe { direction: probe.direction + 0.0, ..*probe };
        assert_eq!(block.probe_all_faces(&[with_plus]), [found], "{probe:?}");
        let truth = oracle.first_hit(probe.origin, probe.direction, None);
        let clear = truth.is_none_or(|hit| hit.margin > 0.0)
            && (truth.is_some() || oracle.miss_margin(probe.origin, probe.direction, None) > 0.0);
        if clear {
            let truth = truth.map(|hit| (hit.t, hit.id.primitive));
            assert_eq!(found.map(|hit| (hit.t, hit.primitive)), truth, "{probe:?}");
        }
    }
    let count = format!("{} rays, with every instruction set", probes.len());
    HardCase::AxisParallelRay
        .tell("rays along the axes, from the planes of boxes, meet what they should", &count);
    HardCase::NegativeZero.tell("a zero with a sign gives the hits of one without", &count);
    HardCase::FlatBox.tell("boxes without thickness are met", count);
}

#[test]
fn pictures_may_be_one_pixel_or_as_wide_as_can_be() {
    let scene = scene("", &wall(0.0, 1.0, "red"));
    assert_eq!(picture(&scene, &settings(1, 1, 1)), [[1.0, 0.0, 0.0]]);
    for (width, height) in [(65_535, 1), (1, 65_535)] {
        let seen = picture(&scene, &settings(width, height, 1));
        let red = seen.iter().filter(|pixel| pixel[0] == 1.0).count();
        // The middle half; the middles of no pixels lie on its border.
        assert_eq!(red, 32_767, "{width} x {height}");
        let settings = settings(width, height, 1);
        let corner = [width as u32 - 1, height as u32 - 1];
        let corner = Area::new(settings.size, corner, [1, 1]).unwrap();
        let last = pixels(&prepared(&scene), &settings, corner);
        assert_eq!(last, [BLACK]);
    }
    HardCase::ExtremePictureSizes
        .tell("pictures of 1 x 1, 65 535 x 1 and 1 x 65 535 are right", "no wrong pixel");
}

/// A sphere of some size somewhere, alone or the only part of a solid.
struct Ball {
    block: PreparedScene<PreparedBytes>,
    center: DVec3,
    radius: f64,
    /// How far off its place rounding may put a point on it, in radii.
    blur: f64,
    is_solid: bool,
}

fn balls(random: &mut Random) -> Vec<Ball> {
    let ball = |k: usize| {
        let center = random.in_cube() * [0.0, 1.0, 1e3, 1e6][k % 4];
        let radius = random.log_uniform(1e-3, 1e3);
        let is_solid = k % 8 >= 4;
        let mut geometry = sphere(center, radius, "white");
        if is_solid {
            let around = upright(center - 2.0 * radius, center + 2.0 * radius, "red");
            geometry = join("intersection", &[&geometry, &around]);
        }
        let block = prepared(&scene("", &geometry));
        // A solid's crossings are told apart on the scale of the whole scene, with its eye at 5.
        let scale = center.abs().max_element().max(if is_solid { 8.0 } else { 0.0 });
        let blur = 16.0 * f64::EPSILON * (1.0 + scale / radius);
        Ball { block, center, radius, blur, is_solid }
    };
    (0..40).map(ball).collect()
}

#[test]
fn a_ray_from_inside_a_sphere_goes_out_once() {
    let mut random = random(16);
    let (mut count, mut worst) = (0, 0.0_f64);
    for ball in balls(&mut random) {
        let probes: Vec<Probe> = (0..rays(100_000) / 40)
            .map(|k| {
                // Down to where rounding would put it outside.
                let depth = random.log_uniform(4.0 * ball.blur, 1.0);
                let share = if k % 2 == 0 { 1.0 - depth } else { random.unit() * (1.0 - depth) };
                let origin = ball.center + random.direction() * ball.radius * share;
                Probe { origin, direction: random.direction(), leaving: None }
            })
            .collect();
        assert!(ball.block.count_crossings(&probes).into_iter().all(|crossings| crossings == 1));
        for (probe, hit) in probes.iter().zip(ball.block.probe(&probes, Isa::fastest())) {
            let hit = hit.unwrap_or_else(|| panic!("{probe:?} never leaves"));
            let point = probe.origin + hit.t * probe.direction;
            let height = (point.distance(ball.center) / ball.radius - 1.0).abs();
            worst = worst.max(height / ball.blur);
            let leaving = Some((hit.primitive, hit.face));
            let on = Probe { origin: point, leaving, ..*probe };
            assert_eq!(ball.block.probe(&[on], Isa::fastest()), [None], "{probe:?}");
            count += 1;
        }
    }
    HardCase::InsideSphere.tell(
        "a ray from inside a sphere goes out once",
        format!("{count} rays, at {:.1} ulp of it or nearer", 16.0 * worst),
    );
    assert!(worst < 1.0);
}

/// Rays that start on spheres, from the places that the tracer finds there, and how fast each goes
/// outwards: from straight out to all but along the sphere.
fn starts_on(ball: &Ball, random: &mut Random, count: usize, ahead: f64) -> Vec<(Probe, f64)> {
    let outside: Vec<Probe> = (0..count)
        .map(|_| {
            let target = ball.center + random.in_cube() * ball.radius * 0.57;
            let origin = ball.center + random.direction() * ball.radius * 5.0;
            Probe { origin, direction: (target - origin).normalize(), leaving: None }
        })
        .collect();
    let hits = ball.block.probe(&outside, Isa::fastest());
    let start = |(probe, hit): (&Probe, Option<rtfarm_core::testing::ProbeHit>)| {
        let hit = hit.expect("a ray at the middle of a ball");
        let origin = probe.origin + hit.t * probe.direction;
        let outward = (origin - ball.center).normalize();
        let aside = outward.any_orthonormal_vector();
        // Where the ends of a solid's stretch cannot be told apart it is nothing.
        let least = if ball.is_solid { ball.blur.sqrt() } else { 1e-15 };
        let sine = random.log_uniform(least, 1.0);
        let cosine = ((1.0 - sine) * (1.0 + sine)).sqrt();
        let direction = (ahead * sine * outward + cosine * aside).normalize();
        let leaving = Some((hit.primitive, hit.face));
        (Probe { origin, direction, leaving }, (origin - ball.center).dot(direction))
    };
    outside.iter().zip(hits).map(start).collect()
}

#[test]
fn a_ray_that_leaves_a_sphere_outwards_never_meets_it_again() {
    let mut random = random(17);
    let (mut count, mut grazing) = (0, 0);
    for ball in balls(&mut random) {
        let starts = starts_on(&ball, &mut random, rays(100_000) / 40, 1.0);
        let probes: Vec<Probe> =
            starts.iter().filter(|start| start.1 >= 0.0).map(|start| start.0).collect();
        let hits = ball.block.probe(&probes, Isa::fastest());
        let self_hits = hits.iter().filter(|hit| hit.is_some()).count();
        assert_eq!(self_hits, 0, "of a radius of {} at {}", ball.radius, ball.center);
        count += probes.len();
        grazing += starts.iter().filter(|start| start.1.abs() < 1e-6 * ball.radius).count();
    }
    HardCase::LeavingSphereOutward.tell(
        "a ray that leaves a sphere outwards never meets it",
        format!("0 of {count} rays, {grazing} of them grazing"),
    );
    assert!(count > rays(95_000));
}

#[test]
fn a_ray_that_leaves_a_sphere_inwards_always_meets_its_other_side() {
    let mut random = random(18);
    let (mut count, mut worst) = (0, 0.0_f64);
    for ball in balls(&mut random) {
        let starts = starts_on(&ball, &mut random, rays(100_000) / 40, -1.0);
        let starts: Vec<_> = starts.into_iter().filter(|start| start.1 < 0.0).collect();
        let probes: Vec<Probe> = starts.iter().map(|start| start.0).collect();
        let hits = ball.block.probe(&probes, Isa::fastest());
        let lost = hits.iter().filter(|hit| hit.is_none()).count();
        assert_eq!(lost, 0, "of a radius of {} at {}", ball.radius, ball.center);
        for (probe, hit) in probes.iter().zip(hits) {
            let t = hit.expect("none is lost").t;
            let end = (probe.origin + t * probe.direction).distance(ball.center);
            worst = worst.max((end / ball.radius - 1.0).abs() / ball.blur);
            assert!(t > 0.0, "{probe:?}");
            count += 1;
        }
    }
    HardCase::LeavingSphereInward.tell(
        "a ray that leaves a sphere inwards meets its other side",
        format!("0 of {count} lost; they end within {:.1} ulp of it", 16.0 * worst),
    );
    assert!(worst < 1.0);
}

#[test]
fn a_ray_mirrored_a_thousand_times_inside_a_ball_keeps_its_chord() {
    let mut random = random(19);
    let (mut count, mut worst) = (0, 0.0_f64);
    for _ in 0..rays(100_000) / 1000 {
        let (center, radius) = (random.in_cube(), random.between(0.5, 2.0));
        let block = prepared(&scene("", &sphere(center, radius, "white")));
        let [origin, direction] = [0.9 * radius * random.in_cube() * 0.57, random.direction()];
        let mut ray = Probe { origin: center + origin, direction, leaving: None };
        let chord = {
            let aside = origin - origin.dot(direction) * direction;
            2.0 * ((radius - aside.length()) * (radius + aside.length())).sqrt()
        };
        for bounce in 0..1000 {
            let hit = block.probe(&[ray], Isa::fastest())[0].expect("a ray in a closed ball");
            if bounce > 0 {
                worst = worst.max((hit.t - chord).abs() / radius);
            }
            let origin = ray.origin + hit.t * ray.direction;
            let normal = (origin - center).normalize();
            let mirrored = ray.direction - 2.0 * ray.direction.dot(normal) * normal;
            let leaving = Some((hit.primitive, hit.face));
            ray = Probe { origin, direction: mirrored.normalize(), leaving };
            count += 1;
        }
    }
    eprintln!("{count} bounces, none lost; chords drift by {worst:.1e} of the radius");
    assert!(worst < 1e-11);
}
