//! `rtfarm worker`: renders for a coordinator.

use std::time::Duration;

use rtfarm_worker::{Config, die_with_parent};
use tokio_util::sync::CancellationToken;

use crate::{args::WorkerArgs, failure::Failure};

/// A local worker needs no more patience: its coordinator is there or dead.
const LOCAL_PATIENCE: Duration = Duration::from_secs(2);

pub(crate) async fn run(args: WorkerArgs, stop: &CancellationToken) -> Result<(), Failure> {
    if let Some(parent) = args.parent {
        die_with_parent(parent)?;
    }
    let is_local = args.parent.is_some();
    let config = Config {
        threads: args.threads(),
        isa: args.isa.0,
        patience: if is_local { LOCAL_PATIENCE } else { args.patience },
        coordinator: args.coordinator,
        version: args.claim_version,
    };
    rtfarm_worker::run(config, stop.cancelled()).await?;
    // A local worker is stopped by its parent, which tells the user.
    if stop.is_cancelled() && !is_local { Err(Failure::Interrupted) } else { Ok(()) }
}
