//! Writes `proto/src/generated/rtfarm.v1.rs`, the code of what `farm.proto` names, without a
//! `protoc` on the machine. Its test holds the written file to what is generated.

use std::{
    error::Error,
    fs,
    path::{Path, PathBuf},
};

/// The package whose code is generated.
fn proto() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

fn written_file() -> PathBuf {
    proto().join("src/generated/rtfarm.v1.rs")
}

/// The code, behind a line that holds the hash of `farm.proto` and of the code together: a test of
/// `rtfarm-proto` compares it without generating anything.
fn generate() -> Result<String, Box<dyn Error>> {
    let source = proto().join("farm.proto");
    let files = protox::compile([&source], [proto()])?;
    let folder = tempfile::tempdir()?;
    tonic_prost_build::configure()
        .bytes(".rtfarm.v1")
        .emit_rerun_if_changed(false)
        .out_dir(folder.path())
        .compile_fds(files)?;
    let code = fs::read_to_string(folder.path().join("rtfarm.v1.rs"))?;
    let hash = blake3::Hasher::new().update(&fs::read(source)?).update(code.as_bytes()).finalize();
    Ok(format!("// {hash}\n{code}"))
}

fn main() -> Result<(), Box<dyn Error>> {
    fs::write(written_file(), generate()?)?;
    Ok(())
}

#[test]
fn the_written_code_is_what_farm_proto_gives() {
    let written = fs::read_to_string(written_file()).unwrap();
    assert!(written == generate().unwrap(), "run proto/generate and commit what it writes");
}
