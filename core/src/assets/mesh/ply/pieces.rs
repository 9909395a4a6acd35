//! Reading on all threads: vertices, then faces, in runs of elements whose first bytes are known
//! beforehand. A text is read so if each element has a line of its own.

use rayon::prelude::*;

use super::{
    body::Body,
    header::{Element, Format, Header, Number},
};
use crate::assets::mesh::builder::{MeshBuilder, MeshFaces, join};

/// A thread reads so many elements in one go.
const AT_ONCE: usize = 1 << 14;

/// The lines of a text are counted by pieces of so many bytes.
const PIECE: usize = 1 << 18;

/// Reads a file on rayon's threads. `None` where the file has another order than vertices, then
/// faces, and where something is wrong.
pub(super) fn read_in_pieces<T: Copy + Into<f64> + bytemuck::Zeroable + Send + Sync>(
    header: &Header<'_>,
    bytes: &[u8],
    convert: impl Fn(f64) -> T + Sync,
) -> Option<MeshBuilder<T>> {
    let mut rest = match header.format {
        Format::Ascii => Rest::Lines(Lines::new(bytes, header.length)),
        _ => Rest::From(header.length),
    };
    let body = |at| Body { bytes, at, format: header.format };
    let (mut mesh, mut numbers) = (MeshBuilder::with_capacity(0, 0), None);
    for (place, element) in header.elements.iter().enumerate() {
        let runs = rest.cut(bytes, header.format, element)?;
        match element.name {
            b"vertex" if numbers.is_none() => {
                let read = |&(start, count): &(usize, usize)| {
                    body(start).read_positions(element, count, &convert)
                };
                let positions = runs.par_iter().map(read).collect::<Option<_>>()?;
                numbers = Some(mesh.add_vertices(join(positions)).ok()?);
            }
            b"face" if place + 1 == header.elements.len() => {
                let numbers = numbers.as_deref()?;
                let read = |&(start, count): &(usize, usize)| {
                    body(start).read_faces(element, count, numbers, mesh.vertices())
                };
                let faces = runs.par_iter().map(read).collect::<Option<_>>()?;
                mesh.take_faces(faces).ok()?;
                return Some(mesh);
            }
            b"vertex" | b"face" => return None,
            _ => {
                let check = |&(start, count): &(usize, usize)| body(start).pass(element, count);
                runs.par_iter().map(check).collect::<Option<()>>()?;
            }
        }
    }
    None
}

/// What is left of a body.
enum Rest {
    /// Binary elements from this byte on.
    From(usize),
    Lines(Lines),
}

impl Rest {
    /// Goes past the elements of a kind: where each run of them begins, and how many it has.
    fn cut(
        &mut self,
        bytes: &[u8],
        format: Format,
        element: &Element<'_>,
    ) -> Option<Vec<(usize, usize)>> {
        let count = usize::try_from(element.count).ok()?;
        if element.properties.is_empty() {
            return None;
        }
        let counts = (0..count).step_by(AT_ONCE).map(|first| (first, AT_ONCE.min(count - first)));
        let has_lists = element.properties.iter().any(|property| property.list.is_some());
        match self {
            Self::Lines(lines) => {
                let runs = counts
                    .map(|(first, count)| Some((lines.start_of(bytes, first)?, count)))
                    .collect();
                lines.passed = lines.passed.checked_add(count)?;
                runs
            }
            Self::From(at) if has_lists => {
                let mut body = Body { bytes, at: *at, format };
                let runs = counts
                    .map(|(_, count)| {
                        let start = body.at;
                        body.pass(element, count)?;
                        Some((start, count))
                    })
                    .collect();
                *at = body.at;
                runs
            }
            Self::From(at) => {
                let (start, size) = (*at, element.least_size(format));
                *at = count.checked_mul(size)?.checked_add(start)?;
                bytes.get(start..*at)?;
                Some(counts.map(|(first, count)| (start + first * size, count)).collect())
            }
        }
    }
}

/// The lines of a text from a byte on.
struct Lines {
    /// Where pieces of the text begin, and how many lines end before.
    pieces: Vec<(usize, usize)>,
    /// Lines that are behind.
    passed: usize,
}

