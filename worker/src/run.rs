//! A worker as a process: it does what [`Worker`] decides, and tells it what came of it.

use std::{
    collections::HashMap,
    future::pending,
    ops::ControlFlow,
    panic::resume_unwind,
    pin::pin,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    time::Duration,
};

use crate::{
    call::{Answer, Call, CallError, CallErrorKind, Delivery},
    client,
    config::Config,
    error::WorkerError,
    job::Job,
    outbox::Outbox,
    outside::{Machine, Outside},
    pulse::Pulse,
    scene::{self, Scene, SceneError},
    task::{Action, TaskId},
    worker::Worker,
};
use rtfarm_core::{prepared::SceneHash, render::render_tile, tile::TileId};
use rtfarm_proto::{
    Address, LeaseName, pixels_to_bytes,
    wire::{self, farm_client::FarmClient},
};
use tokio::{
    sync::mpsc,
    task::{AbortHandle, JoinError, JoinSet},
    time::Instant,
};

/// Works for the coordinator until that sends it home or `shutdown` comes, which says how long the
/// tiles in hand may still take.
pub async fn run(
    config: Config,
    shutdown: impl Future<Output = Duration>,
) -> Result<(), WorkerError> {
    let machine = Machine::new(config.threads)?;
    run_in(machine, config, random()?, shutdown).await
}

/// The same in any surroundings. `nonce` should differ between workers.
pub async fn run_in(
    outside: impl Outside,
    config: Config,
    nonce: u64,
    shutdown: impl Future<Output = Duration>,
) -> Result<(), WorkerError> {
    let mut worker = Worker::new(&config, nonce, now());
    let mut shell = Shell::new(outside, config, nonce);
    let mut shutdown = pin!(shutdown);
    let mut is_stopped = false;
    loop {
        while let Some(action) = worker.next_action() {
            if let ControlFlow::Break(exit) = shell.execute(action) {
                return exit;
            }
        }
        tokio::select! {
            // Always in the same order, so that a simulation can be repeated; the rarest first.
            biased;
            grace = &mut shutdown, if !is_stopped => {
                is_stopped = true;
                worker.on_stop(grace, now());
            }
            () = sleep_until(worker.wake_at()) => worker.on_tick(now()),
            Some(()) = shell.beats.recv() => worker.on_beat(&shell.pulse.count(), now()),
            Some(report) = shell.reports.join_next() => shell.pass_on(report, &mut worker),
            () = shell.outbox.due() => {
                let rendered = shell.outbox.take();
                for (task, _) in &rendered {
                    shell.renderings.remove(task);
                }
                worker.on_tiles_rendered(rendered, now());
            }
        }
    }
}

fn random() -> rustix::io::Result<u64> {
    let mut bytes = [0; 8];
    rustix::rand::getrandom(&mut bytes, rustix::rand::GetRandomFlags::empty())?;
    Ok(u64::from_ne_bytes(bytes))
}

fn now() -> std::time::Instant {
    Instant::now().into_std()
}

/// Waits for a moment; for ever when there is none.
async fn sleep_until(moment: Option<std::time::Instant>) {
    match moment {
        Some(moment) => tokio::time::sleep_until(Instant::from_std(moment)).await,
        None => pending().await,
    }
}

/// The tasks that run, and what they need.
struct Shell<O: Outside> {
    outside: Arc<O>,
    config: Config,
    introduction: Arc<wire::JoinRequest>,
    client: Option<FarmClient<O::Connection>>,
    scenes: HashMap<SceneHash, Arc<Scene>>,
    /// Calls and fetches.
    reports: JoinSet<(TaskId, Report<O::Connection>)>,
    /// How each of them is stopped.
    running: HashMap<TaskId, AbortHandle>,
    renderings: HashMap<TaskId, Rendering>,
    outbox: Arc<Outbox>,
    pulse: Arc<Pulse>,
    beats: mpsc::Receiver<()>,
}

/// What came of a call or a fetch.
enum Report<C> {
    Connected(FarmClient<C>),
    Answered(Answer),
    Failed(CallError),
    Fetched(SceneHash, Arc<Scene>),
    FetchFailed(SceneError),
}

impl<C> Report<C> {
    fn unreached(reason: String) -> Self {
        Self::Failed(CallError { kind: CallErrorKind::NoAnswer, message: reason })
    }
}

/// A tile in the hands of the threads. Dropping this stops it.
struct Rendering {
    is_stopped: Arc<AtomicBool>,
}

impl Drop for Rendering {
    fn drop(&mut self) {
        self.is_stopped.store(true, Ordering::Relaxed);
    }
}

impl<O: Outside> Shell<O> {
    fn new(outside: O, config: Config, nonce: u64) -> Self {
        // Nothing beats before the worker has joined and chosen the period.
        let (pulse, beats) = Pulse::new(Duration::ZERO);
        Self {
            outside: Arc::new(outside),
            introduction: Arc::new(client::introduction(&config, nonce)),
            outbox: Arc::new(Outbox::new(config.threads)),
            config,
            client: None,
            scenes: HashMap::new(),
            reports: JoinSet::new(),
            running: HashMap::new(),
            renderings: HashMap::new(),
            pulse: Arc::new(pulse),
            beats,
        }
    }

