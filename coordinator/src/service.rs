//! The gRPC services: parse, decide, answer. A `Status` is chosen here and nowhere else.

use std::{
    collections::HashMap,
    io::{self, BufWriter, Read, Seek},
    pin::Pin,
    sync::Arc,
    time::Duration,
};

use rtfarm_core::{
    read::{Style, draw_diagnostics},
    render::Tally,
    tile::{Size, TileId},
};
use rtfarm_job::{FinishedTile, Outcome, Placed, Progress, Refusal, RenderRequest};
use rtfarm_picture::{PutError, check_pixels};
use rtfarm_proto::{
    CHUNK_BYTES, JobId, LONGEST_WAIT, LeaseName, MESSAGE_BYTES, PROTOCOL, WireError, WorkerId,
    pixels_from_bytes, scene_hash, transfer,
    wire::{
        self, event, farm_server, jobs_server, lease_response, submit_request, submit_response,
    },
};
use tokio::{sync::mpsc, time::Instant};
use tokio_stream::{Stream, wrappers::ReceiverStream};
use tonic::{
    Request, Response, Status, Streaming,
    transport::{
        Server,
        server::{Router, UdsConnectInfo},
    },
};

use crate::{
    job::Job,
    jobs::{Next, NoMember},
    lease::{PixelHash, Verdict},
    run::{Coordinator, Shared},
};

/// The most bytes that a scene and its files may have.
const LONGEST_BUNDLE: usize = 1 << 31;

/// A watching client hears of changes no more often than this.
const WATCH_PERIOD: Duration = Duration::from_millis(50);

type Chunks = Pin<Box<dyn Stream<Item = Result<wire::Chunk, Status>> + Send>>;
type Events = Pin<Box<dyn Stream<Item = Result<wire::Event, Status>> + Send>>;

/// Both services over one coordinator.
pub(crate) fn router(shared: &Arc<Shared>) -> Router {
    const WINDOW_BYTES: u32 = 1 << 22;
    let farm = farm_server::FarmServer::new(FarmService { shared: Arc::clone(shared) })
        .max_decoding_message_size(MESSAGE_BYTES)
        .max_encoding_message_size(MESSAGE_BYTES);
    let jobs = jobs_server::JobsServer::new(JobsService { shared: Arc::clone(shared) })
        .max_decoding_message_size(MESSAGE_BYTES)
        .max_encoding_message_size(MESSAGE_BYTES);
    Server::builder()
        .initial_stream_window_size(WINDOW_BYTES)
        .initial_connection_window_size(WINDOW_BYTES)
        .http2_keepalive_interval(Some(Duration::from_secs(10)))
        .http2_keepalive_timeout(Some(Duration::from_secs(20)))
        .add_service(farm)
        .add_service(jobs)
}

struct FarmService {
    shared: Arc<Shared>,
}

#[tonic::async_trait]
impl farm_server::Farm for FarmService {
    async fn join(
        &self,
        request: Request<wire::JoinRequest>,
    ) -> Result<Response<wire::JoinResponse>, Status> {
        let join = request.into_inner();
        check_version("worker", &join.version, join.protocol, &self.shared)?;
        let worker = self.shared.jobs().on_join(join.nonce, join.threads as usize, now());
        let is_new = self.shared.processes().insert(worker, join.process).is_none();
        if is_new {
            let wire::JoinRequest { host, process, threads, isa, .. } = join;
            tracing::info!(worker = worker.0, host, process, threads, isa, "worker joined");
        }
        let term_ms = u32::try_from(self.shared.config.term.as_millis()).unwrap_or(u32::MAX);
        Ok(Response::new(wire::JoinResponse { worker: worker.0, term_ms }))
    }

    async fn lease(
        &self,
        request: Request<wire::LeaseRequest>,
    ) -> Result<Response<wire::LeaseResponse>, Status> {
        let is_local = request.extensions().get::<UdsConnectInfo>().is_some();
        let wire::LeaseRequest { worker, max_tiles, wait_ms } = request.into_inner();
        let wait = Duration::from_millis(wait_ms.into()).min(LONGEST_WAIT);
        let next = self.shared.next(WorkerId(worker), max_tiles as usize, wait, is_local).await?;
        Ok(Response::new(wire::LeaseResponse { next: Some(next) }))
    }

