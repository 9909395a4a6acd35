//! Whatever 64 samples of every pixel show is in the adaptive picture too, however thin it is.
//! Polygons seen straight on have closed forms: their area on the screen.

use std::{fmt::Write, ops::ControlFlow};

use glam::DVec3;
use rtfarm_core::{
    isa::Isa,
    prepared::{PreparedBytes, PreparedScene},
    render::{Quality, RenderedTile, Sampling, render_tile},
    tile::{Area, Size},
};

use rtfarm_oracle::hard_case::HardCase;

use crate::support::studio::{prepared, read, whole};

/// The screen of all scenes here, at z = 0, seen from z = 5: 96 x 72 pixels of this side.
const PIXEL: f64 = 4.0 / 96.0;

const VIEWPORT: &str = "viewport origin 0 0 5 topleft -2 1.5 0 bottomleft -2 -1.5 0
    topright 2 1.5 0 endviewport
    materials entry name white endentry entry name red color 255 0 0 endentry
    entry name blue color 0 0 255 endentry entry name dim color 128 0 0 endentry entry name grey color 120 120 120 endentry
    entry name mirror color 0 0 0 reflect 1 endentry entry name pane alpha 0 endentry endmaterials\n";

fn adaptive() -> Sampling {
    Sampling::adaptive(1.0 / 255.0, 256).unwrap()
}

fn frame() -> Size {
    Size::new(96, 72).unwrap()
}

fn scene(geometry: &str) -> PreparedScene<PreparedBytes> {
    prepared(&read(&format!("{VIEWPORT} geometry {geometry} endgeometry")))
}

fn scene_with(lights: &str, geometry: &str) -> PreparedScene<PreparedBytes> {
    prepared(&read(&format!(
        "{VIEWPORT} lights {lights} endlights geometry {geometry} endgeometry"
    )))
}

/// In light that comes from everywhere faces look as they do without light, but nobody knows that.
fn lit_scene(geometry: &str) -> PreparedScene<PreparedBytes> {
    scene_with("ambient 1", geometry)
}

fn render(
    scene: &PreparedScene<PreparedBytes>,
    sampling: Sampling,
    area: Area,
    isa: Isa,
) -> RenderedTile {
    render_with(scene, sampling, area, isa, 1)
}

fn render_with(
    scene: &PreparedScene<PreparedBytes>,
    sampling: Sampling,
    area: Area,
    isa: Isa,
    seed: u64,
) -> RenderedTile {
    let quality = Quality { sampling, seed, ..Quality::default() };
    render_tile(scene, &quality, area, isa, &mut || ControlFlow::Continue(())).unwrap()
}

/// Which share of a picture's light is lacking in one channel, where `truth` is all of it in
/// pixels, adaptive and with 64 samples; and how many samples the adaptive pixels have.
fn lacking(scene: &PreparedScene<PreparedBytes>, channel: usize, truth: f64) -> ([f64; 2], f64) {
    let [adaptive, fixed] = [adaptive(), Sampling::fixed(64).unwrap()]
        .map(|sampling| render(scene, sampling, whole(frame()), Isa::fastest()));
    let lack = |tile: &RenderedTile| {
        1.0 - tile.pixels.iter().map(|pixel| f64::from(pixel[channel])).sum::<f64>() / truth
    };
    let each = adaptive.tally.samples as f64 / frame().pixel_count() as f64;
    ([lack(&adaptive), lack(&fixed)], each)
}

fn check(what: &str, scene: &PreparedScene<PreparedBytes>, channel: usize, truth: f64, most: f64) {
    let ([adaptive, fixed], each) = lacking(scene, channel, truth);
    eprintln!("{what}: lacks {adaptive:.3}, with 64 samples {fixed:.3}; {each:.1} samples a pixel");
    assert!(adaptive.abs() < most, "{what}: {adaptive}");
}

/// A parallelogram from (x, y) along (dx, dy), so wide across.
fn wire_corners([x, y]: [f64; 2], [dx, dy]: [f64; 2], width: f64) -> [[f64; 2]; 4] {
    let length = (dx * dx + dy * dy).sqrt();
    let (nx, ny) = (-dy / length * width / 2.0, dx / length * width / 2.0);
    [[x - nx, y - ny], [x + dx - nx, y + dy - ny], [x + dx + nx, y + dy + ny], [x + nx, y + ny]]
}

/// A wire at a depth of `z`. It looks as it would at z = 0.
fn wire(from: [f64; 2], along: [f64; 2], width: f64, z: f64, material: &str) -> String {
    mirrored_wire(from, along, width, (z, z), material)
}

