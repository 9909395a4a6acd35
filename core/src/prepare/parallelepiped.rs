//! Parallelepipeds as six faces.

use glam::DVec3;

use crate::scene::Parallelepiped;

/// The faces of a parallelepiped, each counter-clockwise seen from outside: 2k is the one through
/// the corner that edge k leaves, 2k + 1 the one opposite.
pub(super) fn box_faces(solid: &Parallelepiped) -> [[DVec3; 4]; 6] {
    let is_left_handed = is_left_handed(solid);
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
pub(super) fn box_edges(solid: &Parallelepiped) -> [[DVec3; 2]; 6] {
    let is_left_handed = is_left_handed(solid);
    std::array::from_fn(|face| {
        let [e, f] = [solid.edges[(face / 2 + 1) % 3], solid.edges[(face / 2 + 2) % 3]];
        if (face % 2 == 1) == is_left_handed { [f, e] } else { [e, f] }
    })
}

fn is_left_handed(solid: &Parallelepiped) -> bool {
    let [u, v, w] = solid.edges;
    u.dot(v.cross(w)) < 0.0
}
