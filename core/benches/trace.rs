//! Prepares and renders a lathe bottle of a million triangles: seconds to prepare, bytes a
//! triangle, millions of rays a second.
//!
//!     cargo bench -p rtfarm-core --bench trace [-- TRIANGLES]

#![expect(clippy::print_stdout, reason = "a benchmark prints its figures")]
#![expect(clippy::disallowed_methods, reason = "a benchmark reads the clock and makes a bottle")]

mod bottle;

use std::{ops::ControlFlow, time::Instant};

use bottle::bottle;

use rayon::prelude::*;
use rtfarm_core::{
    isa::Isa,
    prepare::prepare,
    prepared::PreparedScene,
    render::{Quality, Sampling, Settings, render_tile},
    tile::{Size, TileGrid},
};

fn main() {
    let triangles = std::env::args().find_map(|word| word.parse().ok());
    let scene = bottle(triangles.unwrap_or(1_000_000));
    let count = scene.triangles.len() as f64;
    println!("bottle of {count} triangles, medians of 5");

    for threads in [1, 2] {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads");
        let seconds = median(|| {
            let start = Instant::now();
            pool.install(|| prepare(&scene).expect("a plain scene"));
            start.elapsed().as_secs_f64()
        });
        println!("prepare, {threads} threads: {:.0} ms", seconds * 1e3);
    }
    let prepared = PreparedScene::open(prepare(&scene).expect("a plain scene")).expect("valid");
    println!("prepared: {:.1} bytes a triangle", prepared.byte_count() as f64 / count);
    let seconds = median(|| {
        let bytes = prepare(&scene).expect("a plain scene");
        let start = Instant::now();
        drop(PreparedScene::open(bytes));
        start.elapsed().as_secs_f64()
    });
    println!("open: {:.0} ms", seconds * 1e3);

    let size = Size::new(1280, 720).expect("a size");
    let grid = TileGrid::balanced(size);
    for flat in [true, false] {
        let settings = Settings {
            size,
            quality: Quality { sampling: Sampling::fixed(1).unwrap(), flat, ..Quality::default() },
        };
        for isa in Isa::ALL.into_iter().filter(|isa| isa.is_supported()) {
            for threads in [1, 2] {
                let pool =
                    rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads");
                let mut rays = 0;
                let seconds = median(|| {
                    let start = Instant::now();
                    rays = pool.install(|| {
                        let tile = |tile| {
                            let on = &mut || ControlFlow::Continue(());
                            render_tile(&prepared, &settings.quality, grid.area(tile), isa, on)
                        };
                        let order = grid.render_order();
                        order
                            .par_iter()
                            .map(|&t| tile(t).expect("not stopped").tally.rays)
                            .sum::<u64>()
                    });
                    start.elapsed().as_secs_f64()
                });
                let kind = if flat { "camera rays" } else { "camera and shadow rays" };
                println!(
                    "{kind}, {isa}, {threads} threads: {:.2} Mrays/s ({:.0} ms)",
                    rays as f64 / seconds / 1e6,
                    seconds * 1e3
                );
            }
        }
    }
}

fn median(mut run: impl FnMut() -> f64) -> f64 {
    let mut seconds: Vec<f64> = (0..5).map(|_| run()).collect();
    seconds.sort_by(f64::total_cmp);
    seconds[2]
}
