//! STL files. Source: 3D Systems, "Stereo Lithography Interface Specification" (1989).

use super::{
    builder::{MeshBuilder, MeshFile},
    error::{MeshError, MeshFault, MeshPlace},
};
use crate::text::{
    bytes::{Class, class},
    number::scan_number_without_comment,
};

/// A header of 80 bytes and the number of triangles.
const HEADER: usize = 84;

/// A normal, three vertices, and two bytes that mean nothing.
const FACET: usize = 50;

/// Whether bytes look like STL.
pub(super) fn is_stl(bytes: &[u8]) -> bool {
    binary_length(bytes) == Some(bytes.len() as u64) || starts_as_text(bytes)
}

/// Reads a binary or ASCII file. Binary ones may begin with `solid` too, so their length decides.
pub(super) fn read_stl(bytes: &[u8]) -> Result<MeshFile, MeshError> {
    let binary_length = binary_length(bytes);
    let head = &bytes[..bytes.len().min(1024)];
    let is_text = starts_as_text(bytes)
        && binary_length != Some(bytes.len() as u64)
        && (memchr::memmem::find(&head.to_ascii_lowercase(), b"facet").is_some()
            || !head.contains(&0));
    match binary_length {
        _ if is_text => read_ascii(bytes),
        // Some writers append notes of their own.
        Some(length) if length <= bytes.len() as u64 => {
            read_binary(&bytes[HEADER..length as usize])
        }
        expected => {
            let (expected, found) = (expected.unwrap_or(HEADER as u64), bytes.len() as u64);
            Err(MeshFault::Truncated { expected, found }.of_file())
        }
    }
}

fn starts_as_text(bytes: &[u8]) -> bool {
    bytes.trim_ascii_start().get(..5).is_some_and(|word| word.eq_ignore_ascii_case(b"solid"))
}

/// The length that a binary file of this header has.
fn binary_length(bytes: &[u8]) -> Option<u64> {
    let count = u32::from_le_bytes(*bytes.get(80..)?.first_chunk()?);
    Some(HEADER as u64 + FACET as u64 * u64::from(count))
}

fn read_binary(facets: &[u8]) -> Result<MeshFile, MeshError> {
    let (facets, _) = facets.as_chunks::<FACET>();
    // A closed mesh has half as many vertices as triangles.
    let mut mesh = MeshBuilder::<f32>::with_capacity(facets.len() / 2, facets.len());
    for (index, facet) in facets.iter().enumerate() {
        let at = |fault| MeshError { at: MeshPlace::Triangle(index as u64), fault };
        let (numbers, _) = facet[12..48].as_chunks::<4>();
        let mut corners = [0; 3];
        for (corner, numbers) in corners.iter_mut().zip(numbers.chunks_exact(3)) {
            let position = [0, 1, 2].map(|k| f32::from_le_bytes(numbers[k]) + 0.0);
            if !position.iter().all(|number| number.is_finite()) {
                return Err(at(MeshFault::Number));
            }
            *corner = mesh.add_vertex(position).map_err(at)?;
        }
        mesh.add_triangle(corners).map_err(at)?;
    }
    mesh.into_mesh()
}

/// Reads facets by their `vertex` and `endloop` words and skips all others. The names of solids
/// may be anything, so lines that begin with `solid` or `endsolid` are skipped whole.
fn read_ascii(text: &[u8]) -> Result<MeshFile, MeshError> {
    let mut mesh = MeshBuilder::<f64>::with_capacity(0, 0);
    let mut corners = [0; 3];
    let mut count = 0_u64;
    let mut at = 0;
    loop {
        at = skip_space(text, at);
        let start = at;
        while text.get(at).is_some_and(|&byte| class(byte) != Class::Space) {
            at += 1;
        }
        let fault = |fault: MeshFault| fault.at_byte(text, start);
        match &text[start..at] {
            [] => break,
            word if word.eq_ignore_ascii_case(b"vertex") => {
                let mut position = [0.0; 3];
                for number in &mut position {
                    at = skip_space(text, at);
                    *number = scan_number_without_comment(text, &mut at)
                        .ok_or_else(|| MeshFault::Number.at_byte(text, at))?;
                }
                if let Some(corner) = corners.get_mut(count as usize) {
                    *corner = mesh.add_vertex(position).map_err(fault)?;
                }
                count += 1;
            }
            word if word.eq_ignore_ascii_case(b"endloop") => {
                if count != 3 {
                    return Err(fault(MeshFault::Facet(count)));
                }
                mesh.add_triangle(corners).map_err(fault)?;
                count = 0;
            }
            word if word.eq_ignore_ascii_case(b"solid")
                || word.eq_ignore_ascii_case(b"endsolid") =>
            {
                at += memchr::memchr(b'\n', &text[at..]).unwrap_or(text.len() - at);
            }
            _ => {}
        }
    }
    if count > 0 {
        return Err(MeshFault::EarlyEnd.at_byte(text, text.len()));
    }
    mesh.into_mesh()
}

fn skip_space(text: &[u8], mut at: usize) -> usize {
    while text.get(at).is_some_and(|&byte| class(byte) == Class::Space) {
        at += 1;
    }
    at
}
