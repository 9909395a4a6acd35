//! A farm whose workers do their best, each at its own speed: the real machine, and tiles that cost
//! what real ones did. What it makes of slow workers, of a liar and of a deadly tile.

use std::{
    collections::{BTreeMap, BTreeSet, VecDeque},
    time::{Duration, Instant},
};

use rtfarm_core::{
    render::Tally,
    tile::{Size, TileGrid, TileId},
};
use rtfarm_job::Outcome;
use rtfarm_proto::{JobId, LeaseName, Renewal, WorkerId};

use crate::{
    audit::Audit,
    farm::{Action, Delivery, DeliveryId, Farm, Next, Notice},
    identity::Identity,
    members::Process,
    tiles::Tiles,
    waiting::{Ask, AskId},
};

const TERM: Duration = Duration::from_secs(4);

/// Milliseconds of one thread for each tile of `scenes/gnome.rt`, 320x240 in tiles of 16, with 64
/// samples a pixel.
#[rustfmt::skip]
const COSTS: [u64; 300] = [
    591, 475, 641, 662, 345, 291, 272, 297, 270, 117, 77, 142, 193, 355, 290, 225, 191, 166, 196, 205,
    673, 551, 661, 734, 411, 254, 342, 233, 196, 348, 232, 183, 307, 219, 300, 291, 170, 131, 143, 175,
    662, 604, 693, 672, 303, 271, 471, 372, 439, 536, 167, 199, 338, 241, 185, 117, 143, 175, 196, 167,
    612, 724, 824, 706, 341, 166, 463, 743, 491, 423, 182, 157, 304, 284, 233, 122, 187, 199, 119, 155,
    672, 723, 389, 494, 431, 143, 224, 486, 412, 697, 539, 309, 328, 249, 212, 143, 167, 210, 114, 170,
    740, 683, 411, 400, 430, 260, 236, 550, 398, 860, 628, 751, 520, 231, 158, 175, 196, 187, 137, 123,
    508, 496, 247, 289, 590, 109, 380, 375, 392, 723, 717, 1320, 609, 282, 221, 120, 142, 138, 137, 151,
    403, 401, 192, 290, 397, 168, 690, 284, 263, 533, 805, 777, 770, 236, 167, 129, 188, 166, 128, 129,
    668, 447, 380, 236, 184, 134, 443, 460, 223, 359, 970, 902, 826, 288, 113, 111, 87, 105, 77, 77,
    662, 399, 384, 391, 102, 71, 432, 551, 191, 707, 1497, 1330, 1072, 1248, 141, 145, 130, 105, 114, 125,
    390, 333, 232, 273, 189, 55, 469, 524, 120, 959, 734, 257, 332, 1434, 717, 437, 127, 145, 140, 181,
    198, 220, 156, 200, 281, 242, 312, 602, 387, 975, 723, 297, 351, 1567, 1157, 424, 112, 136, 126, 130,
    172, 170, 162, 182, 203, 307, 358, 623, 664, 786, 1081, 721, 614, 1262, 433, 423, 176, 119, 75, 110,
    582, 621, 497, 553, 444, 478, 466, 754, 551, 797, 1098, 1149, 1073, 400, 291, 305, 101, 62, 45, 70,
    407, 397, 447, 434, 362, 344, 384, 308, 432, 341, 190, 229, 256, 218, 172, 126, 105, 95, 92, 86,
];

/// A process with one thread.
struct Hand {
    worker: WorkerId,
    process: u32,
    /// Times what tiles cost others.
    slowness: u32,
    /// Of a thousand tiles, so many are not what it says.
    lies: u64,
    queue: VecDeque<(LeaseName, TileId)>,
    /// What it renders, and until when.
    busy: Option<(Instant, LeaseName, TileId)>,
    ask: Option<AskId>,
}

