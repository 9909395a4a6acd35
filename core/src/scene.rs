//! A scene as its author wrote it, checked: every number is finite, every reference resolves,
//! every shape has the extent that its type promises. Only [`crate::language`] makes one from text;
//! whoever makes one by hand keeps the invariants written at each field.

use std::{fmt, sync::Arc};

use glam::{DVec2, DVec3};

use crate::{tile::Size, transfer::Transfer};

/// A whole scene. Colours are red, green and blue light, 1.0 where the file says 255.
#[derive(Debug, Clone, Default)]
pub struct Scene {
    /// The eye and the screen; a scene without them can be checked but not rendered.
    pub viewport: Option<Viewport>,
    /// The size in pixels that the file asks for.
    pub size_hint: Option<Size>,
    /// The light that is seen where nothing is hit. Components >= 0.
    pub background: DVec3,
    /// Uniform light on everything; `None` where the file defines none. Components >= 0.
    pub ambient: Option<DVec3>,
    /// The point lights in file order.
    pub lights: Vec<Light>,
    /// The materials in file order, names unique.
    pub materials: Vec<Material>,
    /// The images that materials name.
    pub textures: Vec<Texture>,
    /// How their texels become light; all other colours are light already.
    pub transfer: Transfer,
    /// Spheres in file order.
    pub spheres: Vec<Sphere>,
    /// Triangles in file order.
    pub triangles: Vec<Triangle>,
    /// Texture coordinates of the triangles that have some, by ascending index in `triangles`.
    pub triangle_texcoords: Vec<(u32, [DVec2; 3])>,
    /// Quadrangles in file order.
    pub quadrangles: Vec<Quadrangle>,
    /// Texture coordinates of the quadrangles that have some, by ascending index.
    pub quadrangle_texcoords: Vec<(u32, [DVec2; 4])>,
    /// Parallelepipeds that stand alone, in file order.
    pub parallelepipeds: Vec<Parallelepiped>,
    /// Constructive solids, in file order.
    pub solids: Vec<Solid>,
    /// Triangle meshes, in file order.
    pub meshes: Vec<Mesh>,
    /// The faces that the file holds and the scene does not.
    pub dropped: DroppedFaces,
}

impl Scene {
    /// Lists what a picture may need of the tracer, and whether one of this scene does.
    pub fn needs(&self) -> [(&'static str, bool); 9] {
        let any = |holds: fn(&Material) -> bool| self.materials.iter().any(holds);
        [
            ("point lights", !self.lights.is_empty()),
            ("ambient light", self.ambient.is_some()),
            ("mirrors", any(|m| m.reflect > 0.0)),
            ("transparency", any(|m| m.alpha < 1.0)),
            ("refraction", any(|m| m.alpha < 1.0 && m.refract > 0.0 && m.refract != 1.0)),
            ("textures", any(|m| m.texture.is_some())),
            ("constructive solids", !self.solids.is_empty()),
            ("meshes", !self.meshes.is_empty()),
            ("secondary light", any(|m| m.reflect > 0.0) && !self.lights.is_empty()),
        ]
    }
}

/// Counts of the faces that were left out because they cannot be seen or are copies of others.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct DroppedFaces {
    /// The number of triangles of zero area.
    pub zero_area: u64,
    /// The number of exact copies of an earlier triangle: of the same vertices in cyclic order, the
    /// same material and the same texture coordinates.
    pub duplicates: u64,
}

/// A place in a scene's text: line and column, both from 1, the column in characters.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Place {
    /// The line.
    pub line: u32,
    /// The column.
    pub column: u32,
}

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}:{}", self.line, self.column)
    }
}

/// The eye and the screen. The corners are not collinear and the eye is not in their plane.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Viewport {
    /// The point where all camera rays start.
    pub eye: DVec3,
    /// The outer corner of the first pixel of the first row.
    pub top_left: DVec3,
    /// The outer corner of the first pixel of the last row.
    pub bottom_left: DVec3,
    /// The outer corner of the last pixel of the first row.
    pub top_right: DVec3,
}

impl Viewport {
    /// Gives the size of a picture where nobody asked for one: 1280 pixels wide, with square pixels
    /// as nearly as whole rows allow.
    pub fn default_size(&self) -> Size {
        let (left, top) = (self.bottom_left - self.top_left, self.top_right - self.top_left);
        let height = (1280.0 * (left.length() / top.length())).round();
        Size::new(1280, height.clamp(1.0, f64::from(Size::MAX_SIDE)) as u64).expect("clamped")
    }
}

/// A point light.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Light {
    /// The place of the light.
    pub position: DVec3,
    /// The light that a surface facing it receives at distance 1: (power / reference power) ·
    /// reference distance² · colour. Components >= 0.
    pub intensity: DVec3,
}