/// A wire at a depth of `z` that looks as it would at z = 0 if it is seen at a depth of `seen`.
fn mirrored_wire(
    from: [f64; 2],
    along: [f64; 2],
    width: f64,
    (seen, z): (f64, f64),
    material: &str,
) -> String {
    let scale = (5.0 - seen) / 5.0;
    let mut text = "quadrangle ".to_owned();
    for [x, y] in wire_corners(from, along, width) {
        write!(text, "vertex {} {} {z} ", x * scale, y * scale).unwrap();
    }
    text + &format!("material {material} endquadrangle\n")
}

const WIDTHS: [f64; 6] = [0.5, 0.25, 0.125, 1.0 / 16.0, 1.0 / 32.0, 1.0 / 64.0];

/// What may be lacking at each width.
const MOST: [f64; 6] = [0.01, 0.01, 0.01, 0.02, 0.03, 0.05];

/// Wires in a fan, so that they lie in all ways in their pixels: the text and the light of it.
fn fan(width: f64, z: f64, material: &str) -> (String, f64) {
    fan_at(width, (z, z), material)
}

/// Such a fan that is seen at one depth and is at another.
fn fan_at(width: f64, depths: (f64, f64), material: &str) -> (String, f64) {
    let mut text = String::new();
    let mut light = 0.0;
    for k in 0..12 {
        let x = -1.8 + 0.2 * f64::from(k);
        let along = [0.01 * f64::from(k * k), 2.6];
        text += &mirrored_wire([x, -1.3], along, width * PIXEL, depths, material);
        light += (along[0] * along[0] + along[1] * along[1]).sqrt() * width / PIXEL;
    }
    (text, light)
}

#[test]
fn wires_are_in_the_adaptive_picture() {
    for (width, most) in WIDTHS.into_iter().zip(MOST) {
        let (text, light) = fan(width, -1.0, "white");
        check(&format!("wires of {width}"), &scene(&text), 0, light, most);
    }
}

#[test]
fn level_wires_are_in_the_adaptive_picture() {
    for (width, most) in WIDTHS.into_iter().zip(MOST) {
        let mut text = String::new();
        let mut light = 0.0;
        for k in 0..12 {
            let y = -1.3 + 0.212 * f64::from(k);
            text += &wire([-1.9, y], [3.8, 0.05], width * PIXEL, 0.0, "white");
            light += (3.8_f64 * 3.8 + 0.05 * 0.05).sqrt() * width / PIXEL;
        }
        check(&format!("level wires of {width}"), &scene(&text), 0, light, most);
    }
}

/// Wires between a wall at z = -2 and a lamp that is so far that all of the wall is equally bright:
/// each is its shadow, moved towards the lamp until the eye does not see it. The text and the area
/// of the shadows in pixels.
fn shading_fan(width: f64) -> (String, f64) {
    let (mut text, mut area) = (String::new(), 0.0);
    for k in 0..12 {
        let (x, along) = (-1.8 + 0.2 * f64::from(k), [0.01 * f64::from(k * k), 2.6]);
        text += "quadrangle ";
        for [x, y] in wire_corners([x, -1.3], along, width * PIXEL) {
            let on_wall = DVec3::new(1.4 * x, 1.4 * y, -2.0);
            let DVec3 { x, y, z } = on_wall + 0.005 * (LAMP - on_wall);
            write!(text, "vertex {x} {y} {z} ").unwrap();
        }
        text += "material red endquadrangle\n";
        area += (along[0] * along[0] + along[1] * along[1]).sqrt() * width / PIXEL;
    }
    (text, area)
}

const LAMP: DVec3 = DVec3::new(2000.0, 300.0, 1000.0);

/// The default error, and what at least a thin thing has to change a pixel by to be looked for.
const ERROR: f64 = 1.0 / 255.0;

#[test]
fn shadows_of_wires_are_in_the_adaptive_picture() {
    let mut worst = 0.0_f64;
    for brightness in [1.0, 0.88, 0.75, 0.5, 0.35] {
        let lit = |geometry: &str| {
            let distance = LAMP.length();
            let power = brightness * 100.0 * distance / (LAMP.z + 2.0);
            let lights = format!(
                "reference power 100 distance {distance} endreference
                point coords {} {} {} power {power} endpoint",
                LAMP.x, LAMP.y, LAMP.z
            );
            scene_with(&lights, geometry)
        };
        for width in WIDTHS.into_iter().filter(|width| brightness * width > ERROR) {
            let (text, area) = shading_fan(width);
            let (plain, scene) = (lit(WHITE_WALL), lit(&(text + WHITE_WALL)));
            let lack_with = |seed| {
                let light = |scene: &PreparedScene<PreparedBytes>, sampling| {
                    let tile = render_with(scene, sampling, whole(frame()), Isa::fastest(), seed);
                    tile.pixels.iter().map(|pixel| f64::from(pixel[0])).sum::<f64>()
                };
                let bright = light(&plain, Sampling::fixed(1).unwrap());
                1.0 - (bright - light(&scene, adaptive())) / (brightness * area)
            };
            let lacks = [1, 2, 3].map(lack_with);
            let lack = lacks.into_iter().sum::<f64>() / 3.0;
            eprintln!("shadows of {width} on a wall of {brightness}: {lacks:.3?} lacks");
            worst = worst.max(lack.abs());
        }
    }
    check_beyond("shadows of wires of 1/2 to 1/64 pixel are in the adaptive picture", worst);
}

