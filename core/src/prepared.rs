//! The prepared scene: one flat, position-independent, versioned, checksummed block of bytes that
//! is built once and mapped by every process that renders from it.
//!
//! The block is a header and sections of plain records, each section aligned to 64 bytes.
//! Coordinates are the scene's times a power of two that brings the largest of them into 0.5..1,
//! so that no scale can overflow or underflow and a scaled scene gives the same bits. Loading
//! checks every index, bound and number once; after that nothing is checked twice.

use glam::DVec3;

use crate::{
    bvh::{self, Bounds, Leaflet},
    exact::is_coplanar,
    node::{self, Child, Frame, Node},
    plane,
    ray::{Item, Kind, Surface},
    scene::{self, Material, Place, Scene},
    triangle::triangle_normal,
    weld::weld,
};

const MAGIC: [u8; 8] = *b"rtfarm\r\n";

/// Changes with the layout or the meaning of any byte.
const VERSION: u32 = 1;

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

/// Why a scene cannot be prepared.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum PrepareError {
    /// There is nothing to look through.
    #[error("a picture needs a `viewport` block with origin, topleft, bottomleft and topright")]
    NoViewport,
    /// Something that the language has and the tracer does not.
    #[error("{feature} cannot be rendered yet")]
    Unsupported {
        /// What, as its author would say it.
        feature: String,
        /// Where the file asks for it.
        at: Place,
    },
    /// More faces than indices reach.
    #[error("the scene has {0} faces; at most {limit} can be rendered", limit = Child::ITEM_LIMIT)]
    TooManyFaces(u64),
    /// A light that, seen in the scene's own units, is no finite number.
    #[error("light {0} (counted from 1) is too strong for numbers to hold")]
    Light(usize),
}

