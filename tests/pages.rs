//! The pages for people, `docs/*.md`, tried as they stand.
//!
//! A block ```` ```rt NAME ```` is saved as a file, ```` ```rt + NAME ```` added to one. Lines of a
//! ```` ```console ```` block that begin with `$ ` are run, one after the other, in the page's own
//! folder; the lines below one must be among what it says, in that order, whatever the numbers. A
//! comment `# exit code N` at a command's end says how it ends, otherwise it is well. One that ends with
//! `&` runs until the page ends; the next waits until it has said its lines. A ```` ```slurm ```` block is
//! one for a cluster, whose `SLURM_CONF` the environment must name:
//!
//!     tests/slurm-cluster start /tmp/cluster
//!     SLURM_CONF=/tmp/cluster/slurm.conf cargo test --test pages
//!     tests/slurm-cluster stop /tmp/cluster

use std::{
    env,
    fmt::Write as _,
    fs::{self, File, OpenOptions},
    io::Write as _,
    path::Path,
    process::{Child, Command, Stdio},
    thread,
    time::Duration,
};

use rustix::process::{Pid, Signal, kill_process};

/// A command of a page, and what the page says comes of it.
struct Shown<'a> {
    command: &'a str,
    exit_code: i32,
    lines: Vec<&'a str>,
}

/// A fenced block: what stands behind the fence, and its lines.
fn blocks(page: &str) -> Vec<(&str, Vec<&str>)> {
    let mut blocks = Vec::new();
    let mut lines = page.lines();
    while let Some(line) = lines.next() {
        if let Some(kind) = line.strip_prefix("```") {
            blocks.push((kind, lines.by_ref().take_while(|line| *line != "```").collect()));
        }
    }
    blocks
}

fn shown<'a>(lines: &[&'a str]) -> Vec<Shown<'a>> {
    let mut all: Vec<Shown<'a>> = Vec::new();
    for line in lines {
        if let Some(command) = line.strip_prefix("$ ") {
            let exit_code = command
                .split_once("# exit code ")
                .map_or(0, |(_, code)| code.trim().parse().expect("a number"));
            all.push(Shown { command, exit_code, lines: Vec::new() });
        } else {
            all.last_mut().expect("a command comes first").lines.push(line);
        }
    }
    all
}

/// The line with each number as `#`.
fn without_numbers(line: &str) -> String {
    let mut told = String::new();
    let mut in_number = false;
    for (at, letter) in line.char_indices() {
        let goes_on = in_number
            && (matches!(letter, '.' | 'e' | '-')
                && line[at + letter.len_utf8()..]
                    .starts_with(|next: char| next.is_ascii_digit() || next == '-'));
        if letter.is_ascii_digit() || goes_on {
            if !in_number {
                told.push('#');
            }
            in_number = true;
        } else {
            in_number = false;
            told.push(letter);
        }
    }
    told
}

/// What runs in the background while a page is tried.
struct Background(Vec<Child>);

impl Drop for Background {
    fn drop(&mut self) {
        // Workers go before their coordinator.
        for child in self.0.iter_mut().rev() {
            let _ = kill_process(Pid::from_child(child), Signal::TERM);
            let _ = child.wait();
        }
    }
}

/// Which of the lines that a page shows is not among what was said; `None` when all are.
fn unsaid<'a>(said: &str, lines: &[&'a str]) -> Option<&'a str> {
    let mut told = said.lines().map(without_numbers);
    lines.iter().copied().find(|line| {
        let wanted = without_numbers(line);
        !told.any(|line| line.ends_with(&wanted))
    })
}

/// What is wrong with a page, if anything is.
fn try_page(page: &str) -> Result<usize, String> {
    let folder = tempfile::tempdir().unwrap();
    let program = Path::new(env!("CARGO_BIN_EXE_rtfarm")).parent().unwrap();
    let path = env::join_paths(
        [program.to_owned()].into_iter().chain(env::split_paths(&env::var_os("PATH").unwrap())),
    )
    .unwrap();
    let deploy = Path::new(env!("CARGO_MANIFEST_DIR")).join("deploy");
    std::os::unix::fs::symlink(deploy, folder.path().join("deploy")).unwrap();
    let (mut count, mut background) = (0, Background(Vec::new()));
    for (kind, lines) in blocks(page) {
        if let Some(name) = kind.strip_prefix("rt ") {
            let (name, adds) = name.strip_prefix("+ ").map_or((name, false), |name| (name, true));
            let mut file = OpenOptions::new()
                .create(true)
                .write(true)
                .append(adds)
                .open(folder.path().join(name))
                .unwrap();
            for line in lines {
                writeln!(file, "{line}").unwrap();
            }
        } else if kind == "console" || kind == "slurm" && env::var_os("SLURM_CONF").is_some() {
            for Shown { command, exit_code, lines } in shown(&lines) {
                let log = folder.path().join(format!("log{count}"));
                let said = || fs::read_to_string(&log).unwrap();
                let mut shell = Command::new("sh");
                shell
                    .current_dir(folder.path())
                    .env("PATH", &path)
                    // Of other farms on this machine nothing is known.
                    .env("RTFARM_LISTEN", "127.0.0.1:0")
                    .env_remove("RUST_LOG")
                    .stdin(Stdio::null())
                    .stdout(File::create(&log).unwrap());
                if kind == "slurm" {
                    // Its nodes find each other by their names.
                    shell.env("RTFARM_LISTEN", "0.0.0.0:0").env("RTFARM_SLURM_HOST", "127.0.0.1");
                }
                let (wrong, said) = if let Some(command) = command.strip_suffix(" &") {
                    let command = format!("exec 2>&1; exec {command}");
                    background.0.push(shell.args(["-c", &command]).spawn().unwrap());
                    let mut waits = 0;
                    while unsaid(&said(), &lines).is_some() && waits < 500 {
                        thread::sleep(Duration::from_millis(20));
                        waits += 1;
                    }
                    (None, said())
                } else {
                    let status = shell.args(["-c", &format!("exec 2>&1; {command}")]).status();
                    let status = status.unwrap();
                    let is_wrong = status.code() != Some(exit_code);
                    (is_wrong.then(|| format!("it ended with {status}")), said())
                };
                let missing = unsaid(&said, &lines).map(|line| format!("it did not say: {line}"));
                if let Some(wrong) = wrong.or(missing) {
                    return Err(format!("$ {command}\n{wrong}\nit said:\n{said}"));
                }
                count += 1;
            }
        }
    }
    Ok(count)
}

#[test]
fn what_the_pages_say_happens() {
    let mut wrong = String::new();
    let mut commands = 0;
    for entry in fs::read_dir(Path::new(env!("CARGO_MANIFEST_DIR")).join("docs")).unwrap() {
        let path = entry.unwrap().path();
        if path.extension().is_some_and(|extension| extension == "md") {
            match try_page(&fs::read_to_string(&path).unwrap()) {
                Ok(count) => commands += count,
                Err(error) => writeln!(wrong, "{}: {error}", path.display()).unwrap(),
            }
        }
    }
    assert!(wrong.is_empty(), "{wrong}");
    assert!(commands >= 22, "{commands} commands");
}

#[test]
fn numbers_are_told_from_words() {
    assert_eq!(without_numbers("0.75 s, 1.46e-3, 480x270."), "# s, #, #x#.");
    assert_eq!(without_numbers("a-b 1-"), "a-b #-");
}
