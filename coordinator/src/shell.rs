//! The shell of the machine: it hands events to it, with the time, and does what it answers.
//! Nothing is decided here.

mod log;

use std::{
    collections::{BTreeMap, BTreeSet, HashMap},
    future::pending,
    io,
    path::PathBuf,
    sync::{Arc, Mutex, MutexGuard},
    time::{Duration, Instant},
};

use rtfarm_core::{
    prepared::SceneHash,
    tile::{TileGrid, TileId},
};
use rtfarm_job::{Order, Outcome, Progress};
use rtfarm_picture::{Canvas, CanvasTile, TileRecord};
use rtfarm_proto::{Bytes, Incarnation, JobId, LeaseName, Renewal, WorkerId};
use tokio::sync::{Notify, oneshot};
use tokio_util::sync::CancellationToken;

use crate::{
    audit::Audit,
    events::Events,
    farm::{
        Action, Arrived, Change, Delivery, DeliveryId, Earlier, Explanation, Farm, JobEntry,
        Keeping, Next, Notice, Refused, Terms, Verdict,
    },
    flight::Flight,
    identity::{Identity, Stranger},
    job::Job,
    lease::Run,
    members::{KeptOut, Mark, MemberEntry, NoMember, Process, Standing},
    record::{Plan, Ticket},
    state::{Durability, KeptJob, StateFolder},
    store::SceneFile,
    tiles::Tiles,
    upload::OrderLimits,
    waiting::{Ask, AskId},
};

/// How a coordinator works.
#[derive(Debug, Clone)]
pub struct Config {
    /// Workers and clients of another version are refused.
    pub version: String,
    /// Of the sources that pixels depend on. Workers of another are refused.
    pub build: String,
    /// What the reference tile hashes to. Workers that make another of it are refused, unless there
    /// is none here.
    pub reference: Option<[u8; 32]>,
    /// How long a lease lives without progress.
    pub term: Duration,
    /// Of the tiles, from 0 to 1, that another worker renders again, to compare; besides those each
    /// worker's first of a job, unless this is 0.
    pub audit: f64,
    /// How long jobs that have ended are kept.
    pub keeping: Keeping,
    /// A job that begins has a coarse picture rendered first, for those who watch.
    pub begins_coarsely: bool,
    /// The name by which others know this machine: the page is shown under no other.
    pub host: Option<String>,
    /// A client that sends nothing of its scene for this long is given up.
    pub upload_silence: Duration,
    /// Where what happens is told besides, if anywhere: a JSON object a line.
    pub events: Option<PathBuf>,
    /// How much may be ordered.
    pub orders: OrderLimits,
    /// For scenes: a folder that is nobody else's.
    pub scene_folder: PathBuf,
    /// For pictures while they are rendered.
    pub picture_folder: PathBuf,
}

/// Why an order is not taken.
#[derive(Debug, thiserror::Error)]
pub enum SubmitError {
    /// The scene cannot be written.
    #[error("cannot write the prepared scene into {folder}: {error}", folder = .0.display(), error = .1)]
    Scene(PathBuf, io::Error),
    /// The picture cannot be made.
    #[error("cannot make the picture's file in {folder}: {error}", folder = .0.display(), error = .1)]
    Picture(PathBuf, io::Error),
    /// The job cannot be kept.
    #[error("cannot keep the job in the farm's state: {0}")]
    State(io::Error),
    /// A job has the order's key, and renders something else.
    #[error(
        "job {0} has the key `{1}` and is another order; with another key this one gets a job of its own"
    )]
    Key(JobId, String),
}

/// Why a job is not changed.
#[derive(Debug, thiserror::Error)]
pub(crate) enum ChangeError {
    #[error(transparent)]
    Refused(Refused),
    #[error("cannot read the picture: {0}")]
    Picture(io::Error),
}

