//! The prepared scene: one flat, position-independent, versioned, checksummed block of bytes that
//! is built once and mapped by every process that renders from it.
//!
//! The block is a header and sections of plain records, each section aligned to 64 bytes.
//! Coordinates are the scene's times a power of two that brings the largest of them into 0.5..1,
//! so that no scale can overflow or underflow and a scaled scene gives the same bits. Loading
//! checks every index, bound and number once; after that nothing is checked twice.

use std::ops::Range;

use glam::DVec3;

use crate::{
    left_out,
    light::tree,
    prepare::{
        bvh,
        mip_maps::{LevelRecord, TextureRecord},
    },
    scene::{Material, Sphere},
    shade::{chart::Texcoords, texture::TextureView},
    trace::{
        boxes::{Child, Frame, Node},
        ray::{Item, Kind, Surface},
        solid::{self, NodeRecord},
    },
    transfer::Transfer,
};

const MAGIC: [u8; 8] = *b"rtfarm\r\n";

/// Changes with the layout or the meaning of any byte.
const VERSION: u32 = 6;

/// Reads differently on a machine of the other byte order.
const BYTE_ORDER: u32 = 0x0102_0304;

/// The BLAKE3 hash of a prepared scene: its address on the farm.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct SceneHash(pub [u8; 32]);

impl std::fmt::Display for SceneHash {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&blake3::Hash::from_bytes(self.0).to_hex())
    }
}

/// Why bytes are no prepared scene.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum PreparedError {
    /// Too short, another file type, or another version.
    #[error("not a prepared scene of this version: {0}")]
    Foreign(&'static str),
    /// The bytes are not those that were written.
    #[error("a damaged prepared scene: its hash does not match")]
    Damaged,
    /// A record that no scene leads to.
    #[error("a malformed prepared scene: {0}")]
    Malformed(&'static str),
}

#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C)]
pub(crate) struct Header {
    magic: [u8; 8],
    version: u32,
    byte_order: u32,
    /// BLAKE3 of everything behind this field, and the scene's address.
    hash: [u8; 32],
    sections: [Section; SECTIONS],
    pub(crate) camera: Camera,
    pub(crate) frame: Frame,
    pub(crate) lighting: Lighting,
    /// Scene coordinates times this are the block's: a power of two.
    pub(crate) scale: f64,
    pub(crate) features: Features,
}

/// What the scene needs of the tracer; 1 or 0 each.
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
    /// Faces send light on to others: [`Features::AIMED`] or [`Features::UNAIMED`].
    pub(crate) has_emitters: u32,
    /// A face shows an image.
    pub(crate) has_textures: u32,
    /// The images' finest levels are encoded by the sRGB curve.
    pub(crate) has_srgb_texels: u32,
    pub(crate) padding: u32,
}

impl Features {
    /// Light is looked for where emitters are, as well as all over the sky.
    pub(crate) const AIMED: u32 = 1;
    /// Only all over the sky, by one ray from each place: the yardstick.
    pub(crate) const UNAIMED: u32 = 2;

    pub(crate) fn has_branches(&self) -> bool {
        self.has_branches == 1
    }

    pub(crate) fn has_clear_shadows(&self) -> bool {
        self.has_clear_shadows == 1 && !left_out::TRANSPARENCY
    }

    pub(crate) fn has_emitters(&self) -> bool {
        self.has_emitters != 0 && !left_out::SECONDARY_LIGHT
    }

    pub(crate) fn has_textures(&self) -> bool {
        self.has_textures == 1 && !left_out::TEXTURE
    }

