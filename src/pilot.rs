//! `--time`: how good a picture can be in a given time.

use std::time::Duration;

use rayon::prelude::*;
use rtfarm_core::{
    isa::Isa,
    prepared::{PreparedBytes, PreparedScene},
    render::{Quality, Sampling, render_tile},
    tile::Area,
};
use rtfarm_job::Order;
use rtfarm_ladder::adaptive_settings;
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;

/// Squares of the frame that are rendered to learn what a setting costs, in each direction.
const SQUARES: u32 = 5;

/// Their side in pixels.
const SIDE: u32 = 16;

/// The part of the time that a prediction may take up: it is off by some per cent.
const PART: f64 = 0.9;

/// Chooses the finest of the [`adaptive_settings`] with which `threads` threads render the picture
/// in `time`, what the choice itself takes included; the coarsest where none does. `None` when
/// `stop` came first. Never call this on the async runtime.
pub(crate) fn choose(
    order: &Order,
    (threads, isa): (usize, Isa),
    time: Duration,
    stop: &CancellationToken,
) -> anyhow::Result<Option<Sampling>> {
    let started = Instant::now();
    let scene = PreparedScene::open(PreparedBytes::copy_from(order.prepared.as_ref()))?;
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build()?;
    let window = order.grid.window();
    let squares = squares(window);
    let pixels: usize = squares.iter().map(|square| square.pixel_count()).sum();
    let whole = window.pixel_count() as f64 / pixels as f64;
    let mut chosen = None;
    for sampling in adaptive_settings() {
        let quality = Quality { sampling, ..order.settings.quality };
        let rung_started = Instant::now();
        let is_whole = pool.install(|| {
            squares.par_iter().all(|&square| {
                let on_progress = &mut || {
                    if stop.is_cancelled() {
                        std::ops::ControlFlow::Break(())
                    } else {
                        std::ops::ControlFlow::Continue(())
                    }
                };
                render_tile(&scene, &quality, square, isa, on_progress).is_some()
            })
        });
        if !is_whole {
            return Ok(None);
        }
        let predicted = rung_started.elapsed().mul_f64(whole);
        tracing::debug!(?sampling, ?predicted, "pilot");
        if started.elapsed() + predicted > time.mul_f64(PART) {
            break;
        }
        chosen = Some(sampling);
    }
    Ok(chosen.or_else(|| adaptive_settings().next()))
}

/// Squares all over the window.
fn squares(window: Area) -> Vec<Area> {
    let places = |length: u32| -> Vec<(u32, u32)> {
        let count = SQUARES.min(length.div_ceil(SIDE));
        (0..count)
            .map(|k| {
                let side = SIDE.min(length);
                let middle = u64::from(length) * u64::from(2 * k + 1) / u64::from(2 * count);
                ((middle as u32).saturating_sub(side / 2).min(length - side), side)
            })
            .collect()
    };
    let (columns, rows) = (places(window.width()), places(window.height()));
    let across = |(y0, height)| {
        columns.iter().map(move |&(x0, width)| {
            let corner = [window.x0() + x0, window.y0() + y0];
            Area::new(window.frame(), corner, [width, height]).expect("a square of the window")
        })
    };
    rows.iter().copied().flat_map(across).collect()
}

#[cfg(test)]
mod tests {
    use rtfarm_core::tile::Size;

    use super::*;

    #[test]
    fn squares_lie_in_the_window() {
        for (width, height) in [(1, 1), (17, 3), (100, 75), (65_535, 2), (1280, 720)] {
            let frame = Size::new(width, height).unwrap();
            let corner = [frame.width() / 3, frame.height() / 3];
            let sides = [frame.width() - corner[0], frame.height() - corner[1]];
            for window in [Area::whole(frame), Area::new(frame, corner, sides).unwrap()] {
                assert!(squares(window).into_iter().all(|square| window.has(square)));
            }
        }
    }
}
