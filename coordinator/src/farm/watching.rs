//! What those see who watch a picture.

use rtfarm_core::tile::TileId;
use rtfarm_proto::{JobId, WorkerId};

use super::Farm;
use crate::tiles::Tiles;

/// Tiles that came into a picture.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct Arrived {
    /// It is another number when tiles were taken out of the picture, or the job began again: then
    /// what was known of it counts no more.
    pub(crate) generation: u32,
    /// Those that came after the ones asked for, and who brought them.
    pub(crate) tiles: Vec<(TileId, WorkerId)>,
}

impl Farm {
    /// Which tiles came into a job's picture since this start of the farm, but for the first
    /// `seen`.
    pub(crate) fn arrived(&self, job: JobId, seen: usize) -> Option<Arrived> {
        let job = self.jobs.get(&job)?;
        let came = job.brought.get(seen..).unwrap_or_default();
        let tiles = came.iter().map(|delivery| (delivery.tile, delivery.worker)).collect();
        Some(Arrived { generation: job.progress.retry_count + job.progress.taken_back, tiles })
    }

    /// Says of each tile of a job, by its number, whether it is in the picture. `None` where that
    /// is not known, since an earlier start of the farm saw the job's end.
    pub(crate) fn done(&self, job: JobId) -> Option<Vec<bool>> {
        let known = self.jobs.get(&job)?;
        let flags = |tiles: &Tiles| {
            let grid = tiles.grid();
            let tile = |number| tiles.is_done(grid.tile(number).expect("the grid has it"));
            (0..grid.count()).map(tile).collect()
        };
        if known.progress.tiles_done == known.progress.tile_count {
            return Some(vec![true; known.progress.tile_count as usize]);
        }
        self.leases.tiles(job).or(known.rest.as_ref()).map(flags)
    }

    /// Says whether nobody is there to render.
    pub(crate) fn lacks_workers(&self) -> bool {
        self.members.is_empty()
    }

    /// The tiles of a job that workers have and have not brought, and whether they are known to
    /// have begun them.
    pub(crate) fn in_work(&self, job: JobId) -> Vec<(TileId, WorkerId, bool)> {
        self.leases.in_work(job).collect()
    }
}
