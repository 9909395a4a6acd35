//! The oracle against cases whose answer is known, and against itself by another way.

#![expect(clippy::float_cmp, reason = "truth is compared exactly")]

use glam::DVec3;
use rtfarm_core::scene::{Parallelepiped, Quadrangle, Scene, Sphere, Triangle};
use rtfarm_oracle::{
    FaceId, Hit, Leaving, Oracle,
    random::Random,
    random_scene::{Aim, Recipe, Style, random_ray, random_scene},
};

const O: DVec3 = DVec3::ZERO;

fn v(x: f64, y: f64, z: f64) -> DVec3 {
    DVec3::new(x, y, z)
}

fn sphere(center: DVec3, radius: f64, primitive: u32) -> Sphere {
    Sphere { center, radius, material: 0, primitive }
}

fn triangle(vertices: [DVec3; 3], primitive: u32) -> Triangle {
    Triangle { vertices, material: 0, primitive }
}

fn quadrangle(vertices: [DVec3; 4], primitive: u32) -> Quadrangle {
    Quadrangle { vertices, material: 0, primitive }
}

fn unit_box(primitive: u32) -> Parallelepiped {
    let edges = [DVec3::X, DVec3::Y, DVec3::Z];
    Parallelepiped { corner: O, edges, material: 0, primitive }
}

fn id(primitive: u32, face: u32) -> FaceId {
    FaceId { primitive, face }
}

fn reflected(primitive: u32, face: u32) -> Leaving {
    Leaving { id: id(primitive, face), through: false }
}

fn through(primitive: u32, face: u32) -> Leaving {
    Leaving { id: id(primitive, face), through: true }
}

#[track_caller]
fn check_hits(scene: &Scene, origin: DVec3, direction: DVec3, expected: &[(f64, u32, u32, bool)]) {
    check_hits_leaving(scene, origin, direction, None, expected);
}

#[track_caller]
fn check_hits_leaving(
    scene: &Scene,
    origin: DVec3,
    direction: DVec3,
    leaving: Option<Leaving>,
    expected: &[(f64, u32, u32, bool)],
) {
    let oracle = Oracle::new(scene);
    let told = |hit: &Hit| (hit.t, hit.id.primitive, hit.id.face, hit.front);
    let hits: Vec<_> = oracle.all_hits(origin, direction, leaving).iter().map(told).collect();
    assert_eq!(hits, expected);
    let first = oracle.first_hit(origin, direction, leaving);
    assert_eq!(first.as_ref().map(told), expected.first().copied());
}

#[test]
fn a_sphere_is_entered_at_its_front_and_left_at_its_back() {
    let scene = Scene { spheres: vec![sphere(v(0., 0., 5.), 1., 7)], ..Scene::default() };
    check_hits(&scene, O, v(0., 0., 2.), &[(2., 7, 0, true), (3., 7, 0, false)]);
    check_hits(&scene, v(0., 0., 5.), DVec3::X, &[(1., 7, 0, false)]);
    check_hits(&scene, O, -DVec3::Z, &[]);
}

#[test]
fn touching_a_sphere_is_no_crossing_but_an_ulp_inside_is() {
    let scene = Scene { spheres: vec![sphere(O, 1., 0)], ..Scene::default() };
    check_hits(&scene, v(-2., 1., 0.), DVec3::X, &[]);
    let inside = v(-2., 1f64.next_down(), 0.);
    let hits = Oracle::new(&scene).all_hits(inside, DVec3::X, None);
    assert_eq!(hits.len(), 2);
    assert!(hits[0].t < 2.0 && 2.0 < hits[1].t);
    assert!(hits[0].margin < 2.0 * f64::EPSILON, "{}", hits[0].margin);
}

#[test]
fn a_sphere_on_whose_surface_a_ray_starts_is_not_at_distance_zero() {
    let scene = Scene { spheres: vec![sphere(O, 1., 0)], ..Scene::default() };
    check_hits(&scene, v(1., 0., 0.), -DVec3::X, &[(2., 0, 0, false)]);
    check_hits(&scene, v(1., 0., 0.), DVec3::X, &[]);
    // Rounded off the sphere, but leaving it: neither side sees it again at once.
    for start in [1f64.next_up(), 1f64.next_down()] {
        let point = v(start, 0., 0.);
        check_hits_leaving(&scene, point, DVec3::X, Some(reflected(0, 0)), &[]);
        let opposite = [(2. * start, 0, 0, false)];
        check_hits_leaving(&scene, point, -DVec3::X, Some(through(0, 0)), &opposite);
    }
}

