//! PLY files, ASCII and binary in both byte orders: the vertices' x, y, z and the faces' lists of
//! vertices; all else is skipped. Source: Turk, "The PLY Polygon File Format" (1994).

use super::{
    builder::{MeshBuilder, MeshFile},
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
        read_elements(&header, bytes, MeshBuilder::with_capacity(expected, 0), single)?.into_mesh()
    } else {
        let double = |number: f64| number + 0.0;
        read_elements(&header, bytes, MeshBuilder::with_capacity(expected, 0), double)?.into_mesh()
    }
}

fn read_elements<T: Copy + Into<f64>>(
    header: &Header<'_>,
    bytes: &[u8],
    mut mesh: MeshBuilder<T>,
    convert: impl Fn(f64) -> T,
) -> Result<MeshBuilder<T>, MeshError> {
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

impl Body<'_> {
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
        if number >= 0.0 && number.fract() == 0.0 && number < 1e15 {
            Ok(number as i64)
        } else {
            Err(MeshFault::Whole)
        }
    }
}
