//! What the compiler cannot keep: who may know what.

use std::{
    collections::BTreeSet,
    fs,
    path::{Path, PathBuf},
};

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// The Rust files below a folder of the project.
fn rust_files(folder: &str) -> Vec<PathBuf> {
    let mut waiting = vec![root().join(folder)];
    let mut files = Vec::new();
    while let Some(folder) = waiting.pop() {
        for entry in fs::read_dir(&folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                waiting.push(path);
            } else if path.extension().is_some_and(|extension| extension == "rs") {
                files.push(path);
            }
        }
    }
    files.sort();
    files
}

/// Looks at the code of files before their unit tests.
fn check_never_names(files: &[PathBuf], words: &[&str]) {
    assert!(!files.is_empty());
    for file in files {
        let text = fs::read_to_string(file).unwrap();
        let code = text.split("#[cfg(test)]").next().unwrap_or_default();
        for (number, line) in code.lines().enumerate() {
            let code = line.split("//").next().unwrap_or_default();
            for word in words {
                let place = format!("{}:{}", file.display(), number + 1);
                assert!(!code.contains(word), "{place} names `{word}`");
            }
        }
    }
}

#[test]
fn the_core_opens_no_files_reads_no_clock_and_uses_no_sockets() {
    let words =
        ["tokio", "tonic", "std::net", "fs::", "std::os", "tempfile", "Instant", "SystemTime"];
    check_never_names(&rust_files("core/src"), &words);
}

#[test]
fn a_job_knows_no_wire_no_runtime_and_no_clock() {
    check_never_names(&rust_files("job/src"), &["tokio", "tonic", "proto", "WorkerId", "Instant"]);
}

/// The packages of the project that a package depends on, tests aside.
fn dependencies(folder: &str) -> Vec<String> {
    let text = fs::read_to_string(root().join(folder).join("Cargo.toml")).unwrap();
    let section = text.split("\n[").find_map(|section| section.strip_prefix("dependencies]"));
    let names = section.expect(folder).lines().filter_map(|line| line.strip_prefix("rtfarm-"));
    names.map(|name| name.split(['.', ' ', '=']).next().unwrap().to_owned()).collect()
}

/// ARCHITECTURE.md draws it: nothing that users run knows the oracle, and what renders alone needs
/// no server.
#[test]
fn packages_depend_on_each_other_as_they_are_drawn() {
    let arrows: [(&str, &[&str]); 12] = [
        ("core", &[]),
        ("picture", &["core"]),
        ("job", &["core", "picture"]),
        ("proto", &["core", "picture"]),
        ("coordinator", &["core", "job", "picture", "proto"]),
        ("worker", &["core", "proto"]),
        ("client", &["core", "proto"]),
        ("ladder", &["core"]),
        ("report", &["core", "ladder", "oracle"]),
        ("tests/oracle", &["core"]),
        (".", &["client", "coordinator", "core", "job", "ladder", "picture", "proto", "worker"]),
        ("fuzz", &["core", "picture", "proto"]),
    ];
    for (folder, expected) in arrows {
        assert_eq!(dependencies(folder), expected, "{folder}");
    }
}

#[test]
fn rendering_in_one_process_knows_no_server() {
    let files = ["src/local.rs", "src/pilot.rs", "src/report.rs"].map(|file| root().join(file));
    check_never_names(&files, &["rtfarm_coordinator", "rtfarm_proto", "rtfarm_worker", "WorkerId"]);
}

#[test]
fn the_machine_of_the_coordinator_is_pure() {
    let files = ["identity", "tiles", "pace", "lease", "members", "waiting", "audit", "farm"]
        .map(|file| root().join(format!("coordinator/src/{file}.rs")));
    let parts = rust_files("coordinator/src/farm");
    let parts = parts.into_iter().filter(|file| !file.ends_with("tests.rs"));
    let files: Vec<PathBuf> = files.into_iter().chain(parts).collect();
    check_never_names(&files, &["tokio", "tonic", "async ", ".await", "Instant::now", "tracing"]);
}

#[test]
fn decisions_of_workers_and_clients_are_pure() {
    let files = ["worker/src/call.rs", "worker/src/task.rs", "worker/src/worker.rs"];
    let files = [&files[..], &["client/src/submission.rs"]].concat();
    let files: Vec<PathBuf> = files.iter().map(|file| root().join(file)).collect();
    let words = ["tokio", "tonic", "async ", ".await", "Instant::now", "std::fs", "std::thread"];
    check_never_names(&files, &words);
}

#[test]
fn the_coordinator_traces_no_rays() {
    // Workers of the simulated farm are real ones.
    let is_product = |file: &PathBuf| !file.ends_with("whole_farm.rs");
    let files: Vec<PathBuf> =
        rust_files("coordinator/src").into_iter().filter(is_product).collect();
    check_never_names(&files, &["render_tile", "trace("]);
}

