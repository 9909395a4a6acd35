//! The generated code stands in the repository, so that nobody but its author compiles a compiler
//! of `.proto` files.

use std::{fs, path::Path};

#[test]
fn the_generated_code_is_that_of_farm_proto() {
    let package = Path::new(env!("CARGO_MANIFEST_DIR"));
    let source = fs::read(package.join("farm.proto")).unwrap();
    let generated = fs::read_to_string(package.join("src/generated/rtfarm.v1.rs")).unwrap();
    let (first, code) = generated.split_once('\n').unwrap();
    let hash = blake3::Hasher::new().update(&source).update(code.as_bytes()).finalize();
    assert_eq!(
        first,
        format!("// {hash}"),
        "farm.proto or its code has changed: `cargo run --manifest-path proto/generate/Cargo.toml`"
    );
}
