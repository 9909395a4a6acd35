//! Faces that send light on, seen from a place that receives it: how much of its sky each covers,
//! and directions towards them.
//!
//! All of it only guides where rays go: what they bring is weighed by the density with which they
//! were sent, so an estimate here costs noise, never truth.

use std::f64::consts::{FRAC_PI_4, PI};

use glam::DVec3;

use super::tree::Survey;
use crate::{
    prepared::{layout::View, record::EmitterRecord},
    sample::GatherNumbers,
};

/// A place on a surface that receives light.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Receiver {
    pub(crate) position: DVec3,
    /// Of length 1, towards the side that receives.
    pub(crate) normal: DVec3,
}

/// How much an emitter, or a group of them, may give a receiver: what it pays to aim at, and what
/// rays over the whole sky find as well.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Promise {
    /// About how much of the receiver's cosine-weighted sky it covers: 0..=1.
    pub(crate) share: f64,
    /// About how much light comes from what it pays to aim at: its share times what it sends on
    /// at most.
    pub(crate) light: f64,
    /// The mean square of what a ray of the whole sky brings from the rest.
    pub(crate) square: f64,
}

/// A direction in which to look for light.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Aim {
    /// Of length 1, above the receiver.
    pub(crate) direction: DVec3,
    /// The probability with which the whole sky is sampled, not one emitter: above 0.
    pub(crate) sky: f64,
    /// The emitter that the direction was chosen for, and the probability density, in the measure
    /// of the cosine over π, of the direction for what that emitter gives. `None` where the whole
    /// sky was sampled: then all emitters count.
    pub(crate) emitter: Option<(u32, f64)>,
}

/// The least probability with which the whole sky is sampled. It bounds what one ray may bring by
/// its inverse, for emitters that the estimates here overlook.
const LEAST_SKY: f64 = 0.05;

/// The share of the sky from which on emitters fill it so far that choosing among them is no
/// gain.
pub(crate) const FULL_SHARE: f64 = 0.5;

/// The probability with which the whole sky is sampled above which it is sampled always.
const MOST_SKY: f64 = 0.6;

/// The probability with which the whole sky is sampled where emitters promise this: in proportion
/// to the deviation of what it finds, against that of the light aimed at, which is about its mean.
fn sky_probability(promise: &Promise) -> f64 {
    let deviation = promise.square.sqrt();
    let sky = (deviation / (deviation + promise.light)).max(LEAST_SKY);
    // Also where nothing is promised.
    if sky < MOST_SKY && promise.share < FULL_SHARE { sky } else { 1.0 }
}

/// Chooses a direction: one sample from a mixture of the cosine-weighted
/// sky and all emitters. `None` where the one chosen leads below the receiver's horizon.
///
/// Source: Veach & Guibas, "Optimally Combining Sampling Techniques for Monte Carlo Rendering"
/// (1995): the balance heuristic, here for the light of each emitter on its own, so that only the
/// chosen one's density must be known.
pub(crate) fn aim(view: &View<'_>, receiver: &Receiver, numbers: &GatherNumbers) -> Option<Aim> {
    // Nothing on record can be aimed at.
    if view.emitters.is_empty() {
        return toward_sky(receiver, 1.0, numbers.direction());
    }
    let survey = Survey::new(view, receiver);
    let sky = sky_probability(survey.total());
    let choice = if sky < 1.0 { numbers.choice() } else { 0.0 };
    if choice < sky {
        return toward_sky(receiver, sky, numbers.direction());
    }
    let rest = (choice - sky) / (1.0 - sky);
    let (index, probability) = survey.choose(view, receiver, rest)?;
    let emitter = &view.emitters[index as usize];
    let (direction, distance) = if emitter.is_sphere() {
        (toward_sphere(emitter, receiver, numbers.direction())?, 0.0)
    } else {
        toward_polygon(view, emitter, receiver, numbers.direction())?
    };
    let cosine = receiver.normal.dot(direction);
    if cosine <= 0.0 || !cosine.is_finite() {
        return None;
    }
    let density =
        sky + (1.0 - sky) * probability * relative_density(emitter, receiver, direction, distance);
    Some(Aim { direction, sky, emitter: Some((index, density)) })
}

