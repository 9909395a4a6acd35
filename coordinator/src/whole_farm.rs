//! A whole farm in one thread, under a clock and a network of its own: the real coordinator with its
//! services and its state on disk, real workers, the bytes that they exchange. Only threads, wires and
//! clients are played. A seed says all that happens; `RTFARM_SEED=7` repeats one, `RTFARM_FAULTS=1000000`
//! goes on from seed to seed until so many faults were injected.

use std::{
    collections::{BTreeMap, BTreeSet},
    fmt,
    future::pending,
    ops::ControlFlow,
    path::Path,
    pin::Pin,
    sync::{Arc, Mutex, MutexGuard, OnceLock},
    task::{Context, Poll},
    time::Duration,
};

use http_body_util::{BodyExt, BodyStream, Full, StreamBody};
use prost::Message;
use rtfarm_core::{
    isa::Isa,
    prepared::PreparedScene,
    render::{Quality, Sampling, render_tile},
    transfer::Transfer,
};
use rtfarm_job::{Order, RenderRequest};
use rtfarm_picture::{Disk, Picture, PictureFormat};
use rtfarm_proto::{
    Access, Address, Bytes, JobId, PROTOCOL,
    wire::{
        self, Verdict, event::End, jobs_client::JobsClient, lease_response, submit_request::Part,
        submit_response::Outcome,
    },
};
use rtfarm_worker::{
    WorkerError,
    simulation::{Outside, run_in},
};
use tempfile::TempDir;
use tokio::{
    sync::{Semaphore, oneshot},
    time::{Instant, Sleep, sleep, sleep_until, timeout},
};
use tokio_stream::StreamExt;
use tokio_util::sync::CancellationToken;
use tonic::{
    Code, Status,
    body::Body,
    codegen::{BoxFuture, Service, http},
};

use crate::{
    Config,
    farm::Keeping,
    identity::Identity,
    service::{FarmService, JobsService, services},
    shell::Shell,
    simulation::SplitMix64,
    state::{Durability, StateFolder},
};

const SEEDS: u64 = 500;

const TERM: Duration = Duration::from_secs(4);

/// Faults of one seed, and how long they may come.
const MOST_FAULTS: u32 = 100;
const FAULTY: Duration = Duration::from_secs(90);

/// Without faults, all pictures are ready so much later.
const CALM: Duration = Duration::from_secs(240);

/// Calls that a coordinator hears in a seed, at the most.
const MOST_CALLS: u32 = 20_000;

/// Clients, the pictures that each orders, and what tiles these have.
const CLIENTS: usize = 2;
const PICTURES: usize = 1;
const FRAME: (u64, u64) = (40, 24);
const SIDE: u64 = 8;

/// Pictures differ in their backgrounds.
fn scene(number: usize) -> String {
    format!(
        "viewport\norigin 0 0 -2\ntopleft -1 1 0\nbottomleft -1 -1 0\ntopright 1 1 0\n\
         background {} 20 200\nendviewport\n",
        number * 9
    )
}

fn request() -> RenderRequest {
    RenderRequest {
        name: "test".to_owned(),
        strict: false,
        size: Some(rtfarm_core::tile::Size::new(FRAME.0, FRAME.1).unwrap()),
        crop: None,
        quality: Quality { sampling: Sampling::fixed(1).unwrap(), ..Quality::default() },
        tile_side: Some(SIDE),
        transfer: Transfer::None,
        format: PictureFormat::Png8,
    }
}

/// What a picture's file must be: it is rendered without a farm.
fn expected(number: usize) -> &'static [u8] {
    static PNGS: OnceLock<Vec<Vec<u8>>> = OnceLock::new();
    let render = |number| {
        let nothing = |_: &str| Err(std::io::ErrorKind::NotFound.into());
        let order = request().place(scene(number).as_bytes(), &nothing).order.unwrap();
        let Order { prepared, settings, grid, transfer, format, .. } = order;
        let prepared = PreparedScene::open(prepared).unwrap();
        let picture = Picture::new_in(Path::new("/tmp"), grid.window(), format, transfer).unwrap();
        for tile in grid.render_order() {
            let mut go_on = || ControlFlow::Continue(());
            let area = grid.area(tile);
            let tile = render_tile(&prepared, &settings.quality, area, Isa::Scalar, &mut go_on);
            picture.put(area, &tile.unwrap().pixels).unwrap();
        }
        let mut file = std::io::Cursor::new(Vec::new());
        picture.encode(&mut file).unwrap();
        file.into_inner()
    };
    &PNGS.get_or_init(|| (0..CLIENTS * PICTURES).map(render).collect())[number]
}

