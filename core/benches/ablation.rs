//! What each feature costs where it is present, and that it costs nothing where it is not: one
//! scene, plain and with one feature more each time. Instructions are counted by callgrind, which
//! other work on the machine does not touch.
//!
//!     cargo bench -p rtfarm-core --bench ablation

#![expect(clippy::print_stdout, reason = "a benchmark prints its figures")]
#![expect(clippy::disallowed_methods, reason = "a benchmark reads the clock")]

use std::{io::Cursor, ops::ControlFlow, process::Command, time::Instant};

use rtfarm_core::{
    isa::Isa,
    prepare::prepare,
    prepared::{PreparedBytes, PreparedScene},
    read::read_scene,
    render::{Quality, Sampling, Settings, render_tile},
    tile::{Area, Size},
};

/// A feature and what it changes in the plain scene's text.
const FEATURES: [(&str, &str, &str); 8] = [
    ("plain", "", ""),
    ("ambient", "endlights", "ambient 0.2 endlights"),
    ("mirror, no secondary light", "name ball", "name ball reflect 0.3"),
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
    let secondary = FEATURES[feature].0 == "secondary light";
    let quality = Quality { sampling: Sampling::Fixed(8), secondary, ..Quality::default() };
    let area = Area { x0: 0, y0: 0, width: 160, height: 90 };
    let go_on = &mut || ControlFlow::Continue(());
    let settings = Settings { size, quality };
    render_tile(scene, &settings, area, Isa::fastest(), go_on).expect("not stopped").tally.rays
}

/// The instructions of a run of this very program that renders the picture so often.
fn instructions(feature: usize, times: u32) -> Option<u64> {
    let program = std::env::current_exe().ok()?;
    let output = Command::new("valgrind")
        .args(["--tool=callgrind", "--callgrind-out-file=/dev/null"])
        .arg(program)
        .args(["--only", &feature.to_string(), &times.to_string()])
        .output()
        .ok()?;
    let told = String::from_utf8(output.stderr).ok()?;
    let (_, count) = told.split_once("Collected : ")?;
    count.split_whitespace().next()?.parse().ok()
}

fn main() {
    let words: Vec<String> = std::env::args().collect();
    if let Some(at) = words.iter().position(|word| word == "--only") {
        let [feature, times] = [1, 2].map(|k| words[at + k].parse().expect("a number"));
        let scene = scene(feature);
        for _ in 0..times {
            render(&scene, feature);
        }
        return;
    }
    println!("| feature | ms | Mrays | instructions | a ray | prepared bytes |");
    println!("|---|---|---|---|---|---|");
    let scenes: Vec<_> = (0..FEATURES.len()).map(scene).collect();
    let mut seconds = vec![Vec::new(); FEATURES.len()];
    for _ in 0..9 {
        for (feature, seconds) in seconds.iter_mut().enumerate() {
            let start = Instant::now();
            render(&scenes[feature], feature);
            seconds.push(start.elapsed().as_secs_f64());
        }
    }
    for (feature, seconds) in seconds.iter_mut().enumerate() {
        seconds.sort_by(f64::total_cmp);
        let rays = render(&scenes[feature], feature) as f64;
        // The second picture alone: not reading, not preparing.
        let counts = instructions(feature, 2).zip(instructions(feature, 1));
        let (count, a_ray) = counts.map_or(("no valgrind".into(), String::new()), |(two, one)| {
            let count = (two - one) as f64;
            (format!("{:.1} M", count / 1e6), format!("{:.0}", count / rays))
        });
        println!(
            "| {} | {:.1} | {:.2} | {count} | {a_ray} | {} |",
            FEATURES[feature].0,
            seconds[4] * 1e3,
            rays / 1e6,
            scenes[feature].byte_count()
        );
    }
}
