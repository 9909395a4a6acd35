//! Rays through a mesh, class by class: how many a second, or how many instructions each takes.
//!
//!     cargo bench -p rtfarm-core --bench rays [-- TRIANGLES [single] [compact]]
//!     cargo bench -p rtfarm-core --bench rays -- --check | --update
//!
//! The first prints millions of rays a second for each instruction set: medians of five runs on one
//! thread; with corners in single precision, or of the scene in its compact form. `--check` counts
//! instructions by callgrind with AVX2 and fails where a ray takes over 3 % more than `rays.tsv`
//! says; `--update` writes that file anew. Both say so and do nothing else where valgrind or AVX2
//! is missing.

#![expect(clippy::print_stdout, reason = "a benchmark prints its figures")]
#![expect(clippy::disallowed_methods, reason = "a benchmark reads the clock and makes a bottle")]

mod bottle;

use std::{
    env, fmt::Write, fs, hint::black_box, ops::ControlFlow, path::Path, process::Command,
    time::Instant,
};

use bottle::bottle;
use glam::DVec3;
use rtfarm_core::{
    isa::Isa,
    prepare::{Form, prepare_as},
    prepared::{PreparedBytes, PreparedScene},
    render::{Quality, Sampling, render_tile},
    scene::Scene,
    testing::{Probe, Probing},
    tile::{Size, TileGrid},
};
use rtfarm_oracle::random::Random;

/// The classes of rays: camera rays, rays from what these met towards one point and everywhere, and
/// whole samples of pictures without and with light.
const CLASSES: [&str; 5] = ["camera", "to one point", "everywhere", "flat samples", "lit samples"];

/// A ray may take so many instructions more than the file says, in percent.
const TOLERANCE: f64 = 3.0;

/// A class is counted so many times in one go: preparing the scene, whose hashes begin at random, takes
/// half a million instructions more now and then.
const ROUNDS: u32 = 8;

/// The triangles of the scene that is counted.
const COUNTED: usize = 20_000;

struct Bench {
    scene: PreparedScene<PreparedBytes>,
    probes: [Vec<Probe>; 3],
    size: Size,
}

impl Bench {
    fn new(scene: &Scene, form: Form, [width, height]: [u32; 2]) -> Self {
        let viewport = scene.viewport.expect("the bottle has one");
        let bytes = prepare_as(scene, form).expect("a plain scene");
        let scene = PreparedScene::open(bytes).expect("valid");
        let [right, down] =
            [viewport.top_right, viewport.bottom_left].map(|corner| corner - viewport.top_left);
        let mut camera = Vec::new();
        for block in 0..(width / 8) * (height / 8) {
            let corner = [block % (width / 8) * 8, block / (width / 8) * 8];
            for k in 0..64 {
                let u = (f64::from(corner[0] + k % 8) + 0.5) / f64::from(width);
                let v = (f64::from(corner[1] + k / 8) + 0.5) / f64::from(height);
                let target = viewport.top_left + u * right + v * down;
                let direction = (target - viewport.eye).normalize();
                camera.push(Probe { origin: viewport.eye, direction, leaving: None });
            }
        }
        let random = &mut Random::new(1);
        let light = DVec3::new(7.0, 9.0, 7.0);
        let (mut to_light, mut everywhere) = (Vec::new(), Vec::new());
        let hits = scene.probe(&camera, Isa::fastest());
        for (probe, hit) in camera.iter().zip(hits) {
            let Some(hit) = hit else { continue };
            // Nearly there: the face is met once more, or is passed by.
            let origin = probe.origin + (hit.t * (1.0 - 1e-9)) * probe.direction;
            let direction = (light - origin).normalize();
            to_light.push(Probe { origin, direction, leaving: None });
            let direction = random.direction();
            everywhere.push(Probe { origin, direction, leaving: None });
        }
        let size = Size::new(u64::from(width), u64::from(height)).expect("a size");
        Self { scene, probes: [camera, to_light, everywhere], size }
    }

    /// Traces the rays of a class; how many they are.
    fn run(&self, class: usize, isa: Isa) -> u64 {
        if let Some(probes) = self.probes.get(class) {
            black_box(self.scene.probe(probes, isa));
            return probes.len() as u64;
        }
        let flat = CLASSES[class] == "flat samples";
        let quality = Quality { sampling: Sampling::fixed(1).unwrap(), flat, ..Quality::default() };
        let grid = TileGrid::balanced(self.size);
        let mut rays = 0;
        for tile in grid.render_order() {
            let go_on = &mut || ControlFlow::Continue(());
            let tile = render_tile(&self.scene, &quality, grid.area(tile), isa, go_on);
            rays += tile.expect("not stopped").tally.rays;
        }
        rays
    }
}