impl PrepareError {
    /// The place in the scene's text that it is about, if it is about one.
    pub fn place(&self) -> Option<Place> {
        match self {
            Self::Unsupported { at, .. } => Some(*at),
            _ => None,
        }
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
    pub(crate) background: [f64; 3],
    pub(crate) ambient: [f64; 3],
    /// Scene coordinates times this are the block's: a power of two.
    pub(crate) scale: f64,
    /// 1 when the scene defines light; 0 for plain colours.
    pub(crate) is_lit: u32,
    padding: u32,
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

/// The eye and the screen as seen from it.
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

const SECTIONS: usize = 11;

/// The sections of a block, in their order.
#[derive(Debug, Clone, Copy)]
pub(crate) struct View<'a> {
    pub(crate) header: &'a Header,
    pub(crate) nodes: &'a [Node],
    pub(crate) items: &'a [Item],
    pub(crate) vertices: &'a [[f64; 3]],
    pub(crate) triangles: &'a [TriangleRecord],
    pub(crate) coplanars: &'a [CoplanarRecord],
    pub(crate) quadrangles: &'a [QuadrangleRecord],
    pub(crate) spheres: &'a [SphereRecord],
    pub(crate) planes: &'a [PlaneRecord],
    pub(crate) materials: &'a [MaterialRecord],
    pub(crate) lights: &'a [LightRecord],
    touches: &'a [Surface],
}

impl<'a> View<'a> {
    /// The surfaces that contain the light.
    #[inline(always)]
    pub(crate) fn touches(&self, light: &LightRecord) -> &'a [Surface] {
        let first = light.touches_first as usize;
        &self.touches[first..first + light.touches_count as usize]
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

/// Turns a scene into a prepared scene, on rayon's threads; the same scene gives the same bytes on
/// any number of them.
pub fn prepare(scene: &Scene) -> Result<PreparedBytes, PrepareError> {
    let viewport = scene.viewport.ok_or(PrepareError::NoViewport)?;
    refuse_unsupported(scene)?;
    let count = scene.triangles.len() + scene.quadrangles.len() + scene.spheres.len();
    if count > Child::ITEM_LIMIT {
        return Err(PrepareError::TooManyFaces(count as u64));
    }
    let scale = unit_scale(scene, &viewport);
    let faces = Faces::new(scene, scale);
    let frame = faces.frame();
    let mut leaflets = faces.leaflets(&frame);
    let nodes = bvh::build_bvh(&mut leaflets);
    let sorted = faces.sort(&leaflets);

    let mut lights = Vec::with_capacity(scene.lights.len());
    let mut touches = Vec::new();
    for (k, light) in scene.lights.iter().enumerate() {
        let position = light.position * scale;
        let intensity = light.intensity * scale * scale;
        if !intensity.is_finite() {
            return Err(PrepareError::Light(k + 1));
        }
        let surfaces = sorted.surfaces_at(position);
        lights.push(LightRecord {
            position: position.to_array(),
            intensity: intensity.to_array(),
            touches_first: touches.len() as u32,
            touches_count: surfaces.len() as u32,
        });
        touches.extend(surfaces);
    }
    let materials: Vec<MaterialRecord> =
        scene.materials.iter().map(|m| MaterialRecord { color: m.color.to_array() }).collect();

    let [eye, top_left, bottom_left, top_right] =
        [viewport.eye, viewport.top_left, viewport.bottom_left, viewport.top_right]
            .map(|point| point * scale);
    let header = Header {
        magic: MAGIC,
        version: VERSION,
        byte_order: BYTE_ORDER,
        camera: Camera {
            eye: eye.to_array(),
            top_left: (top_left - eye).to_array(),
            right: (top_right - top_left).to_array(),
            down: (bottom_left - top_left).to_array(),
        },
        frame,
        background: scene.background.to_array(),
        ambient: scene.ambient.unwrap_or_default().to_array(),
        scale,
        is_lit: u32::from(scene.ambient.is_some() || !scene.lights.is_empty()),
        ..bytemuck::Zeroable::zeroed()
    };
    Ok(assemble(
        header,
        [
            bytemuck::cast_slice(&nodes),
            bytemuck::cast_slice(&sorted.items),
            bytemuck::cast_slice(&sorted.vertices),
            bytemuck::cast_slice(&sorted.triangles),
            bytemuck::cast_slice(&sorted.coplanars),
            bytemuck::cast_slice(&sorted.quadrangles),
            bytemuck::cast_slice(&sorted.spheres),
            bytemuck::cast_slice(&sorted.planes),
            bytemuck::cast_slice(&materials),
            bytemuck::cast_slice(&lights),
            bytemuck::cast_slice(&touches),
        ],
    ))
}

/// The record sizes of the sections, in their order.
const RECORD_SIZES: [usize; SECTIONS] = [
    size_of::<Node>(),
    size_of::<Item>(),
    size_of::<[f64; 3]>(),
    size_of::<TriangleRecord>(),
    size_of::<CoplanarRecord>(),
    size_of::<QuadrangleRecord>(),
    size_of::<SphereRecord>(),
    size_of::<PlaneRecord>(),
    size_of::<MaterialRecord>(),
    size_of::<LightRecord>(),
    size_of::<Surface>(),
];

fn assemble(mut header: Header, sections: [&[u8]; SECTIONS]) -> PreparedBytes {
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

/// What the tracer cannot do yet is refused, never ignored; a material that no face wears is not.
fn refuse_unsupported(scene: &Scene) -> Result<(), PrepareError> {
    let unsupported =
        |feature: &str, at: Place| PrepareError::Unsupported { feature: feature.to_owned(), at };
    if let Some(mesh) = scene.meshes.first() {
        return Err(unsupported("a mesh", mesh.at));
    }
    if let Some(solid) = scene.solids.first() {
        return Err(unsupported("a constructive solid", solid.at));
    }
    let mut is_worn = vec![false; scene.materials.len()];
    let worn = (scene.triangles.iter().map(|face| face.material))
        .chain(scene.quadrangles.iter().map(|face| face.material))
        .chain(scene.spheres.iter().map(|face| face.material))
        .chain(scene.parallelepipeds.iter().map(|face| face.material));
    for material in worn {
        is_worn[material as usize] = true;
    }
    let nowhere = Place { line: 1, column: 1 };
    for (Material { name, alpha, reflect, texture, places, .. }, _) in
        scene.materials.iter().zip(is_worn).filter(|(_, is_worn)| *is_worn)
    {
        if *reflect > 0.0 {
            let at = places.reflect.unwrap_or(nowhere);
            return Err(unsupported(&format!("the mirror `{name}` (reflect above 0)"), at));
        }
        if *alpha < 1.0 {
            let at = places.alpha.or(places.refract).unwrap_or(nowhere);
            return Err(unsupported(&format!("the transparent `{name}` (alpha below 1)"), at));
        }
        if texture.is_some() {
            let at = places.texture.unwrap_or(nowhere);
            return Err(unsupported(&format!("the texture of `{name}`"), at));
        }
    }
    if !scene.parallelepipeds.is_empty() {
        return Err(unsupported("a parallelepiped", nowhere));
    }
    Ok(())
}

/// The power of two that brings the largest coordinate of anything into 0.5..1.
fn unit_scale(scene: &Scene, viewport: &scene::Viewport) -> f64 {
    let largest = |point: DVec3| point.abs().max_element();
    let screen = [viewport.eye, viewport.top_left, viewport.bottom_left, viewport.top_right];
    let extent = (screen.into_iter().map(largest))
        .chain(scene.lights.iter().map(|light| largest(light.position)))
        .chain(scene.triangles.iter().flat_map(|face| face.vertices.map(largest)))
        .chain(scene.quadrangles.iter().flat_map(|face| face.vertices.map(largest)))
        .chain(scene.spheres.iter().map(|sphere| largest(sphere.center).max(sphere.radius)))
        .fold(0.0, f64::max);
    power_of_two_below_inverse(extent)
}

/// The power of two that brings `value` into 0.5..1; 1 for 0. Limited to where both it and its
/// inverse are normal numbers.
pub(crate) fn power_of_two_below_inverse(value: f64) -> f64 {
    let exponent = (value.to_bits() >> 52 & 0x7FF).cast_signed() - 1022;
    let exponent = if value == 0.0 { 0 } else { exponent.clamp(-1020, 1020) };
    f64::from_bits(((1023 - exponent) as u64) << 52)
}

/// All faces of a scene, in the block's units: triangles, then quadrangles, then spheres.
struct Faces<'a> {
    scene: &'a Scene,
    scale: f64,
    /// The plane of each flat face.
    planes: Vec<FacePlane>,
    shared: Vec<PlaneRecord>,
    /// Which vertex each corner of each flat face is: the first corner at that place.
    welded: Vec<u32>,
    corners: Vec<DVec3>,
}

/// How a flat face knows its plane.
#[derive(Clone, Copy)]
enum FacePlane {
    /// A triangle that is alone in its plane.
    Own,
    /// All quadrangles, and triangles that have company.
    Shared(PlaneIndex),
}

/// Faces in the order of the hierarchy's leaves.
struct Sorted {
    items: Vec<Item>,
    vertices: Vec<[f64; 3]>,
    triangles: Vec<TriangleRecord>,
    coplanars: Vec<CoplanarRecord>,
    quadrangles: Vec<QuadrangleRecord>,
    spheres: Vec<SphereRecord>,
    planes: Vec<PlaneRecord>,
}

impl<'a> Faces<'a> {
    fn new(scene: &'a Scene, scale: f64) -> Self {
        let corners: Vec<DVec3> = (scene.triangles.iter().flat_map(|face| face.vertices))
            .chain(scene.quadrangles.iter().flat_map(|face| face.vertices))
            .map(|corner| corner * scale)
            .collect();
        let welded = weld(&corners);
        let mut faces =
            Self { scene, scale, planes: Vec::new(), shared: Vec::new(), welded, corners };
        faces.find_planes();
        faces
    }

