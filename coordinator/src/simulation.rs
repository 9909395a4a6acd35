//! A farm of processes that die, stall, and deliver late, twice or never; of clients that cancel;
//! of a coordinator that is killed
//! and started anew; of a disk that takes its time and may fail: the real machine under a clock and a network of
//! its own. A seed says all that happens.

use std::{
    collections::{BTreeMap, BTreeSet, VecDeque},
    time::{Duration, Instant},
};

use rtfarm_core::{
    render::Tally,
    tile::{Size, TileGrid, TileId},
};
use rtfarm_job::Outcome;
use rtfarm_proto::{Incarnation, JobId, LeaseId, LeaseName, Renewal, WorkerId};

use crate::{
    farm::{Action, Delivery, DeliveryId, Farm, Next, Notice, Verdict},
    identity::Identity,
    members::Process,
    tiles::{PixelHash, Tiles},
    waiting::{Ask, AskId},
};

const TERM: Duration = Duration::from_secs(4);
const LONGEST_WAIT: u64 = 10_000;
const SEEDS: u64 = 500;

/// Pictures that clients order, and the tiles of each.
const JOBS: usize = 3;
const TILES: usize = 7 * 5;

/// How often the coordinator may be killed.
const RESTARTS: u32 = 2;

/// Every job is rendered within so many steps, or never will be.
const STEPS: usize = 100_000;

/// Steele, Lea & Flood, "Fast Splittable Pseudorandom Number Generators" (2014).
struct SplitMix64(u64);

impl SplitMix64 {
    fn below(&mut self, end: u64) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        (z ^ (z >> 31)) % end
    }

    fn one_in(&mut self, n: u64) -> bool {
        self.below(n) == 0
    }

    fn milliseconds_below(&mut self, end: u64) -> Duration {
        Duration::from_millis(self.below(end))
    }
}

/// Another identity for each start of the farm.
fn identity(seed: u64, start: u32) -> Identity {
    let mut random = SplitMix64(seed ^ u64::from(start) << 32);
    Identity::from_random([(); 24].map(|()| random.below(256) as u8))
}

/// What the pixels of a tile hash to in a job that shows `scene`.
fn pixel_hash(scene: u8, tile: TileId) -> PixelHash {
    let mut hash = [scene; 32];
    hash[0] = tile.number() as u8;
    hash
}

/// A process that renders, and its misfortunes.
struct Renderer {
    worker: WorkerId,
    /// The start of the farm that it has joined.
    incarnation: Incarnation,
    /// Tiles to be rendered, and what their scenes show.
    queue: VecDeque<(LeaseName, TileId, u8)>,
    /// Tiles that it has rendered: a counter that rises under every lease.
    work: u64,
    /// Its question, while it waits.
    ask: Option<AskId>,
    stopped_until: Instant,
}

/// A farm, its network, its disk, and what must be true of them.
struct World {
    seed: u64,
    random: SplitMix64,
    now: Instant,
    farm: Farm,
    last_number: u64,
    renderers: Vec<Renderer>,
    most_renderers: usize,
    /// Pixels under way: when they arrive, and which start of the farm they are meant for.
    post: Vec<(Instant, Incarnation, Delivery)>,
    /// Pixels being written: when that is done.
    disk: Vec<(Instant, JobId, TileId)>,
    /// Questions without an answer, and until when they wait.
    asks: BTreeMap<AskId, Instant>,
    /// Who asked each question.
    workers: BTreeMap<AskId, WorkerId>,
    /// Deliveries without an answer, and their tiles.
    deliveries: BTreeMap<DeliveryId, (JobId, TileId)>,
    /// The hashes of all pixels that came.
    brought: BTreeMap<DeliveryId, PixelHash>,
    /// What clients ordered, and what each job shows: no two the same.
    jobs: BTreeMap<JobId, u8>,
    /// Tiles of which pixels came that make no sense, and who brought the last.
    senseless: BTreeMap<(JobId, TileId), WorkerId>,
    nonsense_count: u32,
    /// Every tile that a worker was to render under a lease.
    granted: BTreeSet<(WorkerId, LeaseName, TileId)>,
    restart_count: u32,
    scene_count: u8,
    forgotten: BTreeSet<JobId>,
    outcomes: BTreeMap<JobId, Outcome>,
    /// Tiles whose pixels were written, and how often.
    picture: BTreeMap<(JobId, TileId), u32>,
    /// Tiles that the log calls finished.
    logged: BTreeSet<(JobId, TileId)>,
    has_stopped: bool,
}

