//! The gRPC services: requests to events, answers to responses. A `Status` is chosen here and
//! nowhere else.

use std::{
    io::{self, BufWriter, Read, Seek},
    pin::Pin,
    sync::Arc,
    task::{Context, Poll, ready},
    time::Duration,
};

use prost::Message;
use rtfarm_core::{
    language::{Style, draw_diagnostics},
    prepare::Form,
    render::Tally,
    tile::{Crop, Size, TileId},
};
use rtfarm_job::{Order, Outcome, Placed, Refusal, RenderRequest};
use rtfarm_picture::{Picture, TilePixels, TileRecord};
use rtfarm_proto::{
    CHUNK_BYTES, JobId, LONGEST_WAIT, LeaseName, MESSAGE_BYTES, PROTOCOL, Renewal, WireError,
    WorkerId, scene_hash, transfer,
    wire::{
        self, control_request, farm_server, jobs_server, lease_response, submit_request,
        submit_response,
    },
};
use rustix::io::Errno;
use tokio::sync::{Notify, OwnedSemaphorePermit, mpsc, oneshot};
use tokio_stream::{Stream, wrappers::ReceiverStream};
use tokio_util::sync::CancellationToken;
use tonic::{
    Request, Response, Status, Streaming,
    service::Routes,
    transport::{Server, server::Router},
};

use crate::{
    accept::Peer,
    farm::{Attempt, Change, Delivery, Explanation, JobEntry, JobPhase, Next, Refused, Verdict},
    guard::Guarded,
    identity::Stranger,
    job::Job,
    lease::Run,
    members::{MemberEntry, NoMember, Process, Standing},
    page::{Keeper, Page},
    record::{Ticket, to_event, to_standing},
    security::{Holder, Owner, Role, Security},
    shell::{ChangeError, Config, Shell},
    tiles::PixelHash,
    upload::{Ordered, Spool, Uploads},
};

/// The most bytes that a scene and its files may have.
const LONGEST_BUNDLE: u64 = 1 << 31;

/// The longest message of a client: a piece of a scene, or of a file with its path.
const PIECE_BYTES: usize = CHUNK_BYTES + (1 << 16);

/// A watching client hears of changes no more often than this.
const WATCH_PERIOD: Duration = Duration::from_millis(50);

/// Whether there are workers at all is looked at so often.
const WORKERS_PERIOD: Duration = Duration::from_secs(1);

type Chunks = Pin<Box<dyn Stream<Item = Result<wire::Chunk, Status>> + Send>>;
type Events = Pin<Box<dyn Stream<Item = Result<wire::Event, Status>> + Send>>;

/// Both services over one coordinator and its page, for those who have a token if there is `security`.
pub(crate) fn router(shell: &Arc<Shell>, security: Option<Arc<Security>>) -> Router {
    const WINDOW_BYTES: u32 = 1 << 22;
    // A frame of a delivery; each costs both sides a call of the system.
    const FRAME_BYTES: u32 = 1 << 17;
    let (farm, jobs) = services(shell);
    // Who asks for it may have no token: it says that the coordinator serves, and no more.
    let (reporter, health) = tonic_health::server::health_reporter();
    drop(reporter);
    let keeper = security.clone().map_or(Keeper::Nobody, Keeper::Farm);
    let arriving = shell.arriving.clone();
    let routes = Routes::new(Guarded::new(farm, security.clone(), arriving.clone()))
        .add_service(Guarded::new(jobs, security, arriving))
        .add_service(health)
        .into_axum_router()
        .fallback_service(Page::new(shell, keeper));
    Server::builder()
        .initial_stream_window_size(WINDOW_BYTES)
        .initial_connection_window_size(WINDOW_BYTES)
        .max_frame_size(FRAME_BYTES)
        .http2_keepalive_interval(Some(Duration::from_secs(10)))
        .http2_keepalive_timeout(Some(Duration::from_secs(20)))
        // Browsers speak it where nothing is encrypted, and may elsewhere.
        .accept_http1(true)
        .add_routes(routes.into())
}

/// The page alone, for those who have this token.
pub(crate) fn page_router(shell: &Arc<Shell>, token: &str) -> Router {
    let page = Page::new(shell, Keeper::Token(blake3::hash(token.as_bytes())));
    let routes = Routes::default().into_axum_router().fallback_service(page);
    Server::builder().accept_http1(true).add_routes(routes.into())
}

/// What workers call, and what clients call.
pub(crate) fn services(
    shell: &Arc<Shell>,
) -> (farm_server::FarmServer<FarmService>, jobs_server::JobsServer<JobsService>) {
    let farm = farm_server::FarmServer::new(FarmService { shell: Arc::clone(shell) })
        .max_decoding_message_size(MESSAGE_BYTES)
        .max_encoding_message_size(MESSAGE_BYTES);
    let jobs = jobs_server::JobsServer::new(JobsService {
        shell: Arc::clone(shell),
        uploads: Uploads::default(),
    })
    .max_decoding_message_size(PIECE_BYTES)
    .max_encoding_message_size(MESSAGE_BYTES);
    (farm, jobs)
}

