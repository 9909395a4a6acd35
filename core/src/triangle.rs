//! Where a ray meets a triangle.

use glam::DVec3;

use crate::{
    prepared::power_of_two_below_inverse,
    ray::{Projected, edge, exact_edge, side},
};

/// The distance at which the ray crosses the triangle as it sees it, in units of its direction,
/// before or behind its origin; `None` where it passes by.
///
/// Source: Woop, Benthin & Wald, "Watertight Ray/Triangle Intersection" (2013), with an exact rule
/// for edges in place of counting both sides. The distance is held between those of the corners,
/// so a needle that is grazed is never met outside itself.
#[inline(always)]
pub(crate) fn hit_triangle([a, b, c]: [Projected; 3]) -> Option<f64> {
    let (mut over_a, mut over_b, mut over_c) = (edge(&b, &c), edge(&c, &a), edge(&a, &b));
    if (over_a < 0.0 || over_b < 0.0 || over_c < 0.0)
        && (over_a > 0.0 || over_b > 0.0 || over_c > 0.0)
    {
        return None;
    }
    if over_a == 0.0 || over_b == 0.0 || over_c == 0.0 {
        let sides = [side(&b, &c), side(&c, &a), side(&a, &b)];
        if sides[0] == 0 || sides[0] != sides[1] || sides[1] != sides[2] {
            return None;
        }
        (over_a, over_b, over_c) = (exact_edge(&b, &c), exact_edge(&c, &a), exact_edge(&a, &b));
    }
    let area = over_a + over_b + over_c;
    if area == 0.0 {
        return None; // Smaller than numbers go.
    }
    let t = (over_a * a.z + over_b * b.z + over_c * c.z) / area;
    Some(t.max(a.z.min(b.z).min(c.z)).min(a.z.max(b.z).max(c.z)))
}

/// The unit normal towards the side that sees the corners counter-clockwise. Edges are first
/// scaled by a power of two, so that no triangle is too small for its area to be a number.
pub(crate) fn triangle_normal([a, b, c]: [DVec3; 3]) -> DVec3 {
    let (u, v) = (b - a, c - a);
    let u = u * power_of_two_below_inverse(u.abs().max_element());
    let v = v * power_of_two_below_inverse(v.abs().max_element());
    let normal = u.cross(v);
    normal / normal.length()
}
