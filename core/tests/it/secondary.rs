//! Light that faces send on to others, against closed forms and the oracle's sums over the sky.
//! Every test prints how far off it is.

use std::{fmt::Write, ops::ControlFlow};

use glam::DVec3;
use rayon::prelude::*;
use rtfarm_core::{
    isa::Isa,
    prepared::PreparedScene,
    render::{Quality, RenderedTile, Sampling, Settings, render_tile},
    scene::{Scene, Texture},
    testing::render_trees,
    tile::{Area, Size},
};
use rtfarm_oracle::{
    Oracle, Settings as OracleSettings,
    closed_forms::{
        integrating_sphere_bounce, one_bounce_from_disc, patch_to_polygon, patch_to_sphere,
    },
    eye_direction,
    random::Random,
    reference_picture,
};

use crate::support::{
    parts::{join, sphere, upright},
    studio::{prepared, read, whole},
};

/// The materials of these scenes: what receives, and what sends on 0.4 of what it receives.
const MATERIALS: &str = "entry name matte endentry entry name shiny reflect 0.4 endentry ";

/// A screen that fills a hair's breadth around `point`, seen from the side of `normal`.
fn viewport(point: DVec3, normal: DVec3) -> String {
    let right = normal.any_orthonormal_vector();
    let up = normal.cross(right);
    let words = |p: DVec3| format!("{:?} {:?} {:?}", p.x, p.y, p.z);
    let corner = |x: f64, y: f64| words(point + 1e-7 * (x * right + y * up));
    format!(
        "viewport origin {} topleft {} bottomleft {} topright {} endviewport ",
        words(point + 1e-6 * normal),
        corner(-1.0, 1.0),
        corner(-1.0, -1.0),
        corner(1.0, 1.0)
    )
}

/// A small square around `point` that receives on the side of `normal`.
fn patch(point: DVec3, normal: DVec3) -> String {
    let right = 1e-5 * normal.any_orthonormal_vector();
    let up = normal.cross(right);
    polygon(
        &[point - right - up, point + right - up, point + right + up, point - right + up],
        "matte",
    )
}

/// A triangle or a quadrangle.
fn polygon(corners: &[DVec3], material: &str) -> String {
    let name = if corners.len() == 3 { "triangle" } else { "quadrangle" };
    let mut text = format!("{name} ");
    for corner in corners {
        write!(text, "vertex {:?} {:?} {:?} ", corner.x, corner.y, corner.z).unwrap();
    }
    text + &format!("material {material} end{name} ")
}

fn settings(side: u64, samples: u32, secondary: bool) -> Settings {
    let sampling = Sampling::fixed(samples).unwrap();
    let quality = Quality { sampling, seed: 5, secondary, ..Quality::default() };
    Settings { size: Size::new(side, side).unwrap(), quality }
}

fn rendered(scene: &Scene, settings: &Settings, isa: Isa) -> RenderedTile {
    let go_on = &mut || ControlFlow::Continue(());
    render_tile(&prepared(scene), &settings.quality, whole(settings.size), isa, go_on).unwrap()
}

/// The mean of numbers that estimate one, and its standard error.
fn mean_and_error(numbers: &[f64]) -> (f64, f64) {
    let count = numbers.len() as f64;
    let mean = numbers.iter().sum::<f64>() / count;
    let squares: f64 = numbers.iter().map(|x| (x - mean) * (x - mean)).sum();
    (mean, (squares / (count - 1.0) / count).sqrt())
}

/// Pixels on a side of what looks at one place: each estimates it independently.
const SIDE: u64 = 12;

/// The secondary light at a place that `shows` this share of its own light, and its standard error,
/// and how far the rounding of what is seen may move it. `lights` and `geometry` are scene text;
/// what receives is among the geometry.
fn gathered(
    materials: &str,
    lights: &str,
    geometry: &str,
    (point, normal): (DVec3, DVec3),
    shows: f64,
) -> (f64, f64, f64) {
    let scene = read(&format!(
        "{} materials {MATERIALS} {materials} endmaterials lights {lights} endlights
        geometry {geometry} endgeometry",
        viewport(point, normal)
    ));
    let [with, without] = [true, false].map(|secondary| {
        let Settings { size, quality } = settings(SIDE, 1024, secondary);
        // With a cut-off of 1 nothing is seen in mirrors.
        render_trees(&prepared(&scene), &quality, whole(size), Isa::fastest(), 1.0).pixels
    });
    let difference = |(with, without): (&[f32; 3], &[f32; 3])| {
        (f64::from(with[0]) - f64::from(without[0])) / shows
    };
    let differences: Vec<f64> = with.iter().zip(&without).map(difference).collect();
    let (mean, error) = mean_and_error(&differences);
    (mean, error, f64::from(f32::EPSILON * with[0][0]) / shows)
}

