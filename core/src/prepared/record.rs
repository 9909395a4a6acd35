//! The records that a prepared scene is made of.

use std::ops::Range;

use glam::{DVec2, DVec3};

use super::node::Frame;
use crate::{exact::float::power_of_two_below_inverse, left_out, transfer::Transfer};

/// The features of the tracer that the scene needs; each is 1 or 0.
#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C)]
pub(crate) struct Features {
    /// The scene defines light; else it shows plain colours.
    pub(crate) is_lit: u32,
    /// Something mirrors or lets light through.
    pub(crate) has_branches: u32,
    /// A shadow may let light through.
    pub(crate) has_clear_shadows: u32,
    /// There are constructive solids.
    pub(crate) has_solids: u32,
    /// Faces send light on to others.
    pub(crate) has_emitters: u32,
    /// A face shows an image.
    pub(crate) has_textures: u32,
    /// The images' finest levels are encoded by the sRGB curve.
    pub(crate) has_srgb_texels: u32,
    pub(crate) padding: u32,
}

impl Features {
    pub(crate) fn has_branches(&self) -> bool {
        self.has_branches == 1
    }

    pub(crate) fn has_clear_shadows(&self) -> bool {
        self.has_clear_shadows == 1 && !left_out::TRANSPARENCY
    }

    pub(crate) fn has_emitters(&self) -> bool {
        self.has_emitters == 1 && !left_out::SECONDARY_LIGHT
    }

    pub(crate) fn has_textures(&self) -> bool {
        self.has_textures == 1 && !left_out::TEXTURE
    }

    pub(crate) fn texel_transfer(&self) -> Transfer {
        if self.has_srgb_texels == 1 { Transfer::Srgb } else { Transfer::None }
    }
}

/// Light that comes from everywhere.
#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C)]
pub(crate) struct Lighting {
    pub(crate) background: [f64; 3],
    pub(crate) ambient: [f64; 3],
}

impl Lighting {
    /// The light that a surface receives before any lamp is asked.
    pub(crate) fn ambient(&self) -> DVec3 {
        if left_out::AMBIENT { DVec3::ZERO } else { DVec3::from_array(self.ambient) }
    }
}

/// The eye and the screen as seen from it. The screen only gives directions, so it has a scale of
/// its own: one that is nothing beside the scene still does not underflow.
#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C)]
pub(crate) struct Camera {
    pub(crate) eye: [f64; 3],
    /// This vector leads from the eye to the screen's top left corner.
    pub(crate) top_left: [f64; 3],
    /// This vector leads from the top left corner to the top right one.
    pub(crate) right: [f64; 3],
    /// This vector leads from the top left corner to the bottom left one.
    pub(crate) down: [f64; 3],
}

impl Camera {
    /// The same camera with a screen whose largest coordinate is in 0.5..1.
    pub(super) fn with_screen_of_one(self) -> Self {
        let screen = [self.top_left, self.right, self.down].map(DVec3::from_array);
        let largest =
            screen.map(|vector| vector.abs().max_element()).into_iter().fold(0.0, f64::max);
        let scale = power_of_two_below_inverse(largest);
        let [top_left, right, down] = screen.map(|vector| (vector * scale).to_array());
        Self { top_left, right, down, ..self }
    }
}

/// A surface, for leaving it: all faces in exactly one plane, all equal spheres, or else one face.
/// (A ray that starts in a plane never meets that plane again.)
#[derive(Debug, Clone, Copy, PartialEq, Eq, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(transparent)]
pub(crate) struct Surface(pub(crate) u32);

impl Surface {
    /// A ray that starts in free space.
    pub(crate) const NONE: Self = Self(u32::MAX);
}

/// A face in the prepared scene: its kind in the upper 3 bits, its index below: that of a triangle
/// in the section `faces`, that of all others among their kind.
#[derive(Debug, Clone, Copy, PartialEq, Eq, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(transparent)]
pub(crate) struct Item(u32);

/// The kinds of faces.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Kind {
    /// A triangle that is alone in its plane.
    Triangle = 0,
    /// A triangle that shares its plane with other faces.
    Coplanar = 1,
    /// A quadrangle.
    Quadrangle = 2,
    /// A sphere.
    Sphere = 3,
    /// A constructive solid.
    Solid = 4,
}

