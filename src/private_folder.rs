//! A folder for what lives no longer than its process. A process that is killed cannot remove it;
//! the next one that starts does.

use std::{
    fs::{self, File},
    io,
    os::unix::fs::{MetadataExt, PermissionsExt},
    path::Path,
};

use anyhow::Context;
use rustix::{
    fs::{FlockOperation, flock},
    process::geteuid,
    system::uname,
};
use tempfile::TempDir;

const PREFIX: &str = "rtfarm-";

/// A file in each such folder, locked as long as the process lives.
const LOCK: &str = "lock";

/// A folder that only this user can look into; it goes when this does.
#[derive(Debug)]
pub(crate) struct PrivateFolder {
    // The folder goes first: an unlocked one is anybody's to remove.
    folder: TempDir,
    _lock: File,
}

impl PrivateFolder {
    /// Makes one in `parent`, and removes those there whose processes are gone.
    pub(crate) fn new(parent: &Path) -> anyhow::Result<Self> {
        Self::with_prefix(parent, PREFIX)
    }

    /// Makes one on a disk that machines share. Some disks do not show a lock to other machines, so
    /// that each removes only what its own processes left.
    pub(crate) fn new_for_many(parent: &Path) -> anyhow::Result<Self> {
        let host = uname().nodename().to_string_lossy().into_owned();
        Self::with_prefix(parent, &format!("rtfarm@{host}@"))
    }

    fn with_prefix(parent: &Path, prefix: &str) -> anyhow::Result<Self> {
        remove_orphans(parent, prefix);
        let make = || -> io::Result<Self> {
            let folder = tempfile::Builder::new()
                .prefix(prefix)
                .permissions(fs::Permissions::from_mode(0o700))
                .tempdir_in(parent)?;
            // Nobody sees the file before it is locked.
            let unlocked = folder.path().join("new");
            let lock = File::create(&unlocked)?;
            flock(&lock, FlockOperation::NonBlockingLockExclusive)?;
            fs::rename(unlocked, folder.path().join(LOCK))?;
            Ok(Self { folder, _lock: lock })
        };
        make().with_context(|| format!("cannot make a folder in {}", parent.display()))
    }

    pub(crate) fn path(&self) -> &Path {
        self.folder.path()
    }
}

/// Removes this user's folders of processes that are gone. What cannot be removed stays: it is in
/// nobody's way.
fn remove_orphans(parent: &Path, prefix: &str) {
    let Ok(entries) = fs::read_dir(parent) else { return };
    for entry in entries.flatten() {
        if !entry.file_name().as_encoded_bytes().starts_with(prefix.as_bytes()) {
            continue;
        }
        let path = entry.path();
        let is_ours = fs::symlink_metadata(&path)
            .is_ok_and(|metadata| metadata.is_dir() && metadata.uid() == geteuid().as_raw());
        // One without the file is being made.
        let Some(lock) = is_ours.then(|| File::open(path.join(LOCK)).ok()).flatten() else {
            continue;
        };
        if flock(&lock, FlockOperation::NonBlockingLockExclusive).is_ok()
            && fs::remove_dir_all(&path).is_ok()
        {
            tracing::info!(folder = %path.display(), "removed what a killed process had left");
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_folders_of_the_dead_are_removed_and_those_of_the_living_stay() {
        let parent = tempfile::tempdir().unwrap();
        let living = PrivateFolder::new(parent.path()).unwrap();
        let dead = PrivateFolder::new(parent.path()).unwrap();
        let PrivateFolder { folder, _lock: lock } = dead;
        let orphan = folder.keep();
        drop(lock);
        let foreign = parent.path().join("rtfarm-notes");
        fs::create_dir(&foreign).unwrap();
        let mode = fs::metadata(living.path()).unwrap().permissions().mode();
        assert_eq!(mode & 0o777, 0o700);

        let next = PrivateFolder::new(parent.path()).unwrap();
        assert!(!orphan.exists());
        assert!(living.path().exists() && foreign.exists());
        drop((living, next));
        assert_eq!(fs::read_dir(parent.path()).unwrap().count(), 1, "the foreign one");
    }
}
