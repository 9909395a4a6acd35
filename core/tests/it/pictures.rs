//! Whole pictures: the tracer's against the oracle's, against closed forms, against its own when
//! the picture is cut, the scene scaled, moved or turned.

use std::{fs, path::Path};

use glam::{DVec2, DVec3};
use rtfarm_core::{
    language::read_scene,
    prepared::{PreparedBytes, PreparedScene},
    render::{Sampling, Settings},
    sample::Samples,
    scene::{Scene, Viewport},
    tile::{Area, Size},
};
use rtfarm_oracle::{
    Oracle, Settings as OracleSettings,
    closed_forms::{irradiance, polygon_coverage, polygon_outline, sphere_outline},
    eye_direction,
    hard_case::HardCase,
    random::Random,
    random_scene::{Recipe, Style, random_scene},
    reference_picture,
};

use crate::support::studio::{
    picture, pixels, prepared, quality, read, settings, tree_picture, whole,
};

/// The channels are rounded to f32 once, at the end; 1.0 is what a scene writes as 255.
const ROUNDING: f64 = 1e-6;

fn positions(settings: &Settings, x: u32, y: u32) -> Vec<(f64, f64)> {
    let Sampling::Fixed(count) = settings.quality.sampling else { panic!("fixed sampling") };
    let count = count.get();
    let samples = Samples::new(count, settings.quality.seed, x, y);
    (0..count).map(|k| samples.sample(k).position().into()).collect()
}

fn is_same(found: [f32; 3], truth: [f64; 3]) -> bool {
    found.iter().zip(truth).all(|(f, t)| (f64::from(*f) - t).abs() <= ROUNDING * t.max(1.0))
}

/// How little would have to move for a pixel to look otherwise: the least margin of its samples'
/// rays and of the lines to the lights.
fn pixel_margin(oracle: &Oracle, scene: &Scene, settings: &Settings, x: u32, y: u32) -> f64 {
    let viewport = scene.viewport.unwrap();
    let margin = |(sx, sy): (f64, f64)| {
        let at = DVec2::new(f64::from(x) + sx, f64::from(y) + sy);
        let direction = eye_direction(&viewport, settings.size, at.x, at.y);
        let Some(hit) = oracle.first_hit(viewport.eye, direction, None) else {
            return oracle.miss_margin(viewport.eye, direction, None);
        };
        let passage = |position| oracle.transmittance(hit.point, Some(hit.id), position).margin;
        scene.lights.iter().map(|light| passage(light.position)).fold(hit.margin, f64::min)
    };
    positions(settings, x, y).into_iter().map(margin).fold(f64::INFINITY, f64::min)
}

/// The tracer's picture is the oracle's, but for pixels with a sample so close to an edge that
/// rounding decides; tells how many there are.
fn check_against_oracle(what: &str, scene: &Scene, settings: &Settings) -> usize {
    let found = tree_picture(scene, settings);
    let oracle_settings =
        OracleSettings { flat: settings.quality.flat, ..OracleSettings::default() };
    let of_pixel = |x, y| positions(settings, x, y);
    let truth = reference_picture(scene, settings.size, &of_pixel, &oracle_settings);
    let oracle = Oracle::new(scene);
    let mut close = 0;
    for (k, (found, truth)) in (0..).zip(found.into_iter().zip(truth)) {
        if !is_same(found, truth) {
            let (x, y) = (k % settings.size.width(), k / settings.size.width());
            let margin = pixel_margin(&oracle, scene, settings, x, y);
            assert!(margin < 1e-9, "{what}: ({x}, {y}): {found:?}, truly {truth:?} by {margin:e}");
            close += 1;
        }
    }
    close
}

