//! Mirrors, glass and the shadow of glass against closed forms.

#![expect(clippy::float_cmp, reason = "what holds exactly is tested exactly")]

mod parts;
mod studio;

use std::{fmt::Write, ops::ControlFlow};

use glam::DVec3;
use parts::{join, rays, sphere, upright};
use rtfarm_core::{
    isa::Isa,
    render::{RenderedTile, render_tile},
    sample::Samples,
    scene::Scene,
};
use rtfarm_oracle::{closed_forms::irradiance, eye_direction, random::Random};
use studio::{picture, pixels, prepared, read, settings, whole};

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
    render_tile(&prepared(scene), &settings, whole(settings.size), Isa::fastest(), go_on).unwrap()
}

fn side() -> u64 {
    rays(100_000).isqrt() as u64
}

#[test]
fn parallel_mirrors_add_up_a_geometric_series_and_report_the_rest() {
    for share in [0.25, 0.5, 0.9, 0.99, 1.0] {
        let materials = format!("entry name mirror reflect {share:?} endentry");
        let mirrors = pane(0.0, 1e6, true, "mirror") + &pane(6.0, 1e6, false, "mirror");
        let tile = rendered(&scene(&materials, "", &mirrors), 32);
        let mut rest = share;
        let mut depth = 1;
        while rest >= 1.0 / 4096.0 && depth < 65 {
            rest *= share;
            depth += 1;
        }
        assert!(
            (tile.tally.cut - rest).abs() < 1e-14,
            "{share}: {} cut, truly {rest}",
            tile.tally.cut
        );
        for pixel in tile.pixels {
            let error = (f64::from(pixel[0]) - (1.0 - rest)).abs();
            assert!(error < 1e-7, "{share}: {pixel:?}, truly {}", 1.0 - rest);
        }
    }
}

#[test]
fn a_mirror_shows_the_mirrored_scene() {
    for seed in 0..5 {
        let mut random = Random::new(seed);
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
        let mirrored =
            rendered(&scene(glass, &lights(1.0), &(mirror + &geometry(1.0))), side() / 2);
        let straight = rendered(&scene(glass, &lights(-1.0), &geometry(-1.0)), side() / 2);
        assert!(straight.pixels.iter().filter(|pixel| **pixel != [0.0; 3]).count() > 1000);
        for (k, (m, s)) in mirrored.pixels.iter().zip(&straight.pixels).enumerate() {
            let is_same = m.iter().zip(s).all(|(m, s)| (m - s).abs() <= 1e-6 * s.max(1.0));
            assert!(is_same, "{seed}: pixel {k} is {m:?}, not {s:?}");
        }
    }
}

#[test]
fn a_white_world_stays_white_whatever_mirrors_and_bends() {
    let mut random = Random::new(7);
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
        for pixel in rendered(&scene, 100).pixels {
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
    let at = Samples::new(1, settings.quality.seed, 0, 0).sample(0).position();
    let direction = eye_direction(&bare, settings.size, at[0], at[1]).normalize();
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

#[test]
fn at_the_critical_angle_light_turns_back_once_and_stays_a_number() {
    // Refraction 1.5 from above: the sine of the angle is 2/3. The sky is blue, the ceiling red.
    let tangent = 2.0 / 5_f64.sqrt();
    for window in [1e-3, 1e-6, 1e-9, 1e-12] {
        let (left, right) = (tangent - window, tangent + window);
        let scene = read(&format!(
            "viewport origin 0 0 1 topleft {left:?} 1e-20 0.0 bottomleft {left:?} -1e-20 0.0
                topright {right:?} 1e-20 0.0 background 0 0 255 endviewport
            materials entry name glass refract 1.5 endentry entry name red color 255 0 0 endentry
            endmaterials geometry {} {} endgeometry",
            pane(-1.0, 100.0, true, "glass"),
            pane(9.0, 1e3, false, "red"),
        ));
        let seen =
            pixels(&prepared(&scene), &settings(4096, 1, 1), whole(settings(4096, 1, 1).size));
        let turned = seen.iter().position(|pixel| *pixel == [1.0, 0.0, 0.0]).unwrap();
        assert!(seen[..turned].iter().all(|pixel| *pixel == [0.0, 0.0, 1.0]), "{window}");
        assert!(seen[turned..].iter().all(|pixel| *pixel == [1.0, 0.0, 0.0]), "{window}");
        let angle_error = (turned as f64 - 2048.0) / 2048.0 * window;
        assert!(angle_error.abs() < window / 2000.0 + 1e-15, "{window}: off by {angle_error:e}");
    }
}
