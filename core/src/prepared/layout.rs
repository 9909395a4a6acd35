//! The order of a block: its header and its sections.

use std::ops::Range;

use super::{
    node::{CompactNode, Frame, Node},
    record::{
        BoxPlanes, Camera, Coat, EmitterNode, EmitterRecord, FaceRecord, Features, Item,
        LeafRecord, LevelRecord, LightRecord, Lighting, MaterialRecord, PlaneRecord,
        QuadrangleRecord, SolidNodeRecord, SolidRecord, SphereRecord, Surface, TextureRecord,
        TexturedFace,
    },
};

pub(super) const MAGIC: [u8; 8] = *b"rtfarm\r\n";

/// The version changes with the layout or the meaning of any byte.
pub(super) const VERSION: u32 = 10;

/// This number reads differently on a machine of the other byte order.
pub(super) const BYTE_ORDER: u32 = 0x0102_0304;

#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C)]
pub(crate) struct Header {
    pub(super) magic: [u8; 8],
    pub(super) version: u32,
    pub(super) byte_order: u32,
    /// The BLAKE3 hash of all that comes after this field; it is the scene's address.
    pub(super) hash: [u8; 32],
    pub(super) sections: [Section; SECTIONS],
    pub(crate) camera: Camera,
    pub(crate) frame: Frame,
    pub(crate) lighting: Lighting,
    /// Scene coordinates times this power of two are the block's coordinates.
    pub(crate) scale: f64,
    pub(crate) features: Features,
}

pub(super) const HASHED_FROM: usize = 16 + 32;

#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C)]
pub(super) struct Section {
    /// The section begins so many bytes after the start of the block.
    pub(super) offset: u64,
    /// It holds so many records.
    pub(super) count: u64,
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

        /// The names of the sections, in their order.
        #[doc(hidden)]
        pub const SECTION_NAMES: [&str; SECTIONS] = [$(stringify!($name)),*];

        /// The record sizes of the sections, in their order.
        pub(super) const RECORD_SIZES: [usize; SECTIONS] = [$(size_of::<$record>()),*];

        impl<'a> Sections<'a> {
            pub(super) fn to_bytes(self) -> [&'a [u8]; SECTIONS] {
                [$(bytemuck::cast_slice(self.$name)),*]
            }

            pub(super) fn from_bytes(sections: [&'a [u8]; SECTIONS]) -> Self {
                let [$($name),*] = sections;
                Self { $($name: bytemuck::cast_slice($name),)* }
            }
        }
    };
}

sections! {
    nodes: Node,
    compact_nodes: CompactNode,
    faces: FaceRecord,
    vertices: [f64; 3],
    single_vertices: [f32; 3],
    coats: Coat,
    quadrangles: QuadrangleRecord,
    spheres: SphereRecord,
    planes: PlaneRecord,
    materials: MaterialRecord,
    lights: LightRecord,
    coincident: Surface,
    solids: SolidRecord,
    solid_nodes: SolidNodeRecord,
    leaves: LeafRecord,
    box_planes: BoxPlanes,
    solid_boxes: Node,
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
    pub(super) sections: Sections<'a>,
}

impl<'a> std::ops::Deref for View<'a> {
    type Target = Sections<'a>;

    #[inline(always)]
    fn deref(&self) -> &Sections<'a> {
        &self.sections
    }
}

impl<'a> View<'a> {
    /// The surfaces that the light lies on.
    #[inline(always)]
    pub(crate) fn coincident_surfaces(&self, light: &LightRecord) -> &'a [Surface] {
        let first = light.coincident_first as usize;
        &self.coincident[first..first + light.coincident_count as usize]
    }

    /// The nodes of a solid's tree; the last one is its root.
    pub(crate) fn solid_nodes(&self, solid: &SolidRecord) -> &'a [SolidNodeRecord] {
        &self.sections.solid_nodes[solid.nodes()]
    }

    /// The leaves of a solid.
    pub(crate) fn solid_leaves(&self, solid: &SolidRecord) -> &'a [LeafRecord] {
        &self.sections.leaves[solid.leaves()]
    }

    /// The emitter that has a rank; `None` where that face is no emitter on record.
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

    /// The items of a run, such as that of a leaf.
    #[inline(always)]
    pub(crate) fn items(&self, run: Range<usize>) -> impl Iterator<Item = Item> + use<'a> {
        let first = run.start;
        self.faces[run].iter().enumerate().map(move |(k, face)| face.item(first + k))
    }

    /// All items.
    pub(crate) fn all_items(&self) -> impl Iterator<Item = Item> + use<'a> {
        self.items(0..self.faces.len())
    }

    /// The plane and the material of a triangle that shares its plane.
    #[inline(always)]
    pub(crate) fn coat(&self, face: &FaceRecord) -> &'a Coat {
        &self.coats[face.coat()]
    }

    /// A node of the hierarchy, which is compact or not; a compact one is expanded into `room`.
    #[inline(always)]
    pub(crate) fn node<'n>(&self, index: usize, room: &'n mut Node) -> &'n Node
    where
        'a: 'n,
    {
        if let Some(node) = self.sections.nodes.get(index) {
            return node;
        }
        self.compact_nodes[index].expand_into(room);
        room
    }

    /// How many vertices there are.
    pub(crate) fn vertex_count(&self) -> usize {
        self.vertices.len() + self.single_vertices.len()
    }

    /// The position of a vertex: those in single precision follow the others.
    #[inline(always)]
    pub(crate) fn vertex(&self, vertex: u32) -> [f64; 3] {
        let index = vertex as usize;
        if let Some(&vertex) = self.sections.vertices.get(index) {
            return vertex;
        }
        let [x, y, z] = self.single_vertices[index - self.vertices.len()];
        [f64::from(x), f64::from(y), f64::from(z)]
    }

    /// The position of a vertex where it stands; one in single precision is written into `room`.
    #[inline(always)]
    pub(crate) fn vertex_in<'n>(&self, vertex: u32, room: &'n mut [f64; 3]) -> &'n [f64; 3]
    where
        'a: 'n,
    {
        if let Some(vertex) = self.sections.vertices.get(vertex as usize) {
            return vertex;
        }
        *room = self.vertex(vertex);
        room
    }

    /// The positions of vertices. This is a loop, as `Shear::project_all` is.
    #[inline(always)]
    pub(crate) fn corners<const N: usize>(&self, vertices: &[u32; N]) -> [[f64; 3]; N] {
        let mut corners = [[0.0; 3]; N];
        for (corner, &vertex) in corners.iter_mut().zip(vertices) {
            *corner = self.vertex(vertex);
        }
        corners
    }
}
