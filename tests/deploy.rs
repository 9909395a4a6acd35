//! What `deploy/` has for machines and containers, as far as this machine can try it.

use std::{
    fs,
    net::TcpListener,
    path::{Path, PathBuf},
    process::{Child, Command, Output},
    thread,
    time::Duration,
};

use rustix::process::{Pid, Signal, kill_process};

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// Runs a command; `None` where there is no such program.
fn run(command: &mut Command) -> Option<Output> {
    let output = command.output().ok();
    if output.is_none() {
        eprintln!("SKIPPED: {} is missing", command.get_program().display());
    }
    output
}

#[test]
fn the_units_are_well_formed_and_open_to_little() {
    let folder = tempfile::tempdir().unwrap();
    let mut units = Vec::new();
    for entry in fs::read_dir(root().join("deploy/systemd")).unwrap() {
        let path = entry.unwrap().path();
        let text = fs::read_to_string(&path).unwrap();
        let text = text.replace("/usr/local/bin/rtfarm", env!("CARGO_BIN_EXE_rtfarm"));
        // The program still knows the words.
        let start = text.lines().find_map(|line| line.strip_prefix("ExecStart=")).unwrap();
        let mut words = start.split(' ');
        let help = Command::new(words.next().unwrap()).args(words).arg("--help").output();
        assert!(help.unwrap().status.success(), "{start}");
        let unit = folder.path().join(path.file_name().unwrap());
        fs::write(&unit, text).unwrap();
        units.push(unit);
    }
    assert_eq!(units.len(), 2);
    for words in [&["verify"][..], &["security", "--offline=true", "--threshold=20"]] {
        for unit in &units {
            let Some(output) = run(Command::new("systemd-analyze").args(words).arg(unit)) else {
                return;
            };
            assert!(output.status.success(), "{words:?} {}: {output:?}", unit.display());
        }
    }
}

/// A machine of its own, whose first process is systemd, and the units that are started there.
struct Machine {
    script: Child,
    folder: tempfile::TempDir,
}

impl Drop for Machine {
    fn drop(&mut self) {
        let _ = kill_process(Pid::from_child(&self.script), Signal::TERM);
        let _ = self.script.wait();
    }
}

impl Machine {
    /// `None` where the user or the machine cannot run one.
    fn start(units: &[PathBuf], port: u16) -> Option<Self> {
        let mounts = fs::read_to_string("/proc/mounts").unwrap_or_default();
        let is_able = rustix::process::geteuid().is_root()
            && Path::new("/lib/systemd/systemd").exists()
            && mounts.lines().any(|mount| mount.starts_with("cgroup2 "));
        if !is_able {
            eprintln!("SKIPPED: units are started by root, with systemd and cgroup2");
            return None;
        }
        let folder = tempfile::tempdir().unwrap();
        for name in ["bin", "etc", "lib"] {
            fs::create_dir(folder.path().join(name)).unwrap();
        }
        fs::copy(env!("CARGO_BIN_EXE_rtfarm"), folder.path().join("bin/rtfarm")).unwrap();
        let listen = format!("RTFARM_LISTEN=127.0.0.1:{port}\n");
        fs::write(folder.path().join("etc/coordinator"), listen).unwrap();
        let mut command = Command::new(root().join("tests/systemd-machine"));
        let script = command.arg(folder.path()).args(units).spawn().unwrap();
        Some(Self { script, folder })
    }

    /// The process that a unit has now.
    fn process(&self, unit: &str) -> Option<Pid> {
        let group = format!("/rtfarm.{}/system.slice/{unit}\n", self.script.id());
        let processes = fs::read_dir("/proc").unwrap().filter_map(Result::ok);
        let mut numbers = processes.filter_map(|entry| entry.file_name().to_str()?.parse().ok());
        let number = numbers.find(|number: &i32| {
            let found = fs::read_to_string(format!("/proc/{number}/cgroup")).unwrap_or_default();
            found.ends_with(&group)
        });
        number.and_then(Pid::from_raw)
    }
}

/// Asks until there is an answer.
fn poll<T>(mut ask: impl FnMut() -> Option<T>) -> T {
    for _ in 0..1200 {
        if let Some(answer) = ask() {
            return answer;
        }
        thread::sleep(Duration::from_millis(50));
    }
    panic!("nothing happened for a minute");
}

