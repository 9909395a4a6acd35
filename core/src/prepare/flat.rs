//! Flat faces with their corners.

use std::ops::{Deref, Range};

use glam::DVec3;

use super::{
    newell::unit_normal,
    parallelepiped::{box_edges, box_faces},
};
use crate::scene::Parallelepiped;

/// The flat faces of a scene, numbered in this order: triangles, quadrangles, then the faces of the
/// parallelepipeds in solids, six each, which are no items of their own.
pub(super) struct FlatFaces {
    /// Where corners are; no face may be there.
    pub(super) points: Vec<DVec3>,
    /// The points of the corners in the order of the faces: three of each triangle, four of every
    /// other face.
    pub(super) corners: Vec<u32>,
    /// The materials and ranks of all flat faces.
    pub(super) attributes: Vec<FaceAttributes>,
    pub(super) triangle_count: usize,
    /// Quadrangles of their own and the faces of parallelepipeds that stand alone.
    pub(super) quadrangle_count: usize,
    /// The edges of each face of a parallelepiped, which are the last of the flat faces: the sum of
    /// a corner and an edge rounds, and would turn the plane of a needle.
    pub(super) box_edges: Vec<[DVec3; 2]>,
}

/// The corners of a face, three or four.
pub(super) struct Corners {
    points: [DVec3; 4],
    count: usize,
}

impl Deref for Corners {
    type Target = [DVec3];

    fn deref(&self) -> &[DVec3] {
        &self.points[..self.count]
    }
}

/// The material of a face and its place in the order of all faces.
#[derive(Debug, Clone, Copy)]
pub(super) struct FaceAttributes {
    pub(super) material: u32,
    pub(super) rank: u32,
}

impl FlatFaces {
    /// Adds the six faces of a parallelepiped at the end; returns their corners.
    pub(super) fn push_box(&mut self, solid: &Parallelepiped, first_rank: u32) -> [[DVec3; 4]; 6] {
        let faces = box_faces(solid);
        self.push_points(faces.as_flattened());
        self.box_edges.extend(box_edges(solid));
        self.attributes.extend(
            (first_rank..first_rank + 6)
                .map(|rank| FaceAttributes { material: solid.material, rank }),
        );
        faces
    }

    /// Adds points that are a corner each.
    pub(super) fn push_points(&mut self, points: &[DVec3]) {
        let first = self.points.len() as u32;
        self.points.extend(points);
        self.corners.extend(first..self.points.len() as u32);
    }

    /// How many flat faces are items of their own.
    pub(super) fn item_count(&self) -> usize {
        self.triangle_count + self.quadrangle_count
    }

    /// How many corners those have, which stand first.
    pub(super) fn item_corner_count(&self) -> usize {
        3 * self.triangle_count + 4 * self.quadrangle_count
    }

    /// How many flat faces there are.
    pub(super) fn count(&self) -> usize {
        self.attributes.len()
    }

    /// The corners of a face.
    #[inline]
    pub(super) fn corners_of(&self, face: usize) -> Corners {
        let corners = &self.corners[self.corner_range(face)];
        let mut points = [DVec3::ZERO; 4];
        for (point, &corner) in points.iter_mut().zip(corners) {
            *point = self.points[corner as usize];
        }
        Corners { points, count: corners.len() }
    }

    /// The box around a face, as its least and its greatest corner.
    #[inline]
    pub(super) fn bounds(&self, face: usize) -> (DVec3, DVec3) {
        let corners = &self.corners[self.corner_range(face)];
        let first = self.points[corners[0] as usize];
        corners[1..].iter().fold((first, first), |(min, max), &corner| {
            let point = self.points[corner as usize];
            (min.min(point), max.max(point))
        })
    }

    /// The corners of the faces of parallelepipeds in solids.
    pub(super) fn box_corners(&self) -> Vec<DVec3> {
        let corners = &self.corners[self.item_corner_count()..];
        corners.iter().map(|&corner| self.points[corner as usize]).collect()
    }

    /// The places of a face's corners among all corners.
    pub(super) fn corner_range(&self, face: usize) -> Range<usize> {
        if face < self.triangle_count {
            3 * face..3 * face + 3
        } else {
            let first = 3 * self.triangle_count + 4 * (face - self.triangle_count);
            first..first + 4
        }
    }

    /// The unit normal of a face.
    pub(super) fn normal(&self, face: usize) -> DVec3 {
        match face.checked_sub(self.count() - self.box_edges.len()) {
            Some(of_box) => {
                let [u, v] = self.box_edges[of_box];
                unit_normal(&[DVec3::ZERO, u, v])
            }
            None => unit_normal(&self.corners_of(face)),
        }
    }

    /// The place of a face in the order of all faces.
    pub(crate) fn rank(&self, face: usize) -> u32 {
        self.attributes[face].rank
    }
}

/// The smallest box around points, as its least and its greatest corner; inside out for none.
pub(super) fn bounds_of(points: &[DVec3]) -> (DVec3, DVec3) {
    let none = (DVec3::INFINITY, DVec3::NEG_INFINITY);
    points.iter().fold(none, |(min, max), &point| (min.min(point), max.max(point)))
}
