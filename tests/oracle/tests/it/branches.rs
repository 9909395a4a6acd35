//! Mirrors and glass: the oracle against hand-computed cases and closed forms.

use glam::DVec3;
use rtfarm_core::scene::{
    Light, Material, Operation, Parallelepiped, Quadrangle, Scene, Solid, SolidNode, Sphere,
    Triangle,
};
use rtfarm_core::tile::Size;
use rtfarm_oracle::{
    Oracle, Settings, grid_positions,
    random_scene::{Recipe, Style, random_scene},
    reference_picture,
};

const O: DVec3 = DVec3::ZERO;
const SKY: DVec3 = DVec3::new(0.5, 0.25, 1.0);

fn v(x: f64, y: f64, z: f64) -> DVec3 {
    DVec3::new(x, y, z)
}

fn material(alpha: f64, reflect: f64, refract: f64) -> Material {
    Material { name: "m".into(), color: DVec3::ONE, alpha, reflect, refract, texture: None }
}

fn square(z: f64, material: u32, primitive: u32) -> Quadrangle {
    let vertices = [v(-9., -9., z), v(9., -9., z), v(9., 9., z), v(-9., 9., z)];
    Quadrangle { vertices, material, primitive }
}

fn plate(low: DVec3, size: DVec3, material: u32, primitive: u32) -> Parallelepiped {
    let edges = [size.x * DVec3::X, size.y * DVec3::Y, size.z * DVec3::Z];
    Parallelepiped { corner: low, edges, material, primitive }
}

/// Stage-1 light: a surface of colour 1 shows 1.
fn scene(materials: Vec<Material>) -> Scene {
    Scene { materials, background: SKY, ..Scene::default() }
}

fn see_with(scene: &Scene, origin: DVec3, direction: DVec3, cutoff: f64) -> DVec3 {
    Oracle::new(scene).radiance(origin, direction, &Settings { cutoff, ..Settings::default() })
}

#[track_caller]
fn check_seen(scene: &Scene, origin: DVec3, direction: DVec3, expected: DVec3) {
    let seen = see_with(scene, origin, direction, 0.0);
    assert!((seen - expected).abs().max_element() < 1e-13, "{seen} instead of {expected}");
}

#[test]
fn a_mirror_shows_the_share_that_it_reflects() {
    let mut scene = scene(vec![material(1.0, 0.75, 0.0)]);
    scene.quadrangles = vec![square(0., 0, 0)];
    for z in [1., -1.] {
        check_seen(&scene, v(0., 0., z), v(0.5, 0.25, -z), 0.75 * SKY + 0.25);
    }
}

#[test]
fn a_clear_surface_shows_the_blend_of_the_format() {
    let mut scene = scene(vec![material(0.25, 0.5, 0.0)]);
    scene.quadrangles = vec![square(0., 0, 0)];
    // Half mirrored sky; of the rest a quarter surface and three quarters sky behind.
    check_seen(&scene, v(0., 0., 1.), -DVec3::Z, 0.5 * SKY + 0.5 * (0.25 + 0.75 * SKY));
}

#[test]
fn parallel_mirrors_make_a_geometric_series_up_to_depth_64() {
    let k = 0.9;
    let mut scene = scene(vec![material(1.0, k, 0.0)]);
    scene.quadrangles = vec![square(0., 0, 0), square(1., 0, 1)];
    // Depths 0 to 64 see a surface, depth 65 would.
    let series: f64 = (0..=64).map(|depth| (1.0 - k) * k.powi(depth)).sum();
    let expected = DVec3::splat(series) + k.powi(65) * SKY;
    check_seen(&scene, v(0., 0., 0.5), v(1e-3, 0., 1.), expected);

    // With a cut-off the branches of weight 1, k, k² … down to it are traced.
    let traced = (0..64).find(|&depth| k.powi(depth) < 0.25).unwrap();
    let series: f64 = (0..traced).map(|depth| (1.0 - k) * k.powi(depth)).sum();
    let expected = DVec3::splat(series) + k.powi(traced) * SKY;
    let seen = see_with(&scene, v(0., 0., 0.5), DVec3::Z, 0.25);
    assert!((seen - expected).abs().max_element() < 1e-14);
}