/// The machine and all that its answers concern.
#[derive(Debug)]
pub(crate) struct Shell {
    pub(crate) identity: Identity,
    pub(crate) config: Config,
    /// Where jobs outlive this process.
    folder: Option<StateFolder>,
    /// What was written and a power cut may still take.
    unsynced: Mutex<BTreeMap<JobId, Unsynced>>,
    /// Told when there is such.
    written: Notify,
    /// Held for a moment: nothing is written and nobody is waited for under it.
    state: Mutex<State>,
    /// Held while a job is made or changed and that is kept: one at a time.
    changing: Mutex<()>,
    /// Held while it is found out whether there is room for an order, and it is taken.
    pub(crate) ordering: Mutex<()>,
    /// What comes to this process, and what goes.
    pub(crate) arriving: Flight,
    pub(crate) leaving: Flight,
    /// Told when the machine wants to be woken earlier than it will be.
    earlier: Notify,
    /// What happened.
    pub(crate) events: Events,
    /// Cancelled when everybody has gone home: connections are to be closed.
    pub(crate) stop: CancellationToken,
}

#[derive(Debug)]
struct State {
    farm: Farm,
    /// Jobs that the machine has not forgotten.
    jobs: BTreeMap<JobId, Arc<Job>>,
    /// Those that render coarse pictures of what others do.
    coarse: BTreeSet<JobId>,
    /// Questions that the machine has not answered.
    asks: HashMap<AskId, oneshot::Sender<Result<Next, NoMember>>>,
    /// What workers brought and the machine has not answered, by the number of its first tile.
    batches: BTreeMap<DeliveryId, Batch>,
    /// The number of the last question or delivery.
    last_number: u64,
    /// When the machine will be woken.
    wakes_at: Option<Instant>,
}

/// Tiles that came in one message. Their deliveries have consecutive numbers.
#[derive(Debug)]
struct Batch {
    deliveries: Vec<Delivery>,
    /// Of each tile. They are taken out when they are stored.
    pixels: Vec<Bytes>,
    verdicts: Vec<Verdict>,
    undecided_count: usize,
    reply: oneshot::Sender<Vec<Verdict>>,
}

#[derive(Debug)]
struct Unsynced {
    job: Arc<Job>,
    /// Tiles that are acknowledged only when a power cut cannot take them.
    tiles: Vec<TileId>,
}

/// What is done after the state is unlocked, since it may take a while.
#[derive(Default)]
struct Works {
    in_order: Vec<Work>,
    /// How far jobs are, for those who watch them: the last word only, after all else.
    progress: BTreeMap<JobId, (Arc<Job>, Progress)>,
}

enum Work {
    Log(Box<Notice>),
    /// Writes tiles into a job's picture.
    Store(Arc<Job>, Vec<(TileId, Bytes, TileRecord)>),
    /// Tells the machine that a job's picture cannot be written.
    Fail(JobId, String),
    Reopen(Arc<Job>),
    Keep(Arc<Job>, Terms),
    KeepMarks(BTreeMap<u64, Mark>),
    /// Removes the files of a job that nobody else has in hand.
    Drop(Arc<Job>),
}

impl Works {
    /// Has a tile written, together with those before it.
    fn store(&mut self, job: &Arc<Job>, tile: (TileId, Bytes, TileRecord)) {
        match self.in_order.last_mut() {
            Some(Work::Store(last, tiles)) if last.id == job.id => tiles.push(tile),
            _ => self.in_order.push(Work::Store(Arc::clone(job), vec![tile])),
        }
    }
}

/// How long a power cut may lose what was acknowledged.
const SYNC_PERIOD: Duration = Duration::from_secs(1);

impl Shell {
    /// Makes a farm without workers, and without jobs but those that are kept in `folder`.
    /// `secret` chooses the tiles that are compared.
    pub(crate) fn new(
        config: Config,
        identity: Identity,
        secret: [u8; 32],
        mut folder: Option<StateFolder>,
    ) -> io::Result<Self> {
        let events = Events::new(config.events.as_deref())?;
        let audit = Audit::new(config.audit, secret);
        let mut farm = match &folder {
            Some(folder) => Farm::keeping_jobs(identity, config.term, audit, folder.last_job()),
            None => Farm::new(identity, config.term, audit),
        };
        farm.keep(config.keeping);
        farm.remember(folder.as_ref().map(StateFolder::marks).unwrap_or_default());
        let kept = folder.as_mut().map(|folder| std::mem::take(&mut folder.kept));
        let state = State {
            farm,
            jobs: BTreeMap::new(),
            coarse: BTreeSet::new(),
            asks: HashMap::new(),
            batches: BTreeMap::new(),
            last_number: 0,
            wakes_at: None,
        };
        let [arriving, leaving] = [(); 2].map(|()| Flight::new(config.orders.flight_bytes));
        let shell = Self {
            identity,
            config,
            folder,
            unsynced: Mutex::default(),
            written: Notify::new(),
            state: Mutex::new(state),
            changing: Mutex::default(),
            ordering: Mutex::default(),
            arriving,
            leaving,
            earlier: Notify::new(),
            events,
            stop: CancellationToken::new(),
        };
        for job in kept.into_iter().flatten() {
            shell.take_up(job);
        }
        Ok(shell)
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().expect("deciding never panics")
    }