/// The estimate is the truth within its own noise, which is small.
fn check(what: &str, (mean, error, rounding): (f64, f64, f64), truth: f64, noise: f64) {
    let off = mean - truth;
    eprintln!(
        "{what}: {mean:.4e}, truly {truth:.4e}: off by {:+.2} %, noise {:.2} %, {:+.1} sigma",
        100.0 * off / truth,
        100.0 * error / truth,
        off / error
    );
    assert!(off.abs() <= 4.0 * error + rounding, "{what}: {mean} ± {error}");
    assert!(error <= noise * truth + rounding, "{what}: a noise of {error} in {truth}");
}

#[test]
fn inside_a_sphere_one_bounce_is_the_same_everywhere_wherever_the_light_is() {
    let (radius, power) = (2.0, 3.0);
    let truth = integrating_sphere_bounce(0.4, radius) * power;
    for light in [DVec3::ZERO, DVec3::new(1.0, 0.3, -0.2), DVec3::new(0.0, -1.9, 0.0)] {
        let lights = format!(
            "point coords {:?} {:?} {:?} power {power:?} endpoint",
            light.x, light.y, light.z
        );
        let ball = sphere(DVec3::ZERO, radius, "shiny");
        let solid =
            join("difference", &[&upright(DVec3::splat(-2.5), DVec3::splat(2.7), "matte"), &ball]);
        for direction in
            [DVec3::X, DVec3::new(0.6, -0.8, 0.0), DVec3::new(0.1, 0.7, -0.7).normalize()]
        {
            let place = (direction * radius, -direction);
            for (what, geometry) in [("sphere", &ball), ("box \\ sphere", &solid)] {
                let found = gathered("", &lights, geometry, place, 0.6);
                check(&format!("{what}, light at {light}, {direction}"), found, truth, 0.02);
            }
        }
    }
}

#[test]
fn a_plane_and_a_disc_send_back_what_integration_finds() {
    let height = 1.5;
    let place = (DVec3::new(0.0, 0.0, height), -DVec3::Z);
    let lights = format!("point coords 0.00002 0 {height:?} power 1 endpoint");
    let wide = 1e4;
    let plane = polygon(
        &[
            DVec3::new(-wide, -wide, 0.0),
            DVec3::new(wide, -wide, 0.0),
            DVec3::new(wide, wide, 0.0),
            DVec3::new(-wide, wide, 0.0),
        ],
        "shiny",
    );
    let truth = one_bounce_from_disc(0.4, height, f64::INFINITY);
    let found = gathered("", &lights, &(patch(place.0, place.1) + &plane), place, 1.0);
    check("plane", found, truth, 0.02);
    for radius in [0.1, 1.0, 5.0] {
        let slab = upright(DVec3::new(-9.0, -9.0, -1.0), DVec3::new(9.0, 9.0, 0.0), "shiny");
        let disc = join("intersection", &[&slab, &sphere(DVec3::ZERO, radius, "shiny")]);
        let truth = one_bounce_from_disc(0.4, height, radius);
        let found = gathered("", &lights, &(patch(place.0, place.1) + &disc), place, 1.0);
        check(&format!("disc of {radius}"), found, truth, 0.05);
    }
}

#[test]
fn a_patch_receives_from_a_ball_under_ambient_light_its_form_factor() {
    for distance in [1.0001, 1.05, 1.5, 3.0, 30.0] {
        for cosine in [1.0, 0.7, 0.2, 0.01, -0.005, -0.3] {
            let factor = patch_to_sphere(distance, cosine);
            // The ambient light on the patch itself leaves f32 no more digits.
            if factor < 1e-4 {
                continue;
            }
            let sine = f64::sqrt((1.0 - cosine) * (1.0 + cosine));
            let normal = DVec3::new(0.0, 0.36, 0.93).normalize();
            let aside = normal.any_orthonormal_vector();
            let ball = sphere(2.0 * distance * (cosine * normal + sine * aside), 2.0, "shiny");
            let place = (DVec3::ZERO, normal);
            let geometry = patch(DVec3::ZERO, normal) + &ball;
            let found = gathered("", "ambient 1", &geometry, place, 1.0);
            check(&format!("h {distance}, cos {cosine}"), found, 0.4 * factor, 0.03);
        }
    }
}