impl Item {
    /// No face.
    pub(crate) const NONE: Self = Self(u32::MAX);
    /// How many faces of one kind a scene may have.
    pub(super) const LIMIT: usize = 1 << 29;
    /// The bits of the index.
    const INDEX: u32 = Self::LIMIT as u32 - 1;

    /// A face of the given kind.
    pub(crate) fn new(kind: Kind, index: usize) -> Self {
        debug_assert!(index < Self::LIMIT);
        Self((kind as u32) << 29 | index as u32)
    }

    /// The kind; `None` for bits that no kind has.
    #[inline(always)]
    pub(crate) fn kind(self) -> Option<Kind> {
        match self.0 >> 29 {
            0 => Some(Kind::Triangle),
            1 => Some(Kind::Coplanar),
            2 => Some(Kind::Quadrangle),
            3 => Some(Kind::Sphere),
            4 if !left_out::SOLID => Some(Kind::Solid),
            _ => None,
        }
    }

    /// The index among the faces of its kind.
    #[inline(always)]
    pub(crate) fn index(self) -> usize {
        (self.0 & Self::INDEX) as usize
    }
}

/// An item of the hierarchy, in the order of its leaves: a triangle itself, or where another item's
/// record is.
#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C)]
pub(crate) struct FaceRecord {
    /// The vertices of a triangle. Of another item the first is its index among its kind.
    pub(crate) vertices: [u32; 3],
    /// The kind in the upper 3 bits, the rank of a triangle below.
    kind_and_rank: u32,
    /// The material of a triangle that is alone in its plane, the index of a coplanar one's coat.
    coat: u32,
}

impl FaceRecord {
    /// A triangle that is alone in its plane.
    pub(crate) fn triangle(vertices: [u32; 3], material: u32, rank: u32) -> Self {
        Self { vertices, kind_and_rank: Item::new(Kind::Triangle, rank as usize).0, coat: material }
    }

    /// A triangle that shares its plane, with the index of its coat.
    pub(crate) fn coplanar(vertices: [u32; 3], coat: u32, rank: u32) -> Self {
        Self { vertices, kind_and_rank: Item::new(Kind::Coplanar, rank as usize).0, coat }
    }

    /// An item of another kind.
    pub(crate) fn of(kind: Kind, index: usize) -> Self {
        let vertices = [index as u32, 0, 0];
        Self { vertices, kind_and_rank: Item::new(kind, 0).0, coat: 0 }
    }

    /// The item at this place in the section `faces`.
    #[inline(always)]
    pub(crate) fn item(&self, place: usize) -> Item {
        let index = if self.is_triangle() { place as u32 } else { self.vertices[0] };
        Item(self.kind_and_rank & !Item::INDEX | index)
    }

    /// Whether it is a triangle, alone in its plane or not.
    #[inline(always)]
    pub(crate) fn is_triangle(&self) -> bool {
        self.kind_and_rank >> 29 <= Kind::Coplanar as u32
    }

    /// The vertices of a triangle, to be changed; `None` for another item.
    pub(crate) fn triangle_vertices(&mut self) -> Option<&mut [u32; 3]> {
        self.is_triangle().then_some(&mut self.vertices)
    }

    /// The rank of a triangle.
    #[inline(always)]
    pub(crate) fn rank(&self) -> u32 {
        self.kind_and_rank & Item::INDEX
    }

    /// The material of a triangle that is alone in its plane.
    #[inline(always)]
    pub(crate) fn material(&self) -> u32 {
        self.coat
    }

    /// The index of a coplanar triangle's coat.
    #[inline(always)]
    pub(crate) fn coat(&self) -> usize {
        self.coat as usize
    }
}

/// The plane and the material of triangles that share their plane with other faces.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C)]
pub(crate) struct Coat {
    pub(crate) plane: PlaneIndex,
    pub(crate) material: u32,
}

