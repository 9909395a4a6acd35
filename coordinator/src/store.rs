//! Files of the coordinator: prepared scenes in its private folder.

use std::{
    fs,
    io::{self, Write},
    os::unix::fs::PermissionsExt,
    path::Path,
};

use rtfarm_core::prepared::{PreparedBytes, SceneHash};
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
