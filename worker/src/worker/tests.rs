//! A worker's life under a simulated clock, with a coordinator played by hand or by chance.

use std::collections::BTreeSet;

use rtfarm_core::{
    render::{Quality, Settings, Tally},
    tile::{Size, TileGrid},
};
use rtfarm_proto::{FarmId, Incarnation, JobId, LONGEST_WAIT, TileHasher, WorkerId, wire};

use super::*;

const TERM: Duration = Duration::from_secs(4);
const PATIENCE: Duration = Duration::from_secs(30);

#[expect(clippy::disallowed_methods, reason = "any instant will do")]
fn start() -> Instant {
    Instant::now()
}

fn lease(number: u64) -> LeaseName {
    wire::LeaseName { job: 1, id: number }.into()
}

/// A worker's membership of an incarnation that has the same number.
fn member(number: u32) -> Membership {
    Membership { worker: WorkerId(number), incarnation: Incarnation(number.into()) }
}

fn grid() -> TileGrid {
    TileGrid::new(Size::new(160, 160).unwrap(), 16).unwrap()
}

fn job(scene: u8) -> Arc<Job> {
    let settings = Settings { size: Size::new(160, 160).unwrap(), quality: Quality::default() };
    Arc::new(Job {
        incarnation: Incarnation(1),
        scene: SceneHash([scene; 32]),
        scene_byte_count: 1,
        scene_path: None,
        settings,
        grid: grid(),
        hasher: TileHasher::new(JobId(1), SceneHash([scene; 32]), settings, grid()),
    })
}

/// `count` tiles of a job with the scene `scene`.
fn run(number: u64, count: u32, scene: u8) -> Answer {
    let tiles = (0..count).map(|tile| grid().tile(tile).unwrap()).collect();
    Answer::Leased(Next::Run(Run { lease: lease(number), tiles, job: job(scene) }))
}

fn delivery(lease: LeaseName, tile: TileId) -> Delivery {
    let pixels = tile.number().to_le_bytes().to_vec().into();
    Delivery { lease, tile, pixels, hash: [0; 32], tally: Tally::default(), seconds: 1.0 }
}

fn no_answer() -> CallError {
    CallError { kind: CallErrorKind::NoAnswer, message: "no way".to_owned() }
}

fn failure(kind: CallErrorKind) -> CallError {
    CallError { kind, message: "for a reason".to_owned() }
}

fn is_lease(call: &Call) -> bool {
    matches!(call, Call::Lease { .. })
}

fn is_renew(call: &Call) -> bool {
    matches!(call, Call::Renew { .. })
}

fn is_deliver(call: &Call) -> bool {
    matches!(call, Call::Deliver { .. })
}

/// A worker, and what it wants done.
struct Bench {
    worker: Worker,
    threads: usize,
    now: Instant,
    calls: BTreeMap<TaskId, Call>,
    fetches: BTreeMap<TaskId, SceneHash>,
    renderings: BTreeMap<TaskId, (LeaseName, TileId)>,
    /// Renderings that were stopped and have not reported yet.
    stopped: BTreeSet<TaskId>,
    scenes: Vec<SceneHash>,
    beat_period: Option<Duration>,
    exit: Option<Result<(), String>>,
}

impl Bench {
    /// A worker that connects.
    fn new(threads: usize) -> Self {
        Self::with_patience(threads, PATIENCE)
    }

    fn with_patience(threads: usize, patience: Duration) -> Self {
        Self::with(threads, patience, None)
    }

    /// One thread, with so many bytes for scenes.
    fn with_memory(memory: Option<u64>) -> Self {
        Self::with(1, PATIENCE, memory)
    }

    fn with(threads: usize, patience: Duration, memory: Option<u64>) -> Self {
        let config = Config {
            coordinator: Address::Tcp("host:1".to_owned()).into(),
            threads,
            isa: rtfarm_core::isa::Isa::fastest(),
            version: "1".to_owned(),
            build: String::new(),
            reference: None,
            memory,
            patience,
        };
        let now = start();
        let mut bench = Self {
            worker: Worker::new(&config, 7, now),
            threads,
            now,
            calls: BTreeMap::new(),
            fetches: BTreeMap::new(),
            renderings: BTreeMap::new(),
            stopped: BTreeSet::new(),
            scenes: Vec::new(),
            beat_period: None,
            exit: None,
        };
        bench.absorb();
        bench
    }

    /// A worker that has joined and asks for tiles.
    fn joined(threads: usize) -> Self {
        let mut bench = Self::new(threads);
        bench.answer(|call| matches!(call, Call::Connect), Answer::Connected);
        bench.join(1);
        bench
    }

    /// A worker that renders a run of so many tiles.
    fn rendering(threads: usize, tile_count: u32) -> Self {
        let mut bench = Self::joined(threads);
        bench.answer(is_lease, run(1, tile_count, 0));
        bench.fetch();
        bench
    }

    fn join(&mut self, worker: u32) {
        self.join_farm(worker, 1);
    }

    fn join_farm(&mut self, worker: u32, farm: u8) {
        let joined =
            Answer::Joined { member: member(worker), farm: FarmId([farm; 16]), term: TERM };
        self.answer(|call| matches!(call, Call::Join), joined);
    }

    /// A call that waits for its answer.
    fn asked(&self, is_it: fn(&Call) -> bool) -> Call {
        self.calls.values().find(|call| is_it(call)).expect("it is asked").clone()
    }

