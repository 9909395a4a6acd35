//! What the compiler cannot keep: who may know what.

use std::{
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
    let words = ["tokio", "tonic", "std::net", "File::open", "fs::read", "Instant", "SystemTime"];
    check_never_names(&rust_files("core/src"), &words);
}

#[test]
fn decisions_about_leases_and_jobs_are_pure() {
    let files = ["coordinator/src/lease.rs", "coordinator/src/jobs.rs"].map(|f| root().join(f));
    check_never_names(&files, &["tokio", "tonic", "async ", ".await", "Instant::now"]);
}

#[test]
fn decisions_of_workers_and_clients_are_pure() {
    let files = ["worker/src/call.rs", "worker/src/task.rs", "worker/src/worker.rs"];
    let files = [&files[..], &["src/submission.rs"]].concat();
    let files: Vec<PathBuf> = files.iter().map(|file| root().join(file)).collect();
    let words = ["tokio", "tonic", "async ", ".await", "Instant::now", "std::fs", "std::thread"];
    check_never_names(&files, &words);
}

#[test]
fn the_coordinator_traces_no_rays() {
    check_never_names(&rust_files("coordinator/src"), &["render_tile", "trace("]);
}

#[test]
fn unsafe_code_lives_in_four_modules() {
    let allowed = ["core/src/node.rs", "core/src/trace.rs", "src/source.rs", "worker/src/map.rs"];
    for folder in ["core/src", "proto/src", "coordinator/src", "worker/src", "src"] {
        for file in rust_files(folder) {
            let text = fs::read_to_string(&file).unwrap();
            let relative = file.strip_prefix(root()).unwrap().to_str().unwrap().to_owned();
            if !allowed.contains(&relative.as_str()) {
                assert!(!text.contains("unsafe {"), "{relative} has an unsafe block");
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
