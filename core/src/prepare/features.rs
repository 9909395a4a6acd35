//! The features of the tracer that a scene needs.

use super::{emitters::Emitters, textures::Textures};
use crate::{
    prepared::record::Features,
    scene::{Material, Scene, SolidNode},
    transfer::Transfer,
};

/// Whether the scene defines light; else it shows plain colours.
pub(super) fn is_lit(scene: &Scene) -> bool {
    scene.ambient.is_some() || !scene.lights.is_empty()
}

/// The features that a scene with these textures and emitters needs.
pub(super) fn features(scene: &Scene, textures: &Textures, emitters: &Emitters) -> Features {
    let used = used_materials(scene);
    let any = |holds: fn(&Material) -> bool| u32::from(used.iter().any(|&m| holds(m)));
    let has_textures = !textures.faces.is_empty();
    Features {
        is_lit: u32::from(is_lit(scene)),
        has_branches: any(|m| m.reflect > 0.0 || lets_light_through(m)),
        has_clear_shadows: any(lets_light_through),
        has_solids: u32::from(!scene.solids.is_empty()),
        has_emitters: u32::from(!emitters.records.is_empty()),
        has_textures: u32::from(has_textures),
        has_srgb_texels: u32::from(has_textures && scene.transfer == Transfer::Srgb),
        padding: 0,
    }
}

fn lets_light_through(material: &Material) -> bool {
    material.alpha < 1.0 && material.reflect < 1.0
}

/// The materials that faces have.
fn used_materials(scene: &Scene) -> Vec<&Material> {
    let leaf_materials = scene.solids.iter().flat_map(|solid| {
        solid.nodes.iter().filter_map(|node| match node {
            SolidNode::Sphere(sphere) => Some(sphere.material),
            SolidNode::Parallelepiped(solid) => Some(solid.material),
            SolidNode::Operation { .. } => None,
        })
    });
    let materials = (scene.triangles.iter().map(|face| face.material))
        .chain(scene.quadrangles.iter().map(|face| face.material))
        .chain(scene.spheres.iter().map(|sphere| sphere.material))
        .chain(scene.parallelepipeds.iter().map(|solid| solid.material))
        .chain(scene.meshes.iter().map(|mesh| mesh.material))
        .chain(leaf_materials);
    let mut is_used = vec![false; scene.materials.len()];
    for material in materials {
        is_used[material as usize] = true;
    }
    let with_use = scene.materials.iter().zip(is_used);
    with_use.filter_map(|(material, is_used)| is_used.then_some(material)).collect()
}
