//! A chart tells where in its face a point of a triangle or a quadrangle lies; texture coordinates
//! tell where that is on an image.

use glam::{DVec2, DVec3};

use crate::{
    exact::float::{exact_product, power_of_two_below_inverse},
    prepared::record::Texcoords,
};

/// A face as the image of the unit square: corner + s · along + t · up + s · t · twist. A triangle
/// is the half below s + t = 1 of a parallelogram.
///
/// The face is seen along the axis that its normal is closest to, from the side that sees its
/// corners counter-clockwise, in units near its own size.
#[derive(Debug, Clone, Copy)]
pub(super) struct Chart {
    corner: DVec3,
    axes: [usize; 2],
    scale: f64,
    along: DVec2,
    up: DVec2,
    twist: DVec2,
    is_triangle: bool,
}

impl Chart {
    /// Makes the chart of a face with three corners or four, counter-clockwise seen from where
    /// `normal` points.
    pub(crate) fn new(corners: &[DVec3], normal: DVec3) -> Self {
        let from_first = |k: usize| corners[k] - corners[0];
        let extent =
            (1..corners.len()).map(|k| from_first(k).abs().max_element()).fold(0.0, f64::max);
        let depth = normal.abs().max_position();
        let (x, y) = ((depth + 1) % 3, (depth + 2) % 3);
        let mut chart = Self {
            corner: corners[0],
            axes: if normal[depth] > 0.0 { [x, y] } else { [y, x] },
            scale: power_of_two_below_inverse(extent),
            along: DVec2::ZERO,
            up: DVec2::ZERO,
            twist: DVec2::ZERO,
            is_triangle: corners.len() == 3,
        };
        chart.along = chart.project(from_first(1));
        chart.up = chart.project(from_first(corners.len() - 1));
        if !chart.is_triangle {
            chart.twist = chart.project(corners[2] - corners[1]) - chart.up;
        }
        chart
    }

    fn project(&self, step: DVec3) -> DVec2 {
        DVec2::new(step[self.axes[0]], step[self.axes[1]]) * self.scale
    }

    /// Finds the place (s, t) of a point of the face, each in 0..=1.
    ///
    /// Each is the root of a quadratic, whose slope there is the map's determinant. Inside a simple
    /// quadrangle, convex or not, one place with a positive determinant is in the unit square, for
    /// the map goes round the outline once and has no more than two roots. So that root is taken,
    /// in the form that cancels nothing: there is no division by the twist, which is 0 in a
    /// parallelogram.
    pub(super) fn place(&self, point: DVec3) -> DVec2 {
        let from_corner = self.project(point - self.corner);
        let area = cross(self.along, self.up);
        let turned = cross(from_corner, self.twist);
        let s =
            rising_root(cross(self.along, self.twist), area - turned, cross(from_corner, self.up));
        let t =
            rising_root(cross(self.twist, self.up), area + turned, cross(self.along, from_corner));
        // NaN, of a face smaller than numbers go, becomes 0.
        let s = if s > 0.0 { s.min(1.0) } else { 0.0 };
        let most = if self.is_triangle { 1.0 - s } else { 1.0 };
        DVec2::new(s, if t > 0.0 { t.min(most) } else { 0.0 })
    }

    /// Tells how a step along the face, in the block's units, moves the place. It is not finite
    /// where the map folds.
    pub(super) fn step(&self, place: DVec2, step: DVec3) -> DVec2 {
        let step = self.project(step);
        let along = self.along + place.y * self.twist;
        let up = self.up + place.x * self.twist;
        DVec2::new(cross(step, up), cross(along, step)) / cross(along, up)
    }
}

/// Solves a · x² + b · x = c for the x at which the left side rises.
fn rising_root(a: f64, b: f64, c: f64) -> f64 {
    let slope = (b * b + 4.0 * a * c).max(0.0).sqrt();
    if b > 0.0 { 2.0 * c / (b + slope) } else { (slope - b) / (2.0 * a) }
}

