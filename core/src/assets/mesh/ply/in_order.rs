//! Reading element by element, which tells where something is wrong.

use super::{
    body::Body,
    header::{Format, Header},
};
use crate::assets::mesh::{
    builder::MeshBuilder,
    error::{MeshError, MeshFault, MeshPlace},
};

/// Reads a file element by element; it may hold `expected` vertices.
pub(super) fn read_in_order<T: Copy + Into<f64>>(
    header: &Header<'_>,
    bytes: &[u8],
    expected: usize,
    convert: impl Fn(f64) -> T,
) -> Result<MeshBuilder<T>, MeshError> {
    let mut mesh = MeshBuilder::with_capacity(expected, 0);
    let vertex_count = header.element("vertex").map_or(0, |vertex| vertex.count);
    let mut vertices: Vec<u32> = Vec::new();
    // Faces that come before the vertices: how many corners, then those.
    let mut early_faces: Vec<u32> = Vec::new();
    let mut corners: Vec<u32> = Vec::new();
    let mut body = Body { bytes, at: header.length, format: header.format };
    for element in &header.elements {
        let is_vertex = element.name == b"vertex";
        let is_face = element.name == b"face";
        let places =
            if is_vertex { [b"x", b"y", b"z"].map(|name| element.scalar(name)) } else { [None; 3] };
        for index in 0..element.count {
            body.check_left(element, index)?;
            body.skip_space();
            let start = body.at;
            let noun = if is_vertex {
                "vertex"
            } else if is_face {
                "face"
            } else {
                "element"
            };
            let at = |fault: MeshFault| match header.format {
                Format::Ascii => fault.at_byte(bytes, start),
                _ => MeshError { at: MeshPlace::Element(noun, index), fault },
            };
            let mut position = [0.0; 3];
            corners.clear();
            for (k, property) in element.properties.iter().enumerate() {
                match property.list {
                    None => {
                        let number = body.number(property.kind).map_err(at)?;
                        if let Some(axis) = places
                            .iter()
                            .position(|place| place.is_some_and(|(place, _)| place == k))
                        {
                            position[axis] = number;
                        }
                    }
                    Some(length) => {
                        let length = body.whole(length).map_err(at)?;
                        let is_corners = is_face && property.is_corners();
                        for _ in 0..length {
                            if is_corners {
                                let index = body.whole(property.kind).map_err(at)?;
                                if index >= vertex_count.cast_signed() {
                                    return Err(at(MeshFault::Index {
                                        index,
                                        count: vertex_count,
                                        first: 0,
                                    }));
                                }
                                corners.push(index as u32);
                            } else {
                                body.number(property.kind).map_err(at)?;
                            }
                        }
                    }
                }
            }
            if is_vertex {
                let position = position.map(&convert);
                if !position.iter().all(|&number| number.into().is_finite()) {
                    return Err(at(MeshFault::Number));
                }
                vertices.push(mesh.add_vertex(position).map_err(at)?);
            } else if is_face && vertices.len() as u64 == vertex_count {
                for corner in &mut corners {
                    *corner = vertices[*corner as usize];
                }
                mesh.add_polygon(&corners).map_err(at)?;
            } else if is_face {
                early_faces.push(corners.len() as u32);
                early_faces.extend_from_slice(&corners);
            }
        }
    }
    let mut rest = &early_faces[..];
    while let Some((&count, faces)) = rest.split_first() {
        let (face, others) = faces.split_at(count as usize);
        corners.clear();
        corners.extend(face.iter().map(|&corner| vertices[corner as usize]));
        mesh.add_polygon(&corners).map_err(MeshFault::of_file)?;
        rest = others;
    }
    Ok(mesh)
}
