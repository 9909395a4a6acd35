//! A scene into the records of a prepared scene.

pub(crate) mod bvh;
mod emitter_tree;
mod emitters;
pub(crate) mod mip_maps;
mod planes;
mod weld;

use std::collections::HashMap;

use rayon::prelude::*;

use self::bvh::{Bounds, BuildPrimitive};
use self::emitters::{Emitters, smaller_ball, within};
use self::mip_maps::MipMaps;
use self::weld::weld;

use glam::{DVec2, DVec3};

use crate::{
    exact::{
        float::{above, below, power_of_two_below_inverse},
        predicates::is_coplanar,
    },
    prepared::{
        bytes::{PreparedBytes, assemble},
        face::triangle_normal,
        layout::Sections,
        node::{Child, Frame},
        record::{
            Camera, CoplanarRecord, EmitterNode, EmitterRecord, Features, Item, Kind, LeafRecord,
            LightRecord, Lighting, MaterialRecord, NO_NODE, PlaneIndex, PlaneRecord,
            QuadrangleRecord, SolidNodeKind, SolidNodeRecord, SolidRecord, SphereRecord, Surface,
            Texcoords, TexturedFace, TriangleRecord,
        },
    },
    scene::{self, Material, Mesh, MeshVertices, Operation, Parallelepiped, Scene, SolidNode},
    transfer::Transfer,
};

/// Why a scene cannot be prepared.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum PrepareError {
    /// There is nothing to look through.
    #[error("a picture needs a `viewport` block with origin, topleft, bottomleft and topright")]
    NoViewport,
    /// More faces than indices reach.
    #[error("the scene has {0} faces; at most {limit} can be rendered", limit = Child::ITEM_LIMIT)]
    TooManyFaces(u64),
    /// A light that, seen in the scene's own units, is no finite number.
    #[error("light {0} (counted from 1) is too strong for numbers to hold")]
    Light(usize),
}

/// Turns a scene into a prepared scene, on rayon's threads; the same scene gives the same bytes on
/// any number of them.
pub fn prepare(scene: &Scene) -> Result<PreparedBytes, PrepareError> {
    prepare_with(scene, true)
}

/// The same. Without records of the emitters, light that faces send on is looked for over the
/// whole hemisphere alone: the noisier way that benchmarks compare with.
#[doc(hidden)]
pub fn prepare_with(
    scene: &Scene,
    keeps_emitter_records: bool,
) -> Result<PreparedBytes, PrepareError> {
    let viewport = scene.viewport.ok_or(PrepareError::NoViewport)?;
    let ranks = Ranks::new(scene);
    if ranks.count > Child::ITEM_LIMIT as u64 {
        return Err(PrepareError::TooManyFaces(ranks.count));
    }
    let mut faces = Faces::gather(scene, &ranks);
    let scale = power_of_two_below_inverse(faces.extent().max(extent_of_rest(scene, &viewport)));
    faces.scale(scale);
    faces.find_planes();
    faces.find_equal_spheres();
    let frame = faces.frame();
    let mut primitives = faces.primitives(&frame);
    let nodes = bvh::build_bvh(&mut primitives);
    let mut sorted = faces.sort(&primitives);

    let mut lights = Vec::with_capacity(scene.lights.len());
    let mut coincident = Vec::new();
    for (k, light) in scene.lights.iter().enumerate() {
        let position = light.position * scale;
        let intensity = light.intensity * scale * scale;
        if !intensity.is_finite() {
            return Err(PrepareError::Light(k + 1));
        }
        let surfaces = sorted.surfaces_at(position);
        let run = coincident.len()..coincident.len() + surfaces.len();
        lights.push(LightRecord::new(position, intensity, run));
        coincident.extend(surfaces);
    }
    let images = Images::gather(scene, &ranks);
    let materials: Vec<MaterialRecord> = (scene.materials.iter().zip(&images.of_materials))
        .map(|(material, &texture)| material_record(material, texture))
        .collect();
    let [eye, top_left, bottom_left, top_right] =
        [viewport.eye, viewport.top_left, viewport.bottom_left, viewport.top_right]
            .map(|point| point * scale);
    let camera = Camera {
        eye: eye.to_array(),
        top_left: (top_left - eye).to_array(),
        right: (top_right - top_left).to_array(),
        down: (bottom_left - top_left).to_array(),
    };
    let lighting = Lighting {
        background: scene.background.to_array(),
        ambient: scene.ambient.unwrap_or_default().to_array(),
    };
    let mut features = features(scene, &images);
    let (mut emitters, mut emitter_nodes) = (Vec::new(), Vec::new());
    if features.is_lit == 1 && materials.iter().any(MaterialRecord::emits) {
        let found = Emitters::new(&materials, &lights, DVec3::from_array(lighting.ambient));
        (emitters, emitter_nodes) = faces.find_emitters(found, &mut sorted);
        features.has_emitters = u32::from(!emitters.is_empty());
        if !keeps_emitter_records {
            (emitters, emitter_nodes) = (Vec::new(), Vec::new());
        }
    }
    let sections = Sections {
        nodes: &nodes,
        items: &sorted.items,
        vertices: &sorted.vertices,
        triangles: &sorted.triangles,
        coplanars: &sorted.coplanars,
        quadrangles: &sorted.quadrangles,
        spheres: &sorted.spheres,
        planes: sorted.planes,
        materials: &materials,
        lights: &lights,
        coincident: &coincident,
        solids: &sorted.solids,
        solid_nodes: sorted.solid_nodes,
        leaves: sorted.leaves,
        first_ranks: &ranks.firsts,
        emitters: &emitters,
        emitter_nodes: &emitter_nodes,
        textured_faces: &images.faces,
        textures: &images.mip_maps.textures,
        texture_levels: &images.mip_maps.levels,
        fine_texels: &images.mip_maps.fine,
        coarse_texels: &images.mip_maps.coarse,
    };
    Ok(assemble(camera, lighting, frame, scale, features, &sections))
}

