//! `rtfarm worker`: renders for a coordinator.

use std::time::Duration;

use rtfarm_worker::{Config, die_with_parent};
use tokio_util::sync::CancellationToken;

use crate::{BUILD, args::WorkerArgs, failure::Failure};

/// A local worker dies with its coordinator, and waits for one that is merely suspended.
const LOCAL_PATIENCE: Duration = Duration::from_secs(24 * 3600);

pub(crate) async fn run(
    args: WorkerArgs,
    stop: &CancellationToken,
    terminate: &CancellationToken,
) -> Result<(), Failure> {
    if let Some(parent) = args.parent {
        die_with_parent(parent)?;
    }
    let is_local = args.parent.is_some();
    let config = Config {
        threads: args.threads(),
        isa: args.isa.0,
        memory: args.memory(),
        patience: if is_local { LOCAL_PATIENCE } else { args.patience },
        coordinator: args.coordinator.access().map_err(Failure::Input)?,
        version: args.claim_version,
        build: BUILD.to_owned(),
        reference: (!is_local).then(|| rtfarm_worker::reference(args.isa.0)),
    };
    let grace = args.grace;
    let shutdown = async {
        stop.cancelled().await;
        // A local worker's tiles are of no use to a parent that ends it.
        if terminate.is_cancelled() && !is_local { grace } else { Duration::ZERO }
    };
    rtfarm_worker::run(config, shutdown).await?;
    // A local worker is stopped by its parent, which tells the user.
    let is_interrupted = stop.is_cancelled() && !terminate.is_cancelled() && !is_local;
    if is_interrupted { Err(Failure::Interrupted) } else { Ok(()) }
}