#[test]
fn a_lamp_in_a_clear_ball_lights_its_inside_which_is_seen_from_afar() {
    // Alpha 0.5 and reflect 0.2: the far inside sends on 0.1, and the near side lets 0.4 through.
    let materials = "entry name bulb alpha 0.5 reflect 0.2 endentry ";
    let normal = DVec3::Z;
    for distance in [1.5, 10.0, 1e4, 1e8] {
        for cosine in [1.0, 0.5] {
            let sine = f64::sqrt(1.0 - cosine * cosine);
            let center = distance * DVec3::new(sine, 0.0, cosine);
            let geometry = patch(DVec3::ZERO, normal) + &sphere(center, 1.0, "bulb");
            let lights = format!("point coords {:?} 0 {:?} power 1 endpoint", center.x, center.z);
            let truth = 0.1 * 0.4 * patch_to_sphere(distance, cosine);
            let found = gathered(materials, &lights, &geometry, (DVec3::ZERO, normal), 1.0);
            check(&format!("h {distance}, cos {cosine}"), found, truth, 0.03);
        }
    }
}

#[test]
fn a_patch_receives_from_an_evenly_lit_polygon_what_lambert_says() {
    let triangle =
        [DVec3::new(-1.0, -0.5, 0.0), DVec3::new(1.2, -0.7, 0.0), DVec3::new(0.1, 1.0, 0.0)];
    let square = [
        DVec3::new(-1.0, -1.0, 0.0),
        DVec3::new(1.0, -1.0, 0.0),
        DVec3::new(1.0, 1.0, 0.0),
        DVec3::new(-1.0, 1.0, 0.0),
    ];
    let concave = [
        DVec3::new(-1.0, -1.0, 0.0),
        DVec3::new(0.0, -0.3, 0.0),
        DVec3::new(1.0, -1.0, 0.0),
        DVec3::new(0.0, 1.0, 0.0),
    ];
    let turned = [1, 2, 3, 0].map(|k| concave[k]);
    // From far below everything and evenly: on the polygon, and on the back of the patch.
    let lamp = "reference power 1 distance 1000000 endreference point coords 0 0 -1000000 power 1 endpoint";
    let shapes: [(&str, &[DVec3]); 4] = [
        ("triangle", &triangle),
        ("square", &square),
        ("concave", &concave),
        ("concave, turned", &turned),
    ];
    for (name, shape) in shapes {
        // Straight below, very near, far, aside, and grazed from just beyond its edge.
        for (what, offset, tilt) in [
            ("below", DVec3::new(0.0, 0.1, 1.0), 0.0),
            ("near", DVec3::new(0.0, 0.2, 0.01), 0.0),
            ("touching", DVec3::new(0.0, 0.2, 1e-5), 0.0),
            ("far", DVec3::new(3.0, 2.0, 50.0), 0.2),
            ("aside", DVec3::new(4.0, 1.0, 1.0), 0.0),
            ("grazed", DVec3::new(5.0, 0.0, 0.01), 0.0),
            ("edge-on", DVec3::new(3.0, 0.0, 0.02), 1.0),
        ] {
            let corners: Vec<DVec3> = shape.iter().map(|&corner| corner + offset).collect();
            let normal = (DVec3::Z + tilt * DVec3::X).normalize();
            let mut reversed = corners.clone();
            reversed.reverse();
            let factor = patch_to_polygon(DVec3::ZERO, normal, &corners).max(patch_to_polygon(
                DVec3::ZERO,
                normal,
                &reversed,
            ));
            // There the patch would throw a shadow.
            let lights = if what == "touching" { "ambient 1" } else { lamp };
            let geometry = patch(DVec3::ZERO, normal) + &polygon(&corners, "shiny");
            let found = gathered("", lights, &geometry, (DVec3::ZERO, normal), 1.0);
            check(&format!("{name}, {what}"), found, 0.4 * factor, 0.05);
        }
    }
}