/// Computes a × b, right to an ulp or two.
fn cross(a: DVec2, b: DVec2) -> f64 {
    let (left, left_error) = exact_product(a.x, b.y);
    let (right, right_error) = exact_product(a.y, b.x);
    (left - right) + (left_error - right_error)
}

impl Texcoords {
    /// The texture coordinates at a place.
    pub(super) fn at(&self, place: DVec2) -> DVec2 {
        let [a, b, c, d] = self.0.map(DVec2::from_array);
        let (s, t) = (place.x, place.y);
        (a * (1.0 - s) + b * s) * (1.0 - t) + (d * (1.0 - s) + c * s) * t
    }

    /// Tells how a step from a place moves the texture coordinates there.
    pub(super) fn step(&self, place: DVec2, step: DVec2) -> DVec2 {
        let [a, b, c, d] = self.0.map(DVec2::from_array);
        let (s, t) = (place.x, place.y);
        ((b - a) * (1.0 - t) + (c - d) * t) * step.x + ((d - a) * (1.0 - s) + (c - b) * s) * step.y
    }
}

#[cfg(test)]
mod tests {
    use rtfarm_oracle::{
        hard_case::{HardCase, random, rays},
        random::Random,
    };

    use super::*;

    /// The point at a place, and how much of a rounding error there the place takes on.
    fn point(corners: &[DVec3; 4], place: DVec2) -> (DVec3, f64) {
        let [a, b, c, d] = *corners;
        let (s, t) = (place.x, place.y);
        let point = a + s * (b - a) + t * (d - a) + s * t * ((c - b) - (d - a));
        let along = (b - a) + t * ((c - b) - (d - a));
        let up = (d - a) + s * ((c - b) - (d - a));
        let area = along.cross(up).z;
        let extent = corners.iter().map(|corner| corner.abs().max_element()).fold(0.0, f64::max);
        (point, if area > 0.0 { extent * along.length().max(up.length()) / area } else { 1e300 })
    }

    /// Takes random places to the face and back: the largest error, of those where the map does
    /// not enlarge errors, and of all relative to that.
    fn check_round_trips(what: &str, corners: [DVec3; 4], random: &mut Random) -> f64 {
        let chart = Chart::new(&corners, DVec3::Z);
        let mut worst = 0.0_f64;
        for k in 0..100 {
            let border =
                |value: f64, k: u64| if k.is_multiple_of(5) { value.round() } else { value };
            let place = DVec2::new(border(random.unit(), k), border(random.unit(), k / 5));
            let (point, condition) = point(&corners, place);
            let found = chart.place(point);
            assert!((0.0..=1.0).contains(&found.x) && (0.0..=1.0).contains(&found.y), "{what}");
            let off = (found - place).abs().max_element();
            if condition < 1e9 {
                let bound = 8.0 * f64::EPSILON * condition;
                assert!(off <= bound * condition.max(1.0), "{what}: {place} gives {found}");
            }
            if condition < 100.0 {
                worst = worst.max(off);
            }
        }
        worst
    }

    fn flat(corners: [[f64; 2]; 4]) -> [DVec3; 4] {
        corners.map(|[x, y]| DVec3::new(x, y, 0.0))
    }