/// A quadrangle. Its plane is recorded even where no other face shares it.
#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C)]
pub(crate) struct QuadrangleRecord {
    pub(crate) vertices: [u32; 4],
    pub(crate) material: u32,
    pub(crate) rank: u32,
    pub(crate) plane: PlaneIndex,
    padding: u32,
}

impl QuadrangleRecord {
    pub(crate) fn new(vertices: [u32; 4], material: u32, rank: u32, plane: PlaneIndex) -> Self {
        Self { vertices, material, rank, plane, padding: 0 }
    }
}

/// A sphere that is no part of a solid.
#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C)]
pub(crate) struct SphereRecord {
    pub(crate) center: [f64; 3],
    pub(crate) radius: f64,
    pub(crate) material: u32,
    pub(crate) rank: u32,
    /// Equal spheres have one surface: the rank of one of them.
    pub(crate) surface: u32,
    padding: u32,
}

impl SphereRecord {
    /// A sphere with a surface of its own.
    pub(crate) fn new(center: DVec3, radius: f64, material: u32, rank: u32) -> Self {
        Self { center: center.to_array(), radius, material, rank, surface: rank, padding: 0 }
    }
}

/// A constructive solid: runs of nodes and of leaves, and a hierarchy over the leaves.
#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C)]
pub(crate) struct SolidRecord {
    /// The frame of the hierarchy's boxes: its origin is the middle of the solid, and 1 / `scale`
    /// is its size, within a factor of 2.
    pub(crate) frame: Frame,
    /// The boxes of the leaves are larger by this on every side: what a ray passes by farther off
    /// changes nothing.
    pub(crate) margin: f64,
    /// No crossing of a leaf is in doubt by more than this, which is an eighth of the margin at
    /// most.
    pub(crate) most_doubt: f64,
    first_node: u32,
    node_count: u32,
    first_leaf: u32,
    leaf_count: u32,
    /// The root of its hierarchy in the section `solid_boxes`.
    pub(crate) first_box: u32,
    /// The rank of its first leaf's first face; each leaf has six.
    pub(super) rank: u32,
}

impl SolidRecord {
    /// A solid with a run of nodes, a run of leaves and the rank of its first face, still without
    /// a hierarchy.
    pub(crate) fn new(nodes: Range<usize>, leaves: Range<usize>, rank: u32) -> Self {
        Self {
            frame: Frame { origin: [0.0; 3], scale: 1.0 },
            margin: 0.0,
            most_doubt: 0.0,
            first_node: nodes.start as u32,
            node_count: nodes.len() as u32,
            first_leaf: leaves.start as u32,
            leaf_count: leaves.len() as u32,
            first_box: 0,
            rank,
        }
    }

    /// The run of its nodes.
    pub(crate) fn nodes(&self) -> Range<usize> {
        self.first_node as usize..self.first_node as usize + self.node_count as usize
    }

    /// The run of its leaves.
    pub(crate) fn leaves(&self) -> Range<usize> {
        self.first_leaf as usize..self.first_leaf as usize + self.leaf_count as usize
    }
}

/// The kind of a node in a solid's tree: a leaf, or the operation that joins its operands. Numbers
/// that name no kind are refused when a block is opened.
#[derive(Debug, Clone, Copy, PartialEq, Eq, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(transparent)]
pub(crate) struct SolidNodeKind(u32);

impl SolidNodeKind {
    /// What is in any operand.
    pub(crate) const UNION: Self = Self(0);
    /// What is in all operands.
    pub(crate) const INTERSECTION: Self = Self(1);
    /// What is in the first operand and in no other.
    pub(crate) const DIFFERENCE: Self = Self(2);
    /// A leaf has no operands.
    pub(crate) const LEAF: Self = Self(3);

    /// Whether it is one of the operations.
    pub(super) fn is_operation(self) -> bool {
        matches!(self, Self::UNION | Self::INTERSECTION | Self::DIFFERENCE)
    }
}

/// The index that stands where there is no node.
pub(crate) const NO_NODE: u32 = u32::MAX;

