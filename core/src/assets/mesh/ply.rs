//! PLY files, ASCII and binary in both byte orders: the vertices' x, y, z and the faces' lists of
//! vertices; all else is skipped. Source: Turk, "The PLY Polygon File Format" (1994).

use rayon::prelude::*;

use super::{
    builder::{MeshBuilder, MeshFaces, MeshFile},
    error::{MeshError, MeshFault, MeshPlace},
};
use crate::text::{
    bytes::{Class, class},
    number::scan_number_without_comment,
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
            None => read_elements(&header, bytes, expected, single)?.into_mesh(),
        }
    } else {
        let double = |number: f64| number + 0.0;
        match read_in_pieces(&header, bytes, double) {
            Some(mesh) => mesh.into_mesh(),
            None => read_elements(&header, bytes, expected, double)?.into_mesh(),
        }
    }
}

/// A thread reads so many faces in one go.
const FACES_AT_ONCE: usize = 1 << 14;

/// Reads a binary file on rayon's threads: vertices of a fixed size, then faces. `None` where the
/// file has another order, and where something is wrong.
fn read_in_pieces<T: Copy + Into<f64> + Send + Sync>(
    header: &Header<'_>,
    bytes: &[u8],
    convert: impl Fn(f64) -> T + Sync,
) -> Option<MeshBuilder<T>> {
    if header.format == Format::Ascii {
        return None;
    }
    let mut body = Body { bytes, at: header.length, format: header.format };
    let (mut mesh, mut numbers) = (MeshBuilder::with_capacity(0, 0), None);
    for (place, element) in header.elements.iter().enumerate() {
        match element.name {
            b"vertex" if numbers.is_none() => {
                let vertices = body.skip(element)?;
                let places = [b"x", b"y", b"z"].map(|name| element.place(name));
                let [Some(x), Some(y), Some(z)] = places else { return None };
                let size = element.least_size(header.format);
                let position = |vertex: &[u8]| {
                    [x, y, z].map(|(at, kind)| {
                        let mut body = Body { bytes: vertex, at, format: header.format };
                        convert(body.number(kind).unwrap_or(f64::NAN))
                    })
                };
                let positions: Vec<[T; 3]> =
                    vertices.par_chunks_exact(size).map(position).collect();
                let is_finite = |&number: &T| number.into().is_finite();
                if !positions.par_iter().all(|position| position.iter().all(is_finite)) {
                    return None;
                }
                numbers = Some(mesh.add_vertices(positions).ok()?);
            }
            b"face" if place + 1 == header.elements.len() => {
                let numbers = numbers.as_deref()?;
                let pieces = body.cut(element)?;
                let read = |&(start, count): &(usize, usize)| {
                    let mut body = Body { bytes, at: start, format: header.format };
                    body.read_faces(element, count, numbers, mesh.vertices())
                };
                let faces = pieces.par_iter().map(read).collect::<Option<_>>()?;
                mesh.take_faces(faces).ok()?;
                return Some(mesh);
            }
            b"vertex" | b"face" => return None,
            _ => _ = body.skip(element)?,
        }
    }
    None
}

/// Reads a file element by element; it may hold `expected` vertices.
fn read_elements<T: Copy + Into<f64>>(
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

/// The form of the body.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Format {
    Ascii,
    Little,
    Big,
}

/// The type of a number.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Number {
    Char,
    Uchar,
    Short,
    Ushort,
    Int,
    Uint,
    Float,
    Double,
}

impl Number {
    fn named(name: &[u8]) -> Option<Self> {
        Some(match name {
            b"char" | b"int8" => Self::Char,
            b"uchar" | b"uint8" => Self::Uchar,
            b"short" | b"int16" => Self::Short,
            b"ushort" | b"uint16" => Self::Ushort,
            b"int" | b"int32" => Self::Int,
            b"uint" | b"uint32" => Self::Uint,
            b"float" | b"float32" => Self::Float,
            b"double" | b"float64" => Self::Double,
            _ => return None,
        })
    }

    fn size(self) -> usize {
        match self {
            Self::Char | Self::Uchar => 1,
            Self::Short | Self::Ushort => 2,
            Self::Int | Self::Uint | Self::Float => 4,
            Self::Double => 8,
        }
    }
}

/// The lines before the body.
struct Header<'t> {
    format: Format,
    elements: Vec<Element<'t>>,
    length: usize,
}

/// A kind of thing that the body holds `count` times.
struct Element<'t> {
    name: &'t [u8],
    count: u64,
    properties: Vec<Property<'t>>,
}