    /// Hands an event to the machine and does what it answers.
    fn tell<T>(&self, event: impl FnOnce(&mut State, Instant) -> (T, Vec<Action>)) -> T {
        let mut works = Works::default();
        let value = {
            let mut state = self.state();
            // Under the lock, so that the machine's time never runs backwards.
            let (value, actions) = event(&mut state, tokio::time::Instant::now().into_std());
            let now = tokio::time::Instant::now().into_std();
            for action in actions {
                self.act(&mut state, action, &mut works, now);
            }
            let wake = state.farm.next_wake();
            if wake.is_some_and(|wake| state.wakes_at.is_none_or(|at| wake < at)) {
                state.wakes_at = wake;
                self.earlier.notify_one();
            }
            value
        };
        for work in works.in_order {
            self.do_work(work);
        }
        for (job, progress) in works.progress.into_values() {
            let finished = match &progress.outcome {
                Some(Outcome::Finished(time)) => Some(*time),
                _ => None,
            };
            if job.publish(progress)
                && let Some(time) = finished
            {
                self.events.on_finished(job.id, time);
            }
        }
        value
    }

    fn tell_farm(&self, event: impl FnOnce(&mut Farm, Instant) -> Vec<Action>) {
        self.tell(|state, now| ((), event(&mut state.farm, now)));
    }

    /// Does at once what must be done in the order decided, and is quick.
    fn act(&self, state: &mut State, action: Action, works: &mut Works, now: Instant) {
        match action {
            Action::Answer(ask, answer) => {
                if let Some(reply) = state.asks.remove(&ask) {
                    // Who asked may have gone; the lease then runs out.
                    let _ = reply.send(answer);
                }
            }
            Action::Acknowledge(delivery, verdict) => state.acknowledge(delivery, verdict),
            Action::Publish(job, progress) => {
                if let Some(known) = state.jobs.get(&job) {
                    works.progress.insert(job, (Arc::clone(known), progress));
                }
            }
            Action::Store(delivery, job, tile) => {
                let so_far = state.farm.so_far(job, now);
                let known = state.jobs.get(&job).cloned();
                if let (Some((batch, index)), Some(job), Some((elapsed, worker_count))) =
                    (state.batch(delivery), known, so_far)
                {
                    let pixels = std::mem::take(&mut batch.pixels[index]);
                    let Delivery { hash, tally, seconds, .. } = batch.deliveries[index];
                    let record = TileRecord {
                        arrived: hash,
                        tally,
                        seconds: seconds as f32,
                        elapsed: elapsed.as_secs_f32(),
                        worker_count,
                    };
                    works.store(&job, (tile, pixels, record));
                }
            }
            Action::TakeBack(job, tiles) => {
                // At once, though it writes: what comes of these tiles next must not be cleared. It
                // is rare.
                if let Some(known) = state.jobs.get(&job)
                    && let Err(error) = known.canvas.clear(&tiles)
                {
                    works.in_order.push(Work::Fail(job, error.to_string()));
                }
            }
            Action::Reopen(job) => {
                works.in_order.extend(state.jobs.get(&job).cloned().map(Work::Reopen));
            }
            Action::Keep(job, terms) => {
                let job = state.jobs.get(&job).cloned();
                works.in_order.extend(job.map(|job| Work::Keep(job, terms)));
            }
            Action::KeepMarks(marks) => works.in_order.push(Work::KeepMarks(marks)),
            Action::Forget(job) => {
                works.in_order.extend(state.jobs.remove(&job).map(Work::Drop));
            }
            Action::Log(notice) => works.in_order.push(Work::Log(Box::new(notice))),
            Action::Stop => self.stop.cancel(),
        }
    }

