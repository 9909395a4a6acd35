//! A worker's life: it joins, asks for tiles, has them rendered, brings them, leaves. Decisions
//! alone: what happens comes in as events with the time, what is to be done goes out as
//! [`Action`]s, and nothing here waits.

use std::{
    collections::{BTreeMap, VecDeque},
    mem,
    sync::Arc,
    time::{Duration, Instant},
};

use rtfarm_core::{prepared::SceneHash, tile::TileId};
use rtfarm_proto::{Address, DELIVERY_BYTES, FarmId, JobId, LeaseName, Renewal};

use crate::{
    call::{Answer, Call, CallError, CallErrorKind, Delivery, KeptTiles, Membership, Next, Run},
    config::Config,
    error::WorkerError,
    job::Job,
    pulse::Object,
    scene::SceneError,
    task::{Action, GivenUp, Rendered, TURN, TaskId, Tasks},
};

/// Turns of tiles that a thread may have before it, so that it never waits for the network. As many
/// may be on their way to the coordinator. A turn is a tile, or as many small ones as take a thread
/// [`TURN`].
const TURNS_AHEAD: usize = 2;

/// Turns that are handed to the threads at once, for each of them: the one that it renders and
/// those before it.
const TURNS_AT_HAND: usize = 1 + TURNS_AHEAD;

/// The most turns whose pixels may be in memory or in the making, for each thread: a coordinator
/// that takes pixels slowly stops the threads.
const MOST_TURNS_OF_PIXELS: usize = TURNS_AT_HAND + TURNS_AHEAD;

/// The longest run that is asked for, for each thread: so many tiles, or so many turns of small
/// ones.
const LONGEST_RUN_A_THREAD: usize = 32;
const LONGEST_RUN_IN_TURNS: usize = 16;

/// Progress is told so many times before a lease would run out.
const BEATS_A_TERM: u32 = 4;

/// A piece of a scene must come within this time.
const CHUNK_DEADLINE: Duration = Duration::from_secs(30);

/// A worker.
#[derive(Debug)]
pub(crate) struct Worker {
    coordinator: Address,
    threads: usize,
    memory: Option<u64>,
    tasks: Tasks,
    /// The farm that it last joined, and pixels that it rendered for an earlier start of that farm.
    farm: Option<FarmId>,
    kept: Kept,
    stage: Stage,
    /// Set when this worker only finishes what its threads have in hand: until when it may.
    drain_until: Option<Instant>,
}

/// Finished tiles that no coordinator has acknowledged.
type Kept = BTreeMap<(JobId, TileId), Delivery>;

#[derive(Debug)]
enum Stage {
    /// Connects, then joins.
    Joining,
    Working(Member),
    /// Has given its leases back and waits to be heard; then it ends so.
    Leaving(Result<(), WorkerError>),
    Ended,
}

/// A worker that has joined.
#[derive(Debug)]
struct Member {
    id: Membership,
    threads: usize,
    /// Bytes that the scenes may have together; `None`: those of any scene that is needed.
    memory: Option<u64>,
    /// The leases that this worker knows to have.
    leases: BTreeMap<LeaseName, Held>,
    /// A run whose scene waits for room, or is being brought into memory.
    fetching: Option<Run>,
    /// The scene of that run is being brought.
    is_fetching: bool,
    /// Scenes in memory and their bytes, the last that was asked for last.
    scenes: Vec<(SceneHash, u64)>,
    /// Tiles that wait for a thread, first come first served.
    waiting: VecDeque<Waiting>,
    /// The turn of a thread, in tiles: at least one.
    turn: usize,
    /// Tiles in the hands of the threads.
    rendering_count: usize,
    /// Tiles that wait to be delivered.
    rendered: VecDeque<Delivery>,
    /// Tiles whose pixels wait to be leased once more.
    kept: Kept,
    /// Tiles on their way to the coordinator, which has not acknowledged them yet.
    delivering_count: usize,
    is_leasing: bool,
    is_renewing: bool,
}

/// A lease that this worker has.
#[derive(Debug)]
struct Held {
    scene: SceneHash,
    /// Tiles that are not on their way to the coordinator yet: at least one.
    tiles_left: usize,
    /// Steps that brought its scene.
    work: u64,
    /// Tiles of those left that were begun, and the steps that were made for each.
    begun: BTreeMap<TileId, u64>,
    /// There were steps of which the coordinator was not told yet.
    has_news: bool,
}

