//! What workers call.

use std::{io, sync::Arc, time::Duration};

use rtfarm_core::{render::Tally, tile::Crop};
use rtfarm_picture::TilePixels;
use rtfarm_proto::{
    JobId, LONGEST_WAIT, LeaseName, Renewal, WireError, WorkerId, scene_hash,
    wire::{self, farm_server, lease_response},
};
use tokio::sync::oneshot;
use tonic::{Request, Response, Status};

use super::{
    blocking, broken, check_version, invalid, no_member, stranger,
    streaming::{Chunks, stream_file},
};
use crate::{
    accept::Peer,
    farm::{Delivery, Next, Verdict},
    job::Job,
    lease::Run,
    members::Process,
    shell::{Config, Shell},
    tiles::PixelHash,
};

pub(crate) struct FarmService {
    pub(super) shell: Arc<Shell>,
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
pub(super) type Taken = (Vec<usize>, oneshot::Receiver<Vec<Verdict>>);

/// Reads tiles and hands on those that there are and whose pixels make sense. `None` when none
/// does. This hashes and writes: never call it on the async runtime.
pub(super) fn take(
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

pub(super) fn to_verdict(verdict: Verdict) -> wire::Verdict {
    match verdict {
        Verdict::Accepted => wire::Verdict::Accepted,
        Verdict::Duplicate => wire::Verdict::Duplicate,
        Verdict::Rejected => wire::Verdict::Rejected,
    }
}

/// Tells a worker all about its tiles; one on this machine also where the scene is.
pub(super) fn to_run(run: &Run, job: &Job, is_local: bool) -> wire::Run {
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

/// Refuses a worker whose pixels would be others than the coordinator's workers' should be.
pub(super) fn check_pixels_of(request: &wire::JoinRequest, shell: &Shell) -> Result<(), Status> {
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
