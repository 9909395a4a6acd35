//! `rtfarm coordinator`: a farm that stays up.

use std::{
    env,
    io::{self, Write},
    time::Duration,
};

use anyhow::{Context, anyhow};
use rtfarm_coordinator::{Config, Coordinator, Listener};
use tokio::net::lookup_host;
use tokio_util::sync::CancellationToken;

use crate::{VERSION, args::CoordinatorArgs, failure::Failure, private_folder::PrivateFolder};

/// A client that sends nothing of its scene for this long is given up.
pub(crate) const UPLOAD_SILENCE: Duration = Duration::from_secs(30);

pub(crate) async fn run(
    args: CoordinatorArgs,
    stop: &CancellationToken,
    terminate: &CancellationToken,
) -> Result<(), Failure> {
    let listen = &args.listen;
    let mut addresses = lookup_host(listen).await.map_err(|error| {
        Failure::Input(anyhow!("`{listen}` is no address to listen on: {error}"))
    })?;
    let address = addresses.next().with_context(|| format!("`{listen}` has no address"))?;
    if !address.ip().is_loopback() && !args.insecure {
        return Err(Failure::Input(anyhow!(
            "{address} is open to other machines, and TLS and tokens are still to come; \
             --insecure listens there all the same"
        )));
    }
    let folder = PrivateFolder::new(&args.state.unwrap_or_else(env::temp_dir))?;
    let listener = rtfarm_coordinator::listen(address)
        .with_context(|| format!("cannot listen on {address}"))?;
    writeln!(io::stdout().lock(), "listening on http://{}", listener.local_addr()?)
        .context("cannot write to standard output")?;

    let coordinator = Coordinator::new(Config {
        version: VERSION.to_owned(),
        term: args.lease_seconds,
        upload_silence: UPLOAD_SILENCE,
        scene_folder: folder.path().to_owned(),
        picture_folder: folder.path().to_owned(),
    })?;
    coordinator.run(Listener::Tcp(listener), stop.cancelled()).await?;
    if terminate.is_cancelled() { Ok(()) } else { Err(Failure::Interrupted) }
}
