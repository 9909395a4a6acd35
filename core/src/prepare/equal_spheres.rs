//! Which spheres are equal.

use std::collections::HashMap;

use super::solid_trees::SolidTrees;
use crate::prepared::{face::Part, record::SphereRecord};

/// Gives equal spheres one surface, which is the first one's rank. Returns the surfaces of all
/// leaves of solids; those of parallelepipeds, which are as good as spheres of radius 0, mean
/// nothing.
pub(super) fn share_spheres(spheres: &mut [SphereRecord], solids: &SolidTrees) -> Vec<u32> {
    let key = |center: [f64; 3], radius: f64| (center.map(f64::to_bits), radius.to_bits());
    let mut firsts = HashMap::new();
    for sphere in spheres {
        let key = key(sphere.center, sphere.radius);
        sphere.surface = *firsts.entry(key).or_insert(sphere.rank);
    }
    let mut surfaces = Vec::with_capacity(solids.leaves.len());
    for solid in &solids.solids {
        for (number, leaf) in (0..).zip(&solids.leaves[solid.leaves()]) {
            let own = Part::new(number, 0).rank(solid);
            let key = key(leaf.center.to_array(), leaf.radius);
            surfaces.push(*firsts.entry(key).or_insert(own));
        }
    }
    surfaces
}