    fn flat_count(&self) -> usize {
        self.scene.triangles.len() + self.scene.quadrangles.len()
    }

    /// The corners of a flat face.
    fn corners(&self, face: usize) -> &[DVec3] {
        let range = self.corner_range(face);
        &self.corners[range]
    }

    fn corner_range(&self, face: usize) -> std::ops::Range<usize> {
        let triangles = self.scene.triangles.len();
        if face < triangles {
            3 * face..3 * face + 3
        } else {
            let first = 3 * triangles + 4 * (face - triangles);
            first..first + 4
        }
    }

    fn rank(&self, face: usize) -> u32 {
        let triangles = self.scene.triangles.len();
        if face < triangles {
            self.scene.triangles[face].primitive
        } else {
            self.scene.quadrangles[face - triangles].primitive
        }
    }

    /// Gives flat faces in exactly one plane one record, that of the face that comes first.
    fn find_planes(&mut self) {
        let triangles = self.scene.triangles.len();
        let prints = plane::plane_prints(self.flat_count(), |face| {
            let corners = self.corners(face);
            match *corners {
                // Any three corners do that are not in a line, if all four are in one plane.
                [a, b, c, d] if (b - a).cross(c - a) == DVec3::ZERO => [a, c, d],
                _ => [corners[0], corners[1], corners[2]],
            }
        });
        let mut by_plane: Vec<(u64, u32, u32)> = prints
            .into_iter()
            .enumerate()
            .filter(|&(face, _)| match *self.corners(face) {
                [a, b, c, d] => is_coplanar(a, b, c, d),
                _ => true,
            })
            .filter_map(|(face, print)| Some((print?, self.rank(face), face as u32)))
            .collect();
        rayon::slice::ParallelSliceMut::par_sort_unstable(by_plane.as_mut_slice());

        let mut planes = vec![FacePlane::Own; self.flat_count()];
        for group in by_plane.chunk_by(|a, b| a.0 == b.0) {
            let first = group[0].2 as usize;
            if group.len() > 1 || first >= triangles {
                self.share_plane(group.iter().map(|&(_, _, face)| face as usize), &mut planes);
            }
        }
        // Quadrangles that are flat only within rounding share theirs with those of the same
        // corners.
        let mut by_corners: Vec<([u32; 4], u32, usize)> = (triangles..self.flat_count())
            .filter(|&face| matches!(planes[face], FacePlane::Own))
            .map(|face| {
                let mut corners = [0; 4];
                corners.copy_from_slice(&self.welded[self.corner_range(face)]);
                corners.sort_unstable();
                (corners, self.rank(face), face)
            })
            .collect();
        by_corners.sort_unstable();
        for group in by_corners.chunk_by(|a, b| a.0 == b.0) {
            self.share_plane(group.iter().map(|&(_, _, face)| face), &mut planes);
        }
        self.planes = planes;
    }