    fn do_work(&self, work: Work) {
        match work {
            Work::Log(notice) => {
                self.events.on_notice(&notice);
                log::log(*notice);
            }
            Work::Drop(job) => job.forget(),
            Work::Reopen(job) => job.reopen(),
            Work::Keep(job, terms) => job.keep(terms),
            Work::KeepMarks(marks) => {
                let kept = self.folder.as_ref().map(|folder| folder.keep_marks(&marks));
                if let Some(Err(error)) = kept {
                    tracing::error!(reason = %error, "cannot keep what is known of workers");
                }
            }
            Work::Fail(job, reason) => {
                self.tell_farm(|farm, now| farm.on_store_failed(job, reason, now));
            }
            Work::Store(job, tiles) => {
                let put = tiles.iter().map(|&(tile, ref bytes, record)| CanvasTile {
                    tile,
                    bytes,
                    record,
                });
                let numbers: Vec<TileId> = tiles.iter().map(|&(tile, ..)| tile).collect();
                match job.canvas.put_all(&put.collect::<Vec<_>>()) {
                    Ok(()) => self.on_written(&job, &numbers),
                    Err(error) => {
                        self.tell_farm(|farm, now| {
                            farm.on_store_failed(job.id, error.to_string(), now)
                        });
                    }
                }
            }
        }
    }

    /// Tiles are written: a kill cannot take them any more.
    fn on_written(&self, job: &Arc<Job>, tiles: &[TileId]) {
        let is_safe = match &self.folder {
            Some(folder) => folder.durability == Durability::Second,
            None => true,
        };
        if job.canvas.is_kept() {
            let mut unsynced = self.unsynced.lock().expect("nothing here panics");
            let entry = unsynced.entry(job.id);
            let entry =
                entry.or_insert_with(|| Unsynced { job: Arc::clone(job), tiles: Vec::new() });
            if !is_safe {
                entry.tiles.extend(tiles);
            }
            self.written.notify_one();
        }
        if is_safe {
            self.on_stored(job.id, tiles);
        }
    }

    fn on_stored(&self, job: JobId, tiles: &[TileId]) {
        if !tiles.is_empty() {
            self.tell_farm(|farm, now| {
                tiles.iter().flat_map(|&tile| farm.on_stored(job, tile, now)).collect()
            });
        }
    }

    /// Makes all that was written outlive a power cut. Never call this on the async runtime.
    pub(crate) fn sync(&self) {
        let unsynced = std::mem::take(&mut *self.unsynced.lock().expect("nothing here panics"));
        for Unsynced { job, tiles } in unsynced.into_values() {
            match job.canvas.sync() {
                Ok(()) => self.on_stored(job.id, &tiles),
                Err(error) => {
                    let reason = format!("cannot make the picture safe: {error}");
                    self.tell_farm(|farm, now| farm.on_store_failed(job.id, reason, now));
                }
            }
        }
    }

    /// Makes what is written outlive a power cut, again and again. Does not return.
    pub(crate) async fn keep_synced(self: &Arc<Self>) {
        let is_lazy =
            self.folder.as_ref().is_none_or(|folder| folder.durability == Durability::Second);
        loop {
            self.written.notified().await;
            if is_lazy {
                tokio::time::sleep(SYNC_PERIOD).await;
            }
            let shell = Arc::clone(self);
            tokio::task::spawn_blocking(move || shell.sync()).await.expect("syncing never panics");
        }
    }

    /// Wakes the machine whenever it wants to be woken. Does not return.
    pub(crate) async fn keep_time(&self) {
        loop {
            let wake = {
                let mut state = self.state();
                state.wakes_at = state.farm.next_wake();
                state.wakes_at
            };
            let sleep = async {
                match wake {
                    Some(wake) => tokio::time::sleep_until(wake.into()).await,
                    None => pending().await,
                }
            };
            tokio::select! {
                biased;
                () = sleep => self.tell_farm(Farm::on_time),
                () = self.earlier.notified() => {}
            }
        }
    }

    /// Lets a call in that is meant for this incarnation.
    pub(crate) fn admit(&self, incarnation: u64) -> Result<(), Stranger> {
        self.tell(|state, _| state.farm.on_call(Incarnation(incarnation)))
    }

