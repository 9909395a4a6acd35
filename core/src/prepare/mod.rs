//! A scene into the records of a prepared scene.
//!
//! Every step takes what the step before it made, so they cannot be called in another order: faces
//! are collected, scaled and welded, share their surfaces, get their hierarchy and are sorted into
//! records in its order. Then lights find the surfaces that they lie on, materials their images,
//! and emitters the light that they send on; a compact scene gets the nodes and the vertices of its
//! form, and all is assembled as one block.

mod bvh;
mod collect;
mod emitter_tree;
mod emitters;
mod equal_spheres;
mod error;
mod features;
mod flat;
mod form;
mod hierarchy;
mod lights;
pub(crate) mod mip_maps;
mod near_planes;
mod newell;
mod parallelepiped;
mod place;
mod plane_fingerprint;
mod planes;
mod ranks;
mod scale;
mod single;
mod solid_boxes;
mod solid_trees;
mod sort;
mod surfaces;
mod textures;
mod weld;

use glam::DVec3;
use rayon::prelude::*;

use self::{
    collect::Collected, emitters::Emitters, features::features, hierarchy::Hierarchy,
    lights::Lights, ranks::Ranks, scale::extent_of_eye_and_lights, single::split_vertices,
    textures::Textures,
};
pub use self::{error::PrepareError, form::Form};
use crate::{
    prepared::{
        bytes::{PreparedBytes, assemble},
        layout::Sections,
        node::CompactNode,
        record::{Camera, Lighting},
    },
    scene::{Scene, Viewport},
};

/// Turns a scene into a prepared scene, on rayon's threads; the same scene gives the same bytes on
/// any number of them.
pub fn prepare(scene: &Scene) -> Result<PreparedBytes, PrepareError> {
    prepare_as(scene, Form::Fast)
}

/// The same in a form.
pub fn prepare_as(scene: &Scene, form: Form) -> Result<PreparedBytes, PrepareError> {
    prepare_with(scene, form, true)
}

/// The same. Without records of the emitters, light that faces send on is looked for over the
/// whole hemisphere alone: the noisier way that benchmarks compare with.
#[doc(hidden)]
pub fn prepare_with(
    scene: &Scene,
    form: Form,
    keeps_emitter_records: bool,
) -> Result<PreparedBytes, PrepareError> {
    let viewport = scene.viewport.ok_or(PrepareError::NoViewport)?;
    let ranks = Ranks::new(scene)?;

    let scaled = Collected::new(scene, &ranks).scale(extent_of_eye_and_lights(scene, &viewport));
    let scale = scaled.scale;
    let surfaces = scaled.weld().share_surfaces(&ranks);
    let Hierarchy { frame, mut nodes, order } = Hierarchy::new(&surfaces, form);
    let mut faces = surfaces.sort(&order);
    drop(order);

    let lights = Lights::new(&scene.lights, scale, &faces)?;
    let textures = Textures::new(scene, &ranks);
    let materials = textures.materials(&scene.materials);
    let ambient = scene.ambient.unwrap_or_default();
    let mut emitters = if features::is_lit(scene) {
        Emitters::find(&mut faces, &materials, &lights.records, ambient)
    } else {
        Emitters::default()
    };
    let features = features(scene, &textures, &emitters);
    if !keeps_emitter_records {
        emitters = Emitters::default();
    }

    let (mut compact_nodes, mut single_vertices) = (Vec::new(), Vec::new());
    if form == Form::Compact {
        compact_nodes.par_extend(nodes.par_iter().map(CompactNode::new));
        nodes = Vec::new();
        single_vertices = split_vertices(&mut faces, &mut emitters.records);
    }

    let lighting =
        Lighting { background: scene.background.to_array(), ambient: ambient.to_array() };
    let sections = Sections {
        nodes: &nodes,
        compact_nodes: &compact_nodes,
        faces: &faces.faces,
        vertices: &faces.vertices,
        single_vertices: &single_vertices,
        coats: &faces.coats,
        quadrangles: &faces.quadrangles,
        spheres: &faces.spheres,
        planes: &faces.planes,
        materials: &materials,
        lights: &lights.records,
        coincident: &lights.coincident,
        solids: &faces.solids,
        solid_nodes: &faces.solid_nodes,
        leaves: &faces.leaves,
        box_planes: &faces.box_planes,
        solid_boxes: &faces.solid_boxes,
        first_ranks: &ranks.firsts,
        emitters: &emitters.records,
        emitter_nodes: &emitters.nodes,
        textured_faces: &textures.faces,
        textures: &textures.mip_maps.textures,
        texture_levels: &textures.mip_maps.levels,
        fine_texels: &textures.mip_maps.fine,
        coarse_texels: &textures.mip_maps.coarse,
    };
    Ok(assemble(camera(&viewport, scale), lighting, frame, scale, features, &sections))
}

/// What builds the hierarchy of a scene, and that alone, for benchmarks; it tells how many nodes
/// there are.
#[doc(hidden)]
pub fn hierarchy_of(scene: &Scene) -> Result<impl Fn() -> usize, PrepareError> {
    let viewport = scene.viewport.ok_or(PrepareError::NoViewport)?;
    let ranks = Ranks::new(scene)?;
    let scaled = Collected::new(scene, &ranks).scale(extent_of_eye_and_lights(scene, &viewport));
    let surfaces = scaled.weld().share_surfaces(&ranks);
    Ok(move || Hierarchy::new(&surfaces, Form::Fast).nodes.len())
}

/// The eye and the screen in the units of the prepared scene.
fn camera(viewport: &Viewport, scale: f64) -> Camera {
    let [eye, top_left, bottom_left, top_right] =
        [viewport.eye, viewport.top_left, viewport.bottom_left, viewport.top_right]
            .map(|point| point * scale);
    let vector = |from: DVec3, to: DVec3| (to - from).to_array();
    Camera {
        eye: eye.to_array(),
        top_left: vector(eye, top_left),
        right: vector(top_left, top_right),
        down: vector(top_left, bottom_left),
    }
}
