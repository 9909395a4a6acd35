//! `render --slurm`: workers that a cluster's Slurm starts, as the tasks of one array. They find
//! the coordinator by an access file in a folder of the picture's disk, which the nodes must share.

use std::{
    env,
    ffi::OsStr,
    fs,
    os::unix::process::CommandExt,
    path::Path,
    process::{Command, Stdio},
    str::FromStr,
    time::Duration,
};

use anyhow::{Context, bail};
use rtfarm_coordinator::{Limits, Listener, Security};
use rtfarm_proto::Address;
use rustix::system::uname;
use tokio::{
    task::spawn_blocking,
    time::{Instant, MissedTickBehavior, interval, sleep},
};

use crate::private_folder::PrivateFolder;

/// What each task of the array does.
const SCRIPT: &str = include_str!("../deploy/slurm/worker.sh");

/// How often Slurm is asked whether there are workers, or may be.
const LOOK: Duration = Duration::from_secs(5);

/// How long an array that was cancelled may take to be gone.
const GONE: Duration = Duration::from_secs(15);

/// How often it is asked after then.
const GONE_LOOK: Duration = Duration::from_millis(250);

/// Options of sbatch, as a shell would split them.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct SbatchOptions(Vec<String>);

impl FromStr for SbatchOptions {
    type Err = &'static str;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        shlex::split(text).map(Self).ok_or("a quotation mark is missing")
    }
}

/// Where the nodes find this machine.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Host {
    name: Option<String>,
    /// 0 is any.
    port: u16,
}

impl Host {
    /// By this machine's name, at any port.
    pub(crate) const HERE: Self = Self { name: None, port: 0 };
}

impl FromStr for Host {
    type Err = &'static str;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        // An IPv6 address has its colons in brackets.
        let colon = text.rfind(':').filter(|&colon| !text[colon..].contains(']'));
        let (name, port) = match colon {
            Some(colon) => (&text[..colon], text[colon + 1..].parse().ok()),
            None => (text, Some(0)),
        };
        match port {
            Some(port) if !name.is_empty() => Ok(Self { name: Some(name.to_owned()), port }),
            _ => Err("a host looks like login1, 10.0.0.1 or login1:7878"),
        }
    }
}

/// An array that is not submitted yet.
#[derive(Debug)]
pub(crate) struct Order {
    /// On the shared disk: the access files, the script and what the workers say.
    folder: PrivateFolder,
    options: SbatchOptions,
    patience: Duration,
}

/// An array of workers. It is cancelled when this goes.
#[derive(Debug)]
pub(crate) struct Array {
    id: String,
    folder: PrivateFolder,
}

impl Order {
    /// Opens a place for the workers to come to: answers also with where they come in.
    pub(crate) fn new(
        shared: &Path,
        options: SbatchOptions,
        host: Host,
        patience: Duration,
    ) -> anyhow::Result<(Self, Listener)> {
        let folder = PrivateFolder::new_for_many(shared)?;
        let listener = rtfarm_coordinator::listen(([0, 0, 0, 0], host.port).into())
            .with_context(|| format!("cannot listen on port {}", host.port))?;
        let here = || uname().nodename().to_string_lossy().into_owned();
        let name = host.name.unwrap_or_else(here);
        let address = Address::Tls(format!("{name}:{}", listener.local_addr()?.port()));
        let security = Security::open(folder.path(), &address)?;
        let order = Self { folder, options, patience };
        Ok((order, Listener::Tls(listener, security, Limits::default())))
    }

    /// Hands it to Slurm. This waits for sbatch, which must not be left alone with it.
    pub(crate) async fn submit(self) -> anyhow::Result<Array> {
        spawn_blocking(move || self.submit_now()).await?
    }

    fn submit_now(self) -> anyhow::Result<Array> {
        let Self { folder, options, patience } = self;
        let script = folder.path().join("worker.sh");
        fs::write(&script, SCRIPT).with_context(|| format!("cannot write {}", script.display()))?;
        let mut sbatch = command("sbatch");
        for (name, _) in env::vars_os() {
            // What it says is meant for what somebody starts.
            if name.as_encoded_bytes().starts_with(b"RTFARM_") {
                sbatch.env_remove(name);
            }
        }
        // A pattern for names of files has its own signs, so that the folder is not in it.
        sbatch.arg("--chdir").arg(folder.path()).arg("--output=worker-%a.log");
        sbatch.args(options.0).arg("--parsable").arg(script).arg(env::current_exe()?);
        sbatch.arg(folder.path().join("access/work"));
        sbatch.arg("--patience").arg(patience.as_secs_f64().to_string());
        let said = run(&mut sbatch)?;
        let id = said.trim().split(';').next().unwrap_or_default().to_owned();
        if id.is_empty() || !id.bytes().all(|byte| byte.is_ascii_digit()) {
            bail!("sbatch gave no job's number, but `{}`", said.trim());
        }
        tracing::info!(job = %id, "Slurm has the workers in its queue");
        Ok(Array { id, folder })
    }
}