    async fn renew(
        &self,
        request: Request<wire::RenewRequest>,
    ) -> Result<Response<wire::RenewResponse>, Status> {
        let wire::RenewRequest { worker, leases } = request.into_inner();
        let leases: Vec<LeaseName> = leases.into_iter().map(LeaseName::from).collect();
        let lost = self.shared.jobs().on_progress(WorkerId(worker), &leases, now());
        let lost = lost.map_err(no_member)?.into_iter().map(Into::into).collect();
        Ok(Response::new(wire::RenewResponse { lost }))
    }

    async fn deliver(
        &self,
        request: Request<wire::DeliverRequest>,
    ) -> Result<Response<wire::DeliverResponse>, Status> {
        let shared = Arc::clone(&self.shared);
        let delivery = request.into_inner();
        let verdict = blocking(move || shared.take(&delivery)).await?;
        Ok(Response::new(wire::DeliverResponse { verdict: verdict.into() }))
    }

    async fn leave(
        &self,
        request: Request<wire::LeaveRequest>,
    ) -> Result<Response<wire::LeaveResponse>, Status> {
        let wire::LeaveRequest { worker, reason } = request.into_inner();
        self.shared.lose_worker(WorkerId(worker), &reason);
        Ok(Response::new(wire::LeaveResponse {}))
    }

    type FetchStream = Chunks;

    async fn fetch(
        &self,
        request: Request<wire::FetchRequest>,
    ) -> Result<Response<Chunks>, Status> {
        let hash = scene_hash(&request.into_inner().scene_hash).map_err(invalid)?;
        let mut jobs = self.shared.kept_jobs().into_iter();
        let job = jobs
            .find(|job| job.scene.hash() == hash)
            .ok_or_else(|| Status::not_found("no job has this scene now"))?;
        let file = std::fs::File::open(job.scene.path()).map_err(|error| broken(&error))?;
        Ok(Response::new(stream_file(file, job)))
    }
}

impl Shared {
    /// Waits for work for a worker.
    async fn next(
        &self,
        worker: WorkerId,
        most: usize,
        wait: Duration,
        is_local: bool,
    ) -> Result<lease_response::Next, Status> {
        let deadline = Instant::now() + wait;
        let mut changed = self.changed.subscribe();
        loop {
            if self.closing.is_cancelled() {
                self.processes().remove(&worker);
                return Ok(lease_response::Next::ShutDown(wire::ShutDown {}));
            }
            changed.borrow_and_update();
            let next = self.jobs().on_idle(worker, most, now()).map_err(no_member)?;
            let ask_again = match next {
                Next::Render(job, run) => match self.job(job) {
                    Some(job) => {
                        tracing::debug!(worker = worker.0, ?run, "leased");
                        return Ok(lease_response::Next::Run(wire::Run {
                            lease: Some(LeaseName { job: job.id, id: run.lease }.into()),
                            tiles: run.tiles.iter().map(|tile| tile.number()).collect(),
                            job: Some(describe(&job, is_local)),
                        }));
                    }
                    // It was cancelled a moment ago.
                    None => Some(Instant::now()),
                },
                Next::Wait(until) => until.map(Instant::from_std),
            };
            if Instant::now() >= deadline {
                return Ok(lease_response::Next::Nothing(wire::Nothing {}));
            }
            let wake = ask_again.map_or(deadline, |until| until.min(deadline));
            tokio::select! {
                _ = changed.changed() => {}
                () = self.closing.cancelled() => {}
                () = tokio::time::sleep_until(wake) => {}
            }
        }
    }

