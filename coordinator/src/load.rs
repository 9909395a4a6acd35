//! What the machine alone costs, in farms of 10 and of 10,000 workers that all have tiles.
//!
//! `cargo test --release -p rtfarm-coordinator load -- --ignored --nocapture` prints events a
//! second; `valgrind --tool=callgrind --toggle-collect='*::bring_and_ask'` before the test's
//! program and one test's name counts the instructions of its 100,000 tiles.

use std::time::{Duration, Instant};

use rtfarm_core::{
    render::Tally,
    tile::{Size, TileGrid},
};
use rtfarm_job::Progress;
use rtfarm_proto::{Renewal, WorkerId};

use crate::{
    audit::Audit,
    farm::{Action, Delivery, DeliveryId, Farm, Next},
    identity::Identity,
    lease::Run,
    members::Process,
    tiles::Tiles,
    waiting::{Ask, AskId},
};

/// Tiles in a lease.
const RUN: usize = 16;

const TILES: u32 = 100_000;

#[expect(clippy::disallowed_methods, reason = "this measures")]
fn now() -> Instant {
    Instant::now()
}

struct World {
    farm: Farm,
    now: Instant,
    number: u64,
    events: u32,
    progress: Progress,
}

impl World {
    fn number(&mut self) -> u64 {
        self.number += 1;
        self.number
    }

    /// Does what the shell does with answers: little.
    fn act(&mut self, actions: Vec<Action>) -> Option<Run> {
        self.events += 1;
        let mut answer = None;
        for action in actions {
            match action {
                Action::Answer(_, Ok(Next::Render(run))) => answer = Some(run),
                Action::Publish(_, progress) => self.progress = progress,
                _ => {}
            }
        }
        answer
    }

    fn ask(&mut self, worker: WorkerId) -> Run {
        let id = AskId(self.number());
        let until = self.now + Duration::from_secs(10);
        let actions = self.farm.on_ask(id, Ask { worker, most: RUN, until }, self.now);
        self.act(actions).expect("there are tiles")
    }

    /// What is counted.
    #[inline(never)]
    fn bring_and_ask(&mut self, worker: WorkerId, run: &Run) -> Run {
        self.step(worker, run)
    }

    /// Brings what a worker has and gets it new tiles.
    fn step(&mut self, worker: WorkerId, run: &Run) -> Run {
        self.now += Duration::from_micros(100);
        let renewal = Renewal { lease: run.lease, work: self.number, tiles: Vec::new() };
        self.farm.on_renew(worker, &[renewal], self.now).expect("it is a member");
        self.events += 1;
        for &tile in &run.tiles {
            let (lease, hash, tally) = (run.lease, [7; 32], Tally::default());
            let delivery = Delivery { worker, lease, tile, hash, seconds: 0.1, tally };
            let id = DeliveryId(self.number());
            let actions = self.farm.on_pixels(id, delivery, self.now);
            self.act(actions);
            let actions = self.farm.on_stored(lease.job, tile, self.now);
            self.act(actions);
        }
        std::hint::black_box(self.farm.next_wake());
        self.ask(worker)
    }
}

/// Has so many workers bring 100,000 tiles.
fn measure(workers: u64) {
    let identity = Identity::from_random([1; 24]);
    let now_at_first = now();
    let mut world = World {
        farm: Farm::new(identity, Duration::from_secs(60), Audit::new(0.0, [0; 32])),
        now: now_at_first,
        number: 0,
        events: 0,
        progress: Progress::default(),
    };
    let grid = TileGrid::new(Size::new(16_384, 16_384).unwrap(), 16).unwrap();
    let job = world.farm.number_job();
    world.farm.on_submit(job, Tiles::new(grid), world.now);
    let mut runs: Vec<(WorkerId, Run)> = (0..workers)
        .map(|nonce| {
            let process = Process { nonce, threads: 1, ..Process::default() };
            let worker = world.farm.on_join(process, world.now).0.expect("it is let in");
            (worker, world.ask(worker))
        })
        .collect();
    // The first lease of a worker is short, since its speed is not known.
    for (worker, run) in &mut runs {
        *run = world.step(*worker, run);
    }
    let (started, events_before) = (now(), world.events);
    let tiles_before = world.progress.tiles_done;
    let mut turns = (0..workers as usize).cycle();
    while world.progress.tiles_done < tiles_before + TILES {
        let (worker, run) = &mut runs[turns.next().expect("they go round")];
        *run = world.bring_and_ask(*worker, run);
    }
    let (seconds, events) = (started.elapsed().as_secs_f64(), world.events - events_before);
    let tiles = world.progress.tiles_done - tiles_before;
    assert_eq!(tiles, TILES.next_multiple_of(RUN as u32));
    eprintln!(
        "{workers} workers: {events} events in {seconds:.3} s, {:.0} events/s, {:.2} us a tile",
        f64::from(events) / seconds,
        seconds * 1e6 / f64::from(tiles)
    );
}

#[test]
#[ignore = "it measures for some seconds, which tells something in a release build only"]
fn load_of_10_workers() {
    measure(10);
}

#[test]
#[ignore = "it measures for some seconds, which tells something in a release build only"]
fn load_of_10000_workers() {
    measure(10_000);
}
