//! The scene of the benchmarks: a lathe bottle of any number of triangles.

use glam::DVec3;
use rtfarm_core::scene::{Light, Material, Quadrangle, Scene, Triangle, Viewport};

/// A bottle with a bumpy label, standing on the ground.
pub(crate) fn bottle(triangles: usize) -> Scene {
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
