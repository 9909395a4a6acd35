//! What a PLY file says of its body before it.

use crate::assets::mesh::error::{MeshError, MeshFault};

/// The form of the body.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Format {
    Ascii,
    Little,
    Big,
}

/// The type of a number.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Number {
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
    pub(super) fn named(name: &[u8]) -> Option<Self> {
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

    pub(super) fn size(self) -> usize {
        match self {
            Self::Char | Self::Uchar => 1,
            Self::Short | Self::Ushort => 2,
            Self::Int | Self::Uint | Self::Float => 4,
            Self::Double => 8,
        }
    }
}

/// The lines before the body.
pub(super) struct Header<'t> {
    pub(super) format: Format,
    pub(super) elements: Vec<Element<'t>>,
    pub(super) length: usize,
}

/// A kind of thing that the body holds `count` times.
pub(super) struct Element<'t> {
    pub(super) name: &'t [u8],
    pub(super) count: u64,
    pub(super) properties: Vec<Property<'t>>,
}

/// A number of an element, or a list of them with a length of type `list`.
pub(super) struct Property<'t> {
    pub(super) name: &'t [u8],
    pub(super) kind: Number,
    pub(super) list: Option<Number>,
}

impl Property<'_> {
    pub(super) fn is_corners(&self) -> bool {
        matches!(self.name, b"vertex_indices" | b"vertex_index")
    }
}

impl Element<'_> {
    /// Finds the place and the type of the number called `name`.
    pub(super) fn scalar(&self, name: &[u8]) -> Option<(usize, Number)> {
        let place = self
            .properties
            .iter()
            .position(|property| property.name == name && property.list.is_none())?;
        Some((place, self.properties[place].kind))
    }

    /// Finds the number called `name` in a binary element without lists: its first byte, and its
    /// type.
    pub(super) fn place(&self, name: &[u8]) -> Option<(usize, Number)> {
        let (place, kind) = self.scalar(name)?;
        Some((self.properties[..place].iter().map(|property| property.kind.size()).sum(), kind))
    }

    /// Counts the least bytes that one takes.
    pub(super) fn least_size(&self, format: Format) -> usize {
        let size = |property: &Property<'_>| match format {
            Format::Ascii => 2,
            _ => property.list.unwrap_or(property.kind).size(),
        };
        self.properties.iter().map(size).sum()
    }
}

impl<'t> Header<'t> {
    pub(super) fn read(bytes: &'t [u8]) -> Result<Self, MeshError> {
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

    pub(super) fn element(&self, name: &str) -> Option<&Element<'t>> {
        self.elements.iter().find(|element| element.name == name.as_bytes())
    }
}
