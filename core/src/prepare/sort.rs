//! The sixth step: records in the order of the hierarchy's leaves.

use std::collections::HashMap;

use glam::DVec3;
use rayon::prelude::*;

use super::{
    flat::{FaceAttributes, FlatFaces},
    surfaces::Surfaces,
};
use crate::prepared::{
    node::Node,
    record::{
        BoxPlanes, Coat, FaceRecord, Kind, LeafRecord, PlaneIndex, PlaneRecord, QuadrangleRecord,
        SolidNodeRecord, SolidRecord, SphereRecord,
    },
};

/// The records of all faces. Those of each kind stand in the order of the hierarchy's leaves, and
/// vertices in the order in which leaves come to them.
pub(super) struct Sorted {
    pub(super) faces: Vec<FaceRecord>,
    pub(super) vertices: Vec<[f64; 3]>,
    pub(super) coats: Vec<Coat>,
    pub(super) quadrangles: Vec<QuadrangleRecord>,
    pub(super) spheres: Vec<SphereRecord>,
    pub(super) planes: Vec<PlaneRecord>,
    pub(super) solids: Vec<SolidRecord>,
    pub(super) solid_nodes: Vec<SolidNodeRecord>,
    pub(super) leaves: Vec<LeafRecord>,
    pub(super) box_planes: Vec<BoxPlanes>,
    pub(super) solid_boxes: Vec<Node>,
    /// The same solids in file order.
    pub(super) solids_in_file_order: Vec<SolidRecord>,
    /// A box around each of those, as its least and its greatest corner.
    pub(super) solid_bounds: Vec<(DVec3, DVec3)>,
    /// The corners of the parallelepipeds among the leaves, in the leaves' order: six faces each,
    /// four corners a face.
    pub(super) box_corners: Vec<DVec3>,
}

impl Sorted {
    /// The plane that a triangle shares with other faces, if it does, and its material; `None` for an
    /// item of another kind.
    pub(super) fn plane_and_material(
        &self,
        face: &FaceRecord,
    ) -> Option<(Option<PlaneIndex>, u32)> {
        match face.item(0).kind()? {
            Kind::Triangle => Some((None, face.material())),
            Kind::Coplanar => {
                let Coat { plane, material } = self.coats[face.coat()];
                Some((Some(plane), material))
            }
            Kind::Quadrangle | Kind::Sphere | Kind::Solid => None,
        }
    }
}

/// The corners of so many faces are gathered on all threads before these are numbered.
const GATHERED_AT_ONCE: usize = 1 << 14;

impl FlatFaces {
    /// The points of the corners of an item, of three or four, and its attributes; `None` if it is not
    /// flat.
    fn gather(&self, item: usize) -> Option<([u32; 4], FaceAttributes)> {
        (item < self.item_count()).then(|| {
            let mut corners = [0; 4];
            let range = self.corner_range(item);
            corners[..range.len()].copy_from_slice(&self.corners[range]);
            (corners, self.attributes[item])
        })
    }
}

impl Surfaces {
    /// Makes the records of all items, in this order of their numbers.
    pub(super) fn sort(self, order: &[u32]) -> Sorted {
        let Self { flat, solids: solids_in_file_order, .. } = self;
        let mut faces = Vec::with_capacity(order.len());
        // The points of the vertices.
        let mut points = Vec::with_capacity(flat.points.len());
        let mut coats = Vec::new();
        let mut coat_places = HashMap::new();
        let mut quadrangles = Vec::new();
        let mut spheres = Vec::new();
        let mut solids = Vec::new();
        let mut numbers = vec![u32::MAX; flat.points.len()];
        let mut gathered = Vec::new();
        for (place, &item) in order.iter().enumerate() {
            let face = item as usize;
            if place % GATHERED_AT_ONCE == 0 {
                let run = &order[place..order.len().min(place + GATHERED_AT_ONCE)];
                run.par_iter()
                    .map(|&item| flat.gather(item as usize))
                    .collect_into_vec(&mut gathered);
            }
            let Some((mut corners, attributes)) = gathered[place % GATHERED_AT_ONCE] else {
                let round = face - flat.item_count();
                if let Some(&sphere) = self.spheres.get(round) {
                    faces.push(FaceRecord::of(Kind::Sphere, spheres.len()));
                    spheres.push(sphere);
                } else {
                    faces.push(FaceRecord::of(Kind::Solid, solids.len()));
                    solids.push(solids_in_file_order[round - self.spheres.len()]);
                }
                continue;
            };
            let is_quadrangle = face >= flat.triangle_count;
            for corner in &mut corners[..3 + usize::from(is_quadrangle)] {
                let number = &mut numbers[*corner as usize];
                if *number == u32::MAX {
                    *number = points.len() as u32;
                    points.push(*corner);
                }
                *corner = *number;
            }
            let FaceAttributes { material, rank } = attributes;
            let [a, b, c, _] = corners;
            if let Some(quadrangle) = face.checked_sub(flat.triangle_count) {
                let plane = self.quadrangle_planes[quadrangle];
                faces.push(FaceRecord::of(Kind::Quadrangle, quadrangles.len()));
                quadrangles.push(QuadrangleRecord::new(corners, material, rank, plane));
            } else if let Some(plane) = self.triangle_planes[face] {
                let coat = Coat { plane, material };
                let place = *coat_places.entry(coat).or_insert_with(|| {
                    coats.push(coat);
                    coats.len() as u32 - 1
                });
                faces.push(FaceRecord::coplanar([a, b, c], place, rank));
            } else {
                faces.push(FaceRecord::triangle([a, b, c], material, rank));
            }
        }
        let vertices =
            points.par_iter().map(|&point| flat.points[point as usize].to_array()).collect();
        Sorted {
            faces,
            vertices,
            coats,
            quadrangles,
            spheres,
            planes: self.planes,
            solids,
            solid_nodes: self.solid_nodes,
            leaves: self.leaves,
            box_planes: self.box_planes,
            solid_boxes: self.solid_boxes,
            solids_in_file_order,
            solid_bounds: self.solid_bounds,
            box_corners: flat.box_corners(),
        }
    }
}