/// A farm with one job.
struct Steady {
    farm: Farm,
    job: JobId,
    now: Instant,
    start: Instant,
    hands: Vec<Hand>,
    costs: Vec<Duration>,
    deadly: Option<TileId>,
    last_number: u64,
    next_beat: Instant,
    /// What is in the picture: the truth or not.
    picture: BTreeMap<TileId, bool>,
    brought: BTreeMap<DeliveryId, bool>,
    liar: Option<WorkerId>,
    /// Tiles that the liar has brought.
    liar_count: u32,
    rendered_count: u32,
    dead_count: u32,
    outcome: Option<Outcome>,
}

impl Steady {
    /// A row of tiles that cost so much, each.
    fn new(costs: Vec<Duration>, audit: f64, secret: u64) -> Self {
        #[expect(clippy::disallowed_methods, reason = "any instant will do")]
        let now = Instant::now();
        let bytes = std::array::from_fn(|index| secret.to_le_bytes()[index % 8]);
        let audit = Audit::new(audit, bytes);
        let mut farm = Farm::new(Identity::from_random([1; 24]), TERM, audit);
        let columns = 100;
        let rows = costs.len() as u64 / columns;
        let grid = TileGrid::new(Size::new(columns * 16, rows * 16).unwrap(), 16).unwrap();
        let job = farm.number_job();
        assert!(farm.on_submit(job, Tiles::new(grid), now).is_empty());
        Self {
            farm,
            job,
            now,
            start: now,
            hands: Vec::new(),
            costs,
            deadly: None,
            last_number: 0,
            next_beat: now,
            picture: BTreeMap::new(),
            brought: BTreeMap::new(),
            liar: None,
            liar_count: 0,
            rendered_count: 0,
            dead_count: 0,
            outcome: None,
        }
    }

    fn number(&mut self) -> u64 {
        self.last_number += 1;
        self.last_number
    }

    fn join(&mut self, slowness: u32, lies: u64) {
        let nonce = self.number();
        let process = nonce as u32;
        let joins = Process { nonce, number: process, threads: 1, ..Process::default() };
        let worker = self.farm.on_join(joins, self.now).0.unwrap();
        let (queue, busy, ask) = (VecDeque::new(), None, None);
        self.hands.push(Hand { worker, process, slowness, lies, queue, busy, ask });
    }

    fn act(&mut self, actions: Vec<Action>) {
        for action in actions {
            match action {
                Action::Answer(ask, answer) => {
                    let index = self.hands.iter().position(|hand| hand.ask == Some(ask));
                    let Some(index) = index else { continue };
                    self.hands[index].ask = None;
                    match answer {
                        Ok(Next::Render(run)) => {
                            let tiles = run.tiles.iter().map(|&tile| (run.lease, tile));
                            self.hands[index].queue.extend(tiles);
                        }
                        Ok(_) => {}
                        Err(_) => drop(self.hands.swap_remove(index)),
                    }
                }
                Action::Store(delivery, job, tile) => {
                    self.picture.insert(tile, self.brought[&delivery]);
                    let actions = self.farm.on_stored(job, tile, self.now);
                    self.act(actions);
                }
                Action::Publish(_, progress) => self.outcome = progress.outcome,
                Action::Log(Notice::Liar { worker, .. }) => {
                    assert_eq!(self.liar.replace(worker), None);
                }
                _ => {}
            }
        }
    }

    /// Each process begins what it can, and dies of a deadly tile.
    fn begin(&mut self) {
        let mut index = 0;
        while index < self.hands.len() {
            let hand = &mut self.hands[index];
            if hand.busy.is_none()
                && let Some((lease, tile)) = hand.queue.pop_front()
            {
                if self.deadly == Some(tile) {
                    let dead = self.hands.swap_remove(index);
                    self.dead_count += 1;
                    let actions = self.farm.on_process_exit(dead.process, "killed", self.now);
                    self.act(actions);
                    self.join(dead.slowness, dead.lies);
                    continue;
                }
                let end = self.now + self.costs[tile.index()] * hand.slowness;
                hand.busy = Some((end, lease, tile));
            }
            let hand = &self.hands[index];
            if hand.queue.is_empty() && hand.ask.is_none() {
                let (worker, id) = (hand.worker, AskId(self.number()));
                self.hands[index].ask = Some(id);
                let ask = Ask { worker, most: 32, until: self.now + Duration::from_secs(10) };
                let actions = self.farm.on_ask(id, ask, self.now);
                self.act(actions);
            }
            index += 1;
        }
    }

