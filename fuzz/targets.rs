//! What must hold for any input. The fuzz targets call these, and so does an ordinary test with
//! every file of the corpora.

#![allow(dead_code, reason = "each fuzz target calls one of them")]

use rtfarm_core::{
    mesh_file::read_mesh,
    read::{Severity, Style, draw_diagnostics, read_scene},
    scene::{MeshVertices, Scene, SolidNode},
    texture::read_texture,
};

/// A scene text, which may name itself as a mesh or an image.
pub(crate) fn scene(data: &[u8]) {
    let reading = read_scene(data, &|_| Ok(data.to_vec()));
    let is_error = |severity| severity == Severity::Error;
    assert_eq!(reading.scene.is_none(), reading.diagnostics.iter().any(|d| is_error(d.severity)));
    assert!(reading.diagnostics.is_sorted_by_key(|d| d.at));
    // Drawing takes longer than reading: of many diagnostics a few suffice.
    let few = &reading.diagnostics[..reading.diagnostics.len().min(4)];
    draw_diagnostics("fuzz.rt", data, few, Style::Plain);
    if let Some(scene) = &reading.scene {
        check_scene(scene);
    }
    let is_clean = reading.diagnostics.is_empty();
    assert_eq!(reading.into_strict().scene.is_some(), is_clean);
}

/// A mesh file of the format that the name says.
pub(crate) fn stl(data: &[u8]) {
    mesh("fuzz.stl", data);
}

/// A mesh file of the format that the name says.
pub(crate) fn obj(data: &[u8]) {
    mesh("fuzz.obj", data);
}

/// A mesh file of the format that the name says.
pub(crate) fn ply(data: &[u8]) {
    mesh("fuzz.ply", data);
}

/// An image file of any format; the first byte says whether its name is that of a TGA, which is
/// not told from its bytes.
pub(crate) fn image(data: &[u8]) {
    let Some((first, rest)) = data.split_first() else { return };
    let read = if *first == b'T' {
        read_texture("fuzz.tga", rest)
    } else {
        read_texture("fuzz.png", data)
    };
    if let Ok(texture) = read {
        assert!(texture.width > 0 && texture.height > 0);
        assert_eq!(texture.texels.len(), texture.width as usize * texture.height as usize);
    }
}

fn mesh(path: &str, data: &[u8]) {
    let Ok(mesh) = read_mesh(path, data) else { return };
    let count = match &mesh.shape.vertices {
        MeshVertices::Single(vertices) => {
            assert!(vertices.iter().flatten().all(|number| number.is_finite()));
            vertices.len()
        }
        MeshVertices::Double(vertices) => {
            assert!(vertices.iter().flatten().all(|number| number.is_finite()));
            vertices.len()
        }
    };
    assert!(!mesh.shape.triangles.is_empty());
    for [a, b, c] in mesh.shape.triangles {
        assert!(a != b && b != c && c != a && a.max(b).max(c) < count as u32);
    }
}

fn check_scene(scene: &Scene) {
    let materials = scene.materials.len() as u32;
    for material in &scene.materials {
        assert!(material.color.is_finite() && (0.0..=1.0).contains(&material.alpha));
        assert!((0.0..=1.0).contains(&material.reflect) && material.refract >= 0.0);
        assert!(material.texture.is_none_or(|texture| texture < scene.textures.len() as u32));
    }
    assert!(
        scene.lights.iter().all(|light| light.position.is_finite() && light.intensity.is_finite())
    );
    for triangle in &scene.triangles {
        assert!(
            triangle.material < materials
                && triangle.vertices.iter().all(|vertex| vertex.is_finite())
        );
    }
    for quadrangle in &scene.quadrangles {
        assert!(
            quadrangle.material < materials
                && quadrangle.vertices.iter().all(|vertex| vertex.is_finite())
        );
    }
    for sphere in &scene.spheres {
        assert!(sphere.material < materials && sphere.center.is_finite() && sphere.radius > 0.0);
    }
    for mesh in &scene.meshes {
        assert!(mesh.material < materials && mesh.scale > 0.0 && !mesh.shape.triangles.is_empty());
    }
    for solid in &scene.solids {
        let mut depth = 0_u32;
        for node in &solid.nodes {
            depth = match node {
                SolidNode::Operation { operands, .. } => {
                    assert!(*operands >= 2);
                    depth - operands + 1
                }
                SolidNode::Sphere(_) | SolidNode::Parallelepiped(_) => depth + 1,
            };
        }
        assert_eq!(depth, 1);
    }
}