impl World {
    fn new(seed: u64) -> Self {
        #[expect(clippy::disallowed_methods, reason = "any instant will do")]
        let now = Instant::now();
        Self {
            seed,
            random: SplitMix64(seed),
            now,
            farm: Farm::new(identity(seed, 0), TERM),
            last_number: 0,
            renderers: Vec::new(),
            most_renderers: 1 + (seed % 5) as usize,
            post: Vec::new(),
            disk: Vec::new(),
            asks: BTreeMap::new(),
            workers: BTreeMap::new(),
            deliveries: BTreeMap::new(),
            brought: BTreeMap::new(),
            jobs: BTreeMap::new(),
            granted: BTreeSet::new(),
            senseless: BTreeMap::new(),
            nonsense_count: 0,
            restart_count: 0,
            scene_count: 0,
            forgotten: BTreeSet::new(),
            outcomes: BTreeMap::new(),
            picture: BTreeMap::new(),
            logged: BTreeSet::new(),
            has_stopped: false,
        }
    }

    fn number(&mut self) -> u64 {
        self.last_number += 1;
        self.last_number
    }

    fn join(&mut self) -> WorkerId {
        let (nonce, threads) = (self.number(), 1 + self.random.below(3) as usize);
        let process = Process { nonce, number: nonce as u32, threads, ..Process::default() };
        self.farm.on_join(process, self.now).0
    }

    /// Does what the machine says, as the shell does.
    fn act(&mut self, actions: Vec<Action>) {
        for action in actions {
            match action {
                Action::Answer(ask, answer) => {
                    self.asks.remove(&ask).expect("a question is answered once");
                    if let (Some(worker), Ok(Next::Render(run))) =
                        (self.workers.remove(&ask), &answer)
                    {
                        let tiles = run.tiles.iter();
                        self.granted.extend(tiles.map(|&tile| (worker, run.lease, tile)));
                    }
                    let waits = |renderer: &&mut Renderer| renderer.ask == Some(ask);
                    let Some(renderer) = self.renderers.iter_mut().find(waits) else { continue };
                    renderer.ask = None;
                    match answer {
                        // One answer in ten is lost on its way.
                        Ok(Next::Render(run)) if !self.random.one_in(10) => {
                            assert!(!run.tiles.is_empty());
                            let tiles = run.tiles.into_iter();
                            let scene = self.jobs[&run.lease.job];
                            renderer.queue.extend(tiles.map(|tile| (run.lease, tile, scene)));
                        }
                        Ok(_) => {}
                        Err(_) => renderer.worker = WorkerId(0),
                    }
                }
                Action::Store(delivery, job, tile) => {
                    assert_eq!(self.deliveries[&delivery], (job, tile));
                    let shown = self.brought[&delivery];
                    assert_eq!(shown, pixel_hash(self.jobs[&job], tile), "of another picture");
                    let end = self.now + self.random.milliseconds_below(500);
                    self.disk.push((end, job, tile));
                }
                Action::Acknowledge(delivery, verdict) => {
                    let tile = self.deliveries.remove(&delivery);
                    let tile = tile.expect("a delivery is answered once");
                    let is_safe = self.picture.contains_key(&tile);
                    assert!(verdict == Verdict::Rejected || is_safe, "{tile:?} is not safe");
                }
                Action::Publish(job, progress) => {
                    assert!(!self.outcomes.contains_key(&job), "job {job} has ended");
                    self.outcomes.extend(progress.outcome.map(|outcome| (job, outcome)));
                }
                Action::Forget(job) => assert!(self.forgotten.insert(job)),
                Action::Log(Notice::TileDone { delivery, .. }) => {
                    assert!(self.logged.insert((delivery.lease.job, delivery.tile)));
                }
                Action::Log(Notice::CopiesDiffer { .. }) => panic!("tiles are deterministic"),
                Action::Log(_) => {}
                Action::Stop => self.has_stopped = true,
            }
        }
    }

