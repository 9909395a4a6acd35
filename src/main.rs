//! The command line: arguments, errors, exit codes.

mod args;
mod cache;
mod check;
mod children;
mod console;
mod console_queue;
mod coordinator;
mod failure;
mod footer;
mod frames;
mod image;
mod local;
mod manual;
mod memory;
mod output;
mod pilot;
mod preview;
mod private_folder;
mod queue;
mod render;
mod report;
mod resume;
mod scene_files;
mod show;
mod sidecar;
mod slurm;
mod source;
mod submit;
mod terminal;
mod verify;
mod worker;

use std::process::ExitCode;

use rtfarm_proto::wire::{Nothing, Standing, control_request::Change};
use tokio::signal::unix::{SignalKind, signal};
use tokio_util::sync::CancellationToken;

use crate::{
    args::{Args, Command, ExplainArgs, JobArgs, PriorityArgs, StationArgs},
    console::Console,
    failure::Failure,
    queue::Wish,
};

/// The version that both ends of a farm must have.
const VERSION: &str = env!("CARGO_PKG_VERSION");

/// Of the sources that pixels depend on, which coordinator and workers must share; see `build.rs`.
const BUILD: &str = env!("RTFARM_BUILD");

#[global_allocator]
static ALLOCATOR: memory::LargePages = memory::LargePages;

fn main() -> ExitCode {
    memory::return_what_is_freed();
    let args = match Args::read() {
        Ok(args) => args,
        Err(error) => return failure::explain_usage(&error),
    };
    let console = Console::new(&args);
    let runtime =
        tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build();
    let runtime = match runtime {
        Ok(runtime) => runtime,
        Err(error) => {
            let code = Failure::from(error).tell(&console);
            console.close();
            return code;
        }
    };
    // Local workers are started from this very thread, at whose end they would be killed.
    let result = runtime.block_on(run(args.command, &console));
    // What still blocks, such as a scene being read, is of no use to anyone.
    runtime.shutdown_background();
    let code = match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => failure.tell(&console),
    };
    console.close();
    code
}

async fn run(command: Command, console: &Console) -> Result<(), Failure> {
    let Signals { stop, terminate } = Signals::listen()?;
    match command {
        Command::Render(args) => render::run(args, console, &stop).await,
        Command::Coordinator(args) => coordinator::run(args, console, &stop, &terminate).await,
        Command::Worker(args) => worker::run(args, &stop, &terminate).await,
        Command::Submit(args) => submit::run(args, console, &stop).await,
        Command::Image(args) => image::run(args, &stop).await,
        Command::Watch(args) => queue::watch(args, console, &stop).await,
        Command::Jobs(args) => queue::run(args, Wish::Jobs, &stop).await,
        Command::Workers(args) => queue::run(args, Wish::Workers, &stop).await,
        Command::Cancel(args) => queue::run(args.farm, Wish::Cancel(args.job), &stop).await,
        Command::Explain(ExplainArgs { job: JobArgs { job, farm }, tile }) => {
            queue::run(farm, Wish::Explain(job, tile), &stop).await
        }
        Command::Pause(JobArgs { job, farm }) => {
            queue::run(farm, Wish::Change(job, Change::Paused(true)), &stop).await
        }
        Command::Resume(JobArgs { job, farm }) => {
            queue::run(farm, Wish::Change(job, Change::Paused(false)), &stop).await
        }
        Command::Priority(PriorityArgs { job: JobArgs { job, farm }, priority }) => {
            queue::run(farm, Wish::Change(job, Change::Priority(priority)), &stop).await
        }
        Command::Retry(JobArgs { job, farm }) => {
            queue::run(farm, Wish::Change(job, Change::Retry(Nothing {})), &stop).await
        }
        Command::Drain(StationArgs { worker, farm }) => {
            queue::run(farm, Wish::Station(worker, Standing::Draining), &stop).await
        }
        Command::Disable(StationArgs { worker, farm }) => {
            queue::run(farm, Wish::Station(worker, Standing::Disabled), &stop).await
        }
        Command::Enable(StationArgs { worker, farm }) => {
            queue::run(farm, Wish::Station(worker, Standing::Active), &stop).await
        }
        Command::Certs(args) => coordinator::make_certificates(&args),
        Command::Tokens(args) => coordinator::change_tokens(&args),
        Command::Report(args) => report::run(args, console, &stop).await,
        Command::Verify(args) => verify::run(args, &stop).await,
        Command::Check(args) => check::run(args, console, &stop).await,
        Command::Completions(args) => manual::write_completions(&args),
        Command::Man(args) => manual::write_pages(&args),
    }
}

/// Tokens that are cancelled when somebody wants this process to end.
struct Signals {
    stop: CancellationToken,
    /// Cancelled before `stop` by SIGTERM, by which a service is ended in good order.
    terminate: CancellationToken,
}

impl Signals {
    /// Listens from now on. An interruption of a process that is to end already ends it at once.
    fn listen() -> Result<Self, Failure> {
        let (stop, terminate) = (CancellationToken::new(), CancellationToken::new());
        let [interrupt, quit] = [SignalKind::interrupt(), SignalKind::quit()];
        for kind in [interrupt, quit, SignalKind::terminate(), SignalKind::hangup()] {
            let mut signals = signal(kind)?;
            let (stop, terminate) = (stop.clone(), terminate.clone());
            tokio::spawn(async move {
                while signals.recv().await.is_some() {
                    if stop.is_cancelled() && [interrupt, quit].contains(&kind) {
                        std::process::exit(failure::INTERRUPTED.into());
                    }
                    if kind == SignalKind::terminate() {
                        terminate.cancel();
                    }
                    stop.cancel();
                }
            });
        }
        Ok(Self { stop, terminate })
    }
}