/// What goes wrong.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Fault {
    Lost,
    Delayed,
    Duplicated,
    Damaged,
    Partition,
    WorkerKilled,
    WorkerStopped,
    SlowTile,
    Lie,
    Nonsense,
    CoordinatorKilled,
    KilledInAWrite,
    ClientKilled,
    ClockJump,
}

/// A machine of the farm.
struct Host {
    threads: usize,
    slowness: u32,
    is_liar: bool,
    /// Until when it hears and says nothing, and whether who calls is told.
    cut: Mutex<(Instant, bool)>,
}

/// One start of the coordinator.
struct Start {
    shell: Arc<Shell>,
    farm: wire::farm_server::FarmServer<FarmService>,
    jobs: wire::jobs_server::JobsServer<JobsService>,
    disk: Disk,
    /// It was killed.
    over: CancellationToken,
}

/// What must be true.
#[derive(Default)]
struct Ledger {
    leases: BTreeSet<(u64, u64)>,
    /// Tiles whose pixels were acknowledged as the first, and how often.
    accepted: BTreeMap<(u64, u32), u32>,
    pictures: u32,
    failures: u32,
    restarts: u32,
    calls: u32,
}

struct World {
    seed: u64,
    folder: TempDir,
    durability: Option<Durability>,
    began: Instant,
    random: Mutex<SplitMix64>,
    faults: Mutex<BTreeMap<Fault, u32>>,
    hosts: Vec<Host>,
    current: Mutex<Option<Arc<Start>>>,
    ledger: Mutex<Ledger>,
    /// A task has panicked.
    is_broken: CancellationToken,
}

/// Tells when its task panics, which the runtime would keep to itself.
struct Witness(Arc<World>);

impl Drop for Witness {
    fn drop(&mut self) {
        if std::thread::panicking() {
            self.0.is_broken.cancel();
        }
    }
}

impl World {
    fn new(seed: u64) -> Arc<Self> {
        let mut random = SplitMix64(seed);
        let workers = 2 + random.below(3) as usize;
        let began = Instant::now();
        let hosts = (0..workers + CLIENTS).map(|index| Host {
            threads: 1 + random.below(2) as usize,
            slowness: if index == 1 { 1 + 9 * random.below(2) as u32 } else { 1 },
            is_liar: index == 0 && workers > 3,
            cut: Mutex::new((began, false)),
        });
        let hosts = hosts.collect();
        let durability =
            [None, Some(Durability::Second), None, Some(Durability::Tile)][(seed % 4) as usize];
        let memory = Path::new("/dev/shm");
        let folder =
            if memory.is_dir() { tempfile::tempdir_in(memory) } else { tempfile::tempdir() };
        Arc::new(Self {
            seed,
            folder: folder.unwrap(),
            durability,
            began,
            random: Mutex::new(random),
            faults: Mutex::default(),
            hosts,
            current: Mutex::default(),
            ledger: Mutex::default(),
            is_broken: CancellationToken::new(),
        })
    }

    fn spawn(self: &Arc<Self>, task: impl Future<Output: Send> + Send + 'static) {
        let witness = Witness(Arc::clone(self));
        tokio::spawn(async move {
            let _witness = witness;
            task.await
        });
    }

    fn below(&self, end: u64) -> u64 {
        self.random.lock().unwrap().below(end)
    }

    fn milliseconds_below(&self, end: u64) -> Duration {
        Duration::from_millis(self.below(end))
    }

