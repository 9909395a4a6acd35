//! The command line's words.

use std::{
    fmt, fs, ops::RangeInclusive, os::unix::fs::MetadataExt, path::PathBuf, str::FromStr,
    time::Duration,
};

use anyhow::{Context, ensure};

use clap::{
    Args as ClapArgs, Parser, Subcommand, ValueEnum, builder::NonEmptyStringValueParser,
    value_parser,
};
use rtfarm_coordinator::{Limits, OrderLimits, Owner, Role};
use rtfarm_core::{
    isa::{Isa, IsaError},
    prepare::Form,
    render::{Quality, SampleCount, SampleLimit, Sampling, StandardError},
    tile::{Crop, Size, SizeError, TileGrid},
    transfer::Transfer,
};
use rtfarm_job::RenderRequest;
use rtfarm_ladder::Effort;
use rtfarm_picture::PictureFormat;
use rtfarm_proto::{Access, Address};

use crate::{
    frames::FrameRange,
    output::Output,
    slurm::{Host, SbatchOptions},
};

/// Renders scenes in the rt language, on one machine or many.
#[derive(Debug, Parser)]
#[command(version, propagate_version = true, after_help = AFTER_HELP)]
pub(crate) struct Args {
    #[command(subcommand)]
    pub(crate) command: Command,

    /// Write nothing but warnings, errors and what was asked for.
    #[arg(short, long, global = true, conflicts_with = "verbose", help_heading = TALK)]
    pub(crate) quiet: bool,

    /// Write a line for each tile and each worker on a terminal, too; elsewhere, more.
    #[arg(short, long, global = true, help_heading = TALK)]
    pub(crate) verbose: bool,
}

const AFTER_HELP: &str = "\
Examples:
  rtfarm render scenes/gnome.rt -o gnome.png
  rtfarm coordinator --state farm &
  rtfarm worker --access farm/access/work &
  rtfarm submit scenes/gnome.rt -o gnome.png --access farm/access/submit

Exit codes: 0 done, 1 failed, 2 the command line or a file that it names to be read is wrong,
130 stopped by a signal.
Options that say what they are from the environment ([env: ...]) may be given there.";

/// Options that say how much is told.
const TALK: &str = "What is told";

/// Options that say which farm is meant.
const FARM: &str = "The farm";

/// Options that say what the picture is like.
const PICTURE: &str = "The picture";

/// Options that say who is let in.
const LIMITS: &str = "Who is let in";

/// Options that say who renders.
const WORK: &str = "The work";

#[derive(Debug, Subcommand)]
pub(crate) enum Command {
    /// Render a scene on this machine.
    Render(RenderArgs),
    /// Run a farm's coordinator until it is stopped.
    Coordinator(CoordinatorArgs),
    /// Work for a coordinator until it sends the worker home.
    Worker(WorkerArgs),
    /// Have a farm render a scene.
    Submit(SubmitArgs),
    /// List a farm's jobs, those that are rendered first in the order in which they are.
    Jobs(FarmArgs),
    /// List a farm's workers.
    Workers(FarmArgs),
    /// Follow a job to its end; exits with 1 when it fails.
    Watch(WatchArgs),
    /// Fetch the picture of a finished job, which the farm then forgets.
    Image(ImageArgs),
    /// Say what became of a tile: who rendered it, who lost it and why.
    Explain(ExplainArgs),
    /// End a job and forget it.
    Cancel(JobArgs),
    /// Give workers no more tiles of a job; those in work are taken.
    Pause(JobArgs),
    /// Go on with a job that was paused.
    Resume(JobArgs),
    /// Put a job before those of a lower priority.
    Priority(PriorityArgs),
    /// Render what a failed job lacks.
    Retry(JobArgs),
    /// Have a worker finish the tiles that it has, and go home.
    Drain(StationArgs),
    /// Have a worker finish the tiles that it has, and give it no more.
    Disable(StationArgs),
    /// Give tiles again to a worker that was disabled or is drained.
    Enable(StationArgs),
    /// Make the certificates, tokens and access files of a farm before its coordinator is started.
    Certs(CertsArgs),
    /// Renew or revoke a token of a farm; its coordinator need not be stopped.
    Tokens(TokensArgs),
    /// Say whether a picture is what its scene gives: tiles of it are rendered again and compared.
    ///
    /// Exits with 0 when it is, with 1 when it is not, with 2 when that cannot be found out.
    Verify(VerifyArgs),
    /// Say what is wrong with a scene, and what it needs.
    Check(CheckArgs),
    /// Write a shell's completions to standard output.
    Completions(CompletionsArgs),
    /// Write manual pages, one a command, into a folder.
    Man(ManArgs),
    /// Measure speed against error of a scene, whose picture at many samples stands for the truth.
    Report(ReportArgs),
}

