//! Which flat faces lie in one plane.
//!
//! Coincident faces must be met at one distance, and a ray that leaves a face must not meet another
//! that lies on it. So faces in the same plane, exactly or as far as rounding can tell, share one
//! plane record. Real scenes hold thousands of copies of one triangle, and labels that lie in a
//! wall.

use glam::DVec3;
use rayon::prelude::*;

use super::{
    flat::FlatFaces, near_planes::near_sets, plane_fingerprint::plane_fingerprints, ranks::Ranks,
};
use crate::{
    exact::{hash::groups_of_equal, predicates::is_coplanar},
    prepared::record::{PlaneIndex, PlaneRecord},
};

/// The planes of flat faces.
pub(super) struct SharedPlanes {
    /// `None` for a triangle that is alone in its plane.
    pub(super) of_triangles: Vec<Option<PlaneIndex>>,
    /// The planes of quadrangles that are items of their own.
    pub(super) of_quadrangles: Vec<PlaneIndex>,
    /// The planes of the parallelepipeds in solids.
    pub(super) of_boxes: Vec<[PlaneIndex; 6]>,
    pub(super) planes: Vec<PlaneRecord>,
}

/// Gives flat faces in one plane one record: that of the face that comes first where the plane is
/// exactly one, that of the largest where it is one within rounding.
pub(super) fn share_planes(flat: &FlatFaces, ranks: &Ranks) -> SharedPlanes {
    let mut sharing = Sharing { flat, of_faces: vec![None; flat.count()], planes: Vec::new() };
    sharing.share_exact_planes();
    sharing.share_outlines();
    sharing.share_near_planes(ranks);
    let Sharing { of_faces: mut of_triangles, planes, .. } = sharing;
    let every = |faces: Vec<Option<PlaneIndex>>| -> Vec<PlaneIndex> {
        faces.into_iter().map(|plane| plane.expect("every quadrangle is in a group")).collect()
    };
    let of_boxes = every(of_triangles.split_off(flat.item_count()));
    let of_quadrangles = every(of_triangles.split_off(flat.triangle_count));
    let (of_boxes, _) = of_boxes.as_chunks();
    SharedPlanes { of_triangles, of_quadrangles, of_boxes: of_boxes.to_vec(), planes }
}

/// Planes that are being given to faces.
struct Sharing<'a> {
    flat: &'a FlatFaces,
    of_faces: Vec<Option<PlaneIndex>>,
    planes: Vec<PlaneRecord>,
}

impl Sharing<'_> {
    /// Gives faces in exactly one plane one record: triangles that have company, and quadrangles
    /// whose corners are in one plane.
    fn share_exact_planes(&mut self) {
        let flat = self.flat;
        let fingerprints = plane_fingerprints(flat.count(), |face| {
            let corners = flat.corners_of(face);
            match *corners {
                // Any three corners do that are not in a line, if all four are in one plane.
                [a, b, c, d] if (b - a).cross(c - a) == DVec3::ZERO => [a, c, d],
                _ => [corners[0], corners[1], corners[2]],
            }
        });
        let is_quadrangle = |face: u32| face as usize >= flat.triangle_count;
        let fingerprint = |face: u32| {
            let is_flat = || match *flat.corners_of(face as usize) {
                [a, b, c, d] => is_coplanar(a, b, c, d),
                _ => true,
            };
            fingerprints[face as usize].filter(|_| !is_quadrangle(face) || is_flat())
        };
        let by_plane =
            groups_of_equal(flat.count() as u32, fingerprint, is_quadrangle, |group, told| {
                let start = told.len();
                told.extend(group.iter().map(|&face| {
                    let print = fingerprints[face as usize].expect("it has a plane");
                    (print, flat.rank(face as usize), face)
                }));
                told[start..].sort_unstable();
            });
        let groups: Vec<&[(u64, u32, u32)]> = by_plane
            .iter()
            .flat_map(|told| told.chunk_by(|a, b| a.0 == b.0))
            .filter(|group| group.len() > 1 || is_quadrangle(group[0].2))
            .collect();
        self.planes = groups.par_iter().map(|group| plane_of(flat, group[0].2 as usize)).collect();
        for (index, group) in groups.iter().enumerate() {
            for &(_, _, face) in *group {
                self.of_faces[face as usize] = Some(PlaneIndex::new(index, false));
            }
        }
        // Which way they look is found face by face: neighbours are near each other in memory.
        let planes = &self.planes;
        self.of_faces.par_iter_mut().enumerate().for_each(|(face, plane)| {
            if let Some(plane) = plane {
                *plane = index_for(flat, face, plane.index(), &planes[plane.index()]);
            }
        });
    }

    /// Gives the other quadrangles, which are flat only within rounding, a record each; those with
    /// the same corners share it.
    fn share_outlines(&mut self) {
        let flat = self.flat;
        let mut by_corners: Vec<([u32; 4], u32, usize)> = (flat.triangle_count..flat.count())
            .filter(|&face| self.of_faces[face].is_none())
            .map(|face| {
                let mut corners = [0; 4];
                corners.copy_from_slice(&flat.corners[flat.corner_range(face)]);
                corners.sort_unstable();
                (corners, flat.rank(face), face)
            })
            .collect();
        by_corners.sort_unstable();
        for group in by_corners.chunk_by(|a, b| a.0 == b.0) {
            self.share(group.iter().map(|&(_, _, face)| face));
        }
    }

    /// Gives faces in planes that rounding cannot tell apart one record.
    fn share_near_planes(&mut self, ranks: &Ranks) {
        let exact = |face: usize| self.of_faces[face].map(PlaneIndex::index);
        let sets = near_sets(self.flat, ranks, exact);
        for set in &sets {
            self.share(set.iter().copied());
        }
        if !sets.is_empty() {
            self.drop_unused_planes();
        }
    }

    fn drop_unused_planes(&mut self) {
        let mut places = vec![None; self.planes.len()];
        let mut used = Vec::new();
        for index in self.of_faces.iter_mut().flatten() {
            let place = *places[index.index()].get_or_insert_with(|| {
                used.push(self.planes[index.index()]);
                used.len() - 1
            });
            *index = PlaneIndex::new(place, index.sign() < 0.0);
        }
        self.planes = used;
    }

    /// Gives faces the first one's plane.
    fn share(&mut self, group: impl Iterator<Item = usize>) {
        let mut group = group.peekable();
        let plane = plane_of(self.flat, *group.peek().expect("a group has a face"));
        let index = self.planes.len();
        for face in group {
            self.of_faces[face] = Some(index_for(self.flat, face, index, &plane));
        }
        self.planes.push(plane);
    }
}

/// The index of a plane for a face in it, which looks to one of its sides.
fn index_for(flat: &FlatFaces, face: usize, index: usize, plane: &PlaneRecord) -> PlaneIndex {
    let is_reversed = flat.normal(face).dot(DVec3::from_array(plane.normal)) < 0.0;
    PlaneIndex::new(index, is_reversed)
}

/// The plane with Newell's normal through a triangle's first corner, which is in it exactly, or
/// through the mean corner of a quadrangle, whose corners may be only nearly in one plane.
fn plane_of(flat: &FlatFaces, face: usize) -> PlaneRecord {
    let corners = flat.corners_of(face);
    let point = if corners.len() == 3 {
        corners[0]
    } else {
        let from_first: DVec3 = corners.iter().map(|&corner| corner - corners[0]).sum();
        corners[0] + from_first / corners.len() as f64
    };
    PlaneRecord { point: point.to_array(), normal: flat.normal(face).to_array() }
}
