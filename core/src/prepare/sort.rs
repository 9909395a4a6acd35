//! The sixth step: records in the order of the hierarchy's leaves.

use std::{
    collections::HashMap,
    sync::atomic::{AtomicU32, Ordering},
};

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
    /// The plane that a triangle shares with other faces, if it does, and its material; `None` for
    /// an item of another kind.
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

impl FlatFaces {
    /// The points of the corners of an item, of three or four, which are none for one that is not
    /// flat.
    fn gather(&self, item: usize) -> &[u32] {
        if item < self.item_count() { &self.corners[self.corner_range(item)] } else { &[] }
    }

    /// Numbers points in the order in which items come to them: the points in that order, and the
    /// number of each.
    fn number_points(&self, order: &[u32]) -> (Vec<u32>, Vec<AtomicU32>) {
        // The place of the corner that comes to each point first, then its number.
        let none = || AtomicU32::new(u32::MAX);
        let numbers: Vec<AtomicU32> =
            (0..self.points.len()).into_par_iter().map(|_| none()).collect();
        let places = |place: usize, item: u32| (4 * place as u32..).zip(self.gather(item as usize));
        order.par_iter().enumerate().for_each(|(place, &item)| {
            for (corner, &point) in places(place, item) {
                let number = &numbers[point as usize];
                // Mostly it is not the first, which a load tells far sooner.
                if number.load(Ordering::Relaxed) > corner {
                    number.fetch_min(corner, Ordering::Relaxed);
                }
            }
        });
        let of_runs: Vec<Vec<u32>> = (order.par_chunks(NUMBERED_AT_ONCE).enumerate())
            .map(|(run, items)| {
                let mut points = Vec::new();
                for (place, &item) in (run * NUMBERED_AT_ONCE..).zip(items) {
                    let is_first = |&(corner, point): &(u32, &u32)| {
                        numbers[*point as usize].load(Ordering::Relaxed) == corner
                    };
                    points.extend(places(place, item).filter(is_first).map(|(_, &point)| point));
                }
                points
            })
            .collect();
        let points = of_runs.concat();
        points.par_iter().zip(0..points.len() as u32).for_each(|(&point, number)| {
            numbers[point as usize].store(number, Ordering::Relaxed);
        });
        (points, numbers)
    }
}

/// A thread looks for new points in so many items in one go.
const NUMBERED_AT_ONCE: usize = 1 << 13;

impl Surfaces {
    /// Makes the records of all items, in this order of their numbers.
    pub(super) fn sort(self, order: &[u32]) -> Sorted {
        let Self { flat, solids: solids_in_file_order, .. } = self;
        let (points, numbers) = flat.number_points(order);
        let vertices_of = |item: u32| {
            let mut vertices = [0; 4];
            for (vertex, &point) in vertices.iter_mut().zip(flat.gather(item as usize)) {
                *vertex = numbers[point as usize].load(Ordering::Relaxed);
            }
            vertices
        };
        let first_round = flat.item_count();
        let first_solid = first_round + self.spheres.len();
        // Whole records of triangles that are alone in their planes; of other items the kind.
        let record = |&item: &u32| {
            let face = item as usize;
            if face < flat.triangle_count {
                let [a, b, c, _] = vertices_of(item);
                let FaceAttributes { material, rank } = flat.attributes[face];
                match self.triangle_planes[face] {
                    None => FaceRecord::triangle([a, b, c], material, rank),
                    Some(_) => FaceRecord::coplanar([a, b, c], 0, rank),
                }
            } else if face < first_round {
                FaceRecord::of(Kind::Quadrangle, 0)
            } else if face < first_solid {
                FaceRecord::of(Kind::Sphere, 0)
            } else {
                FaceRecord::of(Kind::Solid, 0)
            }
        };
        let mut faces: Vec<FaceRecord> = order.par_iter().map(record).collect();
        let (mut coats, mut coat_places) = (Vec::new(), HashMap::new());
        let (mut quadrangles, mut spheres, mut solids) = (Vec::new(), Vec::new(), Vec::new());
        for (record, &item) in faces.iter_mut().zip(order) {
            let face = item as usize;
            match record.item(0).kind().expect("it was made above") {
                Kind::Triangle => {}
                Kind::Coplanar => {
                    let plane = self.triangle_planes[face].expect("it shares its plane");
                    let coat = Coat { plane, material: flat.attributes[face].material };
                    let place = *coat_places.entry(coat).or_insert_with(|| {
                        coats.push(coat);
                        coats.len() as u32 - 1
                    });
                    *record = FaceRecord::coplanar(record.vertices, place, record.rank());
                }
                kind @ Kind::Quadrangle => {
                    *record = FaceRecord::of(kind, quadrangles.len());
                    let FaceAttributes { material, rank } = flat.attributes[face];
                    let plane = self.quadrangle_planes[face - flat.triangle_count];
                    let vertices = vertices_of(item);
                    quadrangles.push(QuadrangleRecord::new(vertices, material, rank, plane));
                }
                kind @ Kind::Sphere => {
                    *record = FaceRecord::of(kind, spheres.len());
                    spheres.push(self.spheres[face - first_round]);
                }
                kind @ Kind::Solid => {
                    *record = FaceRecord::of(kind, solids.len());
                    solids.push(solids_in_file_order[face - first_solid]);
                }
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