impl Lines {
    fn new(bytes: &[u8], start: usize) -> Self {
        let counts: Vec<usize> = bytes[start..]
            .par_chunks(PIECE)
            .map(|piece| memchr::memchr_iter(b'\n', piece).count())
            .collect();
        let mut ended = 0;
        let pieces = (0..)
            .zip(counts)
            .map(|(k, count)| {
                let piece = (start + k * PIECE, ended);
                ended += count;
                piece
            })
            .collect();
        Self { pieces, passed: 0 }
    }

    /// The first byte of the `line`th line after those that are behind; `None` where there are
    /// fewer.
    fn start_of(&self, bytes: &[u8], line: usize) -> Option<usize> {
        let line = self.passed.checked_add(line)?;
        let &(start, before) = self.pieces[..self.pieces.partition_point(|piece| piece.1 < line)]
            .last()
            .or_else(|| self.pieces.first())?;
        if line == before {
            return Some(start);
        }
        let end = memchr::memchr_iter(b'\n', &bytes[start..]).nth(line - before - 1)?;
        Some(start + end + 1)
    }
}

impl Body<'_> {
    /// Reads so many vertices.
    fn read_positions<T: Copy + Into<f64>>(
        &mut self,
        element: &Element<'_>,
        count: usize,
        convert: &impl Fn(f64) -> T,
    ) -> Option<Vec<[T; 3]>> {
        let axes = [b"x", b"y", b"z"];
        if self.format == Format::Ascii {
            let places = axes.map(|name| element.scalar(name).map(|(place, _)| place));
            let read = |_| {
                let mut position = [0.0; 3];
                for (place, property) in element.properties.iter().enumerate() {
                    if property.list.is_some() {
                        return None;
                    }
                    let number = self.number_in_line(property.kind)?;
                    if let Some(axis) = places.iter().position(|&axis| axis == Some(place)) {
                        position[axis] = number;
                    }
                }
                self.end_line()?;
                finite(position.map(convert))
            };
            return (0..count).map(read).collect();
        }
        let [Some(x), Some(y), Some(z)] = axes.map(|name| element.place(name)) else {
            return None;
        };
        let size = element.least_size(self.format);
        let vertices = self.bytes.get(self.at..)?.get(..count.checked_mul(size)?)?;
        let read = |bytes| {
            finite([x, y, z].map(|(at, kind)| {
                let mut body = Body { bytes, at, format: self.format };
                convert(body.number(kind).unwrap_or(f64::NAN))
            }))
        };
        vertices.chunks_exact(size).map(read).collect()
    }

    /// Reads so many faces, with corners among the file's vertices, which are `numbers` among
    /// `vertices`.
    fn read_faces<T: Copy + Into<f64>>(
        &mut self,
        element: &Element<'_>,
        count: usize,
        numbers: &[u32],
        vertices: &[[T; 3]],
    ) -> Option<MeshFaces> {
        let (mut faces, mut corners) = (MeshFaces::default(), Vec::new());
        for _ in 0..count {
            corners.clear();
            for property in &element.properties {
                match property.list {
                    Some(length) if property.is_corners() => {
                        for _ in 0..self.whole_in_line(length)? {
                            let index = self.whole_in_line(property.kind)? as usize;
                            corners.push(*numbers.get(index)?);
                        }
                    }
                    Some(length) => {
                        let length = self.whole_in_line(length)?;
                        self.pass_numbers(property.kind, length as usize)?;
                    }
                    None => self.pass_numbers(property.kind, 1)?,
                }
            }
            self.end_line()?;
            faces.add_polygon(vertices, &corners).ok()?;
        }
        Some(faces)
    }

    /// Goes past so many elements.
    fn pass(&mut self, element: &Element<'_>, count: usize) -> Option<()> {
        for _ in 0..count {
            for property in &element.properties {
                let length = match property.list {
                    Some(Number::Uchar) if self.format != Format::Ascii => {
                        self.at += 1;
                        usize::from(*self.bytes.get(self.at - 1)?)
                    }
                    Some(kind) => self.whole_in_line(kind)? as usize,
                    None => 1,
                };
                self.pass_numbers(property.kind, length)?;
            }
            self.end_line()?;
        }
        Some(())
    }

    /// Goes past numbers.
    fn pass_numbers(&mut self, kind: Number, count: usize) -> Option<()> {
        if self.format == Format::Ascii {
            return (0..count).try_for_each(|_| self.number_in_line(kind).map(|_| ()));
        }
        self.at = self.at.checked_add(count.checked_mul(kind.size())?)?;
        (self.at <= self.bytes.len()).then_some(())
    }

    /// A number; of a text it has to be in the same line.
    fn number_in_line(&mut self, kind: Number) -> Option<f64> {
        self.stay_in_line()?;
        self.number(kind).ok()
    }

    /// A number that is not negative and has no fraction; of a text it has to be in the same line.
    fn whole_in_line(&mut self, kind: Number) -> Option<i64> {
        self.stay_in_line()?;
        self.whole(kind).ok()
    }

    /// Goes to the next word of a line. `None` where there is none.
    fn stay_in_line(&mut self) -> Option<()> {
        if self.format == Format::Ascii {
            self.skip_blanks();
            return (*self.bytes.get(self.at)? != b'\n').then_some(());
        }
        Some(())
    }

    /// Goes to the next line of a text. `None` where there is more in this one.
    fn end_line(&mut self) -> Option<()> {
        if self.format == Format::Ascii {
            self.skip_blanks();
            let is_end = self.bytes.get(self.at).is_none_or(|&byte| byte == b'\n');
            self.at += 1;
            return is_end.then_some(());
        }
        Some(())
    }
}

