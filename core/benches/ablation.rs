//! What each feature costs where it is present, and that it costs next to nothing where it is not:
//! one scene, plain and with one feature more each time, and the plain one in builds that leave one
//! feature's code out. Instructions are counted by callgrind, which other work on the machine does
//! not touch. Prints a table in Markdown.
//!
//!     cargo bench -p rtfarm-core --bench ablation
//!     cargo bench -p rtfarm-core --bench ablation -- texture "secondary light"
//!
//! The second measures these alone: each takes a build of the tracer.

#![expect(clippy::print_stdout, reason = "a benchmark prints its figures")]
#![expect(clippy::disallowed_methods, reason = "a benchmark reads the clock")]

use std::{
    env, fs,
    io::Cursor,
    ops::ControlFlow,
    path::{Path, PathBuf},
    process::{Command, Stdio},
    time::Instant,
};

use rtfarm_core::{
    isa::Isa,
    language::read_scene,
    prepare::prepare,
    prepared::{PreparedBytes, PreparedScene},
    render::{Quality, Sampling, render_tile},
    testing::{self, BUILT_WITHOUT},
    tile::{Area, Size},
};

/// Runs whose medians are told.
const RUNS: usize = 9;

/// A feature and what it changes in the plain scene's text.
const FEATURES: [(&str, &str, &str); 8] = [
    ("plain", "", ""),
    ("ambient", "endlights", "ambient 0.2 endlights"),
    ("mirror", "name ball", "name ball reflect 0.3"),
    ("secondary light", "name ball", "name ball reflect 0.3"),
    ("transparency", "name ball", "name ball alpha 0.5"),
    ("refraction", "name ball", "name ball alpha 0.3 refract 0.7"),
    ("texture", "name floor", "name floor texture t.png"),
    (
        "solid",
        "endgeometry",
        "difference sphere coords 0 0.5 1 radius 0.6 material ball endsphere
         sphere coords 0 0.8 1.3 radius 0.5 material ball endsphere enddifference endgeometry",
    ),
];

fn text(from: &str, to: &str) -> String {
    let mut text = "viewport origin 0 2 7 topleft -2 3 3 bottomleft -2 0.8 3 topright 2 3 3
        endviewport
        materials entry name floor color 200 200 200 endentry entry name ball color 200 90 50
        endentry endmaterials
        lights reference power 1 distance 6 endreference
        point coords 3 6 4 power 1 endpoint point coords -4 5 2 power 0.6 endpoint endlights
        geometry quadrangle vertex -9 0 -9 vertex -9 0 9 vertex 9 0 9 vertex 9 0 -9 material floor
        endquadrangle "
        .to_owned();
    for k in 0..64 {
        let (x, z) = (f64::from(k % 8) - 3.5, f64::from(k / 8) - 5.0);
        text.extend(["sphere coords ", &x.to_string(), " 0.4 ", &z.to_string()]);
        text += " radius 0.4 material ball endsphere ";
    }
    text += "endgeometry";
    if from.is_empty() { text } else { text.replacen(from, to, 1) }
}

/// A checkerboard of 64 x 64.
fn checkerboard() -> Vec<u8> {
    let image = image::RgbImage::from_fn(64, 64, |x, y| {
        image::Rgb([if (x / 8 + y / 8) % 2 == 0 { 255 } else { 80 }; 3])
    });
    let mut file = Cursor::new(Vec::new());
    image.write_to(&mut file, image::ImageFormat::Png).expect("memory");
    file.into_inner()
}

fn scene(feature: usize) -> PreparedScene<PreparedBytes> {
    let (_, from, to) = FEATURES[feature];
    let reading = read_scene(text(from, to).as_bytes(), &|_: &str| Ok(checkerboard()));
    let scene = reading.scene.expect("a scene without a fault");
    PreparedScene::open(prepare(&scene).expect("a plain scene")).expect("valid")
}

/// Renders the picture; how many rays that took.
fn render(scene: &PreparedScene<PreparedBytes>, feature: usize) -> u64 {
    let size = Size::new(160, 90).expect("a size");
    // Else what mirrors sends light on, too.
    let secondary = FEATURES[feature].0 != "mirror";
    let quality =
        Quality { sampling: Sampling::fixed(8).unwrap(), secondary, ..Quality::default() };
    let go_on = &mut || ControlFlow::Continue(());
    render_tile(scene, &quality, Area::whole(size), Isa::fastest(), go_on)
        .expect("not stopped")
        .tally
        .rays
}

/// A program and the scene that it renders, and what that takes.
struct Case {
    program: PathBuf,
    feature: usize,
    /// Of one picture; `None` without valgrind.
    instructions: Option<f64>,
    seconds: Vec<f64>,
    /// The most memory that the program held, in bytes.
    peaks: Vec<f64>,
    rays: f64,
    /// Of the prepared scene.
    bytes: f64,
}

impl Case {
    fn new(program: &Path, feature: usize) -> Self {
        let (seconds, peaks) = (Vec::new(), Vec::new());
        let program = program.to_owned();
        Self { program, feature, instructions: None, seconds, peaks, rays: 0.0, bytes: 0.0 }
    }

    fn count(&mut self) {
        // The second picture alone: not reading, not preparing.
        let counts = self.count_of(2).zip(self.count_of(1));
        self.instructions = counts.map(|(two, one)| (two - one) as f64);
    }

