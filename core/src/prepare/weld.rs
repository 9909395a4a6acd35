//! The third step: corners in one place become one vertex.

use rayon::prelude::*;

use super::{flat::FlatFaces, scale::Scaled, solid_trees::SolidTrees};
use crate::{exact::welding::find_firsts, prepared::record::SphereRecord};

/// All faces of a scene; corners in one place have one point.
pub(super) struct Welded {
    pub(super) flat: FlatFaces,
    pub(super) spheres: Vec<SphereRecord>,
    pub(super) solids: SolidTrees,
}

impl Scaled {
    /// Finds the corners that faces share.
    pub(super) fn weld(self) -> Welded {
        let Self { mut flat, spheres, solids, .. } = self;
        let firsts = find_firsts(&flat.points, |point| point.to_array().map(f64::to_bits));
        flat.corners.par_iter_mut().for_each(|corner| *corner = firsts[*corner as usize]);
        Welded { flat, spheres, solids }
    }
}
