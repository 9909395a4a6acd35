//! `rtfarm coordinator`: a farm that stays up.

use std::{
    env, fs,
    io::{self, Write},
    net::SocketAddr,
    os::unix::fs::MetadataExt,
    path::PathBuf,
    time::Duration,
};

use anyhow::{Context, anyhow};
use rtfarm_coordinator::{
    Config, Coordinator, Durability, Holder, Keeping, Listener, Owner, Role, Security,
    SecurityError, StateError, StateFolder, renew_token, revoke_token,
};
use rtfarm_core::isa::Isa;
use rtfarm_proto::Address;
use tokio::{
    net::{UnixListener, lookup_host},
    task::spawn_blocking,
};
use tokio_util::sync::CancellationToken;

use crate::{
    BUILD, VERSION,
    args::{CertsArgs, CoordinatorArgs, TokenChange, TokensArgs},
    console::Console,
    failure::Failure,
    output::folder_of,
    private_folder::PrivateFolder,
};

/// A client that sends nothing of its scene for this long is given up.
pub(crate) const UPLOAD_SILENCE: Duration = Duration::from_secs(30);

pub(crate) async fn run(
    args: CoordinatorArgs,
    console: &Console,
    stop: &CancellationToken,
    terminate: &CancellationToken,
) -> Result<(), Failure> {
    let place = Place::find(&args).await?;
    let state = match args.state.clone() {
        Some(path) => Some(open_state(path, args.durable).await?),
        None => None,
    };
    let private = args.state.is_none().then(|| PrivateFolder::new(&env::temp_dir())).transpose()?;
    let folder = private.as_ref().map(PrivateFolder::path).or(args.state.as_deref());
    let folder = folder.expect("one of them is there").to_owned();
    let (listener, address) = place.listen(&args)?;
    console
        .answer(&format!("listening on {address}"))
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
        upload_silence: args.upload_seconds,
        events: args.events.clone(),
        begins_coarsely: false,
        host: Some(args.name.clone().unwrap_or_else(own_name)),
        orders: args.orders(),
        scene_folder: folder.clone(),
        picture_folder: folder,
    };
    let coordinator = match state {
        Some(state) => Coordinator::with_state(config, state),
        None => Coordinator::new(config),
    };
    let coordinator = coordinator.with_context(|| match &args.events {
        Some(path) => format!("cannot start with events in {}", path.display()),
        None => "cannot start".to_owned(),
    })?;
    coordinator.run(listener, stop.cancelled()).await?;
    if terminate.is_cancelled() { Ok(()) } else { Err(Failure::Interrupted) }
}

/// Where a coordinator may listen.
enum Place {
    /// In a folder that is nobody else's.
    Unix(PathBuf),
    Tcp(SocketAddr),
}

impl Place {
    /// Finds out where to listen, and refuses what others could use who should not.
    async fn find(args: &CoordinatorArgs) -> Result<Self, Failure> {
        let listen = &args.listen;
        if let Ok(Address::Unix(socket)) = listen.parse() {
            let folder = folder_of(&socket);
            let metadata = fs::metadata(&folder)
                .with_context(|| format!("cannot listen in {}", folder.display()))?;
            let is_ours = metadata.uid() == rustix::process::geteuid().as_raw();
            if !is_ours || metadata.mode() & 0o077 != 0 {
                return Err(Failure::Input(anyhow!(
                    "others may enter {folder}; a socket needs a folder that is yours alone, with \
                     mode 0700",
                    folder = folder.display()
                )));
            }
            return Ok(Self::Unix(socket));
        }
        let mut addresses = lookup_host(listen).await.map_err(|error| {
            Failure::Input(anyhow!("`{listen}` is no address to listen on: {error}"))
        })?;
        let address = addresses.next().with_context(|| format!("`{listen}` has no address"))?;
        if args.state.is_none() && !args.insecure {
            return Err(Failure::Input(anyhow!(
                "{address} is open to others: --state DIR keeps certificates and tokens for those who \
                 may come, --listen unix:/folder/socket is for this user alone, and --insecure asks \
                 nobody for anything"
            )));
        }
        Ok(Self::Tcp(address))
    }