#[derive(Debug)]
struct Waiting {
    lease: LeaseName,
    tile: TileId,
    job: Arc<Job>,
}

impl Worker {
    /// A worker that begins to look for its coordinator. `seed` should differ between workers, so
    /// that they do not all repeat their calls at the same moments.
    pub(crate) fn new(config: &Config, seed: u64, now: Instant) -> Self {
        let mut tasks = Tasks::new(config.patience, seed);
        tasks.call(Call::Connect, now);
        Self {
            coordinator: config.coordinator.address().clone(),
            threads: config.threads,
            memory: config.memory,
            tasks,
            farm: None,
            kept: Kept::new(),
            stage: Stage::Joining,
            drain_until: None,
        }
    }

    /// What is to be done next, if there is anything. Ask after every event until there is not.
    pub(crate) fn next_action(&mut self) -> Option<Action> {
        self.tasks.next_action()
    }

    /// When to call [`Worker::on_tick`] if nothing happens before.
    pub(crate) fn wake_at(&self) -> Option<Instant> {
        [self.tasks.wake_at(), self.drain_until].into_iter().flatten().min()
    }

    /// Event: the coordinator has answered a call.
    pub(crate) fn on_answer(&mut self, task: TaskId, answer: Answer, now: Instant) {
        let Some(call) = self.tasks.on_answer(task, now) else { return };
        match (&mut self.stage, answer) {
            (Stage::Joining, Answer::Connected) => self.tasks.call(Call::Join, now),
            (Stage::Joining, Answer::Joined { member, farm, term }) => {
                let (worker, coordinator) = (member.worker.0, &self.coordinator);
                tracing::info!(worker, %coordinator, %farm, "joined");
                self.tasks.push(Action::HearBeats { period: term / BEATS_A_TERM });
                // Another farm's jobs have the same numbers.
                if self.farm.replace(farm) != Some(farm) {
                    self.kept.clear();
                }
                let kept = mem::take(&mut self.kept);
                let member = Member::new(member, self.threads, self.memory);
                self.stage = Stage::Working(Member { kept, ..member });
            }
            (Stage::Working(member), Answer::Leased(next)) => {
                member.is_leasing = false;
                match next {
                    Next::Run(run) => member.on_run(run),
                    Next::Nothing => {}
                    Next::ShutDown => {
                        tracing::info!(worker = member.id.worker.0, "sent home");
                        return self.end(Ok(()));
                    }
                }
                // What was offered and not leased is not wanted.
                if let Call::Lease { kept: Some(offered), .. } = call {
                    member.kept.retain(|(job, _), _| *job != offered.job);
                }
            }
            (Stage::Working(member), Answer::Renewed { lost }) => {
                member.is_renewing = false;
                member.on_leases_lost(&lost, &mut self.tasks);
            }
            (Stage::Working(member), Answer::Delivered) => {
                if let Call::Deliver { tiles, .. } = call {
                    member.delivering_count -= tiles.len();
                }
            }
            (Stage::Leaving(_), Answer::Left) => self.end_as_left(),
            (stage, answer) => unreachable!("{answer:?} was not asked for while {stage:?}"),
        }
        self.proceed(now);
    }

    /// Event: a call has failed.
    pub(crate) fn on_call_failed(&mut self, task: TaskId, error: CallError, now: Instant) {
        if let Some(given_up) = self.tasks.on_call_failed(task, error, now) {
            self.on_given_up(given_up, now);
        }
    }

    /// Event: a scene is in memory.
    pub(crate) fn on_fetched(&mut self, task: TaskId, now: Instant) {
        if self.tasks.on_end(task)
            && let Stage::Working(member) = &mut self.stage
        {
            member.on_fetched();
            self.proceed(now);
        }
    }

    /// Event: a scene cannot be brought into memory.
    pub(crate) fn on_fetch_failed(&mut self, task: TaskId, error: SceneError, now: Instant) {
        if !self.tasks.on_end(task) {
            return;
        }
        match (&mut self.stage, error) {
            (Stage::Working(member), SceneError::Gone(reason)) => {
                tracing::info!(worker = member.id.worker.0, reason, "dropped a lease");
                member.is_fetching = false;
                if let Some(run) = member.fetching.take() {
                    member.leases.remove(&run.lease);
                }
                self.proceed(now);
            }
            (_, error) => self.leave(Err(error.into()), now),
        }
    }

