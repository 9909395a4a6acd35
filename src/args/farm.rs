//! The words of those who run a farm.

use std::{fs, os::unix::fs::MetadataExt, path::PathBuf, time::Duration};

use anyhow::{Context, ensure};
use clap::{Args as ClapArgs, ValueEnum};
use rtfarm_coordinator::{Limits, OrderLimits, Owner, Role};
use rtfarm_proto::{Access, Address};

use super::{
    FARM, LIMITS, TALK, WORK, core_count,
    values::{
        IsaChoice, LogFormat, parse_fraction, parse_gigabytes, parse_millions, parse_seconds,
        whole_number,
    },
};

#[derive(Debug, ClapArgs)]
pub(crate) struct CertsArgs {
    /// The folder of the farm's state, which is made if there is none; DIR/access has all.
    #[arg(long, value_name = "DIR", env = "RTFARM_STATE")]
    pub(crate) state: PathBuf,

    /// Where others will find the coordinator.
    #[arg(long, value_name = "HOST", env = "RTFARM_NAME")]
    pub(crate) name: String,

    /// The port that it will listen on.
    #[arg(long, value_name = "PORT", default_value = "7878")]
    pub(crate) port: u16,
}

#[derive(Debug, ClapArgs)]
pub(crate) struct TokensArgs {
    /// Renew makes a new token and access file, and the old one is not taken any more; revoke only
    /// that.
    #[arg(value_name = "renew|revoke")]
    pub(crate) change: TokenChange,

    /// The role whose token it is: submit, work, read or admin.
    #[arg(value_name = "ROLE")]
    pub(crate) role: Role,

    /// A token to submit of this owner's own, in DIR/access/submit.NAME.
    ///
    /// Jobs that are ordered by it are the owner's, and have a budget of their own: see `coordinator
    /// --most-jobs`. Renewing makes it when there is none.
    #[arg(long, value_name = "NAME")]
    pub(crate) owner: Option<Owner>,

    /// The folder of the farm's state.
    #[arg(long, value_name = "DIR", env = "RTFARM_STATE")]
    pub(crate) state: PathBuf,
}

/// What is done about a token.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum TokenChange {
    /// It gets a successor.
    Renew,
    /// It is not taken any more.
    Revoke,
}

#[derive(Debug, ClapArgs)]
pub(crate) struct CoordinatorArgs {
    /// The address and port to listen on, or `unix:/folder/socket`; port 0 takes a free one.
    #[arg(long, value_name = "ADDR:PORT", default_value = "127.0.0.1:7878", env = "RTFARM_LISTEN")]
    pub(crate) listen: String,

    /// Encrypt nothing and ask nobody for a token.
    #[arg(long, env = "RTFARM_INSECURE")]
    pub(crate) insecure: bool,

    /// Keep the farm's jobs and pictures in this folder, which is made if there is none: a
    /// coordinator that is started on it again goes on with them. Without it they end with the
    /// coordinator.
    ///
    /// DIR/access has the farm's certificates, and an access file for each role.
    #[arg(long, value_name = "DIR", env = "RTFARM_STATE")]
    pub(crate) state: Option<PathBuf>,

    /// Lose no finished tile in a power cut; otherwise those of the last second may be rendered
    /// again.
    #[arg(long, requires = "state", env = "RTFARM_DURABLE")]
    pub(crate) durable: bool,

    /// Append what happens to this file, a JSON object a line.
    #[arg(long, value_name = "FILE", env = "RTFARM_EVENTS", help_heading = TALK)]
    pub(crate) events: Option<PathBuf>,

    /// Where others find the coordinator, for the access files and the page; by default this
    /// machine's name, or the address that is listened on.
    #[arg(long, value_name = "HOST", env = "RTFARM_NAME", help_heading = LIMITS)]
    pub(crate) name: Option<String>,

    /// The longest that a TLS handshake may take.
    #[arg(long, value_name = "S", default_value = "5", value_parser = parse_seconds, env = "RTFARM_HANDSHAKE_SECONDS", help_heading = LIMITS)]
    handshake_seconds: Duration,

    /// Who connects must have shown a token after so long.
    #[arg(long, value_name = "S", default_value = "10", value_parser = parse_seconds, env = "RTFARM_GREETING_SECONDS", help_heading = LIMITS)]
    greeting_seconds: Duration,

