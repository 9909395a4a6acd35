//! The hierarchy is searched with a frustum for the faces in a beam.

use glam::DVec3;

use super::{
    outline::Outlines,
    screen::{Beam, Screen},
};
use crate::prepared::{
    layout::View,
    node::{Child, Frame, Node},
};

/// Room for rounding in the test of a box, relative to its terms; rounding is 2^12 times finer.
const MARGIN: f64 = 1.0 / (1_u64 << 40) as f64;

/// The search for the faces in a beam, and what the latest one found.
#[derive(Debug, Default)]
pub(super) struct FrustumSearch {
    /// The outlines of the faces that were found.
    pub(super) outlines: Outlines,
    waiting: Vec<Child>,
}

impl FrustumSearch {
    /// Collects the outlines of the faces in a beam. It gives up, and the answer is `false`, once
    /// there are more than `most`.
    pub(super) fn collect(
        &mut self,
        view: &View<'_>,
        screen: &Screen,
        beam: &Beam,
        most: usize,
    ) -> bool {
        self.outlines.clear();
        self.waiting.clear();
        self.waiting.push(Child::ROOT);
        let frustum = Frustum::new(screen, &view.header.frame, beam);
        let mut room = Node::EMPTY;
        while let Some(child) = self.waiting.pop() {
            if child.is_leaf() {
                for item in view.items(child.items()) {
                    self.outlines.add_item(view, screen, item, beam);
                }
                if self.outlines.as_slice().len() > most {
                    return false;
                }
                continue;
            }
            let node = view.node(child.node(), &mut room);
            let mut mask = frustum.boxes_met(&node.planes);
            while mask != 0 {
                let child = node.children[mask.trailing_zeros() as usize & 7];
                mask &= mask - 1;
                if child != Child::NONE {
                    self.waiting.push(child);
                }
            }
        }
        true
    }
}

/// The planes that bound a beam, in the frame of the boxes.
struct Frustum {
    planes: [BoundingPlane; 6],
}

impl Frustum {
    fn new(screen: &Screen, frame: &Frame, beam: &Beam) -> Self {
        let [depth, across, down] = screen.inverse_rows();
        let origin = (DVec3::from_array(frame.origin) - screen.eye()) * frame.scale;
        let plane = |row: DVec3, factor: f64, sign: f64, depth_limit: f64| {
            let normal = sign * (row - factor * depth);
            let terms = row.abs() + factor * depth.abs();
            let slack = terms.dot(origin.abs() + 1.0) + depth_limit;
            BoundingPlane { normal, least: -(normal.dot(origin) + depth_limit) - slack * MARGIN }
        };
        let ([x0, y0], [x1, y1]) = (beam.block.low, beam.block.high);
        let planes = [
            plane(across, x0, 1.0, 0.0),
            plane(across, x1, -1.0, 0.0),
            plane(down, y0, 1.0, 0.0),
            plane(down, y1, -1.0, 0.0),
            plane(depth, 0.0, 1.0, 0.0),
            plane(depth, 0.0, -1.0, beam.deepest * frame.scale),
        ];
        Self { planes }
    }

    /// Tells which of a node's boxes may reach into the frustum, a bit each, the first one lowest.
    fn boxes_met(&self, boxes: &[[f32; 8]; 6]) -> u32 {
        let mut mask = 0xFF;
        for plane in &self.planes {
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