/// The probability density, in the measure of the cosine over π, with which [`aim`] chooses
/// `direction` for what the emitter gives; it was met at `distance`, and the whole sky is sampled
/// with probability `sky`, below 1. A face that is no emitter on record is never aimed at.
pub(crate) fn density(
    view: &View<'_>,
    receiver: &Receiver,
    sky: f64,
    index: Option<u32>,
    direction: DVec3,
    distance: f64,
) -> f64 {
    let Some(index) = index else { return sky };
    let probability = Survey::new(view, receiver).probability(view, receiver, index);
    if probability == 0.0 {
        return sky;
    }
    let emitter = &view.emitters[index as usize];
    sky + (1.0 - sky) * probability * relative_density(emitter, receiver, direction, distance)
}

/// The density with which a direction towards one emitter is chosen, over that of the
/// cosine-weighted sky. May be infinite where a polygon is seen edge-on.
fn relative_density(
    emitter: &EmitterRecord,
    receiver: &Receiver,
    direction: DVec3,
    distance: f64,
) -> f64 {
    let cosine = receiver.normal.dot(direction);
    let density = if emitter.is_sphere() {
        match cone(emitter, receiver) {
            Some(Cone { height, .. }) => 0.5 / height,
            None => return 0.0,
        }
    } else {
        // Per solid angle distance² / (area · cosine there), over cosine / π.
        PI * (distance * distance) / DVec3::from_array(emitter.vector_area).dot(direction).abs()
    };
    density / cosine
}

/// A direction with a density of cosine / π.
fn toward_sky(receiver: &Receiver, sky: f64, numbers: [f64; 2]) -> Option<Aim> {
    let [x, y] = in_disc(numbers);
    let z = (1.0 - x * x - y * y).max(0.0).sqrt();
    let [right, up] = basis(receiver.normal);
    let direction = x * right + y * up + z * receiver.normal;
    let direction = direction / direction.length();
    let is_above = receiver.normal.dot(direction) > 0.0;
    is_above.then_some(Aim { direction, sky, emitter: None })
}

/// The cone in which a sphere is seen.
struct Cone {
    axis: DVec3,
    /// 1 - the cosine between the axis and the cone's side: the solid angle over 2π, in 0..=1.
    height: f64,
}

/// `None` for a receiver inside, or so near that the cone is a hemisphere within rounding.
fn cone(emitter: &EmitterRecord, receiver: &Receiver) -> Option<Cone> {
    let to_center = DVec3::from_array(emitter.middle) - receiver.position;
    let (distance, radius) = (to_center.length(), emitter.size);
    let gap = distance - radius;
    if gap <= distance * SPHERE_CONTACT {
        return None;
    }
    let sine = radius / distance;
    let cosine = (gap / distance * (1.0 + sine)).sqrt();
    Some(Cone { axis: to_center / distance, height: sine * sine / (1.0 + cosine) })
}

/// How near to a sphere, in its distance, it is no longer aimed at.
const SPHERE_CONTACT: f64 = 1e-6;

/// Uniform in the cone in which the sphere is seen.
fn toward_sphere(emitter: &EmitterRecord, receiver: &Receiver, numbers: [f64; 2]) -> Option<DVec3> {
    let Cone { axis, height } = cone(emitter, receiver)?;
    let [x, y] = in_disc(numbers);
    // 1 - cosine is uniform, and its square root the distance from the disc's middle.
    let below = (x * x + y * y) * height;
    let aside = (height * (2.0 - below)).sqrt();
    let [right, up] = basis(axis);
    let direction = (1.0 - below) * axis + aside * (x * right + y * up);
    Some(direction / direction.length())
}

/// A direction to a place uniform on the polygon, and how far that is.
fn toward_polygon(
    view: &View<'_>,
    emitter: &EmitterRecord,
    receiver: &Receiver,
    numbers: [f64; 2],
) -> Option<(DVec3, f64)> {
    let place = on_polygon(&corners(view, emitter), numbers);
    let to_place = place - receiver.position;
    let distance = to_place.length();
    (distance > 0.0).then(|| (to_place / distance, distance))
}

/// The corners of a polygon; of a triangle the last two are one.
fn corners(view: &View<'_>, emitter: &EmitterRecord) -> [DVec3; 4] {
    emitter.vertices.map(|vertex| DVec3::from_array(view.vertices[vertex as usize]))
}

/// A place uniform on a polygon that its diagonal from the first corner cuts in two triangles.
///
/// Source: Heitz, "A Low-Distortion Map Between Triangle and Square" (2019).
fn on_polygon(corners: &[DVec3; 4], [u, v]: [f64; 2]) -> DVec3 {
    let [b, c, d] = [1, 2, 3].map(|k| corners[k] - corners[0]);
    let areas = [b.cross(c).length(), c.cross(d).length()];
    let first = areas[0] / (areas[0] + areas[1]);
    let (u, [b, c]) =
        if u < first { (u / first, [b, c]) } else { ((u - first) / (1.0 - first), [c, d]) };
    let (s, t) = if v > u { (u * 0.5, v - u * 0.5) } else { (u - v * 0.5, v * 0.5) };
    corners[0] + s * b + t * c
}