#[test]
fn a_far_sphere_keeps_its_digits() {
    // x² + y² = 1 along y = 3/5 is met at x = ±4/5, here from 2^40 away.
    let far = 2f64.powi(40);
    let scene = Scene { spheres: vec![sphere(O, 5., 0)], ..Scene::default() };
    check_hits(
        &scene,
        v(-far, 3., 0.),
        DVec3::X,
        &[(far - 4., 0, 0, true), (far + 4., 0, 0, false)],
    );
}

#[test]
fn a_triangle_is_hit_inside_and_not_in_its_plane() {
    let scene = Scene { triangles: vec![triangle([O, DVec3::X, DVec3::Y], 3)], ..Scene::default() };
    check_hits(&scene, v(0.25, 0.25, 4.), v(0., 0., -2.), &[(2., 3, 0, true)]);
    check_hits(&scene, v(0.25, 0.25, -4.), v(0., 0., 2.), &[(2., 3, 0, false)]);
    check_hits(&scene, v(0.75, 0.75, 4.), v(0., 0., -2.), &[]);
    check_hits(&scene, v(-1., 0.25, 0.), DVec3::X, &[]);
    check_hits(&scene, v(0.25, 0.25, 0.), DVec3::Z, &[]);
}

#[test]
fn a_concave_quadrangle_has_no_surface_in_its_notch() {
    // An arrow head: the notch is at (0.25, 0.25).
    let corners = [O, v(1., 0., 0.), v(0.25, 0.25, 0.), v(0., 1., 0.)];
    for turn in 0..4 {
        let vertices = [0, 1, 2, 3].map(|k| corners[(k + turn) % 4]);
        let scene = Scene { quadrangles: vec![quadrangle(vertices, 0)], ..Scene::default() };
        check_hits(&scene, v(0.125, 0.125, 1.), -DVec3::Z, &[(1., 0, 0, true)]);
        check_hits(&scene, v(0.5, 0.125, 1.), -DVec3::Z, &[(1., 0, 0, true)]);
        check_hits(&scene, v(0.375, 0.375, 1.), -DVec3::Z, &[]);
        check_hits(&scene, v(0.5, 0.5, 1.), -DVec3::Z, &[]);
    }
}

#[test]
fn the_faces_of_a_box_have_the_documented_order() {
    let scene = Scene { parallelepipeds: vec![unit_box(0)], ..Scene::default() };
    let middle = DVec3::splat(0.5);
    for (k, axis) in [DVec3::X, DVec3::Y, DVec3::Z].into_iter().enumerate() {
        let near = 2 * k as u32;
        let origin = middle - 2. * axis;
        check_hits(&scene, origin, axis, &[(1.5, 0, near, true), (2.5, 0, near + 1, false)]);
        let normal = Oracle::new(&scene).first_hit(origin, axis, None).unwrap().normal;
        assert_eq!(normal, -axis);
    }
}

#[test]
fn coincident_faces_come_in_order_and_are_passed_one_by_one() {
    let corners = [O, DVec3::X, DVec3::Y];
    let turned = [DVec3::Y, DVec3::X, O];
    let other = [v(-1., -1., 0.), v(3., -1., 0.), v(-1., 3., 0.)];
    let triangles = vec![triangle(other, 2), triangle(corners, 0), triangle(turned, 1)];
    let scene = Scene { triangles, ..Scene::default() };
    let (origin, direction) = (v(0.25, 0.25, 1.), -DVec3::Z);
    check_hits(&scene, origin, direction, &[(1., 0, 0, true), (1., 1, 0, false), (1., 2, 0, true)]);

    let point = v(0.25, 0.25, 1e-17);
    let rest = [(0., 1, 0, false), (0., 2, 0, true)];
    check_hits_leaving(&scene, point, direction, Some(through(0, 0)), &rest);
    check_hits_leaving(&scene, point, direction, Some(through(1, 0)), &rest[1..]);
    check_hits_leaving(&scene, point, direction, Some(reflected(0, 0)), &[]);
    check_hits_leaving(&scene, point, -direction, Some(reflected(1, 0)), &[]);

    let oracle = Oracle::new(&scene);
    assert!(oracle.first_hit(origin, direction, None).unwrap().margin > 0.01);
}

#[test]
fn an_edge_of_two_faces_belongs_to_one_and_has_no_margin() {
    let square = [O, DVec3::X, v(1., 1., 0.), DVec3::Y];
    let triangles = vec![
        triangle([square[0], square[1], square[2]], 0),
        triangle([square[0], square[2], square[3]], 1),
    ];
    let oracle = Oracle::new(&Scene { triangles, ..Scene::default() });
    for k in 1..64 {
        let at = f64::from(k) / 64.;
        let hits = oracle.all_hits(v(at, at, 1.), v(0., 0., -1.), None);
        assert_eq!(hits.len(), 1);
        assert_eq!(hits[0].margin, 0.);
    }
}