    /// Takes the worker's actions, and checks what always holds.
    fn absorb(&mut self) {
        while let Some(action) = self.worker.next_action() {
            assert_eq!(self.exit, None, "nothing comes after the end, but {action:?}");
            match action {
                Action::Call(task, call) => drop(self.calls.insert(task, call)),
                Action::Fetch { task, job, .. } => drop(self.fetches.insert(task, job.scene)),
                Action::Render { task, lease, tile, job } => {
                    assert!(self.scenes.contains(&job.scene), "{tile:?} needs its scene");
                    self.renderings.insert(task, (lease, tile));
                }
                Action::Stop(task) => {
                    let is_call = self.calls.remove(&task).is_some();
                    if !is_call && self.fetches.remove(&task).is_none() {
                        assert!(self.renderings.contains_key(&task), "{task:?} is under way");
                        self.stopped.insert(task);
                    }
                }
                Action::ForgetScene(scene) => {
                    let known = self.scenes.iter().position(|&known| known == scene);
                    self.scenes.remove(known.expect("only what is known is forgotten"));
                }
                Action::HearBeats { period } => self.beat_period = Some(period),
                Action::Exit(exit) => self.exit = Some(exit.map_err(|error| error.to_string())),
            }
        }
        let at_hand = self.renderings.len() - self.stopped.len();
        let turn = self.turn();
        assert!(at_hand <= TURNS_AT_HAND * turn * self.threads, "{at_hand} tiles at hand");
        let delivering = self.calls.values().filter(|call| is_deliver(call)).count();
        assert!(delivering <= TURNS_AHEAD * self.threads, "{delivering} messages on their way");
        let deadline = self.worker.wake_at();
        assert!(self.calls.is_empty() || deadline.is_some(), "no call waits for ever");
        if self.exit.is_some() {
            assert!(self.calls.is_empty() && self.fetches.is_empty(), "nothing goes on");
            assert_eq!(self.renderings.len(), self.stopped.len(), "nothing goes on");
        }
    }

    /// The turn of a thread, in tiles.
    fn turn(&self) -> usize {
        if let Stage::Working(member) = &self.worker.stage { member.turn } else { 1 }
    }

    /// Tiles whose pixels are in memory or in the making.
    fn pixels(&self) -> usize {
        let delivered = self.calls.values().map(|call| match call {
            Call::Deliver { tiles, .. } => tiles.len(),
            _ => 0,
        });
        let Stage::Working(member) = &self.worker.stage else { panic!("it does not work") };
        delivered.sum::<usize>() + member.rendered.len() + self.renderings.len()
    }

    fn find(&self, is_it: impl Fn(&Call) -> bool) -> TaskId {
        let found = self.calls.iter().find(|(_, call)| is_it(call)).map(|(&task, _)| task);
        found.unwrap_or_else(|| panic!("not among {:?}", self.calls))
    }

    fn take(&mut self, is_it: impl Fn(&Call) -> bool) -> (TaskId, Call) {
        let task = self.find(is_it);
        (task, self.calls.remove(&task).unwrap())
    }

    fn has(&self, is_it: impl Fn(&Call) -> bool) -> bool {
        self.calls.values().any(is_it)
    }

    /// Answers the first such call.
    fn answer(&mut self, is_it: impl Fn(&Call) -> bool, answer: Answer) -> Call {
        let (task, call) = self.take(is_it);
        self.worker.on_answer(task, answer, self.now);
        self.absorb();
        call
    }

    /// Has the first such call fail.
    fn fail(&mut self, is_it: impl Fn(&Call) -> bool, error: CallError) -> Call {
        let (task, call) = self.take(is_it);
        self.worker.on_call_failed(task, error, self.now);
        self.absorb();
        call
    }

    /// Finishes the first fetch.
    fn fetch(&mut self) {
        let (task, scene) = self.fetches.pop_first().expect("a fetch");
        self.scenes.push(scene);
        self.worker.on_fetched(task, self.now);
        self.absorb();
    }

    /// Finishes the first rendering, or notices that it was stopped.
    fn render(&mut self) -> (LeaseName, TileId) {
        let (&task, &(lease, tile)) = self.renderings.first_key_value().expect("a rendering");
        self.renderings.remove(&task);
        let pixels = (!self.stopped.remove(&task)).then(|| delivery(lease, tile));
        self.worker.on_tiles_rendered(vec![(task, pixels)], self.now);
        self.absorb();
        (lease, tile)
    }

    /// A step that brings the scene of a lease.
    fn beat(&mut self, number: u64) {
        self.worker.on_beat(&BTreeMap::from([((lease(number), None), 1)]), self.now);
        self.absorb();
    }

    /// A step for a tile of a lease.
    fn step(&mut self, number: u64, tile: u32) {
        let tile = grid().tile(tile);
        self.worker.on_beat(&BTreeMap::from([((lease(number), tile), 1)]), self.now);
        self.absorb();
    }

    fn stop(&mut self) {
        self.worker.on_stop(Duration::ZERO, self.now);
        self.absorb();
    }

    /// Lets time pass until the worker wants to be woken.
    fn sleep(&mut self) {
        self.now = self.worker.wake_at().expect("something to wait for");
        self.worker.on_tick(self.now);
        self.absorb();
    }
}

