//! Vertices and polygons as a file gives them into a mesh without copies.

use bytemuck::Zeroable;
use hashbrown::hash_table::Entry;
use rayon::prelude::*;

use glam::DVec3;

use super::error::{MeshError, MeshFault};
use crate::{
    exact::{
        hash::{HashFunction, groups_of_equal},
        polygon,
        predicates::is_collinear,
        welding::{PointHasher, PointTable, find_firsts},
    },
    scene::{DroppedFaces, MeshShape, MeshVertices},
};

/// What a mesh file gave.
#[derive(Debug, Clone, PartialEq)]
pub struct MeshFile {
    /// Its faces.
    pub shape: MeshShape,
    /// Faces that were left out.
    pub dropped: DroppedFaces,
}

/// A mesh that grows: equal vertices become one, triangles without area and copies are dropped.
#[derive(Debug)]
pub(super) struct MeshBuilder<T> {
    vertices: Vec<[T; 3]>,
    vertex_table: PointTable,
    faces: MeshFaces,
}

/// Triangles of a mesh, in the order in which they come.
#[derive(Debug, Default)]
pub(super) struct MeshFaces {
    triangles: Vec<[u32; 3]>,
    dropped: DroppedFaces,
}

impl MeshFaces {
    /// Adds a triangle with corners among `vertices`.
    fn add_triangle<T: Copy + Into<f64>>(
        &mut self,
        vertices: &[[T; 3]],
        corners: [u32; 3],
    ) -> Result<(), MeshFault> {
        let [a, b, c] = corners.map(|corner| position(vertices, corner));
        if is_collinear(a, b, c) {
            self.dropped.zero_area += 1;
            return Ok(());
        }
        if self.triangles.len() == u32::MAX as usize {
            return Err(MeshFault::TooLarge);
        }
        self.triangles.push(corners);
        Ok(())
    }

    /// Adds a polygon cut into triangles, with corners among `vertices`.
    pub(super) fn add_polygon<T: Copy + Into<f64>>(
        &mut self,
        vertices: &[[T; 3]],
        corners: &[u32],
    ) -> Result<(), MeshFault> {
        match *corners {
            [a, b, c] => return self.add_triangle(vertices, [a, b, c]),
            [] | [_] | [_, _] => return Err(MeshFault::FewCorners(corners.len() as u64)),
            _ => {}
        }
        let points: Vec<DVec3> = corners.iter().map(|&corner| position(vertices, corner)).collect();
        let mut result = Ok(());
        let is_cut = polygon::triangulate(&points, |triangle| {
            if result.is_ok() {
                result = self.add_triangle(vertices, triangle.map(|k| corners[k]));
            }
        });
        if is_cut { result } else { Err(MeshFault::ManyCorners) }
    }
}

fn position<T: Copy + Into<f64>>(vertices: &[[T; 3]], index: u32) -> DVec3 {
    DVec3::from(vertices[index as usize].map(Into::into))
}

impl<T: Copy + Into<f64>> MeshBuilder<T> {
    /// Starts an empty mesh. It may grow to the given sizes without moving; they must not be taken
    /// from a file without a check.
    pub(super) fn with_capacity(vertices: usize, triangles: usize) -> Self {
        Self {
            vertices: Vec::with_capacity(vertices),
            vertex_table: PointTable::new(PointHasher::new(), vertices),
            faces: MeshFaces {
                triangles: Vec::with_capacity(triangles),
                dropped: DroppedFaces::default(),
            },
        }
    }

    /// Adds all vertices of a file, finite and without negative zeros, to an empty mesh: the index
    /// of each.
    pub(super) fn add_vertices(&mut self, positions: Vec<[T; 3]>) -> Result<Vec<u32>, MeshFault>
    where
        T: Sync,
    {
        u32::try_from(positions.len()).map_err(|_| MeshFault::TooLarge)?;
        let bits_of = |position: &[T; 3]| position.map(|number| number.into().to_bits());
        let mut numbers = find_firsts(&positions, bits_of);
        if numbers.par_iter().enumerate().all(|(k, &first)| first as usize == k) {
            self.vertices = positions;
            return Ok(numbers);
        }
        for k in 0..numbers.len() {
            let first = numbers[k] as usize;
            numbers[k] = if first == k {
                self.vertices.push(positions[k]);
                self.vertices.len() as u32 - 1
            } else {
                numbers[first]
            };
        }
        Ok(numbers)
    }

    /// Finds or adds the vertex at a finite position, in which no zero is negative, and gives its
    /// index.
    pub(super) fn add_vertex(&mut self, position: [T; 3]) -> Result<u32, MeshFault> {
        let vertices = &self.vertices;
        let bits = |position: &[T; 3]| position.map(|number| number.into().to_bits());
        let bits_at = |index: u32| bits(&vertices[index as usize]);
        match self.vertex_table.entry(bits(&position), bits_at) {
            Entry::Occupied(known) => Ok(*known.get()),
            Entry::Vacant(place) => {
                let index = u32::try_from(vertices.len()).map_err(|_| MeshFault::TooLarge)?;
                place.insert(index);
                self.vertices.push(position);
                Ok(index)
            }
        }
    }

