//! Who a farm is, and how it knows calls that are meant for another.

use rtfarm_proto::{FarmId, Incarnation, JobId};

/// Jobs that an incarnation numbers before it may come near another's numbers.
const JOB_BITS: u32 = 24;

/// What tells this start of this farm from every other.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Identity {
    pub(crate) farm: FarmId,
    pub(crate) incarnation: Incarnation,
}

/// A call that is not meant for this incarnation of the farm, or was never told which it is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("this call is not meant for this start of the coordinator; join or submit again")]
pub(crate) struct Stranger;

impl Identity {
    /// Makes an identity of 24 random bytes.
    pub(crate) fn from_random(bytes: [u8; 24]) -> Self {
        let (farm, incarnation) = bytes.split_at(16);
        let farm = FarmId(farm.try_into().expect("16 bytes"));
        let incarnation = u64::from_le_bytes(incarnation.try_into().expect("8 bytes"));
        // A call without an incarnation carries 0.
        Self { farm, incarnation: Incarnation(incarnation.max(1)) }
    }

    /// The number below this incarnation's first job. Jobs of two incarnations have different
    /// numbers unless 40 random bits agree.
    pub(crate) fn job_before_first(self) -> JobId {
        JobId(self.incarnation.0 << JOB_BITS)
    }
}