    /// The most connections on which nobody has shown a token yet.
    #[arg(long, value_name = "N", default_value = "64", value_parser = whole_number::<u16>(1..=u16::MAX), env = "RTFARM_STRANGERS", help_heading = LIMITS)]
    strangers: u16,

    /// Who sends nothing of a scene or takes nothing of one or of a picture for this long is given
    /// up.
    #[arg(long, value_name = "S", default_value = "30", value_parser = parse_seconds, env = "RTFARM_UPLOAD_SECONDS", help_heading = LIMITS)]
    pub(crate) upload_seconds: Duration,

    /// The most bytes, in GB, that scenes have together which are being sent.
    #[arg(long, value_name = "GB", default_value = "8", value_parser = parse_gigabytes, env = "RTFARM_UPLOAD_GB", help_heading = LIMITS)]
    upload_gb: u64,

    /// The most bytes, in MB, of pixels, scenes and pictures that are in memory on their way here,
    /// and as many on their way elsewhere; what more there is waits.
    #[arg(long, value_name = "MB", default_value = "1000", value_parser = whole_number::<u32>(16..=u32::MAX), env = "RTFARM_FLIGHT_MB", help_heading = LIMITS)]
    flight_mb: u32,

    /// The most jobs that have not ended, of each owner of a token and of all others together; who
    /// has the token `admin` may order more, also of the next two.
    #[arg(long, value_name = "N", default_value = "1000", env = "RTFARM_MOST_JOBS", help_heading = LIMITS)]
    most_jobs: u64,

    /// The most pixels, in millions, of their pictures together.
    #[arg(long, value_name = "MILLIONS", default_value = "16384", value_parser = parse_millions, env = "RTFARM_MOST_MEGAPIXELS", help_heading = LIMITS)]
    most_megapixels: u64,

    /// The most bytes, in GB, that all their jobs have on disk.
    #[arg(long, value_name = "GB", default_value = "256", value_parser = parse_gigabytes, env = "RTFARM_MOST_GB", help_heading = LIMITS)]
    most_gb: u64,

    /// A worker that makes no progress for this long loses its tiles to others.
    #[arg(long, value_name = "S", default_value = "4", value_parser = parse_seconds, env = "RTFARM_LEASE_SECONDS", help_heading = WORK)]
    pub(crate) lease_seconds: Duration,

    /// How long a job that has ended is kept if nobody fetches its picture.
    #[arg(long, value_name = "HOURS", default_value = "168", value_parser = whole_number::<u32>(1..=87_600), env = "RTFARM_KEEP_HOURS")]
    pub(crate) keep_hours: u32,

    /// The most bytes, in GB, that jobs that have ended are kept in; the oldest go first.
    #[arg(long, value_name = "GB", default_value = "16", value_parser = whole_number::<u32>(1..=u32::MAX), env = "RTFARM_KEEP_GB")]
    pub(crate) keep_gb: u32,

    /// How much of what a worker renders another renders again, to find out who lies, from 0 to 1;
    /// besides, each worker's first tile of a picture. 0 compares nothing.
    #[arg(long, value_name = "FRACTION", default_value = "0.01", value_parser = parse_fraction, env = "RTFARM_AUDIT", help_heading = WORK)]
    pub(crate) audit: f64,

    #[command(flatten)]
    pub(crate) log: LogArgs,
}

#[derive(Debug, ClapArgs)]
pub(crate) struct LogArgs {
    /// How log lines are written.
    #[arg(long = "log-format", value_name = "FORMAT", default_value = "text", env = "RTFARM_LOG_FORMAT", help_heading = TALK)]
    pub(crate) format: LogFormat,
}

#[derive(Debug, ClapArgs)]
pub(crate) struct WorkerArgs {
    #[command(flatten)]
    pub(crate) coordinator: AccessArgs,

    /// Threads; all cores by default.
    #[arg(long, value_name = "N", value_parser = whole_number::<u16>(1..=1024), env = "RTFARM_THREADS", help_heading = WORK)]
    threads: Option<u16>,

    /// The instruction set that the kernels use; all give the same bytes.
    #[arg(long, value_name = "auto|scalar|sse2|avx2|avx512", default_value = "auto", env = "RTFARM_ISA", help_heading = WORK)]
    pub(crate) isa: IsaChoice,