    /// Whether something goes wrong now, as it does once in so many times while faults may come.
    fn goes_wrong(&self, fault: Fault, once_in: u64) -> bool {
        let mut faults = self.faults.lock().unwrap();
        let may = self.began.elapsed() < FAULTY && faults.values().sum::<u32>() < MOST_FAULTS;
        let does = may && self.below(once_in) == 0;
        if does {
            *faults.entry(fault).or_default() += 1;
        }
        does
    }

    fn has_lied(&self) -> bool {
        self.faults.lock().unwrap().contains_key(&Fault::Lie)
    }

    fn ledger(&self) -> MutexGuard<'_, Ledger> {
        self.ledger.lock().unwrap()
    }

    fn current(&self) -> Option<Arc<Start>> {
        self.current.lock().unwrap().clone()
    }

    fn kill_coordinator(&self) {
        if let Some(start) = self.current.lock().unwrap().take() {
            start.over.cancel();
        }
    }

    /// Starts a coordinator, which must find all that was acknowledged.
    fn start_coordinator(&self) -> Result<Arc<Start>, crate::StateError> {
        let count = self.ledger().restarts;
        let is_to_stop = self.durability.is_some() && self.goes_wrong(Fault::KilledInAWrite, 3);
        let disk = if is_to_stop { Disk::stopping_at(self.below(150)) } else { Disk::default() };
        let path = self.folder.path().join("state");
        let folder = self
            .durability
            .map(|durability| StateFolder::open_on(disk.clone(), &path, "build", durability))
            .transpose()?;
        for kept in folder.iter().flat_map(|folder| &folder.kept) {
            let done: BTreeSet<u32> = kept.done.iter().map(|(tile, _)| tile.number()).collect();
            let of_job = (kept.id.0, 0)..=(kept.id.0, u32::MAX);
            for (&(_, tile), _) in self.ledger().accepted.range(of_job) {
                let is_kept = kept.end.is_some() || self.has_lied() || done.contains(&tile);
                assert!(is_kept, "tile {tile} was acknowledged and is lost");
            }
        }
        let mut bytes = [0; 24];
        bytes.fill_with(|| self.below(256) as u8);
        let mut identity = Identity::from_random(bytes);
        if let Some(folder) = &folder {
            identity.farm = folder.farm();
        }
        let config = Config {
            version: "1".to_owned(),
            build: "build".to_owned(),
            reference: None,
            term: TERM,
            audit: f64::from(u8::from(self.hosts[0].is_liar)),
            upload_silence: Duration::from_secs(5),
            scene_folder: self.folder.path().to_owned(),
            picture_folder: self.folder.path().to_owned(),
            keeping: Keeping::default(),
        };
        let shell = Arc::new(Shell::new(config, identity, [count as u8; 32], folder));
        let (farm, jobs) = services(&shell);
        let over = CancellationToken::new();
        let start = Arc::new(Start { shell, farm, jobs, disk, over });
        *self.current.lock().unwrap() = Some(Arc::clone(&start));
        Ok(start)
    }

    /// A coordinator serves, is killed, and comes again.
    async fn keep_coordinator(self: Arc<Self>) {
        loop {
            let Ok(start) = self.start_coordinator() else {
                // It was killed in a write while it started.
                self.ledger().restarts += 1;
                continue;
            };
            let is_to_die = self.goes_wrong(Fault::CoordinatorKilled, 2);
            let dies = Instant::now() + self.milliseconds_below(15_000);
            let over = start.over.clone();
            let serve = async {
                let sync = async {
                    loop {
                        sleep(Duration::from_millis(500)).await;
                        start.shell.sync();
                        self.mind(&start);
                    }
                };
                tokio::select! {
                    biased;
                    () = over.cancelled() => {}
                    () = sleep_until(dies), if is_to_die => {}
                    () = sync => {}
                    () = start.shell.keep_time() => {}
                }
            };
            serve.await;
            self.kill_coordinator();
            drop(start);
            self.ledger().restarts += 1;
            sleep(Duration::from_millis(10) + self.milliseconds_below(5000)).await;
        }
    }

    /// Looks at a coordinator after it has done something.
    fn mind(&self, start: &Start) {
        if start.disk.has_failed() {
            return self.kill_coordinator();
        }
        start.shell.check();
    }

    /// Looks at what a coordinator answers.
    fn note(&self, start: &Start, path: &str, request: &[u8], answer: &[u8]) {
        let mut ledger = self.ledger();
        match path {
            "/rtfarm.v1.Farm/Lease" => {
                let answer = wire::LeaseResponse::decode(answer).unwrap();
                if let Some(lease_response::Next::Run(run)) = answer.next {
                    assert!(!run.tiles.is_empty(), "a lease without tiles");
                    let lease = (start.shell.identity.incarnation.0, run.lease.unwrap().id);
                    assert!(ledger.leases.insert(lease), "lease {lease:?} was given twice");
                }
            }
            "/rtfarm.v1.Farm/Deliver" => {
                let request = wire::DeliverRequest::decode(request).unwrap();
                let answer = wire::DeliverResponse::decode(answer).unwrap();
                assert_eq!(request.tiles.len(), answer.verdicts.len());
                for (tile, verdict) in request.tiles.iter().zip(answer.verdicts()) {
                    let job = tile.lease.unwrap().job;
                    if verdict == Verdict::Accepted {
                        let count = ledger.accepted.entry((job, tile.tile)).or_default();
                        *count += 1;
                        let is_once = *count == 1 || self.has_lied();
                        assert!(is_once, "tile {} of job {job} was stitched twice", tile.tile);
                    }
                }
            }
            _ => {}
        }
    }
}

