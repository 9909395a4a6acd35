//! The hierarchy is searched with a frustum for the faces in a beam.

use glam::DVec3;

use super::{
    outline::Outlines,
    screen::{Beam, Screen},
};
use crate::{
    isa::Isa,
    prepared::{
        layout::View,
        node::{Child, Frame, Node},
    },
    trace::kernels::{LaneWork, run_in_lanes},
};

/// Room for rounding in the test of a box, relative to its terms; rounding is 2^12 times finer.
const MARGIN: f64 = 1.0 / (1_u64 << 40) as f64;

/// Leaves that are found before their faces are looked at.
const LEAVES: usize = 16;

/// The search for the faces in a beam, and what the latest one found.
#[derive(Debug)]
pub(super) struct FrustumSearch {
    /// The outlines of the faces that were found.
    pub(super) outlines: Outlines,
    isa: Isa,
    waiting: Vec<Child>,
    leaves: Vec<Child>,
}

impl FrustumSearch {
    /// A search with the instructions of `isa`.
    pub(super) fn new(isa: Isa) -> Self {
        Self { outlines: Outlines::default(), isa, waiting: Vec::new(), leaves: Vec::new() }
    }

    /// Collects the outlines of the faces in a beam. It gives up, and the answer is `false`, once
    /// there are more than `most`.
    pub(super) fn collect(
        &mut self,
        view: &View<'_>,
        screen: &Screen,
        beam: &Beam,
        most: usize,
    ) -> bool {
        let Self { outlines, isa, waiting, leaves } = self;
        outlines.clear();
        waiting.clear();
        waiting.push(Child::ROOT);
        let frustum = Frustum::new(screen, &view.header.frame, beam);
        while !waiting.is_empty() {
            leaves.clear();
            run_in_lanes(*isa, &mut Descent { view, frustum: &frustum, waiting, leaves });
            for leaf in leaves.iter() {
                for item in view.items(leaf.items()) {
                    outlines.add_item(view, screen, item, beam);
                }
                if outlines.as_slice().len() > most {
                    return false;
                }
            }
        }
        true
    }
}

/// The way down the hierarchy to the next leaves that may reach into a frustum.
struct Descent<'s, 'a> {
    view: &'s View<'a>,
    frustum: &'s Frustum,
    waiting: &'s mut Vec<Child>,
    leaves: &'s mut Vec<Child>,
}

impl LaneWork for Descent<'_, '_> {
    #[inline(always)]
    fn run(&mut self) {
        let mut room = Node::EMPTY;
        while self.leaves.len() < LEAVES
            && let Some(child) = self.waiting.pop()
        {
            if child.is_leaf() {
                self.leaves.push(child);
                continue;
            }
            let node = self.view.node(child.node(), &mut room);
            let mut mask = self.frustum.boxes_met(&node.planes);
            while mask != 0 {
                let child = node.children[mask.trailing_zeros() as usize & 7];
                mask &= mask - 1;
                if child != Child::NONE {
                    self.waiting.push(child);
                }
            }
        }
    }
}

/// The planes that bound a beam, in the frame of the boxes.
struct Frustum {
    planes: [BoundingPlane; 6],
    /// That of what is within reach.
    reach: Option<BoundingPlane>,
}

impl Frustum {
    fn new(screen: &Screen, frame: &Frame, beam: &Beam) -> Self {
        let rows = screen.inverse_rows();
        let origin = (DVec3::from_array(frame.origin) - screen.eye()) * frame.scale;
        // A sum over depth, column and row, the latter two times the depth, and a distance.
        let plane = |factors: [f64; 3], distance: f64| {
            let (mut normal, mut terms) = (DVec3::ZERO, DVec3::ZERO);
            for (row, factor) in rows.into_iter().zip(factors) {
                normal += factor * row;
                terms += factor.abs() * row.abs();
            }
            let slack = terms.dot(origin.abs() + 1.0) + distance.abs();
            BoundingPlane { normal, least: -(normal.dot(origin) + distance) - slack * MARGIN }
        };
        let ([x0, y0], [x1, y1]) = (beam.block.low, beam.block.high);
        let planes = [
            plane([-x0, 1.0, 0.0], 0.0),
            plane([x1, -1.0, 0.0], 0.0),
            plane([-y0, 0.0, 1.0], 0.0),
            plane([y1, 0.0, -1.0], 0.0),
            plane([1.0, 0.0, 0.0], 0.0),
            plane([-1.0, 0.0, 0.0], beam.deepest * frame.scale),
        ];
        let reach = beam.reach.factors();
        let reach = reach.map(|(factors, height)| plane(factors, height * frame.scale));
        Self { planes, reach }
    }

    /// Tells which of a node's boxes may reach into the frustum, a bit each, the first one lowest.
    #[inline(always)]
    fn boxes_met(&self, boxes: &[[f32; 8]; 6]) -> u32 {
        let mut mask = 0xFF;
        for plane in self.planes.iter().chain(&self.reach) {
            mask &= plane.boxes_met(boxes);
            if mask == 0 {
                break;
            }
        }
        mask
    }
}

/// A plane that bounds a frustum: what may lie inside has `normal` · point >= `least`.
struct BoundingPlane {
    normal: DVec3,
    least: f64,
}

impl BoundingPlane {
    /// Tells which of a node's boxes may reach over the plane to the inside, a bit each.
    #[inline(always)]
    fn boxes_met(&self, boxes: &[[f32; 8]; 6]) -> u32 {
        let normal = self.normal.to_array();
        let mut highest = [0.0; 8];
        for axis in 0..3 {
            let bounds = if normal[axis] > 0.0 { &boxes[axis + 3] } else { &boxes[axis] };
            for (highest, &bound) in highest.iter_mut().zip(bounds) {
                *highest += normal[axis] * f64::from(bound);
            }
        }
        let mut mask = 0;
        for (child, highest) in highest.iter().enumerate() {
            mask |= u32::from(*highest >= self.least) << child;
        }
        mask
    }
}
