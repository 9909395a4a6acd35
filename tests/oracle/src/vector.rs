//! Vectors of [`Number`]s.

use glam::DVec3;

use crate::{
    dyadic::Dyadic,
    number::{Approx, Both, Number},
};

/// Three numbers in one arithmetic.
#[derive(Debug, Clone)]
pub(crate) struct Vector<N>(pub(crate) [N; 3]);

impl<N: Number> Vector<N> {
    pub(crate) fn plus(&self, other: &Self) -> Self {
        self.zip(other, |a, b| a + b)
    }

    pub(crate) fn minus(&self, other: &Self) -> Self {
        self.zip(other, |a, b| a - b)
    }

    pub(crate) fn scaled(&self, factor: &N) -> Self {
        Self(self.0.clone().map(|a| a * factor.clone()))
    }

    pub(crate) fn dot(&self, other: &Self) -> N {
        let [x, y, z] = self.zip(other, |a, b| a * b).0;
        x + y + z
    }

    pub(crate) fn cross(&self, other: &Self) -> Self {
        let part = |i: usize, j: usize| {
            self.0[i].clone() * other.0[j].clone() - self.0[j].clone() * other.0[i].clone()
        };
        Self([part(1, 2), part(2, 0), part(0, 1)])
    }

    fn zip(&self, other: &Self, join: impl Fn(N, N) -> N) -> Self {
        Self([0, 1, 2].map(|k| join(self.0[k].clone(), other.0[k].clone())))
    }
}

impl Vector<Dyadic> {
    pub(crate) fn exactly(vector: DVec3) -> Self {
        Self(vector.to_array().map(Dyadic::from))
    }

    /// Divided by its length, which is not zero; to more digits than an `f64` has.
    pub(crate) fn normalized(&self) -> Self {
        let length = self.dot(self).square_root();
        Self(self.0.each_ref().map(|part| part.divided_by(&length)))
    }

    /// Each component rounded to the nearest.
    pub(crate) fn to_dvec3(&self) -> DVec3 {
        DVec3::from_array(self.0.each_ref().map(Dyadic::to_f64))
    }
}

/// A vector in both arithmetics.
#[derive(Debug, Clone)]
pub(crate) struct BothVector {
    rough: Vector<Approx>,
    pub(crate) exact: Vector<Dyadic>,
}

impl BothVector {
    pub(crate) fn of<N: InBoth>(&self) -> &Vector<N> {
        N::vector(self)
    }

    /// The `f64` numbers nearest to it.
    pub(crate) fn to_dvec3(&self) -> DVec3 {
        DVec3::from_array(self.rough.0.map(|a| a.value))
    }
}

impl From<Vector<Dyadic>> for BothVector {
    fn from(exact: Vector<Dyadic>) -> Self {
        Self { rough: Vector(exact.0.each_ref().map(Approx::from)), exact }
    }
}

impl From<DVec3> for BothVector {
    fn from(vector: DVec3) -> Self {
        let [x, y, z] = vector.to_array().map(Both::from);
        Self {
            rough: Vector([x.rough, y.rough, z.rough]),
            exact: Vector([x.exact, y.exact, z.exact]),
        }
    }
}

/// A [`Number`] that [`BothVector`] holds.
pub(crate) trait InBoth: Number + Sized {
    fn vector(both: &BothVector) -> &Vector<Self>;
}

impl InBoth for Approx {
    fn vector(both: &BothVector) -> &Vector<Self> {
        &both.rough
    }
}

impl InBoth for Dyadic {
    fn vector(both: &BothVector) -> &Vector<Self> {
        &both.exact
    }
}
