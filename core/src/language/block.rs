//! The blocks of a scene text: which words open and end them, and what they hold.

use super::lexer::{Quotes, Word};

/// A kind of block.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Block {
    File,
    Viewport,
    Screen,
    Materials,
    Entry,
    Lights,
    Reference,
    Point,
    Geometry,
    Sphere,
    Triangle,
    Quadrangle,
    Parallelepiped,
    Union,
    Intersection,
    Difference,
    Mesh,
    StlModel,
}

/// The blocks that a word opens: all but the file.
pub(super) const OPENED: [Block; 17] = [
    Block::Viewport,
    Block::Screen,
    Block::Materials,
    Block::Entry,
    Block::Lights,
    Block::Reference,
    Block::Point,
    Block::Geometry,
    Block::Sphere,
    Block::Triangle,
    Block::Quadrangle,
    Block::Parallelepiped,
    Block::Union,
    Block::Intersection,
    Block::Difference,
    Block::Mesh,
    Block::StlModel,
];

impl Block {
    /// Gives the word that opens it; the file has an empty one.
    pub(super) fn word(self) -> &'static str {
        self.end().strip_prefix("end").unwrap_or("")
    }

    /// Gives the word that ends it; the file has an empty one.
    pub(super) fn end(self) -> &'static str {
        match self {
            Self::File => "",
            Self::Viewport => "endviewport",
            Self::Screen => "endscreen",
            Self::Materials => "endmaterials",
            Self::Entry => "endentry",
            Self::Lights => "endlights",
            Self::Reference => "endreference",
            Self::Point => "endpoint",
            Self::Geometry => "endgeometry",
            Self::Sphere => "endsphere",
            Self::Triangle => "endtriangle",
            Self::Quadrangle => "endquadrangle",
            Self::Parallelepiped => "endparallelepiped",
            Self::Union => "endunion",
            Self::Intersection => "endintersection",
            Self::Difference => "enddifference",
            Self::Mesh => "endmesh",
            Self::StlModel => "endstlmodel",
        }
    }

    /// Lists the words that it may hold besides blocks, synonyms included.
    pub(super) fn fields(self) -> &'static [&'static str] {
        const SCREEN: &[&str] = &[
            "topleft",
            "bottomleft",
            "topright",
            "size",
            "background",
            "resolution",
            "xres",
            "yres",
            "origin",
        ];
        match self {
            Self::File => &["background", "resolution", "xres", "yres"],
            Self::Viewport | Self::Screen => SCREEN,
            Self::Materials
            | Self::Geometry
            | Self::Union
            | Self::Intersection
            | Self::Difference => &[],
            Self::Entry => &[
                "name",
                "color",
                "alpha",
                "reflect",
                "refract",
                "texture",
                "image",
                "specular",
                "shininess",
            ],
            Self::Lights => &["ambient", "backlight"],
            Self::Reference => &["power", "distance"],
            Self::Point => &["coords", "power", "color", "position"],
            Self::Sphere => &["coords", "radius", "material", "position"],
            Self::Triangle | Self::Quadrangle => {
                &["vertex", "material", "texcoord", "textureCoord"]
            }
            Self::Parallelepiped => &["vertex", "material"],
            Self::Mesh | Self::StlModel => {
                &["file", "material", "scale", "rotate", "move", "filename"]
            }
        }
    }

    /// Whether a word is one of its fields.
    pub(super) fn has_field(self, word: &[u8]) -> bool {
        self.fields().iter().any(|field| field.as_bytes() == word)
    }

    /// Whether it holds fields only.
    pub(super) fn is_leaf(self) -> bool {
        !self.is_operation()
            && !matches!(
                self,
                Self::File | Self::Viewport | Self::Materials | Self::Lights | Self::Geometry
            )
    }

    /// Whether it joins solids.
    pub(super) fn is_operation(self) -> bool {
        matches!(self, Self::Union | Self::Intersection | Self::Difference)
    }

    /// Whether `outer` may hold it directly.
    pub(super) fn is_allowed_in(self, outer: Self) -> bool {
        match self {
            Self::File => false,
            Self::Viewport | Self::Materials | Self::Lights | Self::Geometry => outer == Self::File,
            Self::Screen => outer == Self::Viewport,
            Self::Entry => outer == Self::Materials,
            Self::Reference | Self::Point => outer == Self::Lights,
            // Flat shapes may not, but whoever reads the operation says so better.
            _ => outer == Self::Geometry || outer.is_operation(),
        }
    }

    /// Names the block that holds it, for messages.
    pub(super) fn home(self) -> &'static str {
        match self {
            Self::File | Self::Viewport | Self::Materials | Self::Lights | Self::Geometry => {
                "the file itself"
            }
            Self::Screen => "`viewport`",
            Self::Entry => "`materials`",
            Self::Reference | Self::Point => "`lights`",
            _ => "`geometry`",
        }
    }

    /// Finds the block that `word` opens.
    pub(super) fn opened_by(word: &Word<'_>) -> Option<Self> {
        let block = match word.bytes {
            b"viewport" => Self::Viewport,
            b"screen" => Self::Screen,
            b"materials" => Self::Materials,
            b"entry" => Self::Entry,
            b"lights" => Self::Lights,
            b"reference" => Self::Reference,
            b"point" => Self::Point,
            b"geometry" => Self::Geometry,
            b"sphere" => Self::Sphere,
            b"triangle" => Self::Triangle,
            b"quadrangle" => Self::Quadrangle,
            b"parallelepiped" => Self::Parallelepiped,
            b"union" => Self::Union,
            b"intersection" => Self::Intersection,
            b"difference" => Self::Difference,
            b"mesh" => Self::Mesh,
            b"stlmodel" => Self::StlModel,
            _ => return None,
        };
        (word.quotes == Quotes::Bare).then_some(block)
    }

    /// Finds the block that `word` ends.
    pub(super) fn ended_by(word: &Word<'_>) -> Option<Self> {
        Self::opened_by(&Word { bytes: word.bytes.strip_prefix(b"end")?, ..*word })
    }
}

/// Whether `word` is a keyword anywhere in the language.
pub(super) fn is_keyword(word: &Word<'_>) -> bool {
    Block::opened_by(word).is_some()
        || Block::ended_by(word).is_some()
        || (word.quotes == Quotes::Bare
            && OPENED
                .iter()
                .any(|block| block.fields().iter().any(|field| field.as_bytes() == word.bytes)))
}