/// Tells how much is lacking at most of thin things that no beam from the eye meets, and that it is
/// little.
fn check_beyond(what: &str, lack: f64) {
    HardCase::ThinBeyond.tell(what, format!("{:.1} % lacks at most", 100.0 * lack));
    assert!(lack < 0.05, "{what}: {lack}");
}

/// The most that is lacking of wires of all widths that are seen at a depth and are at another.
fn most_lacking(
    what: &str,
    depths: (f64, f64),
    scene: impl Fn(&str) -> PreparedScene<PreparedBytes>,
) -> f64 {
    let mut worst = 0.0_f64;
    for (material, brightness) in [("red", 1.0), ("dim", 128.0 / 255.0)] {
        for width in WIDTHS {
            let (text, light) = fan_at(width, depths, material);
            let ([adaptive, fixed], each) = lacking(&scene(&text), 0, brightness * light);
            eprintln!(
                "{what}, {material}, of {width}: lacks {adaptive:.3}, with 64 samples {fixed:.3}; \
                 {each:.1} samples"
            );
            worst = worst.max(adaptive.abs());
        }
    }
    worst
}

/// A square at z that the eye sees, or what is at z = -2 looks at.
fn square(z: f64, material: &str) -> String {
    format!(
        "quadrangle vertex -40 -40 {z} vertex 40 -40 {z} vertex 40 40 {z} vertex -40 40 {z}
        material {material} endquadrangle\n"
    )
}

#[test]
fn wires_in_a_mirror_are_in_the_adaptive_picture() {
    // The eye has them behind it.
    let depths = (-16.0, 12.0);
    let mirror = square(-2.0, "mirror");
    let plain = most_lacking("wires in a mirror", depths, |wires| scene(&(mirror.clone() + wires)));
    let wall = mirror.clone() + &square(13.0, "blue");
    let lines =
        most_lacking("lines in a mirror", depths, |wires| lit_scene(&(wall.clone() + wires)));
    // Seen in a mirror through a pane.
    let pane = mirror + &square(1.0, "pane");
    let both = most_lacking("wires behind both", depths, |wires| scene(&(pane.clone() + wires)));
    check_beyond(
        "wires of 1/2 to 1/64 pixel in a mirror are in the adaptive picture",
        plain.max(lines).max(both),
    );
}

#[test]
fn wires_behind_panes_are_in_the_adaptive_picture() {
    let mut worst = 0.0_f64;
    for panes in [square(1.0, "pane"), square(1.0, "pane") + &square(0.5, "pane")] {
        let wall = panes.clone() + &square(-2.0, "blue");
        let depths = (-1.0, -1.0);
        worst = worst
            .max(most_lacking("wires", depths, |wires| scene(&(panes.clone() + wires))))
            .max(most_lacking("lines", depths, |wires| lit_scene(&(wall.clone() + wires))));
    }
    check_beyond("wires of 1/2 to 1/64 pixel behind panes are in the adaptive picture", worst);
}

const WHITE_WALL: &str =
    "quadrangle vertex -9 -9 -2 vertex 9 -9 -2 vertex 9 9 -2 vertex -9 9 -2 material white
    endquadrangle ";

const WALL: &str =
    "quadrangle vertex -9 -9 -2 vertex 9 -9 -2 vertex 9 9 -2 vertex -9 9 -2 material blue
    endquadrangle ";

#[test]
fn lines_on_a_wall_are_in_the_adaptive_picture() {
    for z in [-1.999_99, 1.0] {
        for (width, most) in WIDTHS.into_iter().zip(MOST) {
            let (text, light) = fan(width, z, "red");
            let what = format!("lines of {width} at {z} before a wall at -2");
            check(&what, &lit_scene(&(text + WALL)), 0, light, most);
        }
    }
}

