//! What stands where a ray meets a face, and a place there that waits for its light.

use glam::DVec3;

use super::{ray_differential::SurfaceFootprint, texture::texture_color};
use crate::{
    left_out,
    prepared::{
        face::Face,
        layout::View,
        record::{MaterialRecord, Surface},
    },
    trace::ray::{Hit, Ray},
};

/// What stands where a ray has met a face.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Interaction<'a> {
    /// The distance from the ray's origin, in units of its direction.
    pub(crate) t: f64,
    pub(crate) position: DVec3,
    pub(super) face: Face,
    pub(crate) rank: u32,
    pub(crate) surface: Surface,
    pub(crate) material: &'a MaterialRecord,
    /// The unit normal towards the face's front.
    outward: DVec3,
    /// The unit normal towards the side that the ray comes from.
    pub(crate) normal: DVec3,
    /// The ray comes from the face's front.
    pub(crate) is_front: bool,
}

/// What is the same all over a flat face.
#[derive(Debug, Clone, Copy)]
pub(crate) struct FlatFace<'a> {
    face: Face,
    outward: DVec3,
    surface: Surface,
    material: &'a MaterialRecord,
}

impl<'a> Interaction<'a> {
    /// What stands at `hit`, which must be a hit of `ray`.
    #[inline(always)]
    pub(crate) fn new(view: &View<'a>, ray: &Ray, hit: &Hit) -> Self {
        Self::with_last(view, ray, hit, &mut None)
    }

    /// The same. Rays that follow each other often meet one face: `last`, the last flat one, is
    /// known.
    #[inline(always)]
    pub(crate) fn with_last(
        view: &View<'a>,
        ray: &Ray,
        hit: &Hit,
        last: &mut Option<FlatFace<'a>>,
    ) -> Self {
        let Hit { t, face, rank } = *hit;
        let position = ray.origin + t * ray.direction;
        let FlatFace { outward, surface, material, .. } = match *last {
            Some(last) if last.face == face => last,
            _ => {
                let (surface, material) = (face.surface(view), face.material(view));
                let outward = face.normal(view, position);
                let found = FlatFace { face, outward, surface, material };
                *last = (!face.is_round(view)).then_some(found);
                found
            }
        };
        let is_front = outward.dot(ray.direction) <= 0.0;
        Self {
            t,
            position,
            face,
            rank,
            surface,
            material,
            outward,
            normal: if is_front { outward } else { -outward },
            is_front,
        }
    }

    /// The face's colour, its texture included, of which the sample sees `footprint`. There is none
    /// in a scene without textures.
    #[inline(always)]
    pub(crate) fn color(&self, view: &View<'_>, footprint: Option<SurfaceFootprint>) -> DVec3 {
        let color = DVec3::from_array(self.material.color);
        match footprint {
            Some(footprint)
                if self.material.texture != MaterialRecord::PLAIN && !left_out::TEXTURE =>
            {
                let at = (self.position, self.outward);
                color
                    * texture_color(
                        view,
                        self.material.texture,
                        self.face,
                        self.rank,
                        at,
                        footprint,
                    )
            }
            _ => color,
        }
    }

    /// A ray that leaves the surface here; `after` is as in [`Ray`].
    #[inline(always)]
    pub(crate) fn leave(&self, direction: DVec3, after: u32) -> Ray {
        let (origin, leaving) = (self.position, self.surface);
        Ray { origin, direction, reach: f64::INFINITY, leaving, after }
    }

    /// By how much a step along the face turns the normal, per unit of the step.
    pub(crate) fn curvature(&self, view: &View<'_>) -> f64 {
        self.face.curvature(view, self.position, self.normal)
    }
}

/// A place on a surface that a ray sees.
#[derive(Debug)]
pub(crate) struct Point {
    pub(crate) sample: usize,
    /// The number of the branch that has met it.
    pub(crate) node: u64,
    /// What the surface's own light counts in the sample.
    pub(crate) weight: f64,
    pub(crate) position: DVec3,
    /// The unit normal towards the side that is seen.
    pub(crate) normal: DVec3,
    pub(crate) surface: Surface,
    pub(crate) color: DVec3,
    /// The light received so far.
    pub(crate) light: DVec3,
}