    /// Gives faces one record, the plane of the first of them.
    fn share_plane(&mut self, group: impl Iterator<Item = usize>, planes: &mut [FacePlane]) {
        let mut group = group.peekable();
        let plane = self.plane_of(*group.peek().expect("a group has a face"));
        let index = self.shared.len() as u32;
        for face in group {
            let normal = plane::unit_normal(self.corners(face));
            let reversed = normal.dot(DVec3::from_array(plane.normal)) < 0.0;
            planes[face] = FacePlane::Shared(PlaneIndex(index | u32::from(reversed) << 31));
        }
        self.shared.push(plane);
    }

    /// The plane through the mean corner with Newell's normal.
    fn plane_of(&self, face: usize) -> PlaneRecord {
        let corners = self.corners(face);
        let from_first: DVec3 = corners.iter().map(|&corner| corner - corners[0]).sum();
        let mean = corners[0] + from_first / corners.len() as f64;
        PlaneRecord { point: mean.to_array(), normal: plane::unit_normal(corners).to_array() }
    }

    fn frame(&self) -> Frame {
        let spheres = self.scene.spheres.iter().flat_map(|sphere| {
            let (center, radius) = (sphere.center * self.scale, sphere.radius * self.scale);
            [center - radius, center + radius]
        });
        let (mut min, mut max) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
        for point in self.corners.iter().copied().chain(spheres) {
            (min, max) = (min.min(point), max.max(point));
        }
        if min.x > max.x {
            return Frame { origin: [0.0; 3], scale: 1.0 };
        }
        let origin = min + (max - min) / 2.0;
        let extent = (max - origin).max(origin - min).max_element();
        Frame { origin: origin.to_array(), scale: power_of_two_below_inverse(extent) }
    }

