//! Local workers: this very program, started again, and always reaped.

use std::{
    env, io,
    os::unix::process::ExitStatusExt,
    process::{ExitStatus, Stdio},
    time::Duration,
};

use rtfarm_coordinator::Coordinator;
use rtfarm_core::isa::Isa;
use rtfarm_proto::Address;
use rustix::process::{Pid, Signal, kill_process};
use tokio::{
    io::{AsyncBufReadExt, BufReader},
    process::{Child, Command},
    task::JoinSet,
    time::timeout,
};
use tokio_util::sync::CancellationToken;

use crate::{args::LogFormat, console::Console};

/// A worker that was sent home may take this long.
const GO_HOME: Duration = Duration::from_millis(400);

/// A worker that was told to end may take this long.
const END: Duration = Duration::from_millis(600);

/// How a local worker is started.
#[derive(Debug)]
pub(crate) struct Setup {
    pub(crate) coordinator: Address,
    pub(crate) threads: usize,
    pub(crate) isa: Isa,
    pub(crate) log_format: LogFormat,
}

/// The local workers of a render.
#[derive(Debug)]
pub(crate) struct Children {
    watchers: JoinSet<Option<Exit>>,
    end: CancellationToken,
}

/// A process that ended.
#[derive(Debug)]
struct Exit {
    process: u32,
    reason: String,
}

impl Children {
    /// Starts so many workers. Call it on a thread that stays: they die with it.
    pub(crate) fn start(count: usize, setup: &Setup, console: &Console) -> io::Result<Self> {
        let mut children = Self { watchers: JoinSet::new(), end: CancellationToken::new() };
        for _ in 0..count {
            let child = start(setup)?;
            children.watchers.spawn(watch(child, console.clone(), children.end.clone()));
        }
        Ok(children)
    }

    /// Tells `coordinator` of every worker that dies. Returns when none is left, with the last
    /// one's reason.
    pub(crate) async fn watch(&mut self, coordinator: &Coordinator) -> String {
        let mut reason = "there were none".to_owned();
        while let Some(exit) = self.watchers.join_next().await {
            if let Ok(Some(exit)) = exit {
                coordinator.on_process_exit(exit.process, &exit.reason);
                reason = exit.reason;
            }
        }
        reason
    }

    /// Waits for the workers to go home, then ends those that do not; a stopped one is killed.
    pub(crate) async fn go_home(&mut self, coordinator: &Coordinator) {
        if timeout(GO_HOME, self.watch(coordinator)).await.is_err() {
            self.end(coordinator).await;
        }
    }

    /// Ends every worker now.
    pub(crate) async fn end(&mut self, coordinator: &Coordinator) {
        self.end.cancel();
        self.watch(coordinator).await;
    }
}

fn start(setup: &Setup) -> io::Result<Child> {
    Command::new(env::current_exe()?)
        .arg("worker")
        .args(["--coordinator", &setup.coordinator.to_string()])
        .args(["--threads", &setup.threads.to_string()])
        .args(["--isa", &setup.isa.to_string()])
        .args(["--log-format", &setup.log_format.to_string()])
        .args(["--parent", &std::process::id().to_string()])
        // Ctrl-C is for this process, which tells the workers in good order.
        .process_group(0)
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .kill_on_drop(true)
        .spawn()
}

/// Waits for a worker's end; what it says meanwhile goes to the console.
async fn watch(mut child: Child, console: Console, end: CancellationToken) -> Option<Exit> {
    let process = child.id()?;
    if let Some(stderr) = child.stderr.take() {
        tokio::spawn(async move {
            let mut lines = BufReader::new(stderr).lines();
            while let Ok(Some(line)) = lines.next_line().await {
                console.tell(&line);
            }
        });
    }
    let status = tokio::select! {
        status = child.wait() => status,
        () = end.cancelled() => {
            if let Some(pid) = i32::try_from(process).ok().and_then(Pid::from_raw) {
                // It may be gone already.
                let _ = kill_process(pid, Signal::TERM);
            }
            match timeout(END, child.wait()).await {
                Ok(status) => status,
                Err(_) => match child.start_kill() {
                    Ok(()) => child.wait().await,
                    Err(error) => Err(error),
                },
            }
        }
    };
    let reason = match status {
        Ok(status) => describe(status),
        Err(error) => format!("cannot be waited for: {error}"),
    };
    Some(Exit { process, reason })
}

fn describe(status: ExitStatus) -> String {
    match (status.signal(), status.code()) {
        (Some(signal), _) => format!("killed by signal {signal}"),
        (None, Some(code)) => format!("exited with code {code}"),
        (None, None) => status.to_string(),
    }
}
