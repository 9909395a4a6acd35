//! Light from points, spheres, polygons and discs.

#![expect(clippy::disallowed_methods, reason = "an arc's last bits decide nothing")]

use std::f64::consts::PI;

use glam::DVec3;

/// What a point with this unit normal receives from a light of an intensity of 1:
/// max(0, cos θ) / r².
pub fn irradiance(light: DVec3, point: DVec3, normal: DVec3) -> f64 {
    let to_light = light - point;
    let distance = to_light.length();
    (normal.dot(to_light) / distance).max(0.0) / (distance * distance)
}

/// The share of what a small patch sends out that reaches a sphere, which is the irradiance of
/// the patch, over π, if the sphere's radiance is 1. `distance` is that of the centre over the
/// radius, at least 1, `cosine` that of the angle between the patch's normal and the centre. A
/// sphere that the patch's own plane cuts counts above it only.
///
/// Source: Naraghi & Chung, "Radiation Configuration Factors Between Disks and a Class of
/// Axisymmetric Bodies" (1982); Howell, "A Catalog of Radiation Transfer Configuration Factors",
/// B-43.
pub fn patch_to_sphere(distance: f64, cosine: f64) -> f64 {
    let squared = distance * distance;
    if cosine * distance >= 1.0 {
        return cosine / squared;
    }
    if cosine * distance <= -1.0 {
        return 0.0;
    }
    let sine = ((1.0 - cosine) * (1.0 + cosine)).sqrt();
    let x = (squared - 1.0).sqrt();
    let y = -x * cosine / sine;
    let rest = ((1.0 - y) * (1.0 + y)).sqrt();
    (cosine * y.acos() - x * sine * rest) / (PI * squared) + (sine * rest / x).atan() / PI
}

/// The share of what a small patch at `point` sends out that reaches a polygon, wholly above the
/// patch's plane and counter-clockwise seen from it.
///
/// Source: Lambert, "Photometria" (1760): the sum over the edges of the angle that an edge is
/// seen under times the cosine between the patch's normal and that of the edge's plane, over 2π.
pub fn patch_to_polygon(point: DVec3, normal: DVec3, corners: &[DVec3]) -> f64 {
    let edge = |k: usize| {
        let (p, q) = (corners[k] - point, corners[(k + 1) % corners.len()] - point);
        let across = p.cross(q);
        let angle = across.length().atan2(p.dot(q));
        angle * normal.dot(across.normalize())
    };
    (0..corners.len()).map(edge).sum::<f64>() / (2.0 * PI)
}

/// The light of one bounce anywhere on the inside of a sphere of this radius that sends back
/// `reflectance` of what it receives from a light of an intensity of 1, wherever in it that is.
pub fn integrating_sphere_bounce(reflectance: f64, radius: f64) -> f64 {
    reflectance / (radius * radius)
}

