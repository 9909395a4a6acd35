//! Images on faces.

use std::collections::HashMap;

use glam::DVec2;
use rayon::prelude::*;

use super::{mip_maps::MipMaps, ranks::Ranks};
use crate::{
    prepared::record::{MaterialRecord, Texcoords, TexturedFace},
    scene::{Material, Scene},
};

/// The images that faces show.
pub(super) struct Textures {
    pub(super) mip_maps: MipMaps,
    /// The texture coordinates of the faces that show one, by ascending rank.
    pub(super) faces: Vec<TexturedFace>,
    /// For each material of the scene, its image in `mip_maps` or [`MaterialRecord::PLAIN`].
    of_materials: Vec<u32>,
}

impl Textures {
    /// Finds the faces that show images, and halves these images down to one texel.
    pub(crate) fn new(scene: &Scene, ranks: &Ranks) -> Self {
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
        let mut is_shown = vec![false; scene.materials.len()];
        let mut faces = Vec::new();
        for (material, primitive, texcoords) in triangles.chain(quadrangles) {
            if is_textured(material) {
                is_shown[material as usize] = true;
                faces.push(TexturedFace::new(ranks.first(primitive), texcoords));
            }
        }
        faces.par_sort_unstable_by_key(|face| face.rank);

        let mut mip_maps = MipMaps { transfer: scene.transfer, ..MipMaps::default() };
        let mut numbers = vec![None; scene.textures.len()];
        let of_materials = (scene.materials.iter().zip(is_shown))
            .map(|(material, is_shown)| match material.texture {
                Some(texture) if is_shown => *numbers[texture as usize].get_or_insert_with(|| {
                    mip_maps.add(&scene.textures[texture as usize]);
                    mip_maps.textures.len() as u32 - 1
                }),
                _ => MaterialRecord::PLAIN,
            })
            .collect();
        Self { mip_maps, faces, of_materials }
    }

    /// The records of the scene's materials, with the images that faces show.
    pub(super) fn materials(&self, materials: &[Material]) -> Vec<MaterialRecord> {
        (materials.iter().zip(&self.of_materials))
            .map(|(material, &texture)| {
                let Material { color, reflect, alpha, refract, .. } = *material;
                MaterialRecord::new(color, [reflect, alpha, refract], texture)
            })
            .collect()
    }
}