    /// Goes to the next moment at which anything happens.
    fn step(&mut self) {
        self.begin();
        let ends = self.hands.iter().filter_map(|hand| hand.busy.map(|(end, ..)| end));
        let next = ends.chain(self.farm.next_wake()).chain([self.next_beat]).min();
        self.now = self.now.max(next.unwrap_or(self.now));
        if self.next_beat <= self.now {
            self.next_beat = self.now + TERM / 4;
            let work = self.number();
            for Hand { worker, busy, .. } in &self.hands {
                if let &Some((_, lease, tile)) = busy {
                    let tiles = vec![(tile.number(), work)];
                    let renewal = Renewal { lease, work: 0, tiles };
                    let _ = self.farm.on_renew(*worker, &[renewal], self.now);
                }
            }
        }
        if self.farm.next_wake().is_some_and(|wake| wake <= self.now) {
            let actions = self.farm.on_time(self.now);
            self.act(actions);
        }
        for index in (0..self.hands.len()).rev() {
            let Some(hand) = self.hands.get_mut(index) else { continue };
            if let Some((end, lease, tile)) = hand.busy
                && end <= self.now
            {
                hand.busy = None;
                self.rendered_count += 1;
                self.liar_count += u32::from(hand.lies > 0);
                let (worker, slowness) = (hand.worker, hand.slowness);
                let lot =
                    blake3::hash(&[self.rendered_count, worker.0].map(u32::to_le_bytes).concat());
                let lot = u64::from_le_bytes(lot.as_bytes()[..8].try_into().unwrap());
                let is_true = lot % 1000 >= hand.lies;
                let hash = [if is_true { 0 } else { worker.0 as u8 }; 32];
                let seconds = (self.costs[tile.index()] * slowness).as_secs_f64();
                let tally = Tally::default();
                let id = DeliveryId(self.number());
                self.brought.insert(id, is_true);
                let delivery = Delivery { worker, lease, tile, hash, seconds, tally };
                let actions = self.farm.on_pixels(id, delivery, self.now);
                self.act(actions);
            }
        }
    }

    /// Renders until the job has ended. Answers with the time that it took.
    fn run(&mut self) -> Duration {
        for _ in 0..200_000 {
            if self.outcome.is_some() {
                self.farm.check();
                return self.now - self.start;
            }
            self.step();
        }
        panic!("no end");
    }
}

/// The measured tiles, each cut into so many that cost as much less.
fn costs(pieces: u32) -> Vec<Duration> {
    let cut = |&cost| vec![Duration::from_millis(cost) / pieces; pieces as usize];
    COSTS.iter().flat_map(cut).collect()
}

#[test]
fn a_worker_that_is_ten_times_slower_delays_a_picture_by_less_than_15_percent() {
    for (pieces, audit) in [(1, 0.0), (4, 0.0), (16, 0.0), (1, 0.01), (4, 0.01), (16, 0.01)] {
        for slow in 0..4 {
            let costs = costs(pieces);
            let ideal = costs.iter().sum::<Duration>().as_secs_f64() / 3.1;
            let mut farm = Steady::new(costs, audit, 1);
            for index in 0..4 {
                farm.join(if index == slow { 10 } else { 1 }, 0);
            }
            let ratio = farm.run().as_secs_f64() / ideal;
            let (rendered, count) = (farm.rendered_count, farm.costs.len());
            eprintln!(
                "{count} tiles, audit {audit}, slow {slow}: {ratio:.3} x, {rendered} rendered"
            );
            assert!(matches!(farm.outcome, Some(Outcome::Finished(_))));
            assert!((1.0..=1.15).contains(&ratio), "{count} tiles: {ratio}");
        }
    }
}

