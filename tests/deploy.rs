//! What `deploy/` has for machines and containers, as far as this machine can try it.

use std::{
    fs,
    path::{Path, PathBuf},
    process::{Command, Output},
};

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

/// The folder with the program that needs nothing of its system; `deploy/Containerfile` says how it is
/// made.
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