    fn count_of(&self, times: u32) -> Option<u64> {
        let output = Command::new("valgrind")
            .args(["--tool=callgrind", "--callgrind-out-file=/dev/null"])
            .arg(&self.program)
            .args(["--only", &self.feature.to_string(), &times.to_string()])
            .output()
            .ok()?;
        let told = String::from_utf8(output.stderr).ok()?;
        let (_, count) = told.split_once("Collected : ")?;
        count.split_whitespace().next()?.parse().ok()
    }

    fn run(&mut self) {
        let output = Command::new(&self.program)
            .args(["--only", &self.feature.to_string(), "2"])
            .stderr(Stdio::inherit())
            .output()
            .expect("a program of this very source");
        let told = String::from_utf8(output.stdout).expect("numbers");
        let numbers: Vec<f64> = told.split_whitespace().map(|x| x.parse().unwrap()).collect();
        let [seconds, peak, rays, bytes] = numbers.try_into().expect("four numbers");
        self.seconds.push(seconds);
        self.peaks.push(peak);
        (self.rays, self.bytes) = (rays, bytes);
    }

    fn cells(&self) -> String {
        let count = self.instructions.map_or("?".to_owned(), |x| format!("{:.1}", x / 1e6));
        let (time, peak) = (median(&self.seconds) * 1e3, median(&self.peaks) / 1e6);
        format!("{count} | {time:.1} | {peak:.2}")
    }
}

fn median(numbers: &[f64]) -> f64 {
    let mut sorted = numbers.to_vec();
    sorted.sort_by(f64::total_cmp);
    sorted[sorted.len() / 2]
}

/// What a [`Case`]'s program does: renders so often, and tells of the last picture.
fn run_one(feature: usize, times: u32) {
    let scene = scene(feature);
    let (mut seconds, mut rays) = (0.0, 0);
    for _ in 0..times {
        let start = Instant::now();
        rays = render(&scene, feature);
        seconds = start.elapsed().as_secs_f64();
    }
    let status = fs::read_to_string("/proc/self/status").unwrap_or_default();
    let peak = status.lines().find_map(|line| line.strip_prefix("VmHWM:"));
    let kib = peak.and_then(|line| line.split_whitespace().next()?.parse::<f64>().ok());
    println!("{seconds} {} {rays} {}", kib.unwrap_or(f64::NAN) * 1024.0, scene.byte_count());
}

/// Builds this program without a feature's code, in a folder of its own, so that no other build is
/// disturbed.
fn build_without(feature: &str) -> PathBuf {
    assert!(testing::FEATURES.contains(&feature), "{feature} cannot be left out");
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("ablation");
    let output = Command::new(env!("CARGO"))
        .args(["bench", "-p", "rtfarm-core", "--bench", "ablation", "--no-run"])
        .args(["--message-format", "json", "--target-dir"])
        .arg(&folder)
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .env("RTFARM_BUILD_WITHOUT", feature)
        .stderr(Stdio::inherit())
        .output()
        .expect("cargo");
    let told = String::from_utf8(output.stdout).expect("JSON");
    let built = told.lines().rev().find_map(|line| {
        let (_, path) = line.split_once(r#""executable":""#)?;
        Some(path.split_once('"')?.0.to_owned())
    });
    let kept = folder.join(format!("without {feature}"));
    fs::copy(built.expect("cargo builds it"), &kept).expect("room on the disk");
    kept
}

fn main() {
    let words: Vec<String> = env::args().collect();
    if let Some(at) = words.iter().position(|word| word == "--only") {
        let [feature, times] = [1, 2].map(|k| words[at + k].parse().expect("a number"));
        return run_one(feature as usize, times);
    }
    assert!(BUILT_WITHOUT.is_none(), "this build is to have all features");
    let wanted = |name: &str| words[1..].iter().any(|word| word == name);
    let all = !FEATURES.iter().any(|(name, ..)| wanted(name));
    let chosen: Vec<usize> =
        (1..FEATURES.len()).filter(|&k| all || wanted(FEATURES[k].0)).collect();
    let mut without: Vec<_> =
        chosen.iter().map(|&k| Case::new(&build_without(FEATURES[k].0), 0)).collect();
    let whole = env::current_exe().expect("a path");
    let mut present: Vec<_> = [0].into_iter().chain(chosen).map(|k| Case::new(&whole, k)).collect();
    present.iter_mut().chain(&mut without).for_each(Case::count);
    // In turns, so that the machine's moods strike all alike.
    for _ in 0..RUNS {
        present.iter_mut().chain(&mut without).for_each(Case::run);
    }

    let (plain, present) = present.split_first().expect("the plain scene");
    if plain.instructions.is_none() {
        println!("No valgrind: instructions are not counted.\n");
    }
    println!(
        "One picture of {:.2} M rays without features, one thread, medians of {RUNS} runs in turns; \
         MB are the most that the process held, kB the prepared scene.\n",
        plain.rays / 1e6
    );
    println!(
        "| feature | present: M instructions | ms | MB | a ray | kB | absent: M instructions | ms | \
         MB | kB | without its code: M instructions | ms | MB | absent costs |"
    );
    println!("|---|{}", "---:|".repeat(13));
    for (present, without) in present.iter().zip(&without) {
        let a_ray = present.instructions.map_or(f64::NAN, |count| count / present.rays);
        let counts = plain.instructions.zip(without.instructions);
        let cost = counts.map_or(f64::NAN, |(absent, without)| 100.0 * (absent / without - 1.0));
        println!(
            "| {} | {} | {a_ray:.0} | {:.1} | {} | {:.1} | {} | {cost:+.2} % |",
            FEATURES[present.feature].0,
            present.cells(),
            present.bytes / 1e3,
            plain.cells(),
            plain.bytes / 1e3,
            without.cells(),
        );
    }
}
