//! Mesh files into shared vertices and triangles.
//!
//! The readers of the three formats are the project's own. Those that the package registry has
//! allocate for every line or property, trust the counts of the file, or keep vertices apart that
//! are equal.

mod obj;
mod ply;
mod stl;

use std::fmt;

use hashbrown::hash_table::Entry;

use glam::DVec3;

use crate::{
    exact::{
        polygon,
        predicates::is_collinear,
        welding::{PointHasher, PointTable},
    },
    scene::{Dropped, MeshShape, MeshVertices},
};

/// What a mesh file gave.
#[derive(Debug, Clone, PartialEq)]
pub struct MeshFile {
    /// Its faces.
    pub shape: MeshShape,
    /// Faces that were left out.
    pub dropped: Dropped,
}

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
    #[error("it is no STL, OBJ or PLY file")]
    UnknownFormat,
    /// There is nothing to see.
    #[error("it holds no triangles")]
    Empty,
    /// The file ends too early.
    #[error("it ends early: {expected} bytes are announced, {found} are there")]
    Truncated {
        /// Bytes that should be there.
        expected: u64,
        /// Bytes that are.
        found: u64,
    },
    /// The text ends too early.
    #[error("the text ends early")]
    TextEnd,
    /// Something else stands where a finite number should.
    #[error("a finite number should stand here")]
    Number,
    /// An STL facet of other than three vertices.
    #[error("a facet has 3 vertices, not {0}")]
    Facet(u64),
    /// A polygon of less than three corners.
    #[error("a face has 3 corners or more, not {0}")]
    FewCorners(u64),
    /// A polygon that would take too long to cut up.
    #[error("a face that is not convex has at most {most} corners", most = polygon::MOST_CORNERS)]
    ManyCorners,
    /// An index that no vertex has.
    #[error("there is no vertex {index}: the file has {count}")]
    Index {
        /// As the file counts.
        index: i64,
        /// Vertices that the file has.
        count: u64,
    },
    /// More vertices or triangles than indices can tell apart.
    #[error("it has more than {most} vertices or triangles", most = u32::MAX)]
    TooLarge,
    /// A line of a PLY header that cannot be understood.
    #[error("this line of the header cannot be understood")]
    Header,
    /// A PLY file without something that it needs.
    #[error("it has no {0}")]
    Missing(&'static str),
}

impl MeshFault {
    /// The fault at a byte of a text.
    pub(crate) fn at_byte(self, text: &[u8], at: usize) -> MeshError {
        let line = 1 + memchr::memchr_iter(b'\n', &text[..at.min(text.len())]).count();
        MeshError { at: MeshPlace::Line(line), fault: self }
    }

    /// The fault of the file as a whole.
    pub(crate) fn of_file(self) -> MeshError {
        MeshError { at: MeshPlace::File, fault: self }
    }
}

/// Reads the bytes of a mesh file. They tell the format; of OBJ, which has no mark, the name does.
pub fn read_mesh(path: &str, bytes: &[u8]) -> Result<MeshFile, MeshError> {
    let extension = path.rsplit_once('.').map(|(_, extension)| extension.to_ascii_lowercase());
    match extension.as_deref() {
        _ if ply::is_ply(bytes) => ply::read_ply(bytes),
        Some("obj") => obj::read_obj(bytes),
        Some("stl") => stl::read_stl(bytes),
        _ if stl::is_stl(bytes) => stl::read_stl(bytes),
        _ => Err(MeshFault::UnknownFormat.of_file()),
    }
}

/// A mesh that grows: equal vertices become one, triangles without area and copies are dropped.
#[derive(Debug)]
pub(crate) struct MeshBuilder<T> {
    vertices: Vec<[T; 3]>,
    vertex_table: PointTable,
    triangles: Vec<[u32; 3]>,
    dropped: Dropped,
}

impl<T: Copy + Into<f64>> MeshBuilder<T> {
    /// Nothing yet. It may grow to the given sizes without moving; they must not be taken from a
    /// file without a check.
    pub(crate) fn with_capacity(vertices: usize, triangles: usize) -> Self {
        Self {
            vertices: Vec::with_capacity(vertices),
            vertex_table: PointTable::new(PointHasher::new(), vertices),
            triangles: Vec::with_capacity(triangles),
            dropped: Dropped::default(),
        }
    }

    /// The index of the vertex at a finite position, in which no zero is negative.
    pub(crate) fn add_vertex(&mut self, position: [T; 3]) -> Result<u32, MeshFault> {
        let vertices = &self.vertices;
        let bits = |position: &[T; 3]| position.map(|number| number.into().to_bits());
        let bits_at = |index: u32| bits(&vertices[index as usize]);
        match self.vertex_table.entry(bits(&position), bits_at) {
            Entry::Occupied(known) => Ok(*known.get()),
            Entry::Vacant(place) => {
                let index = u32::try_from(vertices.len()).map_err(|_| MeshFault::TooLarge)?;
                place.insert(index);
                self.vertices.push(position);
                Ok(index)
            }
        }
    }