    fn leaflets(&self, frame: &Frame) -> Vec<Leaflet> {
        use rayon::prelude::*;
        let origin = DVec3::from_array(frame.origin);
        let bounds = |min: DVec3, max: DVec3| {
            // Rounding to f64 must not pull a box in.
            let relative = |point: DVec3| ((point - origin) * frame.scale).to_array();
            Bounds {
                min: relative(min).map(|x| node::below(x - x.abs() * f64::EPSILON)),
                max: relative(max).map(|x| node::above(x + x.abs() * f64::EPSILON)),
            }
        };
        let flat = (0..self.flat_count()).into_par_iter().map(|face| {
            let corners = self.corners(face);
            let min = corners.iter().copied().reduce(DVec3::min).expect("corners");
            let max = corners.iter().copied().reduce(DVec3::max).expect("corners");
            Leaflet { bounds: bounds(min, max), face: face as u32 }
        });
        let spheres = self.scene.spheres.par_iter().enumerate().map(|(k, sphere)| {
            let (center, radius) = (sphere.center * self.scale, sphere.radius * self.scale);
            let radius = radius + (radius + center.abs().max_element()) * f64::EPSILON;
            let face = (self.flat_count() + k) as u32;
            Leaflet { bounds: bounds(center - radius, center + radius), face }
        });
        flat.chain(spheres).collect()
    }

    fn sort(&self, leaflets: &[Leaflet]) -> Sorted {
        let triangles = self.scene.triangles.len();
        let sphere_surfaces = self.sphere_surfaces();
        let mut sorted = Sorted {
            items: Vec::with_capacity(leaflets.len()),
            vertices: Vec::new(),
            triangles: Vec::new(),
            coplanars: Vec::new(),
            quadrangles: Vec::new(),
            spheres: Vec::new(),
            planes: self.shared.clone(),
        };
        // Vertices are numbered in the order in which leaves come to them.
        let mut numbers = vec![u32::MAX; self.corners.len()];
        for leaflet in leaflets {
            let face = leaflet.face as usize;
            if face >= self.flat_count() {
                let sphere = &self.scene.spheres[face - self.flat_count()];
                sorted.items.push(Item::new(Kind::Sphere, sorted.spheres.len()));
                sorted.spheres.push(SphereRecord {
                    center: (sphere.center * self.scale).to_array(),
                    radius: sphere.radius * self.scale,
                    material: sphere.material,
                    rank: sphere.primitive,
                    surface: sphere_surfaces[face - self.flat_count()],
                    padding: 0,
                });
                continue;
            }
            let mut vertices = [0; 4];
            for (slot, corner) in vertices.iter_mut().zip(self.corner_range(face)) {
                let number = &mut numbers[self.welded[corner] as usize];
                if *number == u32::MAX {
                    *number = sorted.vertices.len() as u32;
                    sorted.vertices.push(self.corners[corner].to_array());
                }
                *slot = *number;
            }
            let [a, b, c, _] = vertices;
            let rank = self.rank(face);
            match self.planes[face] {
                FacePlane::Shared(plane) if face >= triangles => {
                    let material = self.scene.quadrangles[face - triangles].material;
                    sorted.items.push(Item::new(Kind::Quadrangle, sorted.quadrangles.len()));
                    let record = QuadrangleRecord { vertices, material, rank, plane, padding: 0 };
                    sorted.quadrangles.push(record);
                }
                FacePlane::Shared(plane) => {
                    let material = self.scene.triangles[face].material;
                    sorted.items.push(Item::new(Kind::Coplanar, sorted.coplanars.len()));
                    let record = CoplanarRecord { vertices: [a, b, c], material, rank, plane };
                    sorted.coplanars.push(record);
                }
                FacePlane::Own => {
                    let material = self.scene.triangles[face].material;
                    sorted.items.push(Item::new(Kind::Triangle, sorted.triangles.len()));
                    sorted.triangles.push(TriangleRecord { vertices: [a, b, c], material, rank });
                }
            }
        }
        sorted
    }