/// The images that faces show, and the texture coordinates of those faces by ascending rank.
struct Images {
    mip_maps: MipMaps,
    /// Of each material, the image in `mip_maps` or [`MaterialRecord::PLAIN`].
    of_materials: Vec<u32>,
    faces: Vec<TexturedFace>,
}

impl Images {
    fn gather(scene: &Scene, ranks: &Ranks) -> Self {
        let is_textured = |material: u32| scene.materials[material as usize].texture.is_some();
        let triangle_texcoords: HashMap<u32, [DVec2; 3]> =
            scene.triangle_texcoords.iter().copied().collect();
        let triangles = (0..).zip(&scene.triangles).map(|(index, face)| {
            let texcoords = triangle_texcoords
                .get(&index)
                .map_or(Texcoords::DEFAULT, |&given| Texcoords::of_triangle(given));
            (face.material, face.primitive, texcoords)
        });
        let quadrangle_texcoords: HashMap<u32, [DVec2; 4]> =
            scene.quadrangle_texcoords.iter().copied().collect();
        let quadrangles = (0..).zip(&scene.quadrangles).map(|(index, face)| {
            let texcoords = quadrangle_texcoords
                .get(&index)
                .map_or(Texcoords::DEFAULT, |&given| Texcoords::of_quadrangle(given));
            (face.material, face.primitive, texcoords)
        });
        let mut is_worn = vec![false; scene.materials.len()];
        let mut faces = Vec::new();
        for (material, primitive, texcoords) in triangles.chain(quadrangles) {
            if is_textured(material) {
                is_worn[material as usize] = true;
                faces.push(TexturedFace::new(ranks.first(primitive), texcoords));
            }
        }
        faces.par_sort_unstable_by_key(|face| face.rank);

        let mut mip_maps = MipMaps { transfer: scene.transfer, ..MipMaps::default() };
        let mut numbers = vec![None; scene.textures.len()];
        let of_materials = (scene.materials.iter().zip(is_worn))
            .map(|(material, is_worn)| match material.texture {
                Some(texture) if is_worn => *numbers[texture as usize].get_or_insert_with(|| {
                    mip_maps.add(&scene.textures[texture as usize]);
                    mip_maps.textures.len() as u32 - 1
                }),
                _ => MaterialRecord::PLAIN,
            })
            .collect();
        Self { mip_maps, of_materials, faces }
    }
}

fn material_record(material: &Material, texture: u32) -> MaterialRecord {
    let Material { color, reflect, alpha, refract, .. } = *material;
    MaterialRecord::new(color, [reflect, alpha, refract], texture)
}

fn worn_by(count: usize, materials: impl Iterator<Item = u32>) -> Vec<bool> {
    let mut is_worn = vec![false; count];
    for material in materials {
        is_worn[material as usize] = true;
    }
    is_worn
}