#[test]
fn our_scenes_look_as_the_oracle_sees_them() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../scenes");
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.extension().is_none_or(|extension| extension != "rt") {
            continue;
        }
        let beside = |file: &str| fs::read(path.with_file_name(file));
        let reading = read_scene(&fs::read(&path).unwrap(), &beside);
        let scene = reading.scene.expect("our own scenes are without a fault");
        if !scene.textures.is_empty() {
            continue; // Filtered, so `textures.rs` has it.
        }
        // Brute force takes its time.
        let is_large = scene.triangles.len() > 1000;
        let settings = if is_large { settings(32, 18, 1) } else { settings(48, 27, 4) };
        let what = path.file_name().unwrap().to_str().unwrap();
        let close = check_against_oracle(what, &scene, &settings);
        assert!(close <= 1, "{what}: {close} pixels are too close to call");
    }
}

#[test]
fn random_scenes_look_as_the_oracle_sees_them() {
    for style in [Style::Plain, Style::Grid, Style::Extreme, Style::Far] {
        let mut close = 0;
        for seed in 100..110 {
            let scene = random_scene(seed, &recipe(style));
            let what = format!("{style:?} scene {seed}");
            close += check_against_oracle(&what, &scene, &settings(32, 24, 3));
        }
        eprintln!("{style:?}: {close} of {} pixels are too close to call", 10 * 32 * 24);
    }
}

#[test]
fn random_mirrors_and_glass_look_as_the_oracle_sees_them() {
    for style in [Style::Plain, Style::Grid, Style::Far] {
        let mut close = 0;
        for seed in 200..206 {
            let recipe = Recipe { solids: 2, clear: true, ..Recipe::new(style) };
            let scene = random_scene(seed, &recipe);
            let settings = settings(24, 18, 1);
            let found = tree_picture(&scene, &settings);
            let of_pixel = |x, y| positions(&settings, x, y);
            let truth =
                reference_picture(&scene, settings.size, &of_pixel, &OracleSettings::default());
            close += found.iter().zip(&truth).filter(|(f, t)| !is_same(**f, **t)).count();
        }
        eprintln!("{style:?}: {close} of {} pixels differ", 6 * 24 * 18);
        assert!(close <= 3, "{style:?}: more than the few where a deep ray passes an edge");
    }
}

#[test]
fn a_scene_by_others_looks_as_the_oracle_sees_it() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/scenes/test12783.rt");
    let Ok(text) = fs::read_to_string(&path) else {
        eprintln!("SKIPPED: {} is not there", path.display());
        return;
    };
    let nothing = |_: &str| Err(std::io::ErrorKind::NotFound.into());
    let scene = read_scene(text.as_bytes(), &nothing).scene.unwrap();
    let close = check_against_oracle("test12783.rt", &scene, &settings(24, 24, 1));
    assert!(close <= 1, "{close} pixels are too close to call");
}

/// A screen of 4 x 3 at z = 0, seen from z = 5 and a little aside.
const VIEWPORT: &str = "viewport origin 0.3 -0.2 5 topleft -2 1.5 0 bottomleft -2 -1.5 0
    topright 2 1.5 0 endviewport
materials entry name white endentry endmaterials\n";

fn pixel_centers(size: Size) -> impl Iterator<Item = (f64, f64)> {
    let (width, height) = (size.width(), size.height());
    (0..height).flat_map(move |y| (0..width).map(move |x| (f64::from(x) + 0.5, f64::from(y) + 0.5)))
}

#[test]
fn light_falls_with_the_square_and_the_cosine() {
    let scene = read(&format!(
        "{VIEWPORT}
        lights reference power 5 distance 2 endreference
            point coords 0.4 0.3 1.5 power 3 color 255 510 51 endpoint endlights
        geometry quadrangle vertex -9 -9 -1 vertex 9 -9 -1 vertex 9 9 -1 vertex -9 9 -1
            material white endquadrangle endgeometry"
    ));
    let (settings, viewport) = (settings(64, 48, 1), scene.viewport.unwrap());
    let mut worst = 0.0_f64;
    for (found, (x, y)) in picture(&scene, &settings).into_iter().zip(pixel_centers(settings.size))
    {
        let direction = eye_direction(&viewport, settings.size, x, y);
        let point = viewport.eye + direction * (-6.0 / direction.z);
        let arriving = irradiance(DVec3::new(0.4, 0.3, 1.5), point, DVec3::Z);
        for (channel, color) in found.into_iter().zip([1.0, 2.0, 0.2]) {
            let truth = 3.0 / 5.0 * 4.0 * color * arriving;
            worst = worst.max((f64::from(channel) - truth).abs() / truth);
        }
    }
    assert!(worst < f64::from(f32::EPSILON), "off by {worst:e} of the light");
}