/// Slits in a fan between blue covers at z = -1, and the red wall behind: the text and the light.
fn slits(width: f64) -> (String, f64) {
    // Left and right ends of each slit, below and above, and beyond the frame on both sides.
    let mut sides = vec![[-9.0, -9.0]];
    let mut light = 0.0;
    for k in 0..12 {
        let (x, dx) = (-1.8 + 0.2 * f64::from(k), 0.01 * f64::from(k * k));
        // As wide across as a wire is.
        let half = width * PIXEL / 2.0 * (dx * dx + 2.6 * 2.6).sqrt() / 2.6;
        let [below, above] = [x - 0.2 * dx / 2.6, x + dx + 0.2 * dx / 2.6];
        sides.extend([[below - half, above - half], [below + half, above + half]]);
        // The frame is 3 high.
        light += 3.0 * 2.0 * half / (PIXEL * PIXEL);
    }
    sides.push([9.0, 9.0]);
    let mut text = square(-2.0, "red");
    for pair in sides.chunks_exact(2) {
        let [[a, b], [c, d]] = [pair[0], pair[1]];
        text += "quadrangle ";
        for (x, y) in [(a, -1.5), (c, -1.5), (d, 1.5), (b, 1.5)] {
            write!(text, "vertex {} {} -1 ", x * 1.2, y * 1.2).unwrap();
        }
        text += "material blue endquadrangle\n";
    }
    (text, light)
}

#[test]
fn light_through_slits_is_in_the_adaptive_picture_and_its_error_is_told() {
    for width in WIDTHS {
        let (text, light) = slits(width);
        let scene = lit_scene(&text);
        check(&format!("slits of {width}"), &scene, 0, light, 0.05);
        let [tile, truth] = [adaptive(), Sampling::fixed(2048).unwrap()]
            .map(|sampling| render(&scene, sampling, whole(frame()), Isa::fastest()));
        let pairs = tile.pixels.as_flattened().iter().zip(truth.pixels.as_flattened());
        let squares: f64 = pairs.map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2)).sum();
        let error = (squares / (3.0 * frame().pixel_count() as f64)).sqrt();
        let told = tile.tally.error().unwrap() / error;
        eprintln!("slits of {width}: {:.2}/255 off, told over true {told:.2}", 255.0 * error);
        assert!((0.5..=2.0).contains(&told), "{width}: {told}");
    }
}

#[test]
fn wires_before_a_fine_mesh_are_in_the_adaptive_picture() {
    // Ten rows of facets in each pixel.
    let mut mesh = String::new();
    for j in 0..200 {
        for i in 0..200 {
            let at = |i: i32, j: i32| {
                let (x, y) = (0.006 * f64::from(i) - 0.6, 0.006 * f64::from(j) - 0.6);
                format!("vertex {x} {y} {} ", -0.2 * (x * x + y * y) - 0.3)
            };
            let [a, b, c, d] = [at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)];
            write!(mesh, "triangle {a}{b}{c} material blue endtriangle ").unwrap();
            writeln!(mesh, "triangle {a}{c}{d} material blue endtriangle").unwrap();
        }
    }
    let inside = Area::new(frame(), [38, 26], [20, 20]).unwrap();
    let samples = render(&lit_scene(&mesh), adaptive(), inside, Isa::fastest()).tally.samples;
    eprintln!("the mesh alone: {samples} samples in {} pixels", 22 * 22);
    assert!(samples < 9 * 22 * 22, "a smooth mesh hides nothing");
    for (width, most) in WIDTHS.into_iter().zip(MOST).skip(2) {
        let (text, light) = fan(width, 1.0, "red");
        let what = format!("wires of {width} before a mesh");
        check(&what, &scene(&(text + &mesh)), 0, light, most);
    }
}

#[test]
fn small_squares_and_spheres_are_in_the_adaptive_picture() {
    for (size, most) in [(0.5, 0.02), (0.25, 0.03), (0.1, 0.05)] {
        let (mut squares, mut spheres) = (String::new(), String::new());
        for k in 0..600 {
            let (x, y) = (-1.85 + 0.1493 * f64::from(k % 25), -1.4 + 0.1179 * f64::from(k / 25));
            let side = size * PIXEL;
            squares += &wire([x, y], [side, 0.0], side, -3.0, "white");
            // As large; aside they are seen a little larger.
            let radius = side * (1.0 / std::f64::consts::PI).sqrt();
            writeln!(spheres, "sphere coords {x} {y} 0 radius {radius} material white endsphere")
                .unwrap();
        }
        let light = 600.0 * size * size;
        check(&format!("squares of {size}"), &scene(&squares), 0, light, most);
        check(
            &format!("spheres as large as squares of {size}"),
            &scene(&spheres),
            0,
            light,
            most.max(0.05),
        );
    }
}

