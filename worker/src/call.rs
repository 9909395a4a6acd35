//! What a worker asks of its coordinator, and what comes back.

use std::{sync::Arc, time::Duration};

use rtfarm_core::{render::Tally, tile::TileId};
use rtfarm_proto::{Bytes, FarmId, Incarnation, JobId, LONGEST_WAIT, LeaseName, Renewal, WorkerId};

use crate::job::Job;

/// Who a worker is, and on which start of the coordinator.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Membership {
    pub(crate) worker: WorkerId,
    pub(crate) incarnation: Incarnation,
}

/// A question to the coordinator. Each may be repeated safely.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Call {
    /// Reaches the coordinator; everything else needs this first.
    Connect,
    /// Makes this process a member.
    Join,
    /// Asks for tiles, first of all for those that are `kept`; the answer may take as long as
    /// `wait`.
    Lease { member: Membership, most_tiles: usize, wait: Duration, kept: Option<KeptTiles> },
    /// Proves progress under leases.
    Renew { member: Membership, renewals: Vec<Renewal> },
    /// Brings tiles.
    Deliver { member: Membership, tiles: Vec<Delivery> },
    /// Gives every lease back.
    Leave { member: Membership, reason: String },
}

/// Tiles of a job whose pixels this worker has, for an earlier start of the coordinator.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct KeptTiles {
    pub(crate) job: JobId,
    pub(crate) tiles: Vec<TileId>,
}

/// What the coordinator answers to a [`Call`].
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Answer {
    /// To [`Call::Connect`].
    Connected,
    /// To [`Call::Join`]: who the worker is now, and how long a lease lives without progress.
    Joined { member: Membership, farm: FarmId, term: Duration },
    /// To [`Call::Lease`].
    Leased(Next),
    /// To [`Call::Renew`]: the leases among those that this worker has lost.
    Renewed { lost: Vec<LeaseName> },
    /// To [`Call::Deliver`]: the coordinator keeps these pixels or has no use for them.
    Delivered,
    /// To [`Call::Leave`].
    Left,
}

/// What a worker without enough tiles gets.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Next {
    Run(Run),
    Nothing,
    ShutDown,
}

/// Tiles to be rendered, in this order, under one lease.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Run {
    pub(crate) lease: LeaseName,
    pub(crate) tiles: Vec<TileId>,
    pub(crate) job: Arc<Job>,
}

/// A rendered tile, ready to be sent. A clone shares the pixels.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Delivery {
    pub(crate) lease: LeaseName,
    pub(crate) tile: TileId,
    /// Red, green and blue as little-endian f32, row by row.
    pub(crate) pixels: Bytes,
    /// What the job's `TileHasher` makes of them.
    pub(crate) hash: [u8; 32],
    pub(crate) tally: Tally,
    /// What the tile took one thread.
    pub(crate) seconds: f64,
}

/// Why a call has no answer.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct CallError {
    pub(crate) kind: CallErrorKind,
    pub(crate) message: String,
}

/// What a failed call says about the coordinator.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum CallErrorKind {
    /// It did not answer, or its answer was lost: whether it has done what was asked is unknown.
    NoAnswer,
    /// It does not know this worker.
    NotMember,
    /// It does not want this worker.
    Refused,
    /// This worker's token does not allow it.
    Forbidden,
    /// Its answer cannot be understood.
    Nonsense,
    /// It has another reason.
    Other,
}

/// The longest that a short question may wait for its answer.
const DEADLINE: Duration = Duration::from_secs(15);

/// The longest that tiles may wait to be acknowledged: a disk may be slow.
const DELIVERY: Duration = Duration::from_secs(30);

/// The longest that a worker that leaves waits to be heard.
const FAREWELL: Duration = Duration::from_secs(1);

impl Call {
    /// How long the answer may take.
    pub(crate) fn deadline(&self) -> Duration {
        match self {
            Self::Connect | Self::Join | Self::Renew { .. } => DEADLINE,
            Self::Lease { .. } => LONGEST_WAIT + DEADLINE,
            Self::Deliver { .. } => DELIVERY,
            Self::Leave { .. } => FAREWELL,
        }
    }
}
