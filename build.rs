//! Hashes the sources that pixels and messages depend on, so that a coordinator knows workers that
//! were built from others. The same sources give the same hash on every machine, with every
//! compiler and profile; what these make of them, the reference tile shows.

use std::{fs, io, path::Path};

const SOURCES: [&str; 5] = ["Cargo.lock", "core/src", "picture/src", "proto/src", "worker/src"];

fn main() -> io::Result<()> {
    let mut hasher = blake3::Hasher::new();
    for source in SOURCES {
        println!("cargo::rerun-if-changed={source}");
        hash(Path::new(source), &mut hasher)?;
    }
    println!("cargo::rustc-env=RTFARM_BUILD={}", &hasher.finalize().to_hex()[..16]);
    Ok(())
}

/// Hashes a file with its name, or all that a folder holds in the order of its names.
fn hash(path: &Path, hasher: &mut blake3::Hasher) -> io::Result<()> {
    if path.is_dir() {
        let mut paths =
            fs::read_dir(path)?.map(|entry| Ok(entry?.path())).collect::<io::Result<Vec<_>>>()?;
        paths.sort();
        return paths.iter().try_for_each(|path| hash(path, hasher));
    }
    let bytes = fs::read(path)?;
    for part in [path.to_string_lossy().as_bytes(), &bytes] {
        hasher.update(&(part.len() as u64).to_le_bytes());
        hasher.update(part);
    }
    Ok(())
}