#[test]
fn a_thousand_emitters_give_the_sum_of_each() {
    // In one plane, so that none hides another; some a thousand times as bright as others.
    let mut random = Random::new(3);
    let mut materials = String::new();
    for k in 0..10 {
        let shade = 255.0 / f64::from(1 << k);
        write!(materials, "entry name m{k} color {shade:?} 0 0 reflect 0.5 endentry ").unwrap();
    }
    for (what, place, normal) in [
        ("below", DVec3::new(1.0, 2.0, 0.0), DVec3::Z),
        ("aside", DVec3::new(60.0, 3.0, 0.0), DVec3::Z),
        ("near", DVec3::new(-7.3, 3.1, 2.9), DVec3::Z),
    ] {
        let (mut geometry, mut truth) = (patch(place, normal), 0.0);
        for k in 0..1024 {
            let cell = DVec3::new(f64::from(k % 32) - 16.0, f64::from(k / 32) - 16.0, 3.0);
            let corner = |random: &mut Random, x: f64, y: f64| {
                let (dx, dy) = (random.between(0.0, 0.3), random.between(0.0, 0.3));
                cell + DVec3::new(x - x * 2.0 * dx, y - y * 2.0 * dy, 0.0)
            };
            let size = random.between(0.1, 0.45);
            let corners = [(-1.0, -1.0), (-1.0, 1.0), (1.0, 1.0), (1.0, -1.0)]
                .map(|(x, y)| corner(&mut random, size * x, size * y));
            let corners = &corners[..3 + k as usize % 2];
            let material = random.below(10);
            truth +=
                0.5 / f64::from(1 << material) * patch_to_polygon(place, normal, corners).abs();
            geometry += &polygon(corners, &format!("m{material}"));
        }
        let found = gathered(&materials, "ambient 1", &geometry, (place, normal), 1.0);
        check(what, found, truth, 0.05);
    }
}

#[test]
fn what_a_pane_lets_through_is_what_arrives() {
    // 0.7 · 0.8 through each of two panes; the panes themselves send on nothing.
    let materials = "entry name glass color 0 0 0 alpha 0.3 reflect 0.2 endentry ";
    let panes: String = [1.0, 1.5]
        .map(|z| {
            polygon(
                &[
                    DVec3::new(-50.0, -50.0, z),
                    DVec3::new(50.0, -50.0, z),
                    DVec3::new(50.0, 50.0, z),
                    DVec3::new(-50.0, 50.0, z),
                ],
                "glass",
            )
        })
        .concat();
    let place = (DVec3::ZERO, DVec3::Z);
    for distance in [2.0, 8.0] {
        let ball = sphere(DVec3::new(0.3, 0.0, 2.0 * distance), 2.0, "shiny");
        let cosine = 2.0 * distance / (0.09 + 4.0 * distance * distance).sqrt();
        let factor = patch_to_sphere((0.09 + 4.0 * distance * distance).sqrt() / 2.0, cosine);
        let geometry = patch(DVec3::ZERO, DVec3::Z) + &ball + &panes;
        let found = gathered(materials, "ambient 1", &geometry, place, 1.0);
        check(&format!("two panes, {distance}"), found, 0.4 * factor * 0.56 * 0.56, 0.03);
    }
    // A pane that is lit and sends on, and lets what is behind it through as well.
    let materials = "entry name glass alpha 0.5 reflect 0.5 endentry ";
    let pane = [
        DVec3::new(-1.0, -1.0, 1.0),
        DVec3::new(-1.0, 1.0, 1.0),
        DVec3::new(1.0, 1.0, 1.0),
        DVec3::new(1.0, -1.0, 1.0),
    ];
    let behind = pane.map(|corner| 2.0 * corner);
    let geometry =
        patch(DVec3::ZERO, DVec3::Z) + &polygon(&pane, "glass") + &polygon(&behind, "shiny");
    let factor = patch_to_polygon(DVec3::ZERO, DVec3::Z, &pane).abs();
    let found = gathered(materials, "ambient 1", &geometry, place, 1.0);
    check("a pane that sends on", found, factor * (0.25 + 0.25 * 0.4), 0.03);
}

