//! Files of the coordinator: prepared scenes, in its private folder or with their jobs.

use std::{
    fs,
    io::{self, Write},
    os::unix::fs::PermissionsExt,
    path::{Path, PathBuf},
};

use rtfarm_core::prepared::{PreparedBytes, SceneHash};
use rtfarm_picture::Disk;
use tempfile::{NamedTempFile, TempPath};

/// A prepared scene on disk, written once.
#[derive(Debug)]
pub(crate) struct SceneFile {
    path: PathBuf,
    hash: SceneHash,
    byte_count: u64,
    /// The file goes when this does; one that outlives the process has none.
    _temporary: Option<TempPath>,
}

impl SceneFile {
    /// Writes a scene into `folder`, which must be nobody else's. The file goes when this does.
    pub(crate) fn write(folder: &Path, prepared: &PreparedBytes) -> io::Result<Self> {
        let bytes = prepared.as_ref();
        let mut file = NamedTempFile::with_prefix_in("scene-", folder)?;
        file.write_all(bytes)?;
        file.as_file().set_permissions(fs::Permissions::from_mode(0o400))?;
        let path = file.into_temp_path();
        let (hash, byte_count) = (prepared.hash(), bytes.len() as u64);
        Ok(Self { path: path.to_path_buf(), hash, byte_count, _temporary: Some(path) })
    }

    /// Writes a scene to a file that is not there yet and outlives the process, also after a power
    /// cut. It may be a second name of a file that `same` has.
    pub(crate) fn keep(
        path: &Path,
        prepared: &PreparedBytes,
        same: Option<&Path>,
        disk: &Disk,
    ) -> io::Result<()> {
        if same.is_some_and(|same| disk.change(|| fs::hard_link(same, path)).is_ok()) {
            return Ok(());
        }
        let file = disk.change(|| fs::File::create_new(path))?;
        disk.write_at(&file, prepared.as_ref(), 0)?;
        disk.sync(&file)
    }

    /// A scene that an earlier process wrote.
    pub(crate) fn kept(path: PathBuf, hash: SceneHash, byte_count: u64) -> Self {
        Self { path, hash, byte_count, _temporary: None }
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