    /// Adds a triangle with corners that [`MeshBuilder::add_vertex`] gave.
    pub(super) fn add_triangle(&mut self, corners: [u32; 3]) -> Result<(), MeshFault> {
        self.faces.add_triangle(&self.vertices, corners)
    }

    /// Adds a polygon cut into triangles.
    pub(super) fn add_polygon(&mut self, corners: &[u32]) -> Result<(), MeshFault> {
        self.faces.add_polygon(&self.vertices, corners)
    }

    /// The vertices that are there.
    pub(super) fn vertices(&self) -> &[[T; 3]] {
        &self.vertices
    }

    /// Takes the faces that pieces of a file have, whose corners are among the vertices.
    pub(super) fn take_faces(&mut self, pieces: Vec<MeshFaces>) -> Result<(), MeshFault> {
        self.faces.dropped.zero_area = pieces.iter().map(|faces| faces.dropped.zero_area).sum();
        self.faces.triangles = join(pieces.into_iter().map(|faces| faces.triangles).collect());
        let is_too_large = self.faces.triangles.len() > u32::MAX as usize;
        if is_too_large { Err(MeshFault::TooLarge) } else { Ok(()) }
    }

    /// Drops every copy of an earlier triangle.
    fn drop_copies(&mut self) {
        let function = HashFunction::random();
        let triangles = &self.faces.triangles;
        let triangle = |index: u32| turned(triangles[index as usize]);
        let hash = |index| Some(function.hash(triangle(index).map(u64::from)));
        let copies = groups_of_equal(
            triangles.len() as u32,
            hash,
            |_| false,
            |group, copies| {
                for (k, &index) in group.iter().enumerate() {
                    if group[..k].iter().any(|&first| triangle(first) == triangle(index)) {
                        copies.push(index);
                    }
                }
            },
        );
        let mut copies = copies.concat();
        if copies.is_empty() {
            return;
        }
        self.faces.dropped.duplicates += copies.len() as u64;
        copies.par_sort_unstable();
        let mut copies = copies.into_iter().peekable();
        let mut index = 0;
        self.faces.triangles.retain(|_| {
            let is_copy = copies.next_if_eq(&index).is_some();
            index += 1;
            !is_copy
        });
    }

    fn finish(
        mut self,
        vertices: impl FnOnce(Vec<[T; 3]>) -> MeshVertices,
    ) -> Result<MeshFile, MeshError> {
        if self.faces.triangles.is_empty() {
            return Err(MeshFault::Empty.of_file());
        }
        self.vertex_table = PointTable::new(PointHasher::new(), 0); // Its memory is needed.
        self.drop_copies();
        let (mut kept, mut triangles) = (self.vertices, self.faces.triangles);
        kept.shrink_to_fit();
        triangles.shrink_to_fit();
        Ok(MeshFile {
            shape: MeshShape { vertices: vertices(kept), triangles },
            dropped: self.faces.dropped,
        })
    }
}

impl MeshBuilder<f32> {
    /// Finishes the mesh, which must not be empty.
    pub(super) fn into_mesh(self) -> Result<MeshFile, MeshError> {
        self.finish(MeshVertices::Single)
    }
}

impl MeshBuilder<f64> {
    /// Finishes the mesh, which must not be empty.
    pub(super) fn into_mesh(self) -> Result<MeshFile, MeshError> {
        self.finish(|vertices| {
            let is_single = |&number: &f64| f64::from(number as f32).to_bits() == number.to_bits();
            if vertices.iter().flatten().all(is_single) {
                MeshVertices::Single(
                    vertices.iter().map(|vertex| vertex.map(|number| number as f32)).collect(),
                )
            } else {
                MeshVertices::Double(vertices)
            }
        })
    }
}

/// Joins what was read of a file piece by piece, on rayon's threads.
pub(super) fn join<T: Zeroable + Copy + Send + Sync>(mut pieces: Vec<Vec<T>>) -> Vec<T> {
    if pieces.len() == 1 {
        return pieces.remove(0);
    }
    let mut joined = bytemuck::zeroed_vec(pieces.iter().map(Vec::len).sum());
    let mut rest = &mut joined[..];
    let mut places = Vec::with_capacity(pieces.len());
    for piece in &pieces {
        let (place, later) = rest.split_at_mut(piece.len());
        places.push(place);
        rest = later;
    }
    let copy = |(piece, place): (Vec<T>, &mut [T])| place.copy_from_slice(&piece);
    pieces.into_par_iter().zip(places).for_each(copy);
    joined
}

/// Turns a triangle so that it begins with its smallest index.
fn turned([a, b, c]: [u32; 3]) -> [u32; 3] {
    if a <= b && a <= c {
        [a, b, c]
    } else if b <= c {
        [b, c, a]
    } else {
        [c, a, b]
    }
}
