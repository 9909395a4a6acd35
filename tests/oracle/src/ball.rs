//! Spheres.

use std::cmp::Ordering;

use glam::DVec3;
use rtfarm_core::scene::Sphere;

use crate::{
    dyadic::Dyadic,
    number::{Approx, Both, Number},
    ray::Ray,
    root::Root,
    vector::{BothVector, InBoth, Vector},
};

/// The surface of a sphere; its front is its outside.
#[derive(Debug, Clone)]
pub(crate) struct Ball {
    pub(crate) sphere: Sphere,
    center: BothVector,
    radius: Both,
}

/// A root of a·t² + 2b·t + c, where a = d·d, b = (o - center)·d, c = |o - center|² - r².
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum BallRoot {
    /// (-b - √(b² - ac)) / a: from the front.
    Near,
    /// (-b + √(b² - ac)) / a: from the back.
    Far,
    /// The origin itself: it is on this sphere whatever its rounded coordinates say, so c = 0.
    Origin,
    /// The other root where c = 0: -2b / a.
    Opposite,
}

/// a, b and the discriminant b² - ac as r²a - |(o - center) × d|² (Lagrange's identity), which
/// does not cancel where the origin is far.
struct Quadratic<N> {
    a: N,
    b: N,
    discriminant: N,
}

impl Ball {
    pub(crate) fn new(sphere: Sphere) -> Self {
        Self { sphere, center: sphere.center.into(), radius: sphere.radius.into() }
    }

    /// Whether both are the same set of points.
    pub(crate) fn is_coincident(&self, other: &Self) -> bool {
        self.sphere.center == other.sphere.center && self.sphere.radius == other.sphere.radius
    }

    /// Where the ray's line crosses the sphere, in ascending order. A line that touches it in one
    /// point does not cross.
    pub(crate) fn cross(&self, ray: &Ray) -> Option<[(Approx, BallRoot); 2]> {
        let Quadratic { a, b, discriminant } = self.quadratic::<Approx>(ray);
        let sign = discriminant
            .sign()
            .unwrap_or_else(|| self.quadratic::<Dyadic>(ray).discriminant.sign());
        if sign != Ordering::Greater {
            return None;
        }
        // Of the two roots the one whose terms have equal signs; the other from their product.
        let (root, c) = (discriminant.square_root(), self.excess::<Approx>(&ray.origin));
        let (near, far) = if b.value <= 0.0 {
            let sum = root - b;
            (c.divided_by(sum), sum.divided_by(a))
        } else {
            let sum = Approx::ZERO - b - root;
            (sum.divided_by(a), c.divided_by(sum))
        };
        Some([(near, BallRoot::Near), (far, BallRoot::Far)])
    }

    /// The same for a ray whose origin is on the sphere.
    pub(crate) fn cross_from_surface(&self, ray: &Ray) -> Option<[(Approx, BallRoot); 2]> {
        let Quadratic { a, b, .. } = self.quadratic::<Approx>(ray);
        let opposite = (Approx::ZERO - b - b).divided_by(a);
        let origin = (Approx::ZERO, BallRoot::Origin);
        let sign = b.sign().unwrap_or_else(|| self.quadratic::<Dyadic>(ray).b.sign());
        match sign {
            Ordering::Less => Some([origin, (opposite, BallRoot::Opposite)]),
            Ordering::Equal => None,
            Ordering::Greater => Some([(opposite, BallRoot::Opposite), origin]),
        }
    }

    /// The exact t of a crossing.
    pub(crate) fn root(&self, ray: &Ray, which: BallRoot) -> Root {
        let Quadratic { a, b, discriminant } = self.quadratic::<Dyadic>(ray);
        match which {
            BallRoot::Near => Root::quadratic(b.negated(), Ordering::Less, discriminant, a),
            BallRoot::Far => Root::quadratic(b.negated(), Ordering::Greater, discriminant, a),
            BallRoot::Origin => Root::quotient(Dyadic::zero(), a),
            BallRoot::Opposite => Root::quotient(Dyadic::from(-2.0) * b, a),
        }
    }

    /// Whether a point is outside, above zero, on or inside the sphere.
    pub(crate) fn side_of(&self, point: &BothVector) -> Ordering {
        let rough = self.excess::<Approx>(point).sign();
        rough.unwrap_or_else(|| self.excess::<Dyadic>(point).sign())
    }

    /// The unit normal of the outside, towards `point`.
    pub(crate) fn unit_normal(&self, point: &Vector<Dyadic>) -> DVec3 {
        point.minus(&self.center.exact).normalized().to_dvec3()
    }

    fn quadratic<N: InBoth>(&self, ray: &Ray) -> Quadratic<N> {
        let direction = ray.direction.of::<N>();
        let from_center = ray.origin.of::<N>().minus(self.center.of());
        let (a, aside) = (direction.dot(direction), from_center.cross(direction));
        let radius = N::of(&self.radius);
        Quadratic {
            b: from_center.dot(direction),
            discriminant: radius.clone() * radius * a.clone() - aside.dot(&aside),
            a,
        }
    }

    /// c of a ray from `origin`: above zero outside.
    fn excess<N: InBoth>(&self, origin: &BothVector) -> N {
        let from_center = origin.of::<N>().minus(self.center.of());
        let radius = N::of(&self.radius);
        from_center.dot(&from_center) - radius.clone() * radius
    }
}