#[test]
fn a_tile_goes_from_its_lease_to_its_delivery() {
    let mut bench = Bench::joined(1);
    assert_eq!(bench.beat_period, Some(TERM / 4));
    let asked = bench.answer(is_lease, run(1, 1, 0));
    let (member, wait) = (member(1), LONGEST_WAIT);
    let most_tiles = LONGEST_RUN_A_THREAD;
    assert_eq!(asked, Call::Lease { member, most_tiles, wait, kept: None });
    assert!(bench.calls.is_empty(), "nothing is asked for while a scene is fetched");
    bench.fetch();
    assert!(bench.has(is_lease), "one tile is too few to go on with");
    let (name, tile) = bench.render();
    let delivered = bench.answer(is_deliver, Answer::Delivered);
    assert_eq!(delivered, Call::Deliver { member, tiles: vec![delivery(name, tile)] });
    assert!(!bench.has(is_deliver));
}

#[test]
fn tiles_are_asked_for_before_the_threads_run_dry() {
    let mut bench = Bench::rendering(2, 9);
    for left in (0..9).rev() {
        bench.render();
        bench.answer(is_deliver, Answer::Delivered);
        assert_eq!(bench.has(is_lease), left < TURNS_AHEAD * 2, "{left} tiles left");
    }
    let Call::Lease { most_tiles, .. } = bench.asked(is_lease) else { panic!() };
    assert_eq!(most_tiles, LONGEST_RUN_A_THREAD * 2);
}

#[test]
fn tiles_are_rendered_in_the_order_in_which_they_came() {
    let mut bench = Bench::rendering(1, 1);
    bench.answer(is_lease, run(2, 5, 0));
    let mut rendered = vec![bench.render()];
    while bench.renderings.values().next().is_some() {
        bench.answer(is_deliver, Answer::Delivered);
        rendered.push(bench.render());
    }
    let tile = |number, tile| (lease(number), grid().tile(tile).unwrap());
    assert_eq!(rendered, [tile(1, 0), tile(2, 0), tile(2, 1), tile(2, 2), tile(2, 3), tile(2, 4)]);
}

#[test]
fn slow_deliveries_stop_the_threads_and_the_asking() {
    let mut bench = Bench::rendering(1, 32);
    let mut rendered = 0;
    while !bench.renderings.is_empty() {
        bench.render();
        rendered += 1;
    }
    assert_eq!(rendered, MOST_TURNS_OF_PIXELS);
    assert!(!bench.has(is_lease));
    bench.answer(is_deliver, Answer::Delivered);
    assert_eq!(bench.renderings.len(), 1, "one out, one in");
}

#[test]
fn small_tiles_are_handed_on_and_delivered_together() {
    let mut bench = Bench::rendering(1, 100);
    let rendered = |bench: &mut Bench, count: usize| -> Vec<Delivery> {
        let begun: Vec<_> = (0..count).filter_map(|_| bench.renderings.pop_first()).collect();
        let small = |&(_, (lease, tile))| Delivery {
            seconds: TURN.as_secs_f64() / 4.5,
            ..delivery(lease, tile)
        };
        let tiles: Vec<Delivery> = begun.iter().map(small).collect();
        let rendered =
            begun.iter().zip(&tiles).map(|(&(task, _), tile)| (task, Some(tile.clone())));
        bench.worker.on_tiles_rendered(rendered.collect(), bench.now);
        tiles
    };
    let first = rendered(&mut bench, 1);
    assert_eq!(bench.turn(), 4);
    bench.absorb();
    assert!(!bench.has(is_lease), "99 tiles are enough");
    assert_eq!(bench.renderings.len(), 4 * TURNS_AT_HAND);
    let more = rendered(&mut bench, 7);
    bench.absorb();
    for tiles in [first, more] {
        let expected = Call::Deliver { member: member(1), tiles };
        assert_eq!(bench.answer(is_deliver, Answer::Delivered), expected);
    }
    while !bench.renderings.is_empty() {
        rendered(&mut bench, 4);
        bench.absorb();
    }
    assert_eq!(bench.pixels(), 4 * MOST_TURNS_OF_PIXELS, "slow deliveries stop the threads");
    while !bench.has(is_lease) {
        if bench.has(is_deliver) {
            bench.answer(is_deliver, Answer::Delivered);
        } else {
            rendered(&mut bench, 1);
            bench.absorb();
        }
    }
    let Stage::Working(member) = &bench.worker.stage else { panic!("it does not work") };
    let left: usize = member.leases.values().map(|held| held.tiles_left).sum();
    assert_eq!(left, TURNS_AHEAD * 4 - 1);
    let Call::Lease { most_tiles, .. } = bench.asked(is_lease) else { panic!() };
    assert_eq!(most_tiles, LONGEST_RUN_IN_TURNS * 4);
}

#[test]
fn a_message_holds_so_many_bytes_and_no_more() {
    for (part, turn) in [(2, 2), (1, 1)] {
        let mut bench = Bench::rendering(1, 3);
        let big = |(lease, tile)| Delivery {
            pixels: vec![0; DELIVERY_BYTES / part].into(),
            seconds: TURN.as_secs_f64() / 10.0,
            ..delivery(lease, tile)
        };
        let begun = std::mem::take(&mut bench.renderings);
        let rendered = begun.into_iter().map(|(task, tile)| (task, Some(big(tile))));
        bench.worker.on_tiles_rendered(rendered.collect(), bench.now);
        assert_eq!(bench.turn(), turn, "quick tiles, but large ones");
        bench.absorb();
        let call = bench.answer(is_deliver, Answer::Delivered);
        let Call::Deliver { tiles, .. } = call else { panic!("{call:?}") };
        assert_eq!(tiles.len(), part);
    }
    let mut bench = Bench::rendering(1, 1);
    let (task, (lease, tile)) = bench.renderings.pop_first().unwrap();
    let pixels = vec![0; DELIVERY_BYTES + 1].into();
    let tile = Delivery { pixels, ..delivery(lease, tile) };
    bench.worker.on_tiles_rendered(vec![(task, Some(tile))], bench.now);
    bench.absorb();
    assert!(bench.has(is_deliver), "a tile that is too large for a message goes alone");
}

