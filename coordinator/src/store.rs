//! Files of the coordinator: prepared scenes in its private folder, pictures without a name.

use std::{
    fs::{self, File},
    io::{self, Write},
    os::unix::fs::PermissionsExt,
    path::{Path, PathBuf},
};

use rtfarm_core::{
    prepared::{PreparedBytes, SceneHash},
    tile::Size,
    transfer::Transfer,
};
use rtfarm_picture::{Picture, PictureFormat};
use rustix::{
    fs::{FallocateFlags, fallocate},
    io::Errno,
};
use tempfile::{NamedTempFile, TempPath};

/// A prepared scene on disk, written once. The file goes when this does.
#[derive(Debug)]
pub(crate) struct SceneFile {
    path: TempPath,
    hash: SceneHash,
    byte_count: u64,
}

impl SceneFile {
    /// Writes a scene into `folder`, which must be nobody else's.
    pub(crate) fn write(folder: &Path, prepared: &PreparedBytes) -> io::Result<Self> {
        let bytes = prepared.as_ref();
        let mut file = NamedTempFile::with_prefix_in("scene-", folder)?;
        file.write_all(bytes)?;
        file.as_file().set_permissions(fs::Permissions::from_mode(0o400))?;
        let path = file.into_temp_path();
        Ok(Self { path, hash: prepared.hash(), byte_count: bytes.len() as u64 })
    }

    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    pub(crate) fn hash(&self) -> SceneHash {
        self.hash
    }

    pub(crate) fn byte_count(&self) -> u64 {
        self.byte_count
    }
}

/// Makes a black picture in a file of `folder` that has no name, so that nothing stays behind
/// however the process ends. Its bytes are reserved: a full disk is an error now, not later.
pub fn new_picture(
    folder: &Path,
    size: Size,
    format: PictureFormat,
    transfer: Transfer,
) -> io::Result<Picture> {
    let file: File = tempfile::tempfile_in(folder)?;
    let byte_count = Picture::byte_count(size, format);
    loop {
        match fallocate(&file, FallocateFlags::empty(), 0, byte_count) {
            Ok(()) | Err(Errno::OPNOTSUPP) => break,
            Err(Errno::INTR) => {}
            Err(error) => return Err(error.into()),
        }
    }
    Picture::new(file, size, format, transfer)
}

/// The folder in which a file of that path stands.
pub fn folder_of(path: &Path) -> PathBuf {
    match path.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder.to_owned(),
        _ => PathBuf::from("."),
    }
}
