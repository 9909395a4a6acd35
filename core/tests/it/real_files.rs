//! Scenes that others wrote for the same format, where they are at hand beside the project.

use std::{fs, path::PathBuf};

use rtfarm_core::{
    language::{Reading, Severity, read_scene},
    scene::DroppedFaces,
};

fn folder() -> Option<PathBuf> {
    let folder = PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../../shared/scenes"));
    if !folder.is_dir() {
        eprintln!("SKIPPED: {} is not there", folder.display());
        return None;
    }
    Some(folder)
}

fn read(name: &str) -> Option<Reading> {
    let folder = folder()?;
    let text = fs::read(folder.join(name)).unwrap();
    Some(read_scene(&text, &|path| fs::read(folder.join(path))))
}

fn check_errors(name: &str, errors: &[&str]) {
    let Some(reading) = read(name) else { return };
    let found: Vec<_> = reading
        .diagnostics
        .iter()
        .filter(|d| d.severity == Severity::Error)
        .map(|d| format!("{}: {}", d.at, d.message))
        .collect();
    assert_eq!(found, errors, "{name}");
    assert_eq!(reading.scene.is_some(), errors.is_empty());
}

#[test]
fn they_are_read_without_errors() {
    for name in [
        "coloringtest.rt",
        "pool.rt",
        "rc3.rt",
        "refract.rt",
        "sample3.rt",
        "test12783.rt",
        "textureModel.rt",
    ] {
        check_errors(name, &[]);
    }
}

#[test]
fn the_missing_texture_is_the_one_error() {
    check_errors(
        "caustest.rt",
        &[
            "27:11: cannot read the texture `examples/prostyn_small.tga`: No such file or directory (os error 2)",
        ],
    );
}

#[test]
fn a_file_without_a_viewport_gives_a_scene_without_one() {
    let Some(reading) = read("textureModel.rt") else { return };
    let scene = reading.scene.unwrap();
    assert!(scene.viewport.is_none());
    assert_eq!((scene.textures.len(), scene.quadrangle_texcoords.len()), (1, 1));
}

#[test]
fn a_thousand_copies_of_each_triangle_are_dropped() {
    let Some(folder) = folder() else { return };
    let unpacked =
        std::process::Command::new("zcat").arg(folder.join("gnome_pure.rt.gz")).output().unwrap();
    let reading = read_scene(&unpacked.stdout, &|_| Err(std::io::ErrorKind::NotFound.into()));
    let scene = reading.scene.unwrap();
    assert_eq!(scene.triangles.len(), 1076);
    assert_eq!(scene.dropped, DroppedFaces { zero_area: 0, duplicates: 1_140_084 });
    assert_eq!(reading.diagnostics.len(), 10, "ten numbers are names of materials");
}