    fn texel_transfer(&self) -> Transfer {
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
    /// What a surface receives before any lamp is asked.
    pub(crate) fn ambient(&self) -> DVec3 {
        if left_out::AMBIENT { DVec3::ZERO } else { DVec3::from_array(self.ambient) }
    }
}

const HASHED_FROM: usize = 16 + 32;

#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C)]
struct Section {
    /// From the start of the block, in bytes.
    offset: u64,
    /// Records.
    count: u64,
}

/// The eye and the screen as seen from it. The screen only gives directions, so it has a scale of
/// its own: one that is nothing beside the scene still does not underflow.
#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C)]
pub(crate) struct Camera {
    pub(crate) eye: [f64; 3],
    /// From the eye to the screen's top left corner.
    pub(crate) top_left: [f64; 3],
    /// From the top left corner to the top right one.
    pub(crate) right: [f64; 3],
    /// From the top left corner to the bottom left one.
    pub(crate) down: [f64; 3],
}

impl Camera {
    fn with_screen_of_one(self) -> Self {
        let screen = [self.top_left, self.right, self.down].map(DVec3::from_array);
        let largest =
            screen.map(|vector| vector.abs().max_element()).into_iter().fold(0.0, f64::max);
        let scale = power_of_two_below_inverse(largest);
        let [top_left, right, down] = screen.map(|vector| (vector * scale).to_array());
        Self { top_left, right, down, ..self }
    }
}

#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C)]
pub(crate) struct TriangleRecord {
    pub(crate) vertices: [u32; 3],
    pub(crate) material: u32,
    pub(crate) rank: u32,
}

#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C)]
pub(crate) struct CoplanarRecord {
    pub(crate) vertices: [u32; 3],
    pub(crate) material: u32,
    pub(crate) rank: u32,
    pub(crate) plane: PlaneIndex,
}

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

#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C)]
pub(crate) struct SphereRecord {
    pub(crate) center: [f64; 3],
    pub(crate) radius: f64,
    pub(crate) material: u32,
    pub(crate) rank: u32,
    /// Equal spheres have one surface.
    pub(crate) surface: u32,
    padding: u32,
}

impl SphereRecord {
    pub(crate) fn new(center: DVec3, radius: f64, material: u32, rank: u32) -> Self {
        Self { center: center.to_array(), radius, material, rank, surface: rank, padding: 0 }
    }
}

/// A constructive solid: runs of nodes and of leaves.
#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C)]
pub(crate) struct SolidRecord {
    first_node: u32,
    node_count: u32,
    first_leaf: u32,
    leaf_count: u32,
    /// The rank of its first leaf's first face; each leaf has six.
    pub(crate) rank: u32,
}

impl SolidRecord {
    pub(crate) fn new(nodes: Range<usize>, leaves: Range<usize>, rank: u32) -> Self {
        Self {
            first_node: nodes.start as u32,
            node_count: nodes.len() as u32,
            first_leaf: leaves.start as u32,
            leaf_count: leaves.len() as u32,
            rank,
        }
    }

    pub(crate) fn nodes(&self) -> Range<usize> {
        self.first_node as usize..self.first_node as usize + self.node_count as usize
    }

    pub(crate) fn leaves(&self) -> Range<usize> {
        self.first_leaf as usize..self.first_leaf as usize + self.leaf_count as usize
    }
}

/// A leaf of a constructive solid: a sphere, or a parallelepiped by its planes.
#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C)]
pub(crate) struct LeafRecord {
    pub(crate) center: [f64; 3],
    /// 0 for a parallelepiped.
    pub(crate) radius: f64,
    /// Of a parallelepiped; they look outward.
    pub(crate) planes: [PlaneIndex; 6],
    pub(crate) material: u32,
    /// Its node in the solid's tree.
    pub(crate) node: u32,
    /// 1 when it is taken away: its faces look inward.
    pub(crate) is_turned: u32,
    /// Of a sphere.
    pub(crate) surface: u32,
}

impl LeafRecord {
    pub(crate) fn sphere(sphere: &Sphere, node: u32) -> Self {
        Self {
            center: sphere.center.to_array(),
            radius: sphere.radius,
            ..Self::parallelepiped(sphere.material, node)
        }
    }

    pub(crate) fn parallelepiped(material: u32, node: u32) -> Self {
        let planes = [PlaneIndex(0); 6];
        Self { center: [0.0; 3], radius: 0.0, planes, material, node, is_turned: 0, surface: 0 }
    }

    #[inline(always)]
    pub(crate) fn is_sphere(&self) -> bool {
        self.radius > 0.0
    }
}

/// A plane that faces share.
#[derive(Debug, Clone, Copy, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C)]
pub(crate) struct PlaneRecord {
    pub(crate) point: [f64; 3],
    /// Of length 1.
    pub(crate) normal: [f64; 3],
}

/// An index of a plane; bit 31 says that the face looks the other way.
#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(transparent)]
pub(crate) struct PlaneIndex(u32);

impl PlaneIndex {
    pub(crate) fn new(index: usize, is_turned: bool) -> Self {
        Self(index as u32 | u32::from(is_turned) << 31)
    }