/// The share of each pixel that is covered: the tracer's answer converges to it as the samples of
/// a Sobol net do, N^(-3/4), and no pixel is ever off by more than the net's cells on an outline.
/// What is covered has this `brightness`, the rest is black.
fn check_coverage(
    what: &str,
    (scene, brightness): (&Scene, f64),
    size: Size,
    coverage: impl Fn(u32, u32) -> f64,
) {
    let scene = prepared(scene);
    let mut errors = Vec::new();
    for samples in [16, 64, 256, 1024] {
        let settings = Settings { size, quality: quality(samples, 3) };
        let side = f64::from(samples).sqrt();
        let (mut squares, mut edge_count, mut sum, mut worst) = (0.0, 0, 0.0, 0.0_f64);
        for (k, pixel) in (0..).zip(pixels(&scene, &settings, whole(size))) {
            let truth = coverage(k % size.width(), k / size.width());
            let error = f64::from(pixel[0]) / brightness - truth;
            sum += error;
            worst = worst.max(error.abs());
            if truth > 1e-6 && truth < 1.0 - 1e-6 {
                squares += error * error;
                edge_count += 1;
            } else {
                assert!(error.abs() < 2e-4, "{what}: pixel {k} is {pixel:?}, truly {truth}");
            }
        }
        assert!(edge_count > 20, "{what}: {edge_count} pixels at the edge");
        let rms = f64::sqrt(squares / f64::from(edge_count));
        let (worst_bound, rms_bound) = (4.0 / side, 0.5 / (side * side.sqrt()));
        let bias = sum.abs() / f64::from(edge_count);
        assert!(worst < worst_bound, "{what}, {samples} samples: off by {worst}");
        assert!(rms < rms_bound, "{what}, {samples} samples: {rms} rms, not {rms_bound}");
        let bias_bound = 4.0 * rms_bound / f64::from(edge_count).sqrt() + 1e-4;
        assert!(bias < bias_bound, "{what}, {samples} samples: {bias} on average");
        errors.push(format!("{samples}: rms {rms:.1e}, worst {worst:.1e}, mean {bias:.1e}"));
    }
    eprintln!("{what}: {}", errors.join("; "));
}

#[test]
fn a_sphere_covers_what_its_outline_says() {
    let scene = read(&format!(
        "{VIEWPORT} geometry sphere coords 0.5 -0.3 -1 radius 1.1 material white endsphere
        endgeometry"
    ));
    let (size, sphere) = (Size::new(32, 24).unwrap(), scene.spheres[0]);
    let outline = sphere_outline(&scene.viewport.unwrap(), size, sphere.center, sphere.radius);
    let outline = outline.unwrap();
    check_coverage("sphere", (&scene, 1.0), size, |x, y| outline.coverage(x, y));
}

#[test]
fn polygons_cover_what_their_outlines_say() {
    let scene = read(&format!(
        "{VIEWPORT} geometry
        triangle vertex -2.1 -1.2 -0.5 vertex -0.3 -1.3 -1 vertex -1.2 1.4 -1 material white
            endtriangle
        quadrangle vertex 0 -1 0 vertex 1.9 -0.9 0 vertex 0.8 -0.4 0 vertex 0.3 1.3 0
            material white endquadrangle endgeometry"
    ));
    let (size, viewport) = (Size::new(32, 24).unwrap(), scene.viewport.unwrap());
    let triangle = polygon_outline(&viewport, size, &scene.triangles[0].vertices).unwrap();
    let quadrangle = polygon_outline(&viewport, size, &scene.quadrangles[0].vertices).unwrap();
    check_coverage("polygons", (&scene, 1.0), size, |x, y| {
        polygon_coverage(&triangle, x, y) + polygon_coverage(&quadrangle, x, y)
    });
}

