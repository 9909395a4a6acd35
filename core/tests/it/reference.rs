//! The examples of the language's reference are scenes about which there is nothing to say.

use std::{fs, io, path::Path};

use rtfarm_core::language::read_scene;

fn check_examples(name: &str) {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs").join(name);
    let page = fs::read_to_string(path).unwrap();
    let examples: Vec<&str> =
        page.split("```rt\n").skip(1).map(|rest| rest.split("```").next().unwrap()).collect();
    assert_eq!(examples.len(), 7);
    for example in examples {
        let reading = read_scene(example.as_bytes(), &|path| match path {
            "bottle.obj" => Ok(b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3".to_vec()),
            "wood.png" | "моё дерево.png" => Ok(texel()),
            _ => Err(io::ErrorKind::NotFound.into()),
        });
        assert_eq!(reading.diagnostics, [], "{example}");
        assert!(reading.scene.is_some());
    }
}

/// A PNG of one texel.
fn texel() -> Vec<u8> {
    let mut bytes = Vec::new();
    png::Encoder::new(&mut bytes, 1, 1).write_header().unwrap().write_image_data(&[100]).unwrap();
    bytes
}

#[test]
fn the_english_examples_are_clean() {
    check_examples("format.md");
}

#[test]
fn the_russian_examples_are_clean() {
    check_examples("format.ru.md");
}
