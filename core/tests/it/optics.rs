//! Mirrors, glass and the shadow of glass against closed forms.

#![expect(clippy::float_cmp, reason = "what holds exactly is tested exactly")]

use std::{fmt::Write, ops::ControlFlow, sync::Arc};

use glam::DVec3;
use rtfarm_core::{
    isa::Isa,
    render::{RenderedTile, render_tile},
    scene::{Mesh, MeshShape, MeshVertices, Scene},
};
use rtfarm_oracle::{
    Settings as OracleSettings,
    closed_forms::irradiance,
    eye_direction,
    hard_case::{HardCase, few_rays, random, rays},
    reference_picture,
};

use crate::support::{
    parts::{join, sphere, upright},
    studio::{picture, pixels, prepared, read, settings, tree_picture, whole},
};

/// A screen of 2 x 2 at z = 2.5, seen from z = 5.
const VIEWPORT: &str = "viewport origin 0 0 5 topleft -1 1 2.5 bottomleft -1 -1 2.5
    topright 1 1 2.5 endviewport ";

fn scene(materials: &str, lights: &str, geometry: &str) -> Scene {
    read(&format!(
        "{VIEWPORT} materials entry name white endentry entry name red color 255 0 0 endentry
        {materials} endmaterials lights {lights} endlights geometry {geometry} endgeometry"
    ))
}

/// A square at this z; its front looks to the eye or away from it.
fn pane(z: f64, half: f64, to_eye: bool, material: &str) -> String {
    let y = if to_eye { half } else { -half };
    format!(
        "quadrangle vertex {:?} {:?} {z:?} vertex {half:?} {:?} {z:?} vertex {half:?} {y:?} {z:?}
        vertex {:?} {y:?} {z:?} material {material} endquadrangle ",
        -half, -y, -y, -half
    )
}

fn rendered(scene: &Scene, side: u64) -> RenderedTile {
    let settings = settings(side, side, 1);
    let go_on = &mut || ControlFlow::Continue(());
    render_tile(&prepared(scene), &settings.quality, whole(settings.size), Isa::fastest(), go_on)
        .unwrap()
}

/// The same without roulette.
fn tree(scene: &Scene, side: u64) -> Vec<[f32; 3]> {
    tree_picture(scene, &settings(side, side, 1))
}

fn side() -> u64 {
    side_of(100_000)
}

/// The side of a picture that takes this many rays, or more if asked for.
fn side_of(count: usize) -> u64 {
    rays(count).isqrt() as u64
}

#[test]
fn a_mirror_shows_the_mirrored_scene() {
    for seed in 0..5 {
        let mut random = random(seed);
        let mut things = Vec::new();
        for _ in 0..12 {
            let place = DVec3::new(0.0, 0.0, 9.0) + random.in_cube() * 3.0;
            things.push((place, random.between(0.2, 0.9), random.chance(0.5)));
        }
        let glass = "entry name glass color 100 200 50 alpha 0.3 refract 0.7 endentry
            entry name mirror reflect 1 endentry ";
        let geometry = |sign: f64| -> String {
            let thing = |&(place, size, is_round): &(DVec3, f64, bool)| {
                let place = place * DVec3::new(1.0, 1.0, sign);
                if is_round {
                    return sphere(place, size, "glass");
                }
                let cube = upright(place - size, place + size, "red");
                join("difference", &[&cube, &sphere(place, size * 1.2, "white")])
            };
            things.iter().map(thing).collect()
        };
        let lights =
            |sign: f64| format!("ambient 0.2 point coords 1 5 {:?} power 9 endpoint", 7.0 * sign);
        let mirror = pane(0.0, 1e3, true, "mirror");
        let mirrored = tree(&scene(glass, &lights(1.0), &(mirror + &geometry(1.0))), side() / 2);
        let straight = tree(&scene(glass, &lights(-1.0), &geometry(-1.0)), side() / 2);
        assert!(straight.iter().filter(|pixel| **pixel != [0.0; 3]).count() > 1000);
        for (k, (m, s)) in mirrored.iter().zip(&straight).enumerate() {
            let is_same = m.iter().zip(s).all(|(m, s)| (m - s).abs() <= 1e-6 * s.max(1.0));
            assert!(is_same, "{seed}: pixel {k} is {m:?}, not {s:?}");
        }
    }
}

#[test]
fn a_white_world_stays_white_whatever_mirrors_and_bends() {
    let mut random = random(7);
    for seed in 0..10 {
        let mut materials = String::new();
        for (name, reflect) in [("a", 0.0), ("b", 0.4), ("c", 0.1)] {
            let (alpha, ratio) = (random.unit(), random.between(0.4, 2.5));
            write!(
                materials,
                "entry name {name} alpha {alpha:?} reflect {reflect:?} refract {ratio:?} endentry "
            )
            .unwrap();
        }
        let geometry = sphere(random.in_cube(), 1.5, "a")
            + &upright(random.in_cube() - 1.5, random.in_cube() + 1.0, "b")
            + &sphere(DVec3::new(0.0, 0.0, 5.0), 0.7, "c");
        let mut scene = scene(&materials, "ambient 1", &geometry);
        scene.background = DVec3::ONE;
        for pixel in tree(&scene, 100) {
            assert!((f64::from(pixel[0]) - 1.0).abs() < 1e-6, "{seed}: {pixel:?}");
        }
    }
}

