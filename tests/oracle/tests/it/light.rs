//! The oracle's light against hand-computed cases.

#![expect(clippy::float_cmp, reason = "these sums are exact")]

use glam::DVec3;
use rtfarm_core::{
    scene::{Light, Material, Quadrangle, Scene, Sphere, Viewport},
    tile::Size,
};
use rtfarm_oracle::{FaceId, Oracle, Settings, grid_positions, reference_picture};

const O: DVec3 = DVec3::ZERO;

fn v(x: f64, y: f64, z: f64) -> DVec3 {
    DVec3::new(x, y, z)
}

fn material(color: DVec3) -> Material {
    Material { name: "m".into(), color, alpha: 1.0, reflect: 0.0, refract: 0.0, texture: None }
}

fn light(position: DVec3) -> Light {
    Light { position, intensity: DVec3::ONE }
}

/// A square of half side `half` at height z, seen counter-clockwise from above.
fn floor(z: f64, half: f64, material: u32, primitive: u32) -> Quadrangle {
    let vertices = [v(-half, -half, z), v(half, -half, z), v(half, half, z), v(-half, half, z)];
    Quadrangle { vertices, material, primitive }
}

fn sphere(center: DVec3, radius: f64, material: u32, primitive: u32) -> Sphere {
    Sphere { center, radius, material, primitive }
}

#[track_caller]
fn check_seen(scene: &Scene, origin: DVec3, direction: DVec3, expected: DVec3) {
    let seen = Oracle::new(scene).radiance(origin, direction, &Settings::default());
    assert!((seen - expected).abs().max_element() < 1e-14, "{seen} instead of {expected}");
}

#[test]
fn light_falls_with_the_cosine_and_the_square_of_the_distance() {
    let scene = Scene {
        materials: vec![material(v(1.0, 0.5, 0.25))],
        lights: vec![light(v(0., 0., 2.))],
        quadrangles: vec![floor(0., 10., 0, 0)],
        ..Scene::default()
    };
    for x in [0.0, 1.5, 4.0] {
        let squared: f64 = 4.0 + x * x;
        let expected = v(1.0, 0.5, 0.25) * 2.0 / (squared * squared.sqrt());
        check_seen(&scene, v(x, 0., 1.), -DVec3::Z, expected);
        // The other side has no light.
        check_seen(&scene, v(x, 0., -1.), DVec3::Z, O);
    }
}

#[test]
fn shadows_are_as_deep_as_what_casts_them() {
    let mut glass = material(DVec3::ONE);
    (glass.alpha, glass.reflect) = (0.5, 0.25);
    let mut scene = Scene {
        materials: vec![material(DVec3::ONE), glass],
        lights: vec![light(v(0., 0., 3.))],
        quadrangles: vec![floor(0., 10., 0, 0)],
        spheres: vec![sphere(v(0., 0., 1.), 0.5, 1, 1)],
        ..Scene::default()
    };
    // Two crossings of the glass sphere.
    let below = |share: f64| DVec3::splat(share * share / 9.0);
    check_seen(&scene, v(0., 0., 0.25), -DVec3::Z, below(0.5 * 0.75));
    scene.spheres[0].material = 0;
    check_seen(&scene, v(0., 0., 0.25), -DVec3::Z, O);

    // A light on the sphere from which it hangs: that crossing does not count, the other does.
    scene.spheres[0] = sphere(v(0., 0., 4.), 1., 0, 1);
    check_seen(&scene, v(0., 0., 0.25), -DVec3::Z, below(1.0));
    scene.lights[0].position = v(0., 0., 5.);
    check_seen(&scene, v(0., 0., 0.25), -DVec3::Z, O);
}

#[test]
fn a_light_inside_an_opaque_sphere_lights_its_inner_side_only() {
    let scene = Scene {
        materials: vec![material(DVec3::ONE)],
        lights: vec![light(v(0.5, 0., 0.))],
        spheres: vec![sphere(O, 1., 0, 0)],
        ..Scene::default()
    };
    check_seen(&scene, v(3., 0., 0.), -DVec3::X, O);
    check_seen(&scene, O, DVec3::X, DVec3::splat(4.));
    check_seen(&scene, O, -DVec3::X, DVec3::splat(1. / 2.25));
}

#[test]
fn a_light_on_a_face_or_at_the_point_itself_gives_it_nothing() {
    let scene = Scene {
        materials: vec![material(DVec3::ONE)],
        lights: vec![light(O)],
        quadrangles: vec![floor(0., 1., 0, 0)],
        ..Scene::default()
    };
    check_seen(&scene, v(0.5, 0., 1.), -DVec3::Z, O);
    check_seen(&scene, v(0., 0., 1.), -DVec3::Z, O);
}

#[test]
fn coincident_faces_shade_others_and_not_each_other() {
    let mut glass = material(DVec3::ONE);
    glass.alpha = 0.5;
    let scene = Scene {
        materials: vec![material(DVec3::ONE), glass],
        lights: vec![light(v(0., 0., 2.))],
        quadrangles: vec![floor(1., 1., 1, 0), floor(1., 1., 1, 1), floor(0., 9., 0, 2)],
        ..Scene::default()
    };
    let oracle = Oracle::new(&scene);
    let through = |point: DVec3, primitive: u32| {
        let on = Some(FaceId { primitive, face: 0 });
        oracle.transmittance(point, on, scene.lights[0].position)
    };
    assert_eq!(through(O, 2).transmittance, 0.25);
    assert_eq!(through(v(0., 0., 1.), 0).transmittance, 1.0);
    assert!(through(O, 2).margin > 0.1);
    // Seen from above: half of the first, a quarter of the second, a quarter of the floor.
    let seen = 0.5 * 1.0 + 0.25 * 1.0 + 0.25 * 0.25 / 4.0;
    check_seen(&scene, v(0., 0., 1.5), -DVec3::Z, DVec3::splat(seen));
}

#[test]
fn without_light_every_surface_shows_its_colour() {
    let mut scene = Scene {
        materials: vec![material(v(0.1, 0.2, 0.3))],
        quadrangles: vec![floor(0., 1., 0, 0)],
        background: v(0.5, 0., 0.),
        ..Scene::default()
    };
    check_seen(&scene, v(0.5, 0., 1.), -DVec3::Z, v(0.1, 0.2, 0.3));
    check_seen(&scene, v(1.5, 0., 1.), -DVec3::Z, v(0.5, 0., 0.));
    scene.ambient = Some(O);
    check_seen(&scene, v(0.5, 0., 1.), -DVec3::Z, O);
}

#[test]
fn a_picture_is_the_mean_over_its_samples() {
    let scene = Scene {
        materials: vec![material(DVec3::ONE)],
        quadrangles: vec![floor(0., 1., 0, 0)],
        viewport: Some(Viewport {
            eye: v(0., 0., 2.),
            top_left: v(-1., 1., 1.),
            bottom_left: v(-1., -1., 1.),
            top_right: v(1., 1., 1.),
        }),
        ..Scene::default()
    };
    // The square covers the middle half of the screen: from pixel 0.75 to 2.25 of 3.
    let size = Size::new(3, 3).unwrap();
    let picture = reference_picture(&scene, size, &|_, _| grid_positions(4), &Settings::default());
    let expected = [0.25 * 0.25, 0.25, 0.25 * 0.25, 0.25, 1.0, 0.25, 0.0625, 0.25, 0.0625];
    assert_eq!(picture, expected.map(|share| [share; 3]));
}
