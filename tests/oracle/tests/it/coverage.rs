//! Pictures of the oracle against the closed forms of what they show.

use glam::DVec3;
use rtfarm_core::{
    scene::{Light, Material, Quadrangle, Scene, Sphere, Viewport},
    tile::Size,
};
use rtfarm_oracle::{
    Settings,
    closed_forms::{irradiance, polygon_coverage, polygon_outline, sphere_outline},
    grid_positions, reference_picture,
};

fn v(x: f64, y: f64, z: f64) -> DVec3 {
    DVec3::new(x, y, z)
}

/// White things before a black sky, on a screen of 16 x 12 pixels.
fn scene() -> (Scene, Size) {
    let material = Material {
        name: "white".into(),
        color: DVec3::ONE,
        alpha: 1.0,
        reflect: 0.0,
        refract: 0.0,
        texture: None,
    };
    let viewport = Viewport {
        eye: v(0.1, 0.2, -3.0),
        top_left: v(-1.0, 0.75, 0.0),
        bottom_left: v(-1.0, -0.75, 0.0),
        top_right: v(1.0, 0.75, 0.1),
    };
    let scene = Scene { materials: vec![material], viewport: Some(viewport), ..Scene::default() };
    (scene, Size::new(16, 12).unwrap())
}

/// No pixel is off by more than an edge can move between the samples of a grid.
#[track_caller]
fn check_coverage(scene: &Scene, size: Size, coverage: impl Fn(u32, u32) -> f64) {
    let side = 24;
    let picture =
        reference_picture(scene, size, &|_, _| grid_positions(side), &Settings::default());
    let mut total = 0.0;
    for (k, pixel) in (0..).zip(&picture) {
        let expected = coverage(k % size.width(), k / size.width());
        let error = pixel[0] - expected;
        assert!(error.abs() < 1.5 / f64::from(side), "{k} {pixel:?} {expected}");
        total += error;
    }
    assert!((total / picture.len() as f64).abs() < 2e-4, "{total}");
}

#[test]
fn a_sphere_covers_what_its_outline_says() {
    let (mut scene, size) = scene();
    let (center, radius) = (v(0.4, -0.1, 1.0), 0.6);
    scene.spheres = vec![Sphere { center, radius, material: 0, primitive: 0 }];
    let outline = sphere_outline(&scene.viewport.unwrap(), size, center, radius).unwrap();
    check_coverage(&scene, size, |x, y| outline.coverage(x, y));
}

#[test]
fn a_concave_quadrangle_covers_what_its_outline_says() {
    let (mut scene, size) = scene();
    let vertices = [v(-0.8, -0.6, 1.0), v(0.9, -0.5, 1.0), v(-0.2, -0.1, 1.0), v(-0.5, 0.8, 1.0)];
    scene.quadrangles = vec![Quadrangle { vertices, material: 0, primitive: 0 }];
    let outline = polygon_outline(&scene.viewport.unwrap(), size, &vertices).unwrap();
    check_coverage(&scene, size, |x, y| polygon_coverage(&outline, x, y));
}

#[test]
fn a_floor_has_the_light_of_the_formula() {
    let (mut scene, size) = scene();
    let light = v(0.3, 0.4, 0.2);
    scene.lights = vec![Light { position: light, intensity: DVec3::ONE }];
    let vertices = [v(-9.0, -9.0, 1.0), v(-9.0, 9.0, 1.0), v(9.0, 9.0, 1.0), v(9.0, -9.0, 1.0)];
    scene.quadrangles = vec![Quadrangle { vertices, material: 0, primitive: 0 }];
    let viewport = scene.viewport.unwrap();
    let settings = Settings::default();
    let picture = reference_picture(&scene, size, &|_, _| vec![(0.25, 0.75)], &settings);
    for (k, pixel) in (0..).zip(&picture) {
        let (x, y) = (f64::from(k % 16) + 0.25, f64::from(k / 16) + 0.75);
        let direction = rtfarm_oracle::eye_direction(&viewport, size, x, y);
        let point = viewport.eye + direction * (4.0 / direction.z);
        let expected = irradiance(light, point, -DVec3::Z);
        assert!((pixel[0] - expected).abs() < 1e-14, "{pixel:?} {expected}");
    }
}
