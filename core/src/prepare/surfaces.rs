//! The fourth step: faces in one plane and equal spheres have one surface.

use super::{
    equal_spheres::share_spheres,
    flat::FlatFaces,
    planes::{SharedPlanes, share_planes},
    ranks::Ranks,
    solid_trees::SolidTrees,
    weld::Welded,
};
use crate::prepared::record::{
    LeafRecord, PlaneIndex, PlaneRecord, SolidNodeRecord, SolidRecord, SphereRecord,
};
use glam::DVec3;

/// All faces of a scene, with the vertices and the surfaces that they share.
pub(super) struct Surfaces {
    pub(super) flat: FlatFaces,
    /// For every corner of a flat face, the first corner in the same place.
    pub(super) first_corners: Vec<u32>,
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
}

impl Welded {
    /// Finds the surfaces that faces share.
    pub(super) fn share_surfaces(self, ranks: &Ranks) -> Surfaces {
        let Self { flat, mut spheres, solids, first_corners } = self;
        let SharedPlanes { of_triangles, of_quadrangles, of_boxes, planes } =
            share_planes(&flat, ranks, &first_corners);
        let sphere_surfaces = share_spheres(&mut spheres, &solids);
        let SolidTrees { solids, bounds, nodes, leaves } = solids;
        let mut of_boxes = of_boxes.into_iter();
        let leaves = leaves
            .into_iter()
            .zip(sphere_surfaces)
            .map(|(leaf, surface)| LeafRecord {
                center: leaf.center.to_array(),
                radius: leaf.radius,
                planes: if leaf.is_box() {
                    of_boxes.next().expect("as many boxes as there are among the leaves")
                } else {
                    [PlaneIndex::new(0, false); 6]
                },
                material: leaf.material,
                node: leaf.node,
                is_reversed: u32::from(leaf.is_reversed),
                surface,
            })
            .collect();
        Surfaces {
            flat,
            first_corners,
            triangle_planes: of_triangles,
            quadrangle_planes: of_quadrangles,
            planes,
            spheres,
            solids,
            solid_bounds: bounds,
            solid_nodes: nodes,
            leaves,
        }
    }
}
