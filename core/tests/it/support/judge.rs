//! The tracer's answers against the oracle's, ray by ray.

use glam::DVec3;
use rtfarm_core::{
    scene::{Parallelepiped, Scene, SolidNode},
    testing::{Probe, ProbeHit},
};
use rtfarm_oracle::{FaceId, Leaving, Oracle};

/// Where the true answer changes within this distance (in units of the greatest coordinate that
/// takes part) either answer is right: a few roundings of f64.
const CLOSE: f64 = 256.0 * f64::EPSILON;

/// A quadrangle's corners are in one plane only within rounding. The oracle looks at it along its
/// normal, the tracer along the ray: for one that is grazed that makes a difference.
const CLOSE_QUADRANGLE: f64 = 1e-9;

/// The same answer, or one that is right within the roundings of f64.
pub(crate) fn check_against_oracle(
    (scene, oracle): (&Scene, &Oracle),
    probe: &Probe,
    found: Option<ProbeHit>,
    what: &str,
) -> bool {
    let leaving = probe
        .leaving
        .map(|(primitive, face)| Leaving { id: FaceId { primitive, face }, through: false });
    let truth = oracle.first_hit(probe.origin, probe.direction, leaving);
    if truth.map(|hit| (hit.id.primitive, hit.id.face))
        != found.map(|hit| (hit.primitive, hit.face))
    {
        let margin = oracle.miss_margin(probe.origin, probe.direction, leaving);
        let involved = [truth.map(|hit| hit.id.primitive), found.map(|hit| hit.primitive)];
        let is_quadrangle = scene.quadrangles.iter().any(|q| involved.contains(&Some(q.primitive)));
        let close = if is_quadrangle { CLOSE_QUADRANGLE } else { CLOSE };
        assert!(margin < close, "{what}: {probe:?}: {found:?} but truly {truth:?}");
        return false;
    }
    if let (Some(hit), Some(found)) = (truth, found) {
        // Across the face; along the ray it grows as the ray grazes.
        let error = (hit.t - found.t).abs() * hit.normal.dot(probe.direction).abs();
        let extent = oracle_extent(scene, found.primitive);
        let scale = probe.origin.abs().max_element().max(hit.point.abs().max_element()).max(extent);
        let bound = CLOSE * scale;
        assert!(
            error <= bound,
            "{what}: {probe:?}: t {} but truly {hit:?}, scale {scale}",
            found.t
        );
    }
    true
}

/// The greatest coordinate of a face.
fn oracle_extent(scene: &Scene, primitive: u32) -> f64 {
    let corners = (scene.triangles.iter())
        .filter(|face| face.primitive == primitive)
        .flat_map(|face| face.vertices)
        .chain(
            (scene.quadrangles.iter())
                .filter(|face| face.primitive == primitive)
                .flat_map(|face| face.vertices),
        );
    let spheres = (scene.spheres.iter())
        .filter(|sphere| sphere.primitive == primitive)
        .map(|sphere| sphere.center.abs() + sphere.radius);
    let reach = |solid: &Parallelepiped| {
        solid.edges.iter().fold(solid.corner.abs(), |reach, edge| reach + edge.abs())
    };
    let boxes =
        (scene.parallelepipeds.iter()).filter(|solid| solid.primitive == primitive).map(reach);
    let leaves = (scene.solids.iter())
        .filter(|solid| solid.primitive == primitive)
        .flat_map(|solid| &solid.nodes)
        .map(|node| match node {
            SolidNode::Sphere(sphere) => sphere.center.abs() + sphere.radius,
            SolidNode::Parallelepiped(solid) => reach(solid),
            SolidNode::Operation { .. } => DVec3::ZERO,
        });
    corners
        .chain(spheres)
        .chain(boxes)
        .chain(leaves)
        .map(|corner| corner.abs().max_element())
        .fold(0.0, f64::max)
}