    /// Stitches a tile, if it is the first copy.
    fn take(&self, delivery: &wire::DeliverRequest) -> Result<wire::Verdict, Status> {
        let lease = delivery.lease.ok_or_else(|| invalid(WireError::Missing("lease")))?;
        let (worker, lease) = (WorkerId(delivery.worker), LeaseName::from(lease));
        let tile = self.jobs().tile(lease.job, delivery.tile);
        let (Some(tile), Some(job)) = (tile, self.job(lease.job)) else {
            return Ok(wire::Verdict::Rejected);
        };
        let area = job.grid.area(tile);
        let hash: PixelHash = *blake3::hash(&delivery.pixels).as_bytes();
        let pixels = pixels_from_bytes(&delivery.pixels).map_err(invalid)?;
        let tally = delivery.tally.ok_or_else(|| invalid(WireError::Missing("tally")))?;
        let tally = Tally::try_from(tally).map_err(invalid)?;
        if delivery.hash != hash[..] {
            tracing::error!(worker = worker.0, tile = tile.number(), "pixels were damaged");
            return Err(Status::data_loss("the pixels do not have the hash they came with"));
        }
        if let Err(error) = check_pixels(area, &pixels) {
            let reason = format!("worker {worker} rendered tile {}: {error}", tile.number());
            self.end(job.id, Outcome::Failed(reason));
            return Ok(wire::Verdict::Rejected);
        }

        let verdict = self.jobs().on_pixels(worker, lease, tile, hash, now());
        match verdict {
            Some(Verdict::Stitch) => {
                match job.picture.put(area, &pixels) {
                    Ok(()) => self.on_stitched(&job, worker, tile, (tally, delivery.seconds)),
                    Err(error) => self.fail_picture(&job, &error),
                }
                Ok(wire::Verdict::Accepted)
            }
            Some(Verdict::Duplicate) => {
                tracing::debug!(worker = worker.0, tile = tile.number(), "second copy");
                Ok(wire::Verdict::Duplicate)
            }
            Some(Verdict::Differs(first)) => {
                job.progress.send_modify(|progress| progress.differing_tiles += 1);
                tracing::error!(
                    worker = worker.0,
                    tile = tile.number(),
                    first = %blake3::Hash::from_bytes(first),
                    second = %blake3::Hash::from_bytes(hash),
                    "two copies of a tile differ; one of their workers is broken"
                );
                Ok(wire::Verdict::Duplicate)
            }
            None => Ok(wire::Verdict::Rejected),
        }
    }

    fn fail_picture(&self, job: &Job, error: &PutError) {
        self.end(job.id, Outcome::Failed(error.to_string()));
    }

    fn on_stitched(
        &self,
        job: &Job,
        worker: WorkerId,
        tile: TileId,
        (tally, seconds): (Tally, f64),
    ) {
        let elapsed = job.started.elapsed();
        let is_first_of_worker = job.note_worker(worker);
        let mut now_done = Progress::default();
        job.progress.send_modify(|progress| {
            progress.tiles_done += 1;
            progress.tally.add(&tally);
            progress.worker_count += u32::from(is_first_of_worker);
            now_done.clone_from(progress);
        });
        let (worker, rays) = (Some(worker.0), tally.rays);
        FinishedTile { tile, worker, seconds, rays }.log(&now_done, elapsed);
        if now_done.tiles_done == now_done.tile_count {
            self.end(job.id, Outcome::Finished(elapsed));
        }
    }
}

struct JobsService {
    shared: Arc<Shared>,
}