    /// Event: threads are done with tiles; one has no pixels if it was stopped.
    pub(crate) fn on_tiles_rendered(&mut self, rendered: Vec<Rendered>, now: Instant) {
        let awaited = rendered.into_iter().filter(|&(task, _)| self.tasks.on_end(task));
        let awaited: Vec<Option<Delivery>> = awaited.map(|(_, tile)| tile).collect();
        if let Stage::Working(member) = &mut self.stage {
            member.on_rendered(awaited);
            self.proceed(now);
        }
    }

    /// Event: threads or a fetch have made so many steps since the last time.
    pub(crate) fn on_beat(&mut self, beats: &BTreeMap<Object, u64>, now: Instant) {
        if let Stage::Working(member) = &mut self.stage {
            for (&(lease, tile), count) in beats {
                if let Some(held) = member.leases.get_mut(&lease) {
                    *tile.map_or(&mut held.work, |tile| held.begun.entry(tile).or_default()) +=
                        count;
                    held.has_news = true;
                }
            }
            self.proceed(now);
        }
    }

    /// Event: time passes.
    pub(crate) fn on_tick(&mut self, now: Instant) {
        while let Some(given_up) = self.tasks.on_tick(now) {
            self.on_given_up(given_up, now);
        }
        if self.drain_until.is_some_and(|until| until <= now) {
            self.leave(Ok(()), now);
        }
    }

    /// Event: somebody wants this worker to end. The tiles that its threads have in hand may still
    /// be finished and delivered for as long as `grace`.
    pub(crate) fn on_stop(&mut self, grace: Duration, now: Instant) {
        match &mut self.stage {
            Stage::Joining => self.end(Ok(())),
            Stage::Working(_) if grace.is_zero() => self.leave(Ok(()), now),
            Stage::Working(member) => {
                member.waiting.clear();
                self.drain_until = Some(now + grace);
                self.proceed(now);
            }
            Stage::Leaving(_) | Stage::Ended => {}
        }
    }

    fn on_given_up(&mut self, GivenUp { call, error }: GivenUp, now: Instant) {
        let CallError { kind, message } = error;
        let error = match (&call, kind) {
            (Call::Leave { .. }, _) => return self.end_as_left(),
            (Call::Connect, _) => WorkerError::Connect(self.coordinator.clone(), message),
            (_, CallErrorKind::Forbidden) | (Call::Join, CallErrorKind::Refused) => {
                WorkerError::Refused(message)
            }
            (Call::Join, _) => WorkerError::Gone(message),
            (_, CallErrorKind::NotMember) => return self.join_again(call, &message, now),
            (_, CallErrorKind::Nonsense) => WorkerError::Nonsense(message),
            _ => WorkerError::Gone(message),
        };
        match self.stage {
            Stage::Working(_) => self.leave(Err(error), now),
            _ => self.end(Err(error)),
        }
    }

    /// The coordinator does not know this worker any more, nor its leases: it may have been started
    /// anew. Finished tiles are kept, for the same farm may lease them once more.
    fn join_again(&mut self, unheard: Call, reason: &str, now: Instant) {
        tracing::warn!(reason, "joining again");
        let unheard = self.tasks.stop_all().into_iter().chain([unheard]);
        if let Stage::Working(member) = mem::replace(&mut self.stage, Stage::Joining) {
            for (scene, _) in member.scenes {
                self.tasks.push(Action::ForgetScene(scene));
            }
            let delivered = unheard.filter_map(|call| match call {
                Call::Deliver { tiles, .. } => Some(tiles),
                _ => None,
            });
            self.kept = member.kept;
            let tiles = member.rendered.into_iter().chain(delivered.flatten());
            self.kept.extend(tiles.map(|tile| ((tile.lease.job, tile.tile), tile)));
        }
        if self.drain_until.is_some() {
            return self.end(Ok(()));
        }
        self.tasks.call(Call::Join, now);
    }

    /// Stops all work, and gives every lease back if the coordinator can still be told.
    fn leave(&mut self, exit: Result<(), WorkerError>, now: Instant) {
        let Stage::Working(member) = &self.stage else { return };
        let reason = match &exit {
            Ok(()) => "the worker was stopped".to_owned(),
            Err(error) => error.to_string(),
        };
        let leave = Call::Leave { member: member.id, reason };
        self.tasks.stop_all();
        self.tasks.call(leave, now);
        self.drain_until = None;
        self.stage = Stage::Leaving(exit);
    }

    fn end_as_left(&mut self) {
        if let Stage::Leaving(exit) = mem::replace(&mut self.stage, Stage::Ended) {
            self.end(exit);
        }
    }