#[test]
fn a_deadly_tile_is_set_aside_after_few_deaths_and_nothing_else_is() {
    for number in [0, 7, 123, 299] {
        let mut farm = Steady::new(costs(1), 0.0, 1);
        farm.deadly = farm.farm.tile(farm.job, number);
        for _ in 0..4 {
            farm.join(1, 0);
        }
        let time = farm.run();
        let Some(Outcome::Failed(reason)) = &farm.outcome else { panic!("{:?}", farm.outcome) };
        let expected = format!(
            "299 of 300 tiles are right; set aside, since 3 workers were lost with each or stood \
             still: {number}"
        );
        assert_eq!(*reason, expected);
        assert_eq!(farm.picture.len(), 299);
        eprintln!("tile {number}: {} deaths, {:.1} s", farm.dead_count, time.as_secs_f64());
        assert!(farm.dead_count <= 4, "{} deaths", farm.dead_count);
    }
}

/// Says whether a worker that falsifies 5 % of its tiles is caught before it has brought 10,000.
fn is_caught(seed: u64, to_the_end: bool) -> bool {
    let mut farm = Steady::new(vec![Duration::from_millis(10); 30_000], 0.01, seed);
    for lies in [50, 0, 0] {
        farm.join(1, lies);
    }
    while farm.liar.is_none() && farm.liar_count < 10_000 && farm.outcome.is_none() {
        farm.step();
    }
    if to_the_end && farm.liar.is_some() {
        farm.run();
        assert!(matches!(farm.outcome, Some(Outcome::Finished(_))), "{:?}", farm.outcome);
        assert!(farm.picture.len() == 30_000 && farm.picture.values().all(|is_true| *is_true));
        eprintln!("seed {seed}: caught after {} tiles", farm.liar_count);
    }
    farm.liar.is_some()
}

#[test]
fn a_worker_that_falsifies_five_percent_is_caught_and_leaves_no_trace_in_the_picture() {
    let caught = (0..40).filter(|&seed| is_caught(seed, seed < 2)).count();
    assert!(caught >= 39, "{caught} of 40");
}

/// How long one coordinator takes for a tile: it carries 22,600 a second (docs/reliability.md).
const SERIAL: Duration = Duration::from_micros(27);

/// How long a message is on its way.
const LATENCY: Duration = Duration::from_micros(500);

/// What happens to a worker of a large farm.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Event {
    /// Its question is heard.
    Asks,
    /// Its answer is there.
    Gets,
    /// Its thread has rendered the first of its tiles.
    Renders,
    /// The tile is heard.
    Brings(TileId, LeaseName),
}

