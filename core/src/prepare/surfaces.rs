//! The fourth step: faces in one plane and equal spheres have one surface.

use super::{
    equal_spheres::share_spheres,
    flat::{FlatFaces, bounds_of},
    planes::{SharedPlanes, share_planes},
    ranks::Ranks,
    solid_boxes::enclose_leaves,
    solid_trees::{Leaf, SolidTrees},
    weld::Welded,
};
use crate::prepared::{
    node::Node,
    record::{
        BoxPlanes, LeafRecord, PlaneIndex, PlaneRecord, SolidNodeRecord, SolidRecord, SphereRecord,
    },
};
use glam::DVec3;

/// All faces of a scene, with the vertices and the surfaces that they share.
pub(super) struct Surfaces {
    pub(super) flat: FlatFaces,
    /// The planes of triangles; `None` for one that is alone in its plane.
    pub(super) triangle_planes: Vec<Option<PlaneIndex>>,
    /// The planes of all quadrangles that are items of their own.
    pub(super) quadrangle_planes: Vec<PlaneIndex>,
    pub(super) planes: Vec<PlaneRecord>,
    pub(super) spheres: Vec<SphereRecord>,
    /// Solids in file order, and a box around each.
    pub(super) solids: Vec<SolidRecord>,
    pub(super) solid_bounds: Vec<(DVec3, DVec3)>,
    pub(super) solid_nodes: Vec<SolidNodeRecord>,
    pub(super) leaves: Vec<LeafRecord>,
    /// The planes of the parallelepipeds among the leaves.
    pub(super) box_planes: Vec<BoxPlanes>,
    /// The hierarchies over the leaves of each solid.
    pub(super) solid_boxes: Vec<Node>,
}

impl Welded {
    /// Finds the surfaces that faces share.
    pub(super) fn share_surfaces(self, ranks: &Ranks) -> Surfaces {
        let Self { flat, mut spheres, solids } = self;
        let SharedPlanes { of_triangles, of_quadrangles, of_boxes, planes } =
            share_planes(&flat, ranks);
        let sphere_surfaces = share_spheres(&mut spheres, &solids);
        let SolidTrees { mut solids, bounds, nodes, leaves } = solids;
        let leaf_bounds = leaf_bounds(&leaves, &flat);
        let box_planes: Vec<_> =
            of_boxes.iter().map(|&faces| BoxPlanes::new(faces, &planes)).collect();
        let mut of_boxes = (0..).zip(of_boxes);
        let leaves = leaves
            .into_iter()
            .zip(sphere_surfaces)
            .zip(&leaf_bounds)
            .map(|((leaf, sphere), (min, max))| {
                let (surface, planes) = if leaf.is_box() {
                    of_boxes.next().expect("as many boxes as there are among the leaves")
                } else {
                    (sphere, [PlaneIndex::new(0, false); 6])
                };
                LeafRecord {
                    center: leaf.center.to_array(),
                    radius: leaf.radius,
                    planes,
                    material: leaf.material,
                    node: leaf.node,
                    is_reversed: u32::from(leaf.is_reversed),
                    surface,
                    // All of it is in the box, and 4 ulp more are enough for the length's rounding.
                    extent: 2.0 * min.abs().max(max.abs()).length() * (1.0 + 4.0 * f64::EPSILON),
                }
            })
            .collect::<Vec<_>>();
        let mut solid_boxes = Vec::new();
        for solid in &mut solids {
            let nodes = &nodes[solid.nodes()];
            let (leaves, bounds) = (&leaves[solid.leaves()], &leaf_bounds[solid.leaves()]);
            enclose_leaves(solid, nodes, leaves, bounds, &mut solid_boxes);
        }
        Surfaces {
            flat,
            triangle_planes: of_triangles,
            quadrangle_planes: of_quadrangles,
            planes,
            spheres,
            solids,
            solid_bounds: bounds,
            solid_nodes: nodes,
            leaves,
            box_planes,
            solid_boxes,
        }
    }
}

/// A box around each leaf of a solid.
fn leaf_bounds(leaves: &[Leaf], flat: &FlatFaces) -> Vec<(DVec3, DVec3)> {
    let box_corners = flat.box_corners();
    let mut box_corners = box_corners.chunks(6 * 4);
    let mut bounds = |leaf: &Leaf| {
        if leaf.is_box() {
            bounds_of(box_corners.next().expect("as many as there are boxes among the leaves"))
        } else {
            (leaf.center - leaf.radius, leaf.center + leaf.radius)
        }
    };
    leaves.iter().map(&mut bounds).collect()
}