/// A node of a solid's tree. Nodes stand in postfix order and leaves in file order, so a node's
/// subtree is the run that ends with it. Indices count from the solid's first node.
#[derive(Debug, Clone, Copy, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C)]
pub(crate) struct SolidNodeRecord {
    pub(crate) kind: SolidNodeKind,
    /// An operation has so many operands; a leaf has none.
    pub(crate) operands: u32,
    /// The first operand of an operation, the number of a leaf.
    pub(crate) first_child: u32,
    /// The root has none: [`NO_NODE`].
    pub(crate) parent: u32,
    /// An ancestor farther up, so that few steps lead to any ancestor; the root's is itself.
    pub(crate) jump: u32,
    /// The nearest ancestor of which nothing is left if this node is all that is there below it,
    /// or [`NO_NODE`].
    pub(crate) dies_at: u32,
    /// If nothing is left of this node, the leaves before this one make no difference any more.
    pub(crate) rest: u32,
    pub(super) padding: u32,
    /// A bit for each other operand of its parent, in a solid of at most [`Self::BITS`] nodes. If
    /// those that the ray is inside are just those of `needed`, then the ray enters or leaves the
    /// parent with this node. The root has no siblings, and what is needed never is.
    pub(crate) siblings: u64,
    pub(crate) needed: u64,
}

impl SolidNodeRecord {
    /// Nodes of a solid that has no more than these have a bit each, by their indices.
    pub(crate) const BITS: usize = 64;
}

/// A leaf of a constructive solid: a sphere, or a parallelepiped by its planes.
#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C)]
pub(crate) struct LeafRecord {
    pub(crate) center: [f64; 3],
    /// The radius of a sphere is above 0; a parallelepiped has 0.
    pub(crate) radius: f64,
    /// The planes of a parallelepiped's faces, which look outward; a sphere has none.
    pub(crate) planes: [PlaneIndex; 6],
    pub(crate) material: u32,
    /// Its node in the solid's tree.
    pub(crate) node: u32,
    /// 1 where an odd number of differences takes it away, so that its faces look inward.
    pub(crate) is_reversed: u32,
    /// Equal spheres have one surface, within solids or without. Of a parallelepiped it is the
    /// place in the section `box_planes`: its faces have the surfaces of their planes.
    pub(crate) surface: u32,
    /// Twice the distance of its farthest point from the origin, or a little more: the size of the
    /// numbers that rounding counts by.
    pub(crate) extent: f64,
}

impl LeafRecord {
    #[inline(always)]
    pub(crate) fn is_sphere(&self) -> bool {
        self.radius > 0.0
    }

    /// The surface of one of its faces.
    #[inline(always)]
    pub(crate) fn surface(&self, face: usize) -> Surface {
        if self.is_sphere() { Surface(self.surface) } else { self.planes[face].surface() }
    }
}

/// The planes of a parallelepiped side by side: `[axis][face]`, as its faces look.
#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C)]
pub(crate) struct BoxPlanes {
    pub(crate) points: [[f64; 6]; 3],
    /// The normals look outward.
    pub(crate) normals: [[f64; 6]; 3],
    /// The numbers of their surfaces.
    pub(crate) surfaces: [f64; 6],
}

impl BoxPlanes {
    /// Gathers the planes of six faces.
    pub(crate) fn new(faces: [PlaneIndex; 6], planes: &[PlaneRecord]) -> Self {
        let record = |face: usize| &planes[faces[face].index()];
        let side_by_side = |number: &dyn Fn(usize, usize) -> f64| {
            std::array::from_fn(|axis| std::array::from_fn(|face| number(axis, face)))
        };
        Self {
            points: side_by_side(&|axis, face| record(face).point[axis]),
            normals: side_by_side(&|axis, face| record(face).normal[axis] * faces[face].sign()),
            surfaces: faces.map(|plane| f64::from(plane.surface().0)),
        }
    }
}

/// A plane that faces share.
#[derive(Debug, Clone, Copy, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C)]
pub(crate) struct PlaneRecord {
    pub(crate) point: [f64; 3],
    /// The normal has length 1.
    pub(crate) normal: [f64; 3],
}

/// An index of a plane; bit 31 says that the face looks the other way.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(transparent)]
pub(crate) struct PlaneIndex(u32);