    /// Time passes for machine, network and disk.
    fn pass(&mut self) {
        self.now += self.random.milliseconds_below(300);
        if self.farm.next_wake().is_some_and(|wake| wake <= self.now) {
            let actions = self.farm.on_time(self.now);
            self.act(actions);
        }
        assert!(self.farm.next_wake().is_none_or(|wake| wake > self.now), "it spins");
        assert!(self.asks.values().all(|&until| until > self.now), "a wait is too long");

        let now = self.now;
        let written: Vec<_> = self.disk.extract_if(.., |(end, ..)| *end <= now).collect();
        for (_, job, tile) in written {
            let actions = if self.random.one_in(1000) {
                self.farm.on_store_failed(job, "the disk is full".to_owned())
            } else {
                *self.picture.entry((job, tile)).or_default() += 1;
                self.farm.on_stored(job, tile, now)
            };
            self.act(actions);
        }
        self.let_strangers_deliver();
        let arrived: Vec<_> = self.post.extract_if(.., |(arrival, ..)| *arrival <= now).collect();
        for (_, incarnation, delivery) in arrived {
            if !self.is_admitted(incarnation) {
                continue;
            }
            let id = DeliveryId(self.number());
            self.deliveries.insert(id, (delivery.lease.job, delivery.tile));
            self.brought.insert(id, delivery.hash);
            let actions = self.farm.on_pixels(id, delivery, now);
            self.act(actions);
        }
    }

    /// Somebody brings pixels of his own for a tile, with a worker's name and a lease that do not
    /// belong together, or with the right names and the pixels of another tile's lease.
    fn let_strangers_deliver(&mut self) {
        if !self.random.one_in(10) {
            return;
        }
        let Some(job) = self.jobs.keys().nth(self.random.below(JOBS as u64) as usize).copied()
        else {
            return;
        };
        let Some(tile) = self.farm.tile(job, self.random.below(TILES as u64) as u32) else {
            return;
        };
        let lease = LeaseName { job, id: LeaseId(1 + self.random.below(20)) };
        let worker = WorkerId(self.random.below(6) as u32);
        let tally = Tally::default();
        let delivery = Delivery { worker, lease, tile, hash: [0xee; 32], seconds: 0.1, tally };
        if self.granted.contains(&(worker, lease, tile)) {
            return;
        }
        let id = DeliveryId(self.number());
        self.deliveries.insert(id, (job, tile));
        let actions = self.farm.on_pixels(id, delivery, self.now);
        let rejected = |action: &Action| match action {
            Action::Acknowledge(answered, Verdict::Rejected) => *answered == id,
            Action::Log(Notice::NotGranted { .. }) => true,
            _ => false,
        };
        assert!(actions.iter().all(rejected) && !actions.is_empty(), "{actions:?}");
        self.act(actions);
    }

    /// Clients order pictures of 7 x 5 tiles, and may change their minds.
    fn submit_or_cancel(&mut self) {
        if self.jobs.len() < JOBS && (self.jobs.is_empty() || self.random.one_in(50)) {
            let grid = TileGrid::new(Size::new(7 * 16, 5 * 16).unwrap(), 16).unwrap();
            let job = self.farm.number_job();
            self.scene_count += 1;
            assert_eq!(self.jobs.insert(job, self.scene_count), None, "a number is given twice");
            let actions = self.farm.on_submit(job, Tiles::new(grid), self.now);
            self.act(actions);
        }
        if self.random.one_in(400) {
            let nth = self.random.below(JOBS as u64) as usize;
            let job = self.jobs.keys().nth(nth).copied().unwrap_or(JobId(7));
            let is_known = self.jobs.contains_key(&job) && !self.forgotten.contains(&job);
            let actions = self.farm.on_cancel(job);
            let forgets = actions.iter().any(|action| matches!(action, Action::Forget(_)));
            assert_eq!(forgets, is_known);
            self.act(actions);
        }
    }

