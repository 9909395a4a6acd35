//! The second step: coordinates times a power of two.

use glam::DVec3;
use rayon::prelude::*;

use super::{collect::Collected, flat::FlatFaces, solid_trees::SolidTrees};
use crate::{
    exact::float::power_of_two_below_inverse,
    prepared::record::SphereRecord,
    scene::{Scene, Viewport},
};

/// All faces of a scene, in the units of the prepared scene.
pub(super) struct Scaled {
    pub(super) flat: FlatFaces,
    pub(super) spheres: Vec<SphereRecord>,
    pub(super) solids: SolidTrees,
    /// Scene coordinates times this power of two are the prepared scene's.
    pub(super) scale: f64,
}

impl Collected {
    /// Multiplies every coordinate by the power of two that brings the largest one, `other_extent`
    /// included, into 0.5..1.
    pub(super) fn scale(self, other_extent: f64) -> Scaled {
        let scale = power_of_two_below_inverse(self.extent().max(other_extent));
        let Self { mut flat, mut spheres, mut solids } = self;
        flat.points.par_iter_mut().for_each(|point| *point *= scale);
        for sphere in &mut spheres {
            sphere.center = sphere.center.map(|x| x * scale);
            sphere.radius *= scale;
        }
        for leaf in &mut solids.leaves {
            leaf.center *= scale;
            leaf.radius *= scale;
        }
        for bounds in &mut solids.bounds {
            *bounds = (bounds.0 * scale, bounds.1 * scale);
        }
        Scaled { flat, spheres, solids, scale }
    }

    /// The largest coordinate.
    fn extent(&self) -> f64 {
        let of_sphere = |center: DVec3, radius: f64| center.abs().max_element().max(radius);
        let of_corner = |&corner: &u32| self.flat.points[corner as usize].abs().max_element();
        let of_corners = self.flat.corners.par_iter().map(of_corner).reduce(|| 0.0, f64::max);
        (self.spheres.iter())
            .map(|sphere| of_sphere(DVec3::from_array(sphere.center), sphere.radius))
            .chain(self.solids.leaves.iter().map(|leaf| of_sphere(leaf.center, leaf.radius)))
            .fold(of_corners, f64::max)
    }
}

/// The largest coordinate of a scene's eye, screen and lights.
pub(super) fn extent_of_eye_and_lights(scene: &Scene, viewport: &Viewport) -> f64 {
    [viewport.eye, viewport.top_left, viewport.bottom_left, viewport.top_right]
        .into_iter()
        .chain(scene.lights.iter().map(|light| light.position))
        .fold(0.0, |largest, point| largest.max(point.abs().max_element()))
}