/// What the scene needs of the tracer.
fn features(scene: &Scene, images: &Images) -> Features {
    let leaf_materials = scene.solids.iter().flat_map(|solid| {
        solid.nodes.iter().filter_map(|node| match node {
            SolidNode::Sphere(sphere) => Some(sphere.material),
            SolidNode::Parallelepiped(solid) => Some(solid.material),
            SolidNode::Operation { .. } => None,
        })
    });
    let is_worn = worn_by(
        scene.materials.len(),
        (scene.triangles.iter().map(|face| face.material))
            .chain(scene.quadrangles.iter().map(|face| face.material))
            .chain(scene.spheres.iter().map(|sphere| sphere.material))
            .chain(scene.parallelepipeds.iter().map(|solid| solid.material))
            .chain(scene.meshes.iter().map(|mesh| mesh.material))
            .chain(leaf_materials),
    );
    let worn = || scene.materials.iter().zip(&is_worn).filter(|(_, is_worn)| **is_worn);
    let is_clear = |m: &Material| m.alpha < 1.0 && m.reflect < 1.0;
    Features {
        is_lit: u32::from(scene.ambient.is_some() || !scene.lights.is_empty()),
        has_branches: u32::from(worn().any(|(m, _)| m.reflect > 0.0 || is_clear(m))),
        has_clear_shadows: u32::from(worn().any(|(m, _)| is_clear(m))),
        has_solids: u32::from(!scene.solids.is_empty()),
        has_emitters: 0,
        has_textures: u32::from(!images.faces.is_empty()),
        has_srgb_texels: u32::from(!images.faces.is_empty() && scene.transfer == Transfer::Srgb),
        padding: 0,
    }
}

/// The largest coordinate of what is no face.
fn extent_of_rest(scene: &Scene, viewport: &scene::Viewport) -> f64 {
    [viewport.eye, viewport.top_left, viewport.bottom_left, viewport.top_right]
        .into_iter()
        .chain(scene.lights.iter().map(|light| light.position))
        .fold(0.0, |largest, point| largest.max(point.abs().max_element()))
}

/// The order of all faces: by primitive, then by face.
struct Ranks {
    /// The first rank of each primitive; empty where every primitive has one face.
    firsts: Vec<u32>,
    /// How many ranks there are.
    count: u64,
}

impl Ranks {
    fn new(scene: &Scene) -> Self {
        let counts = (scene.parallelepipeds.iter().map(|solid| (solid.primitive, 6)))
            .chain(
                scene.meshes.iter().map(|mesh| (mesh.primitive, mesh.shape.triangles.len() as u64)),
            )
            .chain(scene.solids.iter().map(|solid| {
                let is_leaf = |node: &&SolidNode| !matches!(node, SolidNode::Operation { .. });
                (solid.primitive, 6 * solid.nodes.iter().filter(is_leaf).count() as u64)
            }));
        let several: HashMap<u32, u64> = counts.filter(|&(_, count)| count != 1).collect();
        let primitives = (scene.triangles.iter().map(|face| face.primitive))
            .chain(scene.quadrangles.iter().map(|face| face.primitive))
            .chain(scene.spheres.iter().map(|face| face.primitive))
            .chain(scene.parallelepipeds.iter().map(|face| face.primitive))
            .chain(scene.solids.iter().map(|face| face.primitive))
            .chain(scene.meshes.iter().map(|face| face.primitive))
            .max()
            .map_or(0, |last| last + 1);
        if several.is_empty() {
            return Self { firsts: Vec::new(), count: primitives.into() };
        }
        let mut count = 0;
        let firsts = (0..primitives)
            .map(|primitive| {
                let first = count;
                count += several.get(&primitive).copied().unwrap_or(1);
                first.min(u32::MAX.into()) as u32
            })
            .collect();
        Self { firsts, count }
    }

    fn first(&self, primitive: u32) -> u32 {
        self.firsts.get(primitive as usize).copied().unwrap_or(primitive)
    }
}

/// All faces of a scene. The corners of flat ones stand in this order: triangles with three each,
/// quadrangles with four each, the faces of solids' parallelepipeds with four each.
struct Faces {
    corners: Vec<DVec3>,
    triangle_count: usize,
    quadrangle_count: usize,
    /// The edges of each parallelepiped's faces, which stand last among the flat faces: the sum
    /// of a corner and an edge rounds, and would turn the plane of a needle.
    spans: Vec<[DVec3; 2]>,
    /// Of each triangle and each quadrangle: its material and its rank.
    wear: Vec<(u32, u32)>,
    /// Which vertex each corner is: the first corner at that place.
    welded: Vec<u32>,
    /// The plane of each flat face.
    planes: Vec<FacePlane>,
    shared: Vec<PlaneRecord>,
    spheres: Vec<SphereRecord>,
    solids: Vec<SolidRecord>,
    solid_bounds: Vec<(DVec3, DVec3)>,
    solid_nodes: Vec<SolidNodeRecord>,
    leaves: Vec<LeafRecord>,
    /// For each leaf that is a parallelepiped, its number among the leaves and its rank.
    boxes: Vec<(usize, u32)>,
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
struct Sorted<'a> {
    items: Vec<Item>,
    vertices: Vec<[f64; 3]>,
    triangles: Vec<TriangleRecord>,
    coplanars: Vec<CoplanarRecord>,
    quadrangles: Vec<QuadrangleRecord>,
    spheres: Vec<SphereRecord>,
    planes: &'a [PlaneRecord],
    solids: Vec<SolidRecord>,
    solid_nodes: &'a [SolidNodeRecord],
    leaves: &'a [LeafRecord],
}