    /// Says whether the farm takes a call, and holds it to what it must say.
    fn is_admitted(&mut self, incarnation: Incarnation) -> bool {
        let (admitted, actions) = self.farm.on_call(incarnation);
        assert_eq!(admitted.is_ok(), incarnation == self.farm.incarnation());
        self.act(actions);
        admitted.is_ok()
    }

    /// The coordinator is killed and started anew: connections break, pictures are gone, workers
    /// and their pixels are not.
    fn restart(&mut self) {
        self.restart_count += 1;
        self.farm = Farm::new(identity(self.seed, self.restart_count), TERM);
        self.asks.clear();
        self.deliveries.clear();
        self.disk.clear();
        for renderer in &mut self.renderers {
            renderer.ask = None;
        }
        self.forgotten.extend(self.jobs.keys());
        let outcomes = &self.outcomes;
        self.jobs.retain(|job, _| outcomes.contains_key(job));
    }

    /// One process dies, stalls or works.
    fn work(&mut self) {
        if self.renderers.len() < self.most_renderers {
            let (worker, stopped_until) = (self.join(), self.now);
            let queue = VecDeque::new();
            let incarnation = self.farm.incarnation();
            self.renderers.push(Renderer {
                worker,
                incarnation,
                queue,
                work: 0,
                ask: None,
                stopped_until,
            });
        }
        let index = self.random.below(self.renderers.len() as u64) as usize;
        match self.random.below(40) {
            0 => return self.die(index),
            1 => {
                let terms = self.random.below(4) as u32;
                self.renderers[index].stopped_until = self.now + TERM * terms;
            }
            _ => {}
        }
        let renderer = &mut self.renderers[index];
        if renderer.stopped_until > self.now || renderer.ask.is_some() {
            return;
        }
        if renderer.worker == WorkerId(0) {
            let (worker, incarnation) = (self.join(), self.farm.incarnation());
            let renderer = &mut self.renderers[index];
            (renderer.worker, renderer.incarnation) = (worker, incarnation);
        } else if let Some((lease, tile, scene)) = renderer.queue.pop_front() {
            self.render(index, lease, tile, scene);
        } else {
            let (worker, incarnation) = (renderer.worker, renderer.incarnation);
            if !self.is_admitted(incarnation) {
                self.renderers[index].worker = WorkerId(0);
                return;
            }
            let id = AskId(self.number());
            self.renderers[index].ask = Some(id);
            let until = self.now + self.random.milliseconds_below(LONGEST_WAIT);
            self.asks.insert(id, until);
            self.workers.insert(id, worker);
            let ask = Ask { worker, most: 1 + self.random.below(9) as usize, until };
            let actions = self.farm.on_ask(id, ask, self.now);
            self.act(actions);
        }
    }

    /// Its parent may tell of it, and its connection may break, or nobody notices.
    fn die(&mut self, index: usize) {
        let dead = self.renderers.swap_remove(index);
        if let Some(ask) = dead.ask
            && self.random.one_in(2)
        {
            self.asks.remove(&ask);
            self.farm.on_hang_up(ask);
        }
        if self.random.one_in(2) && self.is_admitted(dead.incarnation) {
            let actions = self.farm.on_leave(dead.worker, "killed", self.now);
            self.act(actions);
        }
    }

