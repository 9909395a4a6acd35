//! Constructive solids as trees of nodes, with their leaves.

use glam::DVec3;

use super::flat::{FlatFaces, bounds_of};
use crate::{
    prepared::{
        face::Part,
        record::{NO_NODE, SolidNodeKind, SolidNodeRecord, SolidRecord},
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
        // The nodes and bounds of what waits to be an operand.
        let mut waiting: Vec<(u32, (DVec3, DVec3))> = Vec::new();
        let mut leaf_count = 0;
        for (index, node) in (0..).zip(&solid.nodes) {
            let (kind, operands, bounds) = match node {
                SolidNode::Sphere(sphere) => {
                    let bounds = (sphere.center - sphere.radius, sphere.center + sphere.radius);
                    (SolidNodeKind::LEAF, Vec::new(), bounds)
                }
                SolidNode::Parallelepiped(solid) => {
                    let first_rank = rank + Part::FACES * leaf_count;
                    let faces = flat.push_box(solid, first_rank);
                    (SolidNodeKind::LEAF, Vec::new(), bounds_of(faces.as_flattened()))
                }
                SolidNode::Operation { operation, operands } => {
                    let operands = waiting.split_off(waiting.len() - *operands as usize);
                    let bounds = join_bounds(*operation, operands.iter().map(|&(_, b)| b));
                    (kind_of(*operation), operands, bounds)
                }
            };
            for (k, &(child, _)) in operands.iter().enumerate() {
                let next = operands.get(k + 1).map_or(NO_NODE, |next| next.0);
                let child = &mut self.nodes[first_node + child as usize];
                (child.parent, child.next) = (index, next);
                child.is_first = u32::from(k == 0);
            }
            self.nodes.push(SolidNodeRecord {
                kind,
                parent: NO_NODE,
                first_child: operands.first().map_or(leaf_count, |first| first.0),
                next: NO_NODE,
                operands: operands.len() as u32,
                is_first: 0,
            });
            leaf_count += u32::from(kind == SolidNodeKind::LEAF);
            waiting.push((index, bounds));
        }
        let (_, bounds) = waiting.pop().expect("a root");
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

/// A box around what an operation makes of operands in these boxes.
fn join_bounds(
    operation: Operation,
    mut operands: impl Iterator<Item = (DVec3, DVec3)>,
) -> (DVec3, DVec3) {
    match operation {
        Operation::Union => operands.reduce(|a, b| (a.0.min(b.0), a.1.max(b.1))),
        Operation::Intersection => operands.reduce(|a, b| (a.0.max(b.0), a.1.min(b.1))),
        Operation::Difference => operands.next(),
    }
    .expect("two operands or more")
}

/// For each node of a solid, whether an odd number of differences takes it away.
fn reversed_nodes(nodes: &[SolidNodeRecord]) -> Vec<bool> {
    let mut is_reversed = vec![false; nodes.len()];
    for index in (0..nodes.len()).rev() {
        let SolidNodeRecord { parent, is_first, .. } = nodes[index];
        if parent != NO_NODE {
            let is_taken =
                nodes[parent as usize].kind == SolidNodeKind::DIFFERENCE && is_first == 0;
            is_reversed[index] = is_reversed[parent as usize] ^ is_taken;
        }
    }
    is_reversed
}