#[test]
fn pixels_are_kept_until_they_are_acknowledged() {
    let mut bench = Bench::rendering(1, 1);
    let (name, tile) = bench.render();
    let expected = Call::Deliver { member: member(1), tiles: vec![delivery(name, tile)] };
    for _ in 0..5 {
        assert_eq!(bench.fail(is_deliver, no_answer()), expected);
        assert!(!bench.has(is_deliver), "not at once");
        while !bench.has(is_deliver) {
            bench.sleep();
        }
    }
    bench.answer(is_deliver, Answer::Delivered);
    assert_eq!(bench.exit, None);
}

#[test]
fn progress_is_told_tile_by_tile_one_renewal_at_a_time() {
    let mut bench = Bench::rendering(2, 2);
    bench.answer(is_lease, run(2, 9, 0));
    assert!(!bench.has(is_renew), "time alone renews nothing");
    bench.step(1, 0);
    bench.step(1, 0);
    bench.step(1, 1);
    bench.beat(2);
    let mut check_renewal = |expected: [(u64, &[(u32, u64)]); 2]| {
        let renewed = bench.answer(is_renew, Answer::Renewed { lost: vec![] });
        let renewals = (1..).zip(expected).map(|(number, (work, tiles))| Renewal {
            lease: lease(number),
            work,
            tiles: tiles.to_vec(),
        });
        assert_eq!(renewed, Call::Renew { member: member(1), renewals: renewals.collect() });
    };
    check_renewal([(0, &[(0, 1)]), (0, &[])]);
    check_renewal([(0, &[(0, 2), (1, 1)]), (1, &[])]);
    assert!(!bench.has(is_renew), "nothing new to tell");
    bench.render();
    bench.step(1, 1);
    let renewed = bench.answer(is_renew, Answer::Renewed { lost: vec![] });
    let Call::Renew { renewals, .. } = renewed else { panic!("{renewed:?}") };
    assert_eq!(renewals[0].tiles, [(1, 2)], "what is on its way is told no more");
}

#[test]
fn nothing_is_renewed_without_a_lease() {
    let mut bench = Bench::joined(1);
    bench.beat(1);
    bench.answer(is_lease, run(1, 1, 0));
    assert!(!bench.has(is_renew));
    bench.beat(1);
    assert!(bench.has(is_renew), "a fetch makes progress too");
}

#[test]
fn a_lost_lease_is_rendered_no_further_but_its_pixels_are_delivered() {
    let mut bench = Bench::rendering(1, 9);
    let (name, tile) = bench.render();
    bench.beat(1);
    bench.answer(is_renew, Answer::Renewed { lost: vec![lease(1)] });
    assert_eq!(bench.stopped.len(), TURNS_AT_HAND);
    while !bench.renderings.is_empty() {
        bench.render();
    }
    let delivered = bench.answer(is_deliver, Answer::Delivered);
    assert_eq!(delivered, Call::Deliver { member: member(1), tiles: vec![delivery(name, tile)] });
    assert!(!bench.has(is_deliver) && bench.has(is_lease));
}

#[test]
fn a_lease_lost_while_its_scene_is_fetched_is_not_rendered() {
    let mut bench = Bench::joined(1);
    bench.answer(is_lease, run(1, 9, 0));
    bench.beat(1);
    bench.answer(is_renew, Answer::Renewed { lost: vec![lease(1)] });
    bench.fetch();
    assert!(bench.renderings.is_empty() && bench.has(is_lease));
    bench.answer(is_lease, run(2, 1, 0));
    assert!(bench.fetches.is_empty(), "the scene is there");
    assert_eq!(bench.renderings.len(), 1);
}

#[test]
fn a_scene_is_forgotten_when_another_came_and_no_lease_needs_it() {
    let mut bench = Bench::rendering(1, 1);
    bench.answer(is_lease, run(2, 4, 0));
    while bench.renderings.len() > 1 {
        bench.render();
        bench.answer(is_deliver, Answer::Delivered);
    }
    bench.answer(is_lease, run(3, 7, 1));
    assert_eq!(bench.scenes, [SceneHash([0; 32])]);
    bench.fetch();
    assert_eq!(bench.scenes.len(), 2, "a tile of the first is in work");
    bench.render();
    assert_eq!(bench.scenes, [SceneHash([1; 32])], "the last tile of the first was rendered");
}

#[test]
fn a_scene_that_waiting_tiles_need_is_kept() {
    let mut bench = Bench::rendering(2, 3);
    bench.answer(is_lease, run(2, 7, 0));
    for _ in 0..7 {
        bench.render();
        bench.answer(is_deliver, Answer::Delivered);
    }
    bench.answer(is_lease, run(3, 9, 1));
    bench.fetch();
    bench.render();
    while !bench.renderings.is_empty() {
        if bench.has(is_deliver) {
            bench.answer(is_deliver, Answer::Delivered);
        }
        bench.render();
    }
    assert_eq!(bench.scenes, [SceneHash([1; 32])]);
}

