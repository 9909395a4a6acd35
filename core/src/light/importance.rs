//! Importance estimates how much light an emitter, or a group of them, gives a place.
//!
//! An estimate only guides where rays go: what they bring is weighed by the density with which
//! they were sent, so an error here costs noise, never truth.

use std::f64::consts::PI;

use glam::DVec3;

use crate::prepared::{layout::View, record::EmitterRecord};

/// A place on a surface that receives light.
#[derive(Debug, Clone, Copy)]
pub(super) struct Receiver {
    /// Where it is, in the block's units.
    pub(super) position: DVec3,
    /// The unit normal towards the side that receives.
    pub(super) normal: DVec3,
}

/// What an emitter, or a group of them, is estimated to give a receiver. What it pays to sample an
/// emitter for is kept apart from what rays over the whole hemisphere find as well.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Importance {
    /// The estimated form factor: the share of the receiver's cosine-weighted hemisphere that the
    /// emitter covers, 0..=1. A sum over many emitters may be above 1.
    pub(super) form_factor: f64,
    /// The estimated irradiance from what it pays to sample: a form factor times a radiosity, at
    /// least 0.
    pub(super) irradiance: f64,
    /// The mean square of what one ray of the cosine-weighted hemisphere brings from the rest, at
    /// least 0.
    pub(super) mean_square: f64,
}

impl Importance {
    /// Emitters that cover this share of the hemisphere are found by any ray, so that choosing
    /// among them is no gain.
    const MOST_FORM_FACTOR: f64 = 0.5;

    /// Whether the emitters cover so much of the hemisphere that none of them is sampled.
    pub(super) fn fills_hemisphere(&self) -> bool {
        self.form_factor >= Self::MOST_FORM_FACTOR
    }
}

/// A sphere is not sampled from nearer than this, relative to the distance of its centre.
pub(super) const SPHERE_CONTACT: f64 = 1e-6;

/// A polygon of at least this nearness (see [`polygon_importance`]) is not sampled.
const NEAR: f64 = 0.3;

/// A polygon of at most this nearness is found by sampling it alone; in between, both share it.
const FAR: f64 = 0.05;

/// Polygons up to this form factor are sampled however near they are, and those above twice of it
/// only by their nearness.
const SMALL: f64 = 0.05;

/// Estimates what an emitter gives a receiver.
pub(super) fn emitter_importance(
    view: &View<'_>,
    emitter: &EmitterRecord,
    receiver: &Receiver,
) -> Importance {
    if emitter.is_sphere() {
        sphere_importance(emitter, receiver)
    } else {
        polygon_importance(view, emitter, receiver)
    }
}

/// Estimates what all emitters of a node give a receiver: they are taken for a ball around them of
/// which they fill a part.
pub(super) fn node_importance(view: &View<'_>, receiver: &Receiver, index: u32) -> Importance {
    let node = &view.emitter_nodes[index as usize];
    if node.is_leaf() {
        return emitter_importance(view, &view.emitters[node.emitter as usize], receiver);
    }
    let to_center = DVec3::from_array(node.center) - receiver.position;
    let distance = to_center.length();
    let of_ball = if distance > node.radius {
        sphere_form_factor(receiver.normal.dot(to_center) / distance, node.radius / distance)
    } else {
        1.0
    };
    let form_factor = of_ball * node.fill;
    Importance { form_factor, irradiance: form_factor * node.radiosity, mean_square: 0.0 }
}

fn sphere_importance(emitter: &EmitterRecord, receiver: &Receiver) -> Importance {
    let [radiosity, _] = emitter.radiosity;
    let to_center = DVec3::from_array(emitter.middle) - receiver.position;
    let distance = to_center.length();
    if distance - emitter.size <= distance * SPHERE_CONTACT {
        // A sphere in contact may be all around the receiver.
        let mean_square = radiosity * radiosity;
        return Importance { form_factor: 1.0, irradiance: 0.0, mean_square };
    }
    let cosine = receiver.normal.dot(to_center) / distance;
    let form_factor = sphere_form_factor(cosine, emitter.size / distance);
    Importance { form_factor, irradiance: form_factor * radiosity, mean_square: 0.0 }
}

/// Estimates the form factor of a sphere, 0..=1, from the cosine of the angle between the normal
/// and its centre, -1..=1, and the sine of half the angle under which it is seen, 0..=1. It is
/// exact unless the horizon cuts the sphere.
fn sphere_form_factor(cosine: f64, sine: f64) -> f64 {
    if cosine >= sine {
        return cosine * (sine * sine);
    }
    let above = (cosine + sine).max(0.0);
    0.25 * sine * (above * above)
}

/// Estimates what a polygon gives a receiver. A polygon that is near compared with its size and
/// covers much is left to the whole hemisphere: a sample is uniform on the area, which gives too
/// few directions to the part next to the receiver.
fn polygon_importance(view: &View<'_>, emitter: &EmitterRecord, receiver: &Receiver) -> Importance {
    let middle = DVec3::from_array(emitter.middle) - receiver.position;
    let toward = DVec3::from_array(emitter.vector_area).dot(middle);
    let radiosity = emitter.radiosity[usize::from(toward > 0.0)];
    let squared = middle.length_squared();
    // Nearness is the form factor of a disc of the polygon's area at the best angle, 0..=1.
    let nearness = emitter.size / (emitter.size + PI * squared);
    let farness = (NEAR - nearness).clamp(0.0, NEAR - FAR) / (NEAR - FAR);
    // This takes the polygon for a disc as well, at the angle at which it is seen.
    let mut form_factor = nearness * toward.abs() / (emitter.size * squared.sqrt());
    if farness > 0.0 || form_factor < 2.0 * SMALL {
        // A closer estimate takes it for one disc at each corner.
        let all = corners(view, emitter).map(|corner| corner - receiver.position);
        let corners = if emitter.is_triangle() { &all[..3] } else { &all[..] };
        let disc_area = emitter.size / corners.len() as f64;
        let mut sum = 0.0;
        for &corner in corners {
            let place = 0.5 * (middle + corner);
            let height = receiver.normal.dot(place);
            if height > 0.0 {
                let squared = place.length_squared();
                sum += height / (squared * (PI * squared + disc_area));
            }
        }
        form_factor = toward.abs() * sum / corners.len() as f64;
    }
    // `min` makes a number of 0/0.
    let form_factor = form_factor.min(1.0);
    // Rays over the whole hemisphere seldom find a small one, however near.
    let sampled = farness.max(((2.0 * SMALL - form_factor) / SMALL).min(1.0));
    let mean_square = form_factor * (1.0 - sampled) * (radiosity * radiosity);
    Importance { form_factor, irradiance: form_factor * sampled * radiosity, mean_square }
}

/// Reads the corners of a polygon; the last two of a triangle are one.
pub(super) fn corners(view: &View<'_>, emitter: &EmitterRecord) -> [DVec3; 4] {
    emitter.vertices.map(|vertex| DVec3::from_array(view.vertex(vertex)))
}
