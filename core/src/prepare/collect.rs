//! The first step: all faces of a scene, in the scene's own units.

use rayon::prelude::*;

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
        let of_primitive = |material: u32, primitive: u32| FaceAttributes {
            material,
            rank: ranks.first(primitive),
        };
        let of_meshes = scene.meshes.iter().map(|mesh| mesh.shape.triangles.len());
        let triangle_count = scene.triangles.len() + of_meshes.sum::<usize>();
        let mut flat = FlatFaces {
            points: Vec::new(),
            corners: Vec::with_capacity(3 * triangle_count + 4 * scene.quadrangles.len()),
            attributes: Vec::with_capacity(triangle_count + scene.quadrangles.len()),
            triangle_count,
            quadrangle_count: scene.quadrangles.len() + 6 * scene.parallelepipeds.len(),
            box_edges: Vec::new(),
        };
        for face in &scene.triangles {
            flat.push_points(&face.vertices);
            flat.attributes.push(of_primitive(face.material, face.primitive));
        }
        for mesh in &scene.meshes {
            let first_point = flat.points.len() as u32;
            flat.points.extend(place_mesh(mesh));
            let first = ranks.first(mesh.primitive);
            let corners = mesh.shape.triangles.as_flattened();
            flat.corners.par_extend(corners.par_iter().map(|&corner| first_point + corner));
            let ranks = first..first + mesh.shape.triangles.len() as u32;
            let attributes = |rank| FaceAttributes { material: mesh.material, rank };
            flat.attributes.par_extend(ranks.into_par_iter().map(attributes));
        }
        for face in &scene.quadrangles {
            flat.push_points(&face.vertices);
            flat.attributes.push(of_primitive(face.material, face.primitive));
        }
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
