//! The files that a scene text names, against those that reading it asks for.

use std::{
    fs, io,
    path::{Path, PathBuf},
    sync::Mutex,
};

use rtfarm_core::language::{read_scene, referenced_files};

/// The files that reading a text asks for.
fn asked(text: &[u8]) -> Vec<String> {
    let asked = Mutex::new(Vec::new());
    read_scene(text, &|path| {
        asked.lock().unwrap().push(path.to_owned());
        Err(io::ErrorKind::NotFound.into())
    });
    asked.into_inner().unwrap()
}

/// Checks that a text names what reading it asks for, no more and nothing twice.
fn check_asked(place: &str, text: &[u8]) {
    let (mut named, mut asked) = (referenced_files(text), asked(text));
    named.sort();
    asked.sort();
    assert_eq!(named, asked, "{place}");
}

/// Checks what a text names, in its order.
fn check_named(text: &str, expected: &[&str]) {
    assert_eq!(referenced_files(text.as_bytes()), expected, "{text}");
    check_asked(text, text.as_bytes());
}

/// The scene texts of a folder and the folders in it.
fn scenes(folder: &Path) -> Vec<PathBuf> {
    let mut waiting = vec![folder.to_owned()];
    let mut scenes = Vec::new();
    while let Some(folder) = waiting.pop() {
        for entry in fs::read_dir(&folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                waiting.push(path);
            } else if path.extension().is_some_and(|extension| extension == "rt") {
                scenes.push(path);
            }
        }
    }
    scenes
}

fn check_folder(folder: &str) {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join(folder);
    if !folder.is_dir() {
        eprintln!("SKIPPED: {} is not there", folder.display());
        return;
    }
    let scenes = scenes(&folder);
    assert!(!scenes.is_empty(), "{}", folder.display());
    let mut count = 0;
    for path in scenes {
        let text = fs::read(&path).unwrap();
        check_asked(&path.display().to_string(), &text);
        count += referenced_files(&text).len();
    }
    assert!(count > 0, "some scene of {} names a file", folder.display());
}

#[test]
fn the_projects_scenes_name_what_reading_them_asks_for() {
    check_folder("../scenes");
}

#[test]
fn scenes_that_others_wrote_name_what_reading_them_asks_for() {
    check_folder("../../shared/scenes");
}

#[test]
fn files_are_named_once_and_in_the_order_of_the_text() {
    check_named(
        "materials
           entry name a texture b.png endentry
           entry name b image \"a #1.png\" endentry # texture none.png
           entry name c texture b.png endentry
         endmaterials
         geometry
           mesh file d.obj material a endmesh
           stlmodel filename c.stl material b endstlmodel
           mesh file d.obj material c scale 2 rotate 0 0 1 90 move 1 2 3 endmesh
         endgeometry
         materials entry name d texture last.png endentry endmaterials",
        &["b.png", "a #1.png", "d.obj", "c.stl", "last.png"],
    );
}

#[test]
fn words_that_look_like_fields_name_no_files() {
    check_named(
        "materials
           entry name texture endentry
           entry name file texture image endentry
           entry name twice texture first.png texture second.png endentry
         endmaterials
         fog texture none.png endfog
         geometry
           sphere coords 0 0 0 radius 1 material texture endsphere
           triangle vertex 0 0 0 vertex 1 0 0 vertex 0 1 0 material file endtriangle
           triangle vertex 0 0 0 texcoord 0 0 vertex 1 0 0 texcoord 0 0 vertex 0 1 0 texcoord 0 0
             material file endtriangle
           union
             sphere coords 0 0 0 radius 1 material file endsphere
             sphere coords 0 0 0 radius 2 material file endsphere
           endunion
           mesh material file file mesh endmesh
         endgeometry",
        &["image", "second.png", "mesh"],
    );
}

#[test]
fn what_is_no_text_names_no_files() {
    for text in [&b""[..], b"\x1f\x8b\x08", b"\xff\xfem\0", b"materials\0"] {
        assert_eq!(referenced_files(text), [""; 0]);
    }
}
