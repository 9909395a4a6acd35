//! The command line's words.

mod farm;
mod jobs;
mod picture;
mod values;

use std::{path::PathBuf, time::Duration};

use clap::{Arg, Args as ClapArgs, CommandFactory, FromArgMatches, Parser, Subcommand};
use rtfarm_core::render::StandardError;
use rtfarm_ladder::Effort;

use self::{
    farm::LogArgs,
    values::{parse_error, parse_seconds, whole_number},
};
use crate::{
    frames::FrameRange,
    slurm::{Host, SbatchOptions},
};

pub(crate) use self::{
    farm::{CertsArgs, CoordinatorArgs, TokenChange, TokensArgs, WorkerArgs},
    jobs::{
        ExplainArgs, FarmArgs, ImageArgs, JobArgs, PriorityArgs, StationArgs, SubmitArgs, WatchArgs,
    },
    picture::{PictureArgs, SettingArgs, form},
    values::{IsaChoice, LogFormat, TileShare},
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
pub(crate) struct VerifyArgs {
    /// The picture, which says itself with which settings it was rendered; those that are given
    /// here must be the same.
    #[arg(value_name = "IMAGE")]
    pub(crate) image: PathBuf,

    #[command(flatten)]
    pub(crate) scene: SceneArgs,

    #[command(flatten)]
    pub(crate) settings: SettingArgs,

    /// So many tiles, which are drawn by chance, or `all`; by default some, at least 8 and at most
    /// 1024.
    #[arg(long, value_name = "N|all", default_value = "few", hide_default_value = true, help_heading = WORK)]
    pub(crate) tiles: TileShare,

    /// Threads; all cores by default.
    #[arg(long, value_name = "N", value_parser = whole_number::<u16>(1..=1024), help_heading = WORK)]
    threads: Option<u16>,

    /// The instruction set that the kernels use; all give the same bytes.
    #[arg(long, value_name = "auto|scalar|sse2|avx2|avx512", default_value = "auto", help_heading = WORK)]
    pub(crate) isa: IsaChoice,

    /// Answer in JSON.
    #[arg(long, help_heading = TALK)]
    pub(crate) json: bool,
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
    /// The folder FILE.rtfarm has it until the picture is there. Of --frames, those whose picture
    /// is there, rendered from the same scene with the same settings by this build, are passed
    /// over.
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
    /// Such as "--array=1-8 --cpus-per-task=16 --time=30". The nodes must share the disk of FILE
    /// and of this program; a folder beside FILE has their access file and their logs until the
    /// picture is there.
    #[arg(long, value_name = "OPTIONS", allow_hyphen_values = true, conflicts_with_all = ["workers", "threads", "isa", "time"], help_heading = WORK)]
    pub(crate) slurm: Option<SbatchOptions>,

    /// Where the nodes of --slurm find this machine; by default by its name, at a free port.
    #[arg(long, value_name = "HOST[:PORT]", env = "RTFARM_SLURM_HOST", help_heading = WORK)]
    slurm_host: Option<Host>,

    /// Worker processes; 0 renders in this one. Default: 2, or 1 on a single core.
    #[arg(long, value_name = "N", value_parser = whole_number::<u16>(0..=256), help_heading = WORK)]
    workers: Option<u16>,

    /// Threads of each worker; by default the cores are shared out.
    #[arg(long, value_name = "N", value_parser = whole_number::<u16>(1..=1024), help_heading = WORK)]
    threads: Option<u16>,

    /// The instruction set that the kernels use; all give the same bytes.
    #[arg(long, value_name = "auto|scalar|sse2|avx2|avx512", default_value = "auto", help_heading = WORK)]
    pub(crate) isa: IsaChoice,

    /// A worker that makes no progress for this long loses its tiles to others.
    #[arg(long, value_name = "S", default_value = "4", value_parser = parse_seconds, help_heading = WORK)]
    pub(crate) lease_seconds: Duration,

    /// How long to go on though no worker process does anything; with --slurm, how long workers go
    /// on when this process is gone.
    #[arg(long, value_name = "S", default_value = "60", value_parser = parse_seconds, help_heading = WORK)]
    pub(crate) patience: Duration,

    /// Show the picture as it comes, on a page of this user's browser.
    ///
    /// Where none can be opened, the page's address is told.
    #[arg(long, help_heading = TALK)]
    pub(crate) show: bool,

    /// Draw the picture in the terminal as it comes, coarsely.
    ///
    /// By the protocol of Kitty or iTerm2 or by sixels; a terminal that has none of them is told
    /// of, and the picture is rendered without. With --quiet, too, and whatever `NO_COLOR` says.
    #[arg(long, help_heading = TALK)]
    pub(crate) preview: bool,

    #[command(flatten)]
    pub(crate) log: LogArgs,
}

impl Args {
    /// Reads the command line. A number below zero is a value of its option there, so that what is
    /// said of it is what would be right.
    pub(crate) fn read() -> Result<Self, clap::Error> {
        let takes_numbers = |argument: Arg| {
            let takes = argument.get_action().takes_values();
            argument.allow_negative_numbers(takes)
        };
        let command = Self::command().mut_subcommands(|command| command.mut_args(takes_numbers));
        Self::from_arg_matches(&command.try_get_matches()?)
    }
}

impl ReportArgs {
    /// The user's own scene.
    pub(crate) fn scene(&self) -> SceneArgs {
        SceneArgs { path: self.scene.clone(), strict: false, allow_files: self.allow_files.clone() }
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

impl VerifyArgs {
    /// Threads that render.
    pub(crate) fn threads(&self) -> usize {
        self.threads.map_or_else(core_count, usize::from)
    }
}

impl Command {
    /// How log lines are written.
    pub(crate) fn log_format(&self) -> LogFormat {
        match self {
            Self::Render(args) => args.log.format,
            Self::Coordinator(args) => args.log.format,
            Self::Worker(args) => args.log.format,
            Self::Submit(args) => args.log.format,
            _ => LogFormat::Text,
        }
    }
}

fn core_count() -> usize {
    std::thread::available_parallelism().map_or(1, usize::from)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_words_fit_together() {
        Args::command().debug_assert();
    }
}