/// The position, if it is finite.
fn finite<T: Copy + Into<f64>>(position: [T; 3]) -> Option<[T; 3]> {
    position.iter().all(|&number| number.into().is_finite()).then_some(position)
}

#[cfg(test)]
mod tests {
    use std::fmt::Write;

    use super::*;
    use crate::assets::mesh::ply::in_order::read_in_order;

    /// A binary file with vertices of numbers besides, equal ones among them, and faces of three
    /// and more corners, some of them copies.
    fn file(is_little: bool, last_corner: u32) -> Vec<u8> {
        const VERTICES: u32 = 3000;
        const FACES: u32 = 2 * AT_ONCE as u32 + 5;
        let order = if is_little { "little" } else { "big" };
        let mut bytes = format!(
            "ply\nformat binary_{order}_endian 1.0\nelement other 2\nproperty short a\n\
             element vertex {VERTICES}\nproperty uchar red\nproperty float x\nproperty double y\n\
             property float z\nelement face {FACES}\nproperty uchar flags\n\
             property list uchar int vertex_indices\nproperty list ushort float others\nend_header\n"
        )
        .into_bytes();
        macro_rules! push {
            ($number:expr) => {
                let number = $number;
                bytes.extend(if is_little { number.to_le_bytes() } else { number.to_be_bytes() })
            };
        }
        bytes.extend([7; 4]);
        for k in 0..VERTICES {
            push!(9_u8);
            push!((k % 50) as f32 - 0.0);
            push!(f64::from(k / 50 % 40) * 0.1);
            push!(-((k * k % 7) as f32));
        }
        for k in 0..FACES {
            push!(1_u8);
            let corners: u8 = if k % 5 == 0 { 4 } else { 3 };
            push!(corners);
            for corner in [0, 1, 51, 50].into_iter().take(usize::from(corners)) {
                let is_last = k + 1 == FACES && corner == 51;
                push!(if is_last { last_corner } else { (k * 37 + corner) % VERTICES });
            }
            push!((k % 3) as u16);
            for _ in 0..k % 3 {
                push!(0.5_f32);
            }
        }
        bytes
    }