impl Array {
    /// Returns when no worker is left and none will come, with what to say of it.
    pub(crate) async fn keep_up(&self) -> String {
        let mut looks = interval(LOOK);
        looks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            looks.tick().await;
            if self.is_queued().await == Some(false) {
                let said = self.last_words();
                return format!("no worker of Slurm's job {} is left{said}", self.id);
            }
        }
    }

    /// Cancels what is left, and waits until Slurm has forgotten it.
    pub(crate) async fn end(&self) {
        let id = self.id.clone();
        let cancelled = spawn_blocking(move || cancel(&id)).await;
        if let Ok(Err(error)) = cancelled {
            tracing::warn!(job = %self.id, reason = %error, "cannot cancel the workers in Slurm's queue");
            return;
        }
        let started = Instant::now();
        while started.elapsed() < GONE && self.is_queued().await == Some(true) {
            sleep(GONE_LOOK).await;
        }
    }

    /// Says whether some task runs or waits; `None` when Slurm does not answer.
    async fn is_queued(&self) -> Option<bool> {
        let queue =
            spawn_blocking(|| run(command("squeue").args(["--noheader", "--me", "--format=%F"])));
        let queue = queue.await.ok()?.ok()?;
        Some(queue.lines().any(|line| line.trim() == self.id))
    }

    /// What some worker said last, with the words that lead to it.
    fn last_words(&self) -> String {
        let logs = fs::read_dir(self.folder.path()).into_iter().flatten().flatten();
        let mut logs = logs
            .map(|entry| entry.path())
            .filter(|path| path.extension() == Some(OsStr::new("log")));
        let last = logs.find_map(|path| {
            let text = fs::read_to_string(path).ok()?;
            text.lines().rfind(|line| !line.trim().is_empty()).map(str::to_owned)
        });
        last.map(|line| format!("; one of them said: {line}")).unwrap_or_default()
    }
}

impl Drop for Array {
    fn drop(&mut self) {
        // A second time nobody minds.
        let _ = cancel(&self.id);
    }
}

fn cancel(id: &str) -> anyhow::Result<()> {
    run(command("scancel").args(["--quiet", id])).map(drop)
}

/// A command of Slurm. Ctrl-C is for this process alone.
fn command(name: &str) -> Command {
    let mut command = Command::new(name);
    command.process_group(0).stdin(Stdio::null());
    command
}

/// Runs a command to its good end; answers with what it said.
fn run(command: &mut Command) -> anyhow::Result<String> {
    let name = command.get_program().display().to_string();
    let output = command.output().with_context(|| format!("cannot run {name}"))?;
    if !output.status.success() {
        let said = String::from_utf8_lossy(&output.stderr);
        let words: Vec<&str> = said.split_whitespace().collect();
        bail!("{name} failed: {}", words.join(" "));
    }
    Ok(String::from_utf8_lossy(&output.stdout).into_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn options_are_split_as_a_shell_does() {
        let options: SbatchOptions = "--array=1-8 --comment 'two words'".parse().unwrap();
        assert_eq!(options.0, ["--array=1-8", "--comment", "two words"]);
        assert_eq!("".parse(), Ok(SbatchOptions(Vec::new())));
        "--comment 'two".parse::<SbatchOptions>().unwrap_err();
    }

    #[test]
    fn a_host_may_have_a_port() {
        let host = |name: &str, port| Ok(Host { name: Some(name.to_owned()), port });
        assert_eq!("login1".parse(), host("login1", 0));
        assert_eq!("10.0.0.1:7878".parse(), host("10.0.0.1", 7878));
        assert_eq!("[fe80::1]".parse(), host("[fe80::1]", 0));
        assert_eq!("[fe80::1]:1".parse(), host("[fe80::1]", 1));
        for bad in ["", ":1", "a:b", "a:70000"] {
            bad.parse::<Host>().expect_err(bad);
        }
    }
}
