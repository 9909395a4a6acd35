//! The last step: vertices in the precision that they need.

use super::sort::Sorted;
use crate::prepared::record::{EmitterRecord, FaceRecord};

/// Takes out the vertices that single precision holds exactly. All get new numbers, the others
/// first.
pub(super) fn split_vertices(faces: &mut Sorted, emitters: &mut [EmitterRecord]) -> Vec<[f32; 3]> {
    let is_single = |vertex: &[f64; 3]| vertex.iter().all(|&x| f64::from(x as f32) == x);
    let (mut singles, mut doubles) = (Vec::new(), Vec::new());
    let double_count = faces.vertices.iter().filter(|vertex| !is_single(vertex)).count();
    let numbers: Vec<u32> = (faces.vertices.iter())
        .map(|vertex| {
            if is_single(vertex) {
                singles.push(vertex.map(|x| x as f32));
                (double_count + singles.len() - 1) as u32
            } else {
                doubles.push(*vertex);
                doubles.len() as u32 - 1
            }
        })
        .collect();
    faces.vertices = doubles;
    let of_triangles = faces.faces.iter_mut().filter_map(FaceRecord::triangle_vertices);
    let of_quadrangles = faces.quadrangles.iter_mut().flat_map(|face| &mut face.vertices);
    let polygons = emitters.iter_mut().filter(|emitter| !emitter.is_sphere());
    let of_emitters = polygons.flat_map(|emitter| &mut emitter.vertices);
    for vertex in of_triangles.flatten().chain(of_quadrangles).chain(of_emitters) {
        *vertex = numbers[*vertex as usize];
    }
    singles
}
