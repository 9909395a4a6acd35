//! A local worker lives no longer than the process that started it.

use rustix::process::{Pid, Signal, getppid, set_parent_process_death_signal};

/// Why a worker cannot be tied to its parent.
#[derive(Debug, thiserror::Error)]
pub enum ParentError {
    /// That process has ended, or did not start this one.
    #[error("the process {0} that started this worker is gone")]
    Gone(u32),
    /// The system refuses.
    #[error("cannot tie this worker's life to the process that started it: {0}")]
    System(#[from] rustix::io::Errno),
}

/// Has this process killed when the process `parent`, which must have started it, ends.
pub fn die_with_parent(parent: u32) -> Result<(), ParentError> {
    set_parent_process_death_signal(Some(Signal::KILL))?;
    // It may have ended before the line above.
    match getppid().map(Pid::as_raw_nonzero) {
        Some(now) if now.get().unsigned_abs() == parent => Ok(()),
        _ => Err(ParentError::Gone(parent)),
    }
}