    /// Does what was decided. Breaks when that is to end.
    fn execute(&mut self, action: Action) -> ControlFlow<Result<(), WorkerError>> {
        match action {
            Action::Call(task, call) => self.call(task, call),
            Action::Fetch { task, job, lease, silence } => self.fetch(task, job, lease, silence),
            Action::Render { task, lease, tile, job } => self.render(task, lease, tile, job),
            Action::Stop(task) => {
                self.renderings.remove(&task);
                if let Some(running) = self.running.remove(&task) {
                    running.abort();
                }
            }
            Action::ForgetScene(scene) => drop(self.scenes.remove(&scene)),
            Action::HearBeats { period } => {
                let (pulse, beats) = Pulse::new(period);
                (self.pulse, self.beats) = (Arc::new(pulse), beats);
            }
            Action::Exit(exit) => return ControlFlow::Break(exit),
        }
        ControlFlow::Continue(())
    }

    fn call(&mut self, task: TaskId, call: Call) {
        let Some(client) = self.client.clone() else {
            let (outside, access) = (Arc::clone(&self.outside), self.config.coordinator.clone());
            return self.start(task, async move {
                let connected = outside.connect(&access).await.map(client::over);
                connected.map_or_else(Report::unreached, Report::Connected)
            });
        };
        let introduction = Arc::clone(&self.introduction);
        self.start(task, async move {
            let answer = client::ask(client, introduction, call).await;
            answer.map_or_else(Report::Failed, Report::Answered)
        });
    }

    fn fetch(&mut self, task: TaskId, job: Arc<Job>, lease: LeaseName, silence: Duration) {
        let (outside, pulse) = (Arc::clone(&self.outside), Arc::clone(&self.pulse));
        let access = self.config.coordinator.clone();
        self.start(task, async move {
            let hash = job.scene;
            let beat = move || pulse.beat((lease, None));
            // A connection of its own: what comes over it takes no share from calls.
            let connect = async || outside.connect(&access).await.map(client::over);
            let is_local = matches!(access.address(), Address::Unix(_));
            let loaded = match scene::bring(&job, is_local, silence, connect, &beat).await {
                Ok(file) => outside.block(move || scene::open(&file, &job, &beat)).await,
                Err(error) => Err(error),
            };
            loaded.map_or_else(Report::FetchFailed, |scene| Report::Fetched(hash, scene))
        });
    }

    fn start(
        &mut self,
        task: TaskId,
        work: impl Future<Output = Report<O::Connection>> + Send + 'static,
    ) {
        let handle = self.reports.spawn(async move { (task, work.await) });
        self.running.insert(task, handle);
    }

    fn pass_on(
        &mut self,
        report: Result<(TaskId, Report<O::Connection>), JoinError>,
        worker: &mut Worker,
    ) {
        let (task, report) = match report {
            Ok(report) => report,
            Err(error) if error.is_panic() => resume_unwind(error.into_panic()),
            // It was stopped.
            Err(_) => return,
        };
        if self.running.remove(&task).is_none() {
            // It was stopped a moment too late.
            return;
        }
        match report {
            Report::Connected(client) => {
                self.client = Some(client);
                worker.on_answer(task, Answer::Connected, now());
            }
            Report::Answered(answer) => worker.on_answer(task, answer, now()),
            Report::Failed(error) => worker.on_call_failed(task, error, now()),
            Report::Fetched(hash, scene) => {
                self.scenes.insert(hash, scene);
                worker.on_fetched(task, now());
            }
            Report::FetchFailed(error) => worker.on_fetch_failed(task, error, now()),
        }
    }

    /// Has a tile rendered, as one piece of work of the threads.
    fn render(&mut self, task: TaskId, lease: LeaseName, tile: TileId, job: Arc<Job>) {
        let is_stopped = Arc::new(AtomicBool::new(false));
        self.renderings.insert(task, Rendering { is_stopped: Arc::clone(&is_stopped) });
        let scene = Arc::clone(&self.scenes[&job.scene]);
        let (pulse, outbox) = (Arc::clone(&self.pulse), Arc::clone(&self.outbox));
        outbox.on_begun();
        let isa = self.config.isa;
        self.outside.render(move |started| {
            let mut on_progress = || {
                pulse.beat((lease, Some(tile)));
                if is_stopped.load(Ordering::Relaxed) {
                    ControlFlow::Break(())
                } else {
                    ControlFlow::Continue(())
                }
            };
            let area = job.grid.area(tile);
            let rendered = match on_progress() {
                ControlFlow::Continue(()) => {
                    render_tile(&scene, &job.settings.quality, area, isa, &mut on_progress)
                }
                ControlFlow::Break(()) => None,
            };
            let delivery = rendered.map(|rendered| {
                let pixels = pixels_to_bytes(rendered.pixels);
                let hash = job.hasher.hash(tile, &pixels);
                let seconds = started.elapsed().as_secs_f64();
                Delivery { lease, tile, pixels, hash, tally: rendered.tally, seconds }
            });
            outbox.put((task, delivery));
        });
    }
}
