//! Constructive solids as trees of nodes, with their leaves.

use glam::DVec3;

use super::flat::{FlatFaces, bounds_of};
use crate::{
    prepared::{
        face::Part,
        record::{NO_NODE, SolidNodeKind, SolidNodeRecord, SolidRecord},
        solid_tree::link_solid,
    },
    scene::{Operation, Solid, SolidNode},
};

/// The solids of a scene in file order.
#[derive(Default)]
pub(super) struct SolidTrees {
    pub(super) solids: Vec<SolidRecord>,
    /// A box around each solid, as its least and its greatest corner. That of an empty
    /// intersection is inside out.
    pub(super) bounds: Vec<(DVec3, DVec3)>,
    /// The nodes of all solids.
    pub(super) nodes: Vec<SolidNodeRecord>,
    /// The leaves of all solids. The parallelepipeds among them are the last of the flat faces, in
    /// the same order, six faces each.
    pub(super) leaves: Vec<Leaf>,
}

/// A leaf of a solid.
pub(super) struct Leaf {
    /// A parallelepiped has none: it stands among the flat faces.
    pub(super) center: DVec3,
    /// The radius of a sphere is above 0; a parallelepiped has 0.
    pub(super) radius: f64,
    pub(super) material: u32,
    /// Its node in the solid's tree.
    pub(super) node: u32,
    /// Whether an odd number of differences takes it away, so that its faces look inward.
    pub(super) is_reversed: bool,
}

impl Leaf {
    /// Whether it is a parallelepiped.
    pub(super) fn is_box(&self) -> bool {
        self.radius == 0.0
    }
}

impl SolidTrees {
    /// Adds a solid whose first face has `rank`; the faces of its parallelepipeds go to `flat`.
    pub(super) fn push(&mut self, solid: &Solid, rank: u32, flat: &mut FlatFaces) {
        let (first_node, first_leaf) = (self.nodes.len(), self.leaves.len());
        let shape = solid.nodes.iter().map(|node| match node {
            SolidNode::Operation { operation, operands } => (kind_of(*operation), *operands),
            _ => (SolidNodeKind::LEAF, 0),
        });
        self.nodes.extend(link_solid(shape).expect("a solid is a tree"));
        let mut leaf_bounds = Vec::new();
        for node in &solid.nodes {
            leaf_bounds.push(match node {
                SolidNode::Sphere(sphere) => {
                    (sphere.center - sphere.radius, sphere.center + sphere.radius)
                }
                SolidNode::Parallelepiped(solid) => {
                    let first_rank = rank + Part::FACES * leaf_bounds.len() as u32;
                    bounds_of(flat.push_box(solid, first_rank).as_flattened())
                }
                SolidNode::Operation { .. } => continue,
            });
        }
        let bounds = *node_bounds(&self.nodes[first_node..], &leaf_bounds).last().expect("a root");
        let is_reversed = reversed_nodes(&self.nodes[first_node..]);
        for ((index, node), is_reversed) in (0..).zip(&solid.nodes).zip(is_reversed) {
            let (center, radius, material) = match node {
                SolidNode::Sphere(sphere) => (sphere.center, sphere.radius, sphere.material),
                SolidNode::Parallelepiped(solid) => (DVec3::ZERO, 0.0, solid.material),
                SolidNode::Operation { .. } => continue,
            };
            self.leaves.push(Leaf { center, radius, material, node: index, is_reversed });
        }
        let (nodes, leaves) = (first_node..self.nodes.len(), first_leaf..self.leaves.len());
        self.solids.push(SolidRecord::new(nodes, leaves, rank));
        self.bounds.push(bounds);
    }
}

fn kind_of(operation: Operation) -> SolidNodeKind {
    match operation {
        Operation::Union => SolidNodeKind::UNION,
        Operation::Intersection => SolidNodeKind::INTERSECTION,
        Operation::Difference => SolidNodeKind::DIFFERENCE,
    }
}

/// A box around what each node of a solid makes of leaves in these boxes.
pub(super) fn node_bounds(
    nodes: &[SolidNodeRecord],
    leaf_bounds: &[(DVec3, DVec3)],
) -> Vec<(DVec3, DVec3)> {
    let mut bounds: Vec<(DVec3, DVec3)> = Vec::with_capacity(nodes.len());
    let mut waiting = Vec::new();
    for (index, node) in nodes.iter().enumerate() {
        let operands = waiting.split_off(waiting.len() - node.operands as usize);
        let operands = operands.into_iter().map(|child: usize| bounds[child]);
        let joined = match node.kind {
            SolidNodeKind::LEAF => Some(leaf_bounds[node.first_child as usize]),
            SolidNodeKind::UNION => operands.reduce(|a, b| (a.0.min(b.0), a.1.max(b.1))),
            SolidNodeKind::INTERSECTION => operands.reduce(|a, b| (a.0.max(b.0), a.1.min(b.1))),
            _ => Some(bounds[node.first_child as usize]),
        };
        bounds.push(joined.expect("two operands or more"));
        waiting.push(index);
    }
    bounds
}

/// For each node of a solid, whether an odd number of differences takes it away.
fn reversed_nodes(nodes: &[SolidNodeRecord]) -> Vec<bool> {
    let mut is_reversed = vec![false; nodes.len()];
    for index in (0..nodes.len()).rev() {
        let parent = nodes[index].parent;
        if parent != NO_NODE {
            let above = &nodes[parent as usize];
            let is_taken =
                above.kind == SolidNodeKind::DIFFERENCE && above.first_child as usize != index;
            is_reversed[index] = is_reversed[parent as usize] ^ is_taken;
        }
    }
    is_reversed
}