#[test]
fn a_ratio_of_one_bends_nothing_to_the_bit() {
    let with = |refract: &str| {
        let glass = format!("entry name glass alpha 0.3 reflect 0.1 {refract} endentry");
        let things = sphere(DVec3::ZERO, 1.0, "glass")
            + &upright(DVec3::new(-0.3, -1.4, -1.0), DVec3::new(1.3, 0.2, 1.5), "glass")
            + &pane(-2.0, 1.5, true, "red");
        rendered(&scene(&glass, "ambient 0.5 point coords 3 3 4 power 9 endpoint", &things), side())
    };
    assert!(with("refract 1") == with("") && with("refract 0") == with(""));
    HardCase::RatioOfOne.tell("a ratio of 1 bends nothing to the bit", "no wrong pixel");
}

#[test]
fn turning_a_pane_around_inverts_its_ratio() {
    let with = |ratio: &str, to_eye: bool| {
        let glass = format!("entry name glass alpha 0.25 refract {ratio} endentry");
        let things = pane(1.0, 1.0, to_eye, "glass")
            + &sphere(DVec3::new(0.3, 0.2, -1.0), 1.0, "red")
            + &sphere(DVec3::new(-0.7, 0.2, -2.0), 0.5, "white");
        rendered(&scene(&glass, "ambient 0.5", &things), side())
    };
    assert!(with("2", true) == with("0.5", false));
    assert!(with("2", true) != with("2", false));
}

/// How far from a plane at z = -`depth` a ray from the eye through glass at its start ends up from
/// where it is expected, found by the light that a lamp close by throws on it.
fn check_arrival(what: &str, glass: &str, geometry: &str, x: f64, expect: impl Fn(DVec3) -> DVec3) {
    let viewport = format!(
        "viewport origin 0 0 5 topleft {:?} 0.0005 4 bottomleft {:?} -0.0005 4
        topright {:?} 0.0005 4 endviewport",
        x - 0.0005,
        x - 0.0005,
        x + 0.0005
    );
    let settings = settings(1, 1, 1);
    let bare = read(&viewport).viewport.unwrap();
    // One sample lies in the pixel's middle.
    let direction = eye_direction(&bare, settings.size, 0.5, 0.5).normalize();
    let target = expect(direction);
    // Aside, so that the light grows as the ray comes nearer.
    let lamp = target + DVec3::new(0.7, 0.4, 1.0);
    let wall = pane(target.z, 1e9, true, "white");
    let scene = read(&format!(
        "{viewport} materials entry name white endentry entry name glass {glass} endentry
        endmaterials lights point coords {:?} {:?} {:?} power 1 endpoint endlights
        geometry {geometry} {wall} endgeometry",
        lamp.x, lamp.y, lamp.z
    ));
    let found = f64::from(picture(&scene, &settings)[0][0]);
    let truth = irradiance(lamp, target, DVec3::Z);
    assert!((found / truth - 1.0).abs() < 1e-6, "{what} at {x}: {found}, truly {truth}");
}

#[test]
fn a_slab_of_glass_shifts_a_ray_and_keeps_its_direction() {
    // A direction off by 1e-13 misses its place at 1e7 by 1e-6.
    for (ratio, thickness) in [(0.625, 1.0), (0.9, 0.3), (1.25, 0.5)] {
        for k in 0..40 {
            let slab = upright(
                DVec3::new(-1e3, -1e3, 1.0),
                DVec3::new(1e3, 1e3, 1.0 + thickness),
                "glass",
            );
            let x = 0.0007 + f64::from(k) * 0.03;
            check_arrival("slab", &format!("refract {ratio:?}"), &slab, x, |direction| {
                let straight = DVec3::new(0.0, 0.0, 5.0) + direction * (1e7 / -direction.z);
                let sine = direction.truncate().length();
                let bent = ratio * sine;
                let (cosine, bent_cosine) =
                    ((1.0 - sine * sine).sqrt(), (1.0 - bent * bent).sqrt());
                // T sin(θ - θt) / cos θt across the ray, 1 / cos θ of that across the slab.
                let shift = thickness * (sine * bent_cosine - cosine * bent) / bent_cosine / cosine;
                straight - (direction.truncate() / sine * shift).extend(0.0)
            });
        }
    }
}

#[test]
fn the_shadow_of_glass_is_the_product_of_what_its_faces_let_through() {
    let glass = "entry name glass alpha 0.3 reflect 0.2 endentry
        entry name tinted color 0 0 255 alpha 0.6 endentry";
    let (clear, tinted) = (0.7 * 0.8, 0.4);
    let large = |z, material: &str| pane(z, 50.0, true, material);
    let ball = sphere(DVec3::new(0.0, 0.0, 50.0), 20.0, "glass");
    let solid = join("union", &[&ball, &sphere(DVec3::new(0.0, 0.0, 55.0), 20.0, "glass")]);
    for (what, between, share) in [
        ("two panes", large(40.0, "glass") + &large(41.0, "tinted"), clear * tinted),
        ("coincident panes", large(40.0, "glass") + &large(40.0, "glass"), clear * clear),
        ("a ball", ball.clone(), clear * clear),
        ("a solid without its inner faces", solid, clear * clear),
        (
            "a box",
            upright(DVec3::new(-30.0, -30.0, 35.0), DVec3::new(30.0, 30.0, 60.0), "tinted"),
            tinted * tinted,
        ),
    ] {
        let lamp = "point coords 0 0 90 power 8100 endpoint";
        let wall = pane(0.0, 4.0, true, "white");
        let free = rendered(&scene(glass, lamp, &wall), 50).pixels;
        let shaded = rendered(&scene(glass, lamp, &(wall + &between)), 50).pixels;
        for (free, shaded) in free.iter().zip(shaded) {
            let truth = f64::from(free[0]) * share;
            assert!(
                (f64::from(shaded[0]) - truth).abs() <= 1e-6,
                "{what}: {shaded:?}, truly {truth}"
            );
        }
    }
}