    #[inline(always)]
    pub(crate) fn index(self) -> usize {
        (self.0 & !(1 << 31)) as usize
    }

    /// 1, or -1 where the face looks against the plane's normal.
    pub(crate) fn sign(self) -> f64 {
        if self.0 >> 31 == 1 { -1.0 } else { 1.0 }
    }

    /// All faces of a plane are one surface.
    #[inline(always)]
    pub(crate) fn surface(self) -> Surface {
        Surface(self.0 | 1 << 31)
    }
}

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
    /// No texture.
    pub(crate) const PLAIN: u32 = u32::MAX;

    pub(crate) fn new(material: &Material, texture: u32) -> Self {
        let Material { color, reflect, alpha, refract, .. } = *material;
        Self { color: color.to_array(), reflect, alpha, refract, texture, padding: 0 }
    }

    /// Whether faces send light on to others.
    pub(crate) fn emits(&self) -> bool {
        self.reflect * self.alpha * DVec3::from_array(self.color).max_element() > 0.0
    }

    /// What a shadow ray keeps when it crosses a face.
    pub(crate) fn clearness(&self) -> f64 {
        (1.0 - self.alpha) * (1.0 - self.reflect)
    }
}

#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C)]
pub(crate) struct LightRecord {
    pub(crate) position: [f64; 3],
    pub(crate) intensity: [f64; 3],
    /// The faces that contain the light: a run of `touches`.
    touches_first: u32,
    touches_count: u32,
}

impl LightRecord {
    pub(crate) fn new(position: DVec3, intensity: DVec3, first: u32, count: u32) -> Self {
        Self {
            position: position.to_array(),
            intensity: intensity.to_array(),
            touches_first: first,
            touches_count: count,
        }
    }
}

/// A face that sends light on to others. Records are sorted by rank.
#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C)]
pub(crate) struct EmitterRecord {
    /// The centre of a sphere, the mean of a polygon's corners.
    pub(crate) middle: [f64; 3],
    /// Of a polygon: its normal times its area.
    pub(crate) turned_area: [f64; 3],
    /// The radius, or the area. Above 0.
    pub(crate) size: f64,
    /// About what each side sends on at most, in its brightest channel; of a polygon the side that
    /// `turned_area` leads to first.
    pub(crate) radiosity: [f64; 2],
    /// Of a polygon: the diagonal from the first to the third lies inside; the third of a triangle
    /// stands there twice.
    pub(crate) vertices: [u32; 4],
    pub(crate) rank: u32,
    pub(crate) shape: u32,
    /// Its leaf in the tree.
    pub(crate) node: u32,
    /// Of the record that stands at the same place in the order of sizes, the largest first: its
    /// index.
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
    /// Of a ball around its emitters.
    pub(crate) center: [f64; 3],
    pub(crate) radius: f64,
    /// About the share of that ball's disc that they fill. 0..=1.
    pub(crate) fill: f64,
    /// What they send on, by their areas.
    pub(crate) radiosity: f64,
    pub(crate) parent: u32,
    /// The first of two, side by side; not of a leaf.
    pub(crate) child: u32,
    /// Of a leaf.
    pub(crate) emitter: u32,
    pub(crate) padding: u32,
}

impl EmitterNode {
    pub(crate) fn leaf(parent: u32, emitter: u32) -> Self {
        let child = tree::NO_NODE;
        Self { parent, child, emitter, ..bytemuck::Zeroable::zeroed() }
    }

