//! The hierarchy over the leaves of a solid.

use glam::DVec3;

use super::{
    bvh::{BuildPrimitive, Leaves, build_bvh},
    solid_trees::node_bounds,
};
use crate::{
    exact::float::{above, below, power_of_two_below_inverse},
    prepared::{
        node::{Child, Frame, Node},
        record::{LeafRecord, NO_NODE, SolidNodeRecord, SolidRecord},
    },
};

/// How many ulp of its coordinates the boxes of a solid are larger on every side.
const MARGIN: f64 = 10.0 * f64::EPSILON * (1_u64 << 30) as f64;

/// The largest doubt of a crossing is this part of the solid's size, and besides as large as that
/// of a face that is met at a cosine of 1/64: this part of the margin.
const GRAZED: f64 = 1.0 / (1 << 17) as f64;
const STEEP: f64 = 1.0 / (1 << 24) as f64;

/// Builds the hierarchy over a solid's leaves, one in each leaf of the hierarchy, at the end of
/// `boxes`. A leaf counts only within the bounds of every operation above it: what is taken away
/// only where something is, for example; one that does not count anywhere is left out.
pub(super) fn enclose_leaves(
    solid: &mut SolidRecord,
    nodes: &[SolidNodeRecord],
    leaves: &[LeafRecord],
    leaf_bounds: &[(DVec3, DVec3)],
    boxes: &mut Vec<Node>,
) {
    let mut bounds = node_bounds(nodes, leaf_bounds);
    // An empty intersection has bounds inside out.
    let (min, max) = *bounds.last().expect("a root");
    let (min, max) = (min.min(max), max.max(min));
    let middle = min + (max - min) / 2.0;
    let size = (max - middle).max(middle - min).max_element();
    let extent = leaves.iter().map(|leaf| leaf.extent).fold(0.0, f64::max);
    // A ray is brought to within 8 / `scale` of the middle before it meets the solid.
    solid.margin = MARGIN * (extent + middle.length() + 32.0 * size);
    // Where a ray grazes a face, how far it goes within rounding of it says little of the faces
    // that it meets on its way: they must not vanish in that doubt.
    solid.most_doubt = (size * GRAZED + solid.margin * STEEP).min(solid.margin / 8.0);
    let scale = power_of_two_below_inverse(size + 2.0 * solid.margin);
    solid.frame = Frame { origin: middle.to_array(), scale };

    for index in (0..nodes.len()).rev().filter(|&index| nodes[index].parent != NO_NODE) {
        let (min, max) = bounds[nodes[index].parent as usize];
        bounds[index] = (bounds[index].0.max(min), bounds[index].1.min(max));
    }
    let relative = |point: DVec3| ((point - middle) * scale).to_array();
    let mut primitives: Vec<BuildPrimitive> = (0..)
        .zip(leaves)
        .filter_map(|(item, leaf)| {
            let (min, max) = bounds[leaf.node as usize];
            let min = relative(min - solid.margin).map(below);
            let max = relative(max + solid.margin).map(above);
            let counts = (0..3).all(|axis| min[axis] <= max[axis]);
            counts.then(|| BuildPrimitive::new(min, max, item))
        })
        .collect();
    let built = build_bvh(&mut primitives, Leaves { most: 1, alone_from: 0 });
    solid.first_box = boxes.len() as u32;
    boxes.extend(built.into_iter().map(|mut node| {
        node.children = node.children.map(|child| {
            if child.is_leaf() {
                Child::leaf(primitives[child.items().start].item() as usize, 1)
            } else {
                child.moved_by(solid.first_box as usize)
            }
        });
        node
    }));
}
