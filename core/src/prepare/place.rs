//! Meshes where the scene wants them.

use glam::DVec3;
use rayon::prelude::*;

use crate::{
    exact::float::power_of_two_below_inverse,
    scene::{Mesh, MeshVertices},
};

/// The corners of a mesh where the scene wants them.
pub(super) fn place_mesh(mesh: &Mesh) -> Vec<DVec3> {
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
            vertices.par_iter().map(|v| place(DVec3::from_array(v.map(f64::from)))).collect()
        }
        MeshVertices::Double(vertices) => {
            vertices.par_iter().map(|&v| place(DVec3::from_array(v))).collect()
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