/// A number of an element, or a list of them with a length of type `list`.
struct Property<'t> {
    name: &'t [u8],
    kind: Number,
    list: Option<Number>,
}

impl Property<'_> {
    fn is_corners(&self) -> bool {
        matches!(self.name, b"vertex_indices" | b"vertex_index")
    }
}

impl Element<'_> {
    /// Finds the place and the type of the number called `name`.
    fn scalar(&self, name: &[u8]) -> Option<(usize, Number)> {
        let place = self
            .properties
            .iter()
            .position(|property| property.name == name && property.list.is_none())?;
        Some((place, self.properties[place].kind))
    }

    /// Finds the number called `name` in a binary element without lists: its first byte, and its
    /// type.
    fn place(&self, name: &[u8]) -> Option<(usize, Number)> {
        let (place, kind) = self.scalar(name)?;
        Some((self.properties[..place].iter().map(|property| property.kind.size()).sum(), kind))
    }

    /// Counts the least bytes that one takes.
    fn least_size(&self, format: Format) -> usize {
        let size = |property: &Property<'_>| match format {
            Format::Ascii => 2,
            _ => property.list.unwrap_or(property.kind).size(),
        };
        self.properties.iter().map(size).sum()
    }
}

impl<'t> Header<'t> {
    fn read(bytes: &'t [u8]) -> Result<Self, MeshError> {
        let mut format = None;
        let mut elements: Vec<Element<'t>> = Vec::new();
        let mut at = 0;
        loop {
            let rest = &bytes[at..];
            let Some(end) = memchr::memchr(b'\n', rest) else {
                return Err(MeshFault::Missing("`end_header`").of_file());
            };
            let fault = || MeshFault::Header.at_byte(bytes, at);
            let mut words =
                rest[..end].split(u8::is_ascii_whitespace).filter(|word| !word.is_empty());
            let mut word = || words.next().unwrap_or_default();
            match word() {
                b"" | b"ply" | b"comment" | b"obj_info" => {}
                b"format" => {
                    format = Some(match word() {
                        b"ascii" => Format::Ascii,
                        b"binary_little_endian" => Format::Little,
                        b"binary_big_endian" => Format::Big,
                        _ => return Err(fault()),
                    });
                }
                b"element" => {
                    let name = word();
                    let count =
                        std::str::from_utf8(word()).ok().and_then(|count| count.parse().ok());
                    let count = count.ok_or_else(fault)?;
                    elements.push(Element { name, count, properties: Vec::new() });
                }
                b"property" => {
                    let element = elements.last_mut().ok_or_else(fault)?;
                    let (list, kind) = match word() {
                        b"list" => (Some(Number::named(word()).ok_or_else(fault)?), word()),
                        kind => (None, kind),
                    };
                    let kind = Number::named(kind).ok_or_else(fault)?;
                    element.properties.push(Property { name: word(), kind, list });
                }
                b"end_header" => {
                    let format = format.ok_or(MeshFault::Missing("`format`").of_file())?;
                    return Ok(Self { format, elements, length: at + end + 1 });
                }
                _ => return Err(fault()),
            }
            at += end + 1;
        }
    }

    fn element(&self, name: &str) -> Option<&Element<'t>> {
        self.elements.iter().find(|element| element.name == name.as_bytes())
    }
}

/// Reads along the body.
struct Body<'t> {
    bytes: &'t [u8],
    at: usize,
    format: Format,
}