    /// Listens; answers also with the address for others.
    fn listen(self, args: &CoordinatorArgs) -> Result<(Listener, Address), Failure> {
        let address = match self {
            Self::Tcp(address) => address,
            Self::Unix(socket) => {
                let in_place = || format!("cannot listen on {}", socket.display());
                // What a killed coordinator left; one that lives is not there, with its state.
                if std::os::unix::net::UnixStream::connect(&socket).is_err() {
                    let _ = fs::remove_file(&socket);
                }
                let listener = UnixListener::bind(&socket).with_context(in_place)?;
                return Ok((Listener::Unix(listener), Address::Unix(socket)));
            }
        };
        let listener = rtfarm_coordinator::listen(address)
            .with_context(|| format!("cannot listen on {address}"))?;
        let address = listener.local_addr()?;
        let Some(state) = args.state.as_deref().filter(|_| !args.insecure) else {
            tracing::warn!("nothing is encrypted, and whoever reaches {address} may use the farm");
            return Ok((Listener::Tcp(listener), Address::Tcp(address.to_string())));
        };
        let host = match &args.name {
            Some(name) => name.clone(),
            None if address.ip().is_unspecified() => own_name(),
            None if address.is_ipv6() => format!("[{}]", address.ip()),
            None => address.ip().to_string(),
        };
        let shown = tls_address(&host, address.port())?;
        let security = Security::open(state, &shown).map_err(anyhow::Error::from)?;
        tracing::info!(folder = %state.join("access").display(), "access files are there");
        Ok((Listener::Tls(listener, security, args.limits()), shown))
    }
}

/// The address that others have of a coordinator.
fn tls_address(host: &str, port: u16) -> Result<Address, Failure> {
    let address = format!("https://{host}:{port}").parse().map_err(anyhow::Error::from);
    address.map_err(Failure::Input)
}

/// What this machine calls itself.
fn own_name() -> String {
    rustix::system::uname().nodename().to_string_lossy().into_owned()
}

/// `rtfarm certs`.
pub(crate) fn make_certificates(args: &CertsArgs) -> Result<(), Failure> {
    let CertsArgs { state, name, port } = args;
    let address = tls_address(name, *port)?;
    fs::create_dir_all(state).with_context(|| format!("cannot make {}", state.display()))?;
    Security::open(state, &address).map_err(anyhow::Error::from)?;
    writeln!(io::stdout().lock(), "{}", state.join("access").display())
        .context("cannot write to standard output")?;
    Ok(())
}

/// `rtfarm tokens`.
pub(crate) fn change_tokens(args: &TokensArgs) -> Result<(), Failure> {
    let TokensArgs { change, role, owner, state } = args;
    let holder =
        Holder::new(*role, owner.clone()).map_err(|reason| Failure::Input(anyhow!(reason)))?;
    let told = match change {
        TokenChange::Renew => {
            let path = renew_token(state, &holder).map_err(cannot_change)?;
            path.display().to_string()
        }
        TokenChange::Revoke => {
            let others = revoke_token(state, &holder).map_err(cannot_change)?;
            match owner {
                Some(owner) => format!("{owner} has no token to {role} any more"),
                None if *role == Role::Submit && !others.is_empty() => {
                    let others: Vec<String> = others.iter().map(Owner::to_string).collect();
                    let others = others.join(", ");
                    format!("the token to submit is void; owners' own are good as before: {others}")
                }
                None => format!("nobody has the token to {role} any more"),
            }
        }
    };
    writeln!(io::stdout().lock(), "{told}").context("cannot write to standard output")?;
    Ok(())
}

/// Why tokens stay as they are.
fn cannot_change(error: SecurityError) -> Failure {
    match error {
        SecurityError::None(_) | SecurityError::NoToken { .. } | SecurityError::Damaged(_) => {
            Failure::Input(error.into())
        }
        SecurityError::Io(..) | SecurityError::Certificate(_) => Failure::Other(error.into()),
    }
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