/// A few of everything over a floor, under two lamps: what is red, green or blue sends on, and so
/// does a pane that lets light through.
fn medley(seed: u64) -> Scene {
    let mut random = Random::new(seed);
    let mut near = |place: DVec3| place + 0.4 * random.in_cube();
    let floor =
        [(-9.0, -9.0), (9.0, -9.0), (9.0, 9.0), (-9.0, 9.0)].map(|(x, y)| DVec3::new(x, y, 0.0));
    let mut geometry = polygon(&floor, "matte");
    geometry += &sphere(near(DVec3::new(-2.2, -1.0, 1.2)), 0.7, "red");
    geometry += &sphere(near(DVec3::new(2.0, 0.5, 2.2)), 0.4, "green");
    let corners = [(-0.5, -3.0, 0.5), (1.5, -2.5, 0.6), (0.6, -2.0, 2.0)];
    let triangle = corners.map(|(x, y, z)| near(DVec3::new(x, y, z)));
    geometry += &polygon(&triangle, "blue");
    let (corner, right) = (near(DVec3::new(-4.0, 2.0, 0.5)), DVec3::new(3.5, 1.0, 0.3));
    let up = DVec3::new(0.2, 0.4, 2.5);
    let wall = [corner, corner + right, corner + right + 0.7 * up, corner + up];
    geometry += &polygon(&wall, "green");
    let low = near(DVec3::new(1.2, -1.4, 0.5));
    let bite = near(low + DVec3::new(0.2, 0.0, 1.0));
    geometry += &join(
        "difference",
        &[&upright(low, low + DVec3::new(1.2, 1.0, 1.1), "blue"), &sphere(bite, 0.6, "red")],
    );
    let corner = near(DVec3::new(-3.2, -2.2, 0.5));
    let (right, up) = (DVec3::new(2.0, -0.4, 0.1), DVec3::new(0.1, 0.5, 1.9));
    geometry += &polygon(&[corner, corner + right, corner + right + up, corner + up], "pane");
    read(&format!(
        "viewport origin 0 -9 3 topleft -1.6 -6 3 bottomleft -1.6 -6 1.2 topright 1.6 -6 3
            background 20 30 40 endviewport
        materials entry name matte color 200 210 190 endentry
            entry name red color 255 40 20 reflect 0.3 endentry
            entry name green color 60 220 50 reflect 0.15 alpha 0.8 endentry
            entry name blue color 30 60 255 reflect 0.2 endentry
            entry name pane color 250 240 160 reflect 0.2 alpha 0.3 endentry endmaterials
        lights ambient 0.2 reference power 1 distance 4 endreference
            point coords 2 -4 4 power 2 endpoint
            point coords -3 -3.5 3 power 1.5 endpoint endlights
        geometry {geometry} endgeometry"
    ))
}

/// With this cut-off nothing is seen in mirrors of mirrors.
const CUTOFF: f64 = 0.1;

/// A picture of which a pixel's one sample is its middle.
fn middles<B: AsRef<[u8]>>(
    block: &PreparedScene<B>,
    size: Size,
    seed: u64,
    secondary: bool,
) -> Vec<[f32; 3]> {
    let sampling = Sampling::fixed(1).unwrap();
    let quality = Quality { sampling, seed, secondary, ..Quality::default() };
    render_trees(block, &quality, whole(size), Isa::fastest(), CUTOFF).pixels
}

fn oracle_settings(secondary: Option<u32>) -> OracleSettings {
    OracleSettings { cutoff: CUTOFF, secondary, ..OracleSettings::default() }
}

