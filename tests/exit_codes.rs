//! What a process ends with when it is given a file to read that it cannot use: 2, whatever the
//! command.

use std::{
    collections::BTreeSet,
    fs,
    io::{BufRead, BufReader},
    os::unix::fs::PermissionsExt,
    path::Path,
    process::{Child, Command, Stdio},
};

/// Each command that reads a file, `FILE`; those that read none are `FREE`.
const COMMANDS: &[&str] = &[
    "render FILE -o out.png",
    "render FILE -o out.png --workers 0",
    "render FILE -o out.png --resume",
    "submit FILE -o out.png --coordinator unix:socket",
    "submit scene.rt -o out.png --access FILE",
    "worker --access FILE",
    "jobs --access FILE",
    "workers --access FILE",
    "watch 1 --access FILE",
    "image 1 -o out.png --access FILE",
    "explain 1 1 --access FILE",
    "cancel 1 --access FILE",
    "pause 1 --access FILE",
    "resume 1 --access FILE",
    "priority 1 1 --access FILE",
    "retry 1 --access FILE",
    "drain 1 --access FILE",
    "disable 1 --access FILE",
    "enable 1 --access FILE",
    "tokens renew work --state FILE",
    "tokens revoke work --state FILE",
    "tokens revoke submit --owner ada --state FILE",
    "verify FILE scene.rt",
    "verify picture.png FILE",
    "check FILE",
    "check FILE --json",
    "report FILE",
];

/// They read nothing: a state's folder is made if it is not there.
const FREE: &[&str] = &["coordinator", "certs", "completions", "man", "help"];

const SCENE: &str = "\
viewport  origin 0 0 5  topleft -1 1 0  bottomleft -1 -1 0  topright 1 1 0  endviewport
materials  entry  name a  endentry  endmaterials
geometry  sphere  coords 0 0 0  radius 1  material a  endsphere  endgeometry
";

/// Runs a command in a folder to its end: its exit code, standard error and standard output.
fn run(folder: &Path, words: &[&str]) -> (Option<i32>, String, String) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_rtfarm"));
    let output = command.args(words).current_dir(folder).output().unwrap();
    let [stderr, stdout] =
        [output.stderr, output.stdout].map(|text| String::from_utf8(text).unwrap());
    (output.status.code(), stderr, stdout)
}

/// A process that ends with the test.
struct Killed(Child);

impl Drop for Killed {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

#[test]
fn a_file_to_read_that_cannot_be_used_ends_every_command_with_2_and_its_name() {
    // Others may not enter it, so that a socket can be there.
    let own = fs::Permissions::from_mode(0o700);
    let folder = tempfile::Builder::new().permissions(own).tempdir().unwrap();
    let run = |words: &str| run(folder.path(), &words.split(' ').collect::<Vec<_>>());
    fs::write(folder.path().join("scene.rt"), SCENE).unwrap();
    let (code, said, _) = run("render scene.rt -o picture.png --size 8x8");
    assert_eq!(code, Some(0), "{said}");
    let mut coordinator = Command::new(env!("CARGO_BIN_EXE_rtfarm"));
    coordinator.args(["coordinator", "--listen", "unix:socket"]).current_dir(folder.path());
    let coordinator = coordinator.stdout(Stdio::piped()).stderr(Stdio::null()).spawn();
    let mut coordinator = Killed(coordinator.unwrap());
    let mut line = String::new();
    BufReader::new(coordinator.0.stdout.take().unwrap()).read_line(&mut line).unwrap();
    assert_eq!(line, "listening on unix:socket\n");
    fs::create_dir(folder.path().join("folder")).unwrap();
    fs::write(folder.path().join("empty"), "").unwrap();
    fs::write(folder.path().join("noise"), [0xff, 0, 7, 0x80].repeat(1000)).unwrap();
    for shape in COMMANDS {
        for file in ["missing", "folder", "empty", "noise", "scene.rt/below"] {
            let words = shape.replace("FILE", file);
            let (code, said, answer) = run(&words);
            assert_eq!(code, Some(2), "{words}: {said}");
            // `check --json` answers with what is wrong.
            let said = said + &answer;
            assert!(said.contains(file), "{words}: {said}");
            assert!(!said.contains("panicked"), "{words}: {said}");
        }
    }

    let (_, _, help) = run("--help");
    let (_, listed) = help.split_once("Commands:\n").unwrap();
    let listed = listed.lines().take_while(|line| !line.is_empty());
    let listed: BTreeSet<&str> = listed.filter_map(|line| line.split_whitespace().next()).collect();
    let tried = COMMANDS.iter().map(|shape| shape.split(' ').next().unwrap());
    assert_eq!(listed, tried.chain(FREE.iter().copied()).collect(), "every command is tried here");
}

#[test]
fn nonsense_is_told_in_words_that_say_what_is_wanted() {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("scene.rt"), SCENE).unwrap();
    let farm = "http://127.0.0.1:9";
    for (words, code, reason) in [
        (
            vec!["coordinator", "--listen", "127.0.0.1:0", "--state", "s", "--name", "a b"],
            2,
            "error: `https://a b:",
        ),
        (
            vec!["watch", "x", "--coordinator", farm],
            2,
            "it must be a job's number, as `rtfarm jobs` lists it",
        ),
        (vec!["explain", "1", "x", "--coordinator", farm], 2, "it must be a tile's number, from 0"),
        (
            vec!["drain", "1.5", "--coordinator", farm],
            2,
            "it must be a worker's number, as `rtfarm workers`",
        ),
        (vec!["priority", "1", "high", "--coordinator", farm], 2, "it must be a whole number"),
        (
            vec!["report", "scene.rt", "--out", "scene.rt"],
            1,
            "error: cannot write into the folder scene.rt: ",
        ),
        (
            vec!["jobs", "--coordinator", "unix:nothing"],
            1,
            "error: no coordinator answers at unix:nothing: No such file or directory (os error 2)\n",
        ),
    ] {
        let (found, said, _) = run(folder.path(), &words);
        assert_eq!(found, Some(code), "{words:?}: {said}");
        assert!(said.contains(reason), "{words:?}: {said}");
        assert_eq!(said.lines().count(), 1, "{words:?}: {said}");
    }
}