    #[test]
    fn places_survive_the_way_to_the_face_and_back() {
        let random = &mut random(1);
        let mut worst = 0.0_f64;
        let shapes = rays(170);
        for _ in 0..shapes {
            // A corner in each quadrant: convex or not, always simple.
            let mut at =
                |x: f64, y: f64| [x * random.between(0.2, 1.0), y * random.between(0.2, 1.0)];
            let corners = flat([at(-1., -1.), at(1., -1.), at(1., 1.), at(-1., 1.)]);
            worst = worst.max(check_round_trips("a quadrangle", corners, random));

            let [x, y, w, h] = [(); 4].map(|()| random.between(0.1, 1.0));
            let trapezium = flat([[0., 0.], [1., 0.], [x.max(0.3), h], [0.2 * x, h]]);
            worst = worst.max(check_round_trips("a trapezium", trapezium, random));
            let parallelogram = flat([[0., 0.], [w, y], [w - x, y + h], [-x, h]]);
            if w * h + x * y > 0.1 {
                worst = worst.max(check_round_trips("a parallelogram", parallelogram, random));
            }
            let nearly = flat([[0., 0.], [1., 0.], [1. + 1e-15 * x, 1.], [0., 1. - 1e-14 * y]]);
            worst = worst.max(check_round_trips("nearly a square", nearly, random));

            // Notches at every corner.
            let notch = 0.3 * x;
            let mut arrow = [[notch, notch], [1., 0.], [0.7, 0.8], [0., 1.]];
            arrow[0] = [0.3 + notch, 0.3 + notch];
            arrow.rotate_left((8.0 * y) as usize % 4);
            worst = worst.max(check_round_trips("an arrow head", flat(arrow), random));

            let thin = random.log_uniform(1e-9, 1e-3);
            let needle = flat([[0., 0.], [1., 0.], [1. - thin, thin], [0.1, thin * h]]);
            check_round_trips("a needle", needle, random);
        }
        let count = 6 * 100 * shapes;
        HardCase::TextureRoundTrip.tell(
            "texture coordinates survive the way to a quadrangle and back",
            format!("{count} places, off by {worst:.1e} at most"),
        );
        HardCase::TextureBorder.tell(
            "texture coordinates stay in the image, also on its border",
            format!("0 of {count} places outside, 36 % of them on the border"),
        );
        assert!(worst < 1e-12);
    }

    #[test]
    fn a_place_moves_as_its_step_says() {
        let random = &mut Random::new(2);
        let corners = flat([[-1., -0.8], [0.9, -1.], [0.7, 0.8], [-0.6, 1.]]);
        let (chart, texcoords) =
            (Chart::new(&corners, DVec3::Z), Texcoords([[0., 3.], [2., 1.], [1., 0.], [-1., 0.5]]));
        for _ in 0..100 {
            let place = DVec2::new(random.between(0.1, 0.9), random.between(0.1, 0.9));
            let (at, _) = point(&corners, place);
            for axis in [DVec3::X, DVec3::Y] {
                let end = |sign: f64| texcoords.at(chart.place(at + sign * 1e-5 * axis));
                let truth = (end(1.0) - end(-1.0)) / 2e-5;
                let found = texcoords.step(place, chart.step(place, axis));
                assert!((found - truth).length() < 1e-8 * (1.0 + truth.length()), "{place}");
            }
        }
    }

    #[test]
    fn default_coordinates_stay_in_the_image() {
        for place in [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0], [1e-17, 1e-17], [0.3, 0.7]] {
            let at = Texcoords::DEFAULT.at(DVec2::from_array(place));
            assert!((0.0..=1.0).contains(&at.x) && (0.0..=1.0).contains(&at.y), "{place:?}: {at}");
        }
    }

    #[test]
    fn triangles_have_barycentric_coordinates() {
        let random = &mut Random::new(3);
        let corners =
            [DVec3::new(0.1, 0.2, 0.3), DVec3::new(0.9, 0.4, 0.1), DVec3::new(0.2, 0.8, 0.7)];
        let given = [DVec2::new(-1.0, 2.0), DVec2::new(3.0, 0.5), DVec2::new(0.0, -4.0)];
        let normal = (corners[1] - corners[0]).cross(corners[2] - corners[0]);
        for (normal, turn) in [(normal, [0, 1, 2]), (-normal, [0, 2, 1])] {
            let (corners, given) = (turn.map(|k| corners[k]), turn.map(|k| given[k]));
            let (chart, texcoords) = (Chart::new(&corners, normal), Texcoords::of_triangle(given));
            for _ in 0..100 {
                let (s, t) = (random.unit(), random.unit());
                let (s, t) = if s + t > 1.0 { (1.0 - s, 1.0 - t) } else { (s, t) };
                let point = corners[0] * (1.0 - s - t) + corners[1] * s + corners[2] * t;
                let truth = given[0] * (1.0 - s - t) + given[1] * s + given[2] * t;
                assert!((texcoords.at(chart.place(point)) - truth).length() < 1e-14);
            }
        }
    }
}
