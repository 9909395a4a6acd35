//! The line that is logged for each finished tile.

use std::time::Duration;

use rtfarm_core::tile::TileId;

use crate::Progress;

/// A tile that was rendered, and what it took.
#[derive(Debug, Clone, Copy)]
pub struct FinishedTile {
    /// Which one.
    pub tile: TileId,
    /// The number of the worker that brought it; `None` where the process renders by itself.
    pub worker: Option<u32>,
    /// Time on one thread, in seconds.
    pub seconds: f64,
    /// Rays traced.
    pub rays: u64,
}

impl FinishedTile {
    /// Logs that the tile is in the picture, as the last of those in `progress`, `elapsed` after
    /// the start.
    pub fn log(&self, progress: &Progress, elapsed: Duration) {
        let Self { tile, worker, seconds, rays } = *self;
        let Progress { tiles_done: done, tile_count: count, .. } = *progress;
        let left = elapsed.as_secs_f64() / f64::from(done) * f64::from(count - done);
        let mrays = rays as f64 / 1e6 / seconds.max(1e-9);
        tracing::info!(
            worker,
            tile = tile.number(),
            ms = (seconds * 1e3).round() as u64,
            mrays = (mrays * 10.0).round() / 10.0,
            left = %format_args!("{left:.0}s"),
            "tile {done}/{count} done"
        );
    }
}
