//! A worker's life: it joins, asks for tiles, has them rendered, brings them, leaves.

use std::{
    collections::BTreeMap,
    future::pending,
    ops::ControlFlow,
    pin::{Pin, pin},
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    time::Duration,
};

use backon::{ExponentialBuilder, Retryable};
use rayon::{ThreadPool, ThreadPoolBuildError, ThreadPoolBuilder};
use rtfarm_core::{isa::Isa, prepared::SceneHash, render::render_tile, tile::TileId};
use rtfarm_proto::{
    Address, LONGEST_WAIT, LeaseName, MESSAGE_BYTES, PROTOCOL, WorkerId, pixels_to_bytes,
    wire::{self, farm_client::FarmClient, lease_response::Next},
};
use tokio::{sync::mpsc, task::JoinSet, time::Instant};
use tonic::{Code, Response, Status, transport::Channel};

use crate::{
    pulse::Pulse,
    scene::{Description, Scene, SceneError, load},
};

/// How a worker works.
#[derive(Debug, Clone)]
pub struct Config {
    /// Where its coordinator is.
    pub coordinator: Address,
    /// Threads that render, at least 1.
    pub threads: usize,
    /// What they render with.
    pub isa: Isa,
    /// The version of the package; the coordinator must have the same.
    pub version: String,
    /// How long it goes on without a coordinator.
    pub patience: Duration,
}

