//! What comes to a farm with a tile, and what it has its shell do.

use std::{collections::BTreeMap, time::Duration};

use rtfarm_core::{render::Tally, tile::TileId};
use rtfarm_job::Progress;
use rtfarm_proto::{JobId, LeaseName, WorkerId};

use super::{Change, Terms};
use crate::{
    lease::{Loss, Run},
    members::{Mark, NoMember, Process, Standing},
    tiles::{PixelHash, Rendering},
    waiting::AskId,
};

/// Pixels that came. The shell numbers them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(crate) struct DeliveryId(pub(crate) u64);

/// What came with the pixels of a tile.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Delivery {
    pub(crate) worker: WorkerId,
    pub(crate) lease: LeaseName,
    pub(crate) tile: TileId,
    pub(crate) hash: PixelHash,
    /// Time on one thread.
    pub(crate) seconds: f64,
    pub(crate) tally: Tally,
}

/// The answer to a question for tiles.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Next {
    /// Render these tiles.
    Render(Run),
    /// There was nothing to do for as long as the worker would wait.
    Nothing,
    /// There will be nothing to do any more.
    GoHome,
}

/// The answer to a delivery.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Verdict {
    /// The pixels are in the picture.
    Accepted,
    /// Earlier pixels of the tile are in the picture.
    Duplicate,
    /// The job is over, or the worker was never to render the tile.
    Rejected,
}

/// What the shell is to do, in this order.
#[derive(Debug)]
pub(crate) enum Action {
    /// Answer a question for tiles.
    Answer(AskId, Result<Next, NoMember>),
    /// Write the pixels of a delivery into the picture of a job, then report
    /// [`Farm::on_stored`](super::Farm::on_stored) or
    /// [`Farm::on_store_failed`](super::Farm::on_store_failed).
    Store(DeliveryId, JobId, TileId),
    /// Answer a delivery.
    Acknowledge(DeliveryId, Verdict),
    /// Keep that a job has not ended, whatever was kept of its end.
    Reopen(JobId),
    /// Keep the terms of a job.
    Keep(JobId, Terms),
    /// Keep what is remembered of processes.
    KeepMarks(BTreeMap<u64, Mark>),
    /// Forget what is kept of tiles that are not in the picture any more.
    TakeBack(JobId, Vec<TileId>),
    /// Show those who watch a job how far it is.
    Publish(JobId, Progress),
    /// Drop a job's scene and picture.
    Forget(JobId),
    /// Write a line into the log.
    Log(Notice),
    /// Close the connections: everybody has gone home, or had the time to.
    Stop,
}

/// What a log line says.
#[derive(Debug)]
pub(crate) enum Notice {
    /// A worker is new on the farm.
    Joined(WorkerId, Process),
    /// A worker without leases is gone, for that reason.
    Gone(WorkerId, String),
    /// A lease is lost, or tiles of it, for that reason.
    LeaseLost(Loss, String),
    /// A tile is rendered no more: too many workers were lost with it in work.
    SetAside(JobId, TileId),
    /// A tile is in the picture, as the last of those in `progress`, so long after the job's
    /// start.
    TileDone { delivery: Delivery, progress: Progress, elapsed: Duration },
    /// A further copy of a tile has another hash than what is in the picture.
    CopiesDiffer { second: Delivery, first: Rendering },
    /// A worker brought pixels of a tile that two others contradict, and is kept out from now on.
    Liar { worker: WorkerId, job: JobId, tile: TileId },
    /// Tiles of a liar are taken out of a picture, to be rendered again.
    TakenBack { worker: WorkerId, job: JobId, tiles: Vec<TileId> },
    /// Nobody is there to render tiles again and compare. It is said once.
    NoAudit,
    /// A tile is not compared any more: workers were lost with it too often.
    NotCompared(JobId, TileId),
    /// A job failed, for that reason.
    JobFailed(JobId, String),
    /// A job waits for a worker that can hold its scene.
    NoRoom(JobId, String),
    /// A client cancelled a job.
    JobCancelled(JobId),
    /// A job is forgotten, since there is no room or no time for it any more.
    JobExpired(JobId),
    /// Somebody changed a job.
    JobChanged(JobId, Change),
    /// Somebody decided what a worker gets.
    Stationed(WorkerId, Standing),
    /// Pixels came of a tile that their worker was never to render under that lease, as the last of
    /// so many.
    NotGranted { worker: WorkerId, lease: LeaseName, tile: TileId, count: u64 },
    /// A worker brought pixels that make no sense, for that reason.
    Suspect { worker: WorkerId, job: JobId, tile: TileId, reason: String },
    /// So many calls were refused, since they were meant for another incarnation.
    Strangers(u64),
}
