//! Rendering in this process, without workers.

use std::{
    collections::HashSet,
    ops::ControlFlow,
    sync::{
        Mutex,
        atomic::{AtomicUsize, Ordering},
    },
    time::Duration,
};

use rayon::ThreadPoolBuilder;
use rtfarm_core::{isa::Isa, prepared::PreparedScene, render::render_tile, tile::TileId};
use rtfarm_job::{FinishedTile, Order, Progress, TileCosts};
use rtfarm_picture::{Canvas, CanvasTile, PutError, TileRecord, pixel_bytes};
use tokio::{sync::watch, time::Instant};
use tokio_util::sync::CancellationToken;

/// A picture that outlives this process is made safe from power cuts so often.
const SYNC_PERIOD: Duration = Duration::from_secs(1);

/// Renders what `canvas` lacks besides the tiles `done`. Answers how long the whole picture took,
/// earlier processes included; `None` when `stop` came first. Never call this on the async runtime.
pub(crate) fn render(
    order: Order,
    canvas: &Canvas,
    done: &[(TileId, TileRecord)],
    (threads, isa): (usize, Isa),
    progress: &watch::Sender<Progress>,
    stop: &CancellationToken,
) -> anyhow::Result<Option<Duration>> {
    let Order { prepared, settings, grid, .. } = order;
    let scene = PreparedScene::open(prepared)?;
    let pool = ThreadPoolBuilder::new().num_threads(threads).build()?;
    let are_done: HashSet<TileId> = done.iter().map(|&(tile, _)| tile).collect();
    let mut tiles = grid.render_order();
    tiles.retain(|tile| !are_done.contains(tile));
    let earlier = done.iter().map(|(_, record)| record.elapsed).fold(0.0, f32::max);
    let earlier = Duration::try_from_secs_f32(earlier)?;
    progress.send_modify(|progress| {
        progress.tiles_done = done.len() as u32;
        for (_, record) in done {
            progress.tally.add(&record.tally);
        }
    });
    let next = AtomicUsize::new(0);
    let failure: Mutex<Option<PutError>> = Mutex::new(None);
    let started = Instant::now();
    let elapsed = || earlier + started.elapsed();
    let synced = Mutex::new(started);
    let costs = Mutex::new(TileCosts::default());
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
            let record = TileRecord {
                arrived: [0; 32],
                tally: rendered.tally,
                seconds: seconds as f32,
                elapsed: elapsed().as_secs_f32(),
                worker_count: 0,
            };
            let bytes = pixel_bytes(&rendered.pixels);
            let put = canvas.put_all(&[CanvasTile { tile, bytes, record }]);
            if let Err(error) = put.and_then(|()| sync_now_and_then(canvas, &synced)) {
                next.store(tiles.len(), Ordering::Relaxed);
                failure.lock().expect("nothing here panics").get_or_insert(error);
                return;
            }
            let mut now_done = Progress::default();
            progress.send_modify(|progress| {
                progress.tiles_done += 1;
                progress.tally.add(&rendered.tally);
                let mut costs = costs.lock().expect("nothing here panics");
                costs.add(seconds);
                let tiles_left = progress.tile_count - progress.tiles_done;
                progress.left = costs.time_left(tiles_left, started.elapsed());
                now_done.clone_from(progress);
            });
            let rays = rendered.tally.rays;
            FinishedTile { tile, worker: None, seconds, rays }.log(&now_done, elapsed());
        }
    });
    if let Some(error) = failure.into_inner().expect("nothing here panics") {
        return Err(error.into());
    }
    let is_whole = on_progress().is_continue();
    Ok(is_whole.then(elapsed))
}

/// Makes a canvas that outlives its process safe, unless that was done a moment ago or is being
/// done.
fn sync_now_and_then(canvas: &Canvas, synced: &Mutex<Instant>) -> Result<(), PutError> {
    if canvas.is_kept()
        && let Ok(mut synced) = synced.try_lock()
        && synced.elapsed() >= SYNC_PERIOD
    {
        canvas.sync()?;
        *synced = Instant::now();
    }
    Ok(())
}
