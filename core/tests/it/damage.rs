//! Prepared scenes whose bytes nobody wrote, under a hash that fits: each is refused, or shows a
//! picture of finite light; no damage leads to a panic or an endless walk.

use std::ops::ControlFlow;

use glam::DVec3;
use rayon::prelude::*;
use rtfarm_core::{
    isa::Isa,
    prepare::prepare,
    prepared::{PreparedBytes, PreparedError, PreparedScene, SECTION_NAMES},
    render::{Quality, Sampling, Settings, render_tile},
    scene::{Scene, Texture},
    tile::Size,
};

use crate::support::{
    block::{entry, hash_again, number, section},
    parts::{join, sphere, upright},
    studio::{read, whole},
};

/// The sections that tell where light is sent on, and those of textures.
const GATHERING: [&str; 2] = ["emitters", "emitter_nodes"];
const TEXTURES: [&str; 5] =
    ["textured_faces", "textures", "texture_levels", "fine_texels", "coarse_texels"];

/// More faces that send light on than are looked at one by one, two of them with a texture.
fn scene() -> Scene {
    let mut geometry = String::from(
        "quadrangle vertex -9 -9 0 vertex 9 -9 0 vertex 9 9 0 vertex -9 9 0 material matte
         endquadrangle
         quadrangle vertex -2 0 0.1 vertex 0 0.2 0.1 vertex 0 0.2 2 vertex -2 0 2 material worn
         endquadrangle
         triangle vertex 0.5 0 0.1 vertex 2 -0.5 0.1 vertex 1 0 1.5 material worn endtriangle
         triangle vertex 1 -1 0.1 vertex 2 -1.5 0.1 vertex 2 -1 0.8 material red endtriangle ",
    );
    for k in 0..4 {
        let x = f64::from(k) - 1.5;
        geometry += &sphere(DVec3::new(x, -2.0, 0.4), 0.3, "red");
    }
    geometry += &join(
        "difference",
        &[
            &upright(DVec3::new(-2.5, -2.0, 0.2), DVec3::new(-1.5, -1.0, 1.0), "red"),
            &sphere(DVec3::new(-1.5, -2.0, 1.0), 0.6, "worn"),
        ],
    );
    let mut scene = read(&format!(
        "viewport origin 0 -9 3 topleft -1.2 -6 2.8 bottomleft -1.2 -6 1.4 topright 1.2 -6 2.8
        endviewport
        materials entry name matte endentry entry name red color 255 40 20 reflect 0.3 endentry
        entry name worn reflect 0.2 alpha 0.9 endentry endmaterials
        lights ambient 0.2 reference power 1 distance 4 endreference
            point coords 3 -5 6 power 1.5 endpoint endlights
        geometry {geometry} endgeometry"
    ));
    let texels = (0..12).map(|k| [20 * k, 255 - 20 * k, 7 * k]).collect();
    scene.textures.push(Texture { path: String::new(), width: 4, height: 3, texels });
    scene.materials[2].texture = Some(0);
    scene
}

/// No estimate makes more of what a face sends on than one ray in twenty would bring alone.
const BRIGHTEST: f32 = 100.0;

/// Whether the block is taken for a scene; then its picture is one.
fn is_taken(block: &[u8], what: &str) -> bool {
    let scene = match PreparedScene::open(PreparedBytes::copy_from(block)) {
        Ok(scene) => scene,
        Err(PreparedError::Malformed(_)) => return false,
        Err(other) => panic!("{what}: {other}"),
    };
    let quality = Quality { sampling: Sampling::fixed(2).unwrap(), ..Quality::default() };
    let settings = Settings { size: Size::new(12, 7).unwrap(), quality };
    let go_on = &mut || ControlFlow::Continue(());
    let picture =
        render_tile(&scene, &settings.quality, whole(settings.size), Isa::fastest(), go_on)
            .unwrap();
    assert_eq!(picture.pixels.len(), 12 * 7);
    for pixel in picture.pixels.as_flattened() {
        assert!((0.0..BRIGHTEST).contains(pixel), "{what}: a pixel is {pixel}");
    }
    true
}

/// Numbers that mean something else than what stood there.
fn damages(was: [u8; 8]) -> impl Iterator<Item = Vec<u8>> + use<> {
    let word = u32::from_le_bytes(was[..4].try_into().unwrap());
    let words = [0, 1, 2, 3, word.wrapping_add(1), word.wrapping_sub(1), word ^ 1 << 31]
        .into_iter()
        .chain([12, 100, 1 << 20, i32::MAX as u32, u32::MAX - 1, u32::MAX, 0x7FC0_0000])
        .map(|word: u32| word.to_le_bytes().to_vec());
    let real = f64::from_le_bytes(was);
    let reals = [0.0, -0.0, 1.0, -real, real * 1e6, real * 1e-6, 1e99, -1e99, 1e100, 1e308, 1e-320]
        .into_iter()
        .chain([f64::INFINITY, f64::NEG_INFINITY, f64::NAN])
        .map(|real: f64| real.to_le_bytes().to_vec());
    words.chain(reals)
}

/// Every word of these sections of the scene, changed in every way.
fn check_damaged_words(sections: &[&str]) {
    let block = prepare(&scene()).unwrap();
    let block = block.as_ref();
    assert!(is_taken(block, "the scene itself"));
    for name in sections {
        let bytes = section(block, name);
        assert!(!bytes.is_empty(), "section {name} is to hold something");
        let taken: Vec<bool> = bytes
            .step_by(4)
            .par_bridge()
            .flat_map_iter(|at| {
                let mut was = [0; 8];
                let end = (at + 8).min(block.len());
                was[..end - at].copy_from_slice(&block[at..end]);
                damages(was).map(move |damage| {
                    let mut damaged = block.to_vec();
                    let end = (at + damage.len()).min(damaged.len());
                    damaged[at..end].copy_from_slice(&damage[..end - at]);
                    hash_again(&mut damaged);
                    is_taken(&damaged, &format!("section {name}, byte {at}: {damage:?}"))
                })
            })
            .collect();
        let count = taken.iter().filter(|&&is_taken| is_taken).count();
        eprintln!("section {name}: {count} of {} damages give a picture", taken.len());
    }
}

#[test]
fn damage_to_what_sends_light_on_is_refused_or_gives_a_picture() {
    check_damaged_words(&GATHERING);
}

#[test]
fn damage_to_textures_is_refused_or_gives_a_picture() {
    check_damaged_words(&TEXTURES);
}

#[test]
fn sections_of_another_place_or_length_are_refused_or_give_a_picture() {
    let block = prepare(&scene()).unwrap();
    let block = block.as_ref();
    for name in GATHERING.into_iter().chain(TEXTURES) {
        let place = entry(name);
        for at in [place, place + 8] {
            let was = number(block, at) as u64;
            let other_places = SECTION_NAMES.iter().map(|name| number(block, entry(name)) as u64);
            let near = [0, 1, was.wrapping_sub(1), was + 1, was + 64, 2 * was, block.len() as u64];
            let far = [1 << 32, 1 << 40, u64::MAX / 64, u64::MAX / 2, u64::MAX - 63, u64::MAX];
            for value in other_places.chain(near).chain(far) {
                let mut damaged = block.to_vec();
                damaged[at..at + 8].copy_from_slice(&value.to_le_bytes());
                hash_again(&mut damaged);
                is_taken(&damaged, &format!("section {name}, byte {at}: {value}"));
            }
        }
    }
}
