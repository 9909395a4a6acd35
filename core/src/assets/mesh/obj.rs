//! OBJ files: vertices and polygons; all else is skipped. Source: Wavefront, "Object Files
//! (.obj)", Advanced Visualizer manual, appendix B1.

use rayon::prelude::*;

use super::{
    builder::{MeshBuilder, MeshFaces, MeshFile, join},
    error::{MeshError, MeshFault},
};
use crate::text::{
    bytes::{Class, class},
    number::scan_number,
};

/// Large files are read by pieces of about so many bytes.
const PIECE: usize = 1 << 18;

/// Reads a file.
pub(super) fn read_obj(text: &[u8]) -> Result<MeshFile, MeshError> {
    read_in_pieces(text, PIECE).map_or_else(|| read_in_order(text), Ok)
}

/// Reads a file of several pieces on rayon's threads: its vertices, then its faces. `None` where
/// that would not be all of it, or in another order: a face names a vertex that comes later, or
/// something is wrong.
fn read_in_pieces(text: &[u8], size: usize) -> Option<MeshFile> {
    let pieces = pieces(text, size);
    if pieces.len() == 1 {
        return None;
    }
    let of_pieces: Vec<Vec<[f64; 3]>> =
        pieces.par_iter().map(|piece| read_positions(piece)).collect::<Option<_>>()?;
    let mut count = 0;
    let mut firsts = Vec::with_capacity(pieces.len());
    for positions in &of_pieces {
        firsts.push(count);
        count += positions.len();
    }
    let mut mesh = MeshBuilder::<f64>::with_capacity(0, 0);
    let vertices = mesh.add_vertices(join(of_pieces)).ok()?;
    let faces: Vec<MeshFaces> = (pieces.par_iter().zip(firsts))
        .map(|(piece, first)| read_faces(piece, first, &vertices, mesh.vertices()))
        .collect::<Option<_>>()?;
    mesh.take_faces(faces).ok()?;
    mesh.into_mesh().ok()
}

/// Cuts a text into pieces of whole lines.
fn pieces(text: &[u8], size: usize) -> Vec<&[u8]> {
    let (mut pieces, mut rest) = (Vec::new(), text);
    while rest.len() > size {
        let goes_on = |end: &usize| matches!(rest[..*end], [.., b'\\'] | [.., b'\\', b'\r']);
        let mut ends = memchr::memchr_iter(b'\n', &rest[size..]).map(|end| size + end);
        let Some(end) = ends.find(|end| !goes_on(end)) else { break };
        let (piece, later) = rest.split_at(end + 1);
        pieces.push(piece);
        rest = later;
    }
    pieces.push(rest);
    pieces
}

/// The vertices of a piece.
fn read_positions(piece: &[u8]) -> Option<Vec<[f64; 3]>> {
    let mut positions = Vec::new();
    let mut line = Line { text: piece, at: 0 };
    while line.at < piece.len() {
        line.skip_blanks();
        if let [b'v', next, ..] = piece[line.at..]
            && is_blank(next)
        {
            line.at += 1;
            positions.push(line.read_position().ok()?);
        }
        line.skip();
    }
    Some(positions)
}

/// The faces of a piece that follows `count` of the file's vertices. These are `numbers` among
/// `vertices`.
fn read_faces(
    piece: &[u8],
    mut count: usize,
    numbers: &[u32],
    vertices: &[[f64; 3]],
) -> Option<MeshFaces> {
    let (mut faces, mut corners) = (MeshFaces::default(), Vec::new());
    let mut line = Line { text: piece, at: 0 };
    while line.at < piece.len() {
        line.skip_blanks();
        match piece[line.at..] {
            [b'v', next, ..] if is_blank(next) => count += 1,
            [b'f', next, ..] if is_blank(next) => {
                line.at += 1;
                line.read_corners(&numbers[..count], count, &mut corners).ok()?;
                if corners.contains(&EARLY) {
                    return None;
                }
                faces.add_polygon(vertices, &corners).ok()?;
            }
            _ => {}
        }
        line.skip();
    }
    Some(faces)
}

/// Reads a file line by line.
fn read_in_order(text: &[u8]) -> Result<MeshFile, MeshError> {
    let mut mesh = MeshBuilder::<f64>::with_capacity(0, 0);
    // The file's vertices by their numbers less one.
    let mut vertices: Vec<u32> = Vec::new();
    // Faces that name vertices which come later, and how many there were.
    let mut early_faces: Vec<(usize, usize)> = Vec::new();
    let mut corners = Vec::new();
    let mut line = Line { text, at: 0 };
    while line.at < text.len() {
        line.skip_blanks();
        let start = line.at;
        match text[start..] {
            [b'v', next, ..] if is_blank(next) => {
                line.at += 1;
                let position = line.read_position()?;
                let vertex =
                    mesh.add_vertex(position).map_err(|fault| fault.at_byte(text, start))?;
                vertices.push(vertex);
            }
            [b'f', next, ..] if is_blank(next) => {
                line.at += 1;
                line.read_corners(&vertices, vertices.len(), &mut corners)?;
                if corners.contains(&EARLY) {
                    early_faces.push((start + 1, vertices.len()));
                } else {
                    mesh.add_polygon(&corners).map_err(|fault| fault.at_byte(text, start))?;
                }
            }
            _ => {}
        }
        line.skip();
    }
    for (start, count) in early_faces {
        let mut line = Line { text, at: start };
        line.read_corners(&vertices, count, &mut corners)?;
        if let Some(place) = corners.iter().position(|&corner| corner == EARLY) {
            let fault = MeshFault::Index {
                index: line.index_of_corner(start, place),
                count: vertices.len() as u64,
                first: 1,
            };
            return Err(fault.at_byte(text, start));
        }
        mesh.add_polygon(&corners).map_err(|fault| fault.at_byte(text, start))?;
    }
    mesh.into_mesh()
}

