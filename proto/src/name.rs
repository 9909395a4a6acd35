//! What is numbered: workers, jobs, leases.

use std::fmt;

use crate::wire;

/// A member of the farm, from joining to leaving. Numbers are never given twice.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct WorkerId(pub u32);

/// A picture being rendered. Numbers are never given twice.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct JobId(pub u64);

/// A lease among all of a coordinator's life. Numbers are never given twice.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Epoch(pub u64);

/// A lease and the job whose tiles it is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct LeaseName {
    /// The job.
    pub job: JobId,
    /// Which of its leases.
    pub epoch: Epoch,
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
        Self { job: JobId(name.job), epoch: Epoch(name.epoch) }
    }
}

impl From<LeaseName> for wire::LeaseName {
    fn from(name: LeaseName) -> Self {
        Self { job: name.job.0, epoch: name.epoch.0 }
    }
}
