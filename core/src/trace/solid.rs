//! Constructive solids: where a ray enters and leaves one.
//!
//! Source: Roth, "Ray Casting for Modeling Solids" (1982). Every leaf's crossings with the whole
//! line of the ray are sorted; walking along them, each operation knows whether the ray is inside
//! its result, and the root's changes are the solid's surface. Nothing recurses, so no depth of
//! nesting needs stack.

use glam::DVec3;

use super::{
    quadrangle::toward_plane,
    ray::Ray,
    sphere::{hit_sphere, hit_sphere_again},
};
use crate::prepared::{
    face::Part,
    layout::View,
    record::{
        LeafRecord, NO_NODE, PlaneIndex, SolidNodeKind, SolidNodeRecord, SolidRecord, Surface,
    },
};

/// Where a ray crosses a solid's surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Crossing {
    /// In units of the ray's direction.
    pub(super) t: f64,
    pub(super) part: Part,
}

/// Where a ray crosses the boundary of a leaf.
#[derive(Debug, Clone, Copy)]
struct Event {
    t: f64,
    /// How far rounding may have moved it.
    doubt: f64,
    leaf: u32,
    face: u32,
}

/// Room to work in, kept from ray to ray.
#[derive(Debug, Default)]
pub(super) struct Scratch {
    events: Vec<Event>,
    /// For each node, whether the ray is inside it.
    inside: Vec<bool>,
    /// For each node, how many operands the ray is inside of; a difference counts those that are
    /// taken away.
    counts: Vec<u32>,
    /// For each node, the crossing at which it was last flipped, and whether the ray was inside it
    /// before.
    flipped: Vec<u32>,
    before: Vec<bool>,
    crossing: u32,
    /// The face at which each leaf is crossed last.
    faces: Vec<u32>,
    /// The result.
    pub(super) crossings: Vec<Crossing>,
}

impl Scratch {
    /// Finds where the ray, from its start on, crosses the solid's surface, in order. A surface
    /// that it leaves is crossed at 0, and one that it ends on (`ending_on`) at its reach.
    pub(super) fn cross(
        &mut self,
        view: &View<'_>,
        solid: &SolidRecord,
        ray: &Ray,
        ending_on: &[Surface],
    ) {
        self.crossings.clear();
        self.events.clear();
        let leaves = view.solid_leaves(solid);
        for (number, leaf) in (0..).zip(leaves) {
            push_events(&mut self.events, view, leaf, number, ray, ending_on);
        }
        if self.events.is_empty() {
            return;
        }
        self.events.sort_unstable_by(|a, b| {
            a.t.total_cmp(&b.t).then(a.leaf.cmp(&b.leaf)).then(a.face.cmp(&b.face))
        });
        let nodes = view.solid_nodes(solid);
        self.inside.clear();
        self.inside.resize(nodes.len(), false);
        self.counts.clear();
        self.counts.resize(nodes.len(), 0);
        self.before.resize(nodes.len(), false);
        self.flipped.clear();
        self.flipped.resize(nodes.len(), 0);
        self.crossing = 0;
        self.faces.resize(leaves.len(), 0);

        let mut next = 0;
        while next < self.events.len() {
            // Crossings that rounding cannot tell apart are one.
            let first = self.events[next];
            let mut end = next;
            self.crossing += 1;
            while let Some(&event) = self.events.get(end) {
                if event.t - first.t > first.doubt + event.doubt {
                    break;
                }
                self.faces[event.leaf as usize] = event.face;
                self.flip(nodes, leaves[event.leaf as usize].node);
                end += 1;
            }
            let root = nodes.len() - 1;
            if self.has_changed(root) {
                let leaf = self.responsible(nodes);
                let face = self.faces[leaf as usize];
                let of_leaf = |event: &&Event| event.leaf == leaf && event.face == face;
                let event = self.events[next..end].iter().find(of_leaf).unwrap_or(&first);
                // At its start and its end the ray only touches.
                let is_start = self.events[next..end].iter().any(|event| event.t == 0.0);
                let t = if is_start { 0.0 } else { event.t };
                if t >= 0.0 {
                    self.crossings.push(Crossing { t, part: Part::new(leaf, face) });
                }
            }
            next = end;
        }
    }