/// Which scene, and how it is read.
#[derive(Debug, Clone, ClapArgs)]
pub(crate) struct SceneArgs {
    /// The scene's file; `-` reads it from standard input.
    #[arg(value_name = "SCENE")]
    pub(crate) path: PathBuf,

    /// Make an error of every warning.
    #[arg(long)]
    pub(crate) strict: bool,

    /// Let the scene name files in this folder, too.
    ///
    /// Otherwise they lie in its own folder or below. May be repeated.
    #[arg(long, value_name = "DIR")]
    pub(crate) allow_files: Vec<PathBuf>,
}

impl SceneArgs {
    /// The scene as messages call it.
    pub(crate) fn name(&self) -> String {
        if self.is_from_stdin() { "<stdin>".to_owned() } else { self.path.display().to_string() }
    }

    pub(crate) fn is_from_stdin(&self) -> bool {
        self.path.as_os_str() == "-"
    }
}

#[derive(Debug, ClapArgs)]
pub(crate) struct CheckArgs {
    #[command(flatten)]
    pub(crate) scene: SceneArgs,

    /// Tell how large the scene is when it is prepared with --compact.
    #[arg(long)]
    pub(crate) compact: bool,

    /// Answer in JSON.
    #[arg(long, help_heading = TALK)]
    pub(crate) json: bool,
}

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
pub(crate) struct VerifyArgs {
    /// The picture, which says itself with which settings it was rendered; those that are given here must
    /// be the same.
    #[arg(value_name = "IMAGE")]
    pub(crate) image: PathBuf,

    #[command(flatten)]
    pub(crate) scene: SceneArgs,

    #[command(flatten)]
    pub(crate) settings: SettingArgs,

    /// So many tiles, which are drawn by chance, or `all`; by default some, at least 8 and at most 1024.
    #[arg(long, value_name = "N|all", default_value = "few", hide_default_value = true, help_heading = WORK)]
    pub(crate) tiles: TileShare,

    /// Threads; all cores by default.
    #[arg(long, value_name = "N", value_parser = value_parser!(u16).range(1..=1024), help_heading = WORK)]
    threads: Option<u16>,

    /// The instruction set that the kernels use; all give the same bytes.
    #[arg(long, value_name = "auto|scalar|sse2|avx2|avx512", default_value = "auto", help_heading = WORK)]
    pub(crate) isa: IsaChoice,

    /// Answer in JSON.
    #[arg(long, help_heading = TALK)]
    pub(crate) json: bool,
}

/// How many tiles are rendered again.
#[derive(Debug, Clone, Copy)]
pub(crate) enum TileShare {
    All,
    Some(u32),
    /// A few percent.
    Few,
}

impl FromStr for TileShare {
    type Err = &'static str;

    fn from_str(text: &str) -> Result<Self, &'static str> {
        match text {
            "all" => Ok(Self::All),
            "few" => Ok(Self::Few),
            _ => match text.parse() {
                Ok(count @ 1..) => Ok(Self::Some(count)),
                _ => Err("a number of tiles is wanted, or `all`"),
            },
        }
    }
}

#[derive(Debug, ClapArgs)]
pub(crate) struct TokensArgs {
    /// Renew makes a new token and access file, and the old one is not taken any more; revoke only that.
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
pub(crate) struct CompletionsArgs {
    /// The shell.
    #[arg(value_name = "SHELL")]
    pub(crate) shell: clap_complete::Shell,
}

#[derive(Debug, ClapArgs)]
pub(crate) struct ManArgs {
    /// The folder; it is made if there is none.
    #[arg(value_name = "DIR")]
    pub(crate) folder: PathBuf,
}

#[derive(Debug, ClapArgs)]
pub(crate) struct ReportArgs {
    /// The scene to measure.
    #[arg(value_name = "SCENE")]
    scene: PathBuf,

    /// Let the scene name files in this folder, too.
    ///
    /// Otherwise they lie in its own folder or below. May be repeated.
    #[arg(long, value_name = "DIR")]
    allow_files: Vec<PathBuf>,

    /// The folder that report.md and its plots go into; without it the report goes to standard
    /// output.
    #[arg(long, value_name = "DIR")]
    pub(crate) out: Option<PathBuf>,

    /// How much work goes into it.
    #[arg(long, value_name = "EFFORT", default_value = "quick")]
    pub(crate) effort: Effort,

    /// The error of SCENE's picture that is wanted, where 1 is full light; some by default.
    #[arg(long, value_name = "ERROR", value_parser = parse_error)]
    pub(crate) wanted: Option<StandardError>,
}

/// What a picture depends on besides its scene, as far as it is said.
#[derive(Debug, Clone, ClapArgs)]
pub(crate) struct SettingArgs {
    /// The picture's size in pixels; the size that the scene asks for by default.
    #[arg(long, value_name = "WxH", value_parser = parse_size, help_heading = PICTURE)]
    size: Option<Size>,