/// Asks where rays through glass meet a wall at z = -20, pixel by pixel, by the light that a lamp
/// before it throws there. The screen is at z = 4 and of this half side; `expect` tells where on
/// the wall the ray of a direction of length 1 should arrive, or is not sure. Returns how many
/// rays were asked about and the greatest error of the light.
fn check_arrivals(
    what: &str,
    (materials, geometry): (&str, &str),
    (half, side): (f64, u64),
    expect: impl Fn(DVec3) -> Option<DVec3>,
) -> (usize, f64) {
    let lamp = DVec3::new(0.7, 0.4, WALL + 6.0);
    let scene = read(&format!(
        "viewport origin 0 0 5 topleft {:?} {half:?} 4 bottomleft {:?} {:?} 4
            topright {half:?} {half:?} 4 endviewport
        materials entry name white endentry {materials} endmaterials
        lights point coords {:?} {:?} {:?} power 1 endpoint endlights
        geometry {geometry} {} endgeometry",
        -half,
        -half,
        -half,
        lamp.x,
        lamp.y,
        lamp.z,
        pane(WALL, 1e9, true, "white")
    ));
    let settings = settings(side, side, 1);
    let (viewport, mut asked, mut worst) = (scene.viewport.unwrap(), 0, 0.0_f64);
    for (k, pixel) in (0..).zip(picture(&scene, &settings)) {
        let (x, y) = ((k % side) as f64 + 0.5, (k / side) as f64 + 0.5);
        let direction = eye_direction(&viewport, settings.size, x, y).normalize();
        let Some(target) = expect(direction) else { continue };
        let truth = irradiance(lamp, target, DVec3::Z);
        let error = (f64::from(pixel[0]) / truth - 1.0).abs();
        assert!(error < 1e-6, "{what}: pixel {k} is {pixel:?}, truly {truth}");
        (asked, worst) = (asked + 1, worst.max(error));
    }
    (asked, worst)
}

const WALL: f64 = -20.0;

/// Where a ray from the eye arrives that meets these planes in turn: each at a z, with the factor
/// that it has for the sine of the angle. `None` after a total reflection.
fn through_planes(direction: DVec3, planes: &[(f64, f64)]) -> Option<DVec3> {
    let sideways = direction.truncate();
    let mut sine = sideways.length();
    let (mut z, mut shift) = (5.0, 0.0);
    for &(next, factor) in planes.iter().chain(&[(WALL, 1.0)]) {
        let tangent = sine / ((1.0 - sine) * (1.0 + sine)).sqrt();
        shift += (z - next) * tangent;
        (z, sine) = (next, sine * factor);
        if sine > 0.999 {
            return None;
        }
    }
    Some((sideways.normalize_or_zero() * shift).extend(WALL))
}

/// A wide plate of glass.
fn plate(low: f64, high: f64, material: &str) -> String {
    upright(DVec3::new(-1e3, -1e3, low), DVec3::new(1e3, 1e3, high), material)
}

#[test]
fn slabs_nested_and_overlapping_bend_at_each_face_by_its_own_ratio_and_side() {
    let materials = "entry name a refract 0.6 endentry entry name b refract 0.8 endentry
        entry name c refract 1.3 endentry";
    let (a, b, c) = (0.6, 0.8, 1.3);
    let (two, three) = (
        (plate(-1.0, 3.0, "a") + &plate(0.0, 1.5, "b")),
        (plate(-1.0, 2.0, "a") + &plate(0.5, 3.0, "b") + &plate(1.0, 1.5, "c")),
    );
    let (mut count, mut worst) = (0, 0.0_f64);
    for (what, geometry, planes) in [
        ("one", plate(-1.0, 2.0, "a"), vec![(2.0, a), (-1.0, 1.0 / a)]),
        ("nested", two, vec![(3.0, a), (1.5, b), (0.0, 1.0 / b), (-1.0, 1.0 / a)]),
        (
            "overlapping",
            three,
            vec![(3.0, b), (2.0, a), (1.5, c), (1.0, 1.0 / c), (0.5, 1.0 / b), (-1.0, 1.0 / a)],
        ),
        (
            "touching",
            plate(1.0, 2.0, "a") + &plate(0.0, 1.0, "b"),
            vec![(2.0, a), (1.0, b / a), (0.0, 1.0 / b)],
        ),
        ("around the eye", plate(2.0, 6.0, "a"), vec![(2.0, 1.0 / a)]),
        (
            "around the eye, in another",
            plate(2.0, 6.0, "b") + &plate(-3.0, 7.0, "a"),
            vec![(2.0, 1.0 / b), (-3.0, 1.0 / a)],
        ),
    ] {
        let seen = (materials, geometry.as_str());
        let expect = |direction| through_planes(direction, &planes);
        let (asked, error) = check_arrivals(what, seen, (1.0, side_of(20_000)), expect);
        assert!(asked > rays(4_000), "{what}: {asked} rays arrive");
        (count, worst) = (count + asked, worst.max(error));
    }
    HardCase::NestedGlass.tell(
        "nested and overlapping slabs bend at each face",
        format!("{count} rays, right within {worst:.1e} of the light"),
    );
}