    /// Memory in GB for prepared scenes; a scene that needs more is left to others.
    ///
    /// By default three quarters of what the machine has, or of what its control group allows.
    #[arg(long, value_name = "GB", value_parser = parse_gigabytes, env = "RTFARM_MEMORY", help_heading = WORK)]
    memory: Option<u64>,

    /// How long to go on without a coordinator.
    #[arg(long, value_name = "S", default_value = "60", value_parser = parse_seconds, env = "RTFARM_PATIENCE", help_heading = WORK)]
    pub(crate) patience: Duration,

    /// How long the tiles in hand may still take after SIGTERM.
    #[arg(long, value_name = "S", default_value = "10", value_parser = parse_seconds, env = "RTFARM_GRACE", help_heading = WORK)]
    pub(crate) grace: Duration,

    #[command(flatten)]
    pub(crate) log: LogArgs,

    /// Live no longer than this process, which has started this one.
    #[arg(long, hide = true)]
    pub(crate) parent: Option<u32>,

    /// Say to be of this version.
    #[arg(long, hide = true, default_value = crate::VERSION)]
    pub(crate) claim_version: String,
}

/// Which farm is meant, and how it is reached.
#[derive(Debug, Clone, ClapArgs)]
pub(crate) struct AccessArgs {
    /// Where the coordinator is: `https://host:7878` or `unix:/path/socket`, `http://` if it is
    /// insecure; by default where the access file says.
    #[arg(long = "coordinator", value_name = "URL", env = "RTFARM_COORDINATOR", help_heading = FARM)]
    address: Option<Address>,

    /// The access file, which says where the coordinator is, who vouches for it, and what it is
    /// shown.
    #[arg(long, value_name = "FILE", env = "RTFARM_ACCESS", help_heading = FARM)]
    access: Option<PathBuf>,
}

impl AccessArgs {
    /// How the coordinator is reached. Reads the access file.
    pub(crate) fn access(&self) -> anyhow::Result<Access> {
        let address = self.address.clone();
        // Where nobody is asked for a token none is read.
        if let Some(address @ (Address::Unix(_) | Address::Tcp(_))) = address {
            return Ok(address.into());
        }
        let Some(path) = &self.access else {
            return address.map(Access::from).context(
                "which farm is meant? --access FILE names its access file, or --coordinator URL says \
                 where it is",
            );
        };
        let read = || -> anyhow::Result<Access> {
            let metadata = fs::metadata(path)?;
            // Who gave another's file for this user to read knows what they do: a Kubernetes secret
            // is so.
            let is_own = metadata.uid() == rustix::process::geteuid().as_raw();
            let for_others = metadata.mode() & if is_own { 0o077 } else { 0o007 };
            ensure!(for_others == 0, "others may read it; chmod 600 makes it yours alone");
            Ok(Access::read(&fs::read_to_string(path)?)?)
        };
        let access =
            read().with_context(|| format!("cannot use the access file {}", path.display()))?;
        Ok(match address {
            Some(address) => access.at(address),
            None => access.kept_in(path.clone()),
        })
    }
}

impl CoordinatorArgs {
    /// How much may be ordered.
    pub(crate) fn orders(&self) -> OrderLimits {
        let (jobs, pixels) = (self.most_jobs, self.most_megapixels);
        let (upload_bytes, flight_bytes) = (self.upload_gb, u64::from(self.flight_mb) * 1_000_000);
        OrderLimits { jobs, pixels, bytes: self.most_gb, upload_bytes, flight_bytes }
    }

    /// How connections of strangers are limited.
    pub(crate) fn limits(&self) -> Limits {
        let (handshake, first_word) = (self.handshake_seconds, self.greeting_seconds);
        Limits { handshake, first_word, strangers: self.strangers.into() }
    }
}

impl WorkerArgs {
    /// Threads that render.
    pub(crate) fn threads(&self) -> usize {
        self.threads.map_or_else(core_count, usize::from)
    }

    /// Bytes for prepared scenes. A local worker takes what its parent could prepare.
    pub(crate) fn memory(&self) -> Option<u64> {
        match self.parent {
            Some(_) => None,
            None => self.memory.or_else(rtfarm_worker::memory_for_scenes),
        }
    }
}
