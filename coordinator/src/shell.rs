//! The shell of the machine: it hands events to it, with the time, and does what it answers.
//! Nothing is decided here.

mod jobs;
mod log;
mod workers;

use std::{
    collections::{BTreeMap, BTreeSet, HashMap},
    future::pending,
    io,
    path::PathBuf,
    sync::{Arc, Mutex, MutexGuard},
    time::{Duration, Instant},
};

use rtfarm_core::tile::TileId;
use rtfarm_job::{Outcome, Progress};
use rtfarm_picture::{CanvasTile, TileRecord};
use rtfarm_proto::{Bytes, Incarnation, JobId};
use tokio::sync::{Notify, oneshot};
use tokio_util::sync::CancellationToken;

use crate::{
    audit::Audit,
    events::Events,
    farm::{Action, Delivery, DeliveryId, Farm, Keeping, Next, Notice, Refused, Terms, Verdict},
    flight::Flight,
    identity::{Identity, Stranger},
    job::Job,
    members::{Mark, NoMember},
    state::{Durability, StateFolder},
    upload::OrderLimits,
    waiting::AskId,
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

    pub(crate) fn close(&self) {
        self.tell_farm(|farm, _| farm.on_close());
    }

    pub(crate) fn shut_down(&self) {
        self.tell_farm(Farm::on_shut_down);
    }
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