/// The light of one bounce at a point that faces a disc of `radius` straight below it, from the
/// same `height` as a light of an intensity of 1 next to it; the disc sends back `reflectance`.
/// An infinite radius is a plane.
pub fn one_bounce_from_disc(reflectance: f64, height: f64, radius: f64) -> f64 {
    let edge = (height * height + radius * radius).sqrt();
    0.4 * reflectance * height.powi(3) * (height.powi(-5) - edge.powi(-5))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Random;

    /// ∫ f over 0..1 by midpoints.
    fn integrate(steps: u32, f: impl Fn(f64) -> f64) -> f64 {
        let step = 1.0 / f64::from(steps);
        (0..steps).map(|k| f((f64::from(k) + 0.5) * step) * step).sum()
    }

    #[test]
    fn a_light_above_a_plane_falls_with_the_cube() {
        for r in [0.0, 0.5, 3.0] {
            let (h, light) = (2f64, DVec3::new(0.0, 0.0, 2.0));
            let expected = h / (h * h + r * r).powf(1.5);
            let found = irradiance(light, DVec3::new(0.0, r, 0.0), DVec3::Z);
            assert!((found - expected).abs() < 1e-15);
        }
        assert_eq!(irradiance(-DVec3::Z, DVec3::ZERO, DVec3::Z), 0.0);
    }

    #[test]
    fn a_patch_sends_to_a_sphere_what_integration_finds() {
        for (distance, cosine) in [
            (2.0, 1.0),
            (2.0, 0.7),
            (2.0, 0.3),
            (2.0, 0.0),
            (2.0, -0.4),
            (1.1, 0.5),
            (1.1, -0.8),
            (50.0, 0.01),
            (50.0, -0.01),
            (3.0, -0.9),
        ] {
            // Over the cone of directions to the sphere, about its axis.
            let sine = (1.0f64 - cosine * cosine).sqrt();
            let edge = 1.0 - 1.0 / (distance * distance);
            let edge = f64::sqrt(edge);
            let expected = integrate(600, |u| {
                let along = edge + (1.0 - edge) * u;
                let aside = (1.0 - along * along).sqrt();
                integrate(600, |v| {
                    let turn = (2.0 * PI * v).cos();
                    (along * cosine + aside * turn * sine).max(0.0)
                })
            });
            let expected = expected * 2.0 * (1.0 - edge);
            let found = patch_to_sphere(distance, cosine);
            let close = 2e-5 * expected.max(1e-4);
            assert!((found - expected).abs() < close, "{distance} {cosine} {found} {expected}");
        }
    }

    #[test]
    fn a_patch_sends_to_a_polygon_what_integration_finds() {
        let mut random = Random::new(8);
        for _ in 0..10 {
            let corners = [0; 3].map(|_| DVec3::new(0.0, 0.0, 2.0) + random.in_cube());
            let (u, v) = (corners[1] - corners[0], corners[2] - corners[0]);
            let normal = u.cross(v);
            let expected = integrate(300, |a| {
                integrate(300, |b| {
                    // The half of the parallelogram that is the triangle.
                    let at = corners[0] + u * a * (1.0 - b) + v * b;
                    let squared = at.length_squared();
                    at.z * normal.dot(at).abs() / (squared * squared) * (1.0 - b)
                })
            }) / PI;
            let corners = if normal.dot(corners[0]) > 0.0 {
                corners
            } else {
                [corners[0], corners[2], corners[1]]
            };
            let found = patch_to_polygon(DVec3::ZERO, DVec3::Z, &corners);
            assert!((found - expected).abs() < 1e-5, "{found} {expected}");
        }
    }

    #[test]
    fn a_disc_sends_back_what_integration_finds() {
        let (height, radius, reflectance) = (1.5, 4.0, 0.6);
        let expected = integrate(20_000, |u| {
            let r = u * radius;
            let squared = height * height + r * r;
            let received = height / squared.powf(1.5);
            received * height * height / (squared * squared) * 2.0 * r * radius
        }) * reflectance;
        let found = one_bounce_from_disc(reflectance, height, radius);
        assert!((found - expected).abs() < 1e-8 * expected, "{found} {expected}");
        let plane = one_bounce_from_disc(reflectance, height, f64::INFINITY);
        assert!((plane - 0.4 * reflectance / (height * height)).abs() < 1e-15);
    }

    #[test]
    fn an_integrating_sphere_gives_the_same_everywhere() {
        let (radius, reflectance) = (2.0, 0.5);
        let light = DVec3::new(0.0, 0.9, 1.2);
        let point = DVec3::new(radius, 0.0, 0.0);
        // From every place of the sphere the same share of what it sends back: 1 / 4πr².
        let sum = integrate(400, |u| {
            let z = 2.0 * u - 1.0;
            let aside = (1.0 - z * z).sqrt();
            integrate(400, |v| {
                let (sin, cos) = (2.0 * PI * v).sin_cos();
                let normal = -DVec3::new(aside * cos, aside * sin, z);
                irradiance(light, -radius * normal, normal)
            })
        });
        assert!((reflectance * sum - integrating_sphere_bounce(reflectance, radius)).abs() < 1e-4);
        // Between two places of a sphere the two cosines make up for the distance.
        let other = radius * DVec3::new(0.6, 0.0, -0.8);
        let between = point - other;
        let cosines = (point.dot(between) / (radius * between.length())).powi(2);
        let share = cosines / (PI * between.length_squared());
        assert!((share - 1.0 / (4.0 * PI * radius * radius)).abs() < 1e-15);
    }
}