    /// Show only the window whose upper left pixel is X,Y, of W columns and H rows.
    ///
    /// Its pixels are those of the whole picture, to the bit.
    #[arg(long, value_name = "X,Y,W,H", value_parser = parse_crop, help_heading = PICTURE)]
    crop: Option<Crop>,

    /// The same number of samples in every pixel.
    #[arg(long, value_name = "N", value_parser = parse_samples, conflicts_with_all = ["error", "max_samples"], help_heading = PICTURE)]
    samples: Option<SampleCount>,

    /// Sample each pixel until its standard error is below this, where 1 is full light [default: 1/255].
    ///
    /// It is an error of light, not of encoded values, whatever the --transfer.
    #[arg(long, value_name = "ERROR", value_parser = parse_error, help_heading = PICTURE)]
    error: Option<StandardError>,

    /// But at most so often [default: 256].
    #[arg(long, value_name = "N", value_parser = parse_max_samples, help_heading = PICTURE)]
    max_samples: Option<SampleLimit>,

    /// Chooses the random numbers [default: 0].
    #[arg(long, value_name = "N", help_heading = PICTURE)]
    seed: Option<u64>,

    /// Show every surface in its plain colour, as in a scene without light.
    #[arg(long, help_heading = PICTURE)]
    flat: bool,

    /// Whether surfaces that mirror light others [default: on].
    #[arg(long, value_name = "on|off", hide_possible_values = true, help_heading = PICTURE)]
    secondary: Option<Switch>,

    /// The side of a tile in pixels; by default the one that gives about 1000 tiles.
    #[arg(long, value_name = "N", value_parser = value_parser!(u64).range(TileGrid::SIDES), help_heading = PICTURE)]
    tile: Option<u64>,

    /// What the numbers of colours say: the light itself, or light encoded by the sRGB curve [default: none].
    ///
    /// Then colours of materials, textures, point lights and the background are decoded, and a PNG is
    /// encoded; an EXR holds light.
    #[arg(long, value_name = "none|srgb", value_parser = parse_transfer, help_heading = PICTURE)]
    transfer: Option<Transfer>,

    /// Bits a channel of a PNG.
    #[arg(long, value_name = "BITS", value_parser = ["8", "16"], help_heading = PICTURE)]
    depth: Option<String>,
}

/// What picture is wanted.
#[derive(Debug, Clone, ClapArgs)]
pub(crate) struct PictureArgs {
    #[command(flatten)]
    pub(crate) scene: SceneArgs,

    /// Where the picture goes; the extension, .png or .exr, says how it is written.
    #[arg(short, long = "output", value_name = "FILE")]
    pub(crate) output: PathBuf,

    #[command(flatten)]
    settings: SettingArgs,

    /// Prepare the scene to take little memory; pictures are the same.
    ///
    /// A triangle takes some 32 bytes instead of 55; 38 if single precision does not hold its corners
    /// exactly, as it does those of binary meshes. To prepare it takes as much memory as before.
    #[arg(long, help_heading = WORK)]
    pub(crate) compact: bool,

    /// Say beside the picture, in FILE.json, when, how long and on which hosts it was rendered.
    ///
    /// What FILE itself says, scene and settings, is there too.
    #[arg(long, help_heading = PICTURE)]
    pub(crate) sidecar: bool,
}

#[derive(Debug, ClapArgs)]
#[expect(clippy::struct_excessive_bools, reason = "each is an option")]
pub(crate) struct RenderArgs {
    #[command(flatten)]
    pub(crate) picture: PictureArgs,

    /// Render these frames of a sequence: 1-48, or 1-48x2 for each second one.
    ///
    /// SCENE and FILE then have a place for the number, like shot.%04d.rt. The next frame fills the
    /// workers while the last tiles of one are rendered.
    #[arg(long, value_name = "A-B", conflicts_with = "time", help_heading = PICTURE)]
    pub(crate) frames: Option<FrameRange>,

    /// Make the picture as good as this many seconds allow: a pilot chooses the --error and the
    /// --max-samples, and tells them.
    #[arg(long, value_name = "S", value_parser = parse_seconds, conflicts_with_all = ["samples", "error", "max_samples"], help_heading = PICTURE)]
    pub(crate) time: Option<Duration>,

    /// Go on with what an earlier render with --resume left when it was interrupted.
    ///
    /// The folder FILE.rtfarm has it until the picture is there. Of --frames, those whose picture is there,
    /// rendered from the same scene with the same settings by this build, are passed over.
    #[arg(long, conflicts_with = "time", help_heading = WORK)]
    pub(crate) resume: bool,

