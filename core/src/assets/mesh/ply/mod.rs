//! PLY files, ASCII and binary in both byte orders: the vertices' x, y, z and the faces' lists of
//! vertices; all else is skipped. Source: Turk, "The PLY Polygon File Format" (1994).

mod body;
mod header;
mod in_order;
mod pieces;

use self::{
    header::{Header, Number},
    in_order::read_in_order,
    pieces::read_in_pieces,
};
use super::{
    builder::MeshFile,
    error::{MeshError, MeshFault},
};

/// Whether bytes begin as a PLY file does.
pub(super) fn is_ply(bytes: &[u8]) -> bool {
    bytes.starts_with(b"ply\n") || bytes.starts_with(b"ply\r")
}

/// Reads a file.
pub(super) fn read_ply(bytes: &[u8]) -> Result<MeshFile, MeshError> {
    let header = Header::read(bytes)?;
    let vertex = header.element("vertex").ok_or(MeshFault::Missing("vertices").of_file())?;
    if vertex.count > u64::from(u32::MAX) {
        return Err(MeshFault::TooLarge.of_file());
    }
    let coordinates = [b"x", b"y", b"z"].map(|name| vertex.scalar(name));
    let [Some(_), Some(_), Some(_)] = coordinates else {
        return Err(MeshFault::Missing("x, y and z for its vertices").of_file());
    };
    // What the header announces, as far as the file is long enough for it.
    let least_size = vertex.least_size(header.format).max(1);
    let expected = vertex.count.min((bytes.len() / least_size) as u64) as usize;
    if coordinates.iter().flatten().all(|&(_, kind)| kind == Number::Float) {
        let single = |number: f64| number as f32 + 0.0;
        match read_in_pieces(&header, bytes, single) {
            Some(mesh) => mesh.into_mesh(),
            None => read_in_order(&header, bytes, expected, single)?.into_mesh(),
        }
    } else {
        let double = |number: f64| number + 0.0;
        match read_in_pieces(&header, bytes, double) {
            Some(mesh) => mesh.into_mesh(),
            None => read_in_order(&header, bytes, expected, double)?.into_mesh(),
        }
    }
}
