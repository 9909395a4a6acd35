//! A receiver samples directions from which light may come: over the cosine-weighted hemisphere, or
//! towards one of the emitters.

use std::f64::consts::{FRAC_PI_4, PI};

use glam::DVec3;

use super::{
    importance::{Importance, Receiver, SPHERE_CONTACT, corners},
    tree::LightCut,
};
use crate::{
    prepared::{layout::View, record::EmitterRecord},
    sample::GatherNumbers,
};

/// A direction in which to look for light.
#[derive(Debug, Clone, Copy)]
pub(super) struct LightSample {
    /// The unit direction, above the receiver's horizon.
    pub(super) direction: DVec3,
    /// The probability with which the whole hemisphere is sampled instead of one emitter: above 0,
    /// at most 1.
    pub(super) hemisphere_probability: f64,
    /// The emitter that the direction was chosen for, and the direction's probability density for
    /// what that emitter gives, relative to the density cosine / π of the hemisphere. It is `None`
    /// where the whole hemisphere was sampled: then all emitters count.
    pub(super) emitter: Option<(u32, f64)>,
}

/// The least probability with which the whole hemisphere is sampled. Its inverse bounds what one
/// ray may bring from emitters whose importance is underestimated.
const LEAST_HEMISPHERE: f64 = 0.05;

/// Where the whole hemisphere would be sampled with this probability or more, it always is.
const MOST_HEMISPHERE: f64 = 0.6;

/// Decides with which probability, above 0 and up to 1, the whole hemisphere is sampled where
/// emitters have this importance. It weighs the deviation of what the hemisphere brings against
/// that of what the sampled emitters bring, which is about its mean.
#[inline]
fn hemisphere_probability(importance: &Importance) -> f64 {
    let deviation = importance.mean_square.sqrt();
    // `max` makes a number of 0/0, where nothing has importance.
    let hemisphere = (deviation / (deviation + importance.irradiance)).max(LEAST_HEMISPHERE);
    if hemisphere < MOST_HEMISPHERE && !importance.fills_hemisphere() { hemisphere } else { 1.0 }
}

/// How a receiver looks for light: with how many rays, and how each chooses its direction.
pub(super) struct LightPlan<'a> {
    view: &'a View<'a>,
    receiver: &'a Receiver,
    /// `None` where no emitter is on record, so that none can be chosen.
    cut: Option<LightCut>,
    /// The probability, above 0 and up to 1, with which a ray samples the whole hemisphere.
    hemisphere: f64,
}

/// How many rays a receiver sends whose hemisphere is full of emitters: aiming at them is no gain,
/// and where light comes from everywhere its noise is most of a picture's. Measured on a bowl and a
/// room.
const RAYS_AMONG_EMITTERS: u32 = 4;

impl<'a> LightPlan<'a> {
    /// That of a receiver.
    #[inline]
    pub(super) fn new(view: &'a View<'a>, receiver: &'a Receiver) -> Self {
        let cut = (!view.emitters.is_empty()).then(|| LightCut::new(view, receiver));
        let hemisphere = cut.as_ref().map_or(1.0, |cut| hemisphere_probability(cut.total()));
        Self { view, receiver, cut, hemisphere }
    }

    /// How many rays the receiver sends.
    pub(super) fn ray_count(&self) -> u32 {
        let is_among = self.cut.as_ref().is_some_and(|cut| cut.total().fills_hemisphere());
        if is_among { RAYS_AMONG_EMITTERS } else { 1 }
    }

    /// Chooses a direction: one sample from a mixture of the cosine-weighted hemisphere and all
    /// emitters. It is `None` where the one chosen leads below the receiver's horizon.
    ///
    /// Source: Veach & Guibas, "Optimally Combining Sampling Techniques for Monte Carlo Rendering"
    /// (1995): the balance heuristic, here for the light of each emitter on its own, so that only
    /// the chosen one's density must be known.
    #[inline]
    pub(super) fn sample(&self, numbers: &GatherNumbers) -> Option<LightSample> {
        let Self { view, receiver, hemisphere, .. } = *self;
        let choice = if hemisphere < 1.0 { numbers.choice() } else { 0.0 };
        let Some(cut) = self.cut.as_ref().filter(|_| choice >= hemisphere) else {
            return sample_hemisphere(receiver, hemisphere, numbers.direction());
        };
        let rest = (choice - hemisphere) / (1.0 - hemisphere);
        let (index, probability) = cut.choose(view, receiver, rest)?;
        let emitter = &view.emitters[index as usize];
        let (direction, distance) = if emitter.is_sphere() {
            (sample_sphere(emitter, receiver, numbers.direction())?, 0.0)
        } else {
            sample_polygon(view, emitter, receiver, numbers.direction())?
        };
        let cosine = receiver.normal.dot(direction);
        if cosine <= 0.0 || !cosine.is_finite() {
            return None;
        }
        let density = hemisphere
            + (1.0 - hemisphere)
                * probability
                * relative_density(emitter, receiver, direction, distance);
        Some(LightSample {
            direction,
            hemisphere_probability: hemisphere,
            emitter: Some((index, density)),
        })
    }
}