#[test]
fn scenes_are_kept_as_long_as_there_is_memory_and_the_least_recent_goes_first() {
    // A scene of the tests has one byte.
    let mut bench = Bench::with_memory(Some(2));
    bench.answer(|call| matches!(call, Call::Connect), Answer::Connected);
    bench.join(1);
    let mut number = 0;
    let mut render = |bench: &mut Bench, scene| {
        number += 1;
        bench.answer(is_lease, run(number, 1, scene));
        let is_new = !bench.fetches.is_empty();
        if is_new {
            bench.fetch();
        }
        bench.render();
        bench.answer(is_deliver, Answer::Delivered);
        is_new
    };
    assert!(render(&mut bench, 0) && render(&mut bench, 1));
    assert!(!render(&mut bench, 0), "it is there still");
    assert!(render(&mut bench, 2));
    assert_eq!(bench.scenes, [SceneHash([0; 32]), SceneHash([2; 32])]);
    assert!(render(&mut bench, 1));
    assert_eq!(bench.scenes, [SceneHash([2; 32]), SceneHash([1; 32])]);
}

#[test]
fn a_scene_for_which_there_is_no_room_waits_for_the_tiles_of_another() {
    let mut bench = Bench::with_memory(Some(1));
    bench.answer(|call| matches!(call, Call::Connect), Answer::Connected);
    bench.join(1);
    bench.answer(is_lease, run(1, 1, 0));
    bench.fetch();
    bench.answer(is_lease, run(2, 1, 1));
    assert!(bench.fetches.is_empty(), "a tile of the first scene is in work");
    assert!(!bench.has(is_lease));
    bench.render();
    assert!(bench.scenes.is_empty() && bench.fetches.len() == 1);
    bench.fetch();
    assert_eq!(bench.render().0, lease(2));

    bench.answer(is_lease, run(3, 1, 1));
    bench.answer(is_lease, run(4, 1, 2));
    bench.step(3, 0);
    bench.answer(is_renew, Answer::Renewed { lost: vec![lease(4)] });
    assert!(bench.has(is_lease), "who has lost what it waits for asks for something else");
}

#[test]
fn an_unusable_scene_ends_the_worker() {
    let mut bench = Bench::joined(1);
    bench.answer(is_lease, run(1, 9, 0));
    let (task, _) = bench.fetches.pop_first().unwrap();
    bench.worker.on_fetch_failed(task, SceneError::Hash, bench.now);
    bench.absorb();
    let reason = "the prepared scene does not have the hash that the job names".to_owned();
    let left = bench.answer(|call| matches!(call, Call::Leave { .. }), Answer::Left);
    assert_eq!(left, Call::Leave { member: member(1), reason: reason.clone() });
    assert_eq!(bench.exit, Some(Err(reason)));
}

#[test]
fn a_scene_that_is_gone_costs_its_lease_and_not_the_worker() {
    let mut bench = Bench::joined(1);
    bench.answer(is_lease, run(1, 9, 0));
    let (task, _) = bench.fetches.pop_first().unwrap();
    let gone = SceneError::Gone("no job has this scene now".to_owned());
    bench.worker.on_fetch_failed(task, gone, bench.now);
    bench.absorb();
    assert_eq!(bench.exit, None);
    bench.beat(1);
    assert!(!bench.has(is_renew), "the lease is dropped");
    bench.answer(is_lease, run(2, 1, 1));
    bench.fetch();
    assert_eq!(bench.render().0, lease(2));
    assert!(bench.has(is_deliver), "it works on");
}

#[test]
fn a_forgotten_worker_stops_everything_and_joins_again() {
    let mut bench = Bench::rendering(1, 9);
    bench.render();
    let late = bench.find(is_deliver);
    bench.beat(1);
    bench.fail(is_renew, failure(CallErrorKind::NotMember));
    assert_eq!(bench.stopped.len(), bench.renderings.len());
    assert!(bench.scenes.is_empty());
    assert_eq!(bench.calls.values().collect::<Vec<_>>(), [&Call::Join]);
    bench.join_farm(2, 2);
    bench.worker.on_answer(late, Answer::Delivered, bench.now);
    while !bench.renderings.is_empty() {
        bench.render();
    }
    assert!(!bench.has(is_deliver), "nobody waits for what was stopped");
    let asked = bench.answer(is_lease, run(1, 1, 0));
    assert!(matches!(asked, Call::Lease { member: as_now, .. } if as_now == member(2)));
    bench.fetch();
    bench.render();
    assert!(bench.has(is_deliver));
}

#[test]
fn a_coordinator_started_anew_gets_no_pixel_that_was_rendered_for_the_last() {
    let mut bench = Bench::rendering(2, 9);
    bench.render();
    bench.render();
    // One delivery is repeated, one is on its way, when the coordinator says that it is another.
    bench.fail(is_deliver, no_answer());
    bench.fail(is_deliver, failure(CallErrorKind::NotMember));
    bench.join_farm(2, 2);
    while !bench.renderings.is_empty() {
        bench.render();
    }
    // Nobody answers any more, so its patience ends one day.
    while bench.exit.is_none() {
        assert!(!bench.has(is_deliver) && !bench.has(is_renew));
        bench.sleep();
    }
}

