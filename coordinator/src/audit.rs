//! Tiles that are rendered again by another worker, to be compared: who lies is found out.

use std::collections::{BTreeMap, BTreeSet};

use rtfarm_core::tile::TileId;
use rtfarm_proto::{JobId, WorkerId};

use crate::tiles::{MOST_LOSSES, Rendering};

/// The tiles under examination. Invariant: `pending` has exactly the checks that no lease covers.
#[derive(Debug)]
pub(crate) struct Audit {
    /// Of a worker's tiles after its first of a job, from 0 to 1. At 0, the first is not examined
    /// either.
    fraction: f64,
    /// Chooses them, so that no worker can know which.
    secret: [u8; 32],
    /// By job and number of the tile.
    checks: BTreeMap<(JobId, u32), Check>,
    /// With the worker whose pixels are in the picture.
    pending: BTreeSet<(JobId, WorkerId, u32)>,
}

/// A tile under examination.
#[derive(Debug)]
struct Check {
    tile: TileId,
    /// What workers brought, no two of them the same; the first is in the picture.
    renderings: Vec<Rendering>,
    is_leased: bool,
    losses: u32,
}

/// What a further copy of a tile says of those who rendered it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Finding {
    /// Nothing new.
    Nothing,
    /// Two workers agree: the tile is right.
    Agreement,
    /// Two workers differ. A third has to say who is right.
    Dispute,
    /// Two agree against this one.
    Liar(WorkerId),
    /// Three differ.
    Unsettled,
}

impl Audit {
    /// Makes an audit of `fraction` of all tiles, from 0 to 1, and each worker's first of each job
    /// unless that is 0.
    pub(crate) fn new(fraction: f64, secret: [u8; 32]) -> Self {
        Self { fraction, secret, checks: BTreeMap::new(), pending: BTreeSet::new() }
    }

    /// Says whether a worker's tile is to be rendered again. It is `the_first` that the worker
    /// brought of this job, or any other.
    pub(crate) fn chooses(
        &self,
        job: JobId,
        tile: TileId,
        worker: WorkerId,
        the_first: bool,
    ) -> bool {
        if the_first || self.fraction == 0.0 {
            return self.fraction > 0.0;
        }
        let mut lot = blake3::Hasher::new_keyed(&self.secret);
        lot.update(&job.0.to_le_bytes());
        lot.update(&tile.number().to_le_bytes());
        lot.update(&worker.0.to_le_bytes());
        let lot = lot.finalize().as_bytes()[..4].try_into().expect("there are 32");
        f64::from(u32::from_le_bytes(lot)) < self.fraction * 2f64.powi(32)
    }

    /// Has a tile of which this is in the picture rendered again.
    pub(crate) fn begin(&mut self, job: JobId, tile: TileId, rendering: Rendering) {
        let check = Check { tile, renderings: vec![rendering], is_leased: false, losses: 0 };
        self.pending.insert((job, rendering.worker, tile.number()));
        self.checks.insert((job, tile.number()), check);
    }

    /// Says whether any tile waits for a worker.
    pub(crate) fn has_pending(&self) -> bool {
        !self.pending.is_empty()
    }

    /// A tile of a job that waits for a worker that has not rendered it, as this one.
    pub(crate) fn work_for(&self, job: JobId, worker: WorkerId) -> Option<TileId> {
        let of = |worker| (job, worker, 0);
        let next = WorkerId(worker.0.saturating_add(1));
        let before = self.pending.range(of(WorkerId(0))..of(worker));
        let after = self.pending.range(of(next)..).take_while(|(other, ..)| *other == job);
        let checks = before.chain(after).map(|&(job, _, number)| &self.checks[&(job, number)]);
        checks.filter(|check| !check.knows(worker)).map(|check| check.tile).next()
    }

    /// Event: a worker is leased a tile that waited for one.
    pub(crate) fn on_lease(&mut self, job: JobId, tile: TileId) {
        self.update(job, tile, |check| check.is_leased = true);
    }

    /// Event: that lease is lost. Says whether the examination is given up.
    pub(crate) fn on_loss(&mut self, job: JobId, tile: TileId) -> bool {
        self.update(job, tile, |check| (check.is_leased, check.losses) = (false, check.losses + 1));
        let check = self.checks.get(&(job, tile.number()));
        check.is_some_and(|check| check.losses >= MOST_LOSSES)
    }

    /// Event: a copy came of a tile of which `first` is in the picture.
    pub(crate) fn on_copy(
        &mut self,
        job: JobId,
        tile: TileId,
        first: Rendering,
        copy: Rendering,
    ) -> Finding {
        let agrees = copy.hash == first.hash;
        let check = self.checks.get(&(job, tile.number()));
        if copy.worker == first.worker {
            if agrees || check.is_some() {
                return Finding::Nothing;
            }
            // It contradicts itself.
            self.begin(job, tile, first);
            return Finding::Dispute;
        }
        let Some(check) = check else {
            if agrees {
                return Finding::Agreement;
            }
            self.begin(job, tile, first);
            self.update(job, tile, |check| check.renderings.push(copy));
            return Finding::Dispute;
        };
        if check.knows(copy.worker) {
            return Finding::Nothing;
        }
        match check.renderings.get(1) {
            None if agrees => {
                self.end(job, tile);
                Finding::Agreement
            }
            None => {
                self.update(job, tile, |check| {
                    check.renderings.push(copy);
                    check.is_leased = false;
                });
                Finding::Dispute
            }
            Some(&second) => {
                self.end(job, tile);
                match copy.hash {
                    hash if hash == first.hash => Finding::Liar(second.worker),
                    hash if hash == second.hash => Finding::Liar(first.worker),
                    _ => Finding::Unsettled,
                }
            }
        }
    }