/// The code of every package.
const SOURCES: [&str; 11] = [
    "core/src",
    "picture/src",
    "job/src",
    "proto/src",
    "coordinator/src",
    "worker/src",
    "client/src",
    "ladder/src",
    "report/src",
    "tests/oracle/src",
    "src",
];

#[test]
fn unsafe_code_lives_in_six_modules() {
    let allowed = [
        "core/src/trace/boxes_avx512.rs",
        "core/src/trace/boxes_x86.rs",
        "core/src/trace/parallelepiped_x86.rs",
        "src/memory.rs",
        "src/source.rs",
        "worker/src/map.rs",
    ];
    let words = ["unsafe {", "unsafe fn", "unsafe impl", "unsafe extern", "unsafe trait"];
    for folder in SOURCES {
        for file in rust_files(folder) {
            let text = fs::read_to_string(&file).unwrap();
            let relative = file.strip_prefix(root()).unwrap().to_str().unwrap().to_owned();
            if !allowed.contains(&relative.as_str()) {
                for word in words {
                    assert!(!text.contains(word), "{relative} says `{word}`");
                }
            }
        }
    }
}

#[test]
fn the_readme_has_the_two_commands() {
    let readme = fs::read_to_string(root().join("README.md")).unwrap();
    assert!(readme.contains("cargo run --release -- render scenes/gnome.rt -o gnome.png"));
    assert!(readme.contains("cargo test --workspace"));
}

/// What each room of the core may import besides the vocabulary: ARCHITECTURE.md draws it.
const ROOMS: [(&str, &[&str]); 13] = [
    ("exact", &[]),
    ("text", &["exact"]),
    ("scene", &["exact"]),
    ("assets", &["exact", "text", "scene"]),
    ("language", &["exact", "text", "scene", "assets"]),
    ("prepared", &["exact"]),
    ("prepare", &["exact", "scene", "prepared"]),
    ("trace", &["exact", "prepared"]),
    ("shade", &["exact", "prepared", "trace"]),
    ("light", &["exact", "prepared", "trace", "shade"]),
    ("render", &["exact", "prepared", "trace", "shade", "light"]),
    // A door for tests and benchmarks: nobody may import it.
    ("testing", &["prepare", "render", "trace"]),
    ("lib", &[]),
];

/// What every room may import, and what imports nothing but itself.
const VOCABULARY: [&str; 5] = ["isa", "left_out", "sample", "tile", "transfer"];

/// A file of the core and the files whose items it names.
struct Room {
    file: PathBuf,
    imports: BTreeSet<PathBuf>,
}

/// The core's files, those of tests aside, and their imports: their `use` lines, and paths that begin with `crate::`,
/// `super::` or a module that the file declares.
fn rooms_of_core() -> Vec<Room> {
    let source = root().join("core/src");
    rust_files("core/src")
        .into_iter()
        .filter(|path| !path.ends_with("tests.rs"))
        .map(|path| {
            let text = fs::read_to_string(&path).unwrap();
            let code = text.split("#[cfg(test)]").next().unwrap();
            let code: Vec<&str> =
                code.lines().map(|line| line.split("//").next().unwrap()).collect();
            let code = code.join("\n");
            let file = path.strip_prefix(&source).unwrap().to_owned();
            let module = module_of(&file);
            let parent = &module[..module.len().saturating_sub(1)];
            let children = children_of(&text);
            let mut imports = BTreeSet::new();
            for words in paths_in(&code) {
                let named = match words[0].as_str() {
                    "crate" => words[1..].to_vec(),
                    "super" => [parent, &words[1..]].concat(),
                    "self" => [&module, &words[1..]].concat(),
                    child if children.contains(child) => [&module, &words[..]].concat(),
                    _ => continue,
                };
                // The room that the file stands in is named by `pub(in ...)`.
                if !module.starts_with(&named) {
                    imports.extend(file_with(&source, &named));
                }
            }
            imports.remove(&file);
            Room { file, imports }
        })
        .collect()
}

/// `trace/ray.rs` is the module `trace`, `ray`; `trace/mod.rs` is `trace`.
fn module_of(file: &Path) -> Vec<String> {
    let names = file.with_extension("");
    let names = names.iter().map(|name| name.to_str().unwrap().to_owned());
    names.filter(|name| name != "mod" && name != "lib").collect()
}

/// The modules that a file declares.
fn children_of(text: &str) -> BTreeSet<String> {
    let declared = |line: &str| {
        let name = line.trim_end().strip_suffix(';')?.rsplit_once("mod ")?.1;
        Some(name.to_owned())
    };
    text.lines().filter_map(declared).collect()
}

/// The file of the innermost module that a path goes through.
fn file_with(source: &Path, path: &[String]) -> Option<PathBuf> {
    (1..=path.len()).rev().find_map(|length| {
        let module = path[..length].join("/");
        let files = [format!("{module}.rs"), format!("{module}/mod.rs")].map(PathBuf::from);
        files.into_iter().find(|file| source.join(file).exists())
    })
}

