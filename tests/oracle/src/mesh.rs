//! Meshes as triangles where the scene puts them.

use glam::DVec3;
use rtfarm_core::scene::{Mesh, MeshVertices};

/// The corners of every triangle after scale, rotation and move, each step rounded to `f64`. Where
/// a mesh is rotated, another way to compute it may differ by ulps.
pub fn mesh_triangles(mesh: &Mesh) -> Vec<[DVec3; 3]> {
    let corner = |index: u32| {
        let stored = match &mesh.shape.vertices {
            MeshVertices::Single(vertices) => vertices[index as usize].map(f64::from),
            MeshVertices::Double(vertices) => vertices[index as usize],
        };
        let scaled = DVec3::from_array(stored) * mesh.scale;
        let turned = mesh.rotate.map_or(scaled, |(axis, degrees)| rotate(scaled, axis, degrees));
        turned + mesh.offset
    };
    mesh.shape.triangles.iter().map(|corners| corners.map(corner)).collect()
}

/// Source: Rodrigues, "Des lois géométriques qui régissent les déplacements d'un système solide"
/// (1840).
fn rotate(point: DVec3, axis: DVec3, degrees: f64) -> DVec3 {
    let (sin, cos) = degrees.to_radians().sin_cos();
    let axis = axis.normalize();
    point * cos + axis.cross(point) * sin + axis * (axis.dot(point) * (1.0 - cos))
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use rtfarm_core::scene::MeshShape;

    use super::*;

    #[test]
    fn a_mesh_is_scaled_then_turned_then_moved() {
        let mesh = Mesh {
            path: String::new(),
            shape: Arc::new(MeshShape {
                vertices: MeshVertices::Single(vec![[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0; 3]]),
                triangles: vec![[0, 1, 2]],
            }),
            scale: 2.0,
            rotate: Some((DVec3::new(0.0, 0.0, 5.0), 90.0)),
            offset: DVec3::new(0.0, 0.0, 3.0),
            material: 0,
            primitive: 0,
        };
        let expected = [(0.0, 2.0, 3.0), (-2.0, 0.0, 3.0), (0.0, 0.0, 3.0)].map(DVec3::from);
        let found = mesh_triangles(&mesh)[0];
        assert!(found.iter().zip(expected).all(|(a, b)| (a - b).length() < 1e-15), "{found:?}");
    }
}
