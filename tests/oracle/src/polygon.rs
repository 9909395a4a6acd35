//! Flat faces with straight edges.

use std::cmp::Ordering;

use glam::DVec3;

use crate::{
    dyadic::Dyadic,
    number::{Approx, Both, Number},
    ray::Ray,
    root::Root,
    vector::{BothVector, InBoth, Vector},
};

/// A simple polygon of three or four corners, counter-clockwise seen from its front, in the plane
/// n·x = n·(sum of anchors) / (count of anchors).
#[derive(Debug, Clone)]
pub(crate) struct Polygon {
    corners: Vec<BothVector>,
    /// Newell's normal: twice the area long.
    normal: BothVector,
    unit_normal: DVec3,
    anchor_sum: BothVector,
    anchor_count: Both,
}

impl Polygon {
    /// A face whose corners lie in one plane exactly: a triangle or a parallelogram.
    pub(crate) fn planar(corners: Vec<Vector<Dyadic>>) -> Self {
        let anchor = corners[0].clone();
        Self::new(corners, anchor, 1.0)
    }

    /// A face whose corners lie in one plane nearly: Newell's plane through their mean.
    pub(crate) fn nearly_planar(corners: Vec<Vector<Dyadic>>) -> Self {
        let sum = corners.iter().skip(1).fold(corners[0].clone(), |sum, c| sum.plus(c));
        let count = corners.len() as f64;
        Self::new(corners, sum, count)
    }

    /// Whether the corners do not all lie in a line.
    pub(crate) fn has_area(corners: &[Vector<Dyadic>]) -> bool {
        newell_normal(corners).0.iter().any(|part| part.sign().is_ne())
    }

    fn new(corners: Vec<Vector<Dyadic>>, anchor_sum: Vector<Dyadic>, anchor_count: f64) -> Self {
        assert!(Self::has_area(&corners), "a face needs an area");
        let normal = newell_normal(&corners);
        Self {
            corners: corners.into_iter().map(BothVector::from).collect(),
            unit_normal: normal.normalized().to_dvec3(),
            normal: normal.into(),
            anchor_sum: anchor_sum.into(),
            anchor_count: anchor_count.into(),
        }
    }

    /// Where the ray's line crosses the polygon, and whether it comes from the front.
    pub(crate) fn cross(&self, ray: &Ray) -> Option<(Approx, bool)> {
        if self.winding(ray) == 0 {
            return None;
        }
        let (numerator, denominator) = self.time::<Approx>(ray);
        let sign = denominator.sign().unwrap_or_else(|| self.time::<Dyadic>(ray).1.sign());
        // A ray in the plane, or parallel to it, does not cross.
        (sign != Ordering::Equal)
            .then(|| (numerator.divided_by(denominator), sign == Ordering::Less))
    }

    /// The exact t of a crossing.
    pub(crate) fn root(&self, ray: &Ray) -> Root {
        let (numerator, denominator) = self.time::<Dyadic>(ray);
        Root::quotient(numerator, denominator)
    }

    /// On which side of the plane a point is: above zero in front.
    pub(crate) fn side_of(&self, point: &BothVector) -> Ordering {
        self.height::<Approx>(point).sign().unwrap_or_else(|| self.height::<Dyadic>(point).sign())
    }

    /// Whether both lie in the same plane, exactly.
    pub(crate) fn is_coplanar(&self, other: &Self) -> bool {
        let turned = self.normal.of::<Approx>().cross(other.normal.of());
        if turned.0.iter().any(|part| part.sign().is_some_and(Ordering::is_ne)) {
            return false;
        }
        let turned = self.normal.exact.cross(&other.normal.exact);
        // Parallel, and the mean of the other's anchors in this plane.
        let (sum, other_sum) = (&self.anchor_sum.exact, &other.anchor_sum.exact);
        let (count, other_count) = (&self.anchor_count.exact, &other.anchor_count.exact);
        let between = other_sum.scaled(count).minus(&sum.scaled(other_count));
        turned.0.iter().all(|part| part.sign().is_eq())
            && self.normal.exact.dot(&between).sign().is_eq()
    }

    /// The unit normal of the front.
    pub(crate) fn unit_normal(&self) -> DVec3 {
        self.unit_normal
    }