/// All paths of names joined by `::`, those in braces spelled out from their beginning.
fn paths_in(code: &str) -> Vec<Vec<String>> {
    let is_word = |c: char| c.is_alphanumeric() || c == '_';
    let mut paths = Vec::new();
    // What stands before each open brace: nothing, where it is no brace of a path.
    let mut before: Vec<Vec<String>> = Vec::new();
    let mut path: Vec<String> = Vec::new();
    let mut rest = code;
    while let Some(c) = rest.chars().next() {
        let word = rest.find(|c| !is_word(c)).unwrap_or(rest.len());
        if word > 0 {
            path.push(rest[..word].to_owned());
            rest = &rest[word..];
            if !rest.starts_with("::") {
                paths.push(std::mem::take(&mut path));
                path.extend(before.last().into_iter().flatten().cloned());
            }
            continue;
        }
        if rest.starts_with("::") {
            rest = &rest[2..];
            continue;
        }
        match c {
            '{' => before.push(std::mem::take(&mut path)),
            '}' => drop(before.pop()),
            _ => {}
        }
        path.clear();
        path.extend(before.last().into_iter().flatten().cloned());
        rest = &rest[c.len_utf8()..];
    }
    paths.retain(|path| path.len() > 1);
    paths
}

#[test]
fn paths_are_read_with_their_braces() {
    let found = paths_in("use crate::{a::{b, c::d}, e};\nfn f() { g::h(i) }");
    let found: Vec<String> = found.iter().map(|path| path.join("::")).collect();
    assert_eq!(found, ["crate::a::b", "crate::a::c::d", "crate::e", "g::h"]);
}

/// The coordinator's files, each of which knows earlier ones only.
const COORDINATOR: [&str; 24] = [
    "upload", "flight", "identity", "tiles", "pace", "lease", "members", "waiting", "audit",
    "farm", "store", "record", "state", "job", "events", "shell", "live", "metrics", "accept",
    "security", "guard", "page", "service", "run",
];

/// Those that only tests know.
const TESTS_OF_COORDINATOR: [&str; 5] = ["load", "simulation", "steady", "restart", "whole_farm"];

#[test]
fn files_of_the_coordinator_know_only_earlier_ones() {
    let source = root().join("coordinator/src");
    for file in rust_files("coordinator/src") {
        // A part of a file knows what the whole may.
        let module = module_of(file.strip_prefix(&source).unwrap());
        let is_test = |name: &str| name == "tests" || TESTS_OF_COORDINATOR.contains(&name);
        let Some(whole) = module.first().filter(|_| !module.iter().any(|name| is_test(name)))
        else {
            continue;
        };
        let index = COORDINATOR.iter().position(|name| name == whole);
        let index = index.unwrap_or_else(|| panic!("{} has no place", file.display()));
        let text = fs::read_to_string(&file).unwrap();
        for path in paths_in(text.split("#[cfg(test)]").next().unwrap()) {
            let is_later = path[0] == "crate"
                && path[1] != *whole
                && COORDINATOR[index..].contains(&&*path[1]);
            assert!(!is_later, "{} knows {}.rs", file.display(), path[1]);
        }
    }
}

#[test]
fn rooms_of_the_core_import_only_what_lies_below_them() {
    for Room { file, imports } in rooms_of_core() {
        let room = room_of(&file);
        for import in imports {
            let other = room_of(&import);
            let may = VOCABULARY.contains(&other.as_str())
                || room == other
                || ROOMS.iter().any(|(name, below)| *name == room && below.contains(&&*other));
            let is_allowed = if VOCABULARY.contains(&room.as_str()) {
                VOCABULARY.contains(&other.as_str()) || other == "exact"
            } else {
                may
            };
            assert!(
                is_allowed || room == "lib",
                "{} looks up to {}",
                file.display(),
                import.display()
            );
        }
    }
}

/// The first name of a file's path.
fn room_of(file: &Path) -> String {
    let first = file.iter().next().unwrap().to_str().unwrap();
    first.trim_end_matches(".rs").to_owned()
}

#[test]
fn no_files_of_the_core_import_each_other_in_a_circle() {
    let mut rooms = rooms_of_core();
    rooms.retain(|room| room.file != Path::new("lib.rs"));
    // Files that import nothing that is left are taken away, until none is left but a circle.
    loop {
        let left: BTreeSet<PathBuf> = rooms.iter().map(|room| room.file.clone()).collect();
        let count = rooms.len();
        rooms.retain(|room| room.imports.iter().any(|import| left.contains(import)));
        if rooms.len() == count {
            break;
        }
    }
    for Room { file, imports } in &rooms {
        eprintln!("{} imports {imports:?}", file.display());
    }
    assert!(rooms.is_empty(), "these files import each other, or import some that do");
}
