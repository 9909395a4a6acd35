//! How much of a pixel a shape covers. Places on the screen are in pixels from its top left.

#![expect(clippy::disallowed_methods, reason = "an arc's last bits decide nothing")]

use std::f64::consts::{PI, TAU};

use glam::{DMat2, DVec2, DVec3};
use rtfarm_core::{scene::Viewport, tile::Size};

/// The points center + matrix · (unit disc).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ellipse {
    /// The middle.
    pub center: DVec2,
    /// Its columns are two conjugate half axes.
    pub axes: DMat2,
}

/// What a sphere covers on the screen; `None` unless it is an ellipse, wholly before the eye.
///
/// In the plane at distance 1 from the eye, with α the angle between its normal and the sphere's
/// middle, sin σ = radius / distance and D = cos²α - sin²σ, the ellipse is centred at
/// sin α cos α / D, its half axes are sin σ cos σ / D in that direction and sin σ / √D across: the
/// extremes are at tan(α ± σ).
pub fn sphere_outline(
    viewport: &Viewport,
    size: Size,
    center: DVec3,
    radius: f64,
) -> Option<Ellipse> {
    let screen = Screen::new(viewport, size);
    let to_center = center - viewport.eye;
    let distance = to_center.length();
    let (height, aside) = screen.split(to_center);
    let (cos_alpha, sin_alpha) = (height / distance, aside.length() / distance);
    let sin_sigma = radius / distance;
    // cos²α - sin²σ, where it is above zero and all lies before the eye.
    let d = (cos_alpha - sin_sigma) * (cos_alpha + sin_sigma);
    if cos_alpha <= sin_sigma || sin_sigma >= 1.0 {
        return None;
    }
    let cos_sigma = ((1.0 - sin_sigma) * (1.0 + sin_sigma)).sqrt();
    let along = if sin_alpha > 0.0 { aside.normalize() } else { screen.right.normalize() };
    let across = along.cross(screen.normal);

    let middle = screen.normal + along * (sin_alpha * cos_alpha / d);
    let half_axes = [along * (sin_sigma * cos_sigma / d), across * (sin_sigma / d.sqrt())];
    let [x, y] = half_axes.map(|axis| screen.in_pixels(axis * screen.distance));
    Some(Ellipse {
        center: screen.in_pixels(middle * screen.distance - screen.top_left),
        axes: DMat2::from_cols(x, y),
    })
}

/// What a polygon covers on the screen, corner by corner; `None` unless it is wholly before the
/// eye.
pub fn polygon_outline(viewport: &Viewport, size: Size, corners: &[DVec3]) -> Option<Vec<DVec2>> {
    let screen = Screen::new(viewport, size);
    let project = |&corner: &DVec3| {
        let to_corner = corner - viewport.eye;
        let (height, _) = screen.split(to_corner);
        let on_screen = to_corner * (screen.distance / height);
        (height > 0.0).then(|| screen.in_pixels(on_screen - screen.top_left))
    };
    corners.iter().map(project).collect()
}

/// The screen as seen from the eye.
struct Screen {
    top_left: DVec3,
    /// One pixel to the right and down.
    right: DVec3,
    down: DVec3,
    /// The unit normal that leads away from the eye, and how far.
    normal: DVec3,
    distance: f64,
}

impl Screen {
    fn new(viewport: &Viewport, size: Size) -> Self {
        let top_left = viewport.top_left - viewport.eye;
        let right = (viewport.top_right - viewport.top_left) / f64::from(size.width());
        let down = (viewport.bottom_left - viewport.top_left) / f64::from(size.height());
        let normal = right.cross(down).normalize();
        let distance = normal.dot(top_left);
        let normal = normal * distance.signum();
        Self { top_left, right, down, normal, distance: distance.abs() }
    }

    /// The part along the normal and the rest.
    fn split(&self, vector: DVec3) -> (f64, DVec3) {
        let height = self.normal.dot(vector);
        (height, vector - height * self.normal)
    }

    /// A vector in the screen's plane as x · right + y · down.
    fn in_pixels(&self, vector: DVec3) -> DVec2 {
        let normal = self.right.cross(self.down);
        let squared = normal.length_squared();
        let x = vector.cross(self.down).dot(normal) / squared;
        let y = self.right.cross(vector).dot(normal) / squared;
        DVec2::new(x, y)
    }
}

impl Ellipse {
    /// The whole area.
    pub fn area(&self) -> f64 {
        PI * self.axes.determinant().abs()
    }