/// The probability density, relative to the density cosine / π of the hemisphere, with which
/// [`LightPlan::sample`] chooses `direction` for what an emitter gives that is met at `distance`.
/// `hemisphere` is the probability, below 1, with which the whole hemisphere is sampled. A face
/// that is no emitter on record, whose index is `None`, is never sampled itself.
#[inline]
pub(super) fn density(
    view: &View<'_>,
    receiver: &Receiver,
    hemisphere: f64,
    index: Option<u32>,
    direction: DVec3,
    distance: f64,
) -> f64 {
    let Some(index) = index else { return hemisphere };
    let probability = LightCut::new(view, receiver).probability(view, receiver, index);
    if probability == 0.0 {
        return hemisphere;
    }
    let emitter = &view.emitters[index as usize];
    hemisphere
        + (1.0 - hemisphere)
            * probability
            * relative_density(emitter, receiver, direction, distance)
}

/// The density with which a direction towards one emitter is chosen, relative to the density
/// cosine / π of the hemisphere. It may be infinite where a polygon is seen edge-on.
fn relative_density(
    emitter: &EmitterRecord,
    receiver: &Receiver,
    direction: DVec3,
    distance: f64,
) -> f64 {
    let cosine = receiver.normal.dot(direction);
    let density = if emitter.is_sphere() {
        match Cone::of_sphere(emitter, receiver) {
            Some(Cone { height, .. }) => 0.5 / height,
            None => return 0.0,
        }
    } else {
        // Per solid angle distance² / (area · cosine there), over cosine / π.
        PI * (distance * distance) / DVec3::from_array(emitter.vector_area).dot(direction).abs()
    };
    density / cosine
}

/// Chooses a direction with the density cosine / π, by two numbers in 0..1. It is `None` where
/// rounding leads below the horizon.
#[inline]
fn sample_hemisphere(
    receiver: &Receiver,
    hemisphere_probability: f64,
    numbers: [f64; 2],
) -> Option<LightSample> {
    let [x, y] = to_disc(numbers);
    let z = (1.0 - x * x - y * y).max(0.0).sqrt();
    let (right, up) = receiver.normal.any_orthonormal_pair();
    let direction = x * right + y * up + z * receiver.normal;
    let direction = direction / direction.length();
    let is_above = receiver.normal.dot(direction) > 0.0;
    is_above.then_some(LightSample { direction, hemisphere_probability, emitter: None })
}

/// The cone in which a receiver sees a sphere.
struct Cone {
    axis: DVec3,
    /// 1 - the cosine between the axis and the cone's side: the solid angle over 2π, in 0..=1.
    height: f64,
}

impl Cone {
    /// It is `None` for a receiver inside, or so near that the cone is a hemisphere within
    /// rounding.
    fn of_sphere(emitter: &EmitterRecord, receiver: &Receiver) -> Option<Self> {
        let to_center = DVec3::from_array(emitter.middle) - receiver.position;
        let (distance, radius) = (to_center.length(), emitter.size);
        let gap = distance - radius;
        if gap <= distance * SPHERE_CONTACT {
            return None;
        }
        let sine = radius / distance;
        let cosine = (gap / distance * (1.0 + sine)).sqrt();
        Some(Self { axis: to_center / distance, height: sine * sine / (1.0 + cosine) })
    }
}

/// Chooses a direction uniformly in the cone in which the sphere is seen, by two numbers in 0..1.
#[inline]
fn sample_sphere(emitter: &EmitterRecord, receiver: &Receiver, numbers: [f64; 2]) -> Option<DVec3> {
    let Cone { axis, height } = Cone::of_sphere(emitter, receiver)?;
    let [x, y] = to_disc(numbers);
    // 1 - cosine is uniform, and its square root the distance from the disc's middle.
    let below = (x * x + y * y) * height;
    let aside = (height * (2.0 - below)).sqrt();
    let (right, up) = axis.any_orthonormal_pair();
    let direction = (1.0 - below) * axis + aside * (x * right + y * up);
    Some(direction / direction.length())
}