impl Faces {
    fn gather(scene: &Scene, ranks: &Ranks) -> Self {
        let mut corners: Vec<DVec3> =
            scene.triangles.iter().flat_map(|face| face.vertices).collect();
        let mut wear: Vec<(u32, u32)> = (scene.triangles.iter())
            .map(|face| (face.material, ranks.first(face.primitive)))
            .collect();
        for mesh in &scene.meshes {
            let vertices = place_mesh(mesh);
            let first = ranks.first(mesh.primitive);
            for (face, triangle) in (0..).zip(&mesh.shape.triangles) {
                corners.extend(triangle.map(|corner| vertices[corner as usize]));
                wear.push((mesh.material, first + face));
            }
        }
        let triangle_count = wear.len();
        let mut spans = Vec::new();
        corners.extend(scene.quadrangles.iter().flat_map(|face| face.vertices));
        wear.extend(
            scene.quadrangles.iter().map(|face| (face.material, ranks.first(face.primitive))),
        );
        for solid in &scene.parallelepipeds {
            let first = ranks.first(solid.primitive);
            corners.extend(box_faces(solid).as_flattened());
            spans.extend(box_spans(solid));
            wear.extend((0..6).map(|face| (solid.material, first + face)));
        }
        let quadrangle_count = wear.len() - triangle_count;
        let spheres = (scene.spheres.iter())
            .map(|sphere| {
                let rank = ranks.first(sphere.primitive);
                SphereRecord::new(sphere.center, sphere.radius, sphere.material, rank)
            })
            .collect();
        let mut faces = Self {
            corners,
            triangle_count,
            quadrangle_count,
            spans,
            wear,
            welded: Vec::new(),
            planes: Vec::new(),
            shared: Vec::new(),
            spheres,
            solids: Vec::new(),
            solid_bounds: Vec::new(),
            solid_nodes: Vec::new(),
            leaves: Vec::new(),
            boxes: Vec::new(),
        };
        for solid in &scene.solids {
            faces.add_solid(solid, ranks.first(solid.primitive));
        }
        faces
    }

    fn add_solid(&mut self, solid: &scene::Solid, rank: u32) {
        let (first_node, first_leaf) = (self.solid_nodes.len(), self.leaves.len());
        // What waits to be an operand: its node and its bounds.
        let mut waiting: Vec<(u32, (DVec3, DVec3))> = Vec::new();
        for (index, node) in (0..).zip(&solid.nodes) {
            let number = (self.leaves.len() - first_leaf) as u32;
            let mut record = SolidNodeRecord {
                kind: SolidNodeKind::LEAF,
                parent: NO_NODE,
                first_child: number,
                next: NO_NODE,
                operands: 0,
                is_first: 0,
            };
            let bounds = match node {
                SolidNode::Sphere(sphere) => {
                    self.leaves.push(LeafRecord::sphere(
                        sphere.center,
                        sphere.radius,
                        sphere.material,
                        index,
                    ));
                    (sphere.center - sphere.radius, sphere.center + sphere.radius)
                }
                SolidNode::Parallelepiped(solid) => {
                    self.boxes.push((self.leaves.len(), rank + 6 * number));
                    self.leaves.push(LeafRecord::parallelepiped(solid.material, index));
                    let faces = box_faces(solid);
                    self.corners.extend(faces.as_flattened());
                    self.spans.extend(box_spans(solid));
                    bounds_of(faces.as_flattened())
                }
                SolidNode::Operation { operation, operands } => {
                    let operands = waiting.split_off(waiting.len() - *operands as usize);
                    record.kind = match operation {
                        Operation::Union => SolidNodeKind::UNION,
                        Operation::Intersection => SolidNodeKind::INTERSECTION,
                        Operation::Difference => SolidNodeKind::DIFFERENCE,
                    };
                    record.operands = operands.len() as u32;
                    record.first_child = operands[0].0;
                    for (k, &(child, _)) in operands.iter().enumerate() {
                        let next = operands.get(k + 1).map_or(NO_NODE, |next| next.0);
                        let child = &mut self.solid_nodes[first_node + child as usize];
                        (child.parent, child.next) = (index, next);
                        child.is_first = u32::from(k == 0);
                    }
                    let bounds = operands.iter().map(|&(_, bounds)| bounds);
                    match operation {
                        Operation::Union => bounds.reduce(|a, b| (a.0.min(b.0), a.1.max(b.1))),
                        Operation::Intersection => {
                            bounds.reduce(|a, b| (a.0.max(b.0), a.1.min(b.1)))
                        }
                        Operation::Difference => bounds.take(1).next(),
                    }
                    .expect("two operands or more")
                }
            };
            self.solid_nodes.push(record);
            waiting.push((index, bounds));
        }
        let (_, bounds) = waiting.pop().expect("a root");
        self.turn_subtracted(first_node, first_leaf);
        self.solids.push(SolidRecord::new(
            first_node..self.solid_nodes.len(),
            first_leaf..self.leaves.len(),
            rank,
        ));
        self.solid_bounds.push(bounds);
    }

