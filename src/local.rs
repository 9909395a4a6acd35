//! Rendering in this process, without workers.

use std::{
    ops::ControlFlow,
    path::Path,
    sync::{
        Mutex,
        atomic::{AtomicUsize, Ordering},
    },
    time::Duration,
};

use anyhow::Context;
use rayon::ThreadPoolBuilder;
use rtfarm_core::{isa::Isa, prepared::PreparedScene, render::render_tile};
use rtfarm_job::{FinishedTile, Order, Progress};
use rtfarm_picture::{Picture, PutError};
use tokio::{sync::watch, time::Instant};
use tokio_util::sync::CancellationToken;

/// Renders a whole picture. `None` when `stop` came first. Never call this on the async runtime.
pub(crate) fn render(
    order: Order,
    folder: &Path,
    (threads, isa): (usize, Isa),
    progress: &watch::Sender<Progress>,
    stop: &CancellationToken,
) -> anyhow::Result<Option<(Picture, Duration)>> {
    let Order { prepared, settings, grid, transfer, format, .. } = order;
    let picture = Picture::new_in(folder, grid.window(), format, transfer)
        .with_context(|| format!("cannot make the picture's file in {}", folder.display()))?;
    let scene = PreparedScene::open(prepared)?;
    let pool = ThreadPoolBuilder::new().num_threads(threads).build()?;
    let tiles = grid.render_order();
    let next = AtomicUsize::new(0);
    let failure: Mutex<Option<PutError>> = Mutex::new(None);
    let started = Instant::now();
    let on_progress = || {
        if stop.is_cancelled() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    };
    pool.broadcast(|_| {
        while let Some(&tile) = tiles.get(next.fetch_add(1, Ordering::Relaxed)) {
            let tile_started = Instant::now();
            let area = grid.area(tile);
            let mut on_progress = on_progress;
            let Some(rendered) =
                render_tile(&scene, &settings.quality, area, isa, &mut on_progress)
            else {
                return;
            };
            let seconds = tile_started.elapsed().as_secs_f64();
            if let Err(error) = picture.put(area, &rendered.pixels) {
                next.store(tiles.len(), Ordering::Relaxed);
                failure.lock().expect("nothing here panics").get_or_insert(error);
                return;
            }
            let mut now_done = Progress::default();
            progress.send_modify(|progress| {
                progress.tiles_done += 1;
                progress.tally.add(&rendered.tally);
                now_done.clone_from(progress);
            });
            let rays = rendered.tally.rays;
            FinishedTile { tile, worker: None, seconds, rays }.log(&now_done, started.elapsed());
        }
    });
    if let Some(error) = failure.into_inner().expect("nothing here panics") {
        return Err(error.into());
    }
    let is_whole = on_progress().is_continue();
    Ok(is_whole.then(|| (picture, started.elapsed())))
}
