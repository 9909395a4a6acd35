//! What is seen along a ray.

use glam::DVec3;
use rtfarm_core::scene::Material;

use crate::{
    face::{Crossing, Leaving},
    oracle::{Hit, Oracle, hit},
    ray::Ray,
};

/// What a picture depends on besides the scene and the samples.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Settings {
    /// Every surface shows its plain colour, as in a scene without light.
    pub flat: bool,
    /// A branch whose weight is below this counts as background, or sums would never end. At 0 the
    /// radiance is the one that the format defines.
    pub cutoff: f64,
    /// Faces send light on to others, which is summed over this many times this many directions;
    /// see [`Oracle::secondary_light`]. `None`: they do not.
    pub secondary: Option<u32>,
}

impl Default for Settings {
    fn default() -> Self {
        Self { flat: false, cutoff: 1.0 / 4096.0, secondary: None }
    }
}

/// The last mirrored or transmitted ray that is traced; the eye's ray has depth 0.
const MAX_DEPTH: u32 = 64;

/// A ray of the tree that the eye's ray grows into.
struct Branch {
    origin: DVec3,
    /// Its length is 1, but for the eye's ray.
    direction: DVec3,
    leaving: Option<Leaving>,
    depth: u32,
    /// The product of the factors that it will be multiplied with.
    weight: f64,
}

impl Oracle {
    /// The colour that an eye at `origin` sees along `direction`, of any length.
    pub fn radiance(&self, origin: DVec3, direction: DVec3, settings: &Settings) -> DVec3 {
        let branch = Branch { origin, direction, leaving: None, depth: 0, weight: 1.0 };
        self.branch_radiance(&branch, settings)
    }

    fn branch_radiance(&self, branch: &Branch, settings: &Settings) -> DVec3 {
        if branch.depth > MAX_DEPTH || branch.weight < settings.cutoff {
            return self.scene.background;
        }
        let ray = Ray::along(branch.origin, branch.direction);
        let Some(crossing) = self.first_crossing(&ray, branch.leaving) else {
            return self.scene.background;
        };
        let hit = hit(&ray, &crossing);
        let material = &self.scene.materials[hit.material as usize];
        let direction = branch.direction.normalize();

        let follow = |direction: DVec3, through: bool, factor: f64| {
            let child = Branch {
                origin: hit.point,
                direction,
                leaving: Some(Leaving { id: hit.id, through }),
                depth: branch.depth + 1,
                weight: branch.weight * factor,
            };
            self.branch_radiance(&child, settings)
        };
        let mirrored = direction - 2.0 * direction.dot(hit.normal) * hit.normal;
        let (reflect, alpha) = (material.reflect, material.alpha);

        let mut radiance = DVec3::ZERO;
        let (mut mirrored_factor, mut transmitted_factor) =
            (reflect, (1.0 - reflect) * (1.0 - alpha));
        let bent = transmitted_direction(direction, &hit, material);
        if bent.is_none() {
            mirrored_factor += std::mem::take(&mut transmitted_factor);
        }
        if mirrored_factor > 0.0 {
            radiance += mirrored_factor * follow(mirrored, false, mirrored_factor);
        }
        if reflect < 1.0 && alpha > 0.0 {
            let surface = self.surface_color(&hit) * self.irradiance(&crossing, &hit, settings);
            radiance += (1.0 - reflect) * alpha * surface;
        }
        if let Some(bent) = bent
            && transmitted_factor > 0.0
        {
            radiance += transmitted_factor * follow(bent, true, transmitted_factor);
        }
        radiance
    }

    /// E: the light on the side of the face that the ray came from.
    fn irradiance(&self, crossing: &Crossing<'_>, hit: &Hit, settings: &Settings) -> DVec3 {
        if settings.flat || self.scene.lights.is_empty() && self.scene.ambient.is_none() {
            return DVec3::ONE;
        }
        let secondary = settings.secondary.map(|side| self.secondary_light(hit, side));
        self.first_light(crossing, hit) + secondary.unwrap_or_default()
    }

    /// What arrives without being sent on by a face: the light from everywhere and straight from
    /// the point lights.
    pub(crate) fn first_light(&self, crossing: &Crossing<'_>, hit: &Hit) -> DVec3 {
        self.scene.ambient.unwrap_or(DVec3::ZERO) + self.direct_light(crossing, hit)
    }
}

/// Where light goes on behind the face, by Snell's law; `None` on total internal reflection.
/// `direction` has length 1.
fn transmitted_direction(direction: DVec3, hit: &Hit, material: &Material) -> Option<DVec3> {
    if material.refract == 0.0 || material.refract == 1.0 {
        return Some(direction);
    }
    let ratio = if hit.front { material.refract } else { 1.0 / material.refract };
    let cosine = -direction.dot(hit.normal);
    let cosine_squared = 1.0 - ratio * ratio * (1.0 - cosine) * (1.0 + cosine);
    (cosine_squared >= 0.0)
        .then(|| ratio * direction + (ratio * cosine - cosine_squared.sqrt()) * hit.normal)
        .map(DVec3::normalize)
}