#[test]
fn a_pane_bends_by_its_ratio_from_the_front_and_by_the_inverse_from_behind() {
    let (mut count, mut worst) = (0, 0.0_f64);
    for ratio in [0.4, 0.65, 0.95, 1.1, 1.5, 2.4] {
        for (to_eye, factor) in [(true, ratio), (false, 1.0 / ratio)] {
            let materials = format!("entry name glass refract {ratio:?} endentry");
            let pane = pane(1.0, 1e3, to_eye, "glass");
            let expect = |direction| through_planes(direction, &[(1.0, factor)]);
            let half = (1.0, side_of(10_000));
            let (asked, error) = check_arrivals("a pane", (&materials, &pane), half, expect);
            assert!(asked > rays(1_000), "{ratio}, {to_eye}: {asked} rays arrive");
            (count, worst) = (count + asked, worst.max(error));
        }
    }
    eprintln!("{count} rays arrive where Snell sends them within {worst:.1e} of the light");
}

/// Where a ray arrives that a ball of glass with this `ratio` turns by 2 (θi - θt): its line turns
/// as a whole, around the ball's centre. `None` where it misses the ball or the wall, or grazes.
fn through_ball(direction: DVec3, center: DVec3, ratio: f64, wall: f64) -> Option<DVec3> {
    let to_center = center - DVec3::Z * 5.0;
    let aside = to_center - to_center.dot(direction) * direction;
    let sine = aside.length();
    let bent = ratio * sine;
    if sine.max(bent) > 0.999 {
        return None;
    }
    let (cosine, bent_cosine) = ((1.0 - sine * sine).sqrt(), (1.0 - bent * bent).sqrt());
    let turn = [cosine * bent_cosine + sine * bent, sine * bent_cosine - cosine * bent];
    let turn = [turn[0] * turn[0] - turn[1] * turn[1], 2.0 * turn[0] * turn[1]];
    let inward = aside / sine;
    let onward = turn[0] * direction + turn[1] * inward;
    let start = center - sine * (turn[0] * inward - turn[1] * direction);
    (onward.z < -0.05).then(|| start + onward * ((wall - start.z) / onward.z))
}

#[test]
fn a_ball_turns_a_ray_by_twice_the_difference_of_its_angles() {
    let center = DVec3::new(0.3, -0.2, 0.0);
    let ball = sphere(center, 1.0, "glass");
    let solid = join("intersection", &[&ball, &plate(-4.0, 4.0, "glass")]);
    let (mut count, mut worst) = (0, 0.0_f64);
    for ratio in [0.4, 0.65, 0.75, 1.2] {
        for geometry in [&ball, &solid] {
            let materials = format!("entry name glass refract {ratio:?} endentry");
            let expect = |direction| through_ball(direction, center, ratio, WALL);
            let half = (0.3, side_of(20_000));
            let (asked, error) = check_arrivals("a ball", (&materials, geometry), half, expect);
            assert!(asked > rays(4_000), "{ratio}: {asked} rays arrive");
            (count, worst) = (count + asked, worst.max(error));
        }
    }
    eprintln!("{count} rays arrive where balls send them within {worst:.1e} of the light");
    // A direction off by 1e-13 misses its place at 1e7 by 1e-6.
    for ratio in [0.4, 0.65, 0.75] {
        for k in 0..40 {
            let x = 0.0007 + f64::from(k) * 0.0045;
            let ball = sphere(DVec3::ZERO, 1.0, "glass");
            check_arrival("ball", &format!("refract {ratio:?}"), &ball, x, |direction| {
                through_ball(direction, DVec3::ZERO, ratio, -1e7).unwrap()
            });
        }
    }
}

/// The least half side of a square at z = `place` that catches all rays through the middle of a
/// lens, up to about `height` from its axis.
fn blur(lens: &str, place: f64, height: f64) -> f64 {
    let half = height / 4.8;
    let side = side_of(500);
    let (mut low, mut high) = (1e-12, 1.0);
    while high / low > 1.001 {
        let middle = f64::sqrt(low * high);
        let scene = read(&format!(
            "viewport origin 0 0 5 topleft {:?} {half:?} 4 bottomleft {:?} {:?} 4
                topright {half:?} {half:?} 4 endviewport
            materials entry name red color 255 0 0 endentry
                entry name glass refract 0.6666666666666666 endentry endmaterials
            geometry {lens} {} endgeometry",
            -half,
            -half,
            -half,
            pane(place, middle, true, "red")
        ));
        let is_caught = picture(&scene, &settings(side, side, 1)).iter().all(|p| p[0] == 1.0);
        if is_caught { high = middle } else { low = middle }
    }
    high
}

