//! The catalogue of hard cases is whole, and each of them has a test that tells what it measured.

use std::{fs, path::Path};

/// All that the Rust files below a folder of this package say.
fn rust_text(folder: &Path) -> String {
    let mut text = String::new();
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            text += &rust_text(&path);
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            text += &fs::read_to_string(&path).unwrap();
        }
    }
    text
}

#[test]
fn every_hard_case_has_a_test_that_tells_of_it() {
    let package = Path::new(env!("CARGO_MANIFEST_DIR"));
    let catalogue = include_str!("../../../tests/oracle/src/hard_case.rs");
    let cases: Vec<(&str, u32)> = (catalogue.lines())
        .filter_map(|line| line.trim().strip_suffix(',')?.split_once(" = "))
        .filter_map(|(name, row)| Some((name, row.parse().ok()?)))
        .collect();
    let rows = || cases.iter().map(|&(_, row)| row);
    assert!(rows().eq(1..=72), "{cases:?}");

    let tests = [rust_text(&package.join("src")), rust_text(&package.join("tests"))].concat();
    let told: Vec<&str> = (tests.split("HardCase::").skip(1))
        .map(|rest| rest.split(|c: char| !c.is_alphanumeric()).next().unwrap())
        .collect();
    for (name, row) in cases {
        assert!(told.contains(&name), "no test tells of case {row}, `{name}`");
    }
}