/// So that a seed that fails can be run again.
impl Drop for World {
    fn drop(&mut self) {
        if std::thread::panicking() {
            eprintln!("RTFARM_SEED={}", self.seed);
        }
    }
}

/// Message and frame: one byte, four bytes of length, and what prost makes of it.
fn framed(message: &impl Message) -> Bytes {
    let bytes = message.encode_to_vec();
    [&[0][..], &(bytes.len() as u32).to_be_bytes(), &bytes].concat().into()
}

/// The network as a host has it.
#[derive(Clone)]
struct Net {
    world: Arc<World>,
    host: usize,
}

impl Service<http::Request<Body>> for Net {
    type Response = http::Response<Body>;
    type Error = Status;
    type Future = BoxFuture<Self::Response, Status>;

    fn poll_ready(&mut self, _: &mut Context<'_>) -> Poll<Result<(), Status>> {
        Poll::Ready(Ok(()))
    }

    fn call(&mut self, request: http::Request<Body>) -> Self::Future {
        Box::pin(self.clone().carry(request))
    }
}

impl Net {
    async fn carry(self, request: http::Request<Body>) -> Result<http::Response<Body>, Status> {
        let (head, body) = request.into_parts();
        let body = body.collect().await?.to_bytes();
        self.hop().await?;
        let path = head.uri.path().to_owned();
        let body = self.tamper(&path, body);
        if path.starts_with("/rtfarm.v1.Farm") && self.world.goes_wrong(Fault::Duplicated, 20) {
            let (net, head, body) = (self.clone(), head.clone(), body.clone());
            let delay = self.world.milliseconds_below(10_000);
            self.world.spawn(async move {
                sleep(delay).await;
                net.handle(head, body).await
            });
        }
        let response = self.handle(head, body).await?;
        self.hop().await?;
        Ok(response)
    }

    /// One way through the network.
    async fn hop(&self) -> Result<(), Status> {
        let world = &self.world;
        let cut = &world.hosts[self.host].cut;
        if world.goes_wrong(Fault::Partition, 100) {
            let end = Instant::now() + world.milliseconds_below(40_000);
            *cut.lock().unwrap() = (end, world.below(2) == 0);
        }
        let late = world.goes_wrong(Fault::Delayed, 20);
        sleep(world.milliseconds_below(if late { 20_000 } else { 20 })).await;
        let (until, is_told) = *cut.lock().unwrap();
        let is_cut = Instant::now() < until;
        if is_cut || world.goes_wrong(Fault::Lost, 30) {
            if is_told {
                return Err(Status::unavailable("the connection broke"));
            }
            pending::<()>().await;
        }
        Ok(())
    }