    /// Marks the leaves of a solid whose faces look the other way: taken away an odd number of
    /// times.
    fn turn_subtracted(&mut self, first_node: usize, first_leaf: usize) {
        let nodes = &self.solid_nodes[first_node..];
        let mut is_turned = vec![false; nodes.len()];
        for index in (0..nodes.len()).rev() {
            let SolidNodeRecord { parent, is_first, .. } = nodes[index];
            if parent != NO_NODE {
                let is_taken =
                    nodes[parent as usize].kind == SolidNodeKind::DIFFERENCE && is_first == 0;
                is_turned[index] = is_turned[parent as usize] ^ is_taken;
            }
        }
        for leaf in &mut self.leaves[first_leaf..] {
            leaf.is_reversed = u32::from(is_turned[leaf.node as usize]);
        }
    }

    /// The largest coordinate.
    fn extent(&self) -> f64 {
        let of_sphere = |center: &[f64; 3], radius: f64| {
            DVec3::from_array(*center).abs().max_element().max(radius)
        };
        (self.corners.iter().map(|corner| corner.abs().max_element()))
            .chain(self.spheres.iter().map(|sphere| of_sphere(&sphere.center, sphere.radius)))
            .chain(self.leaves.iter().map(|leaf| of_sphere(&leaf.center, leaf.radius)))
            .fold(0.0, f64::max)
    }

    /// Multiplies every coordinate by a power of two.
    fn scale(&mut self, scale: f64) {
        self.corners.iter_mut().for_each(|corner| *corner *= scale);
        for sphere in &mut self.spheres {
            sphere.center = sphere.center.map(|x| x * scale);
            sphere.radius *= scale;
        }
        for leaf in &mut self.leaves {
            leaf.center = leaf.center.map(|x| x * scale);
            leaf.radius *= scale;
        }
        for bounds in &mut self.solid_bounds {
            *bounds = (bounds.0 * scale, bounds.1 * scale);
        }
        self.welded = weld(&self.corners);
    }

    /// Flat faces that are items of their own.
    fn flat_count(&self) -> usize {
        self.triangle_count + self.quadrangle_count
    }

    /// The corners of a flat face.
    fn corners(&self, face: usize) -> &[DVec3] {
        let range = self.corner_range(face);
        &self.corners[range]
    }

    fn corner_range(&self, face: usize) -> std::ops::Range<usize> {
        if face < self.triangle_count {
            3 * face..3 * face + 3
        } else {
            let first = 3 * self.triangle_count + 4 * (face - self.triangle_count);
            first..first + 4
        }
    }

    /// The rank of a flat face, those of solids included.
    fn rank(&self, face: usize) -> u32 {
        if let Some(&(_, rank)) = self.wear.get(face) {
            return rank;
        }
        let of_solids = face - self.flat_count();
        self.boxes[of_solids / 6].1 + (of_solids % 6) as u32
    }

