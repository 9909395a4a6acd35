//! Rays, lifted into both arithmetics.

use glam::DVec3;

use crate::{
    dyadic::Dyadic,
    vector::{BothVector, Vector},
};

/// The points origin + t · direction.
#[derive(Debug, Clone)]
pub(crate) struct Ray {
    pub(crate) origin: BothVector,
    pub(crate) direction: BothVector,
}

impl Ray {
    /// From `origin` along `direction`, of any length but zero.
    pub(crate) fn along(origin: DVec3, direction: DVec3) -> Self {
        assert!(direction != DVec3::ZERO, "a ray needs a direction");
        Self { origin: origin.into(), direction: direction.into() }
    }

    /// From `origin`, t = 0, to `target`, t = 1, whether or not `f64` holds their difference.
    pub(crate) fn between(origin: DVec3, target: DVec3) -> Self {
        let difference = Vector::exactly(target).minus(&Vector::exactly(origin));
        Self { origin: origin.into(), direction: difference.into() }
    }

    /// origin + t · direction.
    pub(crate) fn at(&self, t: &Dyadic) -> Vector<Dyadic> {
        self.origin.exact.plus(&self.direction.exact.scaled(t))
    }
}