impl PlaneIndex {
    /// The plane at an index, below 2^31, for a face that may look the other way.
    pub(crate) fn new(index: usize, is_reversed: bool) -> Self {
        Self(index as u32 | u32::from(is_reversed) << 31)
    }

    /// The index of the plane's record.
    #[inline(always)]
    pub(crate) fn index(self) -> usize {
        (self.0 & !(1 << 31)) as usize
    }

    /// 1, or -1 where the face looks against the plane's normal.
    pub(crate) fn sign(self) -> f64 {
        if self.0 >> 31 == 1 { -1.0 } else { 1.0 }
    }

    /// What was measured along the plane's normal, as the face looks: its sign flips where that is
    /// against the normal.
    #[inline(always)]
    pub(crate) fn outward(self, distance: f64) -> f64 {
        f64::from_bits(distance.to_bits() ^ u64::from(self.0 >> 31) << 63)
    }

    /// All faces of a plane are one surface.
    #[inline(always)]
    pub(crate) fn surface(self) -> Surface {
        Surface(self.0 | 1 << 31)
    }
}

/// A material.
#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C)]
pub(crate) struct MaterialRecord {
    pub(crate) color: [f64; 3],
    /// The mirrored share.
    pub(crate) reflect: f64,
    /// The share of the rest that is the surface's own.
    pub(crate) alpha: f64,
    /// n1/n2 from the front; 0 and 1 do not bend.
    pub(crate) refract: f64,
    /// The image that multiplies `color` on faces with texture coordinates, or [`Self::PLAIN`].
    pub(crate) texture: u32,
    padding: u32,
}

impl MaterialRecord {
    /// The texture of a material without one.
    pub(crate) const PLAIN: u32 = u32::MAX;

    pub(crate) fn new(color: DVec3, [reflect, alpha, refract]: [f64; 3], texture: u32) -> Self {
        Self { color: color.to_array(), reflect, alpha, refract, texture, padding: 0 }
    }

    /// Whether faces send light on to others.
    pub(crate) fn emits(&self) -> bool {
        self.reflect * self.alpha * DVec3::from_array(self.color).max_element() > 0.0
    }

    /// The share of its light that a shadow ray keeps when it crosses a face.
    pub(crate) fn transmittance(&self) -> f64 {
        (1.0 - self.alpha) * (1.0 - self.reflect)
    }
}

/// A point light.
#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C)]
pub(crate) struct LightRecord {
    pub(crate) position: [f64; 3],
    pub(crate) intensity: [f64; 3],
    /// The surfaces that the light lies on are a run of the section `coincident`; it begins here.
    pub(super) coincident_first: u32,
    /// That run has so many surfaces.
    pub(super) coincident_count: u32,
}

impl LightRecord {
    /// A light that lies on a run of the section `coincident`.
    pub(crate) fn new(position: DVec3, intensity: DVec3, coincident: Range<usize>) -> Self {
        Self {
            position: position.to_array(),
            intensity: intensity.to_array(),
            coincident_first: coincident.start as u32,
            coincident_count: coincident.len() as u32,
        }
    }
}

/// A face that sends light on to others. Records are sorted by rank.
#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C)]
pub(crate) struct EmitterRecord {
    /// The centre of a sphere, the mean of a polygon's corners.
    pub(crate) middle: [f64; 3],
    /// The normal of a polygon times its area; 0 for a sphere.
    pub(crate) vector_area: [f64; 3],
    /// The radius of a sphere or the area of a polygon, above 0.
    pub(crate) size: f64,
    /// Each side sends on about this at most, in its brightest channel. The first side of a polygon
    /// is the one that `vector_area` leads to.
    pub(crate) radiosity: [f64; 2],
    /// The corners of a polygon: the diagonal from the first to the third lies inside, and the
    /// third of a triangle stands there twice. Those of a sphere mean nothing.
    pub(crate) vertices: [u32; 4],
    pub(crate) rank: u32,
    pub(crate) shape: u32,
    /// Its leaf in the tree over all emitters.
    pub(crate) node: u32,
    /// The k-th record holds here the index of the k-th largest emitter.
    pub(crate) by_size: u32,
}

