//! The compact form of a prepared scene: the same pictures from fewer bytes.

use std::{ops::ControlFlow, sync::Arc};

use glam::DVec3;
use rayon::prelude::*;
use rtfarm_core::{
    isa::Isa,
    prepare::{Form, prepare_as},
    prepared::{PreparedBytes, PreparedScene},
    render::{Quality, Sampling, render_tile},
    scene::{Mesh, MeshShape, MeshVertices, Scene, Texture},
    testing::{Probe, Probing},
    tile::{Area, Size},
};
use rtfarm_oracle::{
    random::Random,
    random_scene::{Aim, Recipe, Style, random_ray, random_scene},
};

use crate::support::{
    block::{entry, hash_again, number, section},
    studio::read,
};

fn opened(scene: &Scene, form: Form) -> PreparedScene<PreparedBytes> {
    PreparedScene::open(prepare_as(scene, form).expect("a plain scene")).expect("a valid block")
}

fn bytes(scene: &Scene, form: Form) -> PreparedBytes {
    prepare_as(scene, form).expect("a plain scene")
}

/// Hills of `2 * side * side` triangles, under a lamp, on a floor that shares its plane; corners
/// are exact in single precision, or not one is.
fn hills(side: u32, is_single: bool) -> Scene {
    let mut scene = read(
        "viewport origin 0.5 -1.2 0.9 topleft -0.1 0 0.6 bottomleft -0.1 0 0 topright 1.1 0 0.6
        endviewport
        materials entry name green color 60 200 80 reflect 0.2 endentry
            entry name grey color 90 90 90 endentry endmaterials
        lights ambient 0.2 reference power 1 distance 2 endreference
            point coords 2 -1 3 power 1 endpoint endlights
        geometry
            triangle vertex -3 -3 -0.25 vertex 3 -3 -0.25 vertex 3 3 -0.25 material grey endtriangle
            triangle vertex -3 -3 -0.25 vertex 3 3 -0.25 vertex -3 3 -0.25 material grey endtriangle
            quadrangle vertex -1 1.75 -1 vertex 2 1.75 -1 vertex 2 1.75 1 vertex -1 1.75 1 material green
            endquadrangle
            sphere coords 0.3 0.4 0.3 radius 0.1 material grey endsphere
        endgeometry",
    );
    let wave = |t: f64| t.fract() * (1.0 - t.fract());
    let corners = (0..=side).flat_map(|y| (0..=side).map(move |x| [x, y])).map(|[x, y]| {
        let [x, y] = [x, y].map(|k| f64::from(k) / f64::from(side));
        [x, y, 0.2 * (wave(2.0 * x) + wave(3.0 * y)) + 0.05 * wave(9.0 * x * y)]
    });
    let to_single = |corner: [f64; 3]| corner.map(|x| x as f32);
    let vertices = if is_single {
        MeshVertices::Single(corners.map(to_single).collect())
    } else {
        MeshVertices::Double(corners.map(|corner| corner.map(|x| x + 0.1 / 3.0)).collect())
    };
    let triangles =
        (0..side).flat_map(|y| (0..side).map(move |x| y * (side + 1) + x)).flat_map(|a| {
            let [b, c, d] = [a + 1, a + side + 1, a + side + 2];
            [[a, b, d], [a, d, c]]
        });
    scene.meshes.push(Mesh {
        path: String::new(),
        shape: Arc::new(MeshShape { vertices, triangles: triangles.collect() }),
        scale: 1.0,
        rotate: None,
        offset: DVec3::ZERO,
        material: 0,
        primitive: 4,
    });
    scene
}

/// A picture of a scene, 24x16 in so many samples a pixel.
fn picture(scene: &PreparedScene<PreparedBytes>, isa: Isa, sampling: Sampling) -> Vec<[u32; 3]> {
    let quality = Quality { sampling, ..Quality::default() };
    let area = Area::whole(Size::new(24, 16).unwrap());
    let go_on = &mut || ControlFlow::Continue(());
    let tile = render_tile(scene, &quality, area, isa, go_on).unwrap();
    tile.pixels.into_iter().map(|pixel| pixel.map(f32::to_bits)).collect()
}

fn check_same_pictures(scene: &Scene, what: &str) {
    let (fast, compact) = (opened(scene, Form::Fast), opened(scene, Form::Compact));
    for sampling in [Sampling::fixed(4).unwrap(), Sampling::adaptive(0.02, 32).unwrap()] {
        let truth = picture(&fast, Isa::Scalar, sampling);
        for isa in Isa::ALL.into_iter().filter(|isa| isa.is_supported()) {
            assert!(picture(&compact, isa, sampling) == truth, "{what}, {isa}, {sampling:?}");
        }
    }
}

#[test]
fn a_compact_scene_gives_the_same_picture_on_every_instruction_set() {
    check_same_pictures(&hills(40, true), "hills in single precision");
    check_same_pictures(&hills(40, false), "hills in double precision");
    check_same_pictures(
        &Scene { viewport: hills(1, true).viewport, ..Scene::default() },
        "nothing",
    );
    for style in [Style::Plain, Style::Grid, Style::Extreme, Style::Far] {
        for seed in 0..4 {
            let recipe = Recipe { spheres: 20, triangles: 40, solids: 3, ..Recipe::new(style) };
            let mut scene = random_scene(seed, &recipe);
            let texels = (0..12).map(|k| [20 * k, 255 - 20 * k, 7 * k]).collect();
            scene.textures.push(Texture { path: String::new(), width: 4, height: 3, texels });
            scene.materials[0].texture = Some(0);
            check_same_pictures(&scene, &format!("{style:?} scene {seed}"));
        }
    }
}

