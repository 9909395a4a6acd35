//! How much of its sky an emitter, or a group of them, covers for a place that receives light.

use std::f64::consts::PI;

use glam::DVec3;

use crate::prepared::{layout::View, record::EmitterRecord};

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

/// The share of the sky from which on emitters fill it so far that choosing among them is no
/// gain.
pub(crate) const FULL_SHARE: f64 = 0.5;

/// How near to a sphere, in its distance, it is no longer aimed at.
pub(super) const SPHERE_CONTACT: f64 = 1e-6;

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
    let toward = DVec3::from_array(emitter.turned_area).dot(middle);
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

/// What all emitters of a node promise: that of a ball around them that they fill in part.
pub(super) fn node_promise(view: &View<'_>, receiver: &Receiver, index: u32) -> Promise {
    let node = &view.emitter_nodes[index as usize];
    if node.is_leaf() {
        return promise(view, &view.emitters[node.emitter as usize], receiver);
    }
    let to_center = DVec3::from_array(node.center) - receiver.position;
    let distance = to_center.length();
    let whole = if distance > node.radius {
        sphere_share(receiver.normal.dot(to_center) / distance, node.radius / distance)
    } else {
        1.0
    };
    let share = whole * node.fill;
    Promise { share, light: share * node.radiosity, square: 0.0 }
}

/// The corners of a polygon; of a triangle the last two are one.
pub(super) fn corners(view: &View<'_>, emitter: &EmitterRecord) -> [DVec3; 4] {
    emitter.vertices.map(|vertex| DVec3::from_array(view.vertices[vertex as usize]))
}

/// From this nearness on a polygon is not aimed at.
const NEAR: f64 = 0.3;

/// Up to this nearness it is left to aiming alone.
const FAR: f64 = 0.05;

/// A share of the sky that is small; twice of it is not.
const SMALL: f64 = 0.05;