#[tonic::async_trait]
impl jobs_server::Jobs for JobsService {
    async fn submit(
        &self,
        request: Request<Streaming<wire::SubmitRequest>>,
    ) -> Result<Response<wire::SubmitResponse>, Status> {
        let Bundle { order, text, files } = receive(request.into_inner()).await?;
        check_version("client", &order.version, order.protocol, &self.shared)?;
        let wanted = to_request(order).map_err(invalid)?;
        let coordinator = Coordinator { shared: Arc::clone(&self.shared) };
        let (outcome, report) = blocking(move || {
            let resolve = |path: &str| {
                files.get(path).cloned().ok_or_else(|| {
                    let reason = format!("`{path}` was not sent along with the scene");
                    io::Error::new(io::ErrorKind::NotFound, reason)
                })
            };
            let name = wanted.name.clone();
            let Placed { order, diagnostics, omitted } = wanted.place(&text, &resolve);
            let mut report = draw_diagnostics(&name, &text, &diagnostics, Style::Plain);
            report.extend(omitted.summary());
            let job = order.and_then(|order| {
                coordinator.submit(order).map_err(|error| Refusal::Other(error.to_string()))
            });
            let outcome = match job {
                Ok(job) => submit_response::Outcome::Accepted(wire::Accepted {
                    job: job.id.0,
                    frame: Some(job.settings.size.into()),
                    tile_count: job.grid.count(),
                }),
                Err(Refusal::Scene) => submit_response::Outcome::Refused(String::new()),
                Err(Refusal::Other(reason)) => submit_response::Outcome::Refused(reason),
            };
            Ok((outcome, report))
        })
        .await?;
        Ok(Response::new(wire::SubmitResponse { outcome: Some(outcome), report }))
    }

    type WatchStream = Events;

    async fn watch(
        &self,
        request: Request<wire::WatchRequest>,
    ) -> Result<Response<Events>, Status> {
        let job = self.known_job(request.into_inner().job)?;
        let mut progress = job.progress();
        let (send, receive) = mpsc::channel(1);
        tokio::spawn(async move {
            loop {
                let event = to_event(&progress.borrow_and_update());
                let is_last = event.end.is_some();
                if send.send(Ok(event)).await.is_err() || is_last {
                    return;
                }
                tokio::time::sleep(WATCH_PERIOD).await;
                tokio::select! {
                    changed = progress.changed() => if changed.is_err() { return },
                    () = send.closed() => return,
                }
            }
        });
        Ok(Response::new(Box::pin(ReceiverStream::new(receive))))
    }

    type ImageStream = Chunks;

    async fn image(
        &self,
        request: Request<wire::ImageRequest>,
    ) -> Result<Response<Chunks>, Status> {
        let job = self.known_job(request.into_inner().job)?;
        if !matches!(job.progress.borrow().outcome, Some(Outcome::Finished(_))) {
            return Err(Status::failed_precondition("the job has not finished"));
        }
        let folder = self.shared.config.picture_folder.clone();
        let encoded = blocking({
            let job = Arc::clone(&job);
            move || {
                let encode = || {
                    let mut file = BufWriter::new(tempfile::tempfile_in(folder)?);
                    job.picture.encode(&mut file)?;
                    let mut file = file.into_inner().map_err(io::IntoInnerError::into_error)?;
                    file.rewind()?;
                    Ok(file)
                };
                encode().map_err(|error: io::Error| broken(&error))
            }
        })
        .await?;
        Ok(Response::new(stream_file(encoded, job)))
    }

    async fn cancel(
        &self,
        request: Request<wire::CancelRequest>,
    ) -> Result<Response<wire::CancelResponse>, Status> {
        let coordinator = Coordinator { shared: Arc::clone(&self.shared) };
        coordinator.cancel(JobId(request.into_inner().job));
        Ok(Response::new(wire::CancelResponse {}))
    }
}

impl JobsService {
    fn known_job(&self, job: u64) -> Result<Arc<Job>, Status> {
        let job = self.shared.job(JobId(job));
        job.ok_or_else(|| Status::not_found("there is no such job"))
    }
}

/// A scene as a client sends it: its text and the files that it names.
struct Bundle {
    order: wire::Order,
    text: Vec<u8>,
    files: HashMap<String, Vec<u8>>,
}

async fn receive(mut parts: Streaming<wire::SubmitRequest>) -> Result<Bundle, Status> {
    let (mut order, mut text, mut files) = (None, Vec::new(), HashMap::<String, Vec<u8>>::new());
    let mut byte_count = 0;
    while let Some(part) = parts.message().await? {
        match part.part {
            Some(submit_request::Part::Order(first)) => order = Some(first),
            Some(submit_request::Part::Text(piece)) => {
                byte_count += piece.len();
                text.extend_from_slice(&piece);
            }
            Some(submit_request::Part::File(piece)) => {
                byte_count += piece.path.len() + piece.data.len();
                files.entry(piece.path).or_default().extend_from_slice(&piece.data);
            }
            None => {}
        }
        if byte_count > LONGEST_BUNDLE {
            return Err(Status::resource_exhausted("the scene and its files are too long"));
        }
    }
    let order = order.ok_or_else(|| invalid(WireError::Missing("order")))?;
    Ok(Bundle { order, text, files })
}

