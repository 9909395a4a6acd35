//! Geometry as scene text.

use std::fmt::Write;

use glam::DVec3;

/// What stands in a scene file for a point.
fn words(point: DVec3) -> String {
    format!("{:?} {:?} {:?} ", point.x, point.y, point.z)
}

pub(crate) fn sphere(center: DVec3, radius: f64, material: &str) -> String {
    format!("sphere coords {} radius {radius:?} material {material} endsphere ", words(center))
}

/// A corner and the three edges that leave it.
pub(crate) fn parallelepiped(corner: DVec3, edges: [DVec3; 3], material: &str) -> String {
    let mut text = format!("parallelepiped vertex {}", words(corner));
    for edge in edges {
        write!(text, "vertex {}", words(corner + edge)).unwrap();
    }
    text + &format!("material {material} endparallelepiped ")
}

/// An upright box between two corners.
pub(crate) fn upright(low: DVec3, high: DVec3, material: &str) -> String {
    let [x, y, z] = (high - low).to_array();
    parallelepiped(low, [DVec3::X * x, DVec3::Y * y, DVec3::Z * z], material)
}

/// `union`, `intersection` or `difference`.
pub(crate) fn join(operation: &str, operands: &[&str]) -> String {
    format!("{operation} {} end{operation} ", operands.concat())
}
