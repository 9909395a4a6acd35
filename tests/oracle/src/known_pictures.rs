//! Scenes whose every pixel has a closed form.

use glam::{DMat2, DVec2, DVec3};
use rayon::prelude::*;
use rtfarm_core::{
    language::read_scene,
    scene::{Scene, Texture, Viewport},
    tile::Size,
};

use crate::{
    closed_forms::{
        Ellipse, irradiance, patch_to_sphere, polygon_coverage, polygon_outline,
        slab_screen_radius, sphere_outline, wave_mean,
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

/// A screen of 4 x 3 at z = 0, seen from [`EYE`]: from z = 5 and a little aside.
const VIEWPORT: &str = "viewport origin 0.3 -0.2 5 topleft -2 1.5 0 bottomleft -2 -1.5 0
    topright 2 1.5 0 endviewport
materials entry name white endentry
    entry name bright reflect 0.9 endentry endmaterials\n";

const EYE: DVec3 = DVec3::new(0.3, -0.2, 5.0);

const SPHERES: &str = "geometry
    sphere coords -0.9 0.3 -1 radius 1.1 material white endsphere
    sphere coords 1.2 -0.7 0.3 radius 0.4 material white endsphere
    sphere coords 1.1 0.8 -4 radius 0.9 material white endsphere
    endgeometry";

const POLYGONS: &str = "geometry
    triangle vertex -2.1 -1.2 -0.5 vertex -0.3 -1.3 -1 vertex -1.2 1.4 -1 material white
        endtriangle
    quadrangle vertex 0 -1 0 vertex 1.9 -0.9 0 vertex 0.8 -0.4 0 vertex 0.3 1.3 0
        material white endquadrangle endgeometry";

const SHADOW: &str = "lights reference power 1 distance 100000 endreference
        point coords 20000 30000 92737 power 1 endpoint endlights
    geometry
        quadrangle vertex -40 -40 -1 vertex 40 -40 -1 vertex 40 40 -1 vertex -40 40 -1
            material white endquadrangle
        quadrangle vertex 0 -1 9 vertex 4 -1 9 vertex 2.3 1 9 vertex 2 4 9
            material white endquadrangle endgeometry";

const LAMP: &str = "lights reference power 5 distance 2 endreference
        point coords 0.4 0.3 -0.6 power 0.15 endpoint endlights
    geometry quadrangle vertex -9 -9 -1 vertex 9 -9 -1 vertex 9 9 -1 vertex -9 9 -1
        material white endquadrangle endgeometry";

const BALL: &str = "lights ambient 0.5 endlights
    geometry quadrangle vertex -9 -9 -1 vertex 9 -9 -1 vertex 9 9 -1 vertex -9 9 -1
        material white endquadrangle
        sphere coords -4.2 0.3 0.6 radius 1.5 material bright endsphere endgeometry";

/// What is seen directly, `width` pixels wide and three quarters as high: outlines of spheres,
/// outlines of polygons, a hard shadow, the light of a lamp, the light that a ball out of sight
/// sends on.
pub fn known_pictures(width: u32) -> Vec<KnownPicture> {
    let size = known_size(width);
    vec![spheres(size), polygons(size), shadow(size), lamp(size), ball(size)]
}

/// The size of pictures so many pixels wide.
pub fn known_size(width: u32) -> Size {
    Size::new(width.into(), u64::from(width) * 3 / 4).expect("a small size")
}

/// The scenes of [`known_pictures`] as their files would have them, by name.
pub fn known_texts() -> [(&'static str, String); 5] {
    [
        ("spheres", SPHERES),
        ("polygons", POLYGONS),
        ("shadow", SHADOW),
        ("lamp", LAMP),
        ("ball", BALL),
    ]
    .map(|(name, text)| (name, format!("{VIEWPORT}{text}")))
}

/// What is seen in a mirror, through glass, and of an image on a plane to the horizon.
pub fn indirect_pictures(width: u32) -> Vec<KnownPicture> {
    let size = known_size(width);
    vec![mirror(size), glass(size), checkerboard(size)]
}

fn known(
    name: &'static str,
    size: Size,
    text: &str,
    truth: impl Fn(&Scene, u32, u32) -> f64 + Sync,
) -> KnownPicture {
    known_from(name, size, &format!("{VIEWPORT}{text}"), truth)
}

fn known_from(
    name: &'static str,
    size: Size,
    text: &str,
    truth: impl Fn(&Scene, u32, u32) -> f64 + Sync,
) -> KnownPicture {
    let nothing = |_: &str| Err(std::io::ErrorKind::NotFound.into());
    let reading = read_scene(text.as_bytes(), &nothing);
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
    known("spheres", size, SPHERES, move |scene, x, y| {
        let coverage = scene.spheres.iter().map(|sphere| {
            let outline = sphere_outline(&viewport(scene), size, sphere.center, sphere.radius);
            outline.expect("before the eye").coverage(x, y)
        });
        coverage.sum()
    })
}

fn polygons(size: Size) -> KnownPicture {
    known("polygons", size, POLYGONS, move |scene, x, y| {
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
    known("shadow", size, SHADOW, move |scene, x, y| {
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
    known("lamp", size, LAMP, move |scene, x, y| {
        let positions = grid_positions(32);
        let light =
            |&(sx, sy): &(f64, f64)| lamp_at(scene, size, f64::from(x) + sx, f64::from(y) + sy);
        positions.iter().map(light).sum::<f64>() / positions.len() as f64
    })
}

/// Under ambient light alone a ball sends on the same everywhere.
fn ball(size: Size) -> KnownPicture {
    known("ball", size, BALL, move |scene, x, y| {
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

/// What a mirror shows stands behind the eye; its picture is that of the mirrored shapes.
fn mirror(size: Size) -> KnownPicture {
    let text = "geometry
        quadrangle vertex -2.1 -1.5 -1 vertex 2.2 -1.3 -1 vertex 1.8 1.5 -1 vertex -1.9 1.6 -1
            material bright endquadrangle
        triangle vertex -2.6 -1.9 8 vertex 0.5 -1.6 9 vertex -1.1 2.2 8 material white endtriangle
        sphere coords 1.9 0.4 10 radius 1.3 material white endsphere endgeometry";
    known("mirror", size, text, move |scene, x, y| {
        let (viewport, sphere) = (viewport(scene), scene.spheres[0]);
        let mirrored = |point: DVec3| DVec3::new(point.x, point.y, -2.0 - point.z);
        let polygon = |corners: &[DVec3]| {
            let outline = polygon_outline(&viewport, size, corners).expect("before the eye");
            polygon_coverage(&outline, x, y)
        };
        let outline = sphere_outline(&viewport, size, mirrored(sphere.center), sphere.radius);
        let shown = polygon(&scene.triangles[0].vertices.map(mirrored))
            + outline.expect("before the eye").coverage(x, y);
        let mirror = scene.quadrangles[0];
        let reflect = scene.materials[mirror.material as usize].reflect;
        (1.0 - reflect) * polygon(&mirror.vertices) + reflect * shown
    })
}

/// Two balls behind a slab that is parallel to the screen, all about one axis through the eye: so
/// are their outlines.
fn glass(size: Size) -> KnownPicture {
    let text = "materials entry name glass refract 0.6 endentry
            entry name grey color 102 102 102 endentry endmaterials
        geometry parallelepiped vertex -40 -40 -2 vertex 40 -40 -2 vertex -40 40 -2
            vertex -40 -40 -1 material glass endparallelepiped
        sphere coords 0.3 -0.2 -4 radius 1.2 material white endsphere
        sphere coords 0.3 -0.2 -8 radius 3 material grey endsphere endgeometry";
    known("glass", size, text, move |scene, x, y| {
        let (slab, ratio) = (scene.parallelepipeds[0], 0.6);
        let pixels = DVec2::new(f64::from(size.width()) / 4.0, f64::from(size.height()) / 3.0);
        let coverage = |index: usize| {
            let sphere = scene.spheres[index];
            let distance = EYE.z - sphere.center.z;
            let thickness = slab.edges[2].z;
            let radius = EYE.z * slab_screen_radius(distance, sphere.radius, thickness, ratio);
            let axis = DVec2::new(EYE.x + 2.0, 1.5 - EYE.y) * pixels;
            Ellipse { center: axis, axes: DMat2::from_diagonal(radius * pixels) }.coverage(x, y)
        };
        let grey = scene.materials[scene.spheres[1].material as usize].color.x;
        coverage(0) + grey * (coverage(1) - coverage(0))
    })
}

/// Squares of a half on a plane to the horizon, seen from 1 above it.
pub fn checkerboard(size: Size) -> KnownPicture {
    let text = "viewport origin 0 0 0 topleft -0.6 0.5 -1 bottomleft -0.6 -1 -1 topright 0.6 0.5 -1
        endviewport materials entry name image endentry endmaterials
        geometry quadrangle vertex -100000 -1 0.5 texcoord -100000 0.5
            vertex 100000 -1 0.5 texcoord 100000 0.5
            vertex 100000 -1 -100000 texcoord 100000 -100000
            vertex -100000 -1 -100000 texcoord -100000 -100000
            material image endquadrangle endgeometry";
    let mut known = known_from("checkerboard", size, text, move |_, x, y| {
        // In a row of the screen the depth is one, and the squares are clipped at once. Bilinear
        // interpolation is one along a row of texels, times one across it.
        let lines = 4096;
        let texel = 1.0 / 256.0;
        let line = |k: u32| {
            let down = f64::from(y) + (f64::from(k) + 0.5) / f64::from(lines);
            let height = 1.5 * down / f64::from(size.height()) - 0.5;
            if height <= 0.0 {
                return 0.0; // Above the horizon.
            }
            let depth = 1.0 / height;
            let across = |x: u32| depth * (1.2 * f64::from(x) / f64::from(size.width()) - 0.6);
            let row = wave_mean(-depth - 1e-9, -depth + 1e-9, texel);
            (1.0 - row * wave_mean(across(x), across(x + 1), texel)) / 2.0
        };
        (0..lines).map(line).sum::<f64>() / f64::from(lines)
    });
    let side = 256;
    let texel = |k: u32| if (k % side < side / 2) == (k / side < side / 2) { 0 } else { 255 };
    let texels = (0..side * side).map(|k| [texel(k); 3]).collect();
    known.scene.textures.push(Texture {
        path: "checkerboard".to_owned(),
        width: side,
        height: side,
        texels,
    });
    known.scene.materials[0].texture = Some(0);
    known
}

/// What the one lamp gives the plane z = -1 at a place of the screen.
fn lamp_at(scene: &Scene, size: Size, x: f64, y: f64) -> f64 {
    let (viewport, light) = (viewport(scene), scene.lights[0]);
    let direction = eye_direction(&viewport, size, x, y);
    let point = viewport.eye + direction * ((-1.0 - viewport.eye.z) / direction.z);
    light.intensity.x * irradiance(light.position, point, DVec3::Z)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Settings, reference_picture};

    /// Each closed form against the oracle's own picture.
    #[test]
    fn what_is_known_is_what_the_oracle_sees() {
        let side = 12;
        let positions = move |_, _| grid_positions(side);
        let settings = Settings { secondary: None, ..Settings::default() };
        let known = known_pictures(16).into_iter().take(4).chain(indirect_pictures(16));
        for known in known {
            let seen = reference_picture(&known.scene, known.size, &positions, &settings);
            let squares = seen.iter().zip(&known.truth).map(|(a, b)| (a[0] - b[0]).powi(2));
            let rms = (squares.sum::<f64>() / seen.len() as f64).sqrt();
            let off = seen.iter().zip(&known.truth).map(|(a, b)| (a[0] - b[0]).abs());
            let worst = off.fold(0.0, f64::max);
            assert!(rms < 0.02 && worst < 0.1, "{}: {rms} {worst}", known.name);
            let light: f64 = known.truth.iter().map(|pixel| pixel[0]).sum();
            assert!(light > 0.02 * seen.len() as f64, "{} is dark", known.name);
        }
    }
}