    /// Prepare the scene anew, and keep nothing of it.
    ///
    /// Otherwise the user's cache folder (`$XDG_CACHE_HOME/rtfarm` or `~/.cache/rtfarm`) has large
    /// scenes as they were prepared for earlier renders.
    #[arg(long, help_heading = WORK)]
    pub(crate) no_cache: bool,

    /// Have workers of a cluster render: Slurm gets an array of them with these options of sbatch.
    ///
    /// Such as "--array=1-8 --cpus-per-task=16 --time=30". The nodes must share the disk of FILE and of
    /// this program; a folder beside FILE has their access file and their logs until the picture is there.
    #[arg(long, value_name = "OPTIONS", allow_hyphen_values = true, conflicts_with_all = ["workers", "threads", "isa", "time"], help_heading = WORK)]
    pub(crate) slurm: Option<SbatchOptions>,

    /// Where the nodes of --slurm find this machine; by default by its name, at a free port.
    #[arg(long, value_name = "HOST[:PORT]", env = "RTFARM_SLURM_HOST", help_heading = WORK)]
    slurm_host: Option<Host>,

    /// Worker processes; 0 renders in this one. Default: 2, or 1 on a single core.
    #[arg(long, value_name = "N", value_parser = value_parser!(u16).range(0..=256), help_heading = WORK)]
    workers: Option<u16>,

    /// Threads of each worker; by default the cores are shared out.
    #[arg(long, value_name = "N", value_parser = value_parser!(u16).range(1..=1024), help_heading = WORK)]
    threads: Option<u16>,

    /// The instruction set that the kernels use; all give the same bytes.
    #[arg(long, value_name = "auto|scalar|sse2|avx2|avx512", default_value = "auto", help_heading = WORK)]
    pub(crate) isa: IsaChoice,

    /// A worker that makes no progress for this long loses its tiles to others.
    #[arg(long, value_name = "S", default_value = "4", value_parser = parse_seconds, help_heading = WORK)]
    pub(crate) lease_seconds: Duration,

    /// How long to go on though no worker process does anything; with --slurm, how long workers go on
    /// when this process is gone.
    #[arg(long, value_name = "S", default_value = "60", value_parser = parse_seconds, help_heading = WORK)]
    pub(crate) patience: Duration,

    /// Show the picture as it comes, on a page of this user's browser.
    ///
    /// Where none can be opened, the page's address is told.
    #[arg(long, help_heading = TALK)]
    pub(crate) show: bool,

    /// Draw the picture in the terminal as it comes, coarsely.
    ///
    /// By the protocol of Kitty or iTerm2 or by sixels; a terminal that has none of them is told of, and the
    /// picture is rendered without. With --quiet, too, and whatever `NO_COLOR` says.
    #[arg(long, help_heading = TALK)]
    pub(crate) preview: bool,

    /// How log lines are written.
    #[arg(long, value_name = "FORMAT", default_value = "text", help_heading = TALK)]
    pub(crate) log_format: LogFormat,
}

#[derive(Debug, ClapArgs)]
pub(crate) struct CoordinatorArgs {
    /// The address and port to listen on, or `unix:/folder/socket`; port 0 takes a free one.
    #[arg(long, value_name = "ADDR:PORT", default_value = "127.0.0.1:7878", env = "RTFARM_LISTEN")]
    pub(crate) listen: String,

    /// Encrypt nothing and ask nobody for a token.
    #[arg(long, env = "RTFARM_INSECURE")]
    pub(crate) insecure: bool,

    /// Keep the farm's jobs and pictures in this folder, which is made if there is none: a coordinator
    /// that is started on it again goes on with them. Without it they end with the coordinator.
    ///
    /// DIR/access has the farm's certificates, and an access file for each role.
    #[arg(long, value_name = "DIR", env = "RTFARM_STATE")]
    pub(crate) state: Option<PathBuf>,

    /// Lose no finished tile in a power cut; otherwise those of the last second may be rendered again.
    #[arg(long, requires = "state", env = "RTFARM_DURABLE")]
    pub(crate) durable: bool,

    /// Append what happens to this file, a JSON object a line.
    #[arg(long, value_name = "FILE", env = "RTFARM_EVENTS", help_heading = TALK)]
    pub(crate) events: Option<PathBuf>,

    /// Where others find the coordinator, for the access files and the page; by default this machine's name, or the
    /// address that is listened on.
    #[arg(long, value_name = "HOST", env = "RTFARM_NAME", help_heading = LIMITS)]
    pub(crate) name: Option<String>,

    /// The longest that a TLS handshake may take.
    #[arg(long, value_name = "S", default_value = "5", value_parser = parse_seconds, env = "RTFARM_HANDSHAKE_SECONDS", help_heading = LIMITS)]
    handshake_seconds: Duration,