    /// The same as text, an element a line, with spaces and empty words here and there.
    fn text(last_corner: u32) -> String {
        const VERTICES: u32 = 20_000;
        const FACES: u32 = 2 * AT_ONCE as u32 + 5;
        let mut text = format!(
            "ply\nformat ascii 1.0\nelement other 2\nproperty short a\n\
             element vertex {VERTICES}\nproperty uchar red\nproperty float x\nproperty double y\n\
             property float z\nelement face {FACES}\nproperty uchar flags\n\
             property list uchar int vertex_indices\nproperty list ushort float others\n\
             end_header\n-7\n 7\r\n"
        );
        for k in 0..VERTICES {
            let [x, y, z] = [f64::from(k % 50), f64::from(k / 50) * 0.1, -f64::from(k * k % 7)];
            let space = if k % 3 == 0 { " \t" } else { "" };
            writeln!(text, "{space}9 {x}  {y} {z}.00000005960464477539062500001{space}").unwrap();
        }
        for k in 0..FACES {
            let corners = [0, 1, 51, 50].map(|corner| {
                let is_last = k + 1 == FACES && corner == 51;
                if is_last { last_corner } else { (k * 37 + corner) % VERTICES }
            });
            let [a, b, c, d] = corners;
            let other = "0.5 ".repeat((k % 3) as usize);
            match k % 5 {
                0 => writeln!(text, "1 4 {a} {b} {c} {d} {} {other}", k % 3).unwrap(),
                _ => writeln!(text, "1 3 {a} {b} {c} {} {other}", k % 3).unwrap(),
            }
        }
        text.truncate(text.trim_end().len());
        text
    }

    #[test]
    fn pieces_give_what_the_whole_gives() {
        let double = |number: f64| number + 0.0;
        let more = format!("{}\nwhat follows is not read\n", text(5)).into_bytes();
        for bytes in [file(true, 5), file(false, 5), text(5).into_bytes(), more] {
            let header = Header::read(&bytes).unwrap();
            let expected = read_in_order(&header, &bytes, 0, double).unwrap().into_mesh().unwrap();
            assert!(expected.shape.triangles.len() > 2000 && expected.dropped.duplicates > 0);
            let found = read_in_pieces(&header, &bytes, double).unwrap().into_mesh().unwrap();
            assert!(found == expected, "{:?}", header.format);
        }
    }

    #[test]
    fn lines_begin_after_the_ends_of_others() {
        let text = "one\n\nthree\nfour";
        let lines = Lines::new(text.as_bytes(), 0);
        let starts: Vec<_> = (0..5).map(|line| lines.start_of(text.as_bytes(), line)).collect();
        assert_eq!(starts, [Some(0), Some(4), Some(5), Some(11), None]);
        let numbers: Vec<String> = (0..100_000).map(|k: u32| k.to_string()).collect();
        let long = numbers.join("\n") + "\n";
        let lines = Lines::new(long.as_bytes(), 2);
        assert!(lines.pieces.len() > 2);
        for line in [0, 1, 40_000, 70_000, 99_998] {
            let start = lines.start_of(long.as_bytes(), line).unwrap();
            assert!(long[start..].starts_with(&format!("{}\n", line + 1)), "{line}");
        }
    }

    #[test]
    fn what_is_wrong_is_left_to_who_reads_in_order() {
        let is_left = |bytes: &[u8]| {
            read_in_pieces(&Header::read(bytes).unwrap(), bytes, |number| number).is_none()
        };
        let whole = file(true, 5);
        assert!(!is_left(&whole));
        assert!(is_left(&whole[..whole.len() - 1]));
        assert!(is_left(&whole[..2000]));
        assert!(is_left(&file(true, 3000)));
        assert!(is_left(&file(true, u32::MAX)));
        let whole = text(5);
        assert!(!is_left(whole.as_bytes()));
        let last_line = whole.rfind('\n').unwrap();
        let without_last = &whole[..last_line];
        assert!(is_left(without_last.as_bytes()));
        assert!(is_left(text(20_000).as_bytes()));
        assert!(is_left(text(5).replace("\n-7\n", "\nx\n").as_bytes()));
        // Elements that share a line, take two, or have no numbers at all.
        assert!(is_left(whole.replace("\n-7\n", "\n-7 ").as_bytes()));
        assert!(is_left(whole.replace("\n-7\n", "\n\n-7\n").as_bytes()));
        assert!(is_left(whole.replacen("\n1 4 ", "\n1\n4 ", 1).as_bytes()));
        assert!(is_left(whole.replace("property short a\n", "").as_bytes()));
        let many = format!("element other {}", u64::MAX);
        assert!(is_left(whole.replace("element other 2", &many).as_bytes()));
        let none = whole.replace("element other 2\nproperty short a", &many);
        assert!(is_left(none.as_bytes()));
    }
}
