//! Where a ray meets a sphere.

use glam::DVec3;

use super::ray::Ray;

/// The two distances at which the ray's line crosses the sphere, the nearer one first, in units
/// of its direction, before or behind its origin; `None` where it passes by or only touches.
///
/// Source: Haines, Günther & Akenine-Möller, "Precision Improvements for Ray/Sphere
/// Intersection", Ray Tracing Gems (2019), ch. 7. The textbook quadratic frays a sphere that is
/// seen from afar, and loses a camera's height just above a large one.
#[inline(always)]
pub(super) fn hit_sphere(ray: &Ray, center: DVec3, radius: f64) -> Option<[f64; 2]> {
    let to_origin = ray.origin - center;
    let half_b = -to_origin.dot(ray.direction); // The direction has length 1, so a = 1.

    // At the closest approach numbers are small; b² - c would subtract two huge ones.
    let closest = (to_origin + half_b * ray.direction).length();
    let quarter_discriminant = (radius - closest) * (radius + closest);
    if quarter_discriminant <= 0.0 {
        return None;
    }

    // Adding terms of one sign loses no bits; the other root follows from their product, c.
    let far = half_b + quarter_discriminant.sqrt().copysign(half_b);
    let distance = to_origin.length();
    let other = (distance - radius) * (distance + radius) / far;
    Some([far.min(other), far.max(other)])
}

/// The distance at which a ray that starts on the sphere crosses it again; <= 0 when it goes out.
/// The root at the start is known to be 0 and is not computed.
#[inline(always)]
pub(super) fn hit_sphere_again(ray: &Ray, center: DVec3) -> f64 {
    -2.0 * (ray.origin - center).dot(ray.direction)
}