    /// Pixels are not always what they were.
    fn tamper(&self, path: &str, body: Bytes) -> Bytes {
        let world = &self.world;
        if path != "/rtfarm.v1.Farm/Deliver" {
            return body;
        }
        let mut request = wire::DeliverRequest::decode(&body[5..]).unwrap();
        for tile in &mut request.tiles {
            let mut pixels = tile.pixels.to_vec();
            if world.goes_wrong(Fault::Damaged, 60) {
                pixels[0] ^= 1;
            } else if self.is_liar()
                && tile.tile.is_multiple_of(3)
                && world.goes_wrong(Fault::Lie, 2)
            {
                // No two say the same.
                let lie = world.below(1 << 20) as f32 / 1e6;
                pixels[..4].copy_from_slice(&lie.to_le_bytes());
                self.seal(tile, &pixels);
            } else if world.goes_wrong(Fault::Nonsense, 100) {
                pixels[..4].copy_from_slice(&f32::NAN.to_le_bytes());
                self.seal(tile, &pixels);
            }
            tile.pixels = pixels.into();
        }
        framed(&request)
    }

    fn is_liar(&self) -> bool {
        self.world.hosts[self.host].is_liar
    }

    /// Gives altered pixels the hash that belongs to them.
    fn seal(&self, tile: &mut wire::FinishedTile, pixels: &[u8]) {
        let job = tile.lease.unwrap().job;
        let job = self.world.current().and_then(|start| start.shell.job(JobId(job)));
        if let Some(job) = job {
            let id = job.grid.tile(tile.tile).unwrap();
            tile.hash = job.hasher.hash(id, pixels).to_vec().into();
        }
    }

    /// The coordinator's side of a call.
    async fn handle(
        &self,
        head: http::request::Parts,
        body: Bytes,
    ) -> Result<http::Response<Body>, Status> {
        let world = Arc::clone(&self.world);
        let Some(start) = world.current() else {
            return Err(Status::unavailable("nobody listens"));
        };
        let over = start.over.clone();
        let (mut reply, answer) = oneshot::channel();
        let hears_hang_up = world.below(2) == 0;
        self.world.spawn(over.run_until_cancelled_owned(async move {
            let path = head.uri.path().to_owned();
            let request = http::Request::from_parts(head, Body::new(Full::new(body.clone())));
            let (mut farm, mut jobs) = (start.farm.clone(), start.jobs.clone());
            let calls = {
                let mut ledger = world.ledger();
                ledger.calls += 1;
                ledger.calls
            };
            assert!(calls < MOST_CALLS, "they call and call");
            let respond = async {
                let Ok(response) = if path.starts_with("/rtfarm.v1.Farm") {
                    farm.call(request).await
                } else {
                    jobs.call(request).await
                };
                response
            };
            let response = tokio::select! {
                biased;
                response = respond => response,
                () = reply.closed(), if hears_hang_up => return world.mind(&start),
            };
            world.mind(&start);
            if start.over.is_cancelled() {
                return;
            }
            let (head, response) = response.into_parts();
            let response = if path.ends_with("Watch") {
                let over = start.over.clone();
                Body::new(StreamBody::new(BodyStream::new(response).map(move |frame| {
                    let gone = Err(Status::unavailable("the coordinator was killed"));
                    if over.is_cancelled() { gone } else { frame }
                })))
            } else {
                let Ok(response) = response.collect().await else { return };
                let trailers = response.trailers().cloned();
                let bytes = response.to_bytes();
                if !path.ends_with("Fetch") && !path.ends_with("Image") && bytes.len() >= 5 {
                    world.note(&start, &path, &body[5..], &bytes[5..]);
                }
                let trailers = trailers.map(Ok);
                Body::new(Full::new(bytes).with_trailers(async { trailers }))
            };
            let _ = reply.send(http::Response::from_parts(head, response));
        }));
        answer.await.map_err(|_| Status::unavailable("the coordinator was killed"))
    }
}

/// A worker's network and threads.
struct Surroundings {
    net: Net,
    threads: Arc<Semaphore>,
}

impl Outside for Surroundings {
    type Connection = Net;