    /// Adds a triangle with corners that [`MeshBuilder::add_vertex`] gave.
    pub(crate) fn add_triangle(&mut self, corners: [u32; 3]) -> Result<(), MeshFault> {
        let [a, b, c] = corners.map(|corner| self.position(corner));
        if is_collinear(a, b, c) {
            self.dropped.zero_area += 1;
            return Ok(());
        }
        if self.triangles.len() == u32::MAX as usize {
            return Err(MeshFault::TooLarge);
        }
        self.triangles.push(corners);
        Ok(())
    }

    /// Adds a polygon cut into triangles.
    pub(crate) fn add_polygon(&mut self, corners: &[u32]) -> Result<(), MeshFault> {
        match *corners {
            [a, b, c] => return self.add_triangle([a, b, c]),
            [] | [_] | [_, _] => return Err(MeshFault::FewCorners(corners.len() as u64)),
            _ => {}
        }
        let points: Vec<DVec3> = corners.iter().map(|&corner| self.position(corner)).collect();
        let mut result = Ok(());
        let is_cut = polygon::triangulate(&points, |triangle| {
            if result.is_ok() {
                result = self.add_triangle(triangle.map(|k| corners[k]));
            }
        });
        if is_cut { result } else { Err(MeshFault::ManyCorners) }
    }

    fn position(&self, index: u32) -> DVec3 {
        DVec3::from(self.vertices[index as usize].map(Into::into))
    }

    /// Drops every triangle that stands there already. Only those of one smallest corner can be
    /// equal, and those are few and near each other: this costs less than a table of all.
    fn drop_copies(&mut self) {
        let triangles = &self.triangles;
        // How many triangles have each smallest corner, then where those begin in `order`.
        let mut starts = vec![0_u32; self.vertices.len() + 1];
        for &triangle in triangles {
            starts[turned(triangle)[0] as usize] += 1;
        }
        let mut sum = 0;
        for start in &mut starts {
            sum += *start;
            *start = sum;
        }
        let mut order = vec![0_u32; triangles.len()];
        for (index, &triangle) in triangles.iter().enumerate().rev() {
            let start = &mut starts[turned(triangle)[0] as usize];
            *start -= 1;
            order[*start as usize] = index as u32;
        }
        let mut copies: Vec<u32> = Vec::new();
        for bounds in starts.windows(2) {
            let group = &mut order[bounds[0] as usize..bounds[1] as usize];
            group.sort_unstable_by_key(|&index| (turned(triangles[index as usize]), index));
            let is_copy = |pair: &&[u32]| {
                turned(triangles[pair[0] as usize]) == turned(triangles[pair[1] as usize])
            };
            copies.extend(group.windows(2).filter(is_copy).map(|pair| pair[1]));
        }
        if copies.is_empty() {
            return;
        }
        self.dropped.duplicates += copies.len() as u64;
        copies.sort_unstable();
        let mut copies = copies.into_iter().peekable();
        let mut index = 0;
        self.triangles.retain(|_| {
            let is_copy = copies.next_if_eq(&index).is_some();
            index += 1;
            !is_copy
        });
    }

    fn finish(
        mut self,
        vertices: impl FnOnce(Vec<[T; 3]>) -> MeshVertices,
    ) -> Result<MeshFile, MeshError> {
        if self.triangles.is_empty() {
            return Err(MeshFault::Empty.of_file());
        }
        self.vertex_table = PointTable::new(PointHasher::new(), 0); // Its memory is needed.
        self.drop_copies();
        let (mut kept, mut triangles) = (self.vertices, self.triangles);
        kept.shrink_to_fit();
        triangles.shrink_to_fit();
        Ok(MeshFile {
            shape: MeshShape { vertices: vertices(kept), triangles },
            dropped: self.dropped,
        })
    }
}

impl MeshBuilder<f32> {
    /// The mesh, unless it is empty.
    pub(crate) fn into_mesh(self) -> Result<MeshFile, MeshError> {
        self.finish(MeshVertices::Single)
    }
}

impl MeshBuilder<f64> {
    /// The mesh, unless it is empty.
    pub(crate) fn into_mesh(self) -> Result<MeshFile, MeshError> {
        self.finish(|vertices| {
            let is_single = |&number: &f64| f64::from(number as f32).to_bits() == number.to_bits();
            if vertices.iter().flatten().all(is_single) {
                MeshVertices::Single(
                    vertices.iter().map(|vertex| vertex.map(|number| number as f32)).collect(),
                )
            } else {
                MeshVertices::Double(vertices)
            }
        })
    }
}

/// A triangle that begins with its smallest index.
fn turned([a, b, c]: [u32; 3]) -> [u32; 3] {
    if a <= b && a <= c {
        [a, b, c]
    } else if b <= c {
        [b, c, a]
    } else {
        [c, a, b]
    }
}