#[test]
fn rays_meet_in_a_compact_scene_what_they_meet_in_a_fast_one() {
    for style in [Style::Plain, Style::Grid, Style::Extreme, Style::Far] {
        for seed in 0..20 {
            let recipe = Recipe {
                spheres: 60,
                triangles: 120,
                quadrangles: 60,
                parallelepipeds: 20,
                solids: 5,
                ..Recipe::new(style)
            };
            let scene = random_scene(seed, &recipe);
            let random = &mut Random::new(seed);
            let probes: Vec<Probe> = (0..600)
                .map(|k| {
                    let (origin, direction) =
                        random_ray(&scene, Aim::ALL[k % Aim::ALL.len()], random);
                    Probe { origin, direction: direction.normalize(), leaving: None }
                })
                .collect();
            let truth = opened(&scene, Form::Fast).probe(&probes, Isa::Scalar);
            let compact = opened(&scene, Form::Compact);
            assert_eq!(
                compact.count_crossings(&probes),
                opened(&scene, Form::Fast).count_crossings(&probes)
            );
            for isa in Isa::ALL.into_iter().filter(|isa| isa.is_supported()) {
                assert_eq!(compact.probe(&probes, isa), truth, "{style:?} scene {seed}, {isa}");
            }
        }
    }
}

/// How many bytes a scene has for each triangle in the sections that hold the hierarchy, faces and
/// corners.
fn bytes_a_triangle(scene: &Scene, form: Form) -> f64 {
    let block = bytes(scene, form);
    let sections = ["nodes", "compact_nodes", "faces", "coats", "vertices", "single_vertices"];
    let count: usize = sections.map(|name| section(block.as_ref(), name).len()).into_iter().sum();
    let triangles = scene.meshes[0].shape.triangles.len() + scene.triangles.len();
    let a_triangle = count as f64 / triangles as f64;
    let all = block.as_ref().len() as f64 / triangles as f64;
    assert!(all < a_triangle + 0.5, "the rest is next to nothing: {all} of {a_triangle}");
    eprintln!("{form:?}: {a_triangle:.1} bytes a triangle");
    a_triangle
}

#[test]
fn a_triangle_takes_33_bytes_at_most_in_a_compact_scene_and_60_in_a_fast_one() {
    let [single, double] = [true, false].map(|is_single| {
        let mut scene = hills(200, is_single);
        scene.materials[0].reflect = 0.0; // What sends light on has a record of its own.
        scene
    });
    assert!(bytes_a_triangle(&single, Form::Compact) <= 33.0);
    assert!(bytes_a_triangle(&single, Form::Fast) <= 60.0);
    assert!(bytes_a_triangle(&double, Form::Compact) <= 39.0);
    assert!(bytes_a_triangle(&double, Form::Fast) <= 60.0);
}

#[test]
fn corners_that_single_precision_does_not_hold_are_kept_whole() {
    let count = |scene: &Scene, name| section(bytes(scene, Form::Compact).as_ref(), name).len();
    let (single, double) = (hills(20, true), hills(20, false));
    let floor = 8 * 64; // The corners of the others, and the gap behind them.
    assert!(count(&single, "vertices") == 0 && count(&single, "single_vertices") >= 441 * 12);
    assert!(count(&double, "vertices") >= 441 * 24 && count(&double, "single_vertices") < floor);
}

#[test]
fn damage_to_a_compact_hierarchy_is_refused_or_gives_one_picture() {
    let scene = hills(8, true);
    let block = bytes(&scene, Form::Compact);
    let block = block.as_ref();
    assert!(number(block, entry("compact_nodes") + 8) > 4, "levels");
    let sections = ["compact_nodes", "faces", "single_vertices", "coats"];
    let places: Vec<usize> = sections.iter().flat_map(|name| section(block, name)).collect();
    let words = [0_u32, 1, 4, 1 << 29, 1 << 31, 0xF000_0000, u32::MAX, 0x7F80_0000, 0xFFFF_7FFF];
    let tried: Vec<bool> = places
        .into_par_iter()
        .step_by(4)
        .flat_map_iter(|at| words.map(|word| (at, word)))
        .map(|(at, word)| {
            let mut damaged = block.to_vec();
            damaged[at..at + 4].copy_from_slice(&word.to_le_bytes());
            hash_again(&mut damaged);
            let Ok(scene) = PreparedScene::open(PreparedBytes::copy_from(&damaged)) else {
                return false;
            };
            let sampling = Sampling::fixed(1).unwrap();
            let truth = picture(&scene, Isa::Scalar, sampling);
            assert!(picture(&scene, Isa::fastest(), sampling) == truth, "byte {at}: {word:#x}");
            true
        })
        .collect();
    let taken = tried.iter().filter(|&&is_taken| is_taken).count();
    eprintln!("{taken} of {} damages give a picture", tried.len());
    assert!(taken > 0 && taken < tried.len());
}

#[test]
fn a_block_with_nodes_of_both_kinds_or_of_none_is_refused() {
    let block = bytes(&hills(8, true), Form::Compact);
    let open = |name: &str, count: usize| {
        let mut changed = block.as_ref().to_vec();
        changed[entry(name) + 8..entry(name) + 16].copy_from_slice(&count.to_le_bytes());
        hash_again(&mut changed);
        PreparedScene::open(PreparedBytes::copy_from(&changed)).map(|_| ())
    };
    let count = number(block.as_ref(), entry("compact_nodes") + 8);
    assert!(open("compact_nodes", count).is_ok());
    for (name, count) in [("compact_nodes", 0), ("compact_nodes", count - 1), ("nodes", 1)] {
        assert!(open(name, count).is_err(), "{count} {name}");
    }
}