#[test]
fn slightly_different_planes_are_told_apart() {
    let square = |z: f64| [v(0., 0., z), v(1., 0., z), v(1., 1., z), v(0., 1., z)];
    let quadrangles = vec![quadrangle(square(1f64.next_up()), 0), quadrangle(square(1.), 1)];
    let scene = Scene { quadrangles, ..Scene::default() };
    let oracle = Oracle::new(&scene);
    let hit = oracle.first_hit(v(0.3, 0.4, 1e-3), v(0., 0., 0.7), None).unwrap();
    assert_eq!(hit.id.primitive, 1);
    assert!(hit.margin <= f64::EPSILON && hit.margin > 0.0, "{}", hit.margin);
}

/// Rays at a scene of every style and every aim.
fn for_random_rays(seeds: u64, rays: u32, mut check: impl FnMut(&Scene, &Oracle, DVec3, DVec3)) {
    for style in [Style::Plain, Style::Grid, Style::Extreme, Style::Far] {
        for seed in 0..seeds {
            let scene = random_scene(seed, &Recipe { solids: 1, ..Recipe::new(style) });
            let oracle = Oracle::new(&scene);
            let mut random = Random::new(seed);
            for _ in 0..rays {
                for aim in Aim::ALL {
                    let (origin, direction) = random_ray(&scene, aim, &mut random);
                    check(&scene, &oracle, origin, direction);
                }
            }
        }
    }
}

#[test]
fn a_closed_surface_is_crossed_an_even_number_of_times_in_turns() {
    for_random_rays(20, 40, |scene, oracle, origin, direction| {
        // From outside of everything.
        let hits = oracle.all_hits(origin, direction, None);
        let back = oracle.all_hits(origin, -direction, None);
        for solid in &scene.parallelepipeds {
            let of_solid = |hits: &[Hit]| -> Vec<bool> {
                let own = hits.iter().filter(|hit| hit.id.primitive == solid.primitive);
                own.map(|hit| hit.front).collect()
            };
            let (ahead, behind) = (of_solid(&hits), of_solid(&back));
            let at_zero = (ahead.len() + behind.len()) % 2 == 1;
            let grazed = hits.iter().chain(&back).map(|hit| hit.margin).fold(1., f64::min) == 0.;
            assert!(ahead.len() <= 2 && (!at_zero || grazed || starts_on(oracle, origin)));
            if ahead.len() == 2 {
                assert!(hits[0].t <= hits[1].t);
            }
        }
    });
}

/// Whether a point is on a face: some ray from it has no distance to one.
fn starts_on(oracle: &Oracle, origin: DVec3) -> bool {
    [DVec3::X, DVec3::Y, DVec3::Z, DVec3::ONE]
        .iter()
        .any(|&direction| oracle.miss_margin(origin, direction, None) < 64. * f64::EPSILON)
}

#[test]
fn a_quadrangle_is_its_two_triangles() {
    for_random_rays(20, 40, |scene, oracle, origin, direction| {
        let hits = oracle.all_hits(origin, direction, None);
        for quadrangle in &scene.quadrangles {
            let [a, b, c, d] = quadrangle.vertices;
            let is_inside =
                |p: DVec3, q: DVec3, r: DVec3| (q - p).cross(r - p).dot((c - a).cross(d - b));
            // Cut along the diagonal that lies inside.
            let halves = if is_inside(a, b, c) > 0. && is_inside(a, c, d) > 0. {
                [[a, b, c], [a, c, d]]
            } else {
                [[b, c, d], [b, d, a]]
            };
            if halves.iter().any(|&[p, q, r]| (q - p).cross(r - p) == O) {
                continue;
            }
            let triangles = vec![triangle(halves[0], 0), triangle(halves[1], 1)];
            let halves = Oracle::new(&Scene { triangles, ..Scene::default() });
            let of_halves = halves.all_hits(origin, direction, None);
            let hit = hits.iter().find(|hit| hit.id.primitive == quadrangle.primitive);
            // The corners are in one plane only nearly.
            let margin = halves.miss_margin(origin, direction, None);
            assert!(
                of_halves.len() == usize::from(hit.is_some()) || margin < 1e-9,
                "{quadrangle:?} {origin} {direction} {margin}"
            );
        }
    });
}