    /// Who connects must have shown a token after so long.
    #[arg(long, value_name = "S", default_value = "10", value_parser = parse_seconds, env = "RTFARM_GREETING_SECONDS", help_heading = LIMITS)]
    greeting_seconds: Duration,

    /// The most connections on which nobody has shown a token yet.
    #[arg(long, value_name = "N", default_value = "64", value_parser = value_parser!(u16).range(1..), env = "RTFARM_STRANGERS", help_heading = LIMITS)]
    strangers: u16,

    /// Who sends nothing of a scene or takes nothing of one or of a picture for this long is given up.
    #[arg(long, value_name = "S", default_value = "30", value_parser = parse_seconds, env = "RTFARM_UPLOAD_SECONDS", help_heading = LIMITS)]
    pub(crate) upload_seconds: Duration,

    /// The most bytes, in GB, that scenes have together which are being sent.
    #[arg(long, value_name = "GB", default_value = "8", value_parser = parse_gigabytes, env = "RTFARM_UPLOAD_GB", help_heading = LIMITS)]
    upload_gb: u64,

    /// The most bytes, in MB, of pixels, scenes and pictures that are in memory on their way here, and as
    /// many on their way elsewhere; what more there is waits.
    #[arg(long, value_name = "MB", default_value = "1000", value_parser = value_parser!(u32).range(16..), env = "RTFARM_FLIGHT_MB", help_heading = LIMITS)]
    flight_mb: u32,

    /// The most jobs that have not ended, of each owner of a token and of all others together; who has the
    /// token `admin` may order more, also of the next two.
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
    #[arg(long, value_name = "HOURS", default_value = "168", value_parser = value_parser!(u32).range(1..=87_600), env = "RTFARM_KEEP_HOURS")]
    pub(crate) keep_hours: u32,

    /// The most bytes, in GB, that jobs that have ended are kept in; the oldest go first.
    #[arg(long, value_name = "GB", default_value = "16", value_parser = value_parser!(u32).range(1..), env = "RTFARM_KEEP_GB")]
    pub(crate) keep_gb: u32,

    /// How much of what a worker renders another renders again, to find out who lies, from 0 to 1;
    /// besides, each worker's first tile of a picture. 0 compares nothing.
    #[arg(long, value_name = "FRACTION", default_value = "0.01", value_parser = parse_fraction, env = "RTFARM_AUDIT", help_heading = WORK)]
    pub(crate) audit: f64,

    /// How log lines are written.
    #[arg(long, value_name = "FORMAT", default_value = "text", env = "RTFARM_LOG_FORMAT", help_heading = TALK)]
    pub(crate) log_format: LogFormat,
}

#[derive(Debug, ClapArgs)]
pub(crate) struct WorkerArgs {
    #[command(flatten)]
    pub(crate) coordinator: AccessArgs,

    /// Threads; all cores by default.
    #[arg(long, value_name = "N", value_parser = value_parser!(u16).range(1..=1024), env = "RTFARM_THREADS", help_heading = WORK)]
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

    /// How log lines are written.
    #[arg(long, value_name = "FORMAT", default_value = "text", env = "RTFARM_LOG_FORMAT", help_heading = TALK)]
    pub(crate) log_format: LogFormat,

    /// Live no longer than this process, which has started this one.
    #[arg(long, hide = true)]
    pub(crate) parent: Option<u32>,

    /// Say to be of this version.
    #[arg(long, hide = true, default_value = crate::VERSION)]
    pub(crate) claim_version: String,
}

#[derive(Debug, ClapArgs)]
pub(crate) struct SubmitArgs {
    #[command(flatten)]
    pub(crate) picture: PictureArgs,

    #[command(flatten)]
    pub(crate) coordinator: AccessArgs,

    /// Print the job's number and end: the job goes on by itself, and `rtfarm image` fetches what -o
    /// says. Otherwise an interruption cancels it.
    #[arg(long, conflicts_with = "sidecar", help_heading = FARM)]
    pub(crate) detach: bool,

    /// What the job is called; the scene's file by default.
    #[arg(long, value_name = "NAME", help_heading = FARM)]
    pub(crate) name: Option<String>,

    /// Who wants it; the user's login name by default. A token of an owner's own overrides it.
    #[arg(long, value_name = "OWNER", env = "RTFARM_OWNER", help_heading = FARM)]
    pub(crate) owner: Option<Owner>,

    /// Submit only once under this key: the job that the same order has already is taken for this one.
    #[arg(long, value_name = "KEY", value_parser = NonEmptyStringValueParser::new(), help_heading = FARM)]
    pub(crate) key: Option<String>,

