//! What the farm costs: pictures rendered in one process and by two workers, in turn.
//!
//! `cargo bench --bench farm [-- ROUNDS]` prints medians.

use std::{
    env, fs,
    io::{self, Write},
    path::Path,
    process::{Command, Stdio},
};

use anyhow::{Context, ensure};
use tokio::time::Instant;

/// Spheres on a grid: enough work for every pixel, nothing to read but this file.
fn scene_text() -> String {
    let head = "\
viewport
origin 0 0 -20
topleft -8 4.5 -10
bottomleft -8 -4.5 -10
topright 8 4.5 -10
endviewport
materials
entry
name grey
color 200 190 180
endentry
endmaterials
lights
reference
power 1
distance 15
endreference
point
coords 5 9 -20
power 1
endpoint
endlights
geometry
";
    let sphere = |number: u32| {
        let (x, y) = (f64::from(number % 25) - 12.0, f64::from(number / 25) - 7.5);
        format!("sphere\ncoords {x} {y} 0\nradius 0.45\nmaterial grey\nendsphere\n")
    };
    let spheres: Vec<String> = (0..400).map(sphere).collect();
    [head, &spheres.concat(), "endgeometry\n"].concat()
}

/// A picture, and how it is asked for.
struct Picture {
    what: &'static str,
    arguments: &'static [&'static str],
    /// Tiles that it is cut into.
    tiles: f64,
}

const PICTURES: [Picture; 3] = [
    Picture {
        what: "a short picture",
        arguments: &["--size", "640x360", "--samples", "16"],
        tiles: 920.0,
    },
    Picture {
        what: "a long picture",
        arguments: &["--size", "1280x720", "--samples", "100"],
        tiles: 920.0,
    },
    Picture {
        what: "tiles of 16",
        arguments: &["--size", "2048x2048", "--samples", "1", "--flat", "--tile", "16"],
        tiles: 16_384.0,
    },
];

fn main() -> anyhow::Result<()> {
    let words: Vec<String> = env::args().skip(1).filter(|word| word != "--bench").collect();
    let rounds = words.first().map_or(Ok(5), |word| word.parse()).context("the rounds")?;
    let folder = tempfile::tempdir()?;
    let scene = folder.path().join("bench.rt");
    fs::write(&scene, scene_text())?;
    let mut out = io::stdout().lock();
    for Picture { what, arguments, tiles } in PICTURES {
        let [mut here, mut farm] = [Vec::new(), Vec::new()];
        for _ in 0..rounds {
            for (workers, threads, costs) in [("0", "2", &mut here), ("2", "1", &mut farm)] {
                let workers = ["--workers", workers, "--threads", threads];
                costs.push(render(&scene, folder.path(), arguments, workers)?);
            }
        }
        let ([time, processor], [farm_time, farm_processor]) = (median(&here), median(&farm));
        writeln!(
            out,
            "{what}: {time:.3} s in one process, {farm_time:.3} s by two workers; processor time \
             {processor:.2} s, {farm_processor:.2} s: {:.3} x, {:+.1} us a tile",
            farm_processor / processor,
            (farm_processor - processor) * 1e6 / tiles,
        )?;
    }
    Ok(())
}

/// What a render took: seconds, and seconds of processor time of all its processes.
fn render(
    scene: &Path,
    folder: &Path,
    arguments: &[&str],
    workers: [&str; 4],
) -> anyhow::Result<[f64; 2]> {
    let (started, before) = (Instant::now(), processor_time()?);
    let status = Command::new(env!("CARGO_BIN_EXE_rtfarm"))
        .arg("render")
        .arg(scene)
        .args(arguments)
        .args(workers)
        .args(["-o", "bench.png"])
        .current_dir(folder)
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .status()?;
    ensure!(status.success(), "the render failed");
    Ok([started.elapsed().as_secs_f64(), processor_time()? - before])
}

/// Seconds of processor time of all processes that this one has started and waited for, and of
/// those that they had. See `proc_pid_stat(5)`; a tick is 10 ms.
fn processor_time() -> anyhow::Result<f64> {
    let line = fs::read_to_string("/proc/self/stat")?;
    let (_, fields) = line.rsplit_once(')').context("a process has a name")?;
    let fields: Vec<&str> = fields.split_whitespace().collect();
    let ticks =
        |index: usize| fields.get(index).context("a field")?.parse::<f64>().context("ticks");
    Ok((ticks(13)? + ticks(14)?) / 100.0)
}

fn median(costs: &[[f64; 2]]) -> [f64; 2] {
    [0, 1].map(|index| {
        let mut costs: Vec<f64> = costs.iter().map(|cost| cost[index]).collect();
        costs.sort_by(f64::total_cmp);
        costs[costs.len() / 2]
    })
}