/// The index of a vertex that is not there yet.
const EARLY: u32 = u32::MAX;

fn is_blank(byte: u8) -> bool {
    matches!(byte, b' ' | b'\t' | b'\\')
}

/// Reads along a line, which goes on after a backslash.
struct Line<'t> {
    text: &'t [u8],
    at: usize,
}

impl Line<'_> {
    fn skip_blanks(&mut self) {
        loop {
            match self.text[self.at..] {
                [b' ' | b'\t', ..] => self.at += 1,
                [b'\\', b'\n', ..] => self.at += 2,
                [b'\\', b'\r', b'\n', ..] => self.at += 3,
                _ => return,
            }
        }
    }

    /// Reads the coordinates of a vertex.
    fn read_position(&mut self) -> Result<[f64; 3], MeshError> {
        let mut position = [0.0; 3];
        for number in &mut position {
            self.skip_blanks();
            *number = scan_number(self.text, &mut self.at)
                .ok_or_else(|| MeshFault::Number.at_byte(self.text, self.at))?;
        }
        Ok(position)
    }

    /// Goes to the next line.
    fn skip(&mut self) {
        let rest = &self.text[self.at..];
        self.at += memchr::memchr(b'\n', rest).map_or(rest.len(), |end| end + 1);
    }

    /// Reads the corners of a face that follows `count` vertices; negative numbers count back from
    /// those.
    fn read_corners(
        &mut self,
        vertices: &[u32],
        count: usize,
        corners: &mut Vec<u32>,
    ) -> Result<(), MeshError> {
        corners.clear();
        loop {
            self.skip_blanks();
            if !self.text.get(self.at).is_some_and(|&byte| class(byte) == Class::Word) {
                return Ok(());
            }
            let start = self.at;
            let index = self
                .read_index()
                .ok_or_else(|| MeshFault::VertexNumber.at_byte(self.text, start))?;
            let from_zero = if index < 0 { count.cast_signed() as i64 + index } else { index - 1 };
            let corner = match usize::try_from(from_zero) {
                Ok(place) if index != 0 => vertices.get(place).copied().unwrap_or(EARLY),
                _ => {
                    let fault = MeshFault::Index { index, count: count as u64, first: 1 };
                    return Err(fault.at_byte(self.text, start));
                }
            };
            corners.push(corner);
        }
    }

    /// Reads a corner's vertex number; those of its texture and normal follow slashes.
    fn read_index(&mut self) -> Option<i64> {
        let is_negative = self.text[self.at] == b'-';
        self.at += usize::from(is_negative);
        let digits = self.at;
        let mut index = 0_i64;
        while let Some(&digit @ b'0'..=b'9') = self.text.get(self.at) {
            index = index.checked_mul(10)?.checked_add(i64::from(digit - b'0'))?;
            self.at += 1;
        }
        let is_number = self.at > digits;
        while matches!(self.text.get(self.at), Some(b'0'..=b'9' | b'/' | b'-')) {
            self.at += 1;
        }
        let is_over = self.text.get(self.at).is_none_or(|&byte| {
            byte == b'\\' || matches!(class(byte), Class::Space | Class::Comment)
        });
        (is_number && is_over).then_some(if is_negative { -index } else { index })
    }

    /// Gives the number of a corner in a face that was read once without a mistake.
    fn index_of_corner(&self, start: usize, place: usize) -> i64 {
        let mut line = Line { text: self.text, at: start };
        let mut index = 0;
        for _ in 0..=place {
            line.skip_blanks();
            index = line.read_index().unwrap_or(0);
        }
        index
    }
}

#[cfg(test)]
mod tests {
    use std::fmt::Write;

    use super::*;

    /// Vertices in turn with faces of all kinds; equal vertices, faces without area and copies
    /// among them.
    fn text(count: usize) -> String {
        let mut text = String::new();
        for k in 0..count {
            writeln!(text, "v {} {}.5 {}e-1", k % 50, k / 50, k * k % 7).unwrap();
            if k % 3 == 0 {
                text.push_str("v 1 2 3\r\n# no v 1 2 \\\n");
            }
            if k >= 10 {
                writeln!(text, "f {} \\\n -1/2/3 -{}//1 # a face", k / 2 + 1, 2 + k % 5).unwrap();
            }
            if k % 10 == 9 {
                writeln!(text, "\tf -1 -2 -4 -3\nf 1 2 2\nf 1 3 5\r").unwrap();
            }
        }
        text
    }

    #[test]
    fn pieces_give_what_the_whole_gives() {
        let text = text(500);
        let expected = read_in_order(text.as_bytes()).unwrap();
        assert!(expected.shape.triangles.len() > 400 && expected.dropped.duplicates > 0);
        for size in [1, 10, 37, 100, 999, 5000] {
            assert!(pieces(text.as_bytes(), size).len() > 1);
            assert_eq!(read_in_pieces(text.as_bytes(), size).as_ref(), Some(&expected), "{size}");
        }
    }

    #[test]
    fn what_is_wrong_or_early_is_left_to_who_reads_in_order() {
        for line in ["f 1 2 100000", "v 1 2", "f 0 1 2", "f 1 2", "f 1 2 x", "v 1 2 1e999"] {
            let text = format!("{}{line}\n{}", text(50), text(50));
            assert_eq!(read_in_pieces(text.as_bytes(), 100), None, "{line}");
        }
        let late = format!("v 0 0 0\nv 1 0 0\nf 1 2 3\nv 0 1 0\n{}", text(50));
        assert_eq!(read_in_pieces(late.as_bytes(), 100), None);
        assert!(read_obj(late.as_bytes()).is_ok());
    }
}
