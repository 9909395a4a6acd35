//! How close a call was.

use glam::DVec3;

use crate::{
    ball::Ball,
    dyadic::Dyadic,
    face::{Crossing, Face, Leaving, Place, Shape},
    number::Approx,
    oracle::Oracle,
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
    /// - the distance, across the faces, between the hit and any other behind it (but for
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
            let own: Vec<_> = face.cross(ray, left).collect();
            margin = margin.min(outline_margin(face, ray, left, end, own.is_empty()));
            crossings.extend(own);
        }
        crossings.retain(|crossing| crossing.place != Place::PlaneLeft);
        crossings.sort_by(|a, b| a.compare(b, ray));
        for crossing in &crossings {
            margin = margin.min(gap_margin(ray, crossing, Time::Number(0.0)));
        }
        for (k, crossing) in crossings.iter().enumerate() {
            // What comes before the first crossing is hidden in a solid, but might not be.
            if first.is_some_and(|first| crossing.compare_time(first, ray).is_gt()) {
                break;
            }
            // All that follow, not only the next: a face that is met at a small angle may be near
            // however late it is met.
            for later in &crossings[k + 1..] {
                if later.is_ahead(ray, leaving) && !later.face.is_coincident(crossing.face) {
                    let gap = gap_margin(ray, crossing, Time::Crossing(later));
                    margin = margin.min(gap).min(gap_margin(ray, later, Time::Crossing(crossing)));
                }
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
        let own: Vec<_> = face.cross(ray, left).collect();
        margin = margin.min(outline_margin(face, ray, left, 1.0, own.is_empty()));
        for crossing in own {
            margin = margin.min(gap_margin(ray, &crossing, Time::Number(0.0)));
            margin = margin.min(gap_margin(ray, &crossing, Time::Number(1.0)));
        }
    }
    margin
}

/// How far a ray, up to time `end`, is from where it would begin or cease to cross a face.
fn outline_margin(face: &Face, ray: &Ray, left: Option<&Face>, end: f64, is_missed: bool) -> f64 {
    let is_left = || left.is_some_and(|left| left.is_coincident(face));
    match &face.shape {
        Shape::Polygon(polygon) => {
            let margin = polygon_margin(polygon, ray, end, is_missed);
            if margin < NEAR && is_left() { f64::INFINITY } else { margin }
        }
        Shape::Ball(ball) => ball_margin(ball, ray, end, is_left()),
    }
}

/// Margins below this are computed exactly: `f64` has no more than the first digits of them.
const NEAR: f64 = 1e-10;

fn polygon_margin(polygon: &Polygon, ray: &Ray, end: f64, is_missed: bool) -> f64 {
    let (origin, direction) = (ray.origin.to_dvec3(), ray.direction.to_dvec3());
    let corners = polygon.corners();
    let margin = |k: usize| {
        let (a, b) = (corners[k], corners[(k + 1) % corners.len()]);
        let t = closest_time(origin, direction, end, a, b);
        let point = origin + t * direction;
        let scale = greatest(&[origin, point, a, b]);
        let margin = distance_to_segment(point, a, b) / scale;
        // In `f64` the closest point is hard to find when ray and edge are nearly parallel.
        let turned = direction.cross(b - a).length();
        let is_parallel = turned < 1e-4 * direction.length() * (b - a).length();
        if margin < NEAR || is_parallel && margin < 1e-4 {
            margin.min(polygon.distance_to_edge(ray, k) / scale)
        } else {
            margin
        }
    };
    let edges = (0..corners.len()).map(margin).fold(f64::INFINITY, f64::min);
    // The ray may also end over the middle of a face that it runs along and does not meet.
    let end_point = origin + end * direction;
    let normal = polygon.unit_normal();
    if !is_missed || !end_point.is_finite() || !is_over(&corners, normal, end_point) {
        return edges;
    }
    let height = normal.dot(end_point - corners[0]).abs();
    edges.min(height / greatest(&[&corners[..], &[origin, end_point]].concat()))
}

/// Whether a point lies over a polygon: how often an outline in the plane goes around it.
fn is_over(corners: &[DVec3], normal: DVec3, point: DVec3) -> bool {
    let side = |k: usize| {
        let (a, b) = (corners[k] - point, corners[(k + 1) % corners.len()] - point);
        let up = normal.any_orthonormal_vector();
        let is_up = |corner: DVec3| up.dot(corner) > 0.0;
        match (is_up(a), is_up(b)) {
            (false, true) if normal.dot(a.cross(b)) > 0.0 => 1,
            (true, false) if normal.dot(a.cross(b)) < 0.0 => -1,
            _ => 0,
        }
    };
    (0..corners.len()).map(side).sum::<i32>() != 0
}

fn ball_margin(ball: &Ball, ray: &Ray, end: f64, is_left: bool) -> f64 {
    let (origin, direction) = (ray.origin.to_dvec3(), ray.direction.to_dvec3());
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

/// A time of a ray.
#[derive(Clone, Copy)]
enum Time<'a> {
    Number(f64),
    Crossing(&'a Crossing<'a>),
}

impl Time<'_> {
    fn rough(self) -> Approx {
        match self {
            Self::Number(value) => Approx { value, error: 0.0 },
            Self::Crossing(crossing) => crossing.time,
        }
    }

    fn exact(self, ray: &Ray) -> Dyadic {
        match self {
            Self::Number(value) => Dyadic::from(value),
            Self::Crossing(crossing) => crossing.root(ray).to_dyadic(),
        }
    }
}

/// How far a crossing is from the point at another time, measured across the face.
fn gap_margin(ray: &Ray, crossing: &Crossing<'_>, other: Time<'_>) -> f64 {
    if crossing.is_at_origin() {
        return f64::INFINITY;
    }
    let (origin, direction) = (ray.origin.to_dvec3(), ray.direction.to_dvec3());
    let point = origin + crossing.time.value * direction;
    let across = crossing.face.rough_normal(point).dot(direction).abs();
    let scale = across / greatest(&[origin, point]);
    let gap = crossing.time - other.rough();
    if (gap.value.abs() - 1e3 * gap.error) * scale > NEAR {
        return gap.value.abs() * scale;
    }
    let time = crossing.root(ray).to_dyadic();
    let point = ray.at(&time);
    let across = crossing.face.unit_normal(&point).dot(direction).abs();
    let gap = (time - other.exact(ray)).to_f64().abs();
    gap * across / greatest(&[origin, point.to_dvec3()])
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