/// How a surface looks.
#[derive(Debug, Clone, PartialEq)]
pub struct Material {
    /// The name that geometry refers to.
    pub name: String,
    /// The colour of the surface. Components in 0..=1.
    pub color: DVec3,
    /// The opacity: 1 is opaque, 0 is clear.
    pub alpha: f64,
    /// The share of light that is mirrored, 0..=1.
    pub reflect: f64,
    /// The refractive index before the front over that after it, n1/n2, >= 0; 0 does not bend
    /// light.
    pub refract: f64,
    /// The image that multiplies `color`: an index in [`Scene::textures`].
    pub texture: Option<u32>,
}

/// An image on a surface.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Texture {
    /// The path as the scene has it.
    pub path: String,
    /// The number of texels in a row, at least 1.
    pub width: u32,
    /// The number of rows, at least 1.
    pub height: u32,
    /// The texels: red, green and blue as the file has them, `[y][x]`, the top row first.
    pub texels: Vec<[u8; 3]>,
}

/// A sphere; its front is its outside.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sphere {
    /// The centre.
    pub center: DVec3,
    /// The radius, above 0.
    pub radius: f64,
    /// An index in [`Scene::materials`].
    pub material: u32,
    /// The place among all primitives of the file, from 0.
    pub primitive: u32,
}

/// A triangle of an area above zero, counter-clockwise seen from its front.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Triangle {
    /// The corners.
    pub vertices: [DVec3; 3],
    /// An index in [`Scene::materials`].
    pub material: u32,
    /// The place among all primitives of the file, from 0.
    pub primitive: u32,
}

/// A simple quadrangle, convex or not and planar within rounding (the reader says how far),
/// counter-clockwise seen from its front.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Quadrangle {
    /// The corners.
    pub vertices: [DVec3; 4],
    /// An index in [`Scene::materials`].
    pub material: u32,
    /// The place among all primitives of the file, from 0.
    pub primitive: u32,
}

/// A parallelepiped of a volume above zero; its front is its outside.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Parallelepiped {
    /// A corner.
    pub corner: DVec3,
    /// The edges from the corner to its three neighbours.
    pub edges: [DVec3; 3],
    /// An index in [`Scene::materials`].
    pub material: u32,
    /// The place among all primitives of the file, from 0.
    pub primitive: u32,
}

/// A constructive solid: its nodes in postfix order, so that operands come before the operation
/// that joins them and the last node is the root.
#[derive(Debug, Clone, PartialEq)]
pub struct Solid {
    /// The nodes in postfix order.
    pub nodes: Vec<SolidNode>,
    /// The place among all primitives of the file, from 0.
    pub primitive: u32,
}

/// A node of a constructive solid. The `primitive` of a leaf is its place within the solid.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum SolidNode {
    /// A leaf.
    Sphere(Sphere),
    /// A leaf.
    Parallelepiped(Parallelepiped),
    /// Joins the last `operands` (>= 2) results.
    Operation {
        /// The operation.
        operation: Operation,
        /// The number of results that it joins.
        operands: u32,
    },
}

/// A set operation; `Difference` is the first operand less all others.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Operation {
    /// What is in any operand.
    Union,
    /// What is in all operands.
    Intersection,
    /// What is in the first operand and in no other.
    Difference,
}

/// A triangle mesh from a file, with the transform that the scene asks for. The file's own
/// numbers are kept.
#[derive(Debug, Clone, PartialEq)]
pub struct Mesh {
    /// The path as the scene has it.
    pub path: String,
    /// The mesh before the transform. All meshes of one file share it.
    pub shape: Arc<MeshShape>,
    /// The factor that is applied first, above 0.
    pub scale: f64,
    /// The rotation that is applied second: an axis, not zero, and an angle in degrees,
    /// right-handed.
    pub rotate: Option<(DVec3, f64)>,
    /// The translation that is applied last.
    pub offset: DVec3,
    /// An index in [`Scene::materials`].
    pub material: u32,
    /// The place among all primitives of the file, from 0.
    pub primitive: u32,
}

/// The faces of a mesh file.
#[derive(Debug, Clone, PartialEq)]
pub struct MeshShape {
    /// The corners that triangles share, no two in one place.
    pub vertices: MeshVertices,
    /// Triangles as indices of corners, counter-clockwise seen from the front. There is at least
    /// one; each has an area above zero and is there only once.
    pub triangles: Vec<[u32; 3]>,
}

/// A mesh's corners in the precision of its file.
#[derive(Debug, Clone, PartialEq)]
pub enum MeshVertices {
    /// Every coordinate fits in f32 exactly.
    Single(Vec<[f32; 3]>),
    /// Some coordinates do not.
    Double(Vec<[f64; 3]>),
}