    #[inline(always)]
    pub(crate) fn is_leaf(&self) -> bool {
        self.child == tree::NO_NODE
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
    pub(crate) fn new(rank: u32, texcoords: Texcoords) -> Self {
        Self { texcoords, rank, padding: 0 }
    }
}

/// Declares the sections of a block, once for all that go through them in order.
macro_rules! sections {
    ($($name:ident: $record:ty,)*) => {
        /// The sections of a block, in their order.
        #[derive(Debug, Clone, Copy)]
        pub(crate) struct Sections<'a> {
            $(pub(crate) $name: &'a [$record],)*
        }

        const SECTIONS: usize = [$(stringify!($name)),*].len();

        /// The record sizes of the sections, in their order.
        const RECORD_SIZES: [usize; SECTIONS] = [$(size_of::<$record>()),*];

        impl<'a> Sections<'a> {
            fn to_bytes(self) -> [&'a [u8]; SECTIONS] {
                [$(bytemuck::cast_slice(self.$name)),*]
            }

            fn from_bytes(sections: [&'a [u8]; SECTIONS]) -> Self {
                let [$($name),*] = sections;
                Self { $($name: bytemuck::cast_slice($name),)* }
            }
        }
    };
}

sections! {
    nodes: Node,
    items: Item,
    vertices: [f64; 3],
    triangles: TriangleRecord,
    coplanars: CoplanarRecord,
    quadrangles: QuadrangleRecord,
    spheres: SphereRecord,
    planes: PlaneRecord,
    materials: MaterialRecord,
    lights: LightRecord,
    touches: Surface,
    solids: SolidRecord,
    solid_nodes: NodeRecord,
    leaves: LeafRecord,
    first_ranks: u32,
    emitters: EmitterRecord,
    emitter_nodes: EmitterNode,
    textured_faces: TexturedFace,
    textures: TextureRecord,
    texture_levels: LevelRecord,
    fine_texels: [u8; 4],
    coarse_texels: [f32; 3],
}

/// A block as the tracer reads it.
#[derive(Debug, Clone, Copy)]
pub(crate) struct View<'a> {
    pub(crate) header: &'a Header,
    sections: Sections<'a>,
}

impl<'a> std::ops::Deref for View<'a> {
    type Target = Sections<'a>;

    #[inline(always)]
    fn deref(&self) -> &Sections<'a> {
        &self.sections
    }
}

impl<'a> View<'a> {
    /// The surfaces that contain the light.
    #[inline(always)]
    pub(crate) fn touches(&self, light: &LightRecord) -> &'a [Surface] {
        let first = light.touches_first as usize;
        &self.touches[first..first + light.touches_count as usize]
    }

    pub(crate) fn solid_nodes(&self, solid: &SolidRecord) -> &'a [NodeRecord] {
        &self.sections.solid_nodes[solid.nodes()]
    }

    pub(crate) fn solid_leaves(&self, solid: &SolidRecord) -> &'a [LeafRecord] {
        &self.sections.leaves[solid.leaves()]
    }

    /// The emitter of a rank.
    pub(crate) fn emitter_of(&self, rank: u32) -> Option<u32> {
        self.emitters.binary_search_by_key(&rank, |emitter| emitter.rank).ok().map(|k| k as u32)
    }

    /// The primitive and its face that have a rank.
    pub(crate) fn primitive_and_face(&self, rank: u32) -> (u32, u32) {
        match self.first_ranks.partition_point(|&first| first <= rank).checked_sub(1) {
            Some(primitive) => (primitive as u32, rank - self.first_ranks[primitive]),
            None => (rank, 0),
        }
    }

    /// An image with its levels.
    pub(crate) fn texture(&self, index: u32) -> TextureView<'a> {
        TextureView {
            levels: &self.texture_levels[self.textures[index as usize].levels()],
            fine: self.fine_texels,
            light_of_bytes: self.header.features.texel_transfer().light_of_bytes(),
            coarse: self.coarse_texels,
        }
    }

    #[inline(always)]
    pub(crate) fn corners<const N: usize>(&self, vertices: &[u32; N]) -> [&'a [f64; 3]; N] {
        vertices.map(|vertex| &self.vertices[vertex as usize])
    }
}

/// A prepared scene in memory, aligned for use in place.
#[derive(Debug, Clone)]
pub struct PreparedBytes {
    lines: Vec<Line>,
    length: usize,
}

#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C, align(64))]
struct Line([u8; 64]);

impl PreparedBytes {
    /// Bytes that came from elsewhere, brought into alignment.
    pub fn copy_from(bytes: &[u8]) -> Self {
        let mut block = Self::zeroed(bytes.len());
        block.bytes_mut().copy_from_slice(bytes);
        block
    }

    /// The scene's address.
    pub fn hash(&self) -> SceneHash {
        let header: &Header = bytemuck::from_bytes(&self.as_ref()[..size_of::<Header>()]);
        SceneHash(header.hash)
    }

    fn zeroed(length: usize) -> Self {
        Self { lines: vec![Line([0; 64]); length.div_ceil(64)], length }
    }

    fn bytes_mut(&mut self) -> &mut [u8] {
        &mut bytemuck::cast_slice_mut(&mut self.lines)[..self.length]
    }
}