#[test]
#[ignore = "needs root and systemd; .ci/run runs it"]
fn units_are_started_by_systemd_as_they_are_and_come_back_when_they_are_killed() {
    let units = ["rtfarm-coordinator.service", "rtfarm-worker.service"];
    let files = units.map(|unit| root().join("deploy/systemd").join(unit));
    let port = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    let Some(machine) = Machine::start(&files, port) else { return };
    let place = |name: &str| machine.folder.path().join(name);
    let access = |role: &str| place("lib/private/rtfarm/access").join(role);
    poll(|| access("submit").exists().then_some(()));
    // The worker starts again and again until it has it.
    fs::copy(access("work"), place("etc/work")).unwrap();
    let ask = |words: &[&str], role: &str| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_rtfarm"));
        let output = command.args(words).arg("--access").arg(access(role)).output().unwrap();
        output.status.success().then(|| String::from_utf8(output.stdout).unwrap())
    };
    let scene = root().join("scenes/lights.rt");
    let picture = |name: &str| {
        let out = place(name).to_str().unwrap().to_owned();
        let words = ["submit", scene.to_str().unwrap(), "-o", &out, "--size", "96x64"];
        poll(|| ask(&words, "submit"));
        fs::read(out).unwrap()
    };
    let has_worker =
        || ask(&["workers", "--json"], "read").is_some_and(|said| said.contains("host"));
    poll(|| has_worker().then_some(()));
    let first = picture("first.png");
    for unit in units {
        let killed = machine.process(unit).unwrap();
        kill_process(killed, Signal::KILL).unwrap();
        poll(|| machine.process(unit).filter(|process| *process != killed));
    }
    assert!(picture("second.png") == first);
    let mut here = Command::new(env!("CARGO_BIN_EXE_rtfarm"));
    let words = ["render", "--size", "96x64", "--workers", "0", "--quiet", "-o"];
    assert!(here.args(words).arg(place("here.png")).arg(&scene).status().unwrap().success());
    assert!(fs::read(place("here.png")).unwrap() == first);
}

/// The folder with the program that needs nothing of its system; `deploy/Containerfile` says how it
/// is made.
fn static_program() -> Option<PathBuf> {
    let target = root().join("target/x86_64-unknown-linux-gnu/release");
    let is_there = target.join("rtfarm").exists();
    if !is_there {
        eprintln!("SKIPPED: there is no static program; deploy/Containerfile says how it is made");
    }
    is_there.then_some(target)
}

/// What `buildah` keeps, in a folder of its own.
struct Store {
    folder: tempfile::TempDir,
}

impl Store {
    fn output(&self, words: &[&str]) -> Option<Output> {
        let mut command = Command::new("buildah");
        let place = |name: &str| self.folder.path().join(name);
        command.args(["--storage-driver", "vfs", "--root"]).arg(place("root"));
        command.arg("--runroot").arg(place("run")).args(words);
        run(&mut command)
    }

    /// Runs a command to its good end; answers with what it said.
    fn run(&self, words: &[&str]) -> Option<String> {
        let output = self.output(words)?;
        assert!(output.status.success(), "{words:?}: {output:?}");
        Some(String::from_utf8(output.stdout).unwrap().trim().to_owned())
    }
}

#[test]
#[ignore = "needs buildah and a static program; .ci/run runs it"]
fn an_image_with_nothing_but_the_program_renders_the_same_bytes() {
    let Some(target) = static_program() else { return };
    let store = Store { folder: tempfile::tempdir().unwrap() };
    if store.run(&["--version"]).is_none() {
        return;
    }
    // Nothing else of the folder goes along.
    let context = store.folder.path().join("context");
    fs::create_dir(&context).unwrap();
    fs::copy(target.join("rtfarm"), context.join("rtfarm")).unwrap();
    let file = root().join("deploy/Containerfile");
    let build = ["build", "--isolation", "chroot", "--tag", "rtfarm", "--file"];
    store.run(&[&build[..], &[file.to_str().unwrap(), context.to_str().unwrap()]].concat());
    let container = store.run(&["from", "rtfarm"]).unwrap();

    let data = store.folder.path().join("data");
    fs::create_dir_all(data.join("tmp")).unwrap();
    fs::copy(root().join("scenes/lights.rt"), data.join("scene.rt")).unwrap();
    let volume = format!("{}:/data", data.display());
    let tmp = format!("{}:/tmp", data.join("tmp").display());
    let start = ["run", "--isolation", "chroot", "--user", "0", "-v", &volume, "-v", &tmp];
    let picture = ["render", "--size", "96x64", "--workers", "2", "--quiet"];
    let there = ["/data/scene.rt", "-o", "/data/there.png"];
    store.run(&[&start[..], &[&container, "--", "/rtfarm"], &picture, &there].concat());
    // Of the same build: a picture's file tells which it was.
    let here = Command::new(target.join("rtfarm"))
        .args(picture)
        .args(["scene.rt", "-o", "here.png"])
        .current_dir(&data)
        .status();
    assert!(here.unwrap().success());
    let bytes = |name: &str| fs::read(data.join(name)).unwrap();
    assert!(bytes("there.png") == bytes("here.png"));
    // It finds hosts by their names, though no library of its system is there.
    let ask = ["jobs", "--coordinator", "http://localhost:9"];
    let words = [&start[..], &[&container, "--", "/rtfarm"], &ask].concat();
    let said = String::from_utf8(store.output(&words).unwrap().stderr).unwrap();
    assert!(said.contains("Connection refused"), "{said}");
}
