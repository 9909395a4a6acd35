//! Local workers: this very program, started again, and always reaped.

use std::{
    collections::BTreeMap,
    env, fs, io,
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
    time::{MissedTickBehavior, interval, timeout},
};
use tokio_util::sync::CancellationToken;

use crate::{args::LogFormat, console::Console};

/// A worker that was sent home may take this long.
const GO_HOME: Duration = Duration::from_millis(400);

/// A worker that was told to end may take this long.
const END: Duration = Duration::from_millis(600);

/// So many workers may be replaced, for each that there is to be.
const REPLACEMENTS: usize = 3;

/// How often the workers are looked at.
const LOOK: Duration = Duration::from_secs(1);

/// A worker that was seen stopped so many times on end is killed.
const MOST_LOOKS_STOPPED: u32 = 5;

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
    setup: Setup,
    console: Console,
    /// How many may still be started in place of others.
    replacements_left: usize,
    /// The processes, and how many times on end each was seen stopped.
    looks_stopped: BTreeMap<u32, u32>,
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
    pub(crate) fn start(count: usize, setup: Setup, console: &Console) -> io::Result<Self> {
        let mut children = Self {
            setup,
            console: console.clone(),
            replacements_left: REPLACEMENTS * count,
            looks_stopped: BTreeMap::new(),
            watchers: JoinSet::new(),
            end: CancellationToken::new(),
        };
        for _ in 0..count {
            children.add()?;
        }
        Ok(children)
    }

    fn add(&mut self) -> io::Result<()> {
        let child = start(&self.setup)?;
        self.looks_stopped.extend(child.id().map(|process| (process, 0)));
        self.watchers.spawn(watch(child, self.console.clone(), self.end.clone()));
        Ok(())
    }

    /// Tells `coordinator` of every worker that dies and starts another in its place, a limited
    /// number of times; one that stays stopped is killed. Returns when no worker is left, or none
    /// has done anything for so long as `patience`, with what to say of it. Await it on the thread
    /// that has started the first workers.
    pub(crate) async fn keep_up(
        &mut self,
        coordinator: &Coordinator,
        patience: Duration,
    ) -> String {
        let mut looks = interval(LOOK);
        // Time in which this process is suspended itself is nobody's fault.
        looks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let (mut last_seen, mut idle) = (0, Duration::ZERO);
        loop {
            tokio::select! {
                exit = self.watchers.join_next() => {
                    let Some(exit) = exit else { return "there are no workers".to_owned() };
                    let Ok(Some(exit)) = exit else { continue };
                    if let Some(end) = self.on_exit(&exit, coordinator) {
                        return end;
                    }
                }
                _ = looks.tick() => {
                    let seen = self.look();
                    idle = if seen == last_seen { idle + LOOK } else { Duration::ZERO };
                    last_seen = seen;
                    if idle >= patience {
                        let seconds = patience.as_secs_f64();
                        return format!("no worker has done anything for {seconds:.1} s");
                    }
                }
            }
        }
    }

    /// Replaces a worker; answers with what to say when none is left.
    fn on_exit(&mut self, exit: &Exit, coordinator: &Coordinator) -> Option<String> {
        coordinator.on_process_exit(exit.process, &exit.reason);
        self.looks_stopped.remove(&exit.process);
        let Exit { process, reason } = exit;
        if self.replacements_left > 0 {
            self.replacements_left -= 1;
            let left = self.replacements_left;
            tracing::warn!(process, reason, left, "a worker is dead; another takes its place");
            if let Err(error) = self.add() {
                tracing::warn!(reason = %error, "cannot start a worker");
            }
        }
        let is_last = self.watchers.is_empty();
        is_last.then(|| format!("all workers are dead; the last one: {reason}"))
    }

    /// Kills workers that stay stopped. Answers with the time that all have had on a processor,
    /// which grows as long as any does something.
    fn look(&mut self) -> u64 {
        let mut ticks = 0;
        for (&process, looks_stopped) in &mut self.looks_stopped {
            let Some(state) = ProcessState::of(process) else { continue };
            ticks += state.ticks;
            *looks_stopped = if state.is_stopped { *looks_stopped + 1 } else { 0 };
            if *looks_stopped == MOST_LOOKS_STOPPED {
                tracing::warn!(process, "a worker stays stopped and is killed");
                signal(process, Signal::KILL);
            }
        }
        ticks
    }

    /// Waits until every worker has ended, and tells `coordinator` of each.
    async fn wait(&mut self, coordinator: &Coordinator) {
        while let Some(exit) = self.watchers.join_next().await {
            if let Ok(Some(exit)) = exit {
                coordinator.on_process_exit(exit.process, &exit.reason);
            }
        }
    }

    /// Waits for the workers to go home, then ends those that do not; a stopped one is killed.
    pub(crate) async fn go_home(&mut self, coordinator: &Coordinator) {
        if timeout(GO_HOME, self.wait(coordinator)).await.is_err() {
            self.end(coordinator).await;
        }
    }

    /// Ends every worker now.
    pub(crate) async fn end(&mut self, coordinator: &Coordinator) {
        self.end.cancel();
        self.wait(coordinator).await;
    }
}

/// Has glibc keep what a tile's buffers took for the next tile. It would give it back to the
/// system, and fault it in again page by page: a fifth of a cheap picture's processor time.
const MALLOC: [(&str, &str); 2] =
    [("MALLOC_MMAP_THRESHOLD_", "33554432"), ("MALLOC_TRIM_THRESHOLD_", "67108864")];

fn start(setup: &Setup) -> io::Result<Child> {
    let mut command = Command::new(env::current_exe()?);
    for (name, _) in env::vars_os() {
        // What it says is meant for workers that somebody starts.
        if name.as_encoded_bytes().starts_with(b"RTFARM_") {
            command.env_remove(name);
        }
    }
    command
        .arg("worker")
        .args(["--coordinator", &setup.coordinator.to_string()])
        .args(["--threads", &setup.threads.to_string()])
        .args(["--isa", &setup.isa.to_string()])
        .args(["--log-format", &setup.log_format.to_string()])
        .args(["--parent", &std::process::id().to_string()])
        .envs(MALLOC)
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
            signal(process, Signal::TERM);
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

/// Signals a process; it may be gone already.
fn signal(process: u32, signal: Signal) {
    if let Some(pid) = i32::try_from(process).ok().and_then(Pid::from_raw) {
        let _ = kill_process(pid, signal);
    }
}

/// What the system tells of a process.
struct ProcessState {
    is_stopped: bool,
    /// The time that it has had on a processor, in the system's ticks.
    ticks: u64,
}

impl ProcessState {
    /// `None` when there is no such process.
    fn of(process: u32) -> Option<Self> {
        let line = fs::read_to_string(format!("/proc/{process}/stat")).ok()?;
        // The name before may have any characters in it. See proc_pid_stat(5).
        let fields: Vec<&str> = line.rsplit_once(')')?.1.split_whitespace().collect();
        let ticks = |index: usize| fields.get(index)?.parse::<u64>().ok();
        Some(Self { is_stopped: *fields.first()? == "T", ticks: ticks(11)? + ticks(12)? })
    }
}

fn describe(status: ExitStatus) -> String {
    match (status.signal(), status.code()) {
        (Some(signal), _) => format!("killed by signal {signal}"),
        (None, Some(code)) => format!("exited with code {code}"),
        (None, None) => status.to_string(),
    }
}