#[test]
fn a_lens_focuses_where_the_lensmaker_says_but_for_the_cube_of_its_aperture() {
    let (n, front, back, thickness) = (1.5, 2.0, 3.0, 0.4);
    // Biconvex: what two balls have in common. Its middle front is at z = 0.2.
    let [near, far] = [thickness / 2.0, -thickness / 2.0];
    let lens = join(
        "intersection",
        &[
            &sphere(DVec3::Z * (near - front), front, "glass"),
            &sphere(DVec3::Z * (far + back), back, "glass"),
        ],
    );
    let bend = (n - 1.0) * thickness / n;
    let power = (n - 1.0) * (1.0 / front + 1.0 / back - bend / (front * back));
    // Distances are counted from the principal planes.
    let object = 5.0 - near + bend / back / power;
    let image = 1.0 / (power - 1.0 / object) - bend / front / power;
    let blurs = [0.4, 0.2, 0.1, 0.05, 0.025].map(|height| blur(&lens, far - image, height));
    eprintln!("a focus {image:.4} behind a lens:");
    let mut margin = 2.0;
    for pair in blurs.windows(2) {
        let ratio = pair[0] / pair[1];
        eprintln!("half the aperture blurs it by {:.1e}, {ratio:.3} times less", pair[1]);
        assert!((ratio - 8.0).abs() < margin + 0.1, "{ratio}");
        margin /= 4.0;
    }
    // A hundredth off the focus the blur is that of a cone.
    let off = [0.025, 0.0125].map(|height| blur(&lens, far - image * 1.01, height));
    assert!(off[0] > 10.0 * blurs[4] && (off[0] / off[1] - 2.0).abs() < 0.2, "{off:?}");
}

/// The faces of an upright box, each counter-clockwise seen from outside.
fn box_faces(low: DVec3, high: DVec3) -> Vec<[DVec3; 4]> {
    let face = |index: usize| {
        let (axis, is_high) = (index / 2, index % 2 == 1);
        let mut corners = [low; 4];
        for (k, corner) in corners.iter_mut().enumerate() {
            corner[axis] = if is_high { high[axis] } else { low[axis] };
            let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
            corner[u] = if k == 1 || k == 2 { high[u] } else { low[u] };
            corner[v] = if k >= 2 { high[v] } else { low[v] };
        }
        if !is_high {
            corners.reverse();
        }
        corners
    };
    (0..6).map(face).collect()
}

/// A mesh of quadrangles, each cut into two triangles, or turned inside out.
fn mesh(faces: &[[DVec3; 4]], inside_out: bool, material: u32, primitive: u32) -> Mesh {
    let mut vertices: Vec<[f64; 3]> = Vec::new();
    let mut index = |corner: DVec3| {
        let corner = corner.to_array();
        let known = vertices.iter().position(|vertex| *vertex == corner);
        known.unwrap_or_else(|| {
            vertices.push(corner);
            vertices.len() - 1
        }) as u32
    };
    let mut triangles = Vec::new();
    for face in faces {
        let [a, b, c, d] = face.map(&mut index);
        for [a, b, c] in [[a, b, c], [a, c, d]] {
            triangles.push(if inside_out { [a, c, b] } else { [a, b, c] });
        }
    }
    let shape = MeshShape { vertices: MeshVertices::Double(vertices), triangles };
    Mesh {
        path: "made here".to_owned(),
        shape: Arc::new(shape),
        scale: 1.0,
        rotate: None,
        offset: DVec3::ZERO,
        material,
        primitive,
    }
}

#[test]
fn the_front_of_a_mesh_is_where_its_vertices_run_counter_clockwise() {
    // No ray through a pixel's middle meets an edge, not even after total reflections.
    let low = DVec3::new(-1.301_73, -0.917_31, -0.4);
    let high = DVec3::new(0.823_17, 1.113_71, 1.7);
    let faces = box_faces(low, high);
    let around = pane(-3.0, 9.0, true, "white")
        + &sphere(DVec3::new(0.4, 0.6, -1.5), 0.8, "red")
        + &sphere(DVec3::new(-1.0, -0.8, -2.0), 0.6, "red");
    let lights = "ambient 0.3 point coords 1 4 6 power 20 endpoint";
    // Without roulette: which light branches it takes hangs on the order of the faces.
    let glass = |ratio: &str| {
        format!("entry name glass color 80 160 240 alpha 0.1 reflect 0.1 refract {ratio} endentry")
    };
    let with_box = |ratio: &str| {
        tree(
            &scene(&glass(ratio), lights, &(around.clone() + &upright(low, high, "glass"))),
            side_of(40_000),
        )
    };
    let with_mesh = |ratio: &str, inside_out: bool| {
        let mut scene = scene(&glass(ratio), lights, &around);
        scene.meshes.push(mesh(&faces, inside_out, 2, 3));
        assert_eq!(scene.materials[2].name, "glass");
        tree(&scene, side_of(40_000))
    };
    let with_quadrangles = |ratio: &str, inside_out: bool| {
        let mut geometry = around.clone();
        for face in &faces {
            geometry += "quadrangle ";
            for k in 0..4 {
                let corner = face[if inside_out { 3 - k } else { k }];
                write!(geometry, "vertex {:?} {:?} {:?} ", corner.x, corner.y, corner.z).unwrap();
            }
            geometry += "material glass endquadrangle ";
        }
        tree(&scene(&glass(ratio), lights, &geometry), side_of(40_000))
    };
    let difference = |a: &[[f32; 3]], b: &[[f32; 3]]| {
        let apart = |(a, b): (&[f32; 3], &[f32; 3])| {
            a.iter().zip(b).any(|(a, b)| (a - b).abs() > 1e-6 * a.abs().max(1.0))
        };
        a.iter().zip(b).filter(|&pair| apart(pair)).count()
    };
    let [dense, thin] = [with_box("0.625"), with_box("1.6")];
    let outward = with_mesh("0.625", false);
    let inward = with_mesh("0.625", true);
    eprintln!(
        "turning the mesh inside out changes {} of {} pixels",
        difference(&outward, &inward),
        outward.len()
    );
    assert!(difference(&outward, &inward) > outward.len() / 10);
    for (what, found, truth) in [
        ("a mesh", &outward, &dense),
        ("a mesh inside out", &inward, &thin),
        ("quadrangles", &with_quadrangles("0.625", false), &dense),
        ("quadrangles inside out", &with_quadrangles("0.625", true), &thin),
    ] {
        assert_eq!(difference(found, truth), 0, "{what}");
    }
}