/// The mean of a picture over many seeds is what the oracle sums, within 4 sigma and the error of
/// that sum, which a coarser one tells. Both are small shares of the light that is sent on.
fn check_against_oracle(what: &str, scene: &Scene, size: Size, side: u32, seeds: u64) {
    let block = prepared(scene);
    let pictures: Vec<Vec<[f32; 3]>> =
        (0..seeds).into_par_iter().map(|seed| middles(&block, size, seed, true)).collect();
    let middle = |_, _| vec![(0.5, 0.5)];
    let summed = |secondary| {
        let settings = oracle_settings(secondary);
        reference_picture(scene, size, &middle, &settings).into_flattened()
    };
    let (none, coarse, fine) = (summed(None), summed(Some(side / 2)), summed(Some(side)));
    let differences = fine.iter().zip(&coarse).map(|(fine, coarse)| (fine - coarse).abs());
    // One place's two sums may agree by chance.
    let blur = differences.fold(0.0, f64::max);
    let (mut brightest, mut worst, mut noise) = (0.0_f64, 0.0_f64, 0.0_f64);
    for (k, truth) in fine.iter().enumerate() {
        let values: Vec<f64> =
            pictures.iter().map(|pixels| f64::from(pixels.as_flattened()[k])).collect();
        let (mean, error) = mean_and_error(&values);
        let off = (mean - truth).abs();
        let rounding = f64::from(f32::EPSILON) * truth;
        let what = format!("{what}, pixel {}, channel {}", k / 3, k % 3);
        assert!(
            off <= 4.0 * error + blur + rounding,
            "{what}: {mean} ± {error}, truly {truth} ± {blur}, and {} without",
            none[k]
        );
        brightest = brightest.max(truth - none[k]);
        worst = worst.max(off);
        noise = noise.max(error);
    }
    // All of it together, where noise is least.
    let total = |values: &[f64]| values.iter().sum::<f64>();
    let total_seen =
        |pixels: &Vec<[f32; 3]>| pixels.as_flattened().iter().map(|x| f64::from(*x)).sum();
    let (mean, error) = mean_and_error(&pictures.iter().map(total_seen).collect::<Vec<f64>>());
    let (off, blur_of_all) = (mean - total(&fine), (total(&fine) - total(&coarse)).abs());
    let gathered = total(&fine) - total(&none);
    eprintln!(
        "{what}: secondary light up to {brightest:.2e}; off by up to {worst:.1e}, noise up to \
         {noise:.1e}, the sum's error about {blur:.1e}; in all off by {:+.2} %, noise {:.2} %, the \
         sum's error {:.2} %",
        100.0 * off / gathered,
        100.0 * error / gathered,
        100.0 * blur_of_all / gathered
    );
    assert!(off.abs() <= 4.0 * error + blur_of_all + 1e-6, "{what}: {mean} ± {error}");
    assert!(brightest > 0.01 && noise < 0.025 * brightest && blur < 0.02 * brightest, "{what}");
    assert!(error < 0.01 * gathered && blur_of_all < 0.01 * gathered, "{what}");
}

#[test]
fn the_mean_of_many_seeds_is_what_the_oracle_sums_over_the_sky() {
    for seed in [1, 2] {
        let size = Size::new(4, 3).unwrap();
        check_against_oracle(&format!("medley {seed}"), &medley(seed), size, 192, 30_000);
    }
}

#[test]
fn a_face_with_a_texture_sends_on_its_finest_colours() {
    // Stripes and spots that any coarser level would blend.
    let mut random = Random::new(3);
    let texels = (0..64).map(|k| {
        let bright = if k / 8 % 2 == 0 { 255 } else { 0 };
        [bright, random.below(256) as u8, 255 - bright]
    });
    let texture = Texture { path: String::new(), width: 8, height: 8, texels: texels.collect() };
    let square = |corners: [(f64, f64, f64); 4], material| {
        polygon(&corners.map(|(x, y, z)| DVec3::new(x, y, z)), material)
    };
    let mut scene = read(&format!(
        "viewport origin 0 -3 2 topleft -0.3 -1.5 0.9 bottomleft -0.3 -1.5 0.3
            topright 0.3 -1.5 0.9 endviewport
        materials entry name matte endentry entry name worn reflect 0.5 endentry endmaterials
        lights ambient 0.3 reference power 1 distance 2 endreference
            point coords 1 -1 1.5 power 1 endpoint endlights
        geometry {} {} {} endgeometry",
        square([(-5.0, -5.0, 0.0), (5.0, -5.0, 0.0), (5.0, 5.0, 0.0), (-5.0, 5.0, 0.0)], "matte"),
        square([(-1.0, 0.6, 0.1), (1.0, 0.4, 0.1), (0.8, 0.495, 1.0), (-1.0, 0.7, 1.3)], "worn"),
        polygon(
            &[DVec3::new(-0.9, -0.7, 0.1), DVec3::new(-1.0, 0.3, 0.1), DVec3::new(-1.2, 0.0, 0.8)],
            "worn"
        ),
    ));
    scene.textures.push(texture);
    scene.materials[1].texture = Some(0);
    check_against_oracle("worn", &scene, Size::new(3, 2).unwrap(), 192, 30_000);
}

