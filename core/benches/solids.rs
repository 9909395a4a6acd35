//! Solids of many leaves: what a ray costs that meets one, as its leaves grow.
//!
//!     cargo bench -p rtfarm-core --bench solids [-- die | sponge SIDE]
//!
//! Prints nanoseconds a ray, medians of nine runs on one thread: through a die with 21 pips and
//! four holes, 27 leaves, and through sponges, cubes less SIDE^3 balls that touch. `die` and
//! `sponge` print the scene instead, for whole commands.

#![expect(clippy::print_stdout, reason = "a benchmark prints its figures")]
#![expect(clippy::disallowed_methods, reason = "a benchmark reads the clock")]

use std::{env, fmt::Write, hint::black_box, io, time::Instant};

use glam::DVec3;
use rtfarm_core::{
    isa::Isa,
    language::read_scene,
    prepare::prepare,
    prepared::PreparedScene,
    testing::{Probe, Probing},
};
use rtfarm_oracle::random::Random;

/// The sides of the sponges: 9, 126 and 1 001 leaves.
const SIDES: [u32; 3] = [2, 5, 10];
const RAYS: usize = 40_000;
const RUNS: usize = 9;

fn main() {
    let words: Vec<String> = env::args().skip(1).filter(|word| word != "--bench").collect();
    match &words[..] {
        [word] if word == "die" => print!("{}", die()),
        [word, side] if word == "sponge" => print!("{}", sponge(side.parse().expect("a number"))),
        _ => measure(),
    }
}

fn measure() {
    println!("die of 27 leaves: {:.0} ns a ray", nanoseconds(&die()));
    for side in SIDES {
        let leaves = side.pow(3) + 1;
        let time = nanoseconds(&sponge(side));
        let a_doubling = time / f64::from(leaves).log2();
        println!("sponge of {leaves} leaves: {time:.0} ns a ray, {a_doubling:.0} a doubling");
    }
}

/// The median time that a ray takes from somewhere around the solid to a place in it.
fn nanoseconds(text: &str) -> f64 {
    let no_files = &|_: &str| Err(io::ErrorKind::NotFound.into());
    let scene = read_scene(text.as_bytes(), no_files).scene.expect("a scene");
    let scene = PreparedScene::open(prepare(&scene).expect("a plain scene")).expect("valid");
    let random = &mut Random::new(3);
    let probes: Vec<Probe> = (0..RAYS)
        .map(|_| {
            let origin = 4.0 * random.direction();
            let direction = (random.in_cube() - origin).normalize();
            Probe { origin, direction, leaving: None }
        })
        .collect();
    let mut times = [0.0; RUNS];
    for time in &mut times {
        let start = Instant::now();
        black_box(scene.probe(&probes, Isa::fastest()));
        *time = start.elapsed().as_secs_f64() * 1e9 / RAYS as f64;
    }
    times.sort_by(f64::total_cmp);
    times[RUNS / 2]
}

/// A scene of one solid around the origin, within -1..1.
fn scene_of(solid: &str) -> String {
    format!(
        "viewport origin 1.4 1.3 4.2 topleft -0.75 0.95 1 bottomleft -0.75 -0.75 1\n\
         topright 0.95 0.95 1 size 640 640 background 180 200 220 endviewport\n\
         materials entry name ivory color 240 232 210 endentry\n\
         entry name ink color 40 40 50 endentry endmaterials\n\
         lights ambient 0.25 reference power 100 distance 5 endreference\n\
         point coords -2 6 5 power 120 endpoint endlights\n\
         geometry quadrangle vertex -8 -1 8 vertex 8 -1 8 vertex 8 -1 -8 vertex -8 -1 -8\n\
         material ivory endquadrangle\n{solid}endgeometry\n"
    )
}

/// A parallelepiped along the axes.
fn cuboid(low: DVec3, high: DVec3, material: &str) -> String {
    let mut text = String::from("parallelepiped");
    for corner in [low, low.with_x(high.x), low.with_y(high.y), low.with_z(high.z)] {
        write!(text, " vertex {} {} {}", corner.x, corner.y, corner.z).expect("a string");
    }
    writeln!(text, " material {material} endparallelepiped").expect("a string");
    text
}

fn ball(center: DVec3, radius: f64, material: &str) -> String {
    let DVec3 { x, y, z } = center;
    format!("sphere coords {x} {y} {z} radius {radius} material {material} endsphere\n")
}

/// A box within a ball, less 21 pips and four bars through it: 27 leaves.
fn die() -> String {
    let mut solid = String::from("difference intersection\n");
    solid += &cuboid(DVec3::splat(-0.8), DVec3::splat(0.8), "ivory");
    solid += &ball(DVec3::ZERO, 1.15, "ivory");
    solid += "endintersection\n";
    let places: [&[(f64, f64)]; 6] = [
        &[(0.0, 0.0)],
        &[(-0.4, -0.4), (0.4, 0.4)],
        &[(-0.4, 0.4), (0.0, 0.0), (0.4, -0.4)],
        &[(-0.4, -0.4), (-0.4, 0.4), (0.4, -0.4), (0.4, 0.4)],
        &[(-0.4, -0.4), (-0.4, 0.4), (0.0, 0.0), (0.4, -0.4), (0.4, 0.4)],
        &[(-0.4, -0.4), (-0.4, 0.0), (-0.4, 0.4), (0.4, -0.4), (0.4, 0.0), (0.4, 0.4)],
    ];
    for (face, places) in places.iter().enumerate() {
        for &(u, v) in *places {
            let side = if face < 3 { 0.8 } else { -0.8 };
            let mut center = [side; 3];
            (center[(face + 1) % 3], center[(face + 2) % 3]) = (u, v);
            solid += &ball(DVec3::from_array(center), 0.14, "ink");
        }
    }
    for (y, z) in [(-0.6, -0.6), (-0.6, 0.6), (0.6, -0.6), (0.6, 0.6)] {
        let (low, high) =
            (DVec3::new(-1.0, y - 0.06, z - 0.06), DVec3::new(1.0, y + 0.06, z + 0.06));
        solid += &cuboid(low, high, "ink");
    }
    scene_of(&(solid + "enddifference\n"))
}

/// A cube less `side`^3 balls that touch, the outer ones cut open.
fn sponge(side: u32) -> String {
    let mut solid = String::from("difference\n");
    solid += &cuboid(DVec3::splat(-0.8), DVec3::splat(0.8), "ivory");
    let step = 1.7 / f64::from(side);
    for k in 0..side.pow(3) {
        let cell = [k % side, k / side % side, k / side / side].map(f64::from);
        let center = (DVec3::from_array(cell) + 0.5) * step - 0.85;
        solid += &ball(center, 0.52 * step, "ink");
    }
    scene_of(&(solid + "enddifference\n"))
}