    /// The share of the pixel (x, y) that is covered.
    pub fn coverage(&self, x: u32, y: u32) -> f64 {
        // Where the ellipse is the unit disc the pixel is a parallelogram.
        let to_disc = self.axes.inverse();
        let mut corners = pixel_corners(x, y).map(|corner| to_disc * (corner - self.center));
        if self.axes.determinant() < 0.0 {
            corners.reverse();
        }
        self.axes.determinant().abs() * area_in_unit_disc(&corners)
    }
}

/// The area that a convex counter-clockwise polygon shares with the unit disc: a polygon whose
/// corners are those inside and the crossings with the circle, and the disc's segments beyond its
/// chords.
fn area_in_unit_disc(corners: &[DVec2]) -> f64 {
    let mut outline = Vec::new();
    let mut is_arc_before = Vec::new();
    for (k, &p) in corners.iter().enumerate() {
        let q = corners[(k + 1) % corners.len()];
        let Some((start, end)) = chord(p, q) else { continue };
        // An edge that starts outside is reached along the circle.
        outline.push(p + (q - p) * start);
        is_arc_before.push(start > 0.0);
        if end < 1.0 {
            outline.push(p + (q - p) * end);
            is_arc_before.push(false);
        }
    }
    if outline.is_empty() {
        let is_around = corners
            .iter()
            .enumerate()
            .all(|(k, &p)| p.perp_dot(corners[(k + 1) % corners.len()]) > 0.0);
        return if is_around { PI } else { 0.0 };
    }
    let segments: f64 = (0..outline.len())
        .filter(|&k| is_arc_before[k])
        .map(|k| segment(outline[(k + outline.len() - 1) % outline.len()], outline[k]))
        .sum();
    area(&outline) + segments
}

/// The part of p + t (q - p), 0 <= t <= 1, inside the unit disc.
fn chord(p: DVec2, q: DVec2) -> Option<(f64, f64)> {
    let direction = q - p;
    let (a, b) = (direction.length_squared(), p.dot(direction));
    let c = (p.length() - 1.0) * (p.length() + 1.0);
    // b² - ac, without cancellation.
    let discriminant = a - p.perp_dot(direction).powi(2);
    if discriminant <= 0.0 {
        return None;
    }
    let sum = -b - discriminant.sqrt().copysign(b);
    let (first, second) = (sum / a, c / sum);
    let (start, end) = (first.min(second).max(0.0), first.max(second).min(1.0));
    (start < end).then_some((start, end))
}

/// The area between the arc from `p` counter-clockwise to `q`, both on the unit circle, and its
/// chord.
fn segment(p: DVec2, q: DVec2) -> f64 {
    let angle = p.perp_dot(q).atan2(p.dot(q)).rem_euclid(TAU);
    if angle < 0.1 {
        // angle - sin(angle) cancels; of its series the next term is below 2e-15 of the first.
        let square = angle * angle;
        let tail = 1.0 / 120.0 - square * (1.0 / 5_040.0 - square / 362_880.0);
        angle * square * (1.0 / 6.0 - square * tail) / 2.0
    } else {
        (angle - angle.sin()) / 2.0
    }
}

/// The share of the pixel (x, y) that a simple polygon covers.
pub fn polygon_coverage(outline: &[DVec2], x: u32, y: u32) -> f64 {
    area(&clip_to_pixel(outline, x, y)).abs()
}

/// The part of a polygon in the pixel (x, y). The result of a concave one may run back and forth
/// along the pixel's border, which adds no area.
///
/// Source: Sutherland & Hodgman, "Reentrant Polygon Clipping" (1974).
pub fn clip_to_pixel(outline: &[DVec2], x: u32, y: u32) -> Vec<DVec2> {
    let low = DVec2::new(f64::from(x), f64::from(y));
    let high = low + 1.0;
    let heights: [&dyn Fn(DVec2) -> f64; 4] =
        [&|p| p.x - low.x, &|p| high.x - p.x, &|p| p.y - low.y, &|p| high.y - p.y];
    heights.iter().fold(outline.to_vec(), |outline, height| clip(&outline, height))
}

/// The part of a polygon where `height` is not below zero.
fn clip(outline: &[DVec2], height: &dyn Fn(DVec2) -> f64) -> Vec<DVec2> {
    let mut clipped = Vec::new();
    for (k, &p) in outline.iter().enumerate() {
        let q = outline[(k + 1) % outline.len()];
        let (at_p, at_q) = (height(p), height(q));
        if at_p >= 0.0 {
            clipped.push(p);
        }
        if (at_p >= 0.0) != (at_q >= 0.0) {
            clipped.push(p + (q - p) * (at_p / (at_p - at_q)));
        }
    }
    clipped
}