fn to_request(order: wire::Order) -> Result<RenderRequest, WireError> {
    let format = order.format().try_into()?;
    let size = order.frame.map(Size::try_from).transpose()?;
    let transfer = transfer(order.transfer)?;
    let quality = order.quality.ok_or(WireError::Missing("quality"))?.try_into()?;
    let wire::Order { name, strict, tile_side, .. } = order;
    let tile_side = (tile_side > 0).then_some(tile_side.into());
    Ok(RenderRequest { name, strict, size, quality, tile_side, transfer, format })
}

fn to_event(progress: &Progress) -> wire::Event {
    wire::Event {
        tiles_done: progress.tiles_done,
        tile_count: progress.tile_count,
        tally: Some(progress.tally.into()),
        workers: progress.worker_count,
        differing_tiles: progress.differing_tiles,
        end: progress.outcome.as_ref().map(|outcome| match outcome {
            Outcome::Finished(time) => {
                event::End::Finished(wire::Finished { seconds: time.as_secs_f64() })
            }
            Outcome::Failed(reason) => event::End::Failed(reason.clone()),
        }),
    }
}

fn describe(job: &Job, is_local: bool) -> wire::Job {
    let path = job.scene.path().to_str().filter(|_| is_local);
    wire::Job {
        scene_hash: job.scene.hash().0.to_vec().into(),
        scene_bytes: job.scene.byte_count(),
        scene_path: path.unwrap_or_default().to_owned(),
        settings: Some(job.settings.into()),
        tile_side: job.grid.side(),
    }
}

/// Streams a file in pieces; `job` is kept until the last one has gone.
fn stream_file(mut file: std::fs::File, job: Arc<Job>) -> Chunks {
    let (send, receive) = mpsc::channel(2);
    tokio::task::spawn_blocking(move || {
        loop {
            let mut data = Vec::with_capacity(CHUNK_BYTES);
            let read = (&mut file).take(CHUNK_BYTES as u64).read_to_end(&mut data);
            let chunk = match read {
                Ok(0) => break,
                Ok(_) => Ok(wire::Chunk { data: data.into() }),
                Err(error) => Err(broken(&error)),
            };
            if send.blocking_send(chunk).is_err() {
                break;
            }
        }
        drop(job);
    });
    Box::pin(ReceiverStream::new(receive))
}

fn check_version(who: &str, version: &str, protocol: u32, shared: &Shared) -> Result<(), Status> {
    let ours = &shared.config.version;
    if version == ours && protocol == PROTOCOL {
        return Ok(());
    }
    tracing::warn!(version, protocol, "refused a {who} of another version");
    Err(Status::failed_precondition(format!(
        "this {who} is rtfarm {version} (protocol {protocol}), the coordinator is rtfarm {ours} \
         (protocol {PROTOCOL}); both must be the same"
    )))
}

fn now() -> std::time::Instant {
    Instant::now().into_std()
}

#[expect(clippy::needless_pass_by_value, reason = "`map_err` hands it over")]
fn invalid(error: WireError) -> Status {
    Status::invalid_argument(error.to_string())
}

#[expect(clippy::needless_pass_by_value, reason = "`map_err` hands it over")]
fn no_member(error: NoMember) -> Status {
    Status::not_found(error.to_string())
}

fn broken(error: &io::Error) -> Status {
    Status::internal(error.to_string())
}

async fn blocking<T: Send + 'static>(
    work: impl FnOnce() -> Result<T, Status> + Send + 'static,
) -> Result<T, Status> {
    match tokio::task::spawn_blocking(work).await {
        Ok(result) => result,
        Err(error) => Err(Status::internal(error.to_string())),
    }
}