    /// The surface of each sphere: the rank of the first one equal to it.
    fn sphere_surfaces(&self) -> Vec<u32> {
        let mut firsts = std::collections::HashMap::new();
        self.scene
            .spheres
            .iter()
            .map(|sphere| {
                let [x, y, z] = sphere.center.to_array().map(f64::to_bits);
                *firsts.entry([x, y, z, sphere.radius.to_bits()]).or_insert(sphere.primitive)
            })
            .collect()
    }
}

impl Sorted {
    /// The surfaces that a point lies on, within rounding.
    fn surfaces_at(&self, point: DVec3) -> Vec<Surface> {
        let mut surfaces = Vec::new();
        let mut add_flat = |corners: &[u32], normal: DVec3, surface: Surface| {
            let corners =
                corners.iter().map(|&corner| DVec3::from_array(self.vertices[corner as usize]));
            let (mut min, mut max) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
            for corner in corners.clone() {
                (min, max) = (min.min(corner), max.max(corner));
            }
            let blur = 8.0 * f64::EPSILON * (max.abs().max(min.abs()).max(point.abs()));
            if point.cmpge(min - blur).all() && point.cmple(max + blur).all() {
                let corner = corners.clone().next().expect("a corner");
                let height = normal.dot(point - corner).abs();
                if height <= blur.max_element() {
                    surfaces.push(surface);
                }
            }
        };
        for triangle in &self.triangles {
            let corners = triangle.vertices.map(|v| DVec3::from_array(self.vertices[v as usize]));
            let normal = triangle_normal(corners);
            add_flat(&triangle.vertices, normal, Surface(triangle.rank));
        }
        for face in &self.coplanars {
            let normal = DVec3::from_array(self.planes[face.plane.index()].normal);
            add_flat(&face.vertices, normal, face.plane.surface());
        }
        for face in &self.quadrangles {
            let normal = DVec3::from_array(self.planes[face.plane.index()].normal);
            add_flat(&face.vertices, normal, face.plane.surface());
        }
        for sphere in &self.spheres {
            let from_center = point - DVec3::from_array(sphere.center);
            let blur = 8.0 * f64::EPSILON * (sphere.radius + point.abs().max_element());
            if (from_center.length() - sphere.radius).abs() <= blur {
                surfaces.push(Surface(sphere.surface));
            }
        }
        surfaces.sort_unstable_by_key(|surface| surface.0);
        surfaces.dedup();
        surfaces
    }
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
        let mut next = || sections.next().expect("as many as there are");
        View {
            header,
            nodes: bytemuck::cast_slice(next()),
            items: bytemuck::cast_slice(next()),
            vertices: bytemuck::cast_slice(next()),
            triangles: bytemuck::cast_slice(next()),
            coplanars: bytemuck::cast_slice(next()),
            quadrangles: bytemuck::cast_slice(next()),
            spheres: bytemuck::cast_slice(next()),
            planes: bytemuck::cast_slice(next()),
            materials: bytemuck::cast_slice(next()),
            lights: bytemuck::cast_slice(next()),
            touches: bytemuck::cast_slice(next()),
        }
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
    ensure(finite(&header.background) && finite(&header.ambient), "a colour")?;
    let is_scale = |x: f64| x.is_normal() && x > 0.0 && (1.0 / x).is_normal();
    ensure(is_scale(header.scale) && is_scale(header.frame.scale), "a scale")?;
    ensure(finite(&header.frame.origin), "the frame")?;

    let mut levels = vec![0_u8; view.nodes.len()];
    *levels.first_mut().ok_or("no root")? = 1;
    for (index, node) in view.nodes.iter().enumerate() {
        ensure(levels[index] > 0, "a node without a parent")?;
        ensure(node.planes.as_flattened().iter().all(|x| !x.is_nan()), "a box")?;
        for &child in node.children.iter().filter(|&&child| child != Child::NONE) {
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
    ensure(view.materials.iter().all(|material| finite(&material.color)), "a material")?;
    for light in view.lights {
        ensure(finite(&light.position) && finite(&light.intensity), "a light")?;
        let end = light.touches_first as usize + light.touches_count as usize;
        ensure(end <= view.touches.len(), "a light")?;
    }
    Ok(())
}