    /// Event: nothing that a worker says counts any more. The tiles in the picture that it rendered
    /// and nobody confirmed are taken out of it.
    pub(crate) fn on_quarantine(&mut self, liar: WorkerId) {
        let of_liar = self.checks.iter().filter(|(_, check)| check.knows(liar));
        let of_liar: Vec<(JobId, TileId, bool)> = of_liar
            .map(|(&(job, _), check)| (job, check.tile, check.renderings[0].worker == liar))
            .collect();
        for (job, tile, is_first) in of_liar {
            if is_first {
                self.end(job, tile);
            } else {
                self.update(job, tile, |check| check.renderings.truncate(1));
            }
        }
    }

    /// Event: a job is rendered no longer.
    pub(crate) fn on_end(&mut self, job: JobId) {
        let tiles: Vec<TileId> = self.of(job).map(|(tile, ..)| tile).collect();
        for tile in tiles {
            self.end(job, tile);
        }
    }

    /// Ends the examination of a tile, which so many workers have rendered.
    pub(crate) fn end(&mut self, job: JobId, tile: TileId) -> usize {
        let Some(check) = self.checks.remove(&(job, tile.number())) else { return 0 };
        self.pending.remove(&(job, check.renderings[0].worker, tile.number()));
        check.renderings.len()
    }

    /// The tiles of a job under examination: whether one is leased, and who rendered it.
    pub(crate) fn of(&self, job: JobId) -> impl Iterator<Item = (TileId, bool, Vec<WorkerId>)> {
        self.checks.range((job, 0)..=(job, u32::MAX)).map(|(_, check)| {
            let workers = check.renderings.iter().map(|rendering| rendering.worker);
            (check.tile, check.is_leased, workers.collect())
        })
    }

    fn update(&mut self, job: JobId, tile: TileId, change: impl FnOnce(&mut Check)) {
        let Some(check) = self.checks.get_mut(&(job, tile.number())) else { return };
        change(check);
        let entry = (job, check.renderings[0].worker, tile.number());
        if check.is_leased {
            self.pending.remove(&entry)
        } else {
            self.pending.insert(entry)
        };
    }
}

impl Check {
    fn knows(&self, worker: WorkerId) -> bool {
        self.renderings.iter().any(|rendering| rendering.worker == worker)
    }
}

#[cfg(test)]
impl Audit {
    /// Checks every invariant, at the price of a scan.
    pub(crate) fn check(&self, is_rendered: impl Fn(JobId) -> bool) {
        let pending = self.checks.iter().filter(|(_, check)| !check.is_leased);
        let pending = pending
            .map(|(&(job, number), check)| (job, check.renderings[0].worker, number))
            .collect();
        assert_eq!(self.pending, pending);
        assert!(self.checks.keys().all(|&(job, _)| is_rendered(job)));
    }
}

#[cfg(test)]
mod tests {
    use rtfarm_core::tile::{Size, TileGrid};

    use super::*;

    #[test]
    fn of_liars_in_five_percent_of_10000_tiles_99_percent_are_caught() {
        const SEEDS: u64 = 5000;
        let grid = TileGrid::new(Size::new(1600, 1600).unwrap(), 16).unwrap();
        let is_caught = |seed: &u64| {
            let audit =
                Audit::new(0.01, std::array::from_fn(|index| seed.to_le_bytes()[index % 8]));
            // One in twenty of all tiles; which is all the same, since lots are drawn for each.
            let lies = (0..10_000).step_by(20).map(|number| grid.tile(number).unwrap());
            lies.into_iter().any(|tile| audit.chooses(JobId(1), tile, WorkerId(1), false))
        };
        let caught = (0..SEEDS).filter(is_caught).count() as f64 / SEEDS as f64;
        eprintln!("{caught}");
        // 1 - 0.99^500.
        assert!((0.990..0.997).contains(&caught), "{caught}");
    }

    #[test]
    fn what_a_liar_said_of_tiles_counts_no_more() {
        const JOB: JobId = JobId(1);
        let grid = TileGrid::new(Size::new(32, 16).unwrap(), 16).unwrap();
        let [first, second] = [0, 1].map(|number| grid.tile(number).unwrap());
        let [liar, honest] = [(1, 1), (2, 2)]
            .map(|(worker, hash)| Rendering { worker: WorkerId(worker), hash: [hash; 32] });
        let mut audit = Audit::new(1.0, [3; 32]);
        // Of the first tile the liar's is in the picture, of the second the other's.
        audit.begin(JOB, first, liar);
        assert_eq!(audit.on_copy(JOB, second, honest, liar), Finding::Dispute);
        audit.on_quarantine(liar.worker);
        let left: Vec<_> = audit.of(JOB).collect();
        assert_eq!(left, [(second, false, vec![honest.worker])]);
        audit.check(|_| true);
    }

    #[test]
    fn one_percent_is_compared_and_the_first_of_each_worker_or_nothing() {
        let grid = TileGrid::new(Size::new(16_000, 1600).unwrap(), 16).unwrap();
        let tiles = || (0..grid.count()).map(|number| grid.tile(number).unwrap());
        let [some, none] = [0.01, 0.0].map(|fraction| Audit::new(fraction, [3; 32]));
        let chosen = |audit: &Audit, first| {
            tiles().filter(|&tile| audit.chooses(JobId(1), tile, WorkerId(1), first)).count()
        };
        assert!((900..1100).contains(&chosen(&some, false)), "{}", chosen(&some, false));
        assert_eq!(chosen(&some, true), 100_000);
        assert_eq!((chosen(&none, false), chosen(&none, true)), (0, 0));
    }
}
