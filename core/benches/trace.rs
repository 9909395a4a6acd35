//! Prepares and renders a lathe bottle of a million triangles: seconds to prepare, bytes a
//! triangle, millions of rays a second.
//!
//!     cargo bench -p rtfarm-core --bench trace [-- TRIANGLES]

#![expect(clippy::print_stdout, reason = "a benchmark prints its figures")]
#![expect(clippy::disallowed_methods, reason = "a benchmark reads the clock and makes a bottle")]

use std::{ops::ControlFlow, time::Instant};

use glam::DVec3;
use rayon::prelude::*;
use rtfarm_core::{
    isa::Isa,
    prepare::prepare,
    prepared::PreparedScene,
    render::{DEFAULT_CUTOFF, Settings, render_tile},
    scene::{Light, Material, Quadrangle, Scene, Triangle, Viewport},
    tile::{Size, TileGrid},
};

fn main() {
    let triangles = std::env::args().find_map(|word| word.parse().ok());
    let scene = bottle(triangles.unwrap_or(1_000_000));
    let count = scene.triangles.len() as f64;
    println!("bottle of {count} triangles, medians of 5");

    for threads in [1, 2] {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads");
        let seconds = median(|| {
            let start = Instant::now();
            pool.install(|| prepare(&scene).expect("a plain scene"));
            start.elapsed().as_secs_f64()
        });
        println!("prepare, {threads} threads: {:.0} ms", seconds * 1e3);
    }
    let prepared = PreparedScene::open(prepare(&scene).expect("a plain scene")).expect("valid");
    println!("prepared: {:.1} bytes a triangle", prepared.byte_count() as f64 / count);
    let seconds = median(|| {
        let bytes = prepare(&scene).expect("a plain scene");
        let start = Instant::now();
        drop(PreparedScene::open(bytes));
        start.elapsed().as_secs_f64()
    });
    println!("open: {:.0} ms", seconds * 1e3);

    let size = Size::new(1280, 720).expect("a size");
    let grid = TileGrid::balanced(size);
    for flat in [true, false] {
        let settings = Settings { size, samples: 1, seed: 0, flat, cutoff: DEFAULT_CUTOFF };
        for isa in Isa::ALL.into_iter().filter(|isa| isa.is_supported()) {
            for threads in [1, 2] {
                let pool =
                    rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads");
                let mut rays = 0;
                let seconds = median(|| {
                    let start = Instant::now();
                    rays = pool.install(|| {
                        let tile = |tile| {
                            let on = &mut || ControlFlow::Continue(());
                            render_tile(&prepared, &settings, grid.area(tile), isa, on)
                        };
                        let order = grid.render_order();
                        order.par_iter().map(|&t| tile(t).expect("not stopped").rays).sum::<u64>()
                    });
                    start.elapsed().as_secs_f64()
                });
                let kind = if flat { "camera rays" } else { "camera and shadow rays" };
                println!(
                    "{kind}, {isa}, {threads} threads: {:.2} Mrays/s ({:.0} ms)",
                    rays as f64 / seconds / 1e6,
                    seconds * 1e3
                );
            }
        }
    }
}

fn median(mut run: impl FnMut() -> f64) -> f64 {
    let mut seconds: Vec<f64> = (0..5).map(|_| run()).collect();
    seconds.sort_by(f64::total_cmp);
    seconds[2]
}

/// A bottle with a bumpy label, standing on the ground.
fn bottle(triangles: usize) -> Scene {
    let around = ((triangles as f64 / 2.0).sqrt() as usize).max(8);
    let along = (triangles / 2 / around).max(4);
    let radius = |height: f64| {
        let shoulder = ((height - 1.65) / 0.6).clamp(0.0, 1.0);
        0.62 - 0.42 * shoulder * shoulder * (3.0 - 2.0 * shoulder)
    };
    let point = |i: usize, j: usize| {
        let height = 3.0 * j as f64 / along as f64;
        let angle = std::f64::consts::TAU * (i % around) as f64 / around as f64;
        let bump = 0.008 * (31.0 * angle).sin() * (37.0 * height).sin();
        let r = radius(height) + bump;
        DVec3::new(r * angle.cos(), height, r * angle.sin())
    };
    let mut faces = Vec::new();
    for j in 0..along {
        for i in 0..around {
            let [a, b, c, d] = [point(i, j), point(i, j + 1), point(i + 1, j), point(i + 1, j + 1)];
            for vertices in [[a, b, c], [c, b, d]] {
                let primitive = faces.len() as u32;
                faces.push(Triangle { vertices, material: 0, primitive });
            }
        }
    }
    let ground = [(-12.0, 12.0), (12.0, 12.0), (12.0, -12.0), (-12.0, -12.0)]
        .map(|(x, z)| DVec3::new(x, 0.0, z));
    let primitive = faces.len() as u32;
    let material = |r, g, b| Material {
        name: String::new(),
        color: DVec3::new(r, g, b),
        alpha: 1.0,
        reflect: 0.0,
        refract: 0.0,
        texture: None,
        places: rtfarm_core::scene::MaterialPlaces::default(),
    };
    Scene {
        viewport: Some(Viewport {
            eye: DVec3::new(0.2, 2.0, 4.5),
            top_left: DVec3::new(-1.6, 2.9, 1.5),
            bottom_left: DVec3::new(-1.6, 1.1, 1.5),
            top_right: DVec3::new(1.6, 2.9, 1.5),
        }),
        materials: vec![material(0.2, 0.6, 0.3), material(0.6, 0.6, 0.5)],
        lights: vec![
            Light { position: DVec3::new(7.0, 9.0, 7.0), intensity: DVec3::splat(130.0) },
            Light { position: DVec3::new(1.5, 8.0, 9.0), intensity: DVec3::splat(60.0) },
        ],
        triangles: faces,
        quadrangles: vec![Quadrangle { vertices: ground, material: 1, primitive }],
        ..Scene::default()
    }
}