    /// Lets a client's call in that is meant for this farm. Who knows only the number of a job
    /// names none.
    pub(crate) fn admit_client(&self, farm: &[u8]) -> Result<(), Stranger> {
        let Identity { farm: ours, incarnation } = self.identity;
        let is_ours = farm.is_empty() || farm == ours.0;
        self.admit(if is_ours { incarnation.0 } else { 0 })
    }

    pub(crate) fn join(&self, process: Process) -> Result<WorkerId, KeptOut> {
        self.tell(|state, now| state.farm.on_join(process, now))
    }

    /// Asks for tiles, and waits for them that long.
    pub(crate) async fn ask(
        &self,
        worker: WorkerId,
        most: usize,
        wait: Duration,
    ) -> Result<Next, NoMember> {
        let (reply, answer) = oneshot::channel();
        let id = self.tell(|state, now| {
            let id = AskId(state.next_number());
            state.asks.insert(id, reply);
            (id, state.farm.on_ask(id, Ask { worker, most, until: now + wait }, now))
        });
        let _line = Line { shell: self, id };
        answer.await.expect("every question is answered")
    }

    /// Offers tiles of a job whose pixels a worker has. It gets those that it may bring.
    pub(crate) fn offer(&self, worker: WorkerId, job: JobId, tiles: &[u32]) -> Option<Run> {
        self.tell(|state, now| (state.farm.on_offer(worker, job, tiles, now), Vec::new()))
    }

    pub(crate) fn renew(
        &self,
        worker: WorkerId,
        renewals: &[Renewal],
    ) -> Result<Vec<LeaseName>, NoMember> {
        self.tell(|state, now| (state.farm.on_renew(worker, renewals, now), Vec::new()))
    }

    /// A tile of a job that is being rendered, and that job.
    pub(crate) fn tile(&self, job: JobId, number: u32) -> Option<(TileId, Arc<Job>)> {
        let state = self.state();
        let tile = state.farm.tile(job, number)?;
        Some((tile, Arc::clone(state.jobs.get(&job)?)))
    }

    /// Brings the pixels of tiles. The verdicts come when all are safe. This writes a file: never
    /// call it on the async runtime.
    pub(crate) fn deliver(&self, tiles: Vec<(Delivery, Bytes)>) -> oneshot::Receiver<Vec<Verdict>> {
        let (reply, verdicts) = oneshot::channel();
        let (deliveries, pixels): (Vec<Delivery>, Vec<Bytes>) = tiles.into_iter().unzip();
        let count = deliveries.len();
        self.tell(|state, now| {
            let first = state.last_number + 1;
            state.last_number += count as u64;
            let verdicts = vec![Verdict::Rejected; count];
            let numbered = (first..).map(DeliveryId).zip(deliveries.clone());
            let batch = Batch { deliveries, pixels, verdicts, undecided_count: count, reply };
            state.batches.insert(DeliveryId(first), batch);
            let arrived = |(id, delivery)| state.farm.on_pixels(id, delivery, now);
            ((), numbered.flat_map(arrived).collect())
        });
        verdicts
    }

    pub(crate) fn report_senseless_pixels(
        &self,
        worker: WorkerId,
        lease: LeaseName,
        tile: TileId,
        reason: &str,
    ) {
        self.tell_farm(|farm, now| farm.on_senseless_pixels(worker, lease, tile, reason, now));
    }

    pub(crate) fn leave(&self, worker: WorkerId, reason: &str) {
        self.tell_farm(|farm, now| farm.on_leave(worker, reason, now));
    }

    pub(crate) fn report_process_exit(&self, process: u32, reason: &str) {
        self.tell_farm(|farm, now| farm.on_process_exit(process, reason, now));
    }

