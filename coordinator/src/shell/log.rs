//! What the farm has noticed, as lines of the log.

use rtfarm_core::tile::TileId;
use rtfarm_job::FinishedTile;

use crate::{
    farm::{Delivery, Notice},
    members::Process,
    tiles::MOST_LOSSES,
};

pub(super) fn log(notice: Notice) {
    match notice {
        Notice::Joined(worker, Process { host, number, threads, isa, .. }) => {
            tracing::info!(
                worker = worker.0,
                host,
                process = number,
                threads,
                isa,
                "worker joined"
            );
        }
        Notice::Gone(worker, reason) => {
            tracing::info!(worker = worker.0, reason, "worker gone");
        }
        Notice::LeaseLost(loss, reason) => tracing::warn!(
            worker = loss.worker.0,
            tiles = %list(&loss.tiles),
            reason,
            job = loss.lease.job.0,
            lease = loss.lease.id.0,
            "lease lost"
        ),
        Notice::SetAside(job, tile) => tracing::error!(
            job = job.0,
            tile = tile.number(),
            "a tile is set aside: too many workers were lost with it, or stood still"
        ),
        Notice::TileDone { delivery, progress, elapsed } => {
            let Delivery { worker, tile, seconds, tally, .. } = delivery;
            let (worker, rays) = (Some(worker.0), tally.rays);
            FinishedTile { tile, worker, seconds, rays }.log(&progress, elapsed);
        }
        Notice::CopiesDiffer { second, first } => tracing::error!(
            worker = second.worker.0,
            tile = second.tile.number(),
            other = first.worker.0,
            first = %blake3::Hash::from_bytes(first.hash),
            second = %blake3::Hash::from_bytes(second.hash),
            "two copies of a tile differ; one of their workers is broken"
        ),
        Notice::Liar { worker, job, tile } => tracing::error!(
            worker = worker.0,
            job = job.0,
            tile = tile.number(),
            "a worker brought pixels that two others contradict; it is kept out from now on"
        ),
        Notice::TakenBack { worker, job, tiles } => tracing::warn!(
            worker = worker.0,
            job = job.0,
            tiles = %list(&tiles),
            "tiles of a worker that is kept out are rendered again"
        ),
        Notice::NoAudit => {
            tracing::warn!("tiles are not compared: nobody is there to render them again");
        }
        Notice::NotCompared(job, tile) => tracing::warn!(
            job = job.0,
            tile = tile.number(),
            "the tile is not compared: {MOST_LOSSES} workers that rendered it again were lost"
        ),
        Notice::JobFailed(job, reason) => tracing::warn!(job = job.0, reason, "job failed"),
        Notice::NotGranted { worker, lease, tile, count } => {
            tracing::warn!(
                worker = worker.0,
                job = lease.job.0,
                lease = lease.id.0,
                tile = tile.number(),
                count,
                "pixels came that nobody was to render so"
            );
        }
        Notice::Suspect { worker, job, tile, reason } => tracing::error!(
            worker = worker.0,
            job = job.0,
            tile = tile.number(),
            reason,
            "a worker brought pixels that make no sense"
        ),
        Notice::Strangers(count) => {
            tracing::warn!(count, "calls meant for another start of a coordinator were refused");
        }
        Notice::JobExpired(job) => {
            tracing::info!(job = job.0, "job forgotten: it was kept long enough");
        }
        Notice::JobChanged(job, change) => tracing::info!(job = job.0, ?change, "job changed"),
        Notice::Stationed(worker, standing) => {
            tracing::info!(worker = worker.0, ?standing, "worker's standing changed");
        }
        Notice::NoRoom(job, reason) => tracing::warn!(job = job.0, reason, "job waits"),
        Notice::JobCancelled(job) => tracing::info!(job = job.0, "job cancelled"),
    }
}

/// Lists tile numbers in ascending order, runs of neighbours as spans: `3,17-24`.
pub(super) fn list(tiles: &[TileId]) -> String {
    let mut numbers: Vec<u32> = tiles.iter().map(|tile| tile.number()).collect();
    numbers.sort_unstable();
    let spans = numbers.chunk_by(|a, b| a + 1 == *b).map(|span| match span {
        [only] => only.to_string(),
        span => format!("{}-{}", span[0], span[span.len() - 1]),
    });
    spans.collect::<Vec<String>>().join(",")
}

#[cfg(test)]
mod tests {
    use rtfarm_core::tile::{Size, TileGrid};

    use super::*;

    #[test]
    fn tiles_are_listed_as_spans() {
        let grid = TileGrid::new(Size::new(160, 160).unwrap(), 16).unwrap();
        let tiles: Vec<TileId> =
            [24, 3, 18, 17, 19, 99].iter().map(|&number| grid.tile(number).unwrap()).collect();
        assert_eq!(list(&tiles), "3,17-19,24,99");
    }
}