#[test]
fn a_shadow_has_the_outline_of_what_throws_it() {
    // The light is so far that all that it reaches is equally bright, within 1e-4.
    let scene = read(&format!(
        "{VIEWPORT} lights reference power 1 distance 100000 endreference
            point coords 20000 30000 92737 power 1 endpoint endlights
        geometry
            quadrangle vertex -40 -40 -1 vertex 40 -40 -1 vertex 40 40 -1 vertex -40 40 -1
                material white endquadrangle
            quadrangle vertex 0 -1 9 vertex 4 -1 9 vertex 2.3 1 9 vertex 2 4 9
                material white endquadrangle endgeometry"
    ));
    let (size, viewport) = (Size::new(32, 24).unwrap(), scene.viewport.unwrap());
    let light = scene.lights[0];
    let shadow = scene.quadrangles[1].vertices.map(|corner| {
        let away = corner - light.position;
        light.position + away * ((-1.0 - light.position.z) / away.z)
    });
    let outline = polygon_outline(&viewport, size, &shadow).unwrap();
    let brightness = irradiance(light.position, DVec3::new(0.0, 0.0, -1.0), DVec3::Z) * 1e10;
    let lit = |x, y| 1.0 - polygon_coverage(&outline, x, y);
    check_coverage("shadow", (&scene, brightness), size, lit);
}

#[test]
fn the_light_of_two_lamps_is_the_sum_of_each() {
    for seed in 0..4 {
        let mut scene = random_scene(seed, &recipe(Style::Plain));
        (scene.ambient, scene.background) = (None, DVec3::ZERO);
        let settings = settings(40, 30, 2);
        let both = picture(&scene, &settings);
        let mut sum = vec![[0.0; 3]; both.len()];
        for light in &scene.lights.clone() {
            scene.lights = vec![*light];
            for (sum, pixel) in sum.iter_mut().zip(picture(&scene, &settings)) {
                *sum = [0, 1, 2].map(|c| sum[c] + f64::from(pixel[c]));
            }
        }
        for (k, (both, sum)) in both.into_iter().zip(sum).enumerate() {
            let is_sum = |(b, s): (f32, f64)| (f64::from(b) - s).abs() <= ROUNDING * s;
            assert!(both.into_iter().zip(sum).all(is_sum), "{seed}: {k}: {both:?}, not {sum:?}");
        }
    }
}

fn recipe(style: Style) -> Recipe {
    Recipe { solids: 2, ..Recipe::new(style) }
}

fn crowded(style: Style) -> Scene {
    random_scene(
        7,
        &Recipe {
            spheres: 20,
            triangles: 40,
            quadrangles: 20,
            parallelepipeds: 0,
            ..Recipe::new(style)
        },
    )
}

fn bits(pixels: &[[f32; 3]]) -> Vec<[u32; 3]> {
    pixels.iter().map(|pixel| pixel.map(f32::to_bits)).collect()
}

/// The picture cut into areas is the picture in one piece, bit for bit.
fn check_areas(
    scene: &PreparedScene<PreparedBytes>,
    settings: &Settings,
    areas: impl IntoIterator<Item = Area>,
) {
    let picture = bits(&pixels(scene, settings, whole(settings.size)));
    for area in areas {
        let rows = area.rows().flat_map(|y| {
            let start = (y * settings.size.width() + area.x0()) as usize;
            picture[start..start + area.width() as usize].iter().copied()
        });
        assert!(bits(&pixels(scene, settings, area)).into_iter().eq(rows), "{area:?}");
    }
}

#[test]
fn the_picture_does_not_depend_on_how_it_is_cut() {
    let scene = prepared(&crowded(Style::Plain));
    let mut random = Random::new(1);
    let fixed = [1, 5, 16].map(|count| Sampling::fixed(count).unwrap());
    for sampling in fixed.into_iter().chain(Sampling::adaptive(0.02, 64)) {
        let mut settings = settings(71, 43, 1);
        settings.quality.sampling = sampling;
        let (width, height) = (settings.size.width(), settings.size.height());
        let area = |start, sides| Area::new(settings.size, start, sides).unwrap();
        let row = |y0| area([0, y0], [width, 1]);
        let column = |x0| area([x0, 0], [1, height]);
        check_areas(&scene, &settings, (0..height).map(row));
        check_areas(&scene, &settings, (0..width).map(column));
        let areas = (0..40).map(|_| {
            let mut side = |length: u32| {
                let start = random.below(length as usize) as u32;
                (start, 1 + random.below((length - start) as usize) as u32)
            };
            let ((x0, width), (y0, height)) = (side(width), side(height));
            area([x0, y0], [width, height])
        });
        check_areas(&scene, &settings, areas);
    }
}

