//! Light that faces send on to others, by a sum over the sky.

use std::f64::consts::TAU;

use glam::DVec3;

use crate::{
    face::{Crossing, Leaving},
    oracle::{Hit, Oracle, hit},
    ray::Ray,
};

/// By how much of a turn each ring of directions is turned against the last, so that straight edges
/// do not fall between the directions of many rings at once: the golden section.
const TURN: f64 = 0.618_033_988_749_894_8;

impl Oracle {
    /// The light that faces send on to the side of the face that `at` shows: the mean, over `side`
    /// rings of `side` directions that each stand for as much of the cosine-weighted sky, of what
    /// all faces on the way send back.
    pub fn secondary_light(&self, at: &Hit, side: u32) -> DVec3 {
        let normal = at.normal;
        let right = normal.any_orthonormal_vector();
        let up = normal.cross(right);
        let leaving = Leaving { id: at.id, through: false };
        let mut sum = DVec3::ZERO;
        for ring in 0..side {
            let square = (f64::from(ring) + 0.5) / f64::from(side);
            for step in 0..side {
                let turn = (f64::from(step) + 0.5) / f64::from(side) + f64::from(ring) * TURN;
                let (sine, cosine) = (TAU * turn).sin_cos();
                let aside = square.sqrt() * (cosine * right + sine * up);
                let direction = aside + (1.0 - square).sqrt() * normal;
                sum += self.sent_back(&Ray::along(at.point, direction), leaving);
            }
        }
        sum / (f64::from(side) * f64::from(side))
    }

    /// What the faces along a ray send back to its origin: each what the ones before it let
    /// through.
    fn sent_back(&self, ray: &Ray, leaving: Leaving) -> DVec3 {
        let mut crossings: Vec<Crossing<'_>> = self.crossings(ray, Some(leaving)).collect();
        crossings.sort_by(|a, b| a.compare(b, ray));
        let mut sum = DVec3::ZERO;
        let mut let_through = 1.0;
        for crossing in &crossings {
            let material = &self.scene.materials[crossing.face.material as usize];
            let sent = material.reflect * material.alpha;
            if sent > 0.0 {
                let place = hit(ray, crossing);
                let color = self.surface_color(&place);
                sum += let_through * sent * color * self.first_light(crossing, &place);
            }
            let_through *= (1.0 - material.alpha) * (1.0 - material.reflect);
            if let_through == 0.0 {
                break;
            }
        }
        sum
    }
}