impl AsRef<[u8]> for PreparedBytes {
    fn as_ref(&self) -> &[u8] {
        &bytemuck::cast_slice(&self.lines)[..self.length]
    }
}

/// Lays the parts of a prepared scene out as one block.
pub(crate) fn assemble(
    camera: Camera,
    lighting: Lighting,
    frame: Frame,
    scale: f64,
    features: Features,
    sections: &Sections<'_>,
) -> PreparedBytes {
    let sections = sections.to_bytes();
    let mut header = Header {
        magic: MAGIC,
        version: VERSION,
        byte_order: BYTE_ORDER,
        camera: camera.with_screen_of_one(),
        lighting,
        frame,
        scale,
        features,
        ..bytemuck::Zeroable::zeroed()
    };
    let mut end = size_of::<Header>();
    for (k, section) in sections.iter().enumerate() {
        let offset = end.next_multiple_of(64);
        header.sections[k] =
            Section { offset: offset as u64, count: (section.len() / RECORD_SIZES[k]) as u64 };
        end = offset + section.len();
    }
    let mut block = PreparedBytes::zeroed(end);
    let bytes = block.bytes_mut();
    for (k, section) in sections.iter().enumerate() {
        let offset = header.sections[k].offset as usize;
        bytes[offset..offset + section.len()].copy_from_slice(section);
    }
    bytes[..size_of::<Header>()].copy_from_slice(bytemuck::bytes_of(&header));
    let hash = blake3::hash(&bytes[HASHED_FROM..]);
    bytes[HASHED_FROM - 32..HASHED_FROM].copy_from_slice(hash.as_bytes());
    block
}

/// The power of two that brings `value` into 0.5..1; 1 for 0. Limited to where both it and its
/// inverse are normal numbers.
pub(crate) fn power_of_two_below_inverse(value: f64) -> f64 {
    let exponent = (value.to_bits() >> 52 & 0x7FF).cast_signed() - 1022;
    let exponent = if value == 0.0 { 0 } else { exponent.clamp(-1020, 1020) };
    f64::from_bits(((1023 - exponent) as u64) << 52)
}

/// A prepared scene whose every index, bound and number has been checked.
#[derive(Debug)]
pub struct PreparedScene<B> {
    bytes: B,
}

impl<B: AsRef<[u8]>> PreparedScene<B> {
    /// Checks `bytes`, which must be aligned to 64 (as [`PreparedBytes`] and memory maps are), and
    /// makes them usable. No bytes whatever can make a later reader go out of bounds, loop or meet
    /// a NaN.
    pub fn open(bytes: B) -> Result<Self, PreparedError> {
        Self::open_in_steps(bytes, &mut || ())
    }

    /// [`PreparedScene::open`], calling `on_step` after every 16 MiB, some 10 ms of work.
    pub fn open_in_steps(bytes: B, on_step: &mut dyn FnMut()) -> Result<Self, PreparedError> {
        let data = bytes.as_ref();
        let header = data.get(..size_of::<Header>()).ok_or(PreparedError::Foreign("too short"))?;
        let header: &Header = bytemuck::try_from_bytes(header)
            .map_err(|_| PreparedError::Foreign("not aligned in memory"))?;
        if header.magic != MAGIC || header.version != VERSION || header.byte_order != BYTE_ORDER {
            return Err(PreparedError::Foreign("another kind, version or byte order"));
        }
        let mut hasher = blake3::Hasher::new();
        for step in data[HASHED_FROM..].chunks(1 << 24) {
            hasher.update(step);
            on_step();
        }
        if hasher.finalize() != header.hash {
            return Err(PreparedError::Damaged);
        }
        for (section, size) in header.sections.iter().zip(RECORD_SIZES) {
            let end = (section.count.checked_mul(size as u64))
                .and_then(|length| length.checked_add(section.offset));
            if section.offset % 64 != 0 || end.is_none_or(|end| end > data.len() as u64) {
                return Err(PreparedError::Malformed("a section out of bounds"));
            }
        }
        on_step();
        let scene = Self { bytes };
        check(&scene.view()).map_err(PreparedError::Malformed)?;
        Ok(scene)
    }

    /// The scene's address.
    pub fn hash(&self) -> SceneHash {
        SceneHash(self.view().header.hash)
    }

    /// How many bytes the block has.
    pub fn byte_count(&self) -> usize {
        self.bytes.as_ref().len()
    }