pub(crate) struct FarmService {
    shell: Arc<Shell>,
}

#[tonic::async_trait]
impl farm_server::Farm for FarmService {
    async fn join(
        &self,
        request: Request<wire::JoinRequest>,
    ) -> Result<Response<wire::JoinResponse>, Status> {
        let request = request.into_inner();
        check_version("worker", &request.version, request.protocol, &self.shell)?;
        check_pixels_of(&request, &self.shell)?;
        let wire::JoinRequest { nonce, threads, isa, host, process, memory, .. } = request;
        let (threads, memory) = (threads as usize, (memory > 0).then_some(memory));
        let process = Process { nonce, number: process, threads, host, isa, memory };
        let worker = self.shell.join(process);
        let worker = worker.map_err(|error| Status::failed_precondition(error.to_string()))?;
        let term_ms = u32::try_from(self.shell.config.term.as_millis()).unwrap_or(u32::MAX);
        Ok(Response::new(wire::JoinResponse {
            worker: worker.0,
            term_ms,
            farm: self.shell.identity.farm.0.to_vec().into(),
            incarnation: self.shell.identity.incarnation.0,
        }))
    }

    async fn lease(
        &self,
        request: Request<wire::LeaseRequest>,
    ) -> Result<Response<wire::LeaseResponse>, Status> {
        let is_local = request.extensions().get::<Peer>().is_some_and(|peer| peer.is_local);
        let wire::LeaseRequest { worker, max_tiles, wait_ms, incarnation, kept } =
            request.into_inner();
        self.shell.admit(incarnation).map_err(stranger)?;
        let wait = Duration::from_millis(wait_ms.into()).min(LONGEST_WAIT);
        let worker_id = WorkerId(worker);
        let offered =
            kept.and_then(|kept| self.shell.offer(worker_id, JobId(kept.job), &kept.tiles));
        let next = match offered {
            Some(run) => Ok(Next::Render(run)),
            None => self.shell.ask(worker_id, max_tiles as usize, wait).await,
        };
        let next = match next.map_err(no_member)? {
            Next::Render(run) => {
                tracing::debug!(worker, ?run, "leased");
                // A job that was cancelled a moment ago is nothing to do.
                let job = self.shell.job(run.lease.job);
                job.map(|job| lease_response::Next::Run(to_run(&run, &job, is_local)))
            }
            Next::Nothing => None,
            Next::GoHome => Some(lease_response::Next::ShutDown(wire::ShutDown {})),
        };
        let next = next.unwrap_or(lease_response::Next::Nothing(wire::Nothing {}));
        Ok(Response::new(wire::LeaseResponse { next: Some(next) }))
    }

    async fn renew(
        &self,
        request: Request<wire::RenewRequest>,
    ) -> Result<Response<wire::RenewResponse>, Status> {
        let wire::RenewRequest { worker, renewals, incarnation } = request.into_inner();
        self.shell.admit(incarnation).map_err(stranger)?;
        let renewals = renewals.into_iter().map(Renewal::try_from);
        let renewals = renewals.collect::<Result<Vec<Renewal>, WireError>>().map_err(invalid)?;
        let lost = self.shell.renew(WorkerId(worker), &renewals).map_err(no_member)?;
        let lost = lost.into_iter().map(Into::into).collect();
        Ok(Response::new(wire::RenewResponse { lost }))
    }

    async fn deliver(
        &self,
        request: Request<wire::DeliverRequest>,
    ) -> Result<Response<wire::DeliverResponse>, Status> {
        let shell = Arc::clone(&self.shell);
        let wire::DeliverRequest { worker, incarnation, tiles } = request.into_inner();
        self.shell.admit(incarnation).map_err(stranger)?;
        let mut verdicts = vec![wire::Verdict::Rejected.into(); tiles.len()];
        let taken = blocking(move || take(&shell, WorkerId(worker), tiles)).await?;
        if let Some((places, decided)) = taken {
            let decided = decided.await.expect("every delivery is answered");
            for (place, verdict) in places.into_iter().zip(decided) {
                verdicts[place] = to_verdict(verdict).into();
            }
        }
        tracing::debug!(worker, ?verdicts, "answered");
        Ok(Response::new(wire::DeliverResponse { verdicts }))
    }

    async fn leave(
        &self,
        request: Request<wire::LeaveRequest>,
    ) -> Result<Response<wire::LeaveResponse>, Status> {
        let wire::LeaveRequest { worker, reason, incarnation } = request.into_inner();
        self.shell.admit(incarnation).map_err(stranger)?;
        self.shell.leave(WorkerId(worker), &reason);
        Ok(Response::new(wire::LeaveResponse {}))
    }

    type FetchStream = Chunks;

