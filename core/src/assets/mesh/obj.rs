//! OBJ files: vertices and polygons; all else is skipped. Source: Wavefront, "Object Files
//! (.obj)", Advanced Visualizer manual, appendix B1.

use super::{
    builder::{MeshBuilder, MeshFile},
    error::{MeshError, MeshFault},
};
use crate::text::{
    bytes::{Class, class},
    number::scan_number,
};

/// Reads a file.
pub(super) fn read_obj(text: &[u8]) -> Result<MeshFile, MeshError> {
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
                let mut position = [0.0; 3];
                for number in &mut position {
                    line.skip_blanks();
                    *number = scan_number(text, &mut line.at)
                        .ok_or_else(|| MeshFault::Number.at_byte(text, line.at))?;
                }
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