/// What an emitter promises a receiver.
pub(crate) fn promise(view: &View<'_>, emitter: &EmitterRecord, receiver: &Receiver) -> Promise {
    if !emitter.is_sphere() {
        return polygon_promise(view, emitter, receiver);
    }
    let [radiosity, _] = emitter.radiosity;
    let to_center = DVec3::from_array(emitter.middle) - receiver.position;
    let distance = to_center.length();
    if distance - emitter.size <= distance * SPHERE_CONTACT {
        // All around, if it is there.
        return Promise { share: 1.0, light: 0.0, square: radiosity * radiosity };
    }
    let cosine = receiver.normal.dot(to_center) / distance;
    let share = sphere_share(cosine, emitter.size / distance);
    Promise { share, light: share * radiosity, square: 0.0 }
}

/// About the share of the sky that a sphere covers whose centre is seen under an angle of this
/// cosine, with its radius over its distance, 0..=1. Exact but where the horizon cuts it.
pub(crate) fn sphere_share(cosine: f64, sine: f64) -> f64 {
    if cosine >= sine {
        return cosine * (sine * sine);
    }
    let above = (cosine + sine).max(0.0);
    0.25 * sine * (above * above)
}

/// What a polygon promises. A near one, compared with its size, that covers much is left to the
/// whole sky: its places are chosen by area, and of those next to the receiver that chooses too few.
fn polygon_promise(view: &View<'_>, emitter: &EmitterRecord, receiver: &Receiver) -> Promise {
    let middle = DVec3::from_array(emitter.middle) - receiver.position;
    let toward = DVec3::from_array(emitter.vector_area).dot(middle);
    let radiosity = emitter.radiosity[usize::from(toward > 0.0)];
    let squared = middle.length_squared();
    // The share of the sky that a disc of its area covers at the best angle: 0..=1.
    let nearness = emitter.size / (emitter.size + PI * squared);
    let is_far = (NEAR - nearness).clamp(0.0, NEAR - FAR) / (NEAR - FAR);
    // About it at this angle.
    let mut share = nearness * toward.abs() / (emitter.size * squared.sqrt());
    if is_far > 0.0 || share < 2.0 * SMALL {
        // A part at each corner, as a disc.
        let all = corners(view, emitter).map(|corner| corner - receiver.position);
        let corners = if emitter.is_triangle() { &all[..3] } else { &all[..] };
        let part = emitter.size / corners.len() as f64;
        let mut sum = 0.0;
        for &corner in corners {
            let place = 0.5 * (middle + corner);
            let height = receiver.normal.dot(place);
            if height > 0.0 {
                let squared = place.length_squared();
                sum += height / (squared * (PI * squared + part));
            }
        }
        share = toward.abs() * sum / corners.len() as f64;
    }
    // `min` makes a number of 0/0.
    let share = share.min(1.0);
    // Rays of the whole sky seldom find a small one, however near.
    let aimed = is_far.max(((2.0 * SMALL - share) / SMALL).min(1.0));
    let square = share * (1.0 - aimed) * (radiosity * radiosity);
    Promise { share, light: share * aimed * radiosity, square }
}

/// From this nearness on a polygon is not aimed at.
const NEAR: f64 = 0.3;

/// Up to this nearness it is left to aiming alone.
const FAR: f64 = 0.05;

/// A share of the sky that is small; twice of it is not.
const SMALL: f64 = 0.05;

/// A place uniform in the unit disc by a place in the unit square.
///
/// Source: Shirley & Chiu, "A Low Distortion Map Between Disk and Square" (1997).
fn in_disc([u, v]: [f64; 2]) -> [f64; 2] {
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

/// Of an angle in -π/4..=π/4, by Taylor's series, within 1e-14.
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

/// Two directions at right angles to each other and to `axis`, all of length 1.
///
/// Source: Duff et al., "Building an Orthonormal Basis, Revisited" (2017).
fn basis(axis: DVec3) -> [DVec3; 2] {
    let sign = 1_f64.copysign(axis.z);
    let a = -1.0 / (sign + axis.z);
    let b = axis.x * axis.y * a;
    [
        DVec3::new(1.0 + sign * axis.x * axis.x * a, sign * b, -sign * axis.x),
        DVec3::new(b, sign + axis.y * axis.y * a, -axis.y),
    ]
}