    async fn connect(&self, _: &Access) -> Result<Net, String> {
        self.net.hop().await.map_err(|error| error.to_string())?;
        self.net.world.current().map(|_| self.net.clone()).ok_or_else(|| "refused".to_owned())
    }

    fn render(&self, work: impl FnOnce(Instant) + Send + 'static) {
        let (world, threads) = (Arc::clone(&self.net.world), Arc::clone(&self.threads));
        let mut time = world.milliseconds_below(400) * world.hosts[self.net.host].slowness;
        if world.goes_wrong(Fault::SlowTile, 40) {
            time += 2 * TERM;
        }
        self.net.world.spawn(async move {
            let _thread = threads.acquire().await;
            let started = Instant::now();
            sleep(time).await;
            work(started);
        });
    }

    async fn block<T: Send + 'static>(&self, work: impl FnOnce() -> T + Send + 'static) -> T {
        work()
    }
}

/// A process that is stopped now and then, and goes on as if no time had passed.
struct Stoppable<F> {
    world: Arc<World>,
    process: Pin<Box<F>>,
    stopped: Option<Pin<Box<Sleep>>>,
}

impl<F: Future> Future for Stoppable<F> {
    type Output = F::Output;

    fn poll(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<F::Output> {
        if self.stopped.is_none() && self.world.goes_wrong(Fault::WorkerStopped, 200) {
            let time = self.world.milliseconds_below(20_000);
            self.stopped = Some(Box::pin(sleep(time)));
        }
        if let Some(stopped) = &mut self.stopped {
            if stopped.as_mut().poll(context).is_pending() {
                return Poll::Pending;
            }
            self.stopped = None;
        }
        self.process.as_mut().poll(context)
    }
}

impl World {
    /// A worker is started whenever it has ended.
    async fn keep_worker(self: Arc<Self>, host: usize) {
        loop {
            let Host { threads, is_liar, .. } = self.hosts[host];
            let config = rtfarm_worker::Config {
                coordinator: Address::Tcp("coordinator:1".to_owned()).into(),
                threads,
                isa: Isa::Scalar,
                version: "1".to_owned(),
                build: "build".to_owned(),
                reference: None,
                memory: None,
                patience: Duration::from_secs(60),
            };
            let net = Net { world: Arc::clone(&self), host };
            let surroundings = Surroundings { net, threads: Arc::new(Semaphore::new(threads)) };
            let nonce = self.below(u64::MAX);
            let life = Stoppable {
                world: Arc::clone(&self),
                process: Box::pin(run_in(surroundings, config, nonce, pending())),
                stopped: None,
            };
            let is_to_die = self.goes_wrong(Fault::WorkerKilled, 2);
            let dies = self.milliseconds_below(15_000);
            let end = tokio::select! {
                biased;
                () = sleep(dies), if is_to_die => None,
                end = life => Some(end),
            };
            match end {
                // A process that brought wrong pixels is kept out.
                Some(Err(WorkerError::Refused(reason))) => {
                    assert!(is_liar, "an honest worker is refused: {reason}");
                }
                // It lost its patience.
                None | Some(Err(WorkerError::Gone(_) | WorkerError::Connect(..))) => {}
                Some(end) => panic!("a worker ended: {end:?}"),
            }
            sleep(self.milliseconds_below(2000)).await;
        }
    }

    /// A client wants pictures until it has them.
    async fn order_pictures(self: Arc<Self>, host: usize, client: usize) {
        for picture in client * PICTURES..(client + 1) * PICTURES {
            while let Err(reason) = self.order(host, picture).await {
                self.ledger().failures += 1;
                if std::env::var_os("RTFARM_SEED").is_some() {
                    eprintln!("{:?}: picture {picture}: {reason}", self.began.elapsed());
                }
                sleep(Duration::from_secs(1)).await;
            }
            self.ledger().pictures += 1;
        }
    }

