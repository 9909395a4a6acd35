//! A whole farm in one thread, under a clock and a network of its own: the real coordinator with
//! its services and its state on disk, real workers, real clients, the bytes that they exchange.
//! Only threads, wires and disks are played. A seed says all that happens; `RTFARM_SEED=7` repeats
//! one, `RTFARM_FAULTS=1000000` goes on from seed to seed until so many faults were injected.

use std::{
    collections::{BTreeMap, BTreeSet},
    future::{pending, ready},
    ops::ControlFlow,
    path::Path,
    pin::Pin,
    sync::{Arc, Mutex, MutexGuard, OnceLock},
    task::{Context, Poll},
    time::Duration,
};

use http_body_util::{BodyExt, BodyStream, Full, StreamBody};
use prost::Message;
use rtfarm_client::{Ended, JobState, NoPicture, Trouble};
use rtfarm_core::{
    isa::Isa,
    prepare::Form,
    prepared::PreparedScene,
    render::{Quality, Sampling, Tally, render_tile},
    transfer::Transfer,
};
use rtfarm_job::{Order, Provenance, RenderRequest};
use rtfarm_picture::{Cache, Disk, Notes, Picture, PictureFormat};
use rtfarm_proto::{
    Access, Address, Bytes, JobId, PROTOCOL,
    wire::{self, Verdict, jobs_client::JobsClient, lease_response, submit_request::Part},
};
use rtfarm_worker::{
    WorkerError,
    simulation::{Outside, run_in},
};
use tempfile::TempDir;
use tokio::{
    sync::{Semaphore, mpsc, oneshot},
    time::{Instant, Sleep, sleep, sleep_until},
};
use tokio_stream::{Stream, StreamExt};
use tokio_util::sync::CancellationToken;
use tonic::{
    Status,
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
    upload::OrderLimits,
};

const VERSION: &str = "1";
const BUILD: &str = "build";

const SEEDS: u64 = 500;

const TERM: Duration = Duration::from_secs(4);

/// A worker that says nothing for so long has no tile: its leases ran out, one after the other.
const LEASELESS: Duration = Duration::from_secs(30);

/// A client notices in this time that a connection is dead.
const KEEP_ALIVE: Duration = Duration::from_secs(30);

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
        form: Form::Fast,
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
        let build = format!("{VERSION} ({BUILD})");
        let provenance =
            Provenance { build, scene: prepared.hash(), settings, grid, transfer, format };
        let prepared = PreparedScene::open(prepared).unwrap();
        let picture = Picture::new_in(Path::new("/tmp"), grid.window(), format, transfer).unwrap();
        let mut tallies = BTreeMap::new();
        for tile in grid.render_order() {
            let mut go_on = || ControlFlow::Continue(());
            let area = grid.area(tile);
            let rendered = render_tile(&prepared, &settings.quality, area, Isa::Scalar, &mut go_on);
            let rendered = rendered.unwrap();
            picture.put(area, &rendered.pixels).unwrap();
            tallies.insert(tile, rendered.tally);
        }
        let mut sum = Tally::default();
        for tally in tallies.values() {
            sum.add(tally);
        }
        let software = format!("rtfarm {}", provenance.build);
        let notes = Notes { software, provenance: provenance.text(&sum) };
        let mut file = std::io::Cursor::new(Vec::new());
        picture.encode(&notes, &mut file).unwrap();
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
    CoordinatorStopped,
    KilledInAWrite,
    PowerCut,
    ClientKilled,
    ClientInterrupted,
    PictureCutShort,
    ClockJump,
}

/// A machine of the farm.
struct Host {
    threads: usize,
    slowness: u32,
    is_liar: bool,
    /// Until when it hears and says nothing, and whether who calls is told.
    cut: Mutex<(Instant, bool)>,
    /// Until when its processes stand still.
    stopped_until: Mutex<Instant>,
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
    /// Tiles whose pixels were acknowledged as the first.
    accepted: BTreeMap<(u64, u32), Accepted>,
    pictures: u32,
    failures: u32,
    restarts: u32,
    calls: u32,
}

/// What is known of a tile that was acknowledged.
#[derive(Clone, Copy, Default)]
struct Accepted {
    count: u32,
    /// A power cut cannot take it.
    is_safe: bool,
}

