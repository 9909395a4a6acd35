//! The pages for people, `docs/*.md`, tried as they stand.
//!
//! A block ```` ```rt NAME ```` is saved as a file, ```` ```rt + NAME ```` added to one. Lines of a
//! ```` ```console ```` block that begin with `$ ` are run, one after the other, in the page's own
//! folder; the lines below one must be among what it says, in that order, whatever the numbers. A
//! comment `# exit code N` at a command's end says how it ends, otherwise it is well.

use std::{
    env,
    fmt::Write as _,
    fs::{self, OpenOptions},
    io::Write as _,
    path::Path,
    process::Command,
};

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

/// What is wrong with a page, if anything is.
fn try_page(page: &str) -> Result<usize, String> {
    let folder = tempfile::tempdir().unwrap();
    let program = Path::new(env!("CARGO_BIN_EXE_rtfarm")).parent().unwrap();
    let path = env::join_paths(
        [program.to_owned()].into_iter().chain(env::split_paths(&env::var_os("PATH").unwrap())),
    )
    .unwrap();
    let mut count = 0;
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
        } else if kind == "console" {
            for Shown { command, exit_code, lines } in shown(&lines) {
                let output = Command::new("sh")
                    .args(["-c", &format!("exec 2>&1; {command}")])
                    .current_dir(folder.path())
                    .env("PATH", &path)
                    .env_remove("RUST_LOG")
                    .output()
                    .unwrap();
                let said = String::from_utf8_lossy(&output.stdout);
                let mut told = said.lines().map(without_numbers);
                let mut wrong = String::new();
                if output.status.code() != Some(exit_code) {
                    writeln!(wrong, "it ended with {}", output.status).unwrap();
                }
                for line in lines {
                    let wanted = without_numbers(line);
                    if !told.any(|line| line == wanted) {
                        writeln!(wrong, "it did not say: {line}").unwrap();
                    }
                }
                if !wrong.is_empty() {
                    return Err(format!("$ {command}\n{wrong}it said:\n{said}"));
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
    assert!(commands >= 14, "{commands} commands");
}

#[test]
fn numbers_are_told_from_words() {
    assert_eq!(without_numbers("0.75 s, 1.46e-3, 480x270."), "# s, #, #x#.");
    assert_eq!(without_numbers("a-b 1-"), "a-b #-");
}