#[test]
fn finished_tiles_are_delivered_to_the_same_farm_under_a_new_lease() {
    for is_same in [true, false] {
        let mut bench = Bench::rendering(2, 9);
        let ((_, first), (_, second)) = (bench.render(), bench.render());
        bench.fail(is_deliver, no_answer());
        bench.fail(is_deliver, failure(CallErrorKind::NotMember));
        bench.join_farm(2, if is_same { 1 } else { 2 });
        let Call::Lease { kept, .. } = bench.asked(is_lease) else { unreachable!() };
        let mut tiles = vec![first, second];
        tiles.sort();
        let offered = KeptTiles { job: JobId(1), tiles };
        assert_eq!(kept, is_same.then_some(offered));

        // One of them was leased to another meanwhile.
        let run = Run { lease: lease(7), tiles: vec![second], job: job(0) };
        bench.answer(is_lease, Answer::Leased(Next::Run(run)));
        if is_same {
            let Call::Deliver { tiles, .. } = bench.asked(is_deliver) else { unreachable!() };
            assert_eq!(tiles, [delivery(lease(7), second)]);
            let Call::Lease { kept, .. } = bench.asked(is_lease) else { unreachable!() };
            assert_eq!(kept, None);
            assert!(bench.fetches.is_empty(), "nothing is to be rendered");
        } else {
            assert!(!bench.has(is_deliver) && bench.fetches.len() == 1, "it is rendered anew");
        }
    }
}

#[test]
fn a_coordinator_that_is_not_there_is_sought_as_long_as_patience_lasts() {
    let mut bench = Bench::new(1);
    let begun = bench.now;
    let mut attempts = 0;
    while bench.exit.is_none() {
        if bench.calls.is_empty() {
            bench.sleep();
        } else {
            attempts += 1;
            bench.fail(|_| true, no_answer());
        }
    }
    let waited = bench.now - begun;
    assert!(waited <= PATIENCE && waited + Duration::from_secs(4) > PATIENCE, "{waited:?}");
    assert!((12..=25).contains(&attempts), "{attempts} attempts");
    let reason = "no coordinator answers at http://host:1: no way".to_owned();
    assert_eq!(bench.exit, Some(Err(reason)));
}

#[test]
fn a_silent_coordinator_is_asked_again_and_in_the_end_given_up() {
    let mut bench = Bench::joined(1);
    let begun = bench.now;
    bench.sleep();
    let deadline = LONGEST_WAIT + Duration::from_secs(15);
    assert_eq!(bench.now - begun, deadline);
    while bench.has(is_lease) || !bench.has(|_| true) {
        bench.sleep();
    }
    let waited = bench.now - begun;
    assert!(waited <= PATIENCE && waited + Duration::from_secs(4) > PATIENCE, "{waited:?}");
    let before = bench.now;
    bench.sleep();
    assert_eq!(bench.now - before, Duration::from_secs(1), "nobody hears that it leaves");
    let reason = "the coordinator is gone: it did not answer in time".to_owned();
    assert_eq!(bench.exit, Some(Err(reason)));
}

#[test]
fn a_silent_coordinator_is_given_up_within_patience_though_an_answer_might_take_longer() {
    let patience = Duration::from_secs(3);
    let mut bench = Bench::with_patience(1, patience);
    bench.answer(|call| matches!(call, Call::Connect), Answer::Connected);
    bench.join(1);
    let Call::Lease { wait, .. } = bench.asked(is_lease) else { panic!("tiles are asked for") };
    assert_eq!(wait, patience / 2, "one that has nothing answers in time");
    bench.now += patience / 2;
    bench.answer(is_lease, Answer::Leased(Next::Nothing));
    let begun = bench.now;
    while bench.exit.is_none() {
        bench.sleep();
    }
    let farewell = Duration::from_secs(1);
    assert_eq!(bench.now - begun, patience + farewell);
}

#[test]
fn workers_do_not_all_ask_again_at_once() {
    let config = Config {
        coordinator: Address::Tcp("host:1".to_owned()).into(),
        threads: 1,
        isa: rtfarm_core::isa::Isa::fastest(),
        version: "1".to_owned(),
        build: String::new(),
        reference: None,
        memory: None,
        patience: PATIENCE,
    };
    let now = start();
    let pauses: BTreeSet<Duration> = (0..100)
        .map(|seed| {
            let mut worker = Worker::new(&config, seed, now);
            let Some(Action::Call(task, Call::Connect)) = worker.next_action() else {
                panic!("a worker connects first")
            };
            worker.on_call_failed(task, no_answer(), now);
            worker.wake_at().unwrap() - now
        })
        .collect();
    assert!(pauses.len() > 90, "{pauses:?}");
    let bounds = Duration::from_millis(50)..=Duration::from_millis(100);
    assert!(pauses.iter().all(|pause| bounds.contains(pause)), "{pauses:?}");
}

#[test]
fn a_refused_worker_ends_at_once() {
    for (kind, reason) in [
        (CallErrorKind::Refused, "the coordinator refuses this worker: for a reason"),
        (CallErrorKind::Forbidden, "the coordinator refuses this worker: for a reason"),
        (CallErrorKind::Other, "the coordinator is gone: for a reason"),
        (CallErrorKind::NotMember, "the coordinator is gone: for a reason"),
    ] {
        let mut bench = Bench::new(1);
        bench.answer(|call| matches!(call, Call::Connect), Answer::Connected);
        bench.fail(|call| matches!(call, Call::Join), failure(kind));
        assert_eq!(bench.exit, Some(Err(reason.to_owned())));
    }
    let mut bench = Bench::joined(1);
    bench.fail(is_lease, failure(CallErrorKind::Forbidden));
    bench.fail(|call| matches!(call, Call::Leave { .. }), failure(CallErrorKind::Forbidden));
    let reason = "the coordinator refuses this worker: for a reason".to_owned();
    assert_eq!(bench.exit, Some(Err(reason)), "its token was revoked");
}

