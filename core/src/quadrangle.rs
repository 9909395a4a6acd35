//! Where a ray meets a quadrangle: a primitive of its own, convex or not.

use glam::DVec3;

use crate::ray::{Projected, Ray, edge, side};

/// Whether the ray passes inside the polygon as it sees it: edges that cross a half-line from the
/// ray are counted. Exact for the projected vertices, with the rule for edges and vertices that
/// triangles have, so that neighbours of either kind leave no crack and no overlap.
///
/// Source: Shimrat, "Algorithm 112: Position of point relative to polygon" (1962).
#[inline(always)]
pub(crate) fn is_inside(corners: &[Projected; 4]) -> bool {
    let mut inside = false;
    for (k, a) in corners.iter().enumerate() {
        let b = &corners[(k + 1) % 4];
        // The nudged ray lies just above y = 0.
        let upward = b.y > 0.0;
        if upward != (a.y > 0.0) {
            let rounded = edge(a, b);
            let left = if rounded == 0.0 { side(a, b) > 0 } else { rounded > 0.0 };
            inside ^= left == upward;
        }
    }
    inside
}

/// The distance at which the ray crosses the quadrangle in the plane through `point` with
/// `normal` (of any length), in units of its direction; `None` where it passes by.
#[inline(always)]
pub(crate) fn hit_quadrangle(
    ray: &Ray,
    corners: &[Projected; 4],
    point: DVec3,
    normal: DVec3,
) -> Option<f64> {
    if !is_inside(corners) {
        return None;
    }
    let t = hit_plane(ray, point, normal)?;
    let [a, b, c, d] = corners.map(|corner| corner.z);
    Some(t.max(a.min(b).min(c.min(d))).min(a.max(b).max(c.max(d))))
}

/// The distance to a plane; `None` for a ray along it.
#[inline(always)]
pub(crate) fn hit_plane(ray: &Ray, point: DVec3, normal: DVec3) -> Option<f64> {
    let along = normal.dot(ray.direction);
    (along != 0.0).then(|| normal.dot(point - ray.origin) / along)
}