    pub(crate) fn view(&self) -> View<'_> {
        let data = self.bytes.as_ref();
        let header: &Header = bytemuck::from_bytes(&data[..size_of::<Header>()]);
        let mut sections = header.sections.iter().zip(RECORD_SIZES).map(|(section, size)| {
            let offset = section.offset as usize;
            &data[offset..offset + section.count as usize * size]
        });
        let sections = std::array::from_fn(|_| sections.next().expect("as many as there are"));
        View { header, sections: Sections::from_bytes(sections) }
    }
}

/// Everything that readers rely on.
fn check(view: &View<'_>) -> Result<(), &'static str> {
    let ensure = |holds: bool, what: &'static str| if holds { Ok(()) } else { Err(what) };
    let finite = |numbers: &[f64]| numbers.iter().all(|x| x.is_finite() && x.abs() < 1e100);
    let header = view.header;

    let camera = &header.camera;
    for vector in [camera.eye, camera.top_left, camera.right, camera.down] {
        ensure(finite(&vector), "the camera")?;
    }
    let lighting = &header.lighting;
    ensure(finite(&lighting.background) && finite(&lighting.ambient), "a colour")?;
    let is_scale = |x: f64| x.is_normal() && x > 0.0 && (1.0 / x).is_normal();
    ensure(is_scale(header.scale) && is_scale(header.frame.scale), "a scale")?;
    ensure(finite(&header.frame.origin), "the frame")?;

    let mut levels = vec![0_u8; view.nodes.len()];
    *levels.first_mut().ok_or("no root")? = 1;
    for (index, node) in view.nodes.iter().enumerate() {
        ensure(levels[index] > 0, "a node without a parent")?;
        ensure(node.planes.as_flattened().iter().all(|x| !x.is_nan()), "a box")?;
        for (k, &child) in node.children.iter().enumerate() {
            if child == Child::NONE {
                // Its box is what keeps rays from going there, to the root again.
                let is_empty = |side: usize| node.planes[side][k] == Node::EMPTY.planes[side][k];
                ensure((0..6).all(is_empty), "a box")?;
                continue;
            }
            if child.is_leaf() {
                ensure(child.items().end <= view.items.len(), "a leaf")?;
                continue;
            }
            let below = levels[index] + 1;
            let level = levels.get_mut(child.node()).ok_or("a child")?;
            // One parent each, standing before it: no loops, and no node is visited twice.
            ensure(*level == 0 && child.node() > index, "a child")?;
            ensure(usize::from(below) <= bvh::MOST_LEVELS, "too many levels")?;
            *level = below;
        }
    }
    for item in view.items {
        let count = match item.kind().ok_or("an item")? {
            Kind::Triangle => view.triangles.len(),
            Kind::Coplanar => view.coplanars.len(),
            Kind::Quadrangle => view.quadrangles.len(),
            Kind::Sphere => view.spheres.len(),
            Kind::Solid => view.solids.len(),
        };
        ensure(item.index() < count, "an item")?;
    }
    ensure(view.vertices.iter().all(|vertex| finite(vertex)), "a vertex")?;
    let vertices = |indices: &[u32]| indices.iter().all(|&k| (k as usize) < view.vertices.len());
    let material = |index: u32| (index as usize) < view.materials.len();
    let plane = |index: PlaneIndex| index.index() < view.planes.len();
    for face in view.triangles {
        ensure(vertices(&face.vertices) && material(face.material), "a triangle")?;
    }
    for face in view.coplanars {
        let whole = vertices(&face.vertices) && material(face.material) && plane(face.plane);
        ensure(whole, "a triangle")?;
    }
    for face in view.quadrangles {
        let whole = vertices(&face.vertices) && material(face.material) && plane(face.plane);
        ensure(whole, "a quadrangle")?;
    }
    for sphere in view.spheres {
        let whole = finite(&sphere.center) && finite(&[sphere.radius]) && sphere.radius > 0.0;
        ensure(whole && material(sphere.material), "a sphere")?;
    }
    for plane in view.planes {
        ensure(finite(&plane.point) && finite(&plane.normal), "a plane")?;
    }
    for record in view.materials {
        let numbers = [record.reflect, record.alpha, record.refract];
        let is_share = |x: f64| (0.0..=1.0).contains(&x);
        let whole = finite(&record.color) && finite(&numbers) && record.refract >= 0.0;
        ensure(whole && is_share(record.reflect) && is_share(record.alpha), "a material")?;
        let has_texture = (record.texture as usize) < view.textures.len();
        ensure(has_texture || record.texture == MaterialRecord::PLAIN, "a material")?;
    }
    for leaf in view.leaves {
        let whole = finite(&leaf.center) && finite(&[leaf.radius]) && material(leaf.material);
        let is_shape = leaf.is_sphere() || leaf.planes.iter().all(|&index| plane(index));
        ensure(whole && is_shape, "a leaf")?;
    }
    for solid in view.solids {
        ensure(solid.nodes().end <= view.solid_nodes.len(), "a solid")?;
        ensure(solid.leaves().end <= view.leaves.len(), "a solid")?;
        let leaves = view.solid_leaves(solid);
        solid::check_tree(view.solid_nodes(solid), leaves).map_err(|()| "a solid's tree")?;
        let last_rank = u64::from(solid.rank) + 6 * leaves.len() as u64;
        ensure(last_rank <= Child::ITEM_LIMIT as u64, "a solid")?;
    }
    for light in view.lights {
        let is_finite = light.intensity.iter().all(|channel| channel.is_finite());
        ensure(finite(&light.position) && is_finite, "a light")?;
        let end = light.touches_first as usize + light.touches_count as usize;
        ensure(end <= view.touches.len(), "a light")?;
    }
    check_textures(view)?;
    check_emitters(view)
}

/// What those rely on who look at textures.
fn check_textures(view: &View<'_>) -> Result<(), &'static str> {
    let ensure = |holds: bool, what: &'static str| if holds { Ok(()) } else { Err(what) };
    let finite = |numbers: &[f64]| numbers.iter().all(|x| x.is_finite() && x.abs() < 1e100);
    let is_sorted = view.textured_faces.is_sorted_by(|a, b| a.rank < b.rank);
    ensure(is_sorted, "the textured faces' order")?;
    let texcoords = |face: &TexturedFace| finite(face.texcoords.0.as_flattened());
    ensure(view.textured_faces.iter().all(texcoords), "a texture coordinate")?;
    for texture in view.textures {
        let levels = view.texture_levels.get(texture.levels()).ok_or("a texture")?;
        let (finest, coarser) = levels.split_first().ok_or("a texture")?;
        ensure(finest.lies_within(view.fine_texels.len()), "a texture")?;
        let are_within = coarser.iter().all(|level| level.lies_within(view.coarse_texels.len()));
        ensure(are_within, "a texture's level")?;
    }
    let texels = view.coarse_texels.as_flattened();
    ensure(texels.iter().all(|channel| (0.0..=1.0).contains(channel)), "a texel")
}

/// What those rely on who aim at emitters.
fn check_emitters(view: &View<'_>) -> Result<(), &'static str> {
    let ensure = |holds: bool, what: &'static str| if holds { Ok(()) } else { Err(what) };
    let finite = |numbers: &[f64]| numbers.iter().all(|x| x.is_finite() && x.abs() < 1e100);
    let vertices = |emitter: &EmitterRecord| {
        emitter.vertices.iter().all(|&k| (k as usize) < view.vertices.len()) || emitter.is_sphere()
    };
    for emitter in view.emitters {
        let is_place = finite(&emitter.middle) && finite(&emitter.turned_area);
        let is_shape = is_place && finite(&[emitter.size]) && emitter.size > 0.0;
        let is_known = emitter.shape <= EmitterRecord::SPHERE && vertices(emitter);
        ensure((emitter.by_size as usize) < view.emitters.len(), "an emitter")?;
        let is_light = emitter.radiosity.iter().all(|&x| (0.0..=1e100).contains(&x));
        ensure(is_shape && is_known && is_light, "an emitter")?;
    }
    ensure(view.emitters.is_sorted_by(|a, b| a.rank < b.rank), "the emitters' order")?;
    for node in view.emitter_nodes {
        let numbers = [node.radius, node.fill, node.radiosity];
        let is_ball = finite(&node.center) && numbers.iter().all(|&x| (0.0..=1e100).contains(&x));
        ensure(is_ball, "a node of emitters")?;
    }
    tree::check_tree(view.emitter_nodes, view.emitters).map_err(|()| "the tree of emitters")
}
