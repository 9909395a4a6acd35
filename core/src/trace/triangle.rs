//! Where a ray meets a triangle.

use super::ray::{Projected, edge, exact_edge, side};

/// The distance at which the ray crosses the triangle as it sees it, in units of its direction,
/// before or behind its origin; `None` where it passes by.
///
/// Source: Woop, Benthin & Wald, "Watertight Ray/Triangle Intersection" (2013), with an exact rule
/// for edges in place of counting both sides. The distance is held between those of the corners,
/// so a needle that is grazed is never met outside itself.
#[inline(always)]
pub(super) fn hit_triangle(corners: [Projected; 3]) -> Option<f64> {
    hit_triangle_in_doubt(corners, &mut false)
}

/// The same; sets `is_in_doubt` where rounded products do not suffice and their lost digits are
/// asked.
#[inline(always)]
pub(super) fn hit_triangle_in_doubt(
    [a, b, c]: [Projected; 3],
    is_in_doubt: &mut bool,
) -> Option<f64> {
    let mut over = [edge(&b, &c), edge(&c, &a), edge(&a, &b)];
    if over.iter().any(|&w| w < 0.0) && over.iter().any(|&w| w > 0.0) {
        return None;
    }
    if over.contains(&0.0) {
        *is_in_doubt = true;
        let sides = [side(&b, &c), side(&c, &a), side(&a, &b)];
        if sides[0] == 0 || sides[0] != sides[1] || sides[1] != sides[2] {
            return None;
        }
    }
    // In a needle, and in any triangle seen edge-on, products cancel: without their lost digits
    // the distance would be that of some other point of the triangle.
    let extent = [a, b, c].iter().map(|p| p.x.abs().max(p.y.abs())).fold(0.0, f64::max);
    if (over[0] + over[1] + over[2]).abs() <= extent * extent / 8.0 {
        *is_in_doubt = true;
        over = [exact_edge(&b, &c), exact_edge(&c, &a), exact_edge(&a, &b)];
    }
    let area = over[0] + over[1] + over[2];
    if area == 0.0 {
        return None; // Smaller than numbers go.
    }
    let t = (over[0] * a.z + over[1] * b.z + over[2] * c.z) / area;
    Some(t.max(a.z.min(b.z).min(c.z)).min(a.z.max(b.z).max(c.z)))
}

/// The sine of the angle between a ray and a face below which the face is as good as seen edge-on.
pub(super) const EDGE_ON: f64 = 1.0 / 1_048_576.0;