    /// Jobs of a higher priority come first.
    #[arg(long, value_name = "N", default_value_t = 0, allow_negative_numbers = true, env = "RTFARM_PRIORITY", help_heading = FARM)]
    pub(crate) priority: i32,

    /// The most workers that render it at the same time.
    #[arg(long, value_name = "N", value_parser = value_parser!(u32).range(1..), env = "RTFARM_MAX_WORKERS", help_heading = FARM)]
    pub(crate) max_workers: Option<u32>,

    /// Answer in JSON.
    #[arg(long, help_heading = TALK)]
    pub(crate) json: bool,

    /// How long to go on without a coordinator once it was reached.
    #[arg(long, value_name = "S", default_value = "60", value_parser = parse_seconds, env = "RTFARM_PATIENCE", help_heading = FARM)]
    pub(crate) patience: Duration,

    /// How log lines are written.
    #[arg(long, value_name = "FORMAT", default_value = "text", env = "RTFARM_LOG_FORMAT", help_heading = TALK)]
    pub(crate) log_format: LogFormat,
}

/// Which farm is meant, and how it is reached.
#[derive(Debug, Clone, ClapArgs)]
pub(crate) struct AccessArgs {
    /// Where the coordinator is: `https://host:7878` or `unix:/path/socket`, `http://` if it is insecure;
    /// by default where the access file says.
    #[arg(long = "coordinator", value_name = "URL", env = "RTFARM_COORDINATOR", help_heading = FARM)]
    address: Option<Address>,

    /// The access file, which says where the coordinator is, who vouches for it, and what it is shown.
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
            // Who gave another's file for this user to read knows what they do: a Kubernetes secret is so.
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

/// Which farm is asked, and how it is told.
#[derive(Debug, ClapArgs)]
pub(crate) struct FarmArgs {
    #[command(flatten)]
    pub(crate) coordinator: AccessArgs,

    /// Answer in JSON.
    #[arg(long, help_heading = TALK)]
    pub(crate) json: bool,
}

#[derive(Debug, ClapArgs)]
pub(crate) struct JobArgs {
    /// The job's number.
    #[arg(value_name = "JOB", value_parser = number::<u64>("a job's number, as `rtfarm jobs` lists it"))]
    pub(crate) job: u64,

    #[command(flatten)]
    pub(crate) farm: FarmArgs,
}

#[derive(Debug, ClapArgs)]
pub(crate) struct ExplainArgs {
    #[command(flatten)]
    pub(crate) job: JobArgs,

    /// The tile's number, as the log and the page have it.
    #[arg(value_name = "TILE", value_parser = number::<u32>("a tile's number, from 0"))]
    pub(crate) tile: u32,
}

#[derive(Debug, ClapArgs)]
pub(crate) struct WatchArgs {
    /// The job's number.
    #[arg(value_name = "JOB", value_parser = number::<u64>("a job's number, as `rtfarm jobs` lists it"))]
    pub(crate) job: u64,

    #[command(flatten)]
    pub(crate) farm: FarmArgs,

    /// How long to go on without a coordinator once it was reached.
    #[arg(long, value_name = "S", default_value = "60", value_parser = parse_seconds, env = "RTFARM_PATIENCE", help_heading = FARM)]
    pub(crate) patience: Duration,
}

#[derive(Debug, ClapArgs)]
pub(crate) struct PriorityArgs {
    #[command(flatten)]
    pub(crate) job: JobArgs,

    /// 0 is that of a job of which nothing is said.
    #[arg(value_name = "N", allow_negative_numbers = true, value_parser = number::<i32>("a whole number"))]
    pub(crate) priority: i32,
}

#[derive(Debug, ClapArgs)]
pub(crate) struct StationArgs {
    /// The worker's number, as `rtfarm workers` lists it.
    #[arg(value_name = "WORKER", value_parser = number::<u32>("a worker's number, as `rtfarm workers` lists it"))]
    pub(crate) worker: u32,

    #[command(flatten)]
    pub(crate) farm: FarmArgs,
}

#[derive(Debug, ClapArgs)]
#[expect(clippy::struct_excessive_bools, reason = "each is a flag of its own")]
pub(crate) struct ImageArgs {
    /// The job's number.
    #[arg(value_name = "JOB", value_parser = number::<u64>("a job's number, as `rtfarm jobs` lists it"))]
    pub(crate) job: u64,

    /// Fetch what there is of a job that has not finished; what there is not is black.
    #[arg(long)]
    pub(crate) partial: bool,

    /// Have the farm keep the picture.
    #[arg(long)]
    pub(crate) keep: bool,

    /// Say beside the picture, in FILE.json, how long and on which hosts it was rendered.
    ///
    /// What FILE itself says, scene and settings, is there too.
    #[arg(long, conflicts_with = "partial")]
    pub(crate) sidecar: bool,