#[test]
fn a_hit_lies_on_its_face_and_the_first_is_the_first_of_all() {
    for_random_rays(20, 20, |scene, oracle, origin, direction| {
        let hits = oracle.all_hits(origin, direction, None);
        let first = oracle.first_hit(origin, direction, None);
        assert_eq!(first.map(|hit| (hit.t, hit.id)), hits.first().map(|hit| (hit.t, hit.id)));
        assert!(hits.is_sorted_by_key(|hit| hit.t));
        for hit in &hits {
            assert!(hit.t > 0. && hit.normal.dot(direction) <= 1e-15 * direction.length());
            assert!((hit.normal.length() - 1.).abs() < 1e-15);
            if let Some(sphere) = scene.spheres.iter().find(|s| s.primitive == hit.id.primitive) {
                let error = (hit.point - sphere.center).length() - sphere.radius;
                let scale = hit.point.length() + sphere.center.length() + sphere.radius;
                assert!(error.abs() < 1e-14 * scale);
            }
        }
    });
}

#[test]
fn a_ray_that_goes_through_meets_the_rest_of_what_it_would_have_met() {
    let mut passed = 0;
    for_random_rays(20, 20, |_, oracle, origin, direction| {
        let hits = oracle.all_hits(origin, direction, None);
        if hits.first().is_none_or(|hit| hit.margin < 1e-9) {
            return;
        }
        for (k, hit) in hits.iter().enumerate() {
            let leaving = Some(Leaving { id: hit.id, through: true });
            let rest = oracle.all_hits(hit.point, direction, leaving);
            let ids = |hits: &[Hit]| hits.iter().map(|hit| (hit.id, hit.front)).collect::<Vec<_>>();
            assert_eq!(ids(&rest), ids(&hits[k + 1..]), "{origin} {direction}");
            // Back from there it meets all that came before, but nothing in the same place.
            let leaving = Some(Leaving { id: hit.id, through: false });
            let back = oracle.all_hits(hit.point, -direction, leaving);
            let before = hits[..k].iter().rev().filter(|other| other.t < hit.t);
            let ids: Vec<FaceId> = before.map(|hit| hit.id).collect();
            let times = back.iter().map(|hit| hit.t);
            assert!(times.is_sorted() && back.len() >= ids.len());
            passed += ids.len();
        }
    });
    assert!(passed > 1000, "{passed}");
}

#[test]
fn scaling_by_a_power_of_two_changes_no_answer() {
    for_random_rays(6, 20, |scene, oracle, origin, direction| {
        let hits = oracle.all_hits(origin, direction, None);
        for exponent in [-300, -40, 40, 300] {
            let factor = 2f64.powi(exponent);
            let mut scaled = scene.clone();
            scaled.solids.clear();
            for sphere in &mut scaled.spheres {
                sphere.center *= factor;
                sphere.radius *= factor;
            }
            for vertex in scaled.triangles.iter_mut().flat_map(|t| &mut t.vertices) {
                *vertex *= factor;
            }
            for vertex in scaled.quadrangles.iter_mut().flat_map(|q| &mut q.vertices) {
                *vertex *= factor;
            }
            for solid in &mut scaled.parallelepipeds {
                solid.corner *= factor;
                solid.edges = solid.edges.map(|edge| edge * factor);
            }
            let scaled = Oracle::new(&scaled).all_hits(origin * factor, direction * factor, None);
            let solids: Vec<u32> = scene.solids.iter().map(|solid| solid.primitive).collect();
            let plain = hits.iter().filter(|hit| !solids.contains(&hit.id.primitive));
            let told = |hit: &Hit| (hit.t, hit.id, hit.normal, hit.front);
            assert!(plain.map(told).eq(scaled.iter().map(told)));
        }
    });
}

#[test]
fn the_answer_stays_within_its_margin() {
    let mut changed = 0;
    for_random_rays(10, 20, |_, oracle, origin, direction| {
        let hit = oracle.first_hit(origin, direction, None);
        let margin = hit.map_or_else(|| oracle.miss_margin(origin, direction, None), |h| h.margin);
        // Move the ray sideways by less than the margin.
        let reach = origin.abs().max_element();
        let step = 0.4 * (margin - 16. * f64::EPSILON).max(0.) * reach;
        let side = direction.normalize().any_orthonormal_vector() * step;
        let moved = oracle.first_hit(origin + side, direction, None);
        assert!(
            step == 0. || moved.map(|hit| hit.id) == hit.map(|hit| hit.id),
            "{origin} {direction} {margin} {hit:?} {moved:?}"
        );
        // And by far more, to see that some do change.
        let moved = oracle.first_hit(origin + 1e9 * side, direction, None);
        changed += u32::from(moved.map(|hit| hit.id) != hit.map(|hit| hit.id));
    });
    assert!(changed > 100);
}