    /// The ray crosses a leaf: what that changes up to the root.
    fn flip(&mut self, nodes: &[SolidNodeRecord], leaf: u32) {
        let mut node = leaf as usize;
        loop {
            if self.flipped[node] != self.crossing {
                self.flipped[node] = self.crossing;
                self.before[node] = self.inside[node];
            }
            let is_inside = !self.inside[node];
            self.inside[node] = is_inside;
            let SolidNodeRecord { parent, is_first, .. } = nodes[node];
            if parent == NO_NODE {
                return;
            }
            let parent = parent as usize;
            let record = &nodes[parent];
            let is_minuend = record.kind == SolidNodeKind::DIFFERENCE && is_first == 1;
            if !is_minuend {
                let count = &mut self.counts[parent];
                *count = if is_inside { *count + 1 } else { *count - 1 };
            }
            let count = self.counts[parent];
            let result = match record.kind {
                SolidNodeKind::UNION => count > 0,
                SolidNodeKind::INTERSECTION => count == record.operands,
                _ => self.inside[record.first_child as usize] && count == 0,
            };
            if result == self.inside[parent] {
                return;
            }
            node = parent;
        }
    }

    /// Whether the current crossing leads into or out of a node's solid.
    fn has_changed(&self, node: usize) -> bool {
        self.flipped[node] == self.crossing && self.before[node] != self.inside[node]
    }

    /// The leaf whose face is the solid's surface where the root has changed: at each operation
    /// the first operand in file order that made it change.
    fn responsible(&self, nodes: &[SolidNodeRecord]) -> u32 {
        let mut node = nodes.len() - 1;
        let mut enters = self.inside[node];
        while nodes[node].kind != SolidNodeKind::LEAF {
            let takes_away = nodes[node].kind == SolidNodeKind::DIFFERENCE;
            let mut child = nodes[node].first_child;
            loop {
                let is_first = nodes[child as usize].is_first == 1;
                let wanted = if takes_away && !is_first { !enters } else { enters };
                let at = child as usize;
                if self.has_changed(at) && self.inside[at] == wanted {
                    (node, enters) = (at, wanted);
                    break;
                }
                child = nodes[at].next;
                assert!(child != NO_NODE, "an operation changes only if an operand does");
            }
        }
        nodes[node].first_child
    }
}

/// The crossings of a leaf with the whole line of the ray: none or two.
fn push_events(
    events: &mut Vec<Event>,
    view: &View<'_>,
    leaf: &LeafRecord,
    number: u32,
    ray: &Ray,
    ending_on: &[Surface],
) {
    // Of coordinates below 1, with the ray's own length on top.
    let doubt_of = |t: f64, cosine: f64| {
        4.0 * f64::EPSILON * (1.0 + ray.origin.abs().max_element() + t.abs()) / cosine.max(1e-12)
    };
    let ends_on = |surface: Surface| ending_on.contains(&surface);
    if leaf.is_sphere() {
        let center = DVec3::from_array(leaf.center);
        let surface = Surface(leaf.surface);
        let ends = if ray.leaving == surface {
            let again = hit_sphere_again(ray, center);
            [again.min(0.0), again.max(0.0)]
        } else if ends_on(surface) {
            let end = ray.reach;
            let back = Ray { origin: ray.origin + end * ray.direction, ..*ray };
            let again = end + hit_sphere_again(&back, center);
            [again.min(end), again.max(end)]
        } else {
            match hit_sphere(ray, center, leaf.radius) {
                Some(ends) => ends,
                None => return,
            }
        };
        let cosine = (ends[1] - ends[0]) / (2.0 * leaf.radius);
        for t in ends {
            let is_exact =
                (ray.leaving == surface && t == 0.0) || (ends_on(surface) && t == ray.reach);
            let doubt = if is_exact { 0.0 } else { doubt_of(t, cosine) };
            events.push(Event { t, doubt, leaf: number, face: 0 });
        }
        return;
    }
    let nowhere = Event { t: f64::NEG_INFINITY, doubt: 0.0, leaf: number, face: 0 };
    let (mut enter, mut leave) = (nowhere, Event { t: f64::INFINITY, ..nowhere });
    for (face, &plane) in (0..).zip(&leaf.planes) {
        let (distance, along) = plane_along(view, ray, plane);
        let surface = plane.surface();
        if along == 0.0 {
            if distance < 0.0 {
                return; // Outside, and never nearer.
            }
            continue;
        }
        let (t, doubt) = if ray.leaving == surface {
            (0.0, 0.0)
        } else if ends_on(surface) {
            (ray.reach, 0.0)
        } else {
            let t = distance / along;
            (t, doubt_of(t, along.abs()))
        };
        let event = Event { t, doubt, leaf: number, face };
        if along < 0.0 && t > enter.t {
            enter = event;
        } else if along > 0.0 && t < leave.t {
            leave = event;
        }
    }
    if enter.t < leave.t {
        events.extend([enter, leave]);
    }
}

/// How far the face's plane is from the ray's start, and how fast the ray goes there, both along
/// the face's outward normal.
fn plane_along(view: &View<'_>, ray: &Ray, plane: PlaneIndex) -> (f64, f64) {
    let record = &view.planes[plane.index()];
    let normal = DVec3::from_array(record.normal) * plane.sign();
    toward_plane(ray, DVec3::from_array(record.point), normal)
}