    /// Answer in JSON.
    #[arg(long, help_heading = TALK)]
    pub(crate) json: bool,

    /// Where the picture goes; the extension should be that of the file that was asked for.
    #[arg(short, long, value_name = "FILE")]
    pub(crate) output: PathBuf,

    #[command(flatten)]
    pub(crate) coordinator: AccessArgs,
}

/// Yes or no.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Switch {
    /// Yes.
    On,
    /// No.
    Off,
}

/// How log lines are written.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum LogFormat {
    /// For people and `grep`.
    Text,
    /// One object a line.
    Json,
}

impl fmt::Display for LogFormat {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Text => "text",
            Self::Json => "json",
        })
    }
}

/// An instruction set, chosen by name or as the fastest there is.
#[derive(Debug, Clone, Copy)]
pub(crate) struct IsaChoice(pub(crate) Isa);

impl FromStr for IsaChoice {
    type Err = IsaError;

    fn from_str(name: &str) -> Result<Self, IsaError> {
        if name == "auto" { Ok(Self(Isa::fastest())) } else { name.parse().map(Self) }
    }
}

impl ReportArgs {
    /// The user's own scene.
    pub(crate) fn scene(&self) -> SceneArgs {
        SceneArgs { path: self.scene.clone(), strict: false, allow_files: self.allow_files.clone() }
    }
}

impl PictureArgs {
    /// Where the picture goes and how it is written.
    pub(crate) fn output(&self) -> anyhow::Result<Output> {
        Output::new(&self.output, self.settings.depth.as_deref())
    }

    /// What is wanted of the scene.
    pub(crate) fn request(&self, format: PictureFormat) -> RenderRequest {
        let settings = &self.settings;
        RenderRequest {
            name: self.scene.name(),
            strict: self.scene.strict,
            size: settings.size,
            quality: Quality {
                sampling: match settings.samples {
                    Some(count) => Sampling::Fixed(count),
                    None => Sampling::Adaptive {
                        error: settings.error.unwrap_or(StandardError::EIGHT_BIT_STEP),
                        most: settings.max_samples.unwrap_or(SampleLimit::DEFAULT),
                    },
                },
                seed: settings.seed.unwrap_or(0),
                flat: settings.flat,
                secondary: !matches!(settings.secondary, Some(Switch::Off)),
                clips: format != PictureFormat::ExrF32,
            },
            crop: settings.crop,
            tile_side: settings.tile,
            transfer: settings.transfer.unwrap_or(Transfer::None),
            format,
            form: form(self.compact),
        }
    }
}

/// What a prepared scene is to be good at.
/// Reads a number; `wanted` says what is wanted where there is none.
fn number<T: FromStr>(wanted: &'static str) -> impl Fn(&str) -> Result<T, String> + Clone {
    move |text| text.parse().map_err(|_| format!("{wanted}, is wanted"))
}

pub(crate) fn form(is_compact: bool) -> Form {
    if is_compact { Form::Compact } else { Form::Fast }
}

impl SettingArgs {
    /// What is said of a picture, as the options that say it and as a picture's file has it: words and
    /// their values.
    pub(crate) fn said(&self) -> Vec<(&'static str, &'static str, String)> {
        let Self { size, crop, samples, error, max_samples, .. } = self;
        let Self { seed, flat, secondary, tile, transfer, depth, .. } = self;
        let window = |crop: Crop| {
            let Crop { corner: [x, y], sides: [width, height] } = crop;
            format!("{x},{y},{width},{height}")
        };
        let secondary = secondary.map(|switch| (switch == Switch::On).to_string());
        let transfer = transfer.map(|transfer| match transfer {
            Transfer::None => "none",
            Transfer::Srgb => "srgb",
        });
        [
            ("size", "frame", size.map(|size| size.to_string())),
            ("crop", "window", crop.map(window)),
            ("samples", "samples", samples.map(|count| count.get().to_string())),
            ("error", "error", error.map(|error| error.get().to_string())),
            ("max-samples", "max-samples", max_samples.map(|most| most.get().to_string())),
            ("seed", "seed", seed.map(|seed| seed.to_string())),
            ("flat", "flat", flat.then(|| "true".to_owned())),
            ("secondary", "secondary", secondary),
            ("tile", "tile", tile.map(|side| side.to_string())),
            ("transfer", "transfer", transfer.map(str::to_owned)),
            ("depth", "format", depth.as_ref().map(|bits| format!("png{bits}"))),
        ]
        .into_iter()
        .filter_map(|(option, word, value)| Some((option, word, value?)))
        .collect()
    }
}

