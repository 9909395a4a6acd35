//! How close a call was.

use glam::DVec3;

use crate::{
    ball::Ball,
    dyadic::Dyadic,
    face::{Crossing, Face, Leaving, Place, Shape},
    oracle::{Oracle, hit},
    polygon::Polygon,
    ray::Ray,
};

impl Oracle {
    /// The margin of a ray that meets nothing.
    ///
    /// A margin says how far at least things would have to move for the answer to change, in
    /// units of the greatest coordinate that takes part in the decision: divided by
    /// `f64::EPSILON` it is in ulps. It is the least over
    /// - the distance between the ray, up to its hit, and any edge or outline: a face missed or
    ///   hit by little; 0 where the ray meets an edge exactly,
    /// - the distance, across the faces, between the hit and the next one behind it (but for
    ///   coincident faces) and between the origin and any face in front of or behind it.
    ///
    /// It is itself computed in `f64` and off by a few ulps. It is too small rather than too
    /// large: faces inside a solid that cannot be seen count too.
    pub fn miss_margin(&self, origin: DVec3, direction: DVec3, leaving: Option<Leaving>) -> f64 {
        self.margin(&Ray::along(origin, direction), leaving, None)
    }

    /// The margin of the answer that the first crossing is `first`, or, where there is none
    /// given, of the list of all crossings.
    pub(crate) fn margin(
        &self,
        ray: &Ray,
        leaving: Option<Leaving>,
        first: Option<&Crossing<'_>>,
    ) -> f64 {
        let left = self.left(leaving);
        let end = first.map_or(f64::INFINITY, |first| first.root(ray).to_dyadic().to_f64());
        let mut crossings = Vec::new();
        let mut margin = f64::INFINITY;
        for face in &self.faces {
            // A ray may pass the edge of a face only behind the point where it meets the face.
            let is_met = first.is_some_and(|first| first.face.id == face.id);
            let end = if is_met { f64::INFINITY } else { end };
            margin = margin.min(outline_margin(face, ray, left, end));
            crossings.extend(face.cross(ray, left));
        }
        crossings.retain(|crossing| crossing.place != Place::PlaneLeft);
        crossings.sort_by(|a, b| a.compare(b, ray));
        for crossing in &crossings {
            margin = margin.min(gap_margin(ray, crossing, Dyadic::zero()));
        }
        for pair in crossings.windows(2) {
            let matters = first.is_none_or(|first| {
                pair.iter().any(|crossing| crossing.compare_time(first, ray).is_eq())
            });
            if matters && !pair[0].face.is_coincident(pair[1].face) {
                let times = [0, 1].map(|k| pair[k].root(ray).to_dyadic());
                let gap = gap_margin(ray, &pair[0], times[1].clone());
                margin = margin.min(gap).min(gap_margin(ray, &pair[1], times[0].clone()));
            }
        }
        margin
    }
}

/// The margin of which crossings lie between the ends of a ray, t = 0 and t = 1.
pub(crate) fn segment_margin(oracle: &Oracle, ray: &Ray, leaving: Option<Leaving>) -> f64 {
    let left = oracle.left(leaving);
    let mut margin = f64::INFINITY;
    for face in &oracle.faces {
        margin = margin.min(outline_margin(face, ray, left, 1.0));
        for crossing in face.cross(ray, left) {
            margin = margin.min(gap_margin(ray, &crossing, Dyadic::zero()));
            margin = margin.min(gap_margin(ray, &crossing, Dyadic::from(1.0)));
        }
    }
    margin
}

/// How far a ray, up to time `end`, is from where it would begin or cease to cross a face.
fn outline_margin(face: &Face, ray: &Ray, left: Option<&Face>, end: f64) -> f64 {
    let (origin, direction) = (ray.origin.to_dvec3(), ray.direction.to_dvec3());
    let is_left = || left.is_some_and(|left| left.is_coincident(face));
    match &face.shape {
        Shape::Polygon(polygon) => {
            let margin = polygon_margin(polygon, origin, direction, end);
            if margin >= 64.0 * f64::EPSILON {
                margin
            } else if is_left() {
                f64::INFINITY
            } else if polygon.meets_edge(ray) {
                0.0
            } else {
                margin
            }
        }
        Shape::Ball(ball) => ball_margin(ball, origin, direction, end, is_left()),
    }
}

fn polygon_margin(polygon: &Polygon, origin: DVec3, direction: DVec3, end: f64) -> f64 {
    let corners = polygon.corners();
    let next = |k: usize| corners[(k + 1) % corners.len()];
    let margin = |k: usize| {
        let (a, b) = (corners[k], next(k));
        let t = closest_time(origin, direction, end, a, b);
        let point = origin + t * direction;
        let distance = distance_to_segment(point, a, b);
        distance / greatest(&[origin, point, a, b])
    };
    (0..corners.len()).map(margin).fold(f64::INFINITY, f64::min)
}

fn ball_margin(ball: &Ball, origin: DVec3, direction: DVec3, end: f64, is_left: bool) -> f64 {
    let (center, radius) = (ball.sphere.center, ball.sphere.radius);
    let from_center = origin - center;
    let length = direction.length();
    let closest = -from_center.dot(direction) / (length * length);
    let scale = greatest(&[origin, center, DVec3::splat(radius)]);
    if is_left {
        return (closest * length).abs() / scale;
    }
    let closest_so_far = if closest > 0.0 { closest.min(end) } else { 0.0 };
    let distance = (from_center + closest_so_far * direction).length();
    if distance >= radius {
        (distance - radius) / scale
    } else if closest > 0.0 && from_center.length() > radius {
        (radius - from_center.cross(direction).length() / length) / scale
    } else {
        f64::INFINITY
    }
}

/// How far a crossing is from the point at time `other`, measured across the face.
fn gap_margin(ray: &Ray, crossing: &Crossing<'_>, other: Dyadic) -> f64 {
    if crossing.is_at_origin() {
        return f64::INFINITY;
    }
    let gap = (crossing.root(ray).to_dyadic() - other).to_f64().abs();
    let hit = hit(ray, crossing);
    let across = hit.normal.dot(ray.direction.to_dvec3()).abs();
    gap * across / greatest(&[ray.origin.to_dvec3(), hit.point])
}

/// The time in 0..=end at which the ray is closest to the segment from a to b.
///
/// Source: Ericson, "Real-Time Collision Detection" (2005), section 5.1.9.
fn closest_time(origin: DVec3, direction: DVec3, end: f64, a: DVec3, b: DVec3) -> f64 {
    let (edge, offset) = (b - a, origin - a);
    let (dd, de, ee) = (direction.dot(direction), direction.dot(edge), edge.dot(edge));
    let (d_offset, e_offset) = (direction.dot(offset), edge.dot(offset));
    // dd·ee - de² without cancellation.
    let turned = direction.cross(edge).length_squared();
    let clamp_time = |t: f64| if t > 0.0 { t.min(end) } else { 0.0 };
    let t = clamp_time((de * e_offset - ee * d_offset) / turned);
    let along = ((de * t + e_offset) / ee).clamp(0.0, 1.0);
    clamp_time((de * along - d_offset) / dd)
}

fn distance_to_segment(point: DVec3, a: DVec3, b: DVec3) -> f64 {
    let edge = b - a;
    let along = ((point - a).dot(edge) / edge.dot(edge)).clamp(0.0, 1.0);
    (point - a - along * edge).length()
}

/// The greatest coordinate.
fn greatest(points: &[DVec3]) -> f64 {
    points.iter().map(|point| point.abs().max_element()).fold(f64::MIN_POSITIVE, f64::max)
}
