//! What the tiles of one job cost, as measured.

use std::{collections::BTreeMap, time::Duration};

use rtfarm_proto::WorkerId;

/// The time on one thread that tiles of a job took, by worker and together.
#[derive(Debug, Default)]
pub(crate) struct Pace {
    all: Cost,
    by_worker: BTreeMap<WorkerId, Cost>,
}

#[derive(Debug, Clone, Copy, Default)]
struct Cost {
    tiles: u32,
    time: Duration,
}

impl Pace {
    /// Event: a worker has brought a tile that took it so long.
    pub(crate) fn on_tile(&mut self, worker: WorkerId, time: Duration) {
        for cost in [&mut self.all, self.by_worker.entry(worker).or_default()] {
            cost.tiles += 1;
            cost.time += time;
        }
    }

    /// What a tile takes on the average; `None` before the first.
    pub(crate) fn mean(&self) -> Option<Duration> {
        self.all.mean()
    }

    /// How fast a thread of a worker is, where 1 is the average of all tiles; `None` before its
    /// first tile.
    pub(crate) fn speed(&self, worker: WorkerId) -> Option<f64> {
        let mean = self.by_worker.get(&worker)?.mean()?;
        Some(self.mean()?.as_secs_f64() / mean.as_secs_f64().max(1e-9))
    }
}

impl Cost {
    fn mean(self) -> Option<Duration> {
        self.time.checked_div(self.tiles)
    }
}