    async fn fetch(
        &self,
        request: Request<wire::FetchRequest>,
    ) -> Result<Response<Chunks>, Status> {
        let peer = request.extensions().get::<Peer>().cloned();
        let wire::FetchRequest { scene_hash: hash, incarnation } = request.into_inner();
        self.shell.admit(incarnation).map_err(stranger)?;
        let hash = scene_hash(&hash).map_err(invalid)?;
        let job = self.shell.job_with_scene(hash);
        let job = job.ok_or_else(|| Status::not_found("no job has this scene now"))?;
        let file = std::fs::File::open(job.scene.path()).map_err(|error| match error.kind() {
            // The job was forgotten a moment ago.
            io::ErrorKind::NotFound => Status::not_found("no job has this scene now"),
            _ => broken(&error),
        })?;
        Ok(Response::new(stream_file(file, job, peer, &self.shell)))
    }
}

/// The places in a message of tiles that were handed on, and what is decided about each of them.
type Taken = (Vec<usize>, oneshot::Receiver<Vec<Verdict>>);

/// Reads tiles and hands on those that there are and whose pixels make sense. `None` when none does.
/// This hashes and writes: never call it on the async runtime.
fn take(
    shell: &Shell,
    worker: WorkerId,
    tiles: Vec<wire::FinishedTile>,
) -> Result<Option<Taken>, Status> {
    let (mut places, mut good) = (Vec::new(), Vec::with_capacity(tiles.len()));
    for (place, finished) in tiles.into_iter().enumerate() {
        let lease = finished.lease.ok_or_else(|| invalid(WireError::Missing("lease")))?;
        let lease = LeaseName::from(lease);
        let Some((tile, job)) = shell.tile(lease.job, finished.tile) else { continue };
        let hash: PixelHash = job.hasher.hash(tile, &finished.pixels);
        let tally = finished.tally.ok_or_else(|| invalid(WireError::Missing("tally")))?;
        let tally = Tally::try_from(tally).map_err(invalid)?;
        if finished.hash != hash[..] {
            tracing::error!(worker = worker.0, tile = tile.number(), "pixels were damaged");
            return Err(Status::data_loss("the pixels do not have the hash they came with"));
        }
        let pixels = TilePixels { area: job.grid.area(tile), bytes: &finished.pixels };
        if let Err(error) = pixels.check() {
            shell.report_senseless_pixels(worker, lease, tile, &error.to_string());
            continue;
        }
        places.push(place);
        let delivery = Delivery { worker, lease, tile, hash, seconds: finished.seconds, tally };
        good.push((delivery, finished.pixels));
    }
    Ok((!good.is_empty()).then(|| (places, shell.deliver(good))))
}

fn to_verdict(verdict: Verdict) -> wire::Verdict {
    match verdict {
        Verdict::Accepted => wire::Verdict::Accepted,
        Verdict::Duplicate => wire::Verdict::Duplicate,
        Verdict::Rejected => wire::Verdict::Rejected,
    }
}

pub(crate) struct JobsService {
    shell: Arc<Shell>,
    uploads: Uploads,
}

#[tonic::async_trait]
impl jobs_server::Jobs for JobsService {
    async fn submit(
        &self,
        request: Request<Streaming<wire::SubmitRequest>>,
    ) -> Result<Response<wire::SubmitResponse>, Status> {
        let holder = request.extensions().get::<Holder>().cloned();
        let is_admin = holder.as_ref().is_some_and(|holder| holder.role() == Role::Admin);
        let owner = holder.as_ref().and_then(Holder::owner);
        let bundle = match receive(request.into_inner(), owner, &self.shell, &self.uploads).await? {
            Received::Known(job) => return Ok(Response::new(accepted(&job, &self.shell))),
            Received::New(bundle) => bundle,
        };
        let Bundle { order, ticket, spool } = *bundle;
        let wanted = to_request(order).map_err(invalid)?;
        let shell = Arc::clone(&self.shell);
        let client_gone = CancellationToken::new();
        let _here = client_gone.clone().drop_guard();
        let (answer, unclaimed) = blocking(move || {
            let name = wanted.name.clone();
            let text = spool.text().map_err(|error| cannot_spool(&error))?;
            let placed = wanted.place(&text, &|path: &str| spool.file(path));
            let Placed { order, diagnostics, omitted, .. } = placed;
            let mut report = draw_diagnostics(&name, &text, &diagnostics, Style::Plain);
            report.extend(omitted.summary());
            if client_gone.is_cancelled() {
                return Err(Status::cancelled("the client is gone"));
            }
            drop((text, spool));
            let job = order.and_then(|order| {
                // Two that come together do not both take the last place.
                let _one = shell.ordering.lock().expect("nothing there panics");
                let limits = shell.config.orders;
                let account = &ticket.account;
                let there = || ordered(&shell, account);
                let refusal = || limits.refusal(account, there(), to_be_ordered(&order));
                match refusal().filter(|_| !is_admin) {
                    Some(reason) => Err(Refusal::Other(reason)),
                    None => shell
                        .submit(order, ticket)
                        .map_err(|error| Refusal::Other(error.to_string())),
                }
            });
            let refused = |reason| wire::SubmitResponse {
                outcome: Some(submit_response::Outcome::Refused(reason)),
                report: String::new(),
            };
            let job_id = job.as_ref().ok().map(|job| job.id);
            let answer = match job {
                Ok(job) => accepted(&job, &shell),
                Err(Refusal::Scene) => refused(String::new()),
                Err(Refusal::Other(reason)) => refused(reason),
            };
            let unclaimed = job_id.map(|job| Unclaimed { shell, job: Some(job) });
            Ok((wire::SubmitResponse { report, ..answer }, unclaimed))
        })
        .await?;
        if let Some(mut unclaimed) = unclaimed {
            unclaimed.job = None;
        }
        Ok(Response::new(answer))
    }

