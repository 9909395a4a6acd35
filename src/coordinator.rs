//! `rtfarm coordinator`: a farm that stays up.

use std::{
    env,
    io::{self, Write},
    path::PathBuf,
    time::Duration,
};

use anyhow::{Context, anyhow};
use rtfarm_coordinator::{
    Config, Coordinator, Durability, Keeping, Listener, StateError, StateFolder,
};
use rtfarm_core::isa::Isa;
use tokio::{net::lookup_host, task::spawn_blocking};
use tokio_util::sync::CancellationToken;

use crate::{
    BUILD, VERSION, args::CoordinatorArgs, failure::Failure, private_folder::PrivateFolder,
};

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
    let state = match args.state.clone() {
        Some(path) => Some(open_state(path, args.durable).await?),
        None => None,
    };
    let private = args.state.is_none().then(|| PrivateFolder::new(&env::temp_dir())).transpose()?;
    let folder = private.as_ref().map(PrivateFolder::path).or(args.state.as_deref());
    let folder = folder.expect("one of them is there").to_owned();
    let listener = rtfarm_coordinator::listen(address)
        .with_context(|| format!("cannot listen on {address}"))?;
    writeln!(io::stdout().lock(), "listening on http://{}", listener.local_addr()?)
        .context("cannot write to standard output")?;

    let config = Config {
        version: VERSION.to_owned(),
        build: BUILD.to_owned(),
        reference: Some(rtfarm_worker::reference(Isa::fastest())),
        term: args.lease_seconds,
        audit: args.audit,
        keeping: Keeping {
            time: Duration::from_secs(u64::from(args.keep_hours) * 3600),
            byte_count: u64::from(args.keep_gb) * 1_000_000_000,
        },
        upload_silence: UPLOAD_SILENCE,
        scene_folder: folder.clone(),
        picture_folder: folder,
    };
    let coordinator = match state {
        Some(state) => Coordinator::with_state(config, state)?,
        None => Coordinator::new(config)?,
    };
    coordinator.run(Listener::Tcp(listener), stop.cancelled()).await?;
    if terminate.is_cancelled() { Ok(()) } else { Err(Failure::Interrupted) }
}

/// Opens the state in a folder, which reads the pictures under way there.
async fn open_state(path: PathBuf, is_durable: bool) -> Result<StateFolder, Failure> {
    let durability = if is_durable { Durability::Tile } else { Durability::Second };
    let build = format!("{VERSION} ({BUILD})");
    let opened = spawn_blocking(move || StateFolder::open(&path, &build, durability)).await?;
    opened.map_err(|error| match error {
        StateError::Foreign(_) => Failure::Input(error.into()),
        _ => Failure::Other(error.into()),
    })
}
