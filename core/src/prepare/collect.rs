//! The first step: all faces of a scene, in the scene's own units.

use glam::DVec3;

use super::{
    flat::{FaceAttributes, FlatFaces},
    place::place_mesh,
    ranks::Ranks,
    solid_trees::SolidTrees,
};
use crate::{prepared::record::SphereRecord, scene::Scene};

/// All faces of a scene, in the scene's own units.
pub(super) struct Collected {
    pub(super) flat: FlatFaces,
    /// Spheres that are no parts of solids, each with a surface of its own.
    pub(super) spheres: Vec<SphereRecord>,
    pub(super) solids: SolidTrees,
}

impl Collected {
    /// Collects the faces of a scene: those of meshes where the scene places them.
    pub(crate) fn new(scene: &Scene, ranks: &Ranks) -> Self {
        let mut corners: Vec<DVec3> =
            scene.triangles.iter().flat_map(|face| face.vertices).collect();
        let of_primitive = |material: u32, primitive: u32| FaceAttributes {
            material,
            rank: ranks.first(primitive),
        };
        let mut attributes: Vec<FaceAttributes> = scene
            .triangles
            .iter()
            .map(|face| of_primitive(face.material, face.primitive))
            .collect();
        for mesh in &scene.meshes {
            let vertices = place_mesh(mesh);
            let first = ranks.first(mesh.primitive);
            for (face, triangle) in (0..).zip(&mesh.shape.triangles) {
                corners.extend(triangle.map(|corner| vertices[corner as usize]));
                attributes.push(FaceAttributes { material: mesh.material, rank: first + face });
            }
        }
        let triangle_count = attributes.len();
        corners.extend(scene.quadrangles.iter().flat_map(|face| face.vertices));
        attributes.extend(
            scene.quadrangles.iter().map(|face| of_primitive(face.material, face.primitive)),
        );
        let quadrangle_count = scene.quadrangles.len() + 6 * scene.parallelepipeds.len();
        let box_edges = Vec::new();
        let mut flat =
            FlatFaces { corners, attributes, triangle_count, quadrangle_count, box_edges };
        for solid in &scene.parallelepipeds {
            flat.push_box(solid, ranks.first(solid.primitive));
        }
        let spheres = (scene.spheres.iter())
            .map(|sphere| {
                let rank = ranks.first(sphere.primitive);
                SphereRecord::new(sphere.center, sphere.radius, sphere.material, rank)
            })
            .collect();
        let mut solids = SolidTrees::default();
        for solid in &scene.solids {
            solids.push(solid, ranks.first(solid.primitive), &mut flat);
        }
        Self { flat, spheres, solids }
    }
}