impl EmitterRecord {
    pub(crate) const TRIANGLE: u32 = 0;
    pub(crate) const QUADRANGLE: u32 = 1;
    pub(crate) const SPHERE: u32 = 2;

    #[inline(always)]
    pub(crate) fn is_sphere(&self) -> bool {
        self.shape == Self::SPHERE
    }

    #[inline(always)]
    pub(crate) fn is_triangle(&self) -> bool {
        self.shape == Self::TRIANGLE
    }
}

/// A node of the tree over all emitters.
#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C)]
pub(crate) struct EmitterNode {
    /// The centre of a sphere around its emitters.
    pub(crate) center: [f64; 3],
    /// The radius of that sphere.
    pub(crate) radius: f64,
    /// The emitters fill about this share of that sphere's disc: 0..=1.
    pub(crate) fill: f64,
    /// The mean of what they send on, weighted by their areas.
    pub(crate) radiosity: f64,
    /// The parent, or [`NO_NODE`] for the root.
    pub(crate) parent: u32,
    /// The first of two children, which stand side by side; [`NO_NODE`] for a leaf.
    pub(crate) child: u32,
    /// The emitter of a leaf; that of an inner node means nothing.
    pub(crate) emitter: u32,
    pub(crate) padding: u32,
}

impl EmitterNode {
    /// The leaf of an emitter.
    pub(crate) fn leaf(parent: u32, emitter: u32) -> Self {
        let child = NO_NODE;
        Self { parent, child, emitter, ..bytemuck::Zeroable::zeroed() }
    }

    #[inline(always)]
    pub(crate) fn is_leaf(&self) -> bool {
        self.child == NO_NODE
    }
}

/// The texture coordinates of a face.
#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C)]
pub(crate) struct TexturedFace {
    pub(crate) texcoords: Texcoords,
    pub(crate) rank: u32,
    padding: u32,
}

impl TexturedFace {
    /// The texture coordinates of the face with a rank.
    pub(crate) fn new(rank: u32, texcoords: Texcoords) -> Self {
        Self { texcoords, rank, padding: 0 }
    }
}

/// Texture coordinates at the corners (0, 0), (1, 0), (1, 1) and (0, 1) of the unit square;
/// bilinear between them.
#[derive(Debug, Clone, Copy, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(transparent)]
pub(crate) struct Texcoords(pub(crate) [[f64; 2]; 4]);

impl Texcoords {
    /// Those of a face that was given none. A triangle's corners are the first, the second and the
    /// last.
    pub(crate) const DEFAULT: Self = Self([[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]]);

    /// Beyond this a number has no fraction, so an image that repeats has no place there.
    const LARGEST: f64 = (1_u64 << 53) as f64;

    /// Makes those of a quadrangle with these at its corners.
    pub(crate) fn of_quadrangle(corners: [DVec2; 4]) -> Self {
        let limit = DVec2::splat(Self::LARGEST);
        Self(corners.map(|corner| corner.clamp(-limit, limit).to_array()))
    }

    /// Makes those of a triangle with these at its corners.
    pub(crate) fn of_triangle([a, b, c]: [DVec2; 3]) -> Self {
        Self::of_quadrangle([a, b, b + (c - a), c])
    }
}

/// An image: a run of levels.
#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C)]
pub(crate) struct TextureRecord {
    pub(crate) first_level: u32,
    /// There is at least one level.
    pub(crate) level_count: u32,
}

/// An image at one size.
#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C)]
pub(crate) struct LevelRecord {
    pub(crate) width: u32,
    pub(crate) height: u32,
    /// The place of its first texel: among the fine texels for an image's first level, among the
    /// coarse ones for all others.
    pub(crate) offset: u64,
}

impl TextureRecord {
    /// The run of its levels.
    pub(crate) fn levels(self) -> Range<usize> {
        self.first_level as usize..self.first_level as usize + self.level_count as usize
    }
}

impl LevelRecord {
    /// Whether it has texels, and they are among so many.
    pub(super) fn lies_within(&self, texel_count: usize) -> bool {
        let count = u64::from(self.width) * u64::from(self.height);
        let end = self.offset.checked_add(count);
        count > 0 && end.is_some_and(|end| end <= texel_count as u64)
    }
}
