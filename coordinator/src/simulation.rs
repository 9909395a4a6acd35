//! A farm of processes that die, stall, lie, and deliver late, twice or never; of clients that
//! cancel; of a coordinator that is killed and started anew; of a disk that takes its time and may
//! fail: the real machine under a clock and a network of its own. A seed says all that happens.

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
    audit::Audit,
    farm::{Action, Delivery, DeliveryId, Earlier, Farm, Next, Notice, Terms, Verdict},
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
pub(crate) struct SplitMix64(pub(crate) u64);

impl SplitMix64 {
    pub(crate) fn below(&mut self, end: u64) -> u64 {
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

/// What compares all tiles in every other farm.
fn audit(seed: u64) -> Audit {
    Audit::new((seed % 2) as f64, [7; 32])
}

fn grid() -> TileGrid {
    TileGrid::new(Size::new(7 * 16, 5 * 16).unwrap(), 16).unwrap()
}

/// What the pixels of a tile hash to in a job that shows `scene`.
fn pixel_hash(scene: u8, tile: TileId) -> PixelHash {
    let mut hash = [scene; 32];
    hash[0] = tile.number() as u8;
    hash
}

/// What a liar says of them: no two liars say the same.
fn lie(liar: WorkerId, honest: PixelHash) -> PixelHash {
    let mut hash = honest;
    hash[28..].copy_from_slice(&(1 << 31 | liar.0).to_le_bytes());
    hash
}

/// A process that renders, and its misfortunes.
struct Renderer {
    worker: WorkerId,
    /// The start of the farm that it has joined.
    incarnation: Incarnation,
    nonce: u64,
    /// It lies of every third tile.
    is_liar: bool,
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
    /// Pixels being written: when that is done, and which.
    disk: Vec<(Instant, JobId, TileId, PixelHash)>,
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
    /// The same of all jobs that there ever were.
    shown: BTreeMap<JobId, u8>,
    /// Tiles of which pixels came that make no sense, and who brought the last.
    senseless: BTreeMap<(JobId, TileId), WorkerId>,
    nonsense_count: u32,
    /// Every tile that a worker was to render under a lease.
    granted: BTreeSet<(WorkerId, LeaseName, TileId)>,
    restart_count: u32,
    /// Liars that have joined so far, and under which names.
    liar_count: u64,
    liars: BTreeSet<WorkerId>,
    caught_count: u32,
    /// Nobody was there to compare, at some time.
    was_without_audit: bool,
    /// Jobs that have tiles which were not compared.
    not_compared: BTreeSet<JobId>,
    scene_count: u8,
    forgotten: BTreeSet<JobId>,
    outcomes: BTreeMap<JobId, Outcome>,
    /// Tiles whose pixels were written, unless they were taken back, and what was written.
    picture: BTreeMap<(JobId, TileId), Vec<PixelHash>>,
    /// Tiles that the log calls finished.
    logged: BTreeSet<(JobId, TileId)>,
    /// Tiles that were in work when too many workers were lost.
    set_aside: BTreeSet<(JobId, TileId)>,
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
            farm: Farm::new(identity(seed, 0), TERM, audit(seed)),
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
            shown: BTreeMap::new(),
            granted: BTreeSet::new(),
            senseless: BTreeMap::new(),
            nonsense_count: 0,
            restart_count: 0,
            liar_count: 0,
            liars: BTreeSet::new(),
            caught_count: 0,
            was_without_audit: false,
            not_compared: BTreeSet::new(),
            scene_count: 0,
            forgotten: BTreeSet::new(),
            outcomes: BTreeMap::new(),
            picture: BTreeMap::new(),
            logged: BTreeSet::new(),
            set_aside: BTreeSet::new(),
            has_stopped: false,
        }
    }

    fn number(&mut self) -> u64 {
        self.last_number += 1;
        self.last_number
    }