    fn end(&mut self, exit: Result<(), WorkerError>) {
        self.tasks.stop_all();
        self.tasks.push(Action::Exit(exit));
        self.drain_until = None;
        self.stage = Stage::Ended;
    }

    fn proceed(&mut self, now: Instant) {
        if let Stage::Working(member) = &mut self.stage {
            let is_draining = self.drain_until.is_some();
            member.proceed(is_draining, &mut self.tasks, now);
            if is_draining && member.holds_no_pixels() {
                self.leave(Ok(()), now);
            }
        }
    }
}

impl Member {
    fn new(id: Membership, threads: usize, memory: Option<u64>) -> Self {
        Self {
            id,
            threads,
            memory,
            leases: BTreeMap::new(),
            fetching: None,
            is_fetching: false,
            scenes: Vec::new(),
            waiting: VecDeque::new(),
            turn: 1,
            rendering_count: 0,
            rendered: VecDeque::new(),
            kept: Kept::new(),
            delivering_count: 0,
            is_leasing: false,
            is_renewing: false,
        }
    }

    fn on_run(&mut self, mut run: Run) {
        if run.tiles.is_empty() {
            return;
        }
        let (tiles_left, begun) = (run.tiles.len(), BTreeMap::new());
        let held = Held { scene: run.job.scene, tiles_left, work: 0, begun, has_news: false };
        let lease = run.lease;
        self.leases.insert(lease, held);
        run.tiles.retain(|&tile| {
            let kept = self.kept.remove(&(lease.job, tile));
            let is_kept = kept.is_some();
            self.rendered.extend(kept.map(|kept| Delivery { lease, ..kept }));
            !is_kept
        });
        if run.tiles.is_empty() {
            return;
        }
        match self.scenes.iter().position(|(scene, _)| *scene == run.job.scene) {
            Some(place) => {
                self.scenes[place..].rotate_left(1);
                self.queue(run);
            }
            None => self.fetching = Some(run),
        }
    }

    fn on_fetched(&mut self) {
        self.is_fetching = false;
        if let Some(run) = self.fetching.take() {
            self.scenes.push((run.job.scene, run.job.scene_byte_count));
            // The lease may have been lost meanwhile.
            if self.leases.contains_key(&run.lease) {
                self.queue(run);
            }
        }
    }

    fn queue(&mut self, run: Run) {
        let Run { lease, tiles, job } = run;
        let waiting = |tile| Waiting { lease, tile, job: Arc::clone(&job) };
        self.waiting.extend(tiles.into_iter().map(waiting));
    }

    fn on_leases_lost(&mut self, lost: &[LeaseName], tasks: &mut Tasks) {
        for &name in lost {
            if self.leases.remove(&name).is_some() {
                tracing::info!(worker = self.id.worker.0, ?name, "lost a lease");
                self.waiting.retain(|waiting| waiting.lease != name);
                tasks.stop_renderings(name);
            }
        }
        let is_lost = |run: &mut Run| lost.contains(&run.lease);
        if !self.is_fetching {
            self.fetching.take_if(is_lost);
        }
    }

    fn on_rendered(&mut self, tiles: Vec<Option<Delivery>>) {
        self.rendering_count -= tiles.len();
        // The pixels are welcome even if the lease was lost meanwhile.
        let tiles: Vec<Delivery> = tiles.into_iter().flatten().collect();
        if tiles.is_empty() {
            return;
        }
        let (seconds, bytes) = tiles.iter().fold((0.0, 0), |(seconds, bytes), tile| {
            (seconds + tile.seconds, bytes + tile.pixels.len())
        });
        let in_time = TURN.as_secs_f64() * tiles.len() as f64 / seconds;
        let in_a_message = DELIVERY_BYTES * tiles.len() / bytes.max(1);
        self.turn = (in_time as usize).min(in_a_message).max(1);
        self.rendered.extend(tiles);
    }

    /// The next tiles to be delivered, as many as a message may hold; none while enough are on
    /// their way.
    fn next_delivery(&mut self) -> Vec<Delivery> {
        let (mut tiles, mut bytes) = (Vec::<Delivery>::new(), 0);
        while self.delivering_count + tiles.len() < TURNS_AHEAD * self.turn * self.threads
            && let Some(tile) = self.rendered.front()
        {
            bytes += tile.pixels.len();
            if bytes > DELIVERY_BYTES && !tiles.is_empty() {
                break;
            }
            tiles.extend(self.rendered.pop_front());
        }
        for tile in &tiles {
            self.on_tile_sent(tile.lease, tile.tile);
        }
        self.delivering_count += tiles.len();
        tiles
    }