struct World {
    seed: u64,
    folder: TempDir,
    cache: Cache,
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

/// A disk makes fewer changes.
const NEVER: u64 = 1 << 60;

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
        let hosts = (0..=workers + CLIENTS).map(|index| Host {
            threads: 1 + random.below(2) as usize,
            slowness: if index == 1 { 1 + 9 * random.below(2) as u32 } else { 1 },
            is_liar: index == 0 && workers > 3,
            cut: Mutex::new((began, false)),
            stopped_until: Mutex::new(began),
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
            cache: Cache::default(),
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

    fn workers(&self) -> usize {
        self.coordinator() - CLIENTS
    }

    /// The coordinator's host, which is the last.
    fn coordinator(&self) -> usize {
        self.hosts.len() - 1
    }

    fn stop(&self, host: usize, time: Duration) {
        let mut until = self.hosts[host].stopped_until.lock().unwrap();
        *until = (*until).max(Instant::now() + time);
    }

    /// The clock of one host jumps ahead, or those of all: to it, it is as if all others had stood
    /// still.
    fn jump(&self) {
        let time = self.milliseconds_below(30_000);
        let jumping = self.below(self.hosts.len() as u64 + 1) as usize;
        (0..self.hosts.len())
            .filter(|&host| host != jumping)
            .for_each(|host| self.stop(host, time));
    }

    fn kill_coordinator(&self) {
        if let Some(start) = self.current.lock().unwrap().take() {
            start.over.cancel();
            start.disk.stop();
        }
    }

    /// The coordinator is dead, and its machine may be.
    fn may_lose_power(&self) {
        self.ledger().restarts += 1;
        if self.durability.is_some() && self.goes_wrong(Fault::PowerCut, 2) {
            self.cache.cut_power(|| self.below(2) == 0);
            self.ledger().accepted.retain(|_, tile| tile.is_safe);
        }
    }

    /// Starts a coordinator, which must find all that was acknowledged.
    fn start_coordinator(&self) -> Result<Arc<Start>, crate::StateError> {
        let count = self.ledger().restarts;
        let is_to_stop = self.durability.is_some() && self.goes_wrong(Fault::KilledInAWrite, 3);
        let disk = Disk::stopping_at(if is_to_stop { self.below(150) } else { NEVER });
        let disk = disk.with_cache(&self.cache);
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
            version: VERSION.to_owned(),
            build: BUILD.to_owned(),
            reference: None,
            term: TERM,
            audit: f64::from(u8::from(self.hosts[0].is_liar)),
            upload_silence: Duration::from_secs(5),
            events: None,
            begins_coarsely: false,
            host: None,
            orders: OrderLimits::default(),
            scene_folder: self.folder.path().to_owned(),
            picture_folder: self.folder.path().to_owned(),
            keeping: Keeping::default(),
        };
        let shell = Arc::new(Shell::new(config, identity, [count as u8; 32], folder).unwrap());
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
                self.may_lose_power();
                continue;
            };
            let is_to_die = self.goes_wrong(Fault::CoordinatorKilled, 2);
            let dies = Instant::now() + self.milliseconds_below(15_000);
            let over = start.over.clone();
            let serve = async {
                let sync = async {
                    loop {
                        sleep(Duration::from_millis(500)).await;
                        self.sync(&start);
                        if self.goes_wrong(Fault::CoordinatorStopped, 60) {
                            self.stop(self.coordinator(), self.milliseconds_below(20_000));
                        }
                    }
                };
                tokio::select! {
                    biased;
                    () = over.cancelled() => {}
                    () = sleep_until(dies), if is_to_die => {}
                    () = start.shell.keep_time() => {}
                    () = sync => {}
                }
            };
            Stoppable::new(&self, self.coordinator(), serve).await;
            self.kill_coordinator();
            drop(start);
            self.may_lose_power();
            sleep(Duration::from_millis(10) + self.milliseconds_below(5000)).await;
        }
    }

    /// Makes what a coordinator has written safe, and looks at its leases.
    fn sync(&self, start: &Start) {
        start.shell.sync();
        if !start.disk.has_failed() {
            self.ledger().accepted.values_mut().for_each(|tile| tile.is_safe = true);
        }
        self.mind(start);
        // Who stood still himself begins to count anew.
        let since = *self.hosts[self.coordinator()].stopped_until.lock().unwrap();
        for (member, tiles) in start.shell.workers() {
            let is_lost = member.silence.min(Instant::now() - since) > LEASELESS;
            assert!(tiles == 0 || !is_lost, "{:?} is lost and has tiles", member.worker);
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
                        let accepted = ledger.accepted.entry((job, tile.tile)).or_default();
                        accepted.count += 1;
                        accepted.is_safe |= self.durability == Some(Durability::Tile);
                        let is_once = accepted.count == 1 || self.has_lied();
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
        let (_, is_told) = *cut.lock().unwrap();
        if self.is_cut() || world.goes_wrong(Fault::Lost, 30) {
            if !is_told && self.host < world.workers() {
                pending::<()>().await;
            }
            if !is_told {
                sleep(KEEP_ALIVE).await;
            }
            return Err(Status::unavailable("the connection broke"));
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

    fn is_cut(&self) -> bool {
        Instant::now() < self.world.hosts[self.host].cut.lock().unwrap().0
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
        let net = self.clone();
        let call = async move {
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
            let (head, response) = response.into_parts();
            let response = if path.ends_with("Watch") {
                let (over, net) = (start.over.clone(), net.clone());
                Body::new(StreamBody::new(BodyStream::new(response).map(move |frame| {
                    let gone = Err(Status::unavailable("the connection broke"));
                    if over.is_cancelled() || net.is_cut() { gone } else { frame }
                })))
            } else if path.ends_with("Image") && net.world.goes_wrong(Fault::PictureCutShort, 3) {
                let lost = || Status::unavailable("the connection broke");
                let frames = BodyStream::new(response).map(move |frame| frame.and(Err(lost())));
                Body::new(StreamBody::new(frames))
            } else {
                let Ok(response) = response.collect().await else { return };
                let trailers = response.trailers().cloned();
                let bytes = response.to_bytes();
                // It may have been told before the coordinator was killed.
                if !path.ends_with("Fetch") && !path.ends_with("Image") && bytes.len() >= 5 {
                    net.world.note(&start, &path, &body[5..], &bytes[5..]);
                }
                let trailers = trailers.map(Ok);
                Body::new(Full::new(bytes).with_trailers(async { trailers }))
            };
            net.world.mind(&start);
            if !start.over.is_cancelled() {
                let _ = reply.send(http::Response::from_parts(head, response));
            }
        };
        let call = Stoppable::new(&self.world, self.world.coordinator(), call);
        self.world.spawn(over.run_until_cancelled_owned(call));
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

/// A process of a host that stands still now and then, and goes on as if no time had passed.
struct Stoppable<F> {
    world: Arc<World>,
    host: usize,
    process: Pin<Box<F>>,
    sleep: Pin<Box<Sleep>>,
}

impl<F> Stoppable<F> {
    fn new(world: &Arc<World>, host: usize, process: F) -> Self {
        let (process, sleep) = (Box::pin(process), Box::pin(sleep_until(world.began)));
        Self { world: Arc::clone(world), host, process, sleep }
    }
}

impl<F: Future> Future for Stoppable<F> {
    type Output = F::Output;

    fn poll(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<F::Output> {
        let (world, host) = (Arc::clone(&self.world), self.host);
        if host < world.workers() && world.goes_wrong(Fault::WorkerStopped, 200) {
            world.stop(host, world.milliseconds_below(20_000));
        }
        let until = *world.hosts[host].stopped_until.lock().unwrap();
        if Instant::now() < until {
            self.sleep.as_mut().reset(until);
            if self.sleep.as_mut().poll(context).is_pending() {
                return Poll::Pending;
            }
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
                coordinator: coordinator().into(),
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
            let life = run_in(surroundings, config, nonce, pending());
            let life = Stoppable::new(&self, host, life);
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
    async fn order(self: &Arc<Self>, host: usize, picture: usize) -> Result<(), String> {
        let order = rtfarm_client::Order {
            scene: "scene.rt".to_owned(),
            coordinator: coordinator(),
            patience: Duration::from_secs(60),
            is_detached: false,
        };
        let stop = CancellationToken::new();
        let net = Net { world: Arc::clone(self), host };
        let key = format!("{picture} {}", self.below(u64::MAX));
        let mut user = User { net, picture, key, most_done: 0 };
        let life = Stoppable::new(self, host, rtfarm_client::run(&mut user, order, &stop));
        let is_to_die = self.goes_wrong(Fault::ClientKilled, 10);
        let is_to_stop = self.goes_wrong(Fault::ClientInterrupted, 10);
        let (dies, stops) = (self.milliseconds_below(20_000), self.milliseconds_below(20_000));
        let interrupt = async {
            sleep(stops).await;
            stop.cancel();
            pending::<()>().await;
        };
        let end = tokio::select! {
            biased;
            () = sleep(dies), if is_to_die => return Err("the client was killed".to_owned()),
            end = life => end,
            () = interrupt, if is_to_stop => unreachable!("it waits for ever"),
        };
        match end {
            Ok(Ended::Finished(..)) => Ok(()),
            Err(NoPicture::Interrupted) if is_to_stop => Err("interrupted".to_owned()),
            Err(NoPicture::Failed(reason)) => {
                assert!(!self.faults.lock().unwrap().is_empty(), "it failed of nothing: {reason}");
                let is_lost = self.durability.is_some() && reason.contains("no such job");
                assert!(!is_lost, "an accepted job is lost");
                assert!(!reason.contains("cut short"), "a picture that stays with the farm");
                Err(reason)
            }
            end => panic!("a client ended: {end:?}"),
        }
    }
}

fn coordinator() -> Address {
    Address::Tcp("coordinator:1".to_owned())
}

/// A user who wants a picture.
struct User {
    net: Net,
    picture: usize,
    key: String,
    /// Tiles that were done, as he was told.
    most_done: u32,
}

impl rtfarm_client::Outside for User {
    type Connection = Net;

    fn connect(&self) -> impl Future<Output = Result<JobsClient<Net>, Trouble>> + Send + 'static {
        let net = self.net.clone();
        async move {
            let refused = |reason: &str| Trouble::Connect(coordinator(), reason.to_owned());
            net.hop().await.map_err(|status| refused(status.message()))?;
            net.world.current().ok_or_else(|| refused("nobody listens"))?;
            Ok(JobsClient::new(net))
        }
    }

    fn order(
        &self,
    ) -> impl Future<
        Output = Result<impl Stream<Item = wire::SubmitRequest> + Send + 'static, Trouble>,
    > + Send
    + 'static {
        let RenderRequest { name, size, quality, .. } = request();
        let order = wire::Order {
            version: "1".to_owned(),
            protocol: PROTOCOL,
            name,
            frame: size.map(Into::into),
            quality: Some(quality.into()),
            key: self.key.clone(),
            tile_side: SIDE as u32,
            format: wire::Format::Png8.into(),
            transfer: wire::Transfer::None.into(),
            ..wire::Order::default()
        };
        let parts = [Part::Order(order), Part::Text(scene(self.picture).into_bytes().into())];
        let parts = parts.map(|part| wire::SubmitRequest { part: Some(part) });
        ready(Ok(tokio_stream::iter(parts)))
    }

    fn tell_report(&mut self, _: &str) {}

    fn show(&mut self, state: &JobState) {
        let world = &self.net.world;
        let may_lose = world.durability == Some(Durability::Second)
            && world.faults.lock().unwrap().contains_key(&Fault::PowerCut);
        let is_as_far = state.tiles_done >= self.most_done;
        assert!(is_as_far || may_lose || world.has_lied(), "tiles were lost");
        self.most_done = state.tiles_done;
    }

    fn hide(&mut self) {}

    fn warn_of_obstacle(&mut self, _: &str) {}

    fn warn_of_differing_tiles(&mut self, _: u32) {
        assert!(self.net.world.has_lied(), "honest tiles differ");
    }

    fn write(
        &self,
        mut chunks: mpsc::Receiver<wire::Chunk>,
    ) -> impl Future<Output = Result<(), String>> + Send + 'static {
        let (world, picture) = (Arc::clone(&self.net.world), self.picture);
        async move {
            let mut file = Vec::new();
            while let Some(chunk) = chunks.recv().await {
                if chunk.data.is_empty() {
                    let is_right = file == expected(picture);
                    assert!(is_right || world.has_lied(), "picture {picture} is wrong");
                    return Ok(());
                }
                file.extend_from_slice(&chunk.data);
            }
            Err("the picture was cut short".to_owned())
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
        let workers = world.workers();
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
                    world.jump();
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

/// Lives through seeds, on all processors, until that is true of the totals and the number of
/// seeds.
fn run_until(is_enough: impl Fn(&Totals, u64) -> bool + Sync) -> Totals {
    let totals = Mutex::new((Totals::default(), 0));
    let work = || loop {
        let seed = {
            let (totals, seeds) = &mut *totals.lock().unwrap();
            if is_enough(totals, *seeds) {
                return;
            }
            if *seeds % 1000 == 0 {
                eprintln!("{seeds} seeds, {} faults", totals.fault_count());
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
    assert!(faults.len() == 18 && faults.values().all(|&count| count > 50), "{faults:?}");
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
