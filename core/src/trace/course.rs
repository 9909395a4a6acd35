//! A ray on its way through a constructive solid: where it enters and leaves the leaves.

use glam::DVec3;

use super::{
    boxes::BoxKernel,
    quadrangle::toward_plane,
    ray::Ray,
    solid_rays::STEEP,
    sphere::{hit_sphere, hit_sphere_again},
};
use crate::prepared::{
    face::Part,
    layout::View,
    record::{LeafRecord, PlaneRecord, SolidNodeRecord, SolidRecord, Surface},
};

/// Where a ray crosses a solid's surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Crossing {
    /// In units of the ray's direction.
    pub(super) t: f64,
    pub(super) part: Part,
}

/// The bounds of a crossing's rounding, across the face, in ulp of what [`Course::doubt`] counts
/// by: docs/proof.md.
const SPHERE_ULP: f64 = 6.0;
const PLANE_ULP: f64 = 10.0;

/// Where a stretch of the ray inside something begins or ends.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct End {
    /// Along the course.
    pub(super) t: f64,
    /// Rounding may have moved it as far as these.
    pub(super) low: f64,
    pub(super) high: f64,
    pub(super) part: Part,
    /// The place among the operands that are being joined.
    pub(super) operand: u32,
    /// Whether the stretch begins here.
    pub(super) enters: bool,
    pub(super) pin: Pin,
}

/// Whether it is known exactly where an end is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Pin {
    No,
    /// On the surface that the ray leaves.
    Start,
    /// On the surface that it ends on.
    Goal,
}

/// A ray on its way through a solid. It starts near the solid, wherever the ray does: so rounding
/// is as fine as the solid.
pub(super) struct Course<'a> {
    pub(super) view: &'a View<'a>,
    pub(super) solid: &'a SolidRecord,
    pub(super) nodes: &'a [SolidNodeRecord],
    pub(super) leaves: &'a [LeafRecord],
    ending_on: &'a [Surface],
    ray: &'a Ray,
    /// The ray from its start on the course, with its end there.
    pub(super) near: Ray,
    /// The course starts here on the ray.
    pub(super) start: f64,
    /// The length of the vector to where it starts.
    size: f64,
}

impl<'a> Course<'a> {
    #[inline(always)]
    pub(super) fn new(
        view: &'a View<'a>,
        solid: &'a SolidRecord,
        ray: &'a Ray,
        ending_on: &'a [Surface],
    ) -> Self {
        let ahead = (DVec3::from_array(solid.frame.origin) - ray.origin).dot(ray.direction);
        let start = if ahead.abs() * solid.frame.scale > 8.0 { ahead } else { 0.0 };
        let origin = ray.origin + start * ray.direction;
        Self {
            view,
            solid,
            nodes: view.solid_nodes(solid),
            leaves: view.solid_leaves(solid),
            ending_on,
            ray,
            near: Ray { origin, reach: ray.reach - start, ..*ray },
            start,
            size: origin.length(),
        }
    }

    /// How far rounding may move a crossing of a leaf along the ray, which meets it at a cosine; no
    /// more than counts in the solid.
    fn doubt(&self, leaf: &LeafRecord, ulp: f64, t: f64, cosine: f64) -> f64 {
        let bound = ulp * f64::EPSILON * (leaf.extent + self.size + t.abs()) / cosine;
        bound.min(self.solid.most_doubt)
    }

    /// An end of the stretch inside a leaf; rounding moves it no farther than its doubt.
    #[inline(always)]
    fn end(
        &self,
        (leaf, ulp): (&LeafRecord, f64),
        (t, cosine): (f64, f64),
        (part, pin): (Part, Pin),
        enters: bool,
    ) -> End {
        let doubt = if pin == Pin::No { self.doubt(leaf, ulp, t, cosine) } else { 0.0 };
        End { t, low: t - doubt, high: t + doubt, part, operand: 0, enters, pin }
    }

    /// The stretch of the ray's line that is inside a leaf; `None` if there is none, or none that
    /// rounding leaves.
    #[inline(always)]
    pub(super) fn meet_leaf(&self, number: u32) -> Option<[End; 2]> {
        let leaf = &self.leaves[number as usize];
        let ends = if leaf.is_sphere() {
            self.meet_sphere(number, leaf)?
        } else {
            self.meet_box(number, leaf)?
        };
        (ends[0].high < ends[1].low).then_some(ends)
    }

    /// Where the line enters and leaves a sphere.
    #[inline(always)]
    fn meet_sphere(&self, number: u32, leaf: &LeafRecord) -> Option<[End; 2]> {
        let center = DVec3::from_array(leaf.center);
        let surface = Surface(leaf.surface);
        let is_left = self.ray.leaving == surface;
        let is_goal = self.ending_on.contains(&surface);
        let (ends, pins) = if is_left && is_goal {
            ([-self.start, self.near.reach], [Pin::Start, Pin::Goal])
        } else if is_left {
            let again = hit_sphere_again(self.ray, center);
            let ends = [again.min(0.0) - self.start, again.max(0.0) - self.start];
            (ends, if again > 0.0 { [Pin::Start, Pin::No] } else { [Pin::No, Pin::Start] })
        } else if is_goal {
            let end = self.ray.origin + self.ray.reach * self.ray.direction;
            let again = hit_sphere_again(&Ray { origin: end, ..*self.ray }, center);
            let ends = [self.near.reach + again.min(0.0), self.near.reach + again.max(0.0)];
            (ends, if again > 0.0 { [Pin::Goal, Pin::No] } else { [Pin::No, Pin::Goal] })
        } else {
            (hit_sphere(&self.near, center, leaf.radius)?, [Pin::No; 2])
        };
        let cosine = (ends[1] - ends[0]) / (2.0 * leaf.radius);
        let (by, part) = ((leaf, SPHERE_ULP), Part::new(number, 0));
        Some([
            self.end(by, (ends[0], cosine), (part, pins[0]), true),
            self.end(by, (ends[1], cosine), (part, pins[1]), false),
        ])
    }

