//! Mesh files into shared vertices and triangles.
//!
//! The readers of the three formats are written by hand, since those of the package registry
//! allocate for every line or property, trust the counts of the file, or keep equal vertices apart.

mod builder;
mod error;
mod obj;
mod ply;
mod stl;

pub use self::{
    builder::MeshFile,
    error::{MeshError, MeshFault, MeshPlace},
};

/// Reads the bytes of a mesh file. They tell the format, except that OBJ has no mark: its name
/// does.
pub fn read_mesh(path: &str, bytes: &[u8]) -> Result<MeshFile, MeshError> {
    let extension = path.rsplit_once('.').map(|(_, extension)| extension.to_ascii_lowercase());
    match extension.as_deref() {
        _ if ply::is_ply(bytes) => ply::read_ply(bytes),
        Some("obj") => obj::read_obj(bytes),
        Some("stl") => stl::read_stl(bytes),
        _ if stl::is_stl(bytes) => stl::read_stl(bytes),
        _ => Err(MeshFault::UnknownFormat.of_file()),
    }
}
