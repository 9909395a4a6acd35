//! A binary tree over all emitters.

use glam::DVec3;

use crate::prepared::record::{EmitterNode, NO_NODE};

/// The sphere around an emitter, its area and the light that it sends on.
#[derive(Debug, Clone, Copy)]
pub(super) struct EmitterBounds {
    pub(super) center: DVec3,
    pub(super) radius: f64,
    pub(super) area: f64,
    /// The area times the radiosity of the side that sends on more.
    pub(super) power: f64,
}

/// A binary tree over all emitters. Its root is node 0; two children stand side by side after their
/// parent.
pub(super) struct EmitterTree {
    pub(super) nodes: Vec<EmitterNode>,
    /// The leaf of each emitter.
    pub(super) leaves: Vec<u32>,
}

impl EmitterTree {
    /// Builds the tree over emitters.
    pub(super) fn new(emitters: &[EmitterBounds]) -> Self {
        let mut leaves = vec![NO_NODE; emitters.len()];
        if emitters.is_empty() {
            return Self { nodes: Vec::new(), leaves };
        }
        let mut order: Vec<u32> = (0..emitters.len() as u32).collect();
        let mut nodes = vec![EmitterNode::leaf(NO_NODE, 0)];
        // Nodes to make, of runs of the order.
        let mut waiting = vec![(0_usize, 0..emitters.len())];
        while let Some((index, run)) = waiting.pop() {
            let parent = nodes[index].parent;
            let part = &mut order[run.clone()];
            if let [emitter] = *part {
                nodes[index] = EmitterNode::leaf(parent, emitter);
                leaves[emitter as usize] = index as u32;
                continue;
            }
            let (mut low, mut high) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
            let (mut min, mut max) = (low, high);
            let (mut area, mut power) = (0.0, 0.0);
            for &emitter in part.iter() {
                let bounds = emitters[emitter as usize];
                let (center, radius) = (bounds.center, bounds.radius);
                (low, high) = (low.min(center), high.max(center));
                (min, max) = (min.min(center - radius), max.max(center + radius));
                area += bounds.area;
                power += bounds.power;
            }
            let extent = high - low;
            let axis = if extent.x >= extent.max_element() {
                0
            } else if extent.y >= extent.z {
                1
            } else {
                2
            };
            let center = min + (max - min) / 2.0;
            let reach = |&emitter: &u32| {
                let bounds = emitters[emitter as usize];
                (bounds.center - center).length() + bounds.radius
            };
            let radius = part.iter().map(reach).fold(0.0, f64::max);
            let middle = part.len() / 2;
            part.select_nth_unstable_by(middle, |&a, &b| {
                let place = |emitter: u32| emitters[emitter as usize].center[axis];
                place(a).total_cmp(&place(b)).then(a.cmp(&b))
            });
            let child = nodes.len();
            // Half of the area is turned away.
            let fill = (area / (std::f64::consts::TAU * (radius * radius))).min(1.0);
            nodes[index] = EmitterNode {
                center: center.to_array(),
                radius,
                fill,
                radiosity: power / area,
                parent,
                child: child as u32,
                emitter: u32::MAX,
                padding: 0,
            };
            nodes.extend([EmitterNode::leaf(index as u32, 0); 2]);
            waiting.push((child, run.start..run.start + middle));
            waiting.push((child + 1, run.start + middle..run.end));
        }
        Self { nodes, leaves }
    }
}