    /// Orders a picture, and says why it does not come.
    async fn order(self: &Arc<Self>, host: usize, picture: usize) -> Result<(), Trouble> {
        const PATIENCE: Duration = Duration::from_secs(60);
        fn lost<E>(_: E) -> Trouble {
            Trouble::Lost
        }
        let mut client = JobsClient::new(Net { world: Arc::clone(self), host });
        let RenderRequest { name, size, quality, .. } = request();
        let order = wire::Order {
            version: "1".to_owned(),
            protocol: PROTOCOL,
            name,
            frame: size.map(Into::into),
            quality: Some(quality.into()),
            tile_side: SIDE as u32,
            format: wire::Format::Png8.into(),
            transfer: wire::Transfer::None.into(),
            ..wire::Order::default()
        };
        let parts = [Part::Order(order), Part::Text(scene(picture).into_bytes().into())];
        let parts = parts.map(|part| wire::SubmitRequest { part: Some(part) });
        let submitted = client.submit(tokio_stream::iter(parts));
        let submitted = timeout(PATIENCE, submitted).await.map_err(lost)?;
        let submitted = submitted.map_err(lost)?.into_inner();
        let Some(Outcome::Accepted(accepted)) = submitted.outcome else {
            panic!("{submitted:?}");
        };
        let wire::Accepted { job, farm, .. } = accepted;
        loop {
            if self.goes_wrong(Fault::ClientKilled, 10) {
                return Err(Trouble::Lost);
            }
            let end = timeout(PATIENCE, self.watch(&mut client, job, &farm)).await;
            match end.map_err(lost).flatten() {
                Err(Trouble::Lost) => sleep(Duration::from_millis(200)).await,
                Err(Trouble::Gone) => {
                    assert!(self.durability.is_none(), "job {job} was accepted and is lost");
                    return Err(Trouble::Gone);
                }
                Ok(End::Failed(reason)) => {
                    let is_calm = self.faults.lock().unwrap().is_empty();
                    assert!(!is_calm, "it failed of nothing: {reason}");
                    return Err(Trouble::Failed(reason));
                }
                Ok(End::Finished(_)) => break,
                Err(error @ Trouble::Failed(_)) => return Err(error),
            }
        }
        loop {
            let image = timeout(PATIENCE, image(&mut client, job, &farm)).await;
            match image.map_err(lost).flatten() {
                Ok(file) => {
                    let is_right = file == expected(picture);
                    assert!(is_right || self.has_lied(), "picture {picture} is wrong");
                    let cancel = client.cancel(wire::CancelRequest { job, farm });
                    let _ = timeout(PATIENCE, cancel).await;
                    return Ok(());
                }
                Err(Trouble::Gone) => {
                    assert!(self.durability.is_none(), "picture {job} was ready and is lost");
                    return Err(Trouble::Gone);
                }
                Err(_) => sleep(Duration::from_millis(200)).await,
            }
        }
    }

    /// Waits for the end of a job.
    async fn watch(
        &self,
        client: &mut JobsClient<Net>,
        job: u64,
        farm: &Bytes,
    ) -> Result<End, Trouble> {
        let watched = client.watch(wire::WatchRequest { job, farm: farm.clone() }).await;
        let mut events = watched?.into_inner();
        let mut most = 0;
        while let Some(event) = events.message().await? {
            assert!(event.tiles_done >= most || self.has_lied(), "tiles were lost");
            most = event.tiles_done;
            if let Some(end) = event.end {
                return Ok(end);
            }
        }
        Err(Trouble::Lost)
    }
}

async fn image(client: &mut JobsClient<Net>, job: u64, farm: &Bytes) -> Result<Vec<u8>, Trouble> {
    let chunks = client.image(wire::ImageRequest { job, farm: farm.clone(), partial: false }).await;
    let (mut chunks, mut file) = (chunks?.into_inner(), Vec::new());
    while let Some(chunk) = chunks.message().await? {
        file.extend_from_slice(&chunk.data);
    }
    Ok(file)
}

/// Why a client has no picture.
#[derive(Debug)]
enum Trouble {
    /// Nobody answers.
    Lost,
    /// There is no such job.
    Gone,
    Failed(String),
}

impl From<Status> for Trouble {
    fn from(status: Status) -> Self {
        if status.code() == Code::NotFound { Self::Gone } else { Self::Lost }
    }
}

impl fmt::Display for Trouble {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Failed(reason) => f.write_str(reason),
            other => write!(f, "{other:?}"),
        }
    }
}