    fn render(&mut self, index: usize, lease: LeaseName, tile: TileId, scene: u8) {
        let Renderer { worker, incarnation, .. } = self.renderers[index];
        let tally = Tally::default();
        let hash = pixel_hash(scene, tile);
        let delivery = Delivery { worker, lease, tile, hash, seconds: 0.1, tally };
        if self.random.one_in(200) {
            self.bring_nonsense(worker, incarnation, lease, tile);
            return;
        }
        let copies = [1, 1, 1, 1, 1, 0, 2][self.random.below(7) as usize];
        for _ in 0..copies {
            let is_late = self.random.one_in(10);
            let delay = if is_late { TERM * 3 } else { Duration::from_millis(9) };
            self.post.push((self.now + delay, incarnation, delivery));
        }
        let is_admitted = self.is_admitted(incarnation);
        let Renderer { worker, queue, work, .. } = &mut self.renderers[index];
        if !is_admitted {
            // Another start of the farm: what was to be rendered for the last is of no use.
            queue.clear();
            *worker = WorkerId(0);
            return;
        }
        // Work is done under the lease of the tile, if any of it is left.
        *work += 1;
        let renewals: Vec<Renewal> = queue
            .iter()
            .map(|&(other, ..)| Renewal {
                lease: other,
                work: if other == lease { *work } else { 0 },
            })
            .collect();
        if let Ok(lost) = self.farm.on_renew(*worker, &renewals, self.now) {
            queue.retain(|(lease, ..)| !lost.contains(lease));
        } else {
            queue.clear();
            *worker = WorkerId(0);
        }
    }

    /// Pixels that make no sense end a job only if another worker brought such pixels of the tile,
    /// or there is no other worker.
    fn bring_nonsense(
        &mut self,
        worker: WorkerId,
        incarnation: Incarnation,
        lease: LeaseName,
        tile: TileId,
    ) {
        if !self.is_admitted(incarnation) {
            return;
        }
        let actions = self.farm.on_senseless_pixels(worker, lease, tile, "it is NaN", self.now);
        let ends = actions.iter().any(|action| match action {
            Action::Publish(_, progress) => progress.outcome.is_some(),
            _ => false,
        });
        let earlier = self.senseless.insert((lease.job, tile), worker);
        assert!(!ends || earlier.is_some(), "one worker's nonsense ended a job");
        self.nonsense_count += u32::from(!actions.is_empty());
        self.act(actions);
    }

    /// Renders until every job has ended.
    fn run(&mut self) {
        for _ in 0..STEPS {
            self.pass();
            self.submit_or_cancel();
            if self.restart_count < RESTARTS && self.random.one_in(300) {
                self.restart();
            }
            self.work();
            self.farm.check();
            if self.outcomes.len() == JOBS {
                return;
            }
        }
        panic!("no end");
    }

    /// Stops the farm, until nobody waits for anything any more.
    fn shut_down(&mut self) {
        let actions = self.farm.on_shut_down(self.now);
        self.act(actions);
        let stopped_by = self.now + Duration::from_secs(2);
        while self.now < stopped_by || !self.disk.is_empty() || !self.post.is_empty() {
            self.pass();
            self.farm.check();
        }
        assert!(self.has_stopped);
        assert!(self.asks.is_empty() && self.deliveries.is_empty(), "somebody still waits");
    }
}

/// So that a seed that fails can be run again.
impl Drop for World {
    fn drop(&mut self) {
        if std::thread::panicking() {
            eprintln!("seed {}", self.seed);
        }
    }
}

#[test]
fn every_job_ends_and_every_tile_is_stitched_once_though_everything_goes_wrong() {
    let [mut finished, mut failed, mut cancelled, mut restarts, mut nonsense] = [0; 5];
    for seed in 0..SEEDS {
        let mut world = World::new(seed);
        world.run();
        world.shut_down();
        restarts += world.restart_count;
        nonsense += world.nonsense_count;
        assert!(world.picture.values().all(|&count| count == 1));
        for (job, outcome) in &world.outcomes {
            let stored = world.picture.keys().filter(|(stored, _)| stored == job).count();
            let logged = world.logged.iter().filter(|(logged, _)| logged == job).count();
            match outcome {
                Outcome::Finished(_) => {
                    assert_eq!((stored, logged), (TILES, TILES));
                    finished += 1;
                }
                Outcome::Failed(reason) => {
                    assert!(logged < TILES && logged <= stored);
                    *(if reason == "it was cancelled" { &mut cancelled } else { &mut failed }) += 1;
                }
            }
        }
    }
    let ends = [finished, failed, cancelled, restarts, nonsense];
    assert!(ends.iter().all(|&count| count > 20), "each end is met: {ends:?}");
}
