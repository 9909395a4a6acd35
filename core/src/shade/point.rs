//! A place on a surface that a ray sees.

use glam::DVec3;

use super::{ray_differential::SurfaceFootprint, texture::texture_color};
use crate::{
    left_out,
    prepared::{
        layout::View,
        record::{MaterialRecord, Surface},
    },
    trace::ray::Hit,
};

/// A place on a surface that a ray sees.
#[derive(Debug)]
pub(crate) struct Point {
    pub(crate) sample: usize,
    /// The number of the branch that has met it.
    pub(crate) node: u64,
    /// What the surface's own light counts in the sample.
    pub(crate) weight: f64,
    pub(crate) position: DVec3,
    /// Of length 1, towards the side that is seen.
    pub(crate) normal: DVec3,
    pub(crate) surface: Surface,
    pub(crate) color: DVec3,
    /// The light received so far.
    pub(crate) light: DVec3,
}

/// The colour of a face at a hit, its texture included, of which the sample sees `footprint`. There is
/// none in a scene without textures.
#[inline(always)]
pub(crate) fn surface_color(
    view: &View<'_>,
    material: &MaterialRecord,
    hit: &Hit,
    at: (DVec3, DVec3),
    footprint: Option<SurfaceFootprint>,
) -> DVec3 {
    let color = DVec3::from_array(material.color);
    match footprint {
        Some(footprint) if material.texture != MaterialRecord::PLAIN && !left_out::TEXTURE => {
            color * texture_color(view, material.texture, hit, at, footprint)
        }
        _ => color,
    }
}