#[test]
fn a_light_guide_keeps_light_and_its_way_over_dozens_of_total_reflections() {
    // Around the eye and down to -15: unfolded, the way is straight. No ray meets an edge.
    let (low, high) =
        (DVec3::new(-0.487_13, -0.511_97, -15.0), DVec3::new(0.523_31, 0.467_79, 6.0));
    let guide = upright(low, high, "glass");
    let folded = |x: f64, axis: usize| {
        let turns = ((x - low[axis]) / (high - low)[axis]).floor();
        let x = x - turns * (high - low)[axis];
        if turns % 2.0 == 0.0 { (x, 1.0) } else { (low[axis] + high[axis] - x, -1.0) }
    };
    let ratio = 2.0 / 3.0;
    let expect = |direction: DVec3| {
        let sideways = direction.truncate() / ratio;
        let [tangent_x, tangent_y] = [direction.x / -direction.z, direction.y / -direction.z];
        let ((x, x_sign), (y, y_sign)) = (folded(20.0 * tangent_x, 0), folded(20.0 * tangent_y, 1));
        let cosine_squared = 1.0 - sideways.length_squared();
        (cosine_squared > 0.01).then(|| {
            let slope = (-15.0 - WALL) / cosine_squared.sqrt();
            let [dx, dy] = [sideways.x * x_sign, sideways.y * y_sign];
            DVec3::new(x + dx * slope, y + dy * slope, WALL)
        })
    };
    let materials = "entry name glass refract 0.6666666666666666 endentry";
    let (count, worst) = check_arrivals("a guide", (materials, &guide), (0.7, side()), expect);
    eprintln!("{count} rays arrive where the guide sends them within {worst:.1e} of the light");
    assert!(count > rays(50_000));
}

#[test]
fn light_that_never_gets_out_adds_up_a_geometric_series_and_no_more() {
    // Near its skin a ball turns all light back for ever: of each meeting it shows a share.
    let mut random = random(52);
    let (mut count, mut worst) = (0, 0.0_f64);
    for alpha in [0.0, 0.01, 0.05, 0.5] {
        for _ in 0..10 {
            let eye = DVec3::new(0.0, 0.0, 5.0);
            // Straight ahead is along the skin.
            let center = eye + DVec3::new(random.sign() * 0.98, random.between(-0.01, 0.01), 0.0);
            let glass = format!("entry name glass alpha {alpha:?} refract 0.6666667 endentry");
            let seen =
                tree(&scene(&glass, "ambient 1", &sphere(center, 1.0, "glass")), side_of(2_500));
            let mut rest = 1.0 - alpha;
            for _ in 0..64 {
                if rest >= 1.0 / 4096.0 {
                    rest *= 1.0 - alpha;
                }
            }
            let kept = seen.iter().map(|pixel| f64::from(pixel[0]));
            // Rays aside of that plane may get out, and then show no more of the ball.
            let most = kept.fold(0.0, f64::max);
            assert!(most <= 1.0 - rest + 1e-6, "{alpha}: {most}, at most {}", 1.0 - rest);
            let middle = seen[seen.len() / 2 + side_of(2_500) as usize / 2];
            worst = worst.max((f64::from(middle[0]) - (1.0 - rest)).abs());
            count += seen.len();
        }
    }
    HardCase::TotalReflection.tell(
        "light that never gets out is no more than there is",
        format!("{count} rays; what stays in is right within {worst:.1e}"),
    );
    assert!(worst < 1e-6);
}

/// A mirror that all rays graze at 89.9999° shows nothing but the sky, in one step.
fn check_grazed(what: &str, scene: &Scene, side: u64) -> u64 {
    let tile = rendered(scene, side);
    let below = tile.pixels.iter().filter(|pixel| **pixel != [0.0, 0.0, 1.0]).count();
    assert_eq!(below, 0, "{what}: rays that go below");
    assert_eq!(
        (tile.tally.rays, tile.tally.untraced),
        (2 * side * side, 0.0),
        "{what}: rays that meet it again"
    );
    side * side
}

