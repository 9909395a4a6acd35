//! Calls over gRPC: a question goes out as a wire message, its answer comes back parsed. What a
//! `Status` says of the coordinator is read here and nowhere else.

use std::{sync::Arc, time::Duration};

use rtfarm_proto::{
    Connection, FarmId, Incarnation, LeaseName, MESSAGE_BYTES, PROTOCOL, WireError, WorkerId,
    wire::{self, farm_client::FarmClient, lease_response},
};
use tonic::{Code, Status};

use crate::{
    call::{Answer, Call, CallError, CallErrorKind, Delivery, KeptTiles, Membership, Next, Run},
    config::Config,
    job::{Job, JobError},
};

/// Speaks over a connection.
pub(crate) fn over<C: Connection>(connection: C) -> FarmClient<C> {
    FarmClient::new(connection)
        .max_decoding_message_size(MESSAGE_BYTES)
        .max_encoding_message_size(MESSAGE_BYTES)
}

/// What this process says of itself when it joins. `nonce` tells its repeated question from
/// another process.
pub(crate) fn introduction(config: &Config, nonce: u64) -> wire::JoinRequest {
    wire::JoinRequest {
        version: config.version.clone(),
        protocol: PROTOCOL,
        nonce,
        threads: u32::try_from(config.threads).unwrap_or(u32::MAX),
        isa: config.isa.to_string(),
        host: rustix::system::uname().nodename().to_string_lossy().into_owned(),
        process: std::process::id(),
        build: config.build.clone(),
        reference: config.reference.map(|hash| hash.to_vec().into()).unwrap_or_default(),
        memory: config.memory.unwrap_or(0),
    }
}

/// Makes a call on a connection, once.
pub(crate) async fn ask<C: Connection>(
    mut client: FarmClient<C>,
    introduction: Arc<wire::JoinRequest>,
    call: Call,
) -> Result<Answer, CallError> {
    match call {
        Call::Connect => Ok(Answer::Connected),
        Call::Join => {
            let joined = client.join(wire::JoinRequest::clone(&introduction)).await?.into_inner();
            let term = Duration::from_millis(joined.term_ms.into());
            let member = Membership {
                worker: WorkerId(joined.worker),
                incarnation: Incarnation(joined.incarnation),
            };
            let farm = joined.farm.as_ref().try_into().map(FarmId);
            let farm = farm.map_err(|_| JobError::from(WireError::Missing("farm")))?;
            Ok(Answer::Joined { member, farm, term })
        }
        Call::Lease { member, most_tiles, wait, kept } => {
            let request = wire::LeaseRequest {
                worker: member.worker.0,
                incarnation: member.incarnation.0,
                max_tiles: u32::try_from(most_tiles).unwrap_or(u32::MAX),
                wait_ms: u32::try_from(wait.as_millis()).unwrap_or(u32::MAX),
                kept: kept.map(|KeptTiles { job, tiles }| wire::KeptTiles {
                    job: job.0,
                    tiles: tiles.iter().map(|tile| tile.number()).collect(),
                }),
            };
            let answer = client.lease(request).await?.into_inner();
            Ok(Answer::Leased(read_next(answer, member.incarnation)?))
        }
        Call::Renew { member, renewals } => {
            let request = wire::RenewRequest {
                worker: member.worker.0,
                incarnation: member.incarnation.0,
                renewals: renewals.into_iter().map(Into::into).collect(),
            };
            let renewed = client.renew(request).await?;
            let lost = renewed.into_inner().lost.into_iter().map(Into::into).collect();
            Ok(Answer::Renewed { lost })
        }
        Call::Deliver { member, tiles } => {
            let request = wire::DeliverRequest {
                worker: member.worker.0,
                incarnation: member.incarnation.0,
                tiles: tiles.into_iter().map(write_tile).collect(),
            };
            let delivered = client.deliver(request).await?.into_inner();
            tracing::debug!(verdicts = ?delivered.verdicts, "delivered");
            Ok(Answer::Delivered)
        }
        Call::Leave { member, reason } => {
            let (worker, incarnation) = (member.worker.0, member.incarnation.0);
            client.leave(wire::LeaveRequest { worker, reason, incarnation }).await?;
            Ok(Answer::Left)
        }
    }
}

fn write_tile(tile: Delivery) -> wire::FinishedTile {
    let Delivery { lease, tile, pixels, hash, tally, seconds } = tile;
    wire::FinishedTile {
        lease: Some(lease.into()),
        tile: tile.number(),
        pixels,
        hash: hash.to_vec().into(),
        seconds,
        tally: Some(tally.into()),
    }
}

fn read_next(answer: wire::LeaseResponse, incarnation: Incarnation) -> Result<Next, JobError> {
    match answer.next {
        Some(lease_response::Next::Run(run)) => read_run(run, incarnation).map(Next::Run),
        Some(lease_response::Next::ShutDown(_)) => Ok(Next::ShutDown),
        Some(lease_response::Next::Nothing(_)) | None => Ok(Next::Nothing),
    }
}

fn read_run(run: wire::Run, incarnation: Incarnation) -> Result<Run, JobError> {
    let lease = LeaseName::from(run.lease.ok_or(WireError::Missing("lease"))?);
    let job = Job::new(lease.job, &run.job.ok_or(WireError::Missing("job"))?, incarnation)?;
    let tile = |&number| job.grid.tile(number).ok_or(WireError::Missing("tile"));
    let tiles = run.tiles.iter().map(tile).collect::<Result<_, _>>()?;
    Ok(Run { lease, tiles, job: Arc::new(job) })
}

impl From<JobError> for CallError {
    fn from(error: JobError) -> Self {
        Self { kind: CallErrorKind::Nonsense, message: error.to_string() }
    }
}

impl From<Status> for CallError {
    fn from(status: Status) -> Self {
        let kind = match status.code() {
            Code::Unavailable
            | Code::DeadlineExceeded
            | Code::Unknown
            | Code::Cancelled
            | Code::DataLoss => CallErrorKind::NoAnswer,
            Code::NotFound => CallErrorKind::NotMember,
            Code::Unauthenticated | Code::PermissionDenied => CallErrorKind::Forbidden,
            Code::FailedPrecondition | Code::InvalidArgument => CallErrorKind::Refused,
            _ => CallErrorKind::Other,
        };
        Self { kind, message: status.message().to_owned() }
    }
}
