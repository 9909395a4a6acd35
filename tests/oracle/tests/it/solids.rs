//! The oracle's constructive solids against set algebra.

use glam::DVec3;
use rtfarm_core::scene::{Operation, Parallelepiped, Scene, Solid, SolidNode, Sphere};
use rtfarm_oracle::{
    Hit, Leaving, Oracle,
    random::Random,
    random_scene::{Aim, Recipe, Style, random_ray, random_scene},
};

use Operation::{Difference, Intersection, Union};

const O: DVec3 = DVec3::ZERO;

fn v(x: f64, y: f64, z: f64) -> DVec3 {
    DVec3::new(x, y, z)
}

fn ball(center: DVec3, radius: f64, leaf: u32) -> SolidNode {
    SolidNode::Sphere(Sphere { center, radius, material: leaf, primitive: leaf })
}

fn cuboid(low: DVec3, high: DVec3, leaf: u32) -> SolidNode {
    let size = high - low;
    let edges = [size.x * DVec3::X, size.y * DVec3::Y, size.z * DVec3::Z];
    let solid = Parallelepiped { corner: low, edges, material: leaf, primitive: leaf };
    SolidNode::Parallelepiped(solid)
}

fn operation(operation: Operation, operands: u32) -> SolidNode {
    SolidNode::Operation { operation, operands }
}

fn scene_of(nodes: Vec<SolidNode>) -> Scene {
    let solid = Solid { nodes, primitive: 0 };
    Scene { solids: vec![solid], ..Scene::default() }
}

/// t, the leaf, its face, whether the ray enters the result.
type Seen = (f64, u32, u32, bool);

fn seen(hits: &[Hit]) -> Vec<Seen> {
    hits.iter().map(|hit| (hit.t, hit.id.face / 6, hit.id.face % 6, hit.front)).collect()
}

/// All crossings of a ray from x = -10 along the x axis, at y and z a little off it.
#[track_caller]
fn check_along_x(nodes: Vec<SolidNode>, expected: &[Seen]) {
    let hits = Oracle::new(&scene_of(nodes)).all_hits(v(-10., 0.25, 0.25), DVec3::X, None);
    let expected: Vec<Seen> = expected.iter().map(|&(x, a, b, c)| (x + 10., a, b, c)).collect();
    assert_eq!(seen(&hits), expected);
    // Normals are those of the result: against the ray, whichever way it goes.
    for hit in hits {
        assert_eq!(hit.normal, -DVec3::X);
    }
}

fn two_boxes(second_low: f64, second_high: f64, how: Operation) -> Vec<SolidNode> {
    let first = cuboid(v(0., -1., -1.), v(4., 1., 1.), 0);
    let second = cuboid(v(second_low, -1., -1.), v(second_high, 1., 1.), 1);
    vec![first, second, operation(how, 2)]
}

#[test]
fn boxes_join_meet_and_cut() {
    check_along_x(two_boxes(2., 6., Union), &[(0., 0, 0, true), (6., 1, 1, false)]);
    check_along_x(two_boxes(2., 6., Intersection), &[(2., 1, 0, true), (4., 0, 1, false)]);
    check_along_x(two_boxes(2., 6., Difference), &[(0., 0, 0, true), (2., 1, 0, false)]);
    check_along_x(
        two_boxes(1., 2., Difference),
        &[(0., 0, 0, true), (1., 1, 0, false), (2., 1, 1, true), (4., 0, 1, false)],
    );
}

#[test]
fn touching_solids_have_no_face_between_them() {
    check_along_x(two_boxes(4., 6., Union), &[(0., 0, 0, true), (6., 1, 1, false)]);
    check_along_x(two_boxes(4., 6., Intersection), &[]);
    check_along_x(two_boxes(4., 6., Difference), &[(0., 0, 0, true), (4., 0, 1, false)]);
}

#[test]
fn where_faces_coincide_the_first_operand_is_taken() {
    check_along_x(two_boxes(0., 2., Union), &[(0., 0, 0, true), (4., 0, 1, false)]);
    check_along_x(two_boxes(0., 2., Intersection), &[(0., 0, 0, true), (2., 1, 1, false)]);
    check_along_x(two_boxes(0., 2., Difference), &[(2., 1, 1, true), (4., 0, 1, false)]);
    // The same box three times.
    check_along_x(two_boxes(0., 4., Union), &[(0., 0, 0, true), (4., 0, 1, false)]);
    check_along_x(two_boxes(0., 4., Intersection), &[(0., 0, 0, true), (4., 0, 1, false)]);
    check_along_x(two_boxes(0., 4., Difference), &[]);
}

#[test]
fn a_wall_an_ulp_thick_has_two_sides() {
    let thin = 4f64.next_down();
    check_along_x(
        two_boxes(2., thin, Difference),
        &[(0., 0, 0, true), (2., 1, 0, false), (thin, 1, 1, true), (4., 0, 1, false)],
    );
}

#[test]
fn a_hollow_ball_is_crossed_four_times() {
    let nodes = vec![ball(O, 2., 0), ball(O, 1., 1), operation(Difference, 2)];
    let hits = Oracle::new(&scene_of(nodes)).all_hits(v(-3., 0., 0.), DVec3::X, None);
    let expected = [(1., 0, 0, true), (2., 1, 0, false), (4., 1, 0, true), (5., 0, 0, false)];
    assert_eq!(seen(&hits), expected);
    assert_eq!(hits.iter().map(|hit| hit.material).collect::<Vec<_>>(), [0, 1, 1, 0]);
}