#[test]
fn without_it_the_picture_is_the_oracles_in_light_from_lamps_alone() {
    let size = Size::new(32, 18).unwrap();
    for seed in [1, 2, 3] {
        let scene = medley(seed);
        let found = middles(&prepared(&scene), size, 7, false);
        let middle = |_, _| vec![(0.5, 0.5)];
        let truth = reference_picture(&scene, size, &middle, &oracle_settings(None));
        let oracle = Oracle::new(&scene);
        let viewport = scene.viewport.unwrap();
        for (k, (found, truth)) in found.iter().zip(&truth).enumerate() {
            let off = |(a, b): (&f32, &f64)| (f64::from(*a) - b).abs();
            let off = found.iter().zip(truth).map(off).fold(0.0, f64::max);
            let at = |k: usize| k as f64 + 0.5;
            let direction = eye_direction(&viewport, size, at(k % 32), at(k / 32));
            let sees = oracle.first_hit(viewport.eye, direction, None).map(|hit| hit.id);
            assert!(off < 1e-6, "medley {seed}, pixel {k}, {sees:?}: {found:?}, truly {truth:?}");
        }
    }
}

/// Balls, boxes, a solid, a mirror and glass over a floor, with a lamp; all colours shine.
fn crowd() -> Scene {
    let mut random = Random::new(11);
    let mut geometry = polygon(
        &[
            DVec3::new(-9.0, -9.0, 0.0),
            DVec3::new(9.0, -9.0, 0.0),
            DVec3::new(9.0, 9.0, 0.0),
            DVec3::new(-9.0, 9.0, 0.0),
        ],
        "matte",
    );
    for _ in 0..8 {
        let at = DVec3::new(random.between(-4.0, 4.0), random.between(-4.0, 4.0), 0.6);
        geometry += &sphere(at, random.between(0.2, 0.6), "red");
        geometry +=
            &upright(at + DVec3::new(0.7, 0.2, -0.6), at + DVec3::new(1.2, 0.6, 0.3), "blue");
    }
    geometry += &join(
        "difference",
        &[
            &upright(DVec3::new(-1.0, -1.0, 1.5), DVec3::new(1.0, 1.0, 2.5), "blue"),
            &sphere(DVec3::new(0.0, 0.0, 1.5), 0.8, "red"),
        ],
    );
    geometry += &sphere(DVec3::new(0.0, -2.5, 0.8), 0.5, "glass");
    read(&format!(
        "viewport origin 0 -9 3 topleft -2 -6 3.6 bottomleft -2 -6 0.6 topright 2 -6 3.6 endviewport
        materials {MATERIALS} entry name red color 255 40 20 reflect 0.3 endentry
        entry name blue color 30 60 255 reflect 0.2 alpha 0.9 endentry
        entry name glass color 200 255 200 alpha 0.2 reflect 0.1 refract 0.7 endentry endmaterials
        lights ambient 0.2 reference power 1 distance 4 endreference
            point coords 3 -5 6 power 1.5 endpoint point coords -4 -2 3 power 0.5 endpoint endlights
        geometry {geometry} endgeometry"
    ))
}

fn bits(pixels: &[[f32; 3]]) -> Vec<[u32; 3]> {
    pixels.iter().map(|pixel| pixel.map(f32::to_bits)).collect()
}

#[test]
fn a_pixel_is_the_same_on_every_machine_and_in_every_tile() {
    let scene = crowd();
    let quality = Quality { sampling: Sampling::fixed(9).unwrap(), ..Quality::default() };
    let settings = Settings { size: Size::new(47, 35).unwrap(), quality };
    let whole_picture = rendered(&scene, &settings, Isa::Scalar);
    for isa in Isa::ALL.into_iter().filter(|isa| isa.is_supported()) {
        let other = rendered(&scene, &settings, isa);
        assert!(bits(&whole_picture.pixels) == bits(&other.pixels), "{isa}");
        assert_eq!(whole_picture.tally, other.tally);
    }
    let block = prepared(&scene);
    for area in [
        Area::new(settings.size, [0, 0], [1, 35]).unwrap(),
        Area::new(settings.size, [13, 7], [20, 9]).unwrap(),
        Area::new(settings.size, [46, 34], [1, 1]).unwrap(),
    ] {
        let go_on = &mut || ControlFlow::Continue(());
        let tile = render_tile(&block, &settings.quality, area, Isa::fastest(), go_on).unwrap();
        let rows = area.rows().flat_map(|y| {
            let start = (y * 47 + area.x0()) as usize;
            whole_picture.pixels[start..start + area.width() as usize].iter().copied()
        });
        assert!(bits(&tile.pixels) == bits(&rows.collect::<Vec<_>>()), "{area:?}");
    }
}

