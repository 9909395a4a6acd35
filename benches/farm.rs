//! What the farm costs: one picture rendered in one process and by two workers, in turn.
//!
//! `cargo bench --bench farm [-- SCENE SIZE SAMPLES ROUNDS]`

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

fn main() -> anyhow::Result<()> {
    let words: Vec<String> = env::args().skip(1).filter(|word| word != "--bench").collect();
    let word = |index: usize, default: &str| {
        words.get(index).map_or_else(|| default.to_owned(), String::clone)
    };
    let folder = tempfile::tempdir()?;
    let scene = word(0, "bench.rt");
    if words.is_empty() {
        fs::write(folder.path().join(&scene), scene_text())?;
    }
    let scene = env::current_dir()?.join(folder.path().join(&scene));
    let (size, samples) = (word(1, "1280x720"), word(2, "64"));
    let rounds: usize = word(3, "5").parse().context("the number of rounds")?;

    let [mut here, mut farm] = [Vec::new(), Vec::new()];
    let mut out = io::stdout().lock();
    for round in 1..=rounds {
        for (workers, threads, times) in [("0", "2", &mut here), ("2", "1", &mut farm)] {
            let seconds = render(&scene, folder.path(), [&size, &samples, workers, threads])?;
            writeln!(
                out,
                "round {round}: --workers {workers} --threads {threads}: {seconds:.3} s"
            )?;
            times.push(seconds);
        }
    }
    let (here, farm) = (median(&mut here), median(&mut farm));
    writeln!(out, "median in one process, 2 threads:    {here:.3} s")?;
    writeln!(out, "median by 2 workers, 1 thread each:  {farm:.3} s")?;
    writeln!(out, "ratio:                               {:.3}", farm / here)?;
    Ok(())
}

fn render(
    scene: &Path,
    folder: &Path,
    [size, samples, workers, threads]: [&str; 4],
) -> anyhow::Result<f64> {
    let started = Instant::now();
    let status = Command::new(env!("CARGO_BIN_EXE_rtfarm"))
        .arg("render")
        .arg(scene)
        .args(["--size", size, "--samples", samples, "--workers", workers, "--threads", threads])
        .args(["-o", "bench.png"])
        .current_dir(folder)
        .env("RUST_LOG", "warn")
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .status()?;
    ensure!(status.success(), "the render failed");
    Ok(started.elapsed().as_secs_f64())
}

fn median(times: &mut [f64]) -> f64 {
    times.sort_by(f64::total_cmp);
    times[times.len() / 2]
}
