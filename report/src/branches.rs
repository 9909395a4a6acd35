//! Branches that are followed by chance, beside whole trees down to a weight.

use std::{fmt::Write, ops::ControlFlow};

use rayon::prelude::*;
use rtfarm_core::{
    isa::Isa,
    language::read_scene,
    prepare::prepare,
    prepared::{PreparedBytes, PreparedScene},
    render::{Quality, RenderedTile, Sampling, render_tile},
    testing::render_trees,
    tile::{Area, Size},
};
use rtfarm_ladder::figures::{mean_and_band, median};

use crate::kernels::now;

/// The weight down to which trees are the truth: what is lighter is less than a thousandth of a
/// step of 8 bits where a branch in two ends.
const TRUTH: f64 = 1.0 / 1_048_576.0;

/// The weights down to which trees are measured. That of roulette is 1/256.
const CUTOFFS: [f64; 4] = [1.0 / 16.0, 1.0 / 256.0, 1.0 / 4096.0, 1.0 / 65_536.0];

const VIEWPORT: &str = "viewport origin 0.72 0.9 0 topleft -0.35 1.7 0.2 bottomleft -0.35 0.1 0.2
    topright 0.35 1.7 -1.2 background 170 200 230 endviewport
lights ambient 0.25 reference power 100 distance 6 endreference point coords 2.5 6 3 power 110
    endpoint endlights
materials
    entry name light color 225 215 190 endentry
    entry name dark color 110 90 80 endentry
    entry name red color 210 60 50 endentry
    entry name glass color 220 240 230 refract 0.667 reflect 0.05 alpha 0.1 endentry
    entry name pane color 0 0 0 reflect 0.5 alpha 0 endentry endmaterials\n";

const ROOM: &str = "quadrangle vertex -8 0 8 vertex 8 0 8 vertex 8 0 -3 vertex -8 0 -3 material light endquadrangle
    quadrangle vertex -8 0 -3 vertex 8 0 -3 vertex 8 1.2 -3 vertex -8 1.2 -3 material dark endquadrangle
    sphere coords -1.1 0.35 -1.2 radius 0.35 material red endsphere
    sphere coords 1.3 0.45 -0.8 radius 0.45 material red endsphere\n";

/// The eye in a ball of glass that mirrors too, and before panes that do.
fn scenes() -> [(&'static str, PreparedScene<PreparedBytes>); 2] {
    let ball = "sphere coords 0 0.9 0 radius 0.8 material glass endsphere".to_owned();
    let mut panes = String::new();
    for x in [-0.5, -0.6, -0.7, -0.8] {
        let _ = writeln!(
            panes,
            "quadrangle vertex {x} 0.1 9 vertex {x} 0.1 -3 vertex {x} 9 -3 vertex {x} 9 9
            material pane endquadrangle"
        );
    }
    [("inside a ball of glass", ball), ("before four panes", panes)].map(|(name, geometry)| {
        let text = format!("{VIEWPORT} geometry {ROOM} {geometry} endgeometry");
        let nothing = |_: &str| Err(std::io::ErrorKind::NotFound.into());
        let scene = read_scene(text.as_bytes(), &nothing).scene.expect("a scene without a fault");
        let bytes = prepare(&scene).expect("a plain scene");
        (name, PreparedScene::open(bytes).expect("what was just prepared"))
    })
}

/// One picture of single samples: its milliseconds, rays a sample, mean square error, mean error.
type Run = [f64; 4];

/// The table of both scenes: `side` pixels across, roulette with so many seeds.
pub(crate) fn table(side: u32, seeds: u64) -> String {
    let mut text = String::from(
        "## Branches by chance, and whole trees\n\nOne sample in the middle of each pixel, so that \
         branches are all that differs. Truth is the whole tree down to a weight of 2^-20; \"trees \
         to w\" end where a branch weighs less than w, which then counts as background. Errors are \
         in steps of 8 bits; ± is the 95 % band over seeds. The last column is the mean square error \
         times the time, in units of that of roulette.\n\n\
         | scene | way | rays a sample | ms | RMSE | mean | error² x time |\n\
         |---|---|---|---|---|---|---|\n",
    );
    let size = Size::new(side.into(), u64::from(side) * 3 / 4).expect("a small size");
    let area = Area::whole(size);
    let quality = |seed| Quality {
        sampling: Sampling::fixed(1).expect("it is in range"),
        seed,
        ..Quality::default()
    };
    for (name, scene) in scenes() {
        let trees = |cutoff| render_trees(&scene, &quality(0), area, Isa::fastest(), cutoff);
        let truth = trees(TRUTH).pixels;
        let run = |render: &dyn Fn() -> RenderedTile| -> Run {
            let started = now();
            let tile = render();
            let milliseconds = started.elapsed().as_secs_f64() * 1e3;
            let pairs = tile.pixels.as_flattened().iter().zip(truth.as_flattened());
            let off: Vec<f64> =
                pairs.map(|(a, b)| 255.0 * (f64::from(*a) - f64::from(*b))).collect();
            let mean =
                |of: fn(f64) -> f64| off.iter().map(|x| of(*x)).sum::<f64>() / off.len() as f64;
            let rays = tile.tally.rays as f64 / tile.tally.samples as f64;
            [milliseconds, rays, mean(|x| x * x), mean(|x| x)]
        };
        let by_chance: Vec<Run> = (0..seeds)
            .into_par_iter()
            .map(|seed| {
                run(&|| {
                    let go_on = &mut || ControlFlow::Continue(());
                    render_tile(&scene, &quality(seed), area, Isa::fastest(), go_on)
                        .expect("nobody stops it")
                })
            })
            .collect();
        let mut rows = vec![("roulette".to_owned(), by_chance)];
        rows.extend(CUTOFFS.map(|cutoff| {
            (format!("trees to 1/{:.0}", 1.0 / cutoff), vec![run(&|| trees(cutoff))])
        }));
        let mut unit = None;
        for (way, runs) in rows {
            let column = |k: usize| runs.iter().map(move |run| run[k]);
            let time = median(&column(0).collect::<Vec<f64>>());
            let [(rays, _), (square, _), (mean, band)] =
                [1, 2, 3].map(|k| mean_and_band(column(k)));
            let band = if runs.len() > 1 { format!(" ± {band:.3}") } else { String::new() };
            let cost = square * time;
            let _ = writeln!(
                text,
                "| {name} | {way} | {rays:.0} | {time:.1} | {:.3} | {mean:+.3}{band} | {:.2} |",
                square.sqrt(),
                cost / *unit.get_or_insert(cost)
            );
        }
    }
    text.push('\n');
    text
}
