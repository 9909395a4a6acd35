//! The words of those who order pictures from a farm and look after its jobs.

use std::{path::PathBuf, time::Duration};

use clap::{Args as ClapArgs, builder::NonEmptyStringValueParser};
use rtfarm_coordinator::Owner;

use super::{
    FARM, TALK,
    farm::{AccessArgs, LogArgs},
    picture::PictureArgs,
    values::{number, parse_seconds, whole_number},
};

#[derive(Debug, ClapArgs)]
pub(crate) struct SubmitArgs {
    #[command(flatten)]
    pub(crate) picture: PictureArgs,

    #[command(flatten)]
    pub(crate) coordinator: AccessArgs,

    /// Print the job's number and end: the job goes on by itself, and `rtfarm image` fetches what
    /// -o says. Otherwise an interruption cancels it.
    #[arg(long, conflicts_with = "sidecar", help_heading = FARM)]
    pub(crate) detach: bool,

    /// What the job is called; the scene's file by default.
    #[arg(long, value_name = "NAME", help_heading = FARM)]
    pub(crate) name: Option<String>,

    /// Who wants it; the user's login name by default. A token of an owner's own overrides it.
    #[arg(long, value_name = "OWNER", env = "RTFARM_OWNER", help_heading = FARM)]
    pub(crate) owner: Option<Owner>,

    /// Submit only once under this key: the job that the same order has already is taken for this
    /// one.
    #[arg(long, value_name = "KEY", value_parser = NonEmptyStringValueParser::new(), help_heading = FARM)]
    pub(crate) key: Option<String>,

    /// Jobs of a higher priority come first.
    #[arg(long, value_name = "N", default_value_t = 0, env = "RTFARM_PRIORITY", help_heading = FARM)]
    pub(crate) priority: i32,

    /// The most workers that render it at the same time.
    #[arg(long, value_name = "N", value_parser = whole_number::<u32>(1..=u32::MAX), env = "RTFARM_MAX_WORKERS", help_heading = FARM)]
    pub(crate) max_workers: Option<u32>,

    /// Answer in JSON.
    #[arg(long, help_heading = TALK)]
    pub(crate) json: bool,

    /// How long to go on without a coordinator once it was reached.
    #[arg(long, value_name = "S", default_value = "60", value_parser = parse_seconds, env = "RTFARM_PATIENCE", help_heading = FARM)]
    pub(crate) patience: Duration,

    #[command(flatten)]
    pub(crate) log: LogArgs,
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
    #[arg(value_name = "N", value_parser = number::<i32>("a whole number of at most nine digits"))]
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