impl RenderArgs {
    /// Where workers that Slurm starts find this machine.
    pub(crate) fn slurm_host(&self) -> Host {
        self.slurm_host.clone().unwrap_or(Host::HERE)
    }

    /// Worker processes, and threads of each.
    pub(crate) fn workers_and_threads(&self) -> (usize, usize) {
        let cores = core_count();
        let workers = self.workers.map_or(cores.min(2), usize::from);
        let threads = self.threads.map_or((cores / workers.max(1)).max(1), usize::from);
        (workers, threads)
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

impl VerifyArgs {
    /// Threads that render.
    pub(crate) fn threads(&self) -> usize {
        self.threads.map_or_else(core_count, usize::from)
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

impl Command {
    /// How log lines are written.
    pub(crate) fn log_format(&self) -> LogFormat {
        match self {
            Self::Render(args) => args.log_format,
            Self::Coordinator(args) => args.log_format,
            Self::Worker(args) => args.log_format,
            Self::Submit(args) => args.log_format,
            _ => LogFormat::Text,
        }
    }
}

fn core_count() -> usize {
    std::thread::available_parallelism().map_or(1, usize::from)
}

fn parse_size(text: &str) -> Result<Size, String> {
    let sides = text.split_once('x').and_then(|(w, h)| Some((w.parse().ok()?, h.parse().ok()?)));
    let (width, height) = sides.ok_or("a size looks like 1280x720")?;
    Size::new(width, height).map_err(|error: SizeError| error.to_string())
}

fn parse_crop(text: &str) -> Result<Crop, &'static str> {
    let numbers: Option<Vec<u32>> = text.split(',').map(|number| number.parse().ok()).collect();
    match numbers.as_deref() {
        Some(&[x, y, width, height]) => Ok(Crop { corner: [x, y], sides: [width, height] }),
        _ => Err("a crop window looks like 320,180,640,360: x, y, width and height in pixels"),
    }
}

fn parse_samples(text: &str) -> Result<SampleCount, String> {
    let count = text.parse().ok().and_then(SampleCount::new);
    count.ok_or_else(|| out_of_range("the number of samples", &SampleCount::RANGE))
}

fn parse_max_samples(text: &str) -> Result<SampleLimit, String> {
    let limit = text.parse().ok().and_then(SampleLimit::new);
    limit.ok_or_else(|| out_of_range("the most samples", &SampleLimit::RANGE))
}

fn out_of_range(what: &str, range: &RangeInclusive<u32>) -> String {
    format!("{what} must be a whole number from {} to {}", range.start(), range.end())
}

fn parse_error(text: &str) -> Result<StandardError, &'static str> {
    let error = text.parse().ok().and_then(StandardError::new);
    error.ok_or("an error must be a number above 0 and at most 1")
}

fn parse_transfer(text: &str) -> Result<Transfer, String> {
    match text {
        "none" => Ok(Transfer::None),
        "srgb" => Ok(Transfer::Srgb),
        _ => Err("a transfer is none or srgb".to_owned()),
    }
}

fn parse_seconds(text: &str) -> Result<Duration, String> {
    let seconds: f64 = text.parse().map_err(|_| "a number of seconds is wanted")?;
    if (0.1..=86_400.0).contains(&seconds) {
        Ok(Duration::from_secs_f64(seconds))
    } else {
        Err("a time is from 0.1 to 86400 seconds".to_owned())
    }
}

/// Answers with bytes.
fn parse_gigabytes(text: &str) -> Result<u64, &'static str> {
    let bytes = text.parse().ok().map(|gigabytes: f64| gigabytes * 1e9);
    let bytes = bytes.filter(|bytes| (1.0..=1e18).contains(bytes));
    bytes.map(|bytes| bytes as u64).ok_or("a number of GB above 0 is wanted")
}

/// Answers with ones.
fn parse_millions(text: &str) -> Result<u64, &'static str> {
    let ones = text.parse().ok().map(|millions: f64| millions * 1e6);
    let ones = ones.filter(|ones| (1.0..=1e18).contains(ones));
    ones.map(|ones| ones as u64).ok_or("a number of millions above 0 is wanted")
}

fn parse_fraction(text: &str) -> Result<f64, &'static str> {
    let fraction = text.parse().ok().filter(|fraction| (0.0..=1.0).contains(fraction));
    fraction.ok_or("a fraction is a number from 0 to 1")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_words_fit_together() {
        use clap::CommandFactory;
        Args::command().debug_assert();
    }

    #[test]
    fn sizes_are_read_and_checked() {
        assert_eq!(parse_size("1280x720"), Ok(Size::new(1280, 720).unwrap()));
        for bad in ["", "x", "1280", "0x0", "100000x100000", "-1x5", "1x1x1", "1.5x2"] {
            parse_size(bad).expect_err(bad);
        }
    }
}