/// The time that a picture takes on so many workers of one thread: each measured tile stands for
/// `side` x `side` that cost as much as it does. What the coordinator does it does one after the
/// other.
fn time_on(workers: usize, side: usize) -> (Duration, Duration) {
    let (columns, rows) = (20 * side, 15 * side);
    let cost = |tile: TileId| {
        let (x, y) = (tile.index() % columns / side, tile.index() / columns / side);
        Duration::from_millis(COSTS[y * 20 + x])
    };
    #[expect(clippy::disallowed_methods, reason = "any instant will do")]
    let start = Instant::now();
    let term = Duration::from_secs(60);
    let audit = Audit::new(0.0, [0; 32]);
    let mut farm = Farm::new(Identity::from_random([1; 24]), term, audit);
    let size = Size::new(columns as u64 * 16, rows as u64 * 16).unwrap();
    let grid = TileGrid::new(size, 16).unwrap();
    let job = farm.number_job();
    farm.on_submit(job, Tiles::new(grid), start);
    let work = (0..grid.count()).map(|number| cost(grid.tile(number).unwrap())).sum();

    let mut events = BTreeSet::new();
    let mut ids = Vec::new();
    let mut queues = vec![VecDeque::<(LeaseName, TileId)>::new(); workers];
    let (mut is_busy, mut asks) = (vec![false; workers], vec![true; workers]);
    for index in 0..workers {
        let process = Process { nonce: index as u64, threads: 1, ..Process::default() };
        ids.push(farm.on_join(process, start).0.unwrap());
        events.insert((start + LATENCY, index, Event::Asks));
    }
    // Until when the coordinator has to do.
    let mut free_at = start;
    let mut number = 0;
    loop {
        let wake =
            farm.next_wake().filter(|&wake| events.first().is_none_or(|first| wake < first.0));
        let (now, actions) = if let Some(wake) = wake {
            (wake, farm.on_time(wake))
        } else {
            let (now, index, event) = events.pop_first().expect("something happens");
            let actions = match event {
                Event::Asks => {
                    let ask =
                        Ask { worker: ids[index], most: 32, until: now + Duration::from_secs(10) };
                    farm.on_ask(AskId((index + 1) as u64), ask, now)
                }
                Event::Brings(tile, lease) => {
                    number += 1;
                    free_at = free_at.max(now) + SERIAL;
                    let (hash, tally) = ([0; 32], Tally::default());
                    let seconds = cost(tile).as_secs_f64();
                    let worker = ids[index];
                    let delivery = Delivery { worker, lease, tile, hash, seconds, tally };
                    let mut actions = farm.on_pixels(DeliveryId(number), delivery, now);
                    if actions.iter().any(|action| matches!(action, Action::Store(..))) {
                        actions.extend(farm.on_stored(job, tile, now));
                    }
                    actions
                }
                Event::Renders => {
                    let (lease, tile) = queues[index].pop_front().expect("it rendered one");
                    events.insert((free_at.max(now) + LATENCY, index, Event::Brings(tile, lease)));
                    is_busy[index] = false;
                    Vec::new()
                }
                Event::Gets => Vec::new(),
            };
            if !is_busy[index]
                && let Some(&(_, tile)) = queues[index].front()
            {
                is_busy[index] = true;
                events.insert((now + cost(tile), index, Event::Renders));
            }
            if queues[index].len() < 2 && !asks[index] {
                asks[index] = true;
                events.insert((free_at.max(now) + LATENCY, index, Event::Asks));
            }
            (now, actions)
        };
        for action in actions {
            match action {
                Action::Answer(AskId(id), answer) => {
                    let index = id as usize - 1;
                    asks[index] = false;
                    if let Ok(Next::Render(run)) = answer {
                        let tiles = run.tiles.into_iter();
                        queues[index].extend(tiles.map(|tile| (run.lease, tile)));
                    }
                    events.insert((free_at.max(now) + LATENCY, index, Event::Gets));
                }
                Action::Publish(_, progress) if progress.outcome.is_some() => {
                    return (work, free_at.max(now) - start);
                }
                _ => {}
            }
        }
    }
}

/// `cargo test --release -p rtfarm-coordinator scale -- --ignored --nocapture` prints the table of
/// docs/reliability.md.
#[test]
#[ignore = "it takes 20 s and prints a table"]
fn scale_to_ten_thousand_workers() {
    for (side, workers) in [1, 10, 100, 1000, 3000, 10_000]
        .map(|workers| (24, workers))
        .into_iter()
        .chain([(72, 10_000)])
    {
        let (work, time) = time_on(workers, side);
        let (work, time) = (work.as_secs_f64(), time.as_secs_f64());
        let efficiency = work / time / workers as f64;
        let tiles = 300 * side * side;
        // What the longest tile and the coordinator's turn at each tile allow.
        let longest = COSTS.into_iter().max().unwrap() as f64 / 1e3;
        let serial = SERIAL.as_secs_f64() * tiles as f64;
        let model = work / (work / workers as f64 + longest / 2.0).max(serial) / workers as f64;
        eprintln!(
            "| {tiles} | {workers} | {time:.2} | {:.1} | {:.1} % | {:.1} % |",
            work / time,
            efficiency * 100.0,
            model * 100.0
        );
        assert!(workers > 1000 || efficiency >= 0.95, "{workers} workers: {efficiency}");
    }
}