#[test]
fn an_answer_without_sense_ends_the_worker() {
    let mut bench = Bench::joined(1);
    bench.fail(is_lease, failure(CallErrorKind::Nonsense));
    bench.fail(|call| matches!(call, Call::Leave { .. }), failure(CallErrorKind::Other));
    let reason = "the coordinator's answer makes no sense: for a reason".to_owned();
    assert_eq!(bench.exit, Some(Err(reason)));
}

#[test]
fn a_worker_sent_home_ends_well() {
    let mut bench = Bench::rendering(1, 1);
    bench.answer(is_lease, Answer::Leased(Next::ShutDown));
    assert_eq!(bench.exit, Some(Ok(())));
}

#[test]
fn a_worker_without_work_asks_again() {
    let mut bench = Bench::joined(1);
    for _ in 0..3 {
        bench.answer(is_lease, Answer::Leased(Next::Nothing));
    }
    assert!(bench.has(is_lease));
}

#[test]
fn a_run_without_tiles_is_nothing() {
    let mut bench = Bench::joined(1);
    bench.answer(is_lease, run(1, 0, 0));
    assert!(bench.fetches.is_empty() && bench.has(is_lease));
    bench.beat(1);
    assert!(!bench.has(is_renew));
}

#[test]
fn a_worker_that_has_not_joined_stops_at_once() {
    let mut bench = Bench::new(1);
    bench.stop();
    assert_eq!(bench.exit, Some(Ok(())));
    let mut bench = Bench::new(1);
    bench.fail(|_| true, no_answer());
    bench.stop();
    assert_eq!(bench.exit, Some(Ok(())));
    let mut bench = Bench::new(1);
    bench.answer(|call| matches!(call, Call::Connect), Answer::Connected);
    bench.stop();
    assert_eq!(bench.exit, Some(Ok(())));
}

#[test]
fn a_worker_that_is_drained_delivers_what_its_threads_have_and_leaves() {
    let mut bench = Bench::rendering(1, 9);
    bench.worker.on_stop(Duration::from_secs(10), bench.now);
    bench.absorb();
    let mut count = 0;
    while !bench.renderings.is_empty() {
        bench.render();
        count += 1;
        bench.answer(is_deliver, Answer::Delivered);
    }
    assert_eq!(count, TURNS_AT_HAND, "no tile is begun any more");
    bench.answer(|call| matches!(call, Call::Leave { .. }), Answer::Left);
    assert_eq!(bench.exit, Some(Ok(())));

    let mut bench = Bench::rendering(1, 2);
    bench.render();
    bench.worker.on_stop(Duration::from_secs(10), bench.now);
    bench.absorb();
    assert!(!bench.has(|call| matches!(call, Call::Leave { .. })), "one comes, one is rendered");
}

#[test]
fn a_worker_is_drained_no_longer_than_its_grace() {
    let mut bench = Bench::rendering(1, 9);
    let begun = bench.now;
    bench.worker.on_stop(Duration::from_secs(1), bench.now);
    bench.absorb();
    bench.sleep();
    assert_eq!(bench.now - begun, Duration::from_secs(1));
    assert_eq!(bench.stopped.len(), bench.renderings.len());
    bench.answer(|call| matches!(call, Call::Leave { .. }), Answer::Left);
    assert_eq!(bench.exit, Some(Ok(())));
}

#[test]
fn a_member_that_is_stopped_gives_its_leases_back() {
    let mut bench = Bench::rendering(2, 9);
    bench.stop();
    assert_eq!(bench.stopped.len(), bench.renderings.len());
    bench.stop();
    let left = bench.answer(|_| true, Answer::Left);
    let reason = "the worker was stopped".to_owned();
    assert_eq!(left, Call::Leave { member: member(1), reason });
    assert_eq!(bench.exit, Some(Ok(())));
}

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

    fn is_one_in(&mut self, n: u64) -> bool {
        self.below(n) == 0
    }
}

/// Something under way.
enum Letter {
    /// A call reaches the coordinator.
    Question(TaskId, Call),
    /// What it says reaches the worker.
    Answer(TaskId, Result<Answer, CallError>),
    /// The next scene is in memory.
    Fetched(TaskId, SceneHash),
    /// A thread is done.
    Rendered(TaskId),
    Beat(LeaseName),
}

/// A coordinator that forgets, and a network that delays and loses.
struct Chance {
    random: SplitMix64,
    post: Vec<(Instant, Letter)>,
    /// Who the worker is now.
    member: Option<Membership>,
    member_count: u32,
    /// Tiles of two jobs that are not leased.
    free: Vec<(u8, TileId)>,
    leases: BTreeMap<LeaseName, (u8, BTreeSet<TileId>)>,
    lease_count: u64,
    delivered: BTreeSet<(u8, TileId)>,
}

impl Chance {
    fn post(&mut self, now: Instant, letter: Letter) {
        let delay = if self.random.is_one_in(50) { 40_000 } else { self.random.below(300) };
        self.post.push((now + Duration::from_millis(delay), letter));
    }