/// Lives through one seed.
fn run(seed: u64) -> Arc<World> {
    let mut runtime = tokio::runtime::Builder::new_current_thread();
    let runtime = runtime.enable_time().start_paused(true).build().unwrap();
    let world = runtime.block_on(async {
        let world = World::new(seed);
        world.spawn(Arc::clone(&world).keep_coordinator());
        let workers = world.hosts.len() - CLIENTS;
        for host in 0..workers {
            world.spawn(Arc::clone(&world).keep_worker(host));
        }
        let clients =
            (0..CLIENTS).map(|client| Arc::clone(&world).order_pictures(workers + client, client));
        let ready = Arc::new(Semaphore::new(0));
        for client in clients {
            let ready = Arc::clone(&ready);
            world.spawn(async move {
                client.await;
                ready.add_permits(1);
            });
        }
        let jumps = async {
            loop {
                sleep(Duration::from_secs(3)).await;
                if world.goes_wrong(Fault::ClockJump, 10) {
                    tokio::time::advance(world.milliseconds_below(30_000)).await;
                }
            }
        };
        tokio::select! {
            biased;
            () = world.is_broken.cancelled() => panic!("see above"),
            _ = ready.acquire_many(CLIENTS as u32) => {}
            () = sleep(FAULTY + CALM) => panic!("some picture does not come"),
            () = jumps => {}
        }
        world
    });
    drop(runtime);
    world
}

/// What was counted in all seeds.
#[derive(Debug, Default, PartialEq)]
struct Totals {
    faults: BTreeMap<Fault, u64>,
    pictures: u32,
    failures: u32,
    restarts: u32,
    calls: u32,
}

impl Totals {
    fn add(&mut self, world: &World) {
        for (&fault, &count) in &*world.faults.lock().unwrap() {
            *self.faults.entry(fault).or_default() += u64::from(count);
        }
        let ledger = world.ledger();
        self.pictures += ledger.pictures;
        self.failures += ledger.failures;
        self.restarts += ledger.restarts;
        self.calls += ledger.calls;
    }

    fn fault_count(&self) -> u64 {
        self.faults.values().sum()
    }
}

/// Lives through seeds, on all processors, until that is true of the totals and the number of seeds.
fn run_until(is_enough: impl Fn(&Totals, u64) -> bool + Sync) -> Totals {
    let totals = Mutex::new((Totals::default(), 0));
    let work = || loop {
        let seed = {
            let (totals, seeds) = &mut *totals.lock().unwrap();
            if is_enough(totals, *seeds) {
                return;
            }
            *seeds += 1;
            *seeds - 1
        };
        let world = run(seed);
        totals.lock().unwrap().0.add(&world);
    };
    std::thread::scope(|scope| {
        for _ in 0..std::thread::available_parallelism().unwrap().get() {
            scope.spawn(work);
        }
    });
    totals.into_inner().unwrap().0
}

#[test]
fn a_whole_farm_gives_right_pictures_and_loses_nothing_though_everything_goes_wrong() {
    let number = |name| std::env::var(name).ok().map(|text| text.parse::<u64>().unwrap());
    if let Some(seed) = number("RTFARM_SEED") {
        let mut totals = Totals::default();
        totals.add(&run(seed));
        eprintln!("{totals:?}");
        return;
    }
    let totals = match number("RTFARM_FAULTS") {
        Some(wanted) => run_until(|totals, _| totals.fault_count() >= wanted),
        None => run_until(|_, seeds| seeds >= SEEDS),
    };
    eprintln!("{} faults, {totals:?}", totals.fault_count());
    let Totals { faults, failures, restarts, .. } = totals;
    assert!(faults.len() == 14 && faults.values().all(|&count| count > 100), "{faults:?}");
    assert!(failures > 100 && restarts > 100, "{failures} failures, {restarts} restarts");
}

#[test]
fn a_seed_says_all_that_happens() {
    for seed in 0..4 {
        let totals = [(); 2].map(|()| {
            let mut totals = Totals::default();
            totals.add(&run(seed));
            totals
        });
        assert_eq!(totals[0], totals[1], "seed {seed}");
    }
}
