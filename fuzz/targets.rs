//! What must hold for any input. The fuzz targets call these, and so does an ordinary test with
//! every file of the corpora.

#![allow(dead_code, reason = "each fuzz target calls one of them")]

use std::{ops::ControlFlow, sync::LazyLock};

use rtfarm_core::{
    assets::{mesh::read_mesh, texture::read_texture},
    isa::Isa,
    language::{Severity, Style, draw_diagnostics, read_scene},
    prepare::{Form, prepare_as},
    prepared::{PreparedBytes, PreparedError, PreparedScene},
    render::{Quality, Sampling, render_tile},
    scene::{MeshVertices, Scene, SolidNode},
    tile::{Area, Size},
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

/// What a prepared scene is made from before its bytes are changed: with all kinds of faces, and
/// light that is mirrored, bent and let through; with solids and nothing else; with one triangle;
/// with an image. The same follow in the compact form.
const SCENES: [&str; 4] = [
    include_str!("prepared/all.rt"),
    include_str!("prepared/solids.rt"),
    include_str!("prepared/triangle.rt"),
    include_str!("prepared/textured.rt"),
];

const IMAGE: &[u8] = include_bytes!("corpus/image/rgb.png");

static PREPARED: LazyLock<Vec<Vec<u8>>> = LazyLock::new(|| {
    let image = |_: &str| Ok(IMAGE.to_vec());
    let scene = |text: &str| read_scene(text.as_bytes(), &image).scene.expect("no errors");
    let block = |(form, text): (Form, &&str)| {
        prepare_as(&scene(text), form).expect("a plain scene").as_ref().to_vec()
    };
    let in_form = |form| SCENES.iter().map(move |text| (form, text));
    in_form(Form::Fast).chain(in_form(Form::Compact)).map(block).collect()
});

/// Where a block keeps the hash of all that follows.
const HASH: std::ops::Range<usize> = 16..48;

/// A prepared scene with changed bytes, whose hash is right again: it is refused, or it gives the
/// same picture on every instruction set.
///
/// The first byte chooses the scene, or says that a whole block follows. Then come changes of four
/// bytes each: what kind and where, where, where, what. So they mean the same in every layout, or
/// nearly. A rest of two bytes or three asks for adaptive samples.
pub(crate) fn prepared(data: &[u8]) {
    let Some((&first, changes)) = data.split_first() else { return };
    let mut block = match PREPARED.get(usize::from(first)) {
        Some(block) => block.clone(),
        None => changes.to_vec(),
    };
    if usize::from(first) < PREPARED.len() {
        for change in changes.chunks_exact(4).take(64) {
            change_block(&mut block, change);
        }
    }
    if block.len() >= HASH.end {
        let hash = blake3::hash(&block[HASH.end..]);
        block[HASH].copy_from_slice(hash.as_bytes());
    }
    let scene = match PreparedScene::open(PreparedBytes::copy_from(&block)) {
        Ok(scene) => scene,
        Err(error) => return assert_ne!(error, PreparedError::Damaged, "the hash has moved"),
    };
    let sampling = match changes.len() % 4 {
        0 | 1 => Sampling::fixed(1),
        _ => Sampling::adaptive(0.1, 16),
    };
    let sampling = sampling.expect("both are in range");
    let quality = Quality { sampling, ..Quality::default() };
    let area = Area::whole(Size::new(4, 4).expect("a size"));
    let picture = |isa| {
        let go_on = &mut || ControlFlow::Continue(());
        let pixels = render_tile(&scene, &quality, area, isa, go_on).expect("nobody stops").pixels;
        // One NaN is as good as another.
        let bits = |channel: f32| if channel.is_nan() { 0 } else { channel.to_bits() };
        pixels.into_iter().map(|pixel| pixel.map(bits)).collect::<Vec<_>>()
    };
    let scalar = picture(Isa::Scalar);
    for isa in Isa::ALL.into_iter().filter(|isa| isa.is_supported()) {
        assert_eq!(picture(isa), scalar, "{isa}");
    }
}

/// Puts a number where it does most harm: a byte, a word, or an f64 that is hard to live with.
fn change_block(block: &mut Vec<u8>, change: &[u8]) {
    const WORDS: [u32; 8] = [0, 1, 2, 1 << 29, 1 << 31, u32::MAX - 1, u32::MAX, 0x7f80_0000];
    const NUMBERS: [f64; 12] =
        [0.0, -0.0, 1.0, -1.0, 0.5, 1e-300, 5e-324, 9e99, -9e99, 1e300, f64::INFINITY, f64::NAN];
    let &[kind, low, high, what] = change else { return };
    let place = usize::from(kind >> 3) << 16 | usize::from(high) << 8 | usize::from(low);
    let place = place % block.len();
    let mut put = |place: usize, bytes: &[u8]| {
        if let Some(old) = block.get_mut(place..place + bytes.len()) {
            old.copy_from_slice(bytes);
        }
    };
    match kind & 7 {
        0 => put(place, &[what]),
        1 => put(place & !3, &WORDS[usize::from(what) % WORDS.len()].to_le_bytes()),
        2 => put(place & !3, &u32::from(what).to_le_bytes()),
        3 => put(place & !7, &NUMBERS[usize::from(what) % NUMBERS.len()].to_le_bytes()),
        4 => put(place & !3, &(NUMBERS[usize::from(what) % NUMBERS.len()] as f32).to_le_bytes()),
        5 => put(place & !3, &(1_u32 << (what % 32)).to_le_bytes()),
        6 => {
            // A word from nearby.
            let from = (place & !3) + 4 * usize::from(what);
            if let Some(word) = block.get(from..from + 4) {
                let word = word.to_vec();
                block[place & !3..(place & !3) + 4].copy_from_slice(&word);
            }
        }
        _ => block.truncate(block.len() - usize::from(what).min(block.len() - 1)),
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