    type WatchStream = Events;

    async fn watch(
        &self,
        request: Request<wire::WatchRequest>,
    ) -> Result<Response<Events>, Status> {
        let wire::WatchRequest { job, farm } = request.into_inner();
        let job = self.job(job, &farm)?;
        let mut progress = job.progress();
        let (send, receive) = mpsc::channel(1);
        // A stream that nobody ends does not keep the coordinator.
        let shell = Arc::downgrade(&self.shell);
        let lacks_workers_now = move || shell.upgrade().is_some_and(|shell| shell.lacks_workers());
        tokio::spawn(async move {
            loop {
                let mut event = to_event(&progress.borrow_and_update());
                let lacks_workers = lacks_workers_now();
                add_lack(&mut event, lacks_workers);
                let is_last = event.end.is_some();
                if send.send(Ok(event)).await.is_err() || is_last {
                    return;
                }
                tokio::time::sleep(WATCH_PERIOD).await;
                let other_workers = async {
                    while lacks_workers_now() == lacks_workers {
                        tokio::time::sleep(WORKERS_PERIOD).await;
                    }
                };
                tokio::select! {
                    biased;
                    changed = progress.changed() => if changed.is_err() { return },
                    () = send.closed() => return,
                    () = other_workers => {}
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
        let peer = request.extensions().get::<Peer>().cloned();
        let wire::ImageRequest { job, farm, partial } = request.into_inner();
        let job = self.job(job, &farm)?;
        if !partial && !matches!(job.progress.borrow().outcome, Some(Outcome::Finished(_))) {
            return Err(Status::failed_precondition("the job has not finished"));
        }
        let folder = self.shell.config.picture_folder.clone();
        let Config { version, build, .. } = &self.shell.config;
        let software = format!("{version} ({build})");
        let encoded = blocking({
            let job = Arc::clone(&job);
            move || {
                let encode = || {
                    let notes = job.notes(&software)?;
                    let mut file = BufWriter::new(tempfile::tempfile_in(folder)?);
                    job.picture().encode(&notes, &mut file)?;
                    let mut file = file.into_inner().map_err(io::IntoInnerError::into_error)?;
                    file.rewind()?;
                    Ok(file)
                };
                encode().map_err(|error: io::Error| broken(&error))
            }
        })
        .await?;
        Ok(Response::new(stream_file(encoded, job, peer, &self.shell)))
    }

    async fn cancel(
        &self,
        request: Request<wire::CancelRequest>,
    ) -> Result<Response<wire::CancelResponse>, Status> {
        let holder = request.extensions().get::<Holder>().cloned();
        let wire::CancelRequest { job, farm } = request.into_inner();
        self.shell.admit_client(&farm).map_err(stranger)?;
        self.check_change(holder, JobId(job))?;
        let was_known = self.shell.cancel(JobId(job));
        Ok(Response::new(wire::CancelResponse { was_known }))
    }

    async fn list(
        &self,
        _: Request<wire::ListRequest>,
    ) -> Result<Response<wire::ListResponse>, Status> {
        let jobs = self.shell.jobs();
        let mut jobs: Vec<wire::JobEntry> =
            jobs.iter().map(|(entry, job)| to_job_entry(entry, job)).collect();
        let lacks_workers = self.shell.lacks_workers();
        for event in jobs.iter_mut().filter_map(|job| job.progress.as_mut()) {
            add_lack(event, lacks_workers);
        }
        Ok(Response::new(wire::ListResponse { jobs }))
    }

    async fn control(
        &self,
        request: Request<wire::ControlRequest>,
    ) -> Result<Response<wire::ControlResponse>, Status> {
        let holder = request.extensions().get::<Holder>().cloned();
        let wire::ControlRequest { job, farm, change } = request.into_inner();
        self.shell.admit_client(&farm).map_err(stranger)?;
        self.check_change(holder, JobId(job))?;
        let change = match change.ok_or_else(|| invalid(WireError::Missing("change")))? {
            control_request::Change::Paused(is_paused) => Change::Pause(is_paused),
            control_request::Change::Priority(priority) => Change::Priority(priority),
            control_request::Change::Retry(wire::Nothing {}) => Change::Retry,
        };
        let shell = Arc::clone(&self.shell);
        blocking(move || {
            shell.change(JobId(job), change).map_err(|error| match error {
                ChangeError::Refused(Refused::Unknown) => Status::not_found(error.to_string()),
                ChangeError::Refused(_) => Status::failed_precondition(error.to_string()),
                ChangeError::Picture(_) => Status::internal(error.to_string()),
            })
        })
        .await?;
        Ok(Response::new(wire::ControlResponse {}))
    }

    async fn workers(
        &self,
        _: Request<wire::WorkersRequest>,
    ) -> Result<Response<wire::WorkersResponse>, Status> {
        let workers = self.shell.workers().into_iter().map(to_worker_entry).collect();
        Ok(Response::new(wire::WorkersResponse { workers }))
    }

    async fn explain(
        &self,
        request: Request<wire::ExplainRequest>,
    ) -> Result<Response<wire::ExplainResponse>, Status> {
        let wire::ExplainRequest { job, farm, tile } = request.into_inner();
        let job = self.job(job, &farm)?;
        let tile = job.grid.tile(tile).ok_or_else(|| {
            Status::not_found(format!("the job has the tiles 0 to {}", job.grid.count() - 1))
        })?;
        let known = self.shell.explain(job.id, tile);
        let known = known.ok_or_else(|| Status::not_found("there is no such job"))?;
        // What an earlier start took stands with the picture.
        let record = blocking({
            let job = Arc::clone(&job);
            move || job.canvas.record(tile).map_err(|error| broken(&error))
        })
        .await?;
        Ok(Response::new(to_explanation(&job, tile, known, record)))
    }

    async fn station(
        &self,
        request: Request<wire::StationRequest>,
    ) -> Result<Response<wire::StationResponse>, Status> {
        let request = request.into_inner();
        let standing = match request.standing() {
            wire::Standing::Active => Standing::Active,
            wire::Standing::Draining => Standing::Draining,
            wire::Standing::Disabled => Standing::Disabled,
            wire::Standing::Unspecified => return Err(invalid(WireError::Missing("standing"))),
        };
        let was_known = self.shell.station(WorkerId(request.worker), standing).is_ok();
        Ok(Response::new(wire::StationResponse { was_known }))
    }
}

impl JobsService {
    fn job(&self, job: u64, farm: &[u8]) -> Result<Arc<Job>, Status> {
        self.shell.admit_client(farm).map_err(stranger)?;
        let job = self.shell.job(JobId(job));
        job.ok_or_else(|| Status::not_found("there is no such job"))
    }

    /// Refuses a change of a job by who may submit, and did not order it.
    fn check_change(&self, holder: Option<Holder>, job: JobId) -> Result<(), Status> {
        let Some(holder) = holder.filter(|holder| holder.role() != Role::Admin) else {
            return Ok(());
        };
        let account = account(holder.owner());
        let Some(changed) = self.shell.job(job).filter(|job| job.ticket.account != account) else {
            return Ok(());
        };
        let by = match &*changed.ticket.account {
            "" => "a token without an owner".to_owned(),
            owner => format!("the token of {owner}"),
        };
        Err(Status::permission_denied(format!(
            "job {} was ordered by {by}; only such a token and one of the role admin may change it",
            job.0
        )))
    }
}

/// A job that no client knows of yet. It is cancelled when this is dropped, as it is with the answer
/// that nobody waits for any more.
struct Unclaimed {
    shell: Arc<Shell>,
    job: Option<JobId>,
}

impl Drop for Unclaimed {
    fn drop(&mut self) {
        if let Some(job) = self.job {
            self.shell.abandon(job);
        }
    }
}

/// The answer to a client whose job there is.
fn accepted(job: &Job, shell: &Shell) -> wire::SubmitResponse {
    let accepted = wire::Accepted {
        job: job.id.0,
        frame: Some(job.grid.window().size().into()),
        tile_count: job.grid.count(),
        farm: shell.identity.farm.0.to_vec().into(),
    };
    let outcome = Some(submit_response::Outcome::Accepted(accepted));
    wire::SubmitResponse { outcome, report: String::new() }
}

/// Says of a job that has not ended whether it waits for workers.
fn add_lack(event: &mut wire::Event, lacks_workers: bool) {
    if lacks_workers && event.end.is_none() && event.obstacle.is_empty() {
        "the farm has no worker".clone_into(&mut event.obstacle);
    }
}

fn to_job_entry(entry: &JobEntry, job: &Job) -> wire::JobEntry {
    let JobEntry { id, phase, terms, workers_now, progress, elapsed, expires_in } = entry;
    let state = match phase {
        JobPhase::Waiting => wire::JobState::Waiting,
        JobPhase::Rendering => wire::JobState::Rendering,
        JobPhase::Paused => wire::JobState::Paused,
        JobPhase::Finished => wire::JobState::Finished,
        JobPhase::Failed => wire::JobState::Failed,
    };
    wire::JobEntry {
        job: id.0,
        name: job.ticket.name.clone(),
        owner: job.ticket.owner.clone(),
        state: state.into(),
        priority: terms.priority,
        max_workers: terms.most_workers.unwrap_or(0),
        workers_now: *workers_now as u32,
        progress: Some(to_event(progress)),
        seconds: elapsed.as_secs_f64(),
        bytes: terms.byte_count,
        expires_in: expires_in.unwrap_or_default().as_secs_f64(),
        frame: Some(job.grid.window().size().into()),
    }
}

fn to_worker_entry((entry, tiles_leased): (MemberEntry, usize)) -> wire::WorkerEntry {
    let MemberEntry { worker, process, standing, tiles_done, silence } = entry;
    let Process { number, threads, host, isa, memory, .. } = process;
    wire::WorkerEntry {
        worker: worker.0,
        host,
        process: number,
        threads: threads as u32,
        isa,
        standing: to_standing(standing).into(),
        memory: memory.unwrap_or(0),
        tiles_leased: tiles_leased as u32,
        tiles_done,
        silence: silence.as_secs_f64(),
    }
}

fn to_explanation(
    job: &Job,
    tile: TileId,
    known: Explanation,
    record: Option<TileRecord>,
) -> wire::ExplainResponse {
    let Explanation { is_done, is_in_work, brought, attempts } = known;
    let state = match (is_done, is_in_work) {
        (true, _) => wire::TileState::Done,
        (_, true) => wire::TileState::InWork,
        _ => wire::TileState::Open,
    };
    let won = brought.filter(|_| is_done).map(|delivery| delivery.lease.id);
    let taken = match (brought, record) {
        (Some(Delivery { hash, seconds, tally, .. }), _) => Some((hash, seconds, tally)),
        (_, Some(record)) => Some((record.arrived, record.seconds.into(), record.tally)),
        _ => None,
    };
    let taken = taken.filter(|_| is_done);
    let to_attempt = |attempt: &Attempt| wire::Attempt {
        worker: attempt.worker.0,
        host: attempt.host.clone(),
        age: attempt.age.as_secs_f64(),
        lost: attempt.lost.clone().unwrap_or_default(),
        lease: attempt.lease.0,
        won: Some(attempt.lease) == won,
    };
    let attempts: Vec<wire::Attempt> = attempts.iter().map(to_attempt).collect();
    let host = attempts.iter().find(|attempt| attempt.won).map(|attempt| attempt.host.clone());
    wire::ExplainResponse {
        state: state.into(),
        area: Some(Crop::from(job.grid.area(tile)).into()),
        worker: brought.filter(|_| is_done).map_or(0, |delivery| delivery.worker.0),
        host: host.unwrap_or_default(),
        hash: taken.map_or_else(Vec::new, |(hash, ..)| hash.to_vec()).into(),
        seconds: taken.map_or(0.0, |(_, seconds, _)| seconds),
        tally: taken.map(|(.., tally)| tally.into()),
        attempts,
    }
}

/// A scene as a client sends it.
struct Bundle {
    order: wire::Order,
    ticket: Ticket,
    spool: Spool,
}

/// Whose jobs are those that this owner's token orders; empty for a token that has no owner.
fn account(owner: Option<&Owner>) -> String {
    owner.map(Owner::to_string).unwrap_or_default()
}

/// What the farm has to do and to keep for an account.
fn ordered(shell: &Shell, account: &str) -> Ordered {
    let mut all = Ordered::default();
    let jobs = shell.jobs().into_iter().filter(|(_, job)| job.ticket.account == account);
    for (JobEntry { phase, terms, .. }, job) in jobs {
        all.bytes += terms.byte_count;
        if !matches!(phase, JobPhase::Finished | JobPhase::Failed) {
            all.jobs += 1;
            all.pixels += job.grid.window().size().pixel_count();
        }
    }
    all
}

/// What an order adds to it.
fn to_be_ordered(order: &Order) -> Ordered {
    let size = order.grid.window().size();
    let bytes = order.prepared.as_ref().len() as u64 + Picture::byte_count(size, order.format);
    Ordered { jobs: 1, pixels: size.pixel_count(), bytes }
}

fn cannot_spool(error: &io::Error) -> Status {
    Status::resource_exhausted(format!("the scene cannot be kept while it comes: {error}"))
}

/// What a client sent.
enum Received {
    New(Box<Bundle>),
    /// An order whose job is there already.
    Known(Arc<Job>),
}

async fn receive(
    parts: Streaming<wire::SubmitRequest>,
    holder: Option<&Owner>,
    shell: &Shell,
    uploads: &Uploads,
) -> Result<Received, Status> {
    // A piece that is decoded, and one that is written.
    let _room = shell.arriving.take(2 * PIECE_BYTES).await;
    let mut parts = Upload { parts, silence: shell.config.upload_silence };
    // What is not wanted is refused before it is sent.
    let Some(submit_request::Part::Order(order)) = parts.next().await?.and_then(|part| part.part)
    else {
        return Err(invalid(WireError::Missing("order")));
    };
    check_version("client", &order.version, order.protocol, shell)?;
    let ticket = to_ticket(&order, holder);
    let claimed = shell.claim(&ticket);
    if let Some(job) = claimed.map_err(|error| Status::already_exists(error.to_string()))? {
        return Ok(Received::Known(job));
    }
    let mut spool = Spool::new(&shell.config.scene_folder, uploads);
    let most = shell.config.orders.upload_bytes;
    let mut names = 0;
    while let Some(part) = parts.next().await? {
        let (path, piece) = match part.part {
            Some(submit_request::Part::Order(_)) => {
                return Err(Status::invalid_argument("a scene has one order"));
            }
            Some(submit_request::Part::Text(piece)) => (None, piece),
            Some(submit_request::Part::File(piece)) => (Some(piece.path), piece.data),
            None => continue,
        };
        names += path.as_ref().map_or(0, String::len) as u64;
        spool = blocking(move || {
            let mut spool = spool.map_err(|error| cannot_spool(&error))?;
            spool.put(path, &piece).map_err(|error| cannot_spool(&error))?;
            Ok(Ok(spool))
        })
        .await?;
        let Ok(spool) = &spool else { continue };
        if spool.byte_count() + names > LONGEST_BUNDLE {
            return Err(Status::resource_exhausted("the scene and its files are too long"));
        }
        if spool.bytes_of_all() > most {
            return Err(Status::resource_exhausted(format!(
                "scenes that are being sent may have {:.2} GB together; try again later",
                most as f64 / 1e9
            )));
        }
    }
    let spool = spool.map_err(|error| cannot_spool(&error))?;
    Ok(Received::New(Box::new(Bundle { order, ticket, spool })))
}

/// What a client sends, piece by piece.
struct Upload {
    parts: Streaming<wire::SubmitRequest>,
    /// The longest that a piece may be on its way.
    silence: Duration,
}

impl Upload {
    /// The next piece; `None` after the last.
    async fn next(&mut self) -> Result<Option<wire::SubmitRequest>, Status> {
        let next = tokio::time::timeout(self.silence, self.parts.message()).await;
        next.unwrap_or_else(|_| {
            let seconds = self.silence.as_secs_f64();
            let reason = format!("nothing of the scene has come for {seconds:.1} s");
            Err(Status::deadline_exceeded(reason))
        })
    }
}

/// What an order says, of which whoever has a token as an owner is the owner.
fn to_ticket(order: &wire::Order, holder: Option<&Owner>) -> Ticket {
    let wire::Order { name, title, owner, key, priority, max_workers, .. } = order.clone();
    let name = if title.is_empty() { name } else { title };
    let most_workers = (max_workers > 0).then_some(max_workers);
    let account = account(holder);
    let owner = if account.is_empty() { owner } else { account.clone() };
    let wanted = blake3::hash(&wanted(order.clone()).encode_to_vec()).as_bytes().to_vec();
    Ticket { name, owner, account, key, wanted, priority, most_workers }
}

/// What an order says of the picture, without who wants it and how.
fn wanted(order: wire::Order) -> wire::Order {
    let [version, name, title, owner, key] = [(); 5].map(|()| String::new());
    let (protocol, priority, max_workers) = (0, 0, 0);
    wire::Order { version, protocol, name, title, owner, key, priority, max_workers, ..order }
}

fn to_request(order: wire::Order) -> Result<RenderRequest, WireError> {
    let format = order.format().try_into()?;
    let size = order.frame.map(Size::try_from).transpose()?;
    let transfer = transfer(order.transfer)?;
    let quality = order.quality.ok_or(WireError::Missing("quality"))?.try_into()?;
    let wire::Order { name, strict, tile_side, crop, compact, .. } = order;
    let tile_side = (tile_side > 0).then_some(tile_side.into());
    let crop = crop.map(Into::into);
    let form = if compact { Form::Compact } else { Form::Fast };
    Ok(RenderRequest { name, strict, size, crop, quality, tile_side, transfer, format, form })
}

/// Tells a worker all about its tiles; one on this machine also where the scene is.
fn to_run(run: &Run, job: &Job, is_local: bool) -> wire::Run {
    let path = job.scene.path().to_str().filter(|_| is_local);
    let description = wire::Job {
        scene_hash: job.scene.hash().0.to_vec().into(),
        scene_bytes: job.scene.byte_count(),
        scene_path: path.unwrap_or_default().to_owned(),
        settings: Some(job.settings.into()),
        tile_side: job.grid.side(),
        window: Some(Crop::from(job.grid.window()).into()),
    };
    wire::Run {
        lease: Some(run.lease.into()),
        tiles: run.tiles.iter().map(|tile| tile.number()).collect(),
        job: Some(description),
    }
}

/// Streams a file in pieces; `job` is kept until the last one has gone. A piece is read when the one
/// before it is on the wire: a reader that takes none holds no thread, and in the end loses its connection.
fn stream_file(file: std::fs::File, job: Arc<Job>, peer: Option<Peer>, shell: &Shell) -> Chunks {
    let (send, receive) = mpsc::channel(1);
    let (flight, silence) = (shell.leaving.clone(), shell.config.upload_silence);
    let asked = Arc::new(Notify::new());
    let pieces = Pieces { receive, asked: Arc::clone(&asked), is_asked: false, on_its_way: None };
    tokio::spawn(async move {
        let mut rest = Some(file);
        while let Some(file) = rest.take() {
            tokio::select! {
                () = asked.notified() => {}
                () = send.closed() => break,
                () = tokio::time::sleep(silence) => {
                    peer.as_ref().inspect(|peer| peer.cut_off());
                    break;
                }
            }
            let room = flight.take(CHUNK_BYTES).await;
            let chunk = match blocking(move || read_chunk(file)).await {
                Ok(None) => break,
                Ok(Some((file, chunk))) => {
                    rest = Some(file);
                    Ok(chunk)
                }
                Err(status) => Err(status),
            };
            if send.send((chunk, room)).await.is_err() {
                break;
            }
        }
        drop(job);
    });
    Box::pin(pieces)
}

/// Pieces of a file. Each has its room until the next is asked for: then it is on the wire.
struct Pieces {
    receive: mpsc::Receiver<(Result<wire::Chunk, Status>, OwnedSemaphorePermit)>,
    asked: Arc<Notify>,
    is_asked: bool,
    on_its_way: Option<OwnedSemaphorePermit>,
}

impl Stream for Pieces {
    type Item = Result<wire::Chunk, Status>;

    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        self.on_its_way = None;
        if !std::mem::replace(&mut self.is_asked, true) {
            self.asked.notify_one();
        }
        let next = ready!(self.receive.poll_recv(context));
        self.is_asked = false;
        Poll::Ready(next.map(|(chunk, room)| {
            self.on_its_way = Some(room);
            chunk
        }))
    }
}

/// The next piece of a file, and the file; `None` at its end.
fn read_chunk(mut file: std::fs::File) -> Result<Option<(std::fs::File, wire::Chunk)>, Status> {
    let mut data = Vec::with_capacity(CHUNK_BYTES);
    match (&mut file).take(CHUNK_BYTES as u64).read_to_end(&mut data) {
        Ok(0) => Ok(None),
        Ok(_) => Ok(Some((file, wire::Chunk { data: data.into() }))),
        Err(error) => Err(broken(&error)),
    }
}

fn check_version(who: &str, version: &str, protocol: u32, shell: &Shell) -> Result<(), Status> {
    let ours = &shell.config.version;
    if version == ours && protocol == PROTOCOL {
        return Ok(());
    }
    tracing::warn!(version, protocol, "refused a {who} of another version");
    Err(Status::failed_precondition(format!(
        "this {who} is rtfarm {version} (protocol {protocol}), the coordinator is rtfarm {ours} \
         (protocol {PROTOCOL}); both must be the same"
    )))
}

/// Refuses a worker whose pixels would be others than the coordinator's workers' should be.
fn check_pixels_of(request: &wire::JoinRequest, shell: &Shell) -> Result<(), Status> {
    let wire::JoinRequest { host, isa, build, reference, .. } = request;
    let Config { build: our_build, reference: ours, .. } = &shell.config;
    let reason = if build != our_build {
        format!(
            "this worker was built from other sources (build `{build}`) than the coordinator \
             (build `{our_build}`); build both from the same"
        )
    } else if let Some(ours) = ours
        && reference != &ours[..]
    {
        format!(
            "this worker, with {isa}, makes other pixels of the reference tile than the coordinator; \
             its compiler or its processor errs"
        )
    } else {
        return Ok(());
    };
    tracing::warn!(host, reason, "refused a worker");
    Err(Status::failed_precondition(reason))
}

#[expect(clippy::needless_pass_by_value, reason = "`map_err` hands it over")]
fn invalid(error: WireError) -> Status {
    Status::invalid_argument(error.to_string())
}

fn no_member(error: NoMember) -> Status {
    Status::not_found(error.to_string())
}

fn stranger(error: Stranger) -> Status {
    Status::not_found(error.to_string())
}

/// What is short for a while can be asked for again; what is broken cannot.
fn broken(error: &io::Error) -> Status {
    let short = [Errno::MFILE, Errno::NFILE, Errno::NOMEM].map(Errno::raw_os_error);
    if error.raw_os_error().is_some_and(|number| short.contains(&number)) {
        Status::unavailable(error.to_string())
    } else {
        Status::internal(error.to_string())
    }
}

async fn blocking<T: Send + 'static>(
    work: impl FnOnce() -> Result<T, Status> + Send + 'static,
) -> Result<T, Status> {
    if cfg!(test) {
        // A simulation has one thread.
        return work();
    }
    match tokio::task::spawn_blocking(work).await {
        Ok(result) => result,
        Err(error) => Err(Status::internal(error.to_string())),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tonic::Code;

    /// A worker that is refused for good ends; one that may ask again does.
    #[test]
    fn what_is_short_for_a_while_can_be_asked_for_again() {
        let code = |errno: Errno| broken(&errno.into()).code();
        for errno in [Errno::MFILE, Errno::NFILE, Errno::NOMEM] {
            assert_eq!(code(errno), Code::Unavailable, "{errno}");
        }
        for errno in [Errno::IO, Errno::NOSPC, Errno::ROFS] {
            assert_eq!(code(errno), Code::Internal, "{errno}");
        }
    }
}