/// The scene with all its points changed; `factor` is what that does to lengths.
fn transformed(scene: &Scene, change: impl Fn(DVec3) -> DVec3, factor: f64) -> Scene {
    let mut scene = scene.clone();
    for sphere in &mut scene.spheres {
        (sphere.center, sphere.radius) = (change(sphere.center), sphere.radius * factor);
    }
    for face in &mut scene.triangles {
        face.vertices = face.vertices.map(&change);
    }
    for face in &mut scene.quadrangles {
        face.vertices = face.vertices.map(&change);
    }
    for light in &mut scene.lights {
        light.position = change(light.position);
        light.intensity *= factor * factor;
    }
    let Viewport { eye, top_left, bottom_left, top_right } = scene.viewport.unwrap();
    let [eye, top_left, bottom_left, top_right] =
        [eye, top_left, bottom_left, top_right].map(change);
    scene.viewport = Some(Viewport { eye, top_left, bottom_left, top_right });
    scene
}

#[test]
fn a_scaled_scene_gives_the_same_picture_to_the_bit() {
    for style in [Style::Plain, Style::Grid, Style::Extreme] {
        let scene = crowded(style);
        let settings = settings(64, 48, 4);
        let picture_bits = bits(&picture(&scene, &settings));
        for exponent in [-40, -1, 3, 40] {
            let factor = 2_f64.powi(exponent);
            let scaled = transformed(&scene, |point| point * factor, factor);
            assert!(bits(&picture(&scaled, &settings)) == picture_bits, "{style:?} 2^{exponent}");
        }
    }
    HardCase::ScaledByPowersOfTwo
        .tell("a scene scaled by 2^-40 to 2^40 gives the same picture to the bit", "12 pictures");
}

/// Two pictures differ by more than one step of eight bits in at most 1 of 10,000 pixels.
fn check_alike(what: &str, settings: &Settings, a: &Scene, b: &Scene) -> usize {
    let (a, b) = (picture(a, settings), picture(b, settings));
    let differs = |(a, b): &(&[f32; 3], &[f32; 3])| {
        a.iter().zip(*b).any(|(a, b)| (a - b).abs() > 1.0 / 255.0)
    };
    let differing = a.iter().zip(&b).filter(differs).count();
    assert!(differing * 10_000 <= a.len(), "{what}: {differing} of {} pixels differ", a.len());
    differing
}

#[test]
fn a_scene_moved_by_a_million_looks_the_same() {
    let offset = DVec3::new(1e6, -1e6, 1e6);
    let scene = crowded(Style::Plain);
    let moved = transformed(&scene, |point| point + offset, 1.0);
    let differing = check_alike("moved", &settings(160, 120, 4), &scene, &moved);
    let measured = format!("{differing} of {} pixels differ by more than 1/255", 160 * 120);
    HardCase::FarScene.tell("a scene moved by 1e6 looks the same", measured);
}

#[test]
fn a_scene_turned_by_quarters_looks_the_same() {
    type Turn = fn(DVec3) -> DVec3;
    let scene = crowded(Style::Plain);
    let turns: [(&str, Turn); 3] = [
        ("about x", |p| DVec3::new(p.x, -p.z, p.y)),
        ("about y", |p| DVec3::new(p.z, p.y, -p.x)),
        ("about the diagonal", |p| DVec3::new(p.y, p.z, p.x)),
    ];
    for (what, turn) in turns {
        check_alike(what, &settings(160, 120, 2), &scene, &transformed(&scene, turn, 1.0));
    }
}