    /// Takes an order, or finds the job of an earlier one with the same key. This writes files:
    /// never call it on the async runtime.
    pub(crate) fn submit(&self, order: Order, ticket: Ticket) -> Result<Arc<Job>, SubmitError> {
        let _alone = self.changing.lock().expect("writing never panics");
        if let Some(job) = self.claim(&ticket)? {
            return Ok(job);
        }
        let id = self.state().farm.number_job();
        let Some(folder) = &self.folder else {
            let picture_folder = &self.config.picture_folder;
            let canvas = Canvas::new_in(picture_folder, order.grid, order.format, order.transfer);
            let canvas =
                canvas.map_err(|error| SubmitError::Picture(picture_folder.clone(), error))?;
            return self.submit_on(id, (order, ticket), canvas, &[]);
        };
        let Order { name: _, prepared, settings, grid, transfer, format } = order;
        let scene_byte_count = prepared.as_ref().len() as u64;
        let plan =
            Plan { scene: prepared.hash(), scene_byte_count, settings, grid, format, transfer };
        let same = self.job_with_scene(plan.scene);
        let same = same.as_ref().map(|job| job.scene.path());
        let kept = folder.create_job(id, (&ticket, &plan), &prepared, same);
        let (scene, canvas, folder) = kept.map_err(SubmitError::State)?;
        let job = Job::new(id, ticket, &plan, scene, canvas, (Some(folder), false));
        self.begin(&job, Tiles::new(grid), Earlier::default(), false);
        Ok(job)
    }

    /// The job that the account's earlier order with the same key has, which another client is told
    /// of now. It fails if that order was another one.
    pub(crate) fn claim(&self, ticket: &Ticket) -> Result<Option<Arc<Job>>, SubmitError> {
        let Ticket { account, key, wanted, .. } = ticket;
        let has_key = |of: &Ticket| !key.is_empty() && (&of.account, &of.key) == (account, key);
        self.tell(|state, _| {
            let job = state.jobs.values().find(|job| has_key(&job.ticket)).cloned();
            let claimed = match job {
                Some(job) if job.ticket.wanted != *wanted => {
                    Err(SubmitError::Key(job.id, key.clone()))
                }
                Some(job) => {
                    state.farm.on_claim(job.id);
                    Ok(Some(job))
                }
                None => Ok(None),
            };
            (claimed, Vec::new())
        })
    }

    /// Who submitted a job has gone before he was told of it.
    pub(crate) fn abandon(&self, job: JobId) {
        self.tell_farm(|farm, now| farm.on_abandon(job, now));
    }

    /// Gives a number to a job that [`Shell::submit_on`] takes.
    pub(crate) fn number_job(&self) -> JobId {
        self.state().farm.number_job()
    }

    /// Takes an order whose picture is `canvas`; these tiles are in it already. This writes files:
    /// never call it on the async runtime.
    pub(crate) fn submit_on(
        &self,
        id: JobId,
        (order, ticket): (Order, Ticket),
        canvas: Canvas,
        done: &[(TileId, TileRecord)],
    ) -> Result<Arc<Job>, SubmitError> {
        let scene_folder = &self.config.scene_folder;
        let Order { name: _, prepared, settings, grid, transfer, format } = order;
        let scene = SceneFile::write(scene_folder, &prepared)
            .map_err(|error| SubmitError::Scene(scene_folder.clone(), error))?;
        drop(prepared);
        let (hash, scene_byte_count) = (scene.hash(), scene.byte_count());
        let plan = Plan { scene: hash, scene_byte_count, settings, grid, format, transfer };
        let job = Job::new(id, ticket, &plan, scene, canvas, (None, false));
        let (tiles, earlier) = progress_of(grid, done);
        if self.config.begins_coarsely && !tiles.is_over() {
            self.coarse(&job);
        }
        self.begin(&job, tiles, earlier, false);
        Ok(job)
    }

    /// The job of a coarse picture of what another job renders, before all others: it is made when
    /// there is none. Nobody is told of it but those who watch. This writes a file: never call it
    /// on the async runtime.
    pub(crate) fn coarse(&self, of: &Arc<Job>) -> Option<Arc<Job>> {
        let id = coarse_id(of.id);
        if let Some(known) = self.job(id) {
            return Some(known);
        }
        let plan = of.coarse()?;
        let Plan { scene, scene_byte_count, grid, format, transfer, .. } = plan;
        let canvas = Canvas::new_in(&self.config.picture_folder, grid, format, transfer).ok()?;
        // The file is that of the other job.
        let scene = SceneFile::kept(of.scene.path().to_owned(), scene, scene_byte_count);
        let name = format!("{}, coarse", of.ticket.name);
        let ticket = Ticket { name, priority: i32::MAX, ..Ticket::default() };
        let job = Job::new(id, ticket, &plan, scene, canvas, (None, false));
        self.state().coarse.insert(id);
        self.begin(&job, Tiles::new(grid), Earlier::default(), false);
        Some(job)
    }