#[test]
fn a_scaled_scene_gathers_the_same_light_to_the_bit() {
    let scene = crowd();
    let quality = Quality { sampling: Sampling::fixed(2).unwrap(), ..Quality::default() };
    let settings = Settings { size: Size::new(40, 30).unwrap(), quality };
    let picture = rendered(&scene, &settings, Isa::fastest()).pixels;
    for factor in [2_f64.powi(-40), 2_f64.powi(40)] {
        let mut scaled = scene.clone();
        for sphere in &mut scaled.spheres {
            (sphere.center, sphere.radius) = (sphere.center * factor, sphere.radius * factor);
        }
        for face in &mut scaled.quadrangles {
            face.vertices = face.vertices.map(|vertex| vertex * factor);
        }
        for solid in &mut scaled.parallelepipeds {
            (solid.corner, solid.edges) = (solid.corner * factor, solid.edges.map(|e| e * factor));
        }
        for node in scaled.solids.iter_mut().flat_map(|solid| &mut solid.nodes) {
            match node {
                rtfarm_core::scene::SolidNode::Sphere(sphere) => {
                    (sphere.center, sphere.radius) =
                        (sphere.center * factor, sphere.radius * factor);
                }
                rtfarm_core::scene::SolidNode::Parallelepiped(solid) => {
                    (solid.corner, solid.edges) =
                        (solid.corner * factor, solid.edges.map(|e| e * factor));
                }
                rtfarm_core::scene::SolidNode::Operation { .. } => {}
            }
        }
        for light in &mut scaled.lights {
            light.position *= factor;
            light.intensity *= factor * factor;
        }
        let viewport = scaled.viewport.as_mut().unwrap();
        viewport.eye *= factor;
        viewport.top_left *= factor;
        viewport.bottom_left *= factor;
        viewport.top_right *= factor;
        let scaled = rendered(&scaled, &settings, Isa::fastest()).pixels;
        assert!(bits(&scaled) == bits(&picture), "{factor:e}");
    }
}

#[test]
fn one_bounce_is_no_more_than_the_brightest_face_sends_on() {
    let scene = crowd();
    let settings = |secondary| {
        let quality = Quality {
            sampling: Sampling::fixed(64).unwrap(),
            secondary,
            ..settings(1, 1, true).quality
        };
        Settings { size: Size::new(64, 48).unwrap(), quality }
    };
    let with = rendered(&scene, &settings(true), Isa::fastest()).pixels;
    let without = rendered(&scene, &settings(false), Isa::fastest()).pixels;
    // No face is nearer than 2 to a lamp of 1.5 · 16 or 0.5 · 16.
    let bound = 0.3 * (0.2 + 24.0 / 4.0 + 8.0 / 4.0);
    let mut largest = 0.0_f64;
    for (with, without) in with.iter().zip(&without) {
        for (with, without) in with.iter().zip(without) {
            assert!(with.is_finite() && *with >= *without, "{with} {without}");
            largest = largest.max(f64::from(with - without));
        }
    }
    eprintln!("at most {largest:.4}, bound {bound:.4}");
    assert!(largest > 0.01 && largest <= bound);
}

#[test]
fn without_it_the_picture_is_that_of_a_scene_whose_faces_send_on_nothing() {
    let quality = |secondary| Quality {
        sampling: Sampling::fixed(4).unwrap(),
        secondary,
        ..Quality::default()
    };
    let size = Size::new(64, 48).unwrap();
    let [on, off] = [true, false].map(|secondary| Settings { size, quality: quality(secondary) });
    // Nothing reflects: no ray more.
    let mut dull = crowd();
    for material in &mut dull.materials {
        material.reflect = 0.0;
    }
    let [with, without] = [&on, &off].map(|settings| rendered(&dull, settings, Isa::fastest()));
    assert!(with == without);
    // What reflects is seen in the light of the lamps alone.
    let scene = crowd();
    let [with, without] = [&on, &off].map(|settings| rendered(&scene, settings, Isa::fastest()));
    assert!(with.tally.rays > without.tally.rays && with.pixels != without.pixels);
    // A scene without light, or in plain colours, has none to send on.
    let mut unlit = crowd();
    (unlit.ambient, unlit.lights) = (None, Vec::new());
    let [with, without] = [&on, &off].map(|settings| rendered(&unlit, settings, Isa::fastest()));
    assert!(with == without);
    let flat = |settings: &Settings| Settings {
        quality: Quality { flat: true, ..settings.quality },
        ..*settings
    };
    let [with, without] =
        [flat(&on), flat(&off)].map(|settings| rendered(&scene, &settings, Isa::fastest()));
    assert!(with == without);
}
