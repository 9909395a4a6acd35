//! What is wrong with a mesh file, and where.

use std::fmt;

use crate::exact::polygon;

/// Why a mesh file cannot be read, and where.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("{at}{fault}")]
pub struct MeshError {
    /// Where it is.
    pub at: MeshPlace,
    /// What is wrong.
    pub fault: MeshFault,
}

/// A place in a mesh file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MeshPlace {
    /// The file as a whole.
    File,
    /// A line of a text, from 1.
    Line(usize),
    /// A triangle of a binary file, from 0.
    Triangle(u64),
    /// An element of a binary file, from 0.
    Element(&'static str, u64),
}

impl fmt::Display for MeshPlace {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::File => Ok(()),
            Self::Line(line) => write!(f, "line {line}: "),
            Self::Triangle(index) => write!(f, "triangle {index}: "),
            Self::Element(noun, index) => write!(f, "{noun} {index}: "),
        }
    }
}

/// A mistake in a mesh file.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum MeshFault {
    /// Neither its bytes nor its name are those of a format.
    #[error("it is not an STL, OBJ or PLY file")]
    UnknownFormat,
    /// There is nothing to see.
    #[error("it has no triangles")]
    Empty,
    /// The file ends too early.
    #[error("it ends early: its header announces {expected} bytes, but it has {found}")]
    Truncated {
        /// Bytes that should be there.
        expected: u64,
        /// Bytes that are.
        found: u64,
    },
    /// The file ends in the middle of something.
    #[error("the file ends early")]
    EarlyEnd,
    /// Something else stands where a finite number should.
    #[error("expected a finite number")]
    Number,
    /// Something else stands where a whole number should that is not negative.
    #[error("expected a whole number of 0 or more")]
    Whole,
    /// Something else stands where the number of a vertex should.
    #[error("expected the number of a vertex")]
    VertexNumber,
    /// An STL facet of other than three vertices.
    #[error("a facet must have 3 vertices, but this one has {0}")]
    Facet(u64),
    /// A polygon of less than three corners.
    #[error("a face must have 3 or more corners, but this one has {0}")]
    FewCorners(u64),
    /// A polygon that would take too long to cut up.
    #[error("a face that is not convex may have at most {most} corners", most = polygon::MOST_CORNERS)]
    ManyCorners,
    /// An index that no vertex has.
    #[error(
        "there is no vertex {index}; vertices are numbered from {first}, and the file has {count}"
    )]
    Index {
        /// As the file counts.
        index: i64,
        /// The number of vertices that the file has.
        count: u64,
        /// The number of the first vertex.
        first: u8,
    },
    /// More vertices or triangles than indices can tell apart.
    #[error("it has more than {most} vertices or triangles", most = u32::MAX)]
    TooLarge,
    /// A line of a PLY header that cannot be understood.
    #[error("this line is not one of a PLY header")]
    Header,
    /// A PLY file without something that it needs.
    #[error("it has no {0}")]
    Missing(&'static str),
}

impl MeshFault {
    /// Says that the fault is at a byte of a text.
    pub(super) fn at_byte(self, text: &[u8], at: usize) -> MeshError {
        let line = 1 + memchr::memchr_iter(b'\n', &text[..at.min(text.len())]).count();
        MeshError { at: MeshPlace::Line(line), fault: self }
    }

    /// Says that the fault is the whole file's.
    pub(super) fn of_file(self) -> MeshError {
        MeshError { at: MeshPlace::File, fault: self }
    }
}