#[test]
fn no_ray_goes_below_a_mirror_that_it_grazes() {
    let mut random = random(55);
    let mut count = 0;
    let words = |p: DVec3| format!("{:?} {:?} {:?} ", p.x, p.y, p.z);
    for seed in 0..20 {
        let up = if seed == 0 { DVec3::Z } else { random.direction() };
        let ahead = up.any_orthonormal_vector();
        let aside = up.cross(ahead);
        let nudge = random.in_cube();
        let at = |x: f64, y: f64, z: f64| nudge + x * ahead + y * aside + z * up;
        // From one above the mirror down by 1 to 3 millionths: met between 300 and 1000 thousand.
        let viewport = format!(
            "viewport origin {} topleft {} bottomleft {} topright {} background 0 0 255
            endviewport",
            words(at(0.0, 0.0, 1.0)),
            words(at(1.0, -1e-2, 1.0 - 1e-6)),
            words(at(1.0, -1e-2, 1.0 - 3e-6)),
            words(at(1.0, 1e-2, 1.0 - 1e-6)),
        );
        let corners =
            |z: f64| [(1e5, -1e5), (2e6, -1e5), (2e6, 1e5), (1e5, 1e5)].map(|(x, y)| at(x, y, z));
        let flat = |word: &str, corners: &[DVec3], material: &str| {
            let vertices: Vec<String> = corners.iter().map(|corner| words(*corner)).collect();
            format!("{word} vertex {} material {material} end{word} ", vertices.join("vertex "))
        };
        let [a, b, c, d] = corners(0.0);
        let low = corners(-1e3);
        let solid = flat("parallelepiped", &[low[0], low[1], low[3], a], "mirror");
        let below = flat("quadrangle", &corners(-1e-3), "red");
        for (what, mirror) in [
            ("a quadrangle", flat("quadrangle", &[a, b, c, d], "mirror") + &below),
            (
                "triangles",
                flat("triangle", &[a, b, c], "mirror")
                    + &flat("triangle", &[a, c, d], "mirror")
                    + &below,
            ),
            ("a box", solid.clone()),
            ("a solid", join("union", &[&solid, &sphere(at(0.0, 0.0, -1e5), 1.0, "red")])),
        ] {
            let scene = read(&format!(
                "{viewport} materials entry name mirror reflect 1 endentry
                entry name red color 255 0 0 endentry endmaterials geometry {mirror} endgeometry"
            ));
            count += check_grazed(what, &scene, side_of(1_000));
        }
    }
    // A ball, at 1e-12 and less within its outline.
    for radius in [1.0, 0.3, 2.7] {
        let tangent = |sine: f64| sine / ((1.0 - sine) * (1.0 + sine)).sqrt();
        let slope = |depth: f64| tangent(radius * (1.0 - depth) / 5.0);
        let (outer, inner) = (slope(1e-13), slope(2e-12));
        for material in ["mirror", "solid"] {
            let mut ball = sphere(DVec3::ZERO, radius, "mirror");
            if material == "solid" {
                let around = DVec3::splat(4.0);
                ball = join("intersection", &[&ball, &upright(-around, around, "mirror")]);
            }
            let scene = read(&format!(
                "viewport origin 0 0 5 topleft {outer:?} 1e-20 4 bottomleft {outer:?} -1e-20 4
                    topright {inner:?} 1e-20 4 background 0 0 255 endviewport
                materials entry name mirror reflect 1 endentry endmaterials
                geometry {ball} endgeometry"
            ));
            count += check_grazed("a ball", &scene, side_of(2_000));
        }
    }
    HardCase::GrazedMirror
        .tell("no ray goes below a mirror that it grazes at 89.9999°", format!("0 of {count}"));
}

/// The picture is the oracle's; tells how many pixels differ.
fn difference_from_oracle(scene: &Scene, side: u64) -> usize {
    let settings = settings(side, side, 1);
    let middle = |_, _| vec![(0.5, 0.5)];
    let truth = reference_picture(scene, settings.size, &middle, &OracleSettings::default());
    let is_same = |found: [f32; 3], truth: [f64; 3]| {
        found.iter().zip(truth).all(|(f, t)| (f64::from(*f) - t).abs() <= 1e-6 * t.max(1.0))
    };
    let found = tree_picture(scene, &settings);
    found.into_iter().zip(truth).filter(|&(found, truth)| !is_same(found, truth)).count()
}