    /// Begins whatever can be begun now; when it `is_draining`, deliveries alone.
    fn proceed(&mut self, is_draining: bool, tasks: &mut Tasks, now: Instant) {
        loop {
            let tiles = self.next_delivery();
            if tiles.is_empty() {
                break;
            }
            tasks.call(Call::Deliver { member: self.id, tiles }, now);
        }
        if is_draining {
            self.waiting.clear();
        }
        while self.has_room_for_pixels()
            && let Some(Waiting { lease, tile, job }) = self.waiting.pop_front()
        {
            self.rendering_count += 1;
            tasks.render(lease, tile, job);
        }
        self.keep_scenes(tasks);

        let tiles_left: usize = self.leases.values().map(|held| held.tiles_left).sum();
        let is_short = tiles_left < TURNS_AHEAD * self.turn * self.threads;
        if is_short && !is_draining && !self.is_leasing && self.fetching.is_none() {
            self.is_leasing = true;
            let longest = LONGEST_RUN_A_THREAD.max(LONGEST_RUN_IN_TURNS * self.turn);
            let most_tiles = longest * self.threads;
            let kept = self.kept.keys().next().map(|&(job, _)| KeptTiles {
                job,
                tiles: self.kept.keys().filter(|key| key.0 == job).map(|key| key.1).collect(),
            });
            let wait = tasks.longest_wait();
            tasks.call(Call::Lease { member: self.id, most_tiles, wait, kept }, now);
        }
        let has_news = self.leases.values().any(|held| held.has_news);
        if has_news && !self.is_renewing {
            self.is_renewing = true;
            let renewals = self.leases.iter_mut().map(|(&lease, held)| {
                held.has_news = false;
                let tiles = held.begun.iter().map(|(tile, &work)| (tile.number(), work));
                Renewal { lease, work: held.work, tiles: tiles.collect() }
            });
            let renewals = renewals.collect();
            tasks.call(Call::Renew { member: self.id, renewals }, now);
        }
    }

    fn holds_no_pixels(&self) -> bool {
        self.rendering_count + self.rendered.len() + self.delivering_count == 0
    }

    fn has_room_for_pixels(&self) -> bool {
        let pixels = self.rendering_count + self.rendered.len() + self.delivering_count;
        let turns = self.turn * self.threads;
        self.rendering_count < TURNS_AT_HAND * turns && pixels < MOST_TURNS_OF_PIXELS * turns
    }

    fn on_tile_sent(&mut self, name: LeaseName, tile: TileId) {
        if let Some(held) = self.leases.get_mut(&name) {
            held.tiles_left -= 1;
            held.begun.remove(&tile);
            if held.tiles_left == 0 {
                self.leases.remove(&name);
            }
        }
    }

    /// Forgets scenes that no lease needs, those first that were asked for longest ago, until the
    /// others and the one that is wanted have room; then has that one brought.
    fn keep_scenes(&mut self, tasks: &mut Tasks) {
        let wanted = self.fetching.as_ref().map_or(0, |run| run.job.scene_byte_count);
        let mut bytes = self.scenes.iter().map(|(_, bytes)| bytes).sum::<u64>() + wanted;
        let latest = self.scenes.last().map(|&(scene, _)| scene);
        let leases = &self.leases;
        let is_needed = |scene| leases.values().any(|held| held.scene == scene);
        let memory = self.memory;
        let is_kept = |scene, bytes: u64| match memory {
            Some(memory) => bytes <= memory,
            None => latest == Some(scene),
        };
        for (scene, its_bytes) in self.scenes.extract_if(.., |(scene, its_bytes)| {
            let goes = !is_kept(*scene, bytes) && !is_needed(*scene);
            bytes -= if goes { *its_bytes } else { 0 };
            goes
        }) {
            tracing::debug!(%scene, bytes = its_bytes, "forgot a scene");
            tasks.push(Action::ForgetScene(scene));
        }
        let has_room = memory.is_none_or(|memory| bytes <= memory) || self.scenes.is_empty();
        if let Some(run) = &self.fetching
            && !self.is_fetching
            && has_room
        {
            self.is_fetching = true;
            tasks.fetch(Arc::clone(&run.job), run.lease, CHUNK_DEADLINE);
        }
    }
}

#[cfg(test)]
mod tests;