    /// A process joins, unless it is kept out.
    fn join(&mut self, nonce: u64, is_liar: bool) -> Option<WorkerId> {
        let threads = 1 + self.random.below(3) as usize;
        let process = Process { nonce, number: nonce as u32, threads, ..Process::default() };
        let worker = self.farm.on_join(process, self.now).0;
        assert!(is_liar || worker.is_ok(), "an honest worker is kept out");
        if let Ok(worker) = worker
            && is_liar
        {
            self.liars.insert(worker);
        }
        worker.ok()
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
                    let (shown, honest) =
                        (self.brought[&delivery], pixel_hash(self.jobs[&job], tile));
                    assert_eq!(shown[..28], honest[..28], "of another picture");
                    let end = self.now + self.random.milliseconds_below(500);
                    self.disk.push((end, job, tile, shown));
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
                Action::TakeBack(job, tiles) => {
                    for tile in tiles {
                        assert!(self.picture.remove(&(job, tile)).is_some());
                        assert!(self.logged.remove(&(job, tile)));
                    }
                }
                Action::Forget(job) => assert!(self.forgotten.insert(job)),
                Action::Log(Notice::TileDone { delivery, .. }) => {
                    assert!(self.logged.insert((delivery.lease.job, delivery.tile)));
                }
                Action::Log(Notice::SetAside(job, tile)) => {
                    self.set_aside.insert((job, tile));
                }
                Action::Log(Notice::CopiesDiffer { second, first }) => {
                    let is_lie = |worker| self.liars.contains(&worker);
                    assert!(is_lie(second.worker) || is_lie(first.worker), "who is honest agrees");
                }
                Action::Log(Notice::Liar { worker, .. }) => {
                    assert!(self.liars.contains(&worker), "worker {worker} is honest");
                    self.caught_count += 1;
                }
                Action::Log(Notice::TakenBack { worker, .. }) => {
                    assert!(self.liars.contains(&worker));
                }
                Action::Log(Notice::NoAudit) => self.was_without_audit = true,
                Action::Log(Notice::NotCompared(job, _)) => {
                    self.not_compared.insert(job);
                }
                Action::Log(_) | Action::KeepMarks(_) => {}
                Action::Reopen(_) | Action::Keep(..) => panic!("nobody changes jobs here"),
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
        for (_, job, tile, shown) in written {
            let actions = if self.random.one_in(1000) {
                self.farm.on_store_failed(job, "the disk is full".to_owned(), self.now)
            } else {
                self.picture.entry((job, tile)).or_default().push(shown);
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
            let job = self.farm.number_job();
            self.scene_count += 1;
            assert_eq!(self.jobs.insert(job, self.scene_count), None, "a number is given twice");
            self.shown.insert(job, self.scene_count);
            let actions = self.farm.on_submit(job, Tiles::new(grid()), self.now);
            self.act(actions);
        }
        if self.random.one_in(400) {
            let nth = self.random.below(JOBS as u64) as usize;
            let job = self.jobs.keys().nth(nth).copied().unwrap_or(JobId(7));
            let is_known = self.jobs.contains_key(&job) && !self.forgotten.contains(&job);
            let actions = self.farm.on_cancel(job, self.now);
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

    /// The coordinator is killed and started anew: connections break, workers and their pixels
    /// stay. It may have kept jobs and pictures, or they are gone.
    fn restart(&mut self) {
        self.restart_count += 1;
        let identity = identity(self.seed, self.restart_count);
        let keeps_jobs = self.random.one_in(2) && !self.jobs.is_empty();
        self.farm = match self.shown.keys().last() {
            Some(&last) if keeps_jobs => Farm::keeping_jobs(identity, TERM, audit(self.seed), last),
            _ => Farm::new(identity, TERM, audit(self.seed)),
        };
        self.liars.clear();
        self.asks.clear();
        self.deliveries.clear();
        self.disk.clear();
        for renderer in &mut self.renderers {
            renderer.ask = None;
        }
        if !keeps_jobs {
            self.forgotten.extend(self.jobs.keys());
            let outcomes = &self.outcomes;
            self.jobs.retain(|job, _| outcomes.contains_key(job));
        }
        // What an earlier start took is not compared any more.
        self.not_compared.extend(self.jobs.keys());
        for id in self.jobs.keys().copied().collect::<Vec<JobId>>() {
            if self.outcomes.contains_key(&id) {
                self.forgotten.insert(id);
                continue;
            }
            let mut tiles = Tiles::new(grid());
            for (&(_, tile), written) in self.picture.iter().filter(|((job, _), _)| *job == id) {
                tiles.set_done(tile, written[0]);
            }
            self.set_aside.retain(|(job, _)| *job != id);
            let actions =
                self.farm.on_order(id, tiles, Earlier::default(), Terms::default(), self.now);
            self.act(actions);
        }
    }

    /// One process dies, stalls or works.
    fn work(&mut self) {
        if self.renderers.len() < self.most_renderers {
            let nonce = self.number();
            // Most are honest.
            let is_liar = self.most_renderers > 3 && self.liar_count * 3 < nonce.isqrt();
            self.liar_count += u64::from(is_liar);
            let worker = self.join(nonce, is_liar).expect("it is new");
            self.renderers.push(Renderer {
                worker,
                incarnation: self.farm.incarnation(),
                nonce,
                is_liar,
                queue: VecDeque::new(),
                work: 0,
                ask: None,
                stopped_until: self.now,
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
            let Renderer { nonce, is_liar, .. } = *renderer;
            let Some(worker) = self.join(nonce, is_liar) else {
                return drop(self.renderers.swap_remove(index));
            };
            let renderer = &mut self.renderers[index];
            (renderer.worker, renderer.incarnation) = (worker, self.farm.incarnation());
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
        let Renderer { worker, incarnation, is_liar, .. } = self.renderers[index];
        let tally = Tally::default();
        let honest = pixel_hash(scene, tile);
        let hash =
            if is_liar && tile.number().is_multiple_of(3) { lie(worker, honest) } else { honest };
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
            .map(|&(other, next, _)| {
                let tiles = if other == lease { vec![(next.number(), *work)] } else { Vec::new() };
                Renewal { lease: other, work: 0, tiles }
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
            Action::Log(Notice::JobFailed(_, reason)) => reason.contains("it is NaN"),
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
    let [mut caught, mut set_aside, mut compared] = [0; 3];
    for seed in 0..SEEDS {
        let mut world = World::new(seed);
        world.run();
        world.shut_down();
        restarts += world.restart_count;
        nonsense += world.nonsense_count;
        caught += world.caught_count;
        set_aside += world.set_aside.len() as u32;
        assert!(world.picture.values().all(|written| written.len() == 1));
        for (job, outcome) in &world.outcomes {
            let stored = world.picture.keys().filter(|(stored, _)| stored == job).count();
            let logged = world.logged.iter().filter(|(logged, _)| logged == job).count();
            match outcome {
                Outcome::Finished(_) => {
                    assert_eq!((stored, logged), (TILES, TILES));
                    finished += 1;
                    let was_compared =
                        !world.was_without_audit && !world.not_compared.contains(job);
                    if seed % 2 == 1 && was_compared {
                        let of_job = world.picture.iter().filter(|((of, _), _)| of == job);
                        for ((_, tile), written) in of_job {
                            assert_eq!(written[0], pixel_hash(world.shown[job], *tile));
                        }
                        compared += 1;
                    }
                }
                Outcome::Failed(reason) => {
                    assert!(logged <= stored);
                    *(if reason == "it was cancelled" { &mut cancelled } else { &mut failed }) += 1;
                }
            }
        }
    }
    let ends = [finished, failed, cancelled, restarts, nonsense, caught, set_aside, compared];
    eprintln!("{ends:?}");
    assert!(ends.iter().all(|&count| count > 20), "each end is met: {ends:?}");
}