    /// The corners, rounded.
    pub(crate) fn corners(&self) -> Vec<DVec3> {
        self.corners.iter().map(BothVector::to_dvec3).collect()
    }

    /// The distance between the ray's line and the line of the edge from corner k to the next;
    /// infinite if they are parallel.
    pub(crate) fn distance_to_edge(&self, ray: &Ray, k: usize) -> f64 {
        let next = (k + 1) % self.corners.len();
        let edge = self.corners[next].exact.minus(&self.corners[k].exact);
        let across = ray.direction.exact.cross(&edge);
        let squared = across.dot(&across);
        if squared.sign().is_eq() {
            return f64::INFINITY;
        }
        let volume = self.volume::<Dyadic>(ray, k, next);
        volume.divided_by(&squared.square_root()).to_f64().abs()
    }

    /// t as numerator and denominator: n·(anchor - o) and n·d.
    fn time<N: InBoth>(&self, ray: &Ray) -> (N, N) {
        let numerator = N::of(&Both::from(0.0)) - self.height(&ray.origin);
        (numerator, N::of(&self.anchor_count) * self.normal.of().dot(ray.direction.of()))
    }

    /// n·(x - anchor), times the count of anchors.
    fn height<N: InBoth>(&self, point: &BothVector) -> N {
        let scaled = point.of().scaled(&N::of(&self.anchor_count));
        self.normal.of().dot(&scaled.minus(self.anchor_sum.of()))
    }

    /// How often the outline runs around the ray's line: for a simple outline -1, 0 or 1. The
    /// sum over a fan of triangles; an edge of the fan that is no edge of the outline is passed
    /// once in each direction and cancels out.
    fn winding(&self, ray: &Ray) -> i32 {
        let last = self.corners.len() - 1;
        (1..last).map(|k| self.winding_of_triangle(ray, k, k + 1)).sum()
    }

    fn winding_of_triangle(&self, ray: &Ray, j: usize, k: usize) -> i32 {
        let first = self.side_of_edge(ray, 0, j);
        if first == Ordering::Equal
            || self.side_of_edge(ray, j, k) != first
            || self.side_of_edge(ray, k, 0) != first
        {
            return 0;
        }
        if first == Ordering::Greater { 1 } else { -1 }
    }

    /// On which side the ray's line passes the edge from corner i to corner j. A line that meets
    /// the edge is moved by an infinitely small step, the same for all edges of all faces, so
    /// that of the faces around an edge or a corner it crosses exactly one, or none where the
    /// surface turns back. Only a line parallel to the edge remains undecided.
    ///
    /// Source: Edelsbrunner & Mücke, "Simulation of Simplicity" (1990).
    fn side_of_edge(&self, ray: &Ray, i: usize, j: usize) -> Ordering {
        let sign = self.volume::<Approx>(ray, i, j).sign();
        let sign = sign.unwrap_or_else(|| self.volume::<Dyadic>(ray, i, j).sign());
        if sign != Ordering::Equal {
            return sign;
        }
        // The origin moves by (ε, ε², ε³): what the volume gains from each, until one counts.
        let edge = self.corners[j].exact.minus(&self.corners[i].exact);
        let gains = ray.direction.exact.cross(&edge);
        gains.0.iter().map(Dyadic::sign).find(|&gain| gain != Ordering::Equal).unwrap_or(sign)
    }

    /// d · ((v - o) × (w - o)) for the edge's corners v and w: how the line passes the edge.
    fn volume<N: InBoth>(&self, ray: &Ray, i: usize, j: usize) -> N {
        let from_origin = |k: usize| self.corners[k].of::<N>().minus(ray.origin.of());
        ray.direction.of().dot(&from_origin(i).cross(&from_origin(j)))
    }
}

/// Newell's normal: twice the area long, towards the side that sees the corners counter-clockwise.
fn newell_normal(corners: &[Vector<Dyadic>]) -> Vector<Dyadic> {
    let from_first = |k: usize| corners[k].minus(&corners[0]);
    let first = from_first(1).cross(&from_first(2));
    (2..corners.len() - 1)
        .map(|k| from_first(k).cross(&from_first(k + 1)))
        .fold(first, |sum, part| sum.plus(&part))
}