/// Why a worker ends before it is told to.
#[derive(Debug, thiserror::Error)]
pub enum WorkerError {
    /// There is nobody at the address.
    #[error("no coordinator answers at {0}: {1}")]
    Connect(Address, String),
    /// The coordinator will not have it.
    #[error("the coordinator refuses this worker: {}", .0.message())]
    Refused(Status),
    /// The coordinator is not heard of any more.
    #[error("the coordinator is gone: {}", .0.message())]
    Gone(Status),
    /// A job cannot be worked on.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// No threads.
    #[error("cannot start threads: {0}")]
    Threads(#[from] ThreadPoolBuildError),
    /// No random number.
    #[error("the system gives no random numbers: {0}")]
    Random(#[from] rustix::io::Errno),
}

/// The longest that a short question may wait for its answer.
const DEADLINE: Duration = Duration::from_secs(15);

/// Tiles that a thread may have before it, so that it never waits for the network.
const TILES_AHEAD: usize = 2;

/// Works for the coordinator until that sends it home or `shutdown` comes.
pub async fn run(config: Config, shutdown: impl Future<Output = ()>) -> Result<(), WorkerError> {
    let mut shutdown = pin!(shutdown);
    let pool = ThreadPoolBuilder::new()
        .num_threads(config.threads)
        .thread_name(|index| format!("render-{index}"))
        .build()?;
    let nonce = random()?;
    let mut client = tokio::select! {
        client = connect(&config) => client?,
        () = &mut shutdown => return Ok(()),
    };
    loop {
        let member = tokio::select! {
            member = join(&config, &client, nonce) => member?,
            () = &mut shutdown => return Ok(()),
        };
        let ended = tokio::select! {
            ended = member.work(&pool) => ended,
            () = &mut shutdown => {
                member.leave("it was stopped").await;
                return Ok(());
            }
        };
        match ended {
            Ok(()) => return Ok(()),
            // The coordinator does not know this worker any more.
            Err(WorkerError::Gone(status)) if status.code() == Code::NotFound => {
                tracing::warn!(reason = status.message(), "joining again");
                client = member.client;
            }
            Err(error) => {
                member.leave(&error.to_string()).await;
                return Err(error);
            }
        }
    }
}

fn random() -> rustix::io::Result<u64> {
    let mut bytes = [0; 8];
    rustix::rand::getrandom(&mut bytes, rustix::rand::GetRandomFlags::empty())?;
    Ok(u64::from_ne_bytes(bytes))
}

async fn connect(config: &Config) -> Result<FarmClient<Channel>, WorkerError> {
    let connect = || config.coordinator.connect();
    let channel = connect.retry(backoff(config.patience)).await.map_err(|error| {
        let mut reason: &dyn std::error::Error = &error;
        while let Some(source) = reason.source() {
            reason = source;
        }
        WorkerError::Connect(config.coordinator.clone(), reason.to_string())
    })?;
    Ok(FarmClient::new(channel)
        .max_decoding_message_size(MESSAGE_BYTES)
        .max_encoding_message_size(MESSAGE_BYTES))
}

fn backoff(patience: Duration) -> ExponentialBuilder {
    ExponentialBuilder::default()
        .with_jitter()
        .with_min_delay(Duration::from_millis(50))
        .with_max_delay(Duration::from_secs(2))
        .with_total_delay(Some(patience))
        .without_max_times()
}

async fn join(
    config: &Config,
    client: &FarmClient<Channel>,
    nonce: u64,
) -> Result<Member, WorkerError> {
    let request = wire::JoinRequest {
        version: config.version.clone(),
        protocol: PROTOCOL,
        nonce,
        threads: u32::try_from(config.threads).unwrap_or(u32::MAX),
        isa: config.isa.to_string(),
        host: rustix::system::uname().nodename().to_string_lossy().into_owned(),
        process: std::process::id(),
    };
    let joined = call(config.patience, DEADLINE, || {
        let (mut client, request) = (client.clone(), request.clone());
        async move { client.join(request).await }
    });
    let joined = joined.await.map_err(|status| match status.code() {
        Code::FailedPrecondition | Code::InvalidArgument => WorkerError::Refused(status),
        _ => WorkerError::Gone(status),
    })?;
    let worker = WorkerId(joined.worker);
    let term = Duration::from_millis(joined.term_ms.into());
    tracing::info!(worker = worker.0, coordinator = %config.coordinator, "joined");
    Ok(Member { config: config.clone(), client: client.clone(), worker, term })
}

/// Asks until there is an answer. A coordinator that is there but slow is waited for; one that
/// is not there, for as long as `patience` lasts.
async fn call<T, F>(
    patience: Duration,
    deadline: Duration,
    ask: impl Fn() -> F,
) -> Result<T, Status>
where
    F: Future<Output = Result<Response<T>, Status>>,
{
    let attempt = || async {
        match tokio::time::timeout(deadline, ask()).await {
            Ok(answer) => answer.map(Response::into_inner),
            Err(_) => Err(Status::deadline_exceeded("no answer in time")),
        }
    };
    let is_transient = |status: &Status| {
        matches!(
            status.code(),
            Code::Unavailable
                | Code::DeadlineExceeded
                | Code::Unknown
                | Code::Cancelled
                | Code::DataLoss
        )
    };
    let notify = |status: &Status, delay: Duration| {
        tracing::debug!(reason = status.message(), ?delay, "asking again");
    };
    attempt.retry(backoff(patience)).when(is_transient).notify(notify).await
}

/// A worker that has joined.
struct Member {
    config: Config,
    client: FarmClient<Channel>,
    worker: WorkerId,
    term: Duration,
}

/// The leases that a member knows to have. Dropping one stops the rendering under it.
#[derive(Default)]
struct Held(BTreeMap<LeaseName, Lease>);

struct Lease {
    is_over: Arc<AtomicBool>,
    /// Tiles that wait or are being rendered.
    tiles_left: usize,
}

impl Drop for Lease {
    fn drop(&mut self) {
        self.is_over.store(true, Ordering::Relaxed);
    }
}

impl Held {
    fn tiles_left(&self) -> usize {
        self.0.values().map(|lease| lease.tiles_left).sum()
    }

    fn on_tile_rendered(&mut self, name: LeaseName) {
        if let Some(lease) = self.0.get_mut(&name) {
            lease.tiles_left -= 1;
            if lease.tiles_left == 0 {
                self.0.remove(&name);
            }
        }
    }
}

/// A run of tiles whose scene has to be brought.
struct Run {
    lease: LeaseName,
    tiles: Vec<TileId>,
    job: Description,
}

/// A tile that a thread has done with.
struct Rendered {
    lease: LeaseName,
    /// Ready to be sent, unless the work was stopped.
    delivery: Option<wire::DeliverRequest>,
}

type Slot<T> = Option<Pin<Box<dyn Future<Output = T> + Send>>>;

/// Waits for the future in a slot; for ever when there is none.
async fn finished<T>(slot: &mut Slot<T>) -> T {
    let Some(future) = slot else { return pending().await };
    let output = future.await;
    *slot = None;
    output
}

impl Member {
    /// Renders what there is to render, until sent home.
    async fn work(&self, pool: &ThreadPool) -> Result<(), WorkerError> {
        let threads = pool.current_num_threads();
        let (pulse, mut beats) = Pulse::new(self.term / 4);
        let pulse = Arc::new(pulse);
        let (send, mut rendered) = mpsc::channel(threads);
        let mut held = Held::default();
        let mut scene: Option<(SceneHash, Arc<Scene>)> = None;
        let mut asking: Slot<Result<Next, WorkerError>> = None;
        let mut loading: Slot<Result<(Run, Arc<Scene>), SceneError>> = None;
        let mut renewing: Slot<Result<Vec<LeaseName>, WorkerError>> = None;
        let mut delivering: JoinSet<Result<(), WorkerError>> = JoinSet::new();

        loop {
            let is_short = held.tiles_left() < TILES_AHEAD * threads;
            if is_short && asking.is_none() && loading.is_none() {
                asking = Some(Box::pin(self.ask((LONGEST_RUN_A_THREAD * threads) as u32)));
            }
            tokio::select! {
                next = finished(&mut asking) => match next? {
                    Next::Run(run) => {
                        let run = read_run(run)?;
                        let lease = Lease {
                            is_over: Arc::default(),
                            tiles_left: run.tiles.len(),
                        };
                        held.0.insert(run.lease, lease);
                        let known = scene.clone().filter(|(hash, _)| *hash == run.job.hash);
                        let (client, pulse) = (self.client.clone(), Arc::clone(&pulse));
                        loading = Some(Box::pin(async move {
                            let scene = match known {
                                Some((_, scene)) => scene,
                                None => load(run.job.clone(), client, pulse).await?,
                            };
                            Ok((run, scene))
                        }));
                    }
                    Next::Nothing(_) => {}
                    Next::ShutDown(_) => {
                        tracing::info!(worker = self.worker.0, "sent home");
                        return Ok(());
                    }
                },
                loaded = finished(&mut loading) => {
                    let (run, loaded) = loaded?;
                    scene = Some((run.job.hash, Arc::clone(&loaded)));
                    if let Some(lease) = held.0.get(&run.lease) {
                        self.start(pool, &run, &loaded, &lease.is_over, &pulse, &send);
                    }
                }
                Some(tile) = rendered.recv(), if delivering.len() < TILES_AHEAD * threads => {
                    held.on_tile_rendered(tile.lease);
                    if let Some(delivery) = tile.delivery {
                        delivering.spawn(self.deliver(delivery));
                    }
                }
                Some(delivered) = delivering.join_next() => match delivered {
                    Ok(delivered) => delivered?,
                    Err(error) => return Err(WorkerError::Gone(Status::internal(error.to_string()))),
                },
                Some(()) = beats.recv(), if renewing.is_none() && !held.0.is_empty() => {
                    renewing = Some(Box::pin(self.renew(held.0.keys().copied().collect())));
                }
                lost = finished(&mut renewing) => {
                    for name in lost? {
                        if held.0.remove(&name).is_some() {
                            tracing::info!(worker = self.worker.0, ?name, "lost a lease");
                        }
                    }
                }
            }
        }
    }

    /// Has every tile of a run rendered, each as one job of the pool.
    fn start(
        &self,
        pool: &ThreadPool,
        run: &Run,
        scene: &Arc<Scene>,
        is_over: &Arc<AtomicBool>,
        pulse: &Arc<Pulse>,
        send: &mpsc::Sender<Rendered>,
    ) {
        for &tile in &run.tiles {
            let (lease, job, worker) = (run.lease, run.job.clone(), self.worker);
            let (scene, is_over) = (Arc::clone(scene), Arc::clone(is_over));
            let (pulse, send, isa) = (Arc::clone(pulse), send.clone(), self.config.isa);
            pool.spawn_fifo(move || {
                let started = Instant::now();
                let mut on_progress = || {
                    pulse.beat();
                    if is_over.load(Ordering::Relaxed) {
                        ControlFlow::Break(())
                    } else {
                        ControlFlow::Continue(())
                    }
                };
                let area = job.grid.area(tile);
                let pixels = match on_progress() {
                    ControlFlow::Continue(()) => {
                        render_tile(&scene, &job.settings.quality, area, isa, &mut on_progress)
                    }
                    ControlFlow::Break(()) => None,
                };
                let delivery = pixels.map(|tile_pixels| {
                    let pixels = pixels_to_bytes(&tile_pixels.pixels);
                    wire::DeliverRequest {
                        worker: worker.0,
                        lease: Some(lease.into()),
                        tile: tile.number(),
                        hash: blake3::hash(&pixels).as_bytes().to_vec().into(),
                        pixels,
                        tally: Some(tile_pixels.tally.into()),
                        seconds: started.elapsed().as_secs_f64(),
                    }
                });
                // Nobody listens when the worker is leaving.
                let _ = send.blocking_send(Rendered { lease, delivery });
            });
        }
    }

    fn ask(&self, max_tiles: u32) -> impl Future<Output = Result<Next, WorkerError>> + use<> {
        let (client, patience) = (self.client.clone(), self.config.patience);
        let wait_ms = u32::try_from(LONGEST_WAIT.as_millis()).unwrap_or(u32::MAX);
        let request = wire::LeaseRequest { worker: self.worker.0, max_tiles, wait_ms };
        async move {
            let answer = call(patience, LONGEST_WAIT + DEADLINE, || {
                let mut client = client.clone();
                async move { client.lease(request).await }
            });
            let answer = answer.await.map_err(WorkerError::Gone)?;
            Ok(answer.next.unwrap_or(Next::Nothing(wire::Nothing {})))
        }
    }

    fn renew(
        &self,
        leases: Vec<LeaseName>,
    ) -> impl Future<Output = Result<Vec<LeaseName>, WorkerError>> + use<> {
        let (client, patience) = (self.client.clone(), self.config.patience);
        let leases = leases.into_iter().map(Into::into).collect();
        let request = wire::RenewRequest { worker: self.worker.0, leases };
        async move {
            let answer = call(patience, DEADLINE, || {
                let (mut client, request) = (client.clone(), request.clone());
                async move { client.renew(request).await }
            });
            let answer = answer.await.map_err(WorkerError::Gone)?;
            Ok(answer.lost.into_iter().map(Into::into).collect())
        }
    }

    /// Brings a tile. Its pixels are kept until the coordinator has answered.
    fn deliver(
        &self,
        delivery: wire::DeliverRequest,
    ) -> impl Future<Output = Result<(), WorkerError>> + use<> {
        let (client, patience) = (self.client.clone(), self.config.patience);
        async move {
            let answer = call(patience, DEADLINE * 2, || {
                let (mut client, delivery) = (client.clone(), delivery.clone());
                async move { client.deliver(delivery).await }
            });
            let answer = answer.await.map_err(WorkerError::Gone)?;
            tracing::debug!(tile = delivery.tile, verdict = ?answer.verdict(), "delivered");
            Ok(())
        }
    }

    /// Gives every lease back, if the coordinator can still be told.
    async fn leave(&self, reason: &str) {
        let mut client = self.client.clone();
        let request = wire::LeaveRequest { worker: self.worker.0, reason: reason.to_owned() };
        let _ = tokio::time::timeout(Duration::from_secs(1), client.leave(request)).await;
    }
}

/// The longest run that is asked for, in tiles a thread.
const LONGEST_RUN_A_THREAD: usize = 32;

fn read_run(run: wire::Run) -> Result<Run, SceneError> {
    use rtfarm_proto::WireError::Missing;

    let lease = run.lease.ok_or(Missing("lease"))?.into();
    let job: Description = run.job.ok_or(Missing("job"))?.try_into()?;
    let tiles = run.tiles.iter().map(|&number| job.grid.tile(number).ok_or(Missing("tile")));
    let tiles = tiles.collect::<Result<_, _>>()?;
    Ok(Run { lease, tiles, job })
}