/// Chooses a point uniformly on the polygon, by two numbers in 0..1: the direction towards it and
/// its distance, above 0.
#[inline]
fn sample_polygon(
    view: &View<'_>,
    emitter: &EmitterRecord,
    receiver: &Receiver,
    numbers: [f64; 2],
) -> Option<(DVec3, f64)> {
    let place = to_polygon(&corners(view, emitter), numbers);
    let to_place = place - receiver.position;
    let distance = to_place.length();
    (distance > 0.0).then(|| (to_place / distance, distance))
}

/// Maps the unit square uniformly to a polygon, which its diagonal from the first corner cuts into
/// two triangles.
///
/// Source: Heitz, "A Low-Distortion Map Between Triangle and Square" (2019).
fn to_polygon(corners: &[DVec3; 4], [u, v]: [f64; 2]) -> DVec3 {
    let [b, c, d] = [1, 2, 3].map(|k| corners[k] - corners[0]);
    let areas = [b.cross(c).length(), c.cross(d).length()];
    let first = areas[0] / (areas[0] + areas[1]);
    let (u, [b, c]) =
        if u < first { (u / first, [b, c]) } else { ((u - first) / (1.0 - first), [c, d]) };
    let (s, t) = if v > u { (u * 0.5, v - u * 0.5) } else { (u - v * 0.5, v * 0.5) };
    corners[0] + s * b + t * c
}

/// Maps the unit square uniformly to the unit disc.
///
/// Source: Shirley & Chiu, "A Low Distortion Map Between Disk and Square" (1997).
#[inline]
fn to_disc([u, v]: [f64; 2]) -> [f64; 2] {
    let (a, b) = (2.0 * u - 1.0, 2.0 * v - 1.0);
    if a == 0.0 && b == 0.0 {
        return [0.0; 2];
    }
    if a.abs() > b.abs() {
        let (sine, cosine) = sine_and_cosine(FRAC_PI_4 * (b / a));
        [a * cosine, a * sine]
    } else {
        let (sine, cosine) = sine_and_cosine(FRAC_PI_4 * (a / b));
        [b * sine, b * cosine]
    }
}

/// Computes the sine and the cosine of an angle in -π/4..=π/4 by Taylor's series, within 1e-14.
fn sine_and_cosine(angle: f64) -> (f64, f64) {
    let x = angle * angle;
    let sine = 1.0
        - x / 6.0
            * (1.0
                - x / 20.0
                    * (1.0 - x / 42.0 * (1.0 - x / 72.0 * (1.0 - x / 110.0 * (1.0 - x / 156.0)))));
    let cosine = 1.0
        - x / 2.0
            * (1.0
                - x / 12.0
                    * (1.0 - x / 30.0 * (1.0 - x / 56.0 * (1.0 - x / 90.0 * (1.0 - x / 132.0)))));
    (angle * sine, cosine)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Pictures rest on these bits: a library that computes them otherwise changes every picture.
    ///
    /// Source: Duff et al., "Building an Orthonormal Basis, Revisited" (2017).
    #[test]
    fn the_pair_of_directions_beside_another_has_the_published_bits() {
        let published = |axis: DVec3| {
            let sign = 1_f64.copysign(axis.z);
            let a = -1.0 / (sign + axis.z);
            let b = axis.x * axis.y * a;
            [
                DVec3::new(1.0 + sign * axis.x * axis.x * a, sign * b, -sign * axis.x),
                DVec3::new(b, sign + axis.y * axis.y * a, -axis.y),
            ]
        };
        let bits = |pair: [DVec3; 2]| pair.map(|axis| axis.to_array().map(f64::to_bits));
        let mut axes = vec![DVec3::X, DVec3::Y, DVec3::Z];
        axes.extend([DVec3::new(0.6, -0.8, 0.0), DVec3::new(1e-9, 0.0, 1.0)]);
        let random = &mut rtfarm_oracle::random::Random::new(1);
        for _ in 0..10_000 {
            let axis = DVec3::from_array([(); 3].map(|()| random.between(-1.0, 1.0)));
            axes.push(axis / axis.length());
        }
        for axis in axes {
            for axis in [axis, -axis] {
                let (right, up) = axis.any_orthonormal_pair();
                assert_eq!(bits([right, up]), bits(published(axis)), "{axis}");
            }
        }
    }
}
