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
    let config = Config {
        threads: args.threads(),
        isa: args.isa.0,
        patience: if args.parent.is_some() { LOCAL_PATIENCE } else { args.patience },
        coordinator: args.coordinator,
        version: args.claim_version,
    };
    rtfarm_worker::run(config, stop.cancelled()).await?;
    if stop.is_cancelled() { Err(Failure::Interrupted) } else { Ok(()) }
}