fn main() {
    let words: Vec<String> = env::args().skip(1).collect();
    let has = |flag: &str| words.iter().any(|word| word == flag);
    if let [flag, class, times] = &words[..]
        && flag == "--only"
    {
        let [class, times] = [class, times].map(|word| word.parse().expect("a number"));
        let bench = Bench::new(&bottle(COUNTED), Form::Fast, [320, 184]);
        let rays: u64 = (0..times).map(|_| bench.run(class, Isa::Avx2)).sum();
        println!("{}", rays / times.max(1) as u64);
    } else if has("--check") || has("--update") {
        count_all(has("--update"));
    } else {
        let form = if has("compact") { Form::Compact } else { Form::Fast };
        let triangles = words.iter().find_map(|word| word.parse().ok()).unwrap_or(100_000);
        tell_speeds(triangles, has("single"), form);
    }
}

fn tell_speeds(triangles: usize, is_single: bool, form: Form) {
    let mut scene = bottle(triangles);
    if is_single {
        for corner in scene.triangles.iter_mut().flat_map(|face| &mut face.vertices) {
            *corner = corner.as_vec3().as_dvec3();
        }
    }
    let bench = Bench::new(&scene, form, [1280, 720]);
    let bytes = bench.scene.byte_count() as f64 / triangles as f64;
    println!("bottle of {triangles} triangles, {form:?}, {bytes:.1} bytes each");
    println!("Mrays/s on one thread, medians of 5");
    for (class, name) in CLASSES.iter().enumerate() {
        for isa in Isa::ALL.into_iter().filter(|isa| isa.is_supported()) {
            let mut speeds = [0.0; 5];
            for speed in &mut speeds {
                let start = Instant::now();
                let rays = bench.run(class, isa);
                *speed = rays as f64 / start.elapsed().as_secs_f64() / 1e6;
            }
            speeds.sort_by(f64::total_cmp);
            println!("{name}, {isa}: {:.2}", speeds[2]);
        }
    }
}

/// How many rays a class has and how many instructions a run takes; `None` without valgrind.
fn count(class: usize) -> Option<(f64, f64)> {
    let count = |times: u32| {
        let output = Command::new("valgrind")
            // Threads that wait while the scene is prepared count, and never the same.
            .env("RAYON_NUM_THREADS", "1")
            // So would clearing memory: what the system gives is clear, what is used again is not.
            .envs([("MALLOC_MMAP_MAX_", "0"), ("MALLOC_TRIM_THRESHOLD_", "17179869184")])
            .args(["--tool=callgrind", "--callgrind-out-file=/dev/null"])
            .arg(env::current_exe().expect("this program"))
            .args(["--only", &class.to_string(), &times.to_string()])
            .output()
            .ok()?;
        let told = String::from_utf8(output.stderr).ok()?;
        let (_, count) = told.split_once("Collected : ")?;
        let rays: f64 = String::from_utf8(output.stdout).ok()?.trim().parse().ok()?;
        Some((rays, count.split_whitespace().next()?.parse::<f64>().ok()?))
    };
    let ((_, once), (rays, often)) = (count(1)?, count(1 + ROUNDS)?);
    Some((rays, (often - once) / f64::from(ROUNDS)))
}

fn count_all(update: bool) {
    if !Isa::Avx2.is_supported() {
        println!("SKIPPED: this machine has no AVX2, which the figures are for");
        return;
    }
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("benches/rays.tsv");
    let known = fs::read_to_string(&path).unwrap_or_default();
    let known = |name: &str| {
        let line = known.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix('\t'));
        line.and_then(|figure| figure.parse::<f64>().ok())
    };
    let (mut figures, mut grown) = (String::new(), Vec::new());
    for (class, &name) in CLASSES.iter().enumerate() {
        let Some((rays, instructions)) = count(class) else {
            println!("SKIPPED: there is no valgrind to count instructions");
            return;
        };
        let a_ray = instructions / rays;
        let before = known(name).unwrap_or(f64::NAN);
        let change = 100.0 * (a_ray / before - 1.0);
        println!("{name}: {a_ray:.0} instructions a ray, {change:+.1} %");
        let _ = writeln!(figures, "{name}\t{a_ray:.0}");
        let is_within = change <= TOLERANCE;
        if !is_within {
            grown.push(name);
        }
    }
    if update {
        fs::write(&path, figures).expect("the folder of benchmarks can be written");
    } else {
        let how = "speed it up, or write rays.tsv anew with --update and say why";
        assert!(grown.is_empty(), "{grown:?} take over {TOLERANCE} % more instructions: {how}");
    }
}
