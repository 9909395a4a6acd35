//! Scenes whose every pixel has a closed form.

use glam::DVec3;
use rayon::prelude::*;
use rtfarm_core::{
    read::read_scene,
    scene::{Scene, Viewport},
    tile::Size,
};

use crate::{
    closed_forms::{
        irradiance, patch_to_sphere, polygon_coverage, polygon_outline, sphere_outline,
    },
    picture::{eye_direction, grid_positions},
};

/// A scene and its true picture.
#[derive(Debug)]
pub struct KnownPicture {
    /// What it is called in tables.
    pub name: &'static str,
    /// What there is to see.
    pub scene: Scene,
    /// The frame in pixels.
    pub size: Size,
    /// The mean over each pixel, linear, row by row.
    pub truth: Vec<[f64; 3]>,
}

/// A screen of 4 x 3 at z = 0, seen from z = 5 and a little aside.
const VIEWPORT: &str = "viewport origin 0.3 -0.2 5 topleft -2 1.5 0 bottomleft -2 -1.5 0
    topright 2 1.5 0 endviewport
materials entry name white endentry
    entry name bright reflect 0.9 endentry endmaterials\n";

/// All of them, `width` pixels wide and three quarters as high: outlines of spheres, outlines of
/// polygons, a hard shadow, the light of a lamp, the light that a ball out of sight sends on.
pub fn known_pictures(width: u32) -> Vec<KnownPicture> {
    let size = Size::new(width.into(), u64::from(width) * 3 / 4).expect("a small size");
    vec![spheres(size), polygons(size), shadow(size), lamp(size), ball(size)]
}

fn known(
    name: &'static str,
    size: Size,
    text: &str,
    truth: impl Fn(&Scene, u32, u32) -> f64 + Sync,
) -> KnownPicture {
    let nothing = |_: &str| Err(std::io::ErrorKind::NotFound.into());
    let reading = read_scene(format!("{VIEWPORT}{text}").as_bytes(), &nothing);
    let scene = reading.scene.expect("a scene without a fault");
    let pixels = size.pixel_count() as u32;
    let truth = (0..pixels)
        .into_par_iter()
        .map(|k| [truth(&scene, k % size.width(), k / size.width()); 3])
        .collect();
    KnownPicture { name, scene, size, truth }
}

fn viewport(scene: &Scene) -> Viewport {
    scene.viewport.expect("every text has one")
}

fn spheres(size: Size) -> KnownPicture {
    let text = "geometry
        sphere coords -0.9 0.3 -1 radius 1.1 material white endsphere
        sphere coords 1.2 -0.7 0.3 radius 0.4 material white endsphere
        sphere coords 1.1 0.8 -4 radius 0.9 material white endsphere
        endgeometry";
    known("spheres", size, text, move |scene, x, y| {
        let coverage = scene.spheres.iter().map(|sphere| {
            let outline = sphere_outline(&viewport(scene), size, sphere.center, sphere.radius);
            outline.expect("before the eye").coverage(x, y)
        });
        coverage.sum()
    })
}

fn polygons(size: Size) -> KnownPicture {
    let text = "geometry
        triangle vertex -2.1 -1.2 -0.5 vertex -0.3 -1.3 -1 vertex -1.2 1.4 -1 material white
            endtriangle
        quadrangle vertex 0 -1 0 vertex 1.9 -0.9 0 vertex 0.8 -0.4 0 vertex 0.3 1.3 0
            material white endquadrangle endgeometry";
    known("polygons", size, text, move |scene, x, y| {
        let corners = [&scene.triangles[0].vertices[..], &scene.quadrangles[0].vertices[..]];
        let coverage = corners.iter().map(|corners| {
            let outline = polygon_outline(&viewport(scene), size, corners);
            polygon_coverage(&outline.expect("before the eye"), x, y)
        });
        coverage.sum()
    })
}

/// The light is so far that all that it reaches is equally bright, within 1e-4.
fn shadow(size: Size) -> KnownPicture {
    let text = "lights reference power 1 distance 100000 endreference
            point coords 20000 30000 92737 power 1 endpoint endlights
        geometry
            quadrangle vertex -40 -40 -1 vertex 40 -40 -1 vertex 40 40 -1 vertex -40 40 -1
                material white endquadrangle
            quadrangle vertex 0 -1 9 vertex 4 -1 9 vertex 2.3 1 9 vertex 2 4 9
                material white endquadrangle endgeometry";
    known("shadow", size, text, move |scene, x, y| {
        let light = scene.lights[0];
        let shadow = scene.quadrangles[1].vertices.map(|corner| {
            let away = corner - light.position;
            light.position + away * ((-1.0 - light.position.z) / away.z)
        });
        let outline = polygon_outline(&viewport(scene), size, &shadow).expect("before the eye");
        let lit = lamp_at(scene, size, f64::from(x) + 0.5, f64::from(y) + 0.5);
        lit * (1.0 - polygon_coverage(&outline, x, y))
    })
}

fn lamp(size: Size) -> KnownPicture {
    let text = "lights reference power 5 distance 2 endreference
            point coords 0.4 0.3 -0.6 power 0.15 endpoint endlights
        geometry quadrangle vertex -9 -9 -1 vertex 9 -9 -1 vertex 9 9 -1 vertex -9 9 -1
            material white endquadrangle endgeometry";
    known("lamp", size, text, move |scene, x, y| {
        let positions = grid_positions(32);
        let light =
            |&(sx, sy): &(f64, f64)| lamp_at(scene, size, f64::from(x) + sx, f64::from(y) + sy);
        positions.iter().map(light).sum::<f64>() / positions.len() as f64
    })
}

/// Under ambient light alone a ball sends on the same everywhere.
fn ball(size: Size) -> KnownPicture {
    let text = "lights ambient 0.5 endlights
        geometry quadrangle vertex -9 -9 -1 vertex 9 -9 -1 vertex 9 9 -1 vertex -9 9 -1
            material white endquadrangle
            sphere coords -4.2 0.3 0.6 radius 1.5 material bright endsphere endgeometry";
    known("ball", size, text, move |scene, x, y| {
        let (viewport, ball, ambient) = (viewport(scene), scene.spheres[0], 0.5);
        let reflect = scene.materials[ball.material as usize].reflect;
        let received = |&(sx, sy): &(f64, f64)| {
            let direction = eye_direction(&viewport, size, f64::from(x) + sx, f64::from(y) + sy);
            let point = viewport.eye + direction * ((-1.0 - viewport.eye.z) / direction.z);
            let to_ball = ball.center - point;
            let distance = to_ball.length();
            let share = patch_to_sphere(distance / ball.radius, to_ball.z / distance);
            ambient + reflect * ambient * share
        };
        let positions = grid_positions(8);
        positions.iter().map(received).sum::<f64>() / positions.len() as f64
    })
}

/// What the one lamp gives the plane z = -1 at a place of the screen.
fn lamp_at(scene: &Scene, size: Size, x: f64, y: f64) -> f64 {
    let (viewport, light) = (viewport(scene), scene.lights[0]);
    let direction = eye_direction(&viewport, size, x, y);
    let point = viewport.eye + direction * ((-1.0 - viewport.eye.z) / direction.z);
    light.intensity.x * irradiance(light.position, point, DVec3::Z)
}