    fn on_question(&mut self, call: Call) -> Result<Answer, CallError> {
        if self.random.is_one_in(200) {
            self.member = None;
            self.take_back(|_| true);
        }
        let is_member = |chance: &Self, caller: Membership| {
            let is_known = chance.member == Some(caller);
            if is_known { Ok(()) } else { Err(failure(CallErrorKind::NotMember)) }
        };
        match call {
            Call::Connect => Ok(Answer::Connected),
            Call::Join => {
                if self.member.is_none() {
                    self.member_count += 1;
                    self.member = Some(member(self.member_count));
                }
                Ok(Answer::Joined {
                    member: self.member.unwrap(),
                    farm: FarmId([7; 16]),
                    term: TERM,
                })
            }
            Call::Lease { member, most_tiles, .. } => {
                is_member(self, member)?;
                Ok(Answer::Leased(self.lease(most_tiles)))
            }
            Call::Renew { member, renewals } => {
                is_member(self, member)?;
                let leases: Vec<LeaseName> = renewals.iter().map(|told| told.lease).collect();
                let gone = self.random.below(20);
                self.take_back(|name| leases.contains(name) && name.id.0 % 20 == gone);
                let known = &self.leases;
                let lost = leases.into_iter().filter(|name| !known.contains_key(name)).collect();
                Ok(Answer::Renewed { lost })
            }
            Call::Deliver { tiles, .. } => {
                for tile in tiles {
                    if let Some((scene, tiles)) = self.leases.get_mut(&tile.lease) {
                        tiles.remove(&tile.tile);
                        self.delivered.insert((*scene, tile.tile));
                    }
                }
                Ok(Answer::Delivered)
            }
            Call::Leave { .. } => Ok(Answer::Left),
        }
    }

    fn lease(&mut self, most_tiles: usize) -> Next {
        if self.delivered.len() == 2 * grid().count() as usize {
            return Next::ShutDown;
        }
        // A lease whose answer was lost runs out.
        if self.free.is_empty() {
            self.take_back(|_| true);
        }
        self.free.sort_unstable();
        let Some(&(scene, _)) = self.free.first() else { return Next::Nothing };
        let most = 1 + self.random.below(most_tiles as u64) as usize;
        let count = self.free.iter().take_while(|tile| tile.0 == scene).take(most).count();
        let tiles: Vec<TileId> = self.free.drain(..count).map(|(_, tile)| tile).collect();
        self.lease_count += 1;
        let name = lease(self.lease_count);
        self.leases.insert(name, (scene, tiles.iter().copied().collect()));
        Next::Run(Run { lease: name, tiles, job: job(scene) })
    }

    fn take_back(&mut self, is_lost: impl Fn(&LeaseName) -> bool) {
        for (_, (scene, tiles)) in self.leases.extract_if(.., |name, _| is_lost(name)) {
            self.free.extend(tiles.into_iter().map(|tile| (scene, tile)));
        }
    }
}

/// Plays a worker's life to its end.
fn simulate(seed: u64) {
    // Some answers in a row are lost, each of which is waited for.
    let mut bench = Bench::with_patience(1 + (seed % 3) as usize, 20 * PATIENCE);
    let tiles = (0..2).flat_map(|scene| grid().render_order().into_iter().map(move |t| (scene, t)));
    let mut chance = Chance {
        random: SplitMix64(seed),
        post: Vec::new(),
        member: None,
        member_count: 0,
        free: tiles.collect(),
        leases: BTreeMap::new(),
        lease_count: 0,
        delivered: BTreeSet::new(),
    };
    let mut posted = BTreeSet::new();
    for _ in 0..50_000 {
        for (&task, call) in &bench.calls {
            if posted.insert(task) && !chance.random.is_one_in(10) {
                chance.post(bench.now, Letter::Question(task, call.clone()));
            }
        }
        for (&task, &scene) in &bench.fetches {
            if posted.insert(task) {
                chance.post(bench.now, Letter::Fetched(task, scene));
            }
        }
        for (&task, &(lease, _)) in &bench.renderings {
            if posted.insert(task) {
                chance.post(bench.now, Letter::Rendered(task));
                chance.post(bench.now, Letter::Beat(lease));
            }
        }
        if let Some(exit) = bench.exit {
            assert_eq!(exit, Ok(()), "seed {seed}");
            assert_eq!(chance.delivered.len(), 2 * grid().count() as usize, "seed {seed}");
            return;
        }

        let is_in_time = |arrival| bench.worker.wake_at().is_none_or(|wake| arrival < wake);
        let first = (0..chance.post.len()).min_by_key(|&index| chance.post[index].0);
        let Some(first) = first.filter(|&index| is_in_time(chance.post[index].0)) else {
            bench.sleep();
            continue;
        };
        let (arrival, letter) = chance.post.swap_remove(first);
        bench.now = bench.now.max(arrival);
        match letter {
            Letter::Question(task, call) => {
                let answer = chance.on_question(call);
                if !chance.random.is_one_in(10) {
                    chance.post(bench.now, Letter::Answer(task, answer));
                }
            }
            Letter::Answer(task, answer) => {
                // The worker may have stopped waiting, and is told all the same.
                bench.calls.remove(&task);
                match answer {
                    Ok(answer) => bench.worker.on_answer(task, answer, bench.now),
                    Err(error) => bench.worker.on_call_failed(task, error, bench.now),
                }
            }
            Letter::Fetched(task, scene) => {
                if bench.fetches.remove(&task).is_some() {
                    bench.scenes.push(scene);
                }
                bench.worker.on_fetched(task, bench.now);
            }
            Letter::Rendered(task) => {
                let (lease, tile) = bench.renderings.remove(&task).unwrap();
                let pixels = (!bench.stopped.remove(&task)).then(|| delivery(lease, tile));
                bench.worker.on_tiles_rendered(vec![(task, pixels)], bench.now);
            }
            Letter::Beat(lease) => {
                bench.worker.on_beat(&BTreeMap::from([((lease, None), 1)]), bench.now);
            }
        }
        bench.absorb();
    }
    panic!("seed {seed}: no end");
}

#[test]
fn every_tile_is_delivered_though_calls_are_lost_and_leases_and_members_forgotten() {
    for seed in 0..500 {
        simulate(seed);
    }
}
