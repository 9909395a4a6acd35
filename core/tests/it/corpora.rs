//! Every file of the fuzz corpora, old findings among them, through what the fuzz targets check.

use std::{fs, path::Path};

use rtfarm_oracle::random::Random;

#[path = "../../../fuzz/targets.rs"]
mod targets;

fn check_corpus(name: &str, target: fn(&[u8])) {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../fuzz/corpus").join(name);
    let mut count = 0;
    for entry in
        fs::read_dir(&folder).unwrap_or_else(|error| panic!("{}: {error}", folder.display()))
    {
        let path = entry.unwrap().path();
        eprintln!("{}", path.display());
        target(&fs::read(path).unwrap());
        count += 1;
    }
    assert!(count > 0, "{} is empty", folder.display());
}

#[test]
fn scenes_hold() {
    check_corpus("scene", targets::scene);
}

#[test]
fn stl_files_hold() {
    check_corpus("stl", targets::stl);
}

#[test]
fn obj_files_hold() {
    check_corpus("obj", targets::obj);
}

#[test]
fn ply_files_hold() {
    check_corpus("ply", targets::ply);
}

#[test]
fn images_hold() {
    check_corpus("image", targets::image);
}

#[test]
fn prepared_scenes_with_changed_bytes_hold() {
    check_corpus("prepared", targets::prepared);
}

#[test]
fn prepared_scenes_with_a_few_words_changed_anywhere_hold() {
    for seed in 0..3000 {
        let mut random = Random::new(seed);
        let mut input = vec![random.below(8) as u8];
        for _ in 0..4 * (1 + random.below(3)) {
            input.push(random.bits() as u8);
        }
        // Small blocks: the upper bits of a place only wrap around.
        targets::prepared(&input);
    }
}
