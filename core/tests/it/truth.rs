//! The tracer against the oracle, against brute force and against itself on other instructions.

use rtfarm_core::{
    isa::Isa,
    prepare::prepare,
    prepared::{PreparedBytes, PreparedScene},
    scene::{Parallelepiped, Scene, SolidNode},
    testing::{Probe, ProbeHit, Probing},
};
use rtfarm_oracle::{
    Oracle,
    random::Random,
    random_scene::{Aim, Recipe, Style, random_ray, random_scene},
};

use crate::support::judge::check_against_oracle;

const STYLES: [Style; 4] = [Style::Plain, Style::Grid, Style::Extreme, Style::Far];

fn opened(scene: &Scene) -> PreparedScene<PreparedBytes> {
    PreparedScene::open(prepare(scene).expect("a plain scene")).expect("a valid block")
}

fn recipe(style: Style) -> Recipe {
    Recipe { solids: 2, ..Recipe::new(style) }
}

fn rays(scene: &Scene, seed: u64, count: usize) -> Vec<Probe> {
    let mut random = Random::new(seed);
    (0..count)
        .map(|k| {
            let aim = Aim::ALL[k % Aim::ALL.len()];
            let (origin, direction) = random_ray(scene, aim, &mut random);
            Probe { origin, direction: direction.normalize(), leaving: None }
        })
        .collect()
}

#[test]
fn the_tracer_meets_what_the_oracle_meets() {
    for style in STYLES {
        let (mut same, mut close) = (0, 0);
        for seed in 0..60 {
            let scene = random_scene(seed, &recipe(style));
            let (prepared, oracle) = (opened(&scene), Oracle::new(&scene));
            let probes = rays(&scene, seed, 100);
            for (probe, found) in probes.iter().zip(prepared.probe(&probes, Isa::fastest())) {
                let what = format!("{style:?} scene {seed}");
                if check_against_oracle((&scene, &oracle), probe, found, &what) {
                    same += 1;
                } else {
                    close += 1;
                }
            }
        }
        eprintln!("{style:?}: {same} answers are the oracle's, {close} too close to call");
    }
}

#[test]
fn a_ray_that_leaves_a_face_meets_what_the_oracle_meets() {
    for style in STYLES {
        for seed in 0..40 {
            let scene = random_scene(seed, &recipe(style));
            let (prepared, oracle) = (opened(&scene), Oracle::new(&scene));
            let first = rays(&scene, seed, 60);
            let mut random = Random::new(seed);
            let mut secondary = Vec::new();
            for (probe, hit) in first.iter().zip(prepared.probe(&first, Isa::fastest())) {
                let Some(hit) = hit else { continue };
                let origin = probe.origin + hit.t * probe.direction;
                let direction = random.direction();
                secondary.push(Probe {
                    origin,
                    direction,
                    leaving: Some((hit.primitive, hit.face)),
                });
            }
            let found = prepared.probe(&secondary, Isa::fastest());
            for (probe, found) in secondary.iter().zip(found) {
                let what = format!("{style:?} scene {seed}, leaving");
                check_against_oracle((&scene, &oracle), probe, found, &what);
            }
        }
    }
}

#[test]
fn the_hierarchy_finds_what_brute_force_finds_on_every_instruction_set() {
    for style in STYLES {
        for seed in 0..30 {
            let recipe = Recipe {
                spheres: 60,
                triangles: 120,
                quadrangles: 60,
                parallelepipeds: 20,
                solids: 20,
                ..recipe(style)
            };
            let scene = random_scene(seed, &recipe);
            let prepared = opened(&scene);
            let probes = rays(&scene, seed, 500);
            let brute = prepared.probe_all_faces(&probes);
            for isa in Isa::ALL.into_iter().filter(|isa| isa.is_supported()) {
                let found = prepared.probe(&probes, isa);
                for ((probe, brute), found) in probes.iter().zip(&brute).zip(found) {
                    let bits = |hit: &ProbeHit| (hit.primitive, hit.face, hit.t.to_bits());
                    assert_eq!(
                        found.as_ref().map(bits),
                        brute.as_ref().map(bits),
                        "{style:?} scene {seed}, {isa}: {probe:?}"
                    );
                }
            }
        }
    }
}

#[test]
fn a_scaled_scene_gives_the_same_hits_to_the_bit() {
    let scene = random_scene(3, &recipe(Style::Plain));
    let probes = rays(&scene, 3, 1000);
    let hits = opened(&scene).probe(&probes, Isa::fastest());
    for exponent in [-40, 40] {
        let factor = 2_f64.powi(exponent);
        let mut scaled = scene.clone();
        for sphere in &mut scaled.spheres {
            sphere.center *= factor;
            sphere.radius *= factor;
        }
        scaled
            .triangles
            .iter_mut()
            .for_each(|face| face.vertices = face.vertices.map(|v| v * factor));
        scaled
            .quadrangles
            .iter_mut()
            .for_each(|face| face.vertices = face.vertices.map(|v| v * factor));
        let scale_box = |solid: &mut Parallelepiped| {
            solid.corner *= factor;
            solid.edges = solid.edges.map(|edge| edge * factor);
        };
        scaled.parallelepipeds.iter_mut().for_each(scale_box);
        for node in scaled.solids.iter_mut().flat_map(|solid| &mut solid.nodes) {
            match node {
                SolidNode::Sphere(sphere) => {
                    sphere.center *= factor;
                    sphere.radius *= factor;
                }
                SolidNode::Parallelepiped(solid) => scale_box(solid),
                SolidNode::Operation { .. } => {}
            }
        }
        scaled.lights.iter_mut().for_each(|light| light.position *= factor);
        let viewport = scaled.viewport.as_mut().expect("a viewport");
        viewport.eye *= factor;
        viewport.top_left *= factor;
        viewport.top_right *= factor;
        viewport.bottom_left *= factor;
        let probes: Vec<Probe> =
            probes.iter().map(|probe| Probe { origin: probe.origin * factor, ..*probe }).collect();
        for (hit, scaled) in hits.iter().zip(opened(&scaled).probe(&probes, Isa::fastest())) {
            assert_eq!(
                hit.map(|h| (h.primitive, h.t * factor)),
                scaled.map(|h| (h.primitive, h.t))
            );
        }
    }
}
