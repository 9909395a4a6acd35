//! The fifth step: the bounding volume hierarchy.

use glam::DVec3;
use rayon::prelude::*;

use super::{
    bvh::{BuildPrimitive, Leaves, build_bvh},
    form::Form,
    surfaces::Surfaces,
};
use crate::{
    exact::float::{above, below, power_of_two_below_inverse},
    prepared::node::{Child, Frame, Node},
};

/// The most faces in a leaf of a scene that is not compact. Splitting them further makes a triangle
/// mesh no faster to trace and takes half as many bytes again.
const FEW: usize = 4;

/// So many corners are looked at in one go.
const CORNERS_AT_ONCE: usize = 1 << 12;

/// The hierarchy over all items of a scene: flat faces, spheres and solids.
pub(super) struct Hierarchy {
    /// Boxes are kept in this frame.
    pub(super) frame: Frame,
    pub(super) nodes: Vec<Node>,
    /// All items in the order in which leaves name them: the numbers of flat faces first, then
    /// those of spheres, then those of solids.
    pub(super) order: Vec<u32>,
}

impl Hierarchy {
    /// Builds the hierarchy.
    pub(crate) fn new(surfaces: &Surfaces, form: Form) -> Self {
        let frame = frame_around(surfaces);
        let mut primitives = build_primitives(surfaces, &frame);
        let most = if form == Form::Compact { Child::MOST_ITEMS } else { FEW };
        let first_solid = surfaces.flat.item_count() + surfaces.spheres.len();
        let nodes = build_bvh(&mut primitives, Leaves { most, alone_from: first_solid as u32 });
        let order = primitives.par_iter().flat_map_iter(BuildPrimitive::items).collect();
        Self { frame, nodes, order }
    }
}

/// The frame around everything.
fn frame_around(surfaces: &Surfaces) -> Frame {
    let flat = &surfaces.flat;
    let none = (DVec3::INFINITY, DVec3::NEG_INFINITY);
    let join = |a: (DVec3, DVec3), b: (DVec3, DVec3)| (a.0.min(b.0), a.1.max(b.1));
    let corners = flat.corners[..flat.item_corner_count()].par_chunks(CORNERS_AT_ONCE);
    let bounds = corners.map(|corners| {
        corners.iter().fold(none, |(min, max), &corner| {
            let point = flat.points[corner as usize];
            (min.min(point), max.max(point))
        })
    });
    let (min, max) = round_bounds(surfaces).fold(bounds.reduce(|| none, join), join);
    if min.x > max.x {
        return Frame { origin: [0.0; 3], scale: 1.0 };
    }
    let origin = min + (max - min) / 2.0;
    let extent = (max - origin).max(origin - min).max_element();
    Frame { origin: origin.to_array(), scale: power_of_two_below_inverse(extent) }
}

/// The bounds of everything that is not flat: spheres, then solids.
fn round_bounds(surfaces: &Surfaces) -> impl Iterator<Item = (DVec3, DVec3)> {
    let spheres = surfaces.spheres.iter().map(|sphere| {
        let center = DVec3::from_array(sphere.center);
        (center - sphere.radius, center + sphere.radius)
    });
    // An empty intersection has bounds inside out.
    let solids = surfaces.solid_bounds.iter().map(|&(min, max)| (min.min(max), max.max(min)));
    spheres.chain(solids).map(|(min, max)| {
        let blur = 4.0 * f64::EPSILON * min.abs().max(max.abs()).max(max - min);
        (min - blur, max + blur)
    })
}

/// Items are joined within runs of so many: the hierarchy depends on it.
const JOINED_AT_ONCE: usize = 1 << 12;

/// What the hierarchy is built over: flat faces, two at a time where they are as good as one, and
/// all else.
fn build_primitives(surfaces: &Surfaces, frame: &Frame) -> Vec<BuildPrimitive> {
    let flat = &surfaces.flat;
    let origin = DVec3::from_array(frame.origin);
    let primitive = |(min, max): (DVec3, DVec3), item| {
        // Rounding to f64 must not pull a box in.
        let relative = |point: DVec3| ((point - origin) * frame.scale).to_array();
        BuildPrimitive::new(
            relative(min).map(|x| below(x - x.abs() * f64::EPSILON)),
            relative(max).map(|x| above(x + x.abs() * f64::EPSILON)),
            item,
        )
    };
    let of_face = |face: usize| primitive(flat.bounds(face), face as u32);
    let of_run = |run: usize| {
        let mut primitives: Vec<BuildPrimitive> = Vec::with_capacity(JOINED_AT_ONCE);
        let mut is_open = false;
        for face in JOINED_AT_ONCE * run..flat.item_count().min(JOINED_AT_ONCE * (run + 1)) {
            let next = of_face(face);
            let both = primitives.last().filter(|_| is_open).and_then(|last| last.joined(&next));
            if let Some(both) = both {
                primitives.pop();
                primitives.push(both);
            } else {
                primitives.push(next);
            }
            is_open = both.is_none();
        }
        primitives
    };
    let runs = flat.item_count().div_ceil(JOINED_AT_ONCE);
    let runs: Vec<Vec<BuildPrimitive>> = (0..runs).into_par_iter().map(of_run).collect();
    let mut primitives = runs.concat();
    let round = round_bounds(surfaces).zip(flat.item_count() as u32..);
    primitives.extend(round.map(|(round, item)| primitive(round, item)));
    primitives
}
