//! The faces of a scene and where rays cross them.

use std::cmp::Ordering;

use glam::DVec3;

use crate::{
    ball::{Ball, BallRoot},
    dyadic::Dyadic,
    number::{Approx, Number},
    polygon::Polygon,
    ray::Ray,
    root::Root,
    vector::{BothVector, Vector},
};

/// A whole sphere or a flat polygon: what is hit, left and ordered as one thing.
#[derive(Debug, Clone)]
pub(crate) struct Face {
    pub(crate) shape: Shape,
    pub(crate) id: FaceId,
    pub(crate) material: u32,
}

/// Which face; the order among coincident ones.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct FaceId {
    /// The scene's number.
    pub primitive: u32,
    /// Which face of it: 0 for a sphere, a triangle and a quadrangle.
    ///
    /// Parallelepiped with corner `c` and edges `e[0..3]`: 2k is the face through `c` that `e[k]`
    /// leaves from, 2k + 1 the one opposite. Solid: 6 · (the leaf's `primitive`) + the leaf's face.
    /// Mesh: the index of the triangle.
    pub face: u32,
}

#[derive(Debug, Clone)]
pub(crate) enum Shape {
    Ball(Ball),
    Polygon(Polygon),
}

/// A ray that starts on a face and shall not meet it again there.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Leaving {
    /// The face that it leaves.
    pub id: FaceId,
    /// Whether it went through: then it still crosses, at t = 0, the coincident faces that come
    /// later. Otherwise (mirrored, shadow) it crosses none of them.
    pub through: bool,
}

/// A point where a ray's line crosses a face.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Crossing<'a> {
    pub(crate) face: &'a Face,
    pub(crate) time: Approx,
    pub(crate) place: Place,
    /// Whether the ray comes from the front of the face as it stands alone.
    pub(crate) front: bool,
    /// Whether a solid has turned the face around.
    pub(crate) reversed: bool,
}

/// How the exact time of a crossing is found.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Place {
    /// In a polygon's plane.
    Plane,
    /// In the plane that the ray leaves from, so at t = 0.
    PlaneLeft,
    /// On a sphere.
    Ball(BallRoot),
}

impl Face {
    /// Where the ray's line crosses the face, if it does, in ascending order. A ray that leaves
    /// `left` crosses all coincident faces at t = 0.
    pub(crate) fn cross<'a>(
        &'a self,
        ray: &Ray,
        left: Option<&Face>,
    ) -> impl Iterator<Item = Crossing<'a>> {
        let (first, second) = match &self.shape {
            Shape::Polygon(polygon) => {
                let crossing = polygon.cross(ray).map(|(time, front)| {
                    let is_left = left.is_some_and(|left| left.is_coincident(self));
                    if is_left {
                        self.crossing(Approx::ZERO, Place::PlaneLeft, front)
                    } else {
                        self.crossing(time, Place::Plane, front)
                    }
                });
                (crossing, None)
            }
            Shape::Ball(ball) => {
                let is_left = left.is_some_and(|left| left.is_coincident(self));
                let roots = if is_left { ball.cross_from_surface(ray) } else { ball.cross(ray) };
                let crossing = |k: usize| {
                    roots.map(|roots| self.crossing(roots[k].0, Place::Ball(roots[k].1), k == 0))
                };
                (crossing(0), crossing(1))
            }
        };
        first.into_iter().chain(second)
    }

    pub(crate) fn is_flat(&self) -> bool {
        matches!(self.shape, Shape::Polygon(_))
    }

    /// Whether both lie in one plane, or are one sphere, exactly.
    pub(crate) fn is_coincident(&self, other: &Self) -> bool {
        match (&self.shape, &other.shape) {
            (Shape::Ball(a), Shape::Ball(b)) => a.is_coincident(b),
            (Shape::Polygon(a), Shape::Polygon(b)) => a.is_coplanar(b),
            _ => false,
        }
    }

    /// On which side of the plane, or of the sphere, a point is: above zero in front.
    pub(crate) fn side_of(&self, point: &BothVector) -> Ordering {
        match &self.shape {
            Shape::Ball(ball) => ball.side_of(point),
            Shape::Polygon(polygon) => polygon.side_of(point),
        }
    }

    /// The unit normal of the front at a point of the face.
    pub(crate) fn unit_normal(&self, point: &Vector<Dyadic>) -> DVec3 {
        match &self.shape {
            Shape::Ball(ball) => ball.unit_normal(point),
            Shape::Polygon(polygon) => polygon.unit_normal(),
        }
    }

    /// The same, near enough for an estimate.
    pub(crate) fn rough_normal(&self, point: DVec3) -> DVec3 {
        match &self.shape {
            Shape::Ball(ball) => (point - ball.sphere.center).normalize_or_zero(),
            Shape::Polygon(polygon) => polygon.unit_normal(),
        }
    }

    fn crossing(&self, time: Approx, place: Place, front: bool) -> Crossing<'_> {
        Crossing { face: self, time, place, front, reversed: false }
    }
}

impl Crossing<'_> {
    /// The exact time.
    pub(crate) fn root(&self, ray: &Ray) -> Root {
        match (&self.face.shape, self.place) {
            (Shape::Polygon(polygon), Place::Plane) => polygon.root(ray),
            (Shape::Ball(ball), Place::Ball(which)) => ball.root(ray, which),
            _ => Root::quotient(Dyadic::zero(), Dyadic::from(1.0)),
        }
    }

    /// The order of two crossings of one ray in time.
    pub(crate) fn compare_time(&self, other: &Self, ray: &Ray) -> Ordering {
        if self.time.high() < other.time.low() {
            Ordering::Less
        } else if self.time.low() > other.time.high() {
            Ordering::Greater
        } else {
            self.root(ray).compare(&other.root(ray))
        }
    }

    /// The order by (time, primitive, face).
    pub(crate) fn compare(&self, other: &Self, ray: &Ray) -> Ordering {
        self.compare_time(other, ray).then(self.face.id.cmp(&other.face.id))
    }

    /// Whether it lies on the face that the ray leaves, or a coincident one, at t = 0.
    pub(crate) fn is_at_origin(&self) -> bool {
        matches!(self.place, Place::PlaneLeft | Place::Ball(BallRoot::Origin))
    }

    /// Whether a ray from its origin on crosses here.
    pub(crate) fn is_ahead(&self, ray: &Ray, leaving: Option<Leaving>) -> bool {
        if self.is_at_origin() {
            return leaving.is_some_and(|left| left.through && self.face.id > left.id);
        }
        self.time.sign().unwrap_or_else(|| self.root(ray).sign()) == Ordering::Greater
    }

    /// Whether it lies before t = 1.
    pub(crate) fn is_before_one(&self, ray: &Ray) -> bool {
        if self.time.high() < 1.0 || self.time.low() > 1.0 {
            return self.time.high() < 1.0;
        }
        let one = Root::quotient(Dyadic::from(1.0), Dyadic::from(1.0));
        self.root(ray).compare(&one) == Ordering::Less
    }
}