    /// Gives flat faces in exactly one plane one record, that of the face that comes first.
    fn find_planes(&mut self) {
        let triangles = self.triangle_count;
        let count = self.flat_count() + 6 * self.boxes.len();
        let prints = planes::plane_prints(count, |face| {
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
        by_plane.par_sort_unstable();

        let mut planes = vec![FacePlane::Own; count];
        for group in by_plane.chunk_by(|a, b| a.0 == b.0) {
            let first = group[0].2 as usize;
            if group.len() > 1 || first >= triangles {
                self.share_plane(group.iter().map(|&(_, _, face)| face as usize), &mut planes);
            }
        }
        // Quadrangles that are flat only within rounding share theirs with those of the same
        // corners.
        let mut by_corners: Vec<([u32; 4], u32, usize)> = (triangles..count)
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
        let of_solids = &planes[self.flat_count()..];
        for (&(leaf, _), planes) in self.boxes.iter().zip(of_solids.chunks(6)) {
            for (slot, plane) in self.leaves[leaf].planes.iter_mut().zip(planes) {
                if let FacePlane::Shared(plane) = plane {
                    *slot = *plane;
                }
            }
        }
        self.planes = planes;
    }

    /// Gives faces, in the order of their ranks, the first one's plane.
    fn share_plane(&mut self, group: impl Iterator<Item = usize>, planes: &mut [FacePlane]) {
        let mut group = group.peekable();
        let plane = self.plane_of(*group.peek().expect("a group has a face"));
        let index = self.shared.len();
        for face in group {
            let is_turned = self.normal_of(face).dot(DVec3::from_array(plane.normal)) < 0.0;
            planes[face] = FacePlane::Shared(PlaneIndex::new(index, is_turned));
        }
        self.shared.push(plane);
    }

    /// The plane with Newell's normal through a triangle's first corner, which is in it exactly, or
    /// through the mean corner of a quadrangle, whose corners may be only nearly in one plane.
    fn plane_of(&self, face: usize) -> PlaneRecord {
        let corners = self.corners(face);
        let point = if corners.len() == 3 {
            corners[0]
        } else {
            let from_first: DVec3 = corners.iter().map(|&corner| corner - corners[0]).sum();
            corners[0] + from_first / corners.len() as f64
        };
        PlaneRecord { point: point.to_array(), normal: self.normal_of(face).to_array() }
    }

    /// The unit normal of a flat face.
    fn normal_of(&self, face: usize) -> DVec3 {
        let count = self.flat_count() + 6 * self.boxes.len();
        match face.checked_sub(count - self.spans.len()) {
            Some(span) => {
                let [u, v] = self.spans[span];
                planes::unit_normal(&[DVec3::ZERO, u, v])
            }
            None => planes::unit_normal(self.corners(face)),
        }
    }

    /// Gives equal spheres one surface: the first one's rank.
    fn find_equal_spheres(&mut self) {
        let key = |center: &[f64; 3], radius: f64| (center.map(f64::to_bits), radius.to_bits());
        let mut firsts = HashMap::new();
        for sphere in &mut self.spheres {
            let key = key(&sphere.center, sphere.radius);
            sphere.surface = *firsts.entry(key).or_insert(sphere.rank);
        }
        for solid in &self.solids {
            for (number, leaf) in (0..).zip(&mut self.leaves[solid.leaves()]) {
                let own = solid.rank + 6 * number;
                leaf.surface = *firsts.entry(key(&leaf.center, leaf.radius)).or_insert(own);
            }
        }
    }

    /// The bounds of everything that is not flat: spheres, then solids.
    fn round_bounds(&self) -> impl Iterator<Item = (DVec3, DVec3)> {
        let spheres = self.spheres.iter().map(|sphere| {
            let center = DVec3::from_array(sphere.center);
            (center - sphere.radius, center + sphere.radius)
        });
        // An empty intersection has bounds inside out.
        let solids = self.solid_bounds.iter().map(|&(min, max)| (min.min(max), max.max(min)));
        spheres.chain(solids).map(|(min, max)| {
            let blur = 4.0 * f64::EPSILON * min.abs().max(max.abs()).max(max - min);
            (min - blur, max + blur)
        })
    }

    fn frame(&self) -> Frame {
        let flat = &self.corners[..3 * self.triangle_count + 4 * self.quadrangle_count];
        let points = flat.iter().map(|&corner| (corner, corner)).chain(self.round_bounds());
        let (mut min, mut max) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
        for (low, high) in points {
            (min, max) = (min.min(low), max.max(high));
        }
        if min.x > max.x {
            return Frame { origin: [0.0; 3], scale: 1.0 };
        }
        let origin = min + (max - min) / 2.0;
        let extent = (max - origin).max(origin - min).max_element();
        Frame { origin: origin.to_array(), scale: power_of_two_below_inverse(extent) }
    }

    fn primitives(&self, frame: &Frame) -> Vec<BuildPrimitive> {
        let origin = DVec3::from_array(frame.origin);
        let bounds = |(min, max): (DVec3, DVec3)| {
            // Rounding to f64 must not pull a box in.
            let relative = |point: DVec3| ((point - origin) * frame.scale).to_array();
            Bounds {
                min: relative(min).map(|x| below(x - x.abs() * f64::EPSILON)),
                max: relative(max).map(|x| above(x + x.abs() * f64::EPSILON)),
            }
        };
        let mut primitives: Vec<BuildPrimitive> = (0..self.flat_count())
            .into_par_iter()
            .map(|face| BuildPrimitive {
                bounds: bounds(bounds_of(self.corners(face))),
                face: face as u32,
            })
            .collect();
        let round = self.round_bounds().zip(self.flat_count() as u32..);
        primitives
            .extend(round.map(|(round, face)| BuildPrimitive { bounds: bounds(round), face }));
        primitives
    }

    fn sort(&self, primitives: &[BuildPrimitive]) -> Sorted<'_> {
        let mut sorted = Sorted {
            items: Vec::with_capacity(primitives.len()),
            vertices: Vec::new(),
            triangles: Vec::new(),
            coplanars: Vec::new(),
            quadrangles: Vec::new(),
            spheres: Vec::new(),
            planes: &self.shared,
            solids: Vec::new(),
            solid_nodes: &self.solid_nodes,
            leaves: &self.leaves,
        };
        // Vertices are numbered in the order in which leaves come to them.
        let mut numbers = vec![u32::MAX; self.corners.len()];
        for primitive in primitives {
            let face = primitive.face as usize;
            if let Some(round) = face.checked_sub(self.flat_count()) {
                if let Some(&sphere) = self.spheres.get(round) {
                    sorted.items.push(Item::new(Kind::Sphere, sorted.spheres.len()));
                    sorted.spheres.push(sphere);
                } else {
                    sorted.items.push(Item::new(Kind::Solid, sorted.solids.len()));
                    sorted.solids.push(self.solids[round - self.spheres.len()]);
                }
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
            let (material, rank) = self.wear[face];
            match self.planes[face] {
                FacePlane::Shared(plane) if face >= self.triangle_count => {
                    sorted.items.push(Item::new(Kind::Quadrangle, sorted.quadrangles.len()));
                    sorted.quadrangles.push(QuadrangleRecord::new(vertices, material, rank, plane));
                }
                FacePlane::Shared(plane) => {
                    sorted.items.push(Item::new(Kind::Coplanar, sorted.coplanars.len()));
                    let record = CoplanarRecord { vertices: [a, b, c], material, rank, plane };
                    sorted.coplanars.push(record);
                }
                FacePlane::Own => {
                    sorted.items.push(Item::new(Kind::Triangle, sorted.triangles.len()));
                    sorted.triangles.push(TriangleRecord { vertices: [a, b, c], material, rank });
                }
            }
        }
        sorted
    }

    /// All faces that send light on. Those of solids may need vertices that no other face has.
    fn find_emitters(
        &self,
        mut found: Emitters<'_>,
        sorted: &mut Sorted<'_>,
    ) -> (Vec<EmitterRecord>, Vec<EmitterNode>) {
        for face in &sorted.triangles {
            found.add_polygon((face.material, face.rank), &face.vertices, &sorted.vertices);
        }
        for face in &sorted.coplanars {
            found.add_polygon((face.material, face.rank), &face.vertices, &sorted.vertices);
        }
        for face in &sorted.quadrangles {
            found.add_polygon((face.material, face.rank), &face.vertices, &sorted.vertices);
        }
        for sphere in &sorted.spheres {
            found.add_sphere((sphere.material, sphere.rank), sphere.center, sphere.radius);
        }
        // In the order of `boxes`, so not that of the hierarchy.
        let mut corners =
            self.corners[3 * self.triangle_count + 4 * self.quadrangle_count..].chunks(4);
        for (solid, &bounds) in self.solids.iter().zip(&self.solid_bounds) {
            for (rank, leaf) in (solid.rank..).step_by(6).zip(&self.leaves[solid.leaves()]) {
                if leaf.is_sphere() {
                    let (center, radius) =
                        smaller_ball(DVec3::from_array(leaf.center), leaf.radius, bounds);
                    found.add_sphere((leaf.material, rank), center.to_array(), radius);
                    continue;
                }
                for (rank, corners) in (rank..).zip(corners.by_ref().take(6)) {
                    if !found.is_one(leaf.material) {
                        continue;
                    }
                    // The solid has nothing of the others.
                    let Some(corners) = within(corners, bounds) else { continue };
                    let first = sorted.vertices.len() as u32;
                    sorted.vertices.extend(corners.iter().map(DVec3::to_array));
                    let vertices = [first, first + 1, first + 2, first + 3];
                    found.add_polygon((leaf.material, rank), &vertices, &sorted.vertices);
                }
            }
        }
        found.finish()
    }
}

impl Sorted<'_> {
    /// The surfaces that a point lies on, within rounding.
    fn surfaces_at(&self, point: DVec3) -> Vec<Surface> {
        let mut surfaces = Vec::new();
        let mut add_flat = |corners: &[u32], normal: DVec3, surface: Surface| {
            let mut points = [DVec3::ZERO; 4];
            for (point, &corner) in points.iter_mut().zip(corners) {
                *point = DVec3::from_array(self.vertices[corner as usize]);
            }
            let (min, max) = bounds_of(&points[..corners.len()]);
            let blur = 8.0 * f64::EPSILON * (max.abs().max(min.abs()).max(point.abs()));
            let is_within = point.cmpge(min - blur).all() && point.cmple(max + blur).all();
            if is_within && normal.dot(point - points[0]).abs() <= blur.max_element() {
                surfaces.push(surface);
            }
        };
        for triangle in &self.triangles {
            let corners = triangle.vertices.map(|v| DVec3::from_array(self.vertices[v as usize]));
            add_flat(&triangle.vertices, triangle_normal(corners), Surface(triangle.rank));
        }
        for face in &self.coplanars {
            let normal = DVec3::from_array(self.planes[face.plane.index()].normal);
            add_flat(&face.vertices, normal, face.plane.surface());
        }
        for face in &self.quadrangles {
            let normal = DVec3::from_array(self.planes[face.plane.index()].normal);
            add_flat(&face.vertices, normal, face.plane.surface());
        }
        let is_on_sphere = |center: [f64; 3], radius: f64| {
            let blur = 8.0 * f64::EPSILON * (radius + point.abs().max_element());
            ((point - DVec3::from_array(center)).length() - radius).abs() <= blur
        };
        for sphere in &self.spheres {
            if is_on_sphere(sphere.center, sphere.radius) {
                surfaces.push(Surface(sphere.surface));
            }
        }
        for leaf in self.leaves {
            if leaf.is_sphere() {
                if is_on_sphere(leaf.center, leaf.radius) {
                    surfaces.push(Surface(leaf.surface));
                }
                continue;
            }
            for plane in leaf.planes {
                let record = &self.planes[plane.index()];
                let [on, normal] = [record.point, record.normal].map(DVec3::from_array);
                let blur = 8.0 * f64::EPSILON * (1.0 + point.abs().max_element());
                if normal.dot(point - on).abs() <= blur {
                    surfaces.push(plane.surface());
                }
            }
        }
        surfaces.sort_unstable_by_key(|surface| surface.0);
        surfaces.dedup();
        surfaces
    }
}

fn bounds_of(points: &[DVec3]) -> (DVec3, DVec3) {
    let none = (DVec3::INFINITY, DVec3::NEG_INFINITY);
    points.iter().fold(none, |(min, max), &point| (min.min(point), max.max(point)))
}

/// The faces of a parallelepiped, each counter-clockwise seen from outside: 2k is the one through
/// the corner that edge k leaves, 2k + 1 the one opposite.
fn box_faces(solid: &Parallelepiped) -> [[DVec3; 4]; 6] {
    let [u, v, w] = solid.edges;
    let is_left_handed = u.dot(v.cross(w)) < 0.0;
    // Every face adds edges in the same order: faces that share a corner agree on its bits.
    let corner = |is_far: [bool; 3]| {
        solid.edges.iter().zip(is_far).fold(solid.corner, |corner, (&edge, is_far)| {
            if is_far { corner + edge } else { corner }
        })
    };
    std::array::from_fn(|face| {
        let (axis, is_far) = (face / 2, face % 2 == 1);
        let (e, f) = ((axis + 1) % 3, (axis + 2) % 3);
        let (e, f) = if is_far == is_left_handed { (f, e) } else { (e, f) };
        [[false, false], [true, false], [true, true], [false, true]].map(|[along_e, along_f]| {
            let mut at = [is_far; 3];
            (at[e], at[f]) = (along_e, along_f);
            corner(at)
        })
    })
}

/// The two edges of each of those faces, so that the face looks along their cross product.
fn box_spans(solid: &Parallelepiped) -> [[DVec3; 2]; 6] {
    let [u, v, w] = solid.edges;
    let is_left_handed = u.dot(v.cross(w)) < 0.0;
    std::array::from_fn(|face| {
        let [e, f] = [solid.edges[(face / 2 + 1) % 3], solid.edges[(face / 2 + 2) % 3]];
        if (face % 2 == 1) == is_left_handed { [f, e] } else { [e, f] }
    })
}

/// The corners of a mesh where the scene wants them.
fn place_mesh(mesh: &Mesh) -> Vec<DVec3> {
    let turn = mesh.rotate.map(|(axis, degrees)| {
        let axis = axis * power_of_two_below_inverse(axis.abs().max_element());
        (axis / axis.length(), sine_and_cosine(degrees))
    });
    let place = |point: DVec3| {
        let mut point = point * mesh.scale;
        // Source: Rodrigues (1840).
        if let Some((axis, (sine, cosine))) = turn {
            point = point * cosine
                + axis.cross(point) * sine
                + axis * (axis.dot(point) * (1.0 - cosine));
        }
        point + mesh.offset
    };
    match &mesh.shape.vertices {
        MeshVertices::Single(vertices) => {
            vertices.iter().map(|v| place(DVec3::from_array(v.map(f64::from)))).collect()
        }
        MeshVertices::Double(vertices) => {
            vertices.iter().map(|&v| place(DVec3::from_array(v))).collect()
        }
    }
}

/// Exact for multiples of 90 degrees, the same bits on every machine for all.
fn sine_and_cosine(degrees: f64) -> (f64, f64) {
    let turned = degrees % 360.0;
    let quarters = (turned / 90.0).round();
    let rest = (turned - 90.0 * quarters).to_radians();
    let (sine, cosine) = (libm::sin(rest), libm::cos(rest));
    match (quarters as i32).rem_euclid(4) {
        0 => (sine, cosine),
        1 => (cosine, -sine),
        2 => (-sine, -cosine),
        _ => (-cosine, sine),
    }
}