    /// Where the line enters and leaves a parallelepiped, and through which faces.
    #[inline(always)]
    fn meet_box(&self, number: u32, leaf: &LeafRecord) -> Option<[End; 2]> {
        // The place, the cosine, the face.
        let mut enter = (f64::NEG_INFINITY, 1.0, 0, Pin::No);
        let mut leave = (f64::INFINITY, 1.0, 0, Pin::No);
        for (face, &plane) in (0..).zip(&leaf.planes) {
            let PlaneRecord { point, normal } = &self.view.planes[plane.index()];
            let [point, normal] = [*point, *normal].map(DVec3::from_array);
            let (distance, along) = toward_plane(&self.near, point, normal);
            let (distance, along) = (plane.outward(distance), plane.outward(along));
            if along == 0.0 {
                if distance < 0.0 {
                    return None; // Outside, and never nearer.
                }
                continue;
            }
            let surface = plane.surface();
            let (t, pin) = if self.ray.leaving == surface {
                (-self.start, Pin::Start)
            } else if self.ending_on.contains(&surface) {
                (self.near.reach, Pin::Goal)
            } else {
                (distance / along, Pin::No)
            };
            if along < 0.0 && t > enter.0 {
                enter = (t, -along, face, pin);
            } else if along > 0.0 && t < leave.0 {
                leave = (t, along, face, pin);
            }
        }
        if enter.0 >= leave.0 {
            return None;
        }
        let end = |(t, cosine, face, pin), enters| {
            self.end((leaf, PLANE_ULP), (t, cosine), (Part::new(number, face), pin), enters)
        };
        Some([end(enter, true), end(leave, false)])
    }

    /// The nearest common ancestor of two nodes, of which `a` comes first and is no ancestor of
    /// `b`.
    pub(super) fn join(&self, a: u32, b: u32) -> u32 {
        let mut node = a;
        while node < b {
            let SolidNodeRecord { jump, parent, .. } = self.nodes[node as usize];
            node = if jump < b { jump } else { parent };
        }
        node
    }

    /// The crossing at an end.
    pub(super) fn crossing(&self, end: &End) -> Crossing {
        let t = match end.pin {
            Pin::No => self.start + end.t,
            Pin::Start => 0.0,
            Pin::Goal => self.ray.reach,
        };
        Crossing { t, part: end.part }
    }

    /// The stretch of the line that is inside a leaf, to the bit as [`Self::meet_leaf`] has it, or
    /// [`NOWHERE`]; `None` where the leaf is grazed or thin, so that doubts might count.
    #[inline(always)]
    pub(super) fn sure_stretch(
        &self,
        kernel: impl BoxKernel,
        leaf: &LeafRecord,
    ) -> Option<[f64; 2]> {
        let (stretch, is_steep) = if leaf.is_sphere() {
            let stretch = self.sphere_stretch(leaf);
            (stretch, stretch[1] - stretch[0] >= STEEP * 2.0 * leaf.radius)
        } else {
            let planes = &self.view.box_planes[leaf.surface as usize];
            let (stretch, cosine) = kernel.cross_box(&self.near, -self.start, planes);
            (stretch, cosine >= STEEP)
        };
        let [enter, leave] = stretch;
        if enter >= leave {
            return Some(NOWHERE);
        }
        (is_steep && leave - enter > self.apart()).then_some(stretch)
    }

    /// Two ends of sure stretches that are farther from each other than this are not in one doubt.
    #[inline(always)]
    pub(super) fn apart(&self) -> f64 {
        self.solid.margin / 1024.0
    }

    #[inline(always)]
    fn sphere_stretch(&self, leaf: &LeafRecord) -> [f64; 2] {
        let center = DVec3::from_array(leaf.center);
        if self.ray.leaving == Surface(leaf.surface) {
            let again = hit_sphere_again(self.ray, center);
            return [again.min(0.0) - self.start, again.max(0.0) - self.start];
        }
        hit_sphere(&self.near, center, leaf.radius).unwrap_or(NOWHERE)
    }

    /// The crossing at an end of a leaf's sure stretch, at `t` of the course.
    #[inline(always)]
    pub(super) fn sure_crossing(
        &self,
        kernel: impl BoxKernel,
        number: u32,
        (t, enters): (f64, bool),
    ) -> Crossing {
        let leaf = &self.leaves[number as usize];
        let face = if leaf.is_sphere() {
            0
        } else {
            let planes = &self.view.box_planes[leaf.surface as usize];
            kernel.face_at((&self.near, -self.start), planes, t, enters)
        };
        Crossing { t: self.start + t, part: Part::new(number, face) }
    }
}

/// The stretch inside a leaf that the ray passes by: it ends before all others begin.
const NOWHERE: [f64; 2] = [f64::INFINITY, f64::NEG_INFINITY];