#[test]
fn an_eye_inside_glass_or_a_solid_sees_what_the_oracle_sees() {
    let eye = DVec3::Z * 5.0;
    let ball = |center: DVec3, radius: f64| sphere(eye + center, radius, "glass");
    // No ray lies in a plane of symmetry, where it would meet edges.
    let cube = |half: f64, material: &str| {
        upright(
            eye - half * DVec3::new(1.0, 0.8, 1.1),
            eye + half * DVec3::new(0.7, 0.9, 0.6),
            material,
        )
    };
    let materials = "entry name glass color 90 200 160 alpha 0.15 reflect 0.1 refract 0.65 endentry
        entry name air alpha 0.3 refract 1.5 endentry";
    let around = pane(-4.0, 20.0, true, "white")
        + &sphere(DVec3::new(0.5, 0.3, 1.0), 0.7, "red")
        + &sphere(DVec3::new(-1.5, 0.4, 0.0), 0.9, "white");
    let lights = "ambient 0.2 point coords 3 4 7 power 20 endpoint
        point coords 0.2 0.1 5.3 power 0.5 endpoint";
    let mut count = 0;
    for (what, geometry) in [
        ("a ball", ball(DVec3::new(0.1, 0.2, 0.3), 0.9)),
        ("a ball, near its skin", ball(DVec3::new(0.1, 0.2, 0.85), 0.9)),
        ("a box", cube(0.7, "glass")),
        ("an opaque box", cube(0.7, "red")),
        ("a ball in a box", cube(1.5, "glass") + &ball(DVec3::new(0.1, 0.07, 0.2), 0.6)),
        ("overlapping balls", ball(DVec3::X * 0.3, 0.9) + &ball(DVec3::X * -0.4, 0.9)),
        (
            "a lens",
            join("intersection", &[&ball(DVec3::Z * 0.8, 1.2), &ball(DVec3::Z * -0.7, 1.2)]),
        ),
        ("a union", join("union", &[&ball(DVec3::X * 0.3, 0.9), &cube(0.6, "air")])),
        (
            "a shell's cavity",
            join("difference", &[&cube(1.6, "glass"), &ball(DVec3::new(0.1, 0.07, 0.2), 0.7)]),
        ),
        ("a shell's wall", join("difference", &[&cube(1.2, "glass"), &ball(DVec3::X, 0.9)])),
    ] {
        let scene = scene(materials, lights, &(around.clone() + &geometry));
        // A multiple of four: no pixel's middle has a slope of 0 or 1/2, at which rays that are
        // mirrored in these boxes come upon an edge.
        let side = few_rays(400).isqrt() as u64 & !3;
        let differing = difference_from_oracle(&scene, side);
        assert!(differing * 500 <= (side * side) as usize, "{what}: {differing} pixels differ");
        count += side * side;
    }
    HardCase::EyeInside.tell(
        "an eye inside glass or a solid sees what the oracle sees",
        format!("{count} pixels"),
    );
}

#[test]
fn at_the_critical_angle_light_turns_back_once_and_stays_a_number() {
    // Up to the angle light goes through and, ever flatter, to a green wall that is the darker
    // the higher up; from there on it turns back to a red ceiling.
    let mut random = random(51);
    let (width, mut count, mut worst) = (4096, 0, 0.0_f64);
    for run in 0..rays(100_000) / 4096 {
        let ratio = if run < 4 { 1.5 } else { random.between(1.1, 3.0) };
        let window = [1e-3, 1e-6, 1e-9, if run < 4 { 1e-12 } else { 1e-10 }][run % 4];
        let tangent = 1.0 / ((ratio - 1.0) * (ratio + 1.0)).sqrt();
        let (left, right) = (tangent - window, tangent + window);
        let wall = 2.0 * tangent + 1.0;
        let scene = read(&format!(
            "viewport origin 0 0 1 topleft {left:?} 1e-20 0.0 bottomleft {left:?} -1e-20 0.0
                topright {right:?} 1e-20 0.0 endviewport
            materials entry name glass refract {ratio:?} endentry
                entry name red color 255 0 0 endentry entry name green color 0 255 0 endentry
            endmaterials
            lights ambient 0.1 point coords {:?} 0 -1.5 power 1 endpoint endlights
            geometry {} {} quadrangle vertex {wall:?} -9 -9 vertex {wall:?} -9 -0.9
                vertex {wall:?} 9 -0.9 vertex {wall:?} 9 -9 material green endquadrangle endgeometry",
            wall - 1.0,
            pane(-1.0, 100.0, true, "glass"),
            pane(9.0, 1e3, false, "red"),
        ));
        let settings = settings(width, 1, 1);
        // All are numbers: that is asked of every picture.
        let seen = pixels(&prepared(&scene), &settings, whole(settings.size));
        let turned = seen.iter().position(|pixel| pixel[0] > 0.0).unwrap();
        let (through, back) = seen.split_at(turned);
        assert!(through.iter().all(|pixel| pixel[0] == 0.0 && pixel[1] > 0.0), "{window}");
        assert!(back.iter().all(|pixel| pixel[0] > 0.0 && pixel[1] == 0.0), "{window}");
        let is_flatter = |pair: &[[f32; 3]]| pair[0][1] >= pair[1][1];
        assert!(through.windows(2).all(is_flatter), "{ratio}, {window}: not monotone");
        assert!(through[0][1] > through[turned - 1][1] || window < 1e-9, "{ratio}, {window}");
        let angle_error = ((turned as f64 - 2048.0) / 2048.0 * window).abs();
        assert!(angle_error < window / 2000.0 + 1e-14, "{window}: off by {angle_error:e}");
        worst = worst.max(angle_error);
        count += seen.len();
    }
    HardCase::CriticalAngle.tell(
        "at the critical angle light turns back once and stays a number",
        format!("{count} rays; windows from 1e-3 down turn at the angle within {worst:.1e}"),
    );
}