/// The area of a polygon, above zero if its corners run from x towards y. Taken about the first
/// corner, so that it keeps its digits far from the origin.
pub fn area(outline: &[DVec2]) -> f64 {
    let Some((&first, rest)) = outline.split_first() else { return 0.0 };
    rest.windows(2).map(|pair| (pair[0] - first).perp_dot(pair[1] - first)).sum::<f64>() / 2.0
}

/// The mean between two coordinates of a wave that is 1 from 0 to 1/2, -1 from there to 1, and so
/// on, but for edges that slope over `slope` units, at most 1/2: what interpolation makes of a row
/// of texels.
pub fn wave_mean(from: f64, to: f64, slope: f64) -> f64 {
    let half = slope / 2.0;
    let up_to = |x: f64| {
        // The wave is as far above 0 before 1/2 as it is below after it.
        let part = x - x.floor();
        let part = part.min(1.0 - part);
        if part < half {
            part * part / slope
        } else {
            let beyond = (part - (0.5 - half)).max(0.0);
            part - half / 2.0 - beyond * beyond / slope
        }
    };
    (up_to(to) - up_to(from)) / (to - from)
}

fn pixel_corners(x: u32, y: u32) -> [DVec2; 4] {
    let corner = DVec2::new(f64::from(x), f64::from(y));
    [corner, corner + DVec2::X, corner + DVec2::ONE, corner + DVec2::Y]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{picture::eye_direction, random::Random};

    fn viewport() -> Viewport {
        // Sheared, left-handed, and the eye off the axis.
        Viewport {
            eye: DVec3::new(0.3, -0.2, 0.1),
            top_left: DVec3::new(-1.0, -0.75, 2.0),
            bottom_left: DVec3::new(-0.9, 0.75, 2.2),
            top_right: DVec3::new(1.0, -0.8, 1.9),
        }
    }

    fn size() -> Size {
        Size::new(20, 15).unwrap()
    }

    /// The share of a pixel whose points satisfy `covers`, by midpoints of `side`² squares.
    fn numeric(x: u32, y: u32, side: u32, covers: impl Fn(DVec2) -> bool) -> f64 {
        let center = |k: u32| (f64::from(k) + 0.5) / f64::from(side);
        let corner = DVec2::new(f64::from(x), f64::from(y));
        let inside = (0..side * side)
            .filter(|k| covers(corner + DVec2::new(center(k % side), center(k / side))))
            .count();
        inside as f64 / f64::from(side * side)
    }

    #[test]
    fn a_sphere_covers_what_its_rays_hit() {
        let mut random = Random::new(5);
        for _ in 0..20 {
            let center = DVec3::new(0.0, 0.0, 5.0) + 1.5 * random.in_cube();
            let radius = random.log_uniform(0.05, 1.0);
            let outline = sphere_outline(&viewport(), size(), center, radius).unwrap();
            let covers = |at: DVec2| {
                let direction = eye_direction(&viewport(), size(), at.x, at.y).normalize();
                (center - viewport().eye).cross(direction).length() < radius
            };
            let mut sum = 0.0;
            for y in 0..15 {
                for x in 0..20 {
                    let coverage = outline.coverage(x, y);
                    sum += coverage;
                    let expected = numeric(x, y, 32, covers);
                    assert!((coverage - expected).abs() < 0.02, "{x} {y} {coverage} {expected}");
                }
            }
            let is_on_screen = (0..64).map(f64::from).all(|k| {
                let (sin, cos) = (k * TAU / 64.0).sin_cos();
                let at = outline.center + outline.axes * DVec2::new(cos, sin);
                (0.0..20.0).contains(&at.x) && (0.0..15.0).contains(&at.y)
            });
            assert!(!is_on_screen || (sum - outline.area()).abs() < 1e-12 * outline.area());
        }
    }

    #[test]
    fn the_area_of_an_outline_is_that_of_the_formula() {
        // π sin²σ cos σ / (cos²α - sin²σ)^(3/2) at distance 1, here in pixels of 0.1 x 0.1.
        let viewport = Viewport {
            eye: DVec3::ZERO,
            top_left: DVec3::new(-1.0, 1.0, 1.0),
            bottom_left: DVec3::new(-1.0, -1.0, 1.0),
            top_right: DVec3::new(1.0, 1.0, 1.0),
        };
        let (size, center, radius) = (Size::new(20, 20).unwrap(), DVec3::new(1.0, 0.5, 3.0), 0.7);
        let distance = center.length();
        let (cos_alpha, sin_sigma) = (center.z / distance, radius / distance);
        let cos_sigma = (1.0 - sin_sigma * sin_sigma).sqrt();
        let d = cos_alpha * cos_alpha - sin_sigma * sin_sigma;
        let expected = PI * sin_sigma * sin_sigma * cos_sigma / d.powi(3).sqrt() * 100.0;
        let outline = sphere_outline(&viewport, size, center, radius).unwrap();
        assert!((outline.area() - expected).abs() < 1e-13 * expected);
    }

    #[test]
    fn a_disc_shares_known_areas_with_polygons() {
        let square = |low: f64, high: f64| {
            [(low, low), (high, low), (high, high), (low, high)].map(DVec2::from)
        };
        let check = |corners: &[DVec2], expected: f64| {
            let found = area_in_unit_disc(corners);
            assert!((found - expected).abs() < 1e-15, "{found} instead of {expected}");
        };
        check(&square(-2.0, 2.0), PI);
        check(&square(-0.5, 0.5), 1.0);
        check(&square(0.0, 2.0), PI / 4.0);
        check(&square(1.0, 2.0), 0.0);
        // Everything but four segments of height 0.2.
        let cut = 0.8f64;
        let segment = cut.acos() - cut * (1.0 - cut * cut).sqrt();
        check(&square(-cut, cut), PI - 4.0 * segment);
        // A half plane beyond y = 1/2, as a large triangle.
        let beyond = [(-9.0, 0.5), (9.0, 0.5), (0.0, 9.0)].map(DVec2::from);
        check(&beyond, PI / 3.0 - 3f64.sqrt() / 4.0);
    }

    #[test]
    fn tiny_and_huge_spheres_keep_their_digits() {
        let viewport = viewport();
        // Some 1e-6 of a pixel, wholly in one.
        let far = viewport.eye + 1e6 * eye_direction(&viewport, size(), 7.3, 4.6);
        let outline = sphere_outline(&viewport, size(), far, 0.1).unwrap();
        assert!((outline.coverage(7, 4) - outline.area()).abs() < 1e-12 * outline.area());
        // So large that its edge is almost straight.
        let away = eye_direction(&viewport, size(), 10.0, 7.0).normalize();
        let aside = away.any_orthonormal_vector();
        let near = viewport.eye + away * 1e4 + aside * 0.5e4;
        let outline = sphere_outline(&viewport, size(), near, 0.5e4).unwrap();
        let mut partly = 0;
        for y in 0..15 {
            for x in 0..20 {
                let coverage = outline.coverage(x, y);
                partly += u32::from(coverage > 1e-9 && coverage < 1.0 - 1e-9);
                assert!((-1e-12..1.0 + 1e-12).contains(&coverage), "{coverage}");
            }
        }
        assert!(partly > 5);
    }

    #[test]
    fn a_polygon_covers_what_its_rays_hit() {
        let mut random = Random::new(6);
        for _ in 0..20 {
            let corner = || DVec3::new(0.0, 0.0, 5.0);
            let corners = [0; 3].map(|_| corner() + 2.0 * random.in_cube());
            let outline = polygon_outline(&viewport(), size(), &corners).unwrap();
            let normal = (corners[1] - corners[0]).cross(corners[2] - corners[0]);
            let covers = |at: DVec2| {
                let direction = eye_direction(&viewport(), size(), at.x, at.y);
                let from_eye = corners.map(|corner| corner - viewport().eye);
                let t = normal.dot(from_eye[0]) / normal.dot(direction);
                (0..3).all(|k| {
                    let (p, q) = (from_eye[k], from_eye[(k + 1) % 3]);
                    (q - p).cross(t * direction - p).dot(normal) > 0.0
                })
            };
            for y in 0..15 {
                for x in 0..20 {
                    let coverage = polygon_coverage(&outline, x, y);
                    let expected = numeric(x, y, 32, covers);
                    assert!((coverage - expected).abs() < 0.03, "{coverage} {expected}");
                }
            }
        }
    }

    #[test]
    fn a_concave_outline_is_clipped_to_its_share() {
        // An arrow head whose notch reaches into pixel (0, 0) from above.
        let outline = [(0.0, 0.0), (2.0, 0.0), (0.5, 0.5), (0.0, 2.0)].map(DVec2::from);
        let whole: f64 = (0..2)
            .flat_map(|y| (0..2).map(move |x| (x, y)))
            .map(|(x, y)| polygon_coverage(&outline, x, y))
            .sum();
        assert!((whole - area(&outline)).abs() < 1e-15);
        // Below y = x: a triangle of 1/8 and, under the edge from (2, 0) to (1/2, 1/2), 5/24.
        let expected = 2.0 * (1.0 / 8.0 + 5.0 / 24.0);
        assert!((polygon_coverage(&outline, 0, 0) - expected).abs() < 1e-15);
    }
}