#[test]
fn a_ray_that_leaves_a_face_of_a_solid_does_not_meet_it_again() {
    let oracle = Oracle::new(&scene_of(two_boxes(1., 2., Difference)));
    let hit = oracle.first_hit(v(-1., 0.1, 0.2), v(1., 0.01, 0.03), None).unwrap();
    for nudge in [-1e-16, 0., 1e-16] {
        let point = hit.point + v(nudge, 0., 0.);
        let told = |direction, through| {
            let leaving = Some(Leaving { id: hit.id, through });
            oracle.first_hit(point, direction, leaving).map(|hit| hit.id.face)
        };
        assert_eq!(told(v(1., 0.01, 0.03), true), Some(6));
        assert_eq!(told(v(-1., 0.01, 0.03), false), None);
    }
}

/// Whether a point is in a solid, by its definition.
fn contains(solid: &Solid, point: DVec3) -> bool {
    let mut stack = Vec::new();
    for node in &solid.nodes {
        let inside = match node {
            SolidNode::Sphere(leaf) => (point - leaf.center).length() < leaf.radius,
            SolidNode::Parallelepiped(leaf) => {
                let [a, b, c] = leaf.edges;
                let (volume, offset) = (a.dot(b.cross(c)), point - leaf.corner);
                [offset.dot(b.cross(c)), offset.dot(c.cross(a)), offset.dot(a.cross(b))]
                    .iter()
                    .all(|part| (0.0..1.0).contains(&(part / volume)))
            }
            SolidNode::Operation { operation, operands } => {
                let operands: Vec<bool> = stack.split_off(stack.len() - *operands as usize);
                match operation {
                    Union => operands.contains(&true),
                    Intersection => !operands.contains(&false),
                    Difference => operands[0] && !operands[1..].contains(&true),
                }
            }
        };
        stack.push(inside);
    }
    stack.pop().unwrap()
}

fn for_random_solids(mut check: impl FnMut(&Scene, &Oracle, DVec3, DVec3)) {
    let mut recipe = Recipe::new(Style::Plain);
    (recipe.spheres, recipe.triangles, recipe.quadrangles) = (0, 0, 0);
    (recipe.parallelepipeds, recipe.solids) = (0, 1);
    for style in [Style::Plain, Style::Grid] {
        recipe.style = style;
        for seed in 0..150 {
            let scene = random_scene(seed, &recipe);
            let oracle = Oracle::new(&scene);
            let mut random = Random::new(seed);
            for k in 0..10 {
                let (origin, direction) = random_ray(&scene, Aim::ALL[k % 5], &mut random);
                check(&scene, &oracle, origin, direction);
            }
        }
    }
}

#[test]
fn between_two_crossings_a_ray_is_inside_or_outside() {
    let mut crossing_count = 0;
    for_random_solids(|scene, oracle, origin, direction| {
        let hits = oracle.all_hits(origin, direction, None);
        if oracle.miss_margin(origin, direction, None) < 1e-6 {
            return; // A ray along faces: points on it are on no side of them.
        }
        crossing_count += hits.len();
        let mut times = vec![0.0];
        times.extend(hits.iter().map(|hit| hit.t));
        times.push(times.last().unwrap() + 1.0);
        for (k, pair) in times.windows(2).enumerate() {
            for share in [0.01, 0.3, 0.99] {
                let point = origin + direction * (pair[0] + (pair[1] - pair[0]) * share);
                let expected = hits.get(k).is_some_and(|next| !next.front);
                assert_eq!(contains(&scene.solids[0], point), expected, "{origin} {direction}");
            }
        }
        assert!(hits.windows(2).all(|pair| pair[0].front != pair[1].front));
    });
    assert!(crossing_count > 1000, "{crossing_count}");
}

/// What a ray does at a solid, whatever the names of the faces.
fn profile(nodes: Vec<SolidNode>, origin: DVec3, direction: DVec3) -> Vec<(f64, bool)> {
    let hits = Oracle::new(&scene_of(nodes)).all_hits(origin, direction, None);
    hits.iter().map(|hit| (hit.t, hit.front)).collect()
}

#[test]
fn set_algebra_holds_on_every_ray() {
    for_random_solids(|scene, _, origin, direction| {
        let leaves: Vec<SolidNode> = scene.solids[0]
            .nodes
            .iter()
            .filter(|node| !matches!(node, SolidNode::Operation { .. }))
            .copied()
            .collect();
        let (a, b) = (leaves[0], leaves[1]);
        let c = *leaves.last().unwrap();
        let of = |nodes: Vec<SolidNode>| profile(nodes, origin, direction);
        let (or, and, less) =
            (operation(Union, 2), operation(Intersection, 2), operation(Difference, 2));
        let same = |x: Vec<SolidNode>, y: Vec<SolidNode>| assert_eq!(of(x), of(y));

        assert_eq!(of(vec![a, a, less]), []);
        same(vec![a, a, or], vec![a, a, and]);
        same(vec![a, b, or], vec![b, a, or]);
        same(vec![a, b, and], vec![b, a, and]);
        same(vec![a, b, or, c, or], vec![a, b, c, operation(Union, 3)]);
        same(vec![a, b, and, c, and], vec![a, b, c, operation(Intersection, 3)]);
        same(vec![a, b, less, c, less], vec![a, b, c, operation(Difference, 3)]);
        same(vec![a, b, c, or, less], vec![a, b, less, a, c, less, and]);
        same(vec![a, b, c, and, less], vec![a, b, less, a, c, less, or]);
        same(vec![a, a, b, or, and], vec![a, a, or]);
        same(vec![a, a, b, less, less], vec![a, b, and]);
    });
}