    /// The coarse picture of what a job renders, if it was begun.
    pub(crate) fn coarse_of(&self, job: JobId) -> Option<Arc<Job>> {
        self.job(coarse_id(job))
    }

    fn begin(&self, job: &Arc<Job>, tiles: Tiles, earlier: Earlier, is_paused: bool) {
        tracing::info!(
            job = job.id.0,
            scene = job.ticket.name,
            size = %job.grid.window().size(),
            sampling = %job.settings.quality.sampling,
            transfer = ?job.canvas.picture().transfer(),
            tiles = job.grid.count(),
            side = job.grid.side(),
            scene_bytes = job.scene.byte_count(),
            done = (tiles.done_count() > 0).then_some(tiles.done_count()),
            "job started"
        );
        self.events.on_job(job.id, &job.ticket.name);
        self.tell(|state, now| {
            state.jobs.insert(job.id, Arc::clone(job));
            let terms = terms_of(job, is_paused, false);
            ((), state.farm.on_order(job.id, tiles, earlier, terms, now))
        });
    }

    /// Goes on with a job that an earlier coordinator left.
    fn take_up(&self, kept: KeptJob) {
        let KeptJob { id, ticket, is_paused, is_foreign, plan, scene, canvas, done, end, folder } =
            kept;
        let job = Job::new(id, ticket, &plan, scene, canvas, (Some(folder), is_foreign));
        if let Some((end, age)) = end {
            let terms = terms_of(&job, is_paused, is_foreign);
            // Who watches is not told of its end as of news.
            job.progress.send_replace(end.clone());
            self.tell(|state, now| {
                state.jobs.insert(id, job);
                ((), state.farm.on_kept(id, end, terms, (age, now)))
            });
        } else {
            let (tiles, earlier) = progress_of(plan.grid, &done);
            self.begin(&job, tiles, earlier, is_paused);
        }
    }

    /// Ends and forgets a job; says whether it was known.
    pub(crate) fn cancel(&self, job: JobId) -> bool {
        if self.state().coarse.remove(&coarse_id(job)) {
            self.tell_farm(|farm, now| farm.on_cancel(coarse_id(job), now));
        }
        self.tell(|state, now| (state.jobs.contains_key(&job), state.farm.on_cancel(job, now)))
    }

    /// Changes a job. This reads and writes files: never call it on the async runtime.
    pub(crate) fn change(&self, job: JobId, change: Change) -> Result<(), ChangeError> {
        let _alone = self.changing.lock().expect("writing never panics");
        let changed = self.tell(|state, now| state.farm.on_change(job, change, now));
        let (Err(Refused::TilesUnknown), Some(known)) = (changed, self.job(job)) else {
            return changed.map_err(ChangeError::Refused);
        };
        // It failed under an earlier start.
        let done = known.canvas.done().map_err(ChangeError::Picture)?;
        let tiles = progress_of(known.grid, &done);
        self.tell(|state, now| state.farm.on_retry(job, Some(tiles), now))
            .map_err(ChangeError::Refused)
    }

    /// The jobs that are known, and what there is to say of them.
    pub(crate) fn jobs(&self) -> Vec<(JobEntry, Arc<Job>)> {
        self.tell(|state, now| {
            let entries = state.farm.job_entries(now).into_iter();
            let known = |entry: JobEntry| {
                if state.coarse.contains(&entry.id) {
                    return None;
                }
                let job = state.jobs.get(&entry.id).cloned()?;
                Some((entry, job))
            };
            (entries.filter_map(known).collect(), Vec::new())
        })
    }

    /// The workers, and how many tiles each has.
    pub(crate) fn workers(&self) -> Vec<(MemberEntry, usize)> {
        self.tell(|state, now| (state.farm.worker_entries(now), Vec::new()))
    }

    /// Which tiles came into a job's picture, but for the first `seen`.
    pub(crate) fn arrived(&self, job: JobId, seen: usize) -> Option<Arrived> {
        self.state().farm.arrived(job, seen)
    }

    /// Says of each tile of a job whether it is in the picture, if that is known.
    pub(crate) fn done(&self, job: JobId) -> Option<Vec<bool>> {
        self.state().farm.done(job)
    }

