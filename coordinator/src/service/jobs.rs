//! What clients call.

use std::{
    io::{self, BufWriter, Seek},
    pin::Pin,
    sync::Arc,
    time::Duration,
};

use rtfarm_core::{
    language::{Style, draw_diagnostics},
    prepare::Form,
    tile::{Crop, Size, TileId},
};
use rtfarm_job::{Order, Outcome, Placed, Refusal, RenderRequest};
use rtfarm_picture::{Picture, TileRecord};
use rtfarm_proto::{
    JobId, WireError, WorkerId, transfer,
    wire::{self, control_request, jobs_server, submit_response},
};
use tokio::sync::mpsc;
use tokio_stream::{Stream, wrappers::ReceiverStream};
use tokio_util::sync::CancellationToken;
use tonic::{Request, Response, Status, Streaming};

use super::{
    blocking, broken, invalid, stranger,
    streaming::{Chunks, stream_file},
    uploading::{Bundle, Received, account, cannot_spool, receive},
};
use crate::{
    accept::Peer,
    farm::{Attempt, Change, Delivery, Explanation, JobEntry, JobPhase, Refused},
    job::Job,
    members::{MemberEntry, Process, Standing},
    record::{to_event, to_standing},
    security::{Holder, Role},
    shell::{ChangeError, Config, Shell},
    upload::{Ordered, Uploads},
};

/// A watching client hears of changes no more often than this.
const WATCH_PERIOD: Duration = Duration::from_millis(50);

type Events = Pin<Box<dyn Stream<Item = Result<wire::Event, Status>> + Send>>;

/// Whether there are workers at all is looked at so often.
const WORKERS_PERIOD: Duration = Duration::from_secs(1);

pub(crate) struct JobsService {
    pub(super) shell: Arc<Shell>,
    pub(super) uploads: Uploads,
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

/// A job that no client knows of yet. It is cancelled when this is dropped, as it is with the
/// answer that nobody waits for any more.
pub(super) struct Unclaimed {
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
pub(super) fn accepted(job: &Job, shell: &Shell) -> wire::SubmitResponse {
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
pub(super) fn add_lack(event: &mut wire::Event, lacks_workers: bool) {
    if lacks_workers && event.end.is_none() && event.obstacle.is_empty() {
        "the farm has no worker".clone_into(&mut event.obstacle);
    }
}

pub(super) fn to_job_entry(entry: &JobEntry, job: &Job) -> wire::JobEntry {
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

pub(super) fn to_worker_entry((entry, tiles_leased): (MemberEntry, usize)) -> wire::WorkerEntry {
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

pub(super) fn to_explanation(
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

/// What the farm has to do and to keep for an account.
pub(super) fn ordered(shell: &Shell, account: &str) -> Ordered {
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
pub(super) fn to_be_ordered(order: &Order) -> Ordered {
    let size = order.grid.window().size();
    let bytes = order.prepared.as_ref().len() as u64 + Picture::byte_count(size, order.format);
    Ordered { jobs: 1, pixels: size.pixel_count(), bytes }
}

pub(super) fn to_request(order: wire::Order) -> Result<RenderRequest, WireError> {
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
