//! The line that is logged for each finished tile.

use std::time::Duration;

use rtfarm_core::tile::TileId;
use rtfarm_proto::WorkerId;

/// What a tile took its worker.
#[derive(Debug, Clone, Copy)]
pub struct TileCost {
    /// Time on one thread, in seconds.
    pub seconds: f64,
    /// Rays traced.
    pub rays: u64,
}

/// Logs that a tile is in the picture, as the `done`th of `count`, `elapsed` after the start.
pub fn log_tile(
    done: u32,
    count: u32,
    tile: TileId,
    worker: WorkerId,
    cost: &TileCost,
    elapsed: Duration,
) {
    let left = elapsed.as_secs_f64() / f64::from(done) * f64::from(count - done);
    let mrays = cost.rays as f64 / 1e6 / cost.seconds.max(1e-9);
    tracing::info!(
        worker = worker.0,
        tile = tile.number(),
        ms = (cost.seconds * 1e3).round() as u64,
        mrays = (mrays * 10.0).round() / 10.0,
        left = %format_args!("{left:.0}s"),
        "tile {done}/{count} done"
    );
}
