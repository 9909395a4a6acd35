//! Light that comes straight from the point lights.

use glam::DVec3;
use rtfarm_core::scene::Light;

use crate::{
    face::{Crossing, FaceId, Leaving},
    margin::segment_margin,
    oracle::{Hit, Oracle},
    ray::Ray,
    vector::BothVector,
};

/// What a straight line lets through.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Passage {
    /// The share of light that passes, 0..=1.
    pub transmittance: f64,
    /// How little would change which faces are crossed; see [`Oracle::miss_margin`].
    pub margin: f64,
}

impl Oracle {
    /// What the straight line from `point`, which is on the face `on` if any, to `light` lets
    /// through: the product of (1 - alpha)(1 - reflect) over the crossings strictly between.
    pub fn transmittance(&self, point: DVec3, on: Option<FaceId>, light: DVec3) -> Passage {
        let leaving = on.map(|id| Leaving { id, through: false });
        if point == light {
            return Passage { transmittance: 1.0, margin: 0.0 };
        }
        let ray = Ray::between(point, light);
        let margin = segment_margin(self, &ray, leaving);
        Passage { transmittance: self.let_through(&ray, leaving), margin }
    }

    /// Light from the point lights on the side of the face that the ray which crossed it came
    /// from: Σ intensity / r² · max(0, n·l) · T.
    pub(crate) fn direct_light(&self, crossing: &Crossing<'_>, hit: &Hit) -> DVec3 {
        self.scene.lights.iter().map(|light| self.direct_light_of(light, crossing, hit)).sum()
    }

    fn direct_light_of(&self, light: &Light, crossing: &Crossing<'_>, hit: &Hit) -> DVec3 {
        let to_light = light.position - hit.point;
        let distance_squared = to_light.length_squared();
        let cosine = hit.normal.dot(to_light) / distance_squared.sqrt();
        let side = crossing.face.side_of(&BothVector::from(light.position));
        // A flat face turns its other side to a light behind it, whatever the cosine's rounding.
        let is_behind = crossing.face.is_flat() && side.is_gt() != crossing.front;
        if side.is_eq() || is_behind || distance_squared == 0.0 || cosine <= 0.0 {
            return DVec3::ZERO;
        }
        let leaving = Leaving { id: hit.id, through: false };
        let ray = Ray::between(hit.point, light.position);
        let transmittance = self.let_through(&ray, Some(leaving));
        light.intensity * (cosine / distance_squared * transmittance)
    }

    /// The product of (1 - alpha)(1 - reflect) over the crossings before t = 1.
    fn let_through(&self, ray: &Ray, leaving: Option<Leaving>) -> f64 {
        self.crossings(ray, leaving)
            .filter(|crossing| crossing.is_before_one(ray))
            .map(|crossing| &self.scene.materials[crossing.face.material as usize])
            .map(|material| (1.0 - material.alpha) * (1.0 - material.reflect))
            .product()
    }
}
