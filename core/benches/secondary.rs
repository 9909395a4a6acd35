//! Light that faces send on: how much sooner a picture is as good when rays are aimed at emitters
//! than when all go over the whole hemisphere, by the same kernel; and how far off single pixels
//! are.
//!
//!     cargo bench -p rtfarm-core --bench secondary
//!
//! With a scene and a way it renders that once, for those who count instructions:
//!
//!     valgrind --tool=callgrind target/release/deps/secondary-* room aimed

#![expect(clippy::print_stdout, reason = "a benchmark prints its figures")]
#![expect(clippy::disallowed_methods, reason = "a benchmark reads the clock")]

use std::{env, fs, ops::ControlFlow, path::Path, time::Instant};

use rtfarm_core::{
    isa::Isa,
    language::read_scene,
    prepare::{Form, prepare},
    prepared::{PreparedBytes, PreparedScene},
    render::{Quality, RenderedTile, Sampling, Settings, render_tile},
    testing::prepare_with,
    tile::{Area, Size},
};

const ROUNDS: u64 = 9;
const SAMPLES: u32 = 16;
const REFERENCE_SAMPLES: u32 = 1024;

type Block = PreparedScene<PreparedBytes>;

fn main() {
    let arguments: Vec<String> = env::args().skip(1).collect();
    if let [name, way] = arguments.as_slice() {
        let ways = ways(name);
        let (_, scene) = ways.iter().find(|(known, _)| known == way).expect("`spread` or `aimed`");
        let picture = picture(scene, SAMPLES / 8, 0, true);
        println!("{name} {way}: {} rays", picture.tally.rays);
        return;
    }
    println!(
        "secondary light alone, {SAMPLES} samples a pixel, one thread, medians of {ROUNDS}, \
         truth by {REFERENCE_SAMPLES} samples; errors in steps of 8 bits"
    );
    for name in ["ball", "room", "bowl"] {
        measure(name);
    }
}

/// A scene, prepared in two ways.
fn ways(name: &str) -> [(&'static str, Block); 2] {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../scenes").join(name);
    let text = fs::read(path.with_extension("rt")).expect("the project's own scene");
    let nothing = |_: &str| Err(std::io::ErrorKind::NotFound.into());
    let scene = read_scene(&text, &nothing).scene.expect("a scene without a fault");
    let open = |bytes| PreparedScene::open(bytes).expect("a valid block");
    [
        ("spread", open(prepare_with(&scene, Form::Fast, false).expect("a scene"))),
        ("aimed", open(prepare(&scene).expect("a scene"))),
    ]
}

fn measure(name: &str) {
    let ways = ways(name);
    let truth = secondary_light(&ways[1].1, REFERENCE_SAMPLES, 1000).0;
    // In turns, so that the machine's moods strike both alike.
    let mut seconds = [Vec::new(), Vec::new()];
    let mut rays = [0, 0];
    let mut errors: [Vec<f64>; 2] = [Vec::new(), Vec::new()];
    for seed in 0..ROUNDS {
        for (k, (_, scene)) in ways.iter().enumerate() {
            let (found, time, count) = secondary_light(scene, SAMPLES, seed);
            seconds[k].push(time);
            rays[k] = count;
            errors[k].extend(found.iter().zip(&truth).map(|(found, truth)| found - truth));
        }
    }
    let mut costs = [0.0; 2];
    for (k, (way, _)) in ways.iter().enumerate() {
        seconds[k].sort_by(f64::total_cmp);
        let time = seconds[k][seconds[k].len() / 2];
        let square = errors[k].iter().map(|x| x * x).sum::<f64>() / errors[k].len() as f64;
        let bias = errors[k].iter().sum::<f64>() / errors[k].len() as f64;
        let mut sizes: Vec<f64> = errors[k].iter().map(|x| x.abs()).collect();
        sizes.sort_by(f64::total_cmp);
        let at = |share: f64| 255.0 * sizes[(share * (sizes.len() - 1) as f64) as usize];
        costs[k] = square * time;
        println!(
            "{name:5} {way:7} {:7.1} ms {rays:9} rays  rmse {:.4}  mean {:+.4}  p99.99 {:.3}  \
             worst {:.3}",
            time * 1e3,
            255.0 * square.sqrt(),
            255.0 * bias,
            at(0.9999),
            at(1.0),
            rays = rays[k],
        );
    }
    println!("{name:5} as good in 1/{:.2} of the time", costs[0] / costs[1]);
}

/// What secondary light adds to each channel, the seconds that the whole picture took and its
/// rays.
fn secondary_light(scene: &Block, samples: u32, seed: u64) -> (Vec<f64>, f64, u64) {
    let start = Instant::now();
    let with = picture(scene, samples, seed, true);
    let time = start.elapsed().as_secs_f64();
    let without = picture(scene, samples, seed, false);
    let difference = with
        .pixels
        .as_flattened()
        .iter()
        .zip(without.pixels.as_flattened())
        .map(|(with, without)| f64::from(*with) - f64::from(*without))
        .collect();
    (difference, time, with.tally.rays)
}

fn picture(scene: &Block, samples: u32, seed: u64, secondary: bool) -> RenderedTile {
    let size = Size::new(96, 54).expect("a size");
    let quality = Quality {
        sampling: Sampling::fixed(samples).unwrap(),
        seed,
        secondary,
        ..Quality::default()
    };
    let area = Area::whole(size);
    let on_progress = &mut || ControlFlow::Continue(());
    let settings = Settings { size, quality };
    render_tile(scene, &settings.quality, area, Isa::fastest(), on_progress)
        .expect("nobody stops it")
}
