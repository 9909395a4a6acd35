//! The numbers of farms, workers, jobs and leases.

use std::fmt;

use crate::{WireError, wire};

/// A farm: random, so that no two have the same.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FarmId(pub [u8; 16]);

/// One start of a farm's coordinator: random, so that calls meant for an earlier start are known.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Incarnation(pub u64);

/// A member of the farm, from joining to leaving. An incarnation never gives a number
/// twice.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct WorkerId(pub u32);

/// A job: a picture that somebody ordered. Numbers are never given twice, whichever coordinator
/// gives them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct JobId(pub u64);

/// A lease, numbered over all jobs of an incarnation, which never gives a number twice.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct LeaseId(pub u64);

/// Names a lease and the job whose tiles it covers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct LeaseName {
    /// The job.
    pub job: JobId,
    /// The lease.
    pub id: LeaseId,
}

/// How far the work under a lease is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Renewal {
    /// The lease.
    pub lease: LeaseName,
    /// Steps that brought its scene, since it began.
    pub work: u64,
    /// The numbers of its tiles that were begun and not delivered, and the steps made for each.
    pub tiles: Vec<(u32, u64)>,
}

impl fmt::Display for FarmId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:032x}", u128::from_be_bytes(self.0))
    }
}

impl fmt::Display for WorkerId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

impl fmt::Display for JobId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

impl From<wire::LeaseName> for LeaseName {
    fn from(name: wire::LeaseName) -> Self {
        Self { job: JobId(name.job), id: LeaseId(name.id) }
    }
}

impl TryFrom<wire::Renewal> for Renewal {
    type Error = WireError;

    fn try_from(renewal: wire::Renewal) -> Result<Self, WireError> {
        let lease = renewal.lease.ok_or(WireError::Missing("lease"))?.into();
        let tiles = renewal.tiles.into_iter().map(|wire::TileWork { tile, work }| (tile, work));
        Ok(Self { lease, work: renewal.work, tiles: tiles.collect() })
    }
}

impl From<Renewal> for wire::Renewal {
    fn from(renewal: Renewal) -> Self {
        let tiles = renewal.tiles.into_iter().map(|(tile, work)| wire::TileWork { tile, work });
        Self { lease: Some(renewal.lease.into()), work: renewal.work, tiles: tiles.collect() }
    }
}

impl From<LeaseName> for wire::LeaseName {
    fn from(name: LeaseName) -> Self {
        Self { job: name.job.0, id: name.id.0 }
    }
}