/// A small opaque triangle around `target`, hit only by rays that pass it within `reach`.
fn target(target: DVec3, reach: f64, primitive: u32) -> Triangle {
    let vertices = [v(-1., -1., 0.), v(1., -1., 0.), v(0., 1., 0.)].map(|p| target + reach * p);
    Triangle { vertices, material: 1, primitive }
}

#[test]
fn a_slab_shifts_a_ray_and_keeps_its_direction() {
    // n2 = 1.5: refract = n1/n2 = 2/3.
    let mut scene = scene(vec![material(0.0, 0.0, 1.0 / 1.5), material(1.0, 0.0, 0.0)]);
    let thickness = 0.5;
    scene.parallelepipeds = vec![plate(v(-9., -9., -thickness), v(18., 18., thickness), 0, 0)];
    for degrees in [0.0, 10.0, 45.0, 80.0] {
        let sine = sine_of(degrees);
        let (cosine, sine_inside) = ((1.0 - sine * sine).sqrt(), sine / 1.5);
        let direction = v(sine, 0., -cosine);
        let inside = thickness * sine_inside / (1.0 - sine_inside * sine_inside).sqrt();
        let beyond = (2.0 - thickness) * sine / cosine;
        scene.triangles = vec![target(v(inside + beyond, 0., -2.), 1e-12, 1)];
        check_seen(&scene, -direction, direction, v(1., 1., 1.));
        scene.triangles = vec![target(v(inside + beyond + 1e-11, 0., -2.), 1e-12, 1)];
        check_seen(&scene, -direction, direction, SKY);
    }
}

/// By the half-angle of 2 · asin: enough for a test, and no function of the platform.
fn sine_of(degrees: f64) -> f64 {
    let x = degrees * std::f64::consts::PI / 180.0;
    let mut term = x;
    let mut sum = x;
    for k in 1..20 {
        let k = f64::from(k);
        term *= -x * x / ((2.0 * k) * (2.0 * k + 1.0));
        sum += term;
    }
    sum
}

#[test]
fn a_ball_turns_a_ray_by_twice_the_difference_of_its_angles() {
    // Entering at 60° into n = √3: 30° inside, so 60° in all. From the point (-1/2, √3/2) on the
    // unit circle along x the ray runs to the point at 0° and leaves it 60° downwards.
    let root = 3f64.sqrt();
    let mut scene = scene(vec![material(0.0, 0.0, 1.0 / root), material(1.0, 0.0, 0.0)]);
    scene.spheres = vec![Sphere { center: O, radius: 1., material: 0, primitive: 0 }];
    let origin = v(-3., root / 2., 0.);
    let exit = v(1., 0., 0.) + 4.0 * v(0.5, -root / 2., 0.);
    let facing = |at: DVec3, reach: f64| Triangle {
        vertices: [v(0., -1., -1.), v(0., 1., -1.), v(0., 0., 1.)].map(|p| at + reach * p),
        material: 1,
        primitive: 1,
    };
    scene.triangles = vec![facing(exit, 1e-12)];
    check_seen(&scene, origin, DVec3::X, DVec3::ONE);
    scene.triangles = vec![facing(exit + v(0., 1e-11, 0.), 1e-12)];
    check_seen(&scene, origin, DVec3::X, SKY);
}

#[test]
fn beyond_the_critical_angle_all_light_is_mirrored() {
    // From inside a medium with n = 2 the limit is a sine of 1/2.
    let mut scene = scene(vec![material(0.0, 0.0, 0.5), material(1.0, 0.0, 0.0)]);
    scene.quadrangles = vec![square(0., 0, 0), square(-1., 1, 1)];
    let ray = |sine: f64| v(sine, 0., (1.0 - sine * sine).sqrt());
    for gap in [1e-3, 1e-9, 1e-12] {
        check_seen(&scene, v(0., 0., -0.5), ray(0.5 - gap), SKY);
        check_seen(&scene, v(0., 0., -0.5), ray(0.5 + gap), DVec3::ONE);
    }
    // From the front there is no limit.
    check_seen(&scene, v(0., 0., 4e-3), v(1., 0., -1e-3), DVec3::ONE);
}