impl<'t> Body<'t> {
    /// Goes past binary elements without lists; these are their bytes.
    fn skip(&mut self, element: &Element<'_>) -> Option<&'t [u8]> {
        if element.properties.iter().any(|property| property.list.is_some()) {
            return None;
        }
        let length = usize::try_from(element.count).ok()?;
        let length = length.checked_mul(element.least_size(self.format))?;
        let (elements, _) = self.bytes.get(self.at..)?.split_at_checked(length)?;
        self.at += length;
        Some(elements)
    }

    /// Goes past binary faces; where each run of them begins, and how many it has.
    fn cut(&mut self, element: &Element<'_>) -> Option<Vec<(usize, usize)>> {
        let mut runs = Vec::new();
        let mut left = usize::try_from(element.count).ok()?;
        while left > 0 {
            let count = left.min(FACES_AT_ONCE);
            runs.push((self.at, count));
            for _ in 0..count {
                for property in &element.properties {
                    let length = match property.list {
                        Some(Number::Uchar) => {
                            self.at += 1;
                            usize::from(*self.bytes.get(self.at - 1)?)
                        }
                        Some(kind) => self.whole(kind).ok()? as usize,
                        None => 1,
                    };
                    self.at = self.at.checked_add(length.checked_mul(property.kind.size())?)?;
                }
                if self.at > self.bytes.len() {
                    return None;
                }
            }
            left -= count;
        }
        Some(runs)
    }

    /// Reads so many binary faces, with corners among the file's vertices, which are `numbers`
    /// among `vertices`.
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
                        for _ in 0..self.whole(length).ok()? {
                            let index = self.whole(property.kind).ok()? as usize;
                            corners.push(*numbers.get(index)?);
                        }
                    }
                    Some(length) => {
                        self.at += self.whole(length).ok()? as usize * property.kind.size();
                    }
                    None => self.at += property.kind.size(),
                }
            }
            faces.add_polygon(vertices, &corners).ok()?;
        }
        Some(faces)
    }

    /// Checks before the first element that the file is long enough for all.
    fn check_left(&self, element: &Element<'_>, index: u64) -> Result<(), MeshError> {
        if index == 0 {
            let left = (self.bytes.len() - self.at) as u64;
            // The last number of a text needs no space after it.
            let least = element
                .count
                .saturating_mul(element.least_size(self.format) as u64)
                .saturating_sub(1);
            if element.properties.is_empty() && element.count > 0 {
                return Err(MeshFault::Missing("properties for one of its elements").of_file());
            }
            if least > left {
                let expected = least.saturating_add(self.at as u64);
                return Err(
                    MeshFault::Truncated { expected, found: self.bytes.len() as u64 }.of_file()
                );
            }
        }
        Ok(())
    }

    fn number(&mut self, kind: Number) -> Result<f64, MeshFault> {
        if self.format == Format::Ascii {
            return self.ascii_number(kind);
        }
        let end = self.at + kind.size();
        let bytes = self.bytes.get(self.at..end).ok_or(MeshFault::EarlyEnd)?;
        self.at = end;
        let is_little = self.format == Format::Little;
        macro_rules! number {
            ($type:ty) => {{
                let bytes = bytes.try_into().expect("the slice has the number's size");
                f64::from(if is_little {
                    <$type>::from_le_bytes(bytes)
                } else {
                    <$type>::from_be_bytes(bytes)
                })
            }};
        }
        Ok(match kind {
            Number::Char => number!(i8),
            Number::Uchar => number!(u8),
            Number::Short => number!(i16),
            Number::Ushort => number!(u16),
            Number::Int => number!(i32),
            Number::Uint => number!(u32),
            Number::Float => number!(f32),
            Number::Double => number!(f64),
        })
    }

    /// Goes to the next word of a text.
    fn skip_space(&mut self) {
        while self.format == Format::Ascii
            && self.bytes.get(self.at).is_some_and(|&byte| class(byte) == Class::Space)
        {
            self.at += 1;
        }
    }

    fn ascii_number(&mut self, kind: Number) -> Result<f64, MeshFault> {
        self.skip_space();
        let start = self.at;
        if start == self.bytes.len() {
            return Err(MeshFault::EarlyEnd);
        }
        let number =
            scan_number_without_comment(self.bytes, &mut self.at).ok_or(MeshFault::Number)?;
        if kind == Number::Float {
            // Rounded once, from the digits.
            let single: f32 =
                fast_float2::parse(&self.bytes[start..self.at]).map_err(|_| MeshFault::Number)?;
            return Ok(f64::from(single));
        }
        Ok(number)
    }

    /// A number that is not negative and has no fraction.
    fn whole(&mut self, kind: Number) -> Result<i64, MeshFault> {
        let number = self.number(kind)?;
        let whole = number as i64;
        if number >= 0.0 && whole as f64 == number && number < 1e15 {
            Ok(whole)
        } else {
            Err(MeshFault::Whole)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A binary file with vertices of numbers besides, equal ones among them, and faces of three
    /// and more corners, some of them copies.
    fn file(is_little: bool, last_corner: u32) -> Vec<u8> {
        const VERTICES: u32 = 3000;
        const FACES: u32 = 2 * FACES_AT_ONCE as u32 + 5;
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

    #[test]
    fn pieces_give_what_the_whole_gives() {
        let double = |number: f64| number + 0.0;
        for is_little in [true, false] {
            let bytes = file(is_little, 5);
            let header = Header::read(&bytes).unwrap();
            let expected = read_elements(&header, &bytes, 0, double).unwrap().into_mesh().unwrap();
            assert!(expected.shape.triangles.len() > 2000 && expected.dropped.duplicates > 0);
            let found = read_in_pieces(&header, &bytes, double).unwrap().into_mesh().unwrap();
            assert!(found == expected, "little: {is_little}");
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
    }
}