    /// The tiles of a job that workers have, and whether they are known to have begun them.
    pub(crate) fn in_work(&self, job: JobId) -> Vec<(TileId, WorkerId, bool)> {
        self.state().farm.in_work(job)
    }

    /// Says whether nobody is there to render.
    pub(crate) fn lacks_workers(&self) -> bool {
        self.state().farm.lacks_workers()
    }

    /// What became of a tile.
    pub(crate) fn explain(&self, job: JobId, tile: TileId) -> Option<Explanation> {
        self.tell(|state, now| (state.farm.explain(job, tile, now), Vec::new()))
    }

    /// Decides what a worker gets.
    pub(crate) fn station(&self, worker: WorkerId, standing: Standing) -> Result<(), NoMember> {
        self.tell(|state, now| state.farm.on_station(worker, standing, now))
    }

    pub(crate) fn close(&self) {
        self.tell_farm(|farm, _| farm.on_close());
    }

    pub(crate) fn shut_down(&self) {
        self.tell_farm(Farm::on_shut_down);
    }

    /// A job that has not been forgotten.
    pub(crate) fn job(&self, job: JobId) -> Option<Arc<Job>> {
        self.state().jobs.get(&job).cloned()
    }

    /// A job that has not been forgotten and has this scene.
    pub(crate) fn job_with_scene(&self, hash: SceneHash) -> Option<Arc<Job>> {
        self.state().jobs.values().find(|job| job.scene.hash() == hash).cloned()
    }
}

/// The number of the coarse picture of what a job renders; no other job comes to have it.
fn coarse_id(of: JobId) -> JobId {
    JobId(!of.0)
}

/// What the machine knows of a job besides its tiles.
fn terms_of(job: &Job, is_paused: bool, is_foreign: bool) -> Terms {
    let Ticket { priority, most_workers, .. } = job.ticket;
    let (byte_count, scene_byte_count) = (job.byte_count(), job.scene.byte_count());
    Terms { priority, is_paused, most_workers, scene_byte_count, byte_count, is_foreign }
}

/// A picture's tiles, of which some are done, and what was done so far.
fn progress_of(grid: TileGrid, done: &[(TileId, TileRecord)]) -> (Tiles, Earlier) {
    // Not under the lock: there may be a million.
    let (mut tiles, mut earlier) = (Tiles::new(grid), Earlier::default());
    for (tile, record) in done {
        tiles.set_done(*tile, record.arrived);
        earlier.tally.add(&record.tally);
        let elapsed = Duration::try_from_secs_f32(record.elapsed).unwrap_or_default();
        earlier.elapsed = earlier.elapsed.max(elapsed);
        earlier.worker_count = earlier.worker_count.max(record.worker_count);
    }
    (tiles, earlier)
}

#[cfg(test)]
impl Shell {
    /// Checks every invariant of the machine, at the price of a scan.
    pub(crate) fn check(&self) {
        self.state().farm.check();
    }
}

impl State {
    /// The message that brought a tile, and which of its tiles that is.
    fn batch(&mut self, delivery: DeliveryId) -> Option<(&mut Batch, usize)> {
        let (first, batch) = self.batches.range_mut(..=delivery).next_back()?;
        let index = (delivery.0 - first.0) as usize;
        (index < batch.verdicts.len()).then_some((batch, index))
    }

    /// Answers a message when all of its tiles have a verdict.
    fn acknowledge(&mut self, delivery: DeliveryId, verdict: Verdict) {
        let Some((batch, index)) = self.batch(delivery) else { return };
        batch.verdicts[index] = verdict;
        batch.undecided_count -= 1;
        let first = DeliveryId(delivery.0 - index as u64);
        if batch.undecided_count == 0
            && let Some(batch) = self.batches.remove(&first)
        {
            // The worker may have gone; another delivers its tiles again.
            let _ = batch.reply.send(batch.verdicts);
        }
    }

    fn next_number(&mut self) -> u64 {
        self.last_number += 1;
        self.last_number
    }
}

/// A question on which somebody hangs on. It hangs up when it is dropped.
struct Line<'a> {
    shell: &'a Shell,
    id: AskId,
}

impl Drop for Line<'_> {
    fn drop(&mut self) {
        let mut state = self.shell.state();
        if state.asks.remove(&self.id).is_some() {
            state.farm.on_hang_up(self.id);
        }
    }
}