/// Bars, as they are and as solids; what they show of their sides only samples tell.
#[test]
fn bars_are_in_the_adaptive_picture() {
    for width in [1.0 / 16.0, 1.0 / 32.0] {
        let (mut bars, mut solids) = (String::new(), String::new());
        for k in 0..12 {
            let (x, w) = (-1.8 + 0.32 * f64::from(k), width * PIXEL);
            let bar = format!(
                "parallelepiped vertex {x} -1.3 0 vertex {} -1.3 0 vertex {} 1.3 0
                 vertex {x} -1.3 {} material white endparallelepiped\n",
                x + w,
                x + 0.1,
                -w
            );
            let ball = "sphere coords 0 9 0 radius 1 material red endsphere";
            bars += &bar;
            writeln!(solids, "difference {bar} {ball} enddifference").unwrap();
        }
        let plain = scene(&bars);
        let truth = render(&plain, Sampling::fixed(1024).unwrap(), whole(frame()), Isa::fastest());
        let light = truth.pixels.iter().map(|pixel| f64::from(pixel[0])).sum();
        check(&format!("bars of {width}"), &plain, 0, light, 0.05);
        check(&format!("solid bars of {width}"), &scene(&solids), 0, light, 0.05);
    }
}

/// Wires of so many facets that no pixel can look at them one by one.
#[test]
fn wires_of_many_facets_are_in_the_adaptive_picture() {
    for (width, most) in WIDTHS.into_iter().zip(MOST).skip(2).take(3) {
        let mut text = String::new();
        for k in 0..8 {
            let x = -1.7 + 0.43 * f64::from(k);
            for j in 0..8000 {
                let (x, y) = (x + 0.000_015 * f64::from(j), -1.0 + 0.000_25 * f64::from(j));
                text += &wire([x, y], [0.000_015, 0.000_25], width * PIXEL, 0.0, "white");
            }
        }
        let light = 8.0 * 2.0 * (1.0_f64 + 0.06 * 0.06).sqrt() * width / PIXEL;
        let what = format!("wires of {width} in many facets");
        check(&what, &scene(&text), 0, light, 2.0 * most);
    }
}

/// What the eye has behind it, or beside it up to behind it, hides nowhere but where it is seen.
#[test]
fn wires_that_pass_the_eye_are_in_the_adaptive_picture() {
    let mut text = String::new();
    for k in 0..10 {
        // From the distance to behind the eye, below it.
        let (x, w) = (-0.9 + 0.2 * f64::from(k), 0.002);
        writeln!(
            text,
            "quadrangle vertex {x} -0.4 -9 vertex {} -0.4 -9 vertex {} -0.4 9 vertex {x} -0.4 9
             material white endquadrangle
             quadrangle vertex {x} 0.4 6 vertex {} 0.4 6 vertex {} 0.4 9 vertex {x} 0.4 9
             material red endquadrangle",
            x + w,
            x + w,
            x + w,
            x + w
        )
        .unwrap();
    }
    let scene = scene(&text);
    let truth = render(&scene, Sampling::fixed(1024).unwrap(), whole(frame()), Isa::fastest());
    let light = truth.pixels.iter().map(|pixel| f64::from(pixel[1])).sum();
    check("wires past the eye", &scene, 1, light, 0.02);
}

#[test]
fn pixels_are_the_same_whatever_the_tile_and_the_instructions() {
    let (fan, _) = fan(1.0 / 16.0, 1.0, "red");
    let ball = "sphere coords 0.5 0.2 0 radius 0.4 material grey endsphere
        difference sphere coords -0.7 0.2 0 radius 0.4 material white endsphere
            sphere coords -0.7 0.4 0.3 radius 0.3 material grey endsphere enddifference\n";
    let scene = scene(&(fan + ball + WALL));
    let together = render(&scene, adaptive(), whole(frame()), Isa::Scalar).pixels;
    for side in [5, 16, 33] {
        for y0 in (0..72).step_by(side) {
            for x0 in (0..96).step_by(side) {
                let side = side as u32;
                let (width, height) = (side.min(96 - x0), side.min(72 - y0));
                let area = Area::new(frame(), [x0, y0], [width, height]).unwrap();
                let tile = render(&scene, adaptive(), area, Isa::fastest()).pixels;
                for (k, pixel) in (0..).zip(tile) {
                    let (x, y) = (x0 + k % width, y0 + k / width);
                    assert_eq!(pixel, together[(y * 96 + x) as usize], "({x}, {y}) by {side}");
                }
            }
        }
    }
}