#[test]
fn a_ratio_of_one_or_zero_goes_straight_on() {
    for refract in [0.0, 1.0] {
        let mut scene = scene(vec![material(0.5, 0.0, refract)]);
        let direction = v(0.3, 0.2, -1.);
        scene.quadrangles = vec![square(0., 0, 0)];
        let once = see_with(&scene, v(0., 0., 1.), direction, 0.0);
        assert_eq!(once, 0.5 * DVec3::ONE + 0.5 * SKY);
    }
}

#[test]
fn light_that_mirrors_between_coincident_faces_crosses_none_of_them() {
    // Two clear half mirrors in one plane. Through the first, the second is met at the same
    // point; what it mirrors leaves on the near side and crosses the first no more.
    let mut scene = scene(vec![material(0.0, 0.5, 0.0), material(1.0, 0.0, 0.0)]);
    scene.quadrangles = vec![square(0., 0, 0), square(0., 0, 1), square(-1., 1, 2)];
    let expected = 0.5 * SKY + 0.5 * (0.5 * SKY + 0.5 * DVec3::ONE);
    check_seen(&scene, v(0., 0., 1.), -DVec3::Z, expected);
}

#[test]
fn a_glass_shell_cut_from_a_ball_bends_like_its_walls() {
    // A ray through the middle is not bent: four clear walls of alpha 1/4.
    let mut scene = scene(vec![material(0.25, 0.0, 0.5)]);
    let ball = |radius: f64, leaf: u32| {
        SolidNode::Sphere(Sphere { center: O, radius, material: 0, primitive: leaf })
    };
    let cut = SolidNode::Operation { operation: Operation::Difference, operands: 2 };
    let nodes = vec![ball(2., 0), ball(1., 1), cut];
    scene.solids = vec![Solid { nodes, primitive: 0 }];
    let clear = 0.75f64.powi(4);
    check_seen(&scene, v(-5., 0., 0.), DVec3::X, DVec3::splat(1.0 - clear) + clear * SKY);
    // Off the middle: into the glass by 1/2 and out into the hollow by 2, from its reversed
    // face. A ray at distance 1.2 from the axis: sine 0.6 outside, 0.3 in the glass; the hollow
    // is passed where 2 · 0.3 = 0.6 < 1, at a sine of 0.6 in the glass and 1.2 > 1 in the
    // hollow: it mirrors, and meets the outer wall again at a sine of 0.3.
    let hits = |y: f64| {
        let seen = see_with(&scene, v(-5., y, 0.), DVec3::X, 0.0);
        (1.0 - (seen - DVec3::ONE).x / (SKY - DVec3::ONE).x).clamp(0.0, 1.0)
    };
    let walls = 0.75f64.powi(3);
    assert!((hits(1.2) - (1.0 - walls)).abs() < 1e-12, "{}", hits(1.2));
}

#[test]
fn lights_are_seen_through_mirrors() {
    let mut scene = scene(vec![material(1.0, 0.5, 0.0), material(1.0, 0.0, 0.0)]);
    scene.lights = vec![Light { position: v(0., 0., 0.5), intensity: DVec3::ONE }];
    scene.quadrangles = vec![square(0., 0, 0), square(1., 1, 1)];
    // Straight down: the mirror's own light at distance 1/2, and half that of the ceiling.
    check_seen(&scene, v(0., 0., 0.25), -DVec3::Z, DVec3::splat(0.5 * 4.0 + 0.5 * 4.0));
}

#[test]
fn pictures_of_random_scenes_are_finite_and_not_negative() {
    for style in [Style::Plain, Style::Grid, Style::Extreme, Style::Far] {
        for seed in 0..8 {
            let recipe = Recipe { solids: 2, clear: true, ..Recipe::new(style) };
            let scene = random_scene(seed, &recipe);
            let size = Size::new(12, 12).unwrap();
            let settings = Settings { cutoff: 1.0 / 64.0, ..Settings::default() };
            let picture = reference_picture(&scene, size, &|_, _| grid_positions(1), &settings);
            assert_eq!(picture.len(), 144);
            assert!(picture.iter().flatten().all(|&value| value.is_finite() && value >= 0.0));
        }
    }
}
