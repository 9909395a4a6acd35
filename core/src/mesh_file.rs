//! Mesh files into shared vertices and triangles.

use crate::scene::MeshVertices;

/// What a mesh file holds.
#[derive(Debug, Clone, PartialEq)]
pub struct MeshShape {
    /// The corners that triangles share; no two are equal.
    pub vertices: MeshVertices,
    /// Indices of corners, counter-clockwise seen from the front.
    pub triangles: Vec<[u32; 3]>,
}

/// Why a mesh file cannot be read.
#[derive(Debug, PartialEq, Eq, thiserror::Error)]
pub enum MeshError {
    /// Neither its bytes nor its name are those of a format.
    #[error("it is no STL, OBJ or PLY")]
    UnknownFormat,
}

/// Reads the bytes of a mesh file.
pub fn read_mesh(_path: &str, _bytes: &[u8]) -> Result<MeshShape, MeshError> {
    Err(MeshError::UnknownFormat)
}
