//! Where a ray meets a quadrangle: a primitive of its own, convex or not.

use glam::DVec3;

use super::{
    ray::{Projected, Ray, edge, exact_edge, side},
    triangle::EDGE_ON,
};

/// Whether the ray passes inside the polygon as it sees it: edges that cross a half-line from the
/// ray are counted. Exact for the projected vertices, with the rule for edges and vertices that
/// triangles have, so that neighbours of either kind leave no crack and no overlap.
///
/// Source: Shimrat, "Algorithm 112: Position of point relative to polygon" (1962).
#[inline(always)]
pub(super) fn is_inside(corners: &[Projected; 4]) -> bool {
    is_inside_in_doubt(corners, &mut false)
}

/// The same; sets `is_in_doubt` where rounded products do not suffice and their lost digits are
/// asked.
#[inline(always)]
pub(super) fn is_inside_in_doubt(corners: &[Projected; 4], is_in_doubt: &mut bool) -> bool {
    let mut inside = false;
    for (k, a) in corners.iter().enumerate() {
        let b = &corners[(k + 1) % 4];
        // The nudged ray lies just above y = 0.
        let upward = b.y > 0.0;
        if upward != (a.y > 0.0) {
            let rounded = edge(a, b);
            let left = if rounded == 0.0 {
                *is_in_doubt = true;
                side(a, b) > 0
            } else {
                rounded > 0.0
            };
            inside ^= left == upward;
        }
    }
    inside
}

/// The distance to a plane; `None` for a ray that as good as runs along it, for which the division
/// would give any place in the plane.
#[inline(always)]
pub(super) fn hit_plane(ray: &Ray, point: DVec3, normal: DVec3) -> Option<f64> {
    let (distance, along) = toward_plane(ray, point, normal);
    (along.abs() > EDGE_ON).then(|| distance / along)
}

/// How far a plane is from the ray's start, and how fast the ray goes there, both along its
/// normal: the same for all faces in the plane.
#[inline(always)]
pub(super) fn toward_plane(ray: &Ray, point: DVec3, normal: DVec3) -> (f64, f64) {
    (normal.dot(point - ray.origin), normal.dot(ray.direction))
}

/// The distance of a quadrangle seen edge-on, by interpolation between the two edges right and
/// left of the ray.
#[cold]
pub(super) fn hit_chord(corners: &[Projected; 4]) -> f64 {
    let [mut left, mut right] = [(f64::NEG_INFINITY, 0.0), (f64::INFINITY, 0.0)];
    for (k, a) in corners.iter().enumerate() {
        let b = &corners[(k + 1) % 4];
        if (a.y > 0.0) != (b.y > 0.0) {
            let (x, z) = (exact_edge(a, b) / (b.y - a.y), (a.z * b.y - b.z * a.y) / (b.y - a.y));
            let is_right = (side(a, b) > 0) == (b.y > 0.0);
            if is_right && x < right.0 {
                right = (x, z);
            } else if !is_right && x > left.0 {
                left = (x, z);
            }
        }
    }
    let width = right.0 - left.0;
    let t = if width > 0.0 { (left.1 * right.0 - right.1 * left.0) / width } else { left.1 };
    let [a, b, c, d] = corners.map(|corner| corner.z);
    t.max(a.min(b).min(c.min(d))).min(a.max(b).max(c.max(d)))
}
