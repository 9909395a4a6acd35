//! The files that a scene names, and which of them may be read: regular ones that lie in the
//! scene's folder once all links are resolved, or in a folder that the user allows besides. A scene
//! may come from a stranger, and what it names may be sent to another machine.

use std::{
    fs::{self, File},
    io::{self, Read, Seek, SeekFrom},
    os::{fd::OwnedFd, unix::fs::FileExt},
    path::{Component, Path, PathBuf},
    sync::atomic::{AtomicU64, Ordering},
};

use rayon::prelude::*;
use rustix::{
    fs::{Mode, OFlags, ResolveFlags, open, openat2},
    io::Errno,
};

use crate::{args::SceneArgs, output::folder_of};

/// The most bytes that the files of one scene may have together.
const MOST_BYTES: u64 = 1 << 31;

/// A thread reads so many bytes in one go.
const READ_AT_ONCE: usize = 1 << 20;

/// A path is looked up so many times when other processes rename what it leads through.
const ATTEMPTS: usize = 16;

/// The files of one scene.
#[derive(Debug)]
pub(crate) struct SceneFiles {
    /// What the names are relative to.
    folder: PathBuf,
    /// Folders that the user allows besides.
    allowed: Vec<PathBuf>,
    /// Bytes that may still be read.
    bytes_left: AtomicU64,
}

impl SceneFiles {
    /// The files that stand beside the scene's own, or below; for a scene from standard input,
    /// those in the current folder.
    pub(crate) fn new(scene: &SceneArgs) -> Self {
        let folder = if scene.is_from_stdin() { ".".into() } else { folder_of(&scene.path) };
        Self::in_folder(folder, scene.allow_files.clone())
    }

    pub(crate) fn in_folder(folder: PathBuf, allowed: Vec<PathBuf>) -> Self {
        Self { folder, allowed, bytes_left: AtomicU64::new(MOST_BYTES) }
    }

    /// Reads a file by the name that the scene has for it. Nothing that is no regular file is
    /// waited for or read.
    pub(crate) fn read(&self, name: &str) -> io::Result<Vec<u8>> {
        let mut file = self.open(name)?;
        let metadata = file.metadata()?;
        if metadata.is_dir() {
            return Err(io::Error::other("it is a folder"));
        }
        if !metadata.is_file() {
            return Err(io::Error::other("it is no regular file"));
        }
        let too_long = || {
            io::Error::other(format!(
                "the files of a scene have at most {MOST_BYTES} bytes together"
            ))
        };
        let left = self.bytes_left.load(Ordering::Relaxed);
        if metadata.len() > left {
            return Err(too_long());
        }
        let mut data = vec![0; metadata.len() as usize];
        let read = |(piece, place): (usize, &mut [u8])| {
            file.read_exact_at(place, (piece * READ_AT_ONCE) as u64)
        };
        data.par_chunks_mut(READ_AT_ONCE).enumerate().try_for_each(read)?;
        // It may grow meanwhile.
        file.seek(SeekFrom::Start(metadata.len()))?;
        (&mut file).take(left + 1 - metadata.len()).read_to_end(&mut data)?;
        let length = data.len() as u64;
        let taken = self
            .bytes_left
            .fetch_update(Ordering::Relaxed, Ordering::Relaxed, |left| left.checked_sub(length));
        taken.map(|_| data).map_err(|_| too_long())
    }

    fn open(&self, name: &str) -> io::Result<File> {
        // Opening a pipe or a device must neither wait nor do anything to it.
        match open_beneath(&self.folder, Path::new(name), ResolveFlags::empty()) {
            Ok(file) => Ok(file),
            // The name is absolute, or leads out of the folder, perhaps by a link: where to,
            // matters.
            Err(Errno::XDEV) => self.open_where_it_leads(name),
            Err(errno) if is_unsupported(errno) => self.open_where_it_leads(name),
            Err(errno) => Err(errno.into()),
        }
    }

    /// Resolves every link, and opens what is found if it lies where it may.
    fn open_where_it_leads(&self, name: &str) -> io::Result<File> {
        let forbidden = || {
            let reason = "it lies outside of the scene's folder; --allow-files DIR allows another";
            io::Error::new(io::ErrorKind::PermissionDenied, reason)
        };
        // Outside of the allowed folders even whether a file is there is nobody's business.
        let path = fs::canonicalize(self.folder.join(name))
            .map_err(|error| if is_plain(Path::new(name)) { error } else { forbidden() })?;
        for folder in std::iter::once(&self.folder).chain(&self.allowed) {
            let folder = fs::canonicalize(folder).map_err(|error| {
                let reason = format!("cannot look into {}: {error}", folder.display());
                io::Error::new(error.kind(), reason)
            })?;
            let Ok(rest) = path.strip_prefix(&folder) else { continue };
            return match open_beneath(&folder, rest, ResolveFlags::NO_SYMLINKS) {
                Err(errno) if is_unsupported(errno) => {
                    // Without the system's help, who can write into the folder can still put a link
                    // there between the look and the opening.
                    Ok(open(&path, FLAGS | OFlags::NOFOLLOW, Mode::empty())?.into())
                }
                opened => Ok(opened?),
            };
        }
        Err(forbidden())
    }
}

const FLAGS: OFlags = OFlags::RDONLY.union(OFlags::NONBLOCK).union(OFlags::CLOEXEC);

/// Opens a file so that no part of its path leads out of `folder`.
fn open_beneath(folder: &Path, name: &Path, resolve: ResolveFlags) -> Result<File, Errno> {
    let root: OwnedFd =
        open(folder, OFlags::PATH | OFlags::DIRECTORY | OFlags::CLOEXEC, Mode::empty())?;
    let resolve = resolve | ResolveFlags::BENEATH | ResolveFlags::NO_MAGICLINKS;
    let mut attempts = 0..ATTEMPTS;
    loop {
        match openat2(&root, name, FLAGS, Mode::empty(), resolve) {
            Err(Errno::AGAIN) if attempts.next().is_some() => {}
            opened => return opened.map(File::from),
        }
    }
}

/// Whether the kernel, or a sandbox around this process, has no `openat2`.
fn is_unsupported(errno: Errno) -> bool {
    matches!(errno, Errno::NOSYS | Errno::PERM)
}

/// Whether a name has no part that leads anywhere but down.
fn is_plain(name: &Path) -> bool {
    name.components().all(|part| matches!(part, Component::Normal(_) | Component::CurDir))
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::symlink;

    use rustix::fs::{CWD, FileType, mknodat};
    use tempfile::TempDir;

    use super::*;

    /// A folder with a scene's folder in it, `scene`, and another, `other`.
    fn place() -> (TempDir, SceneFiles) {
        let place = tempfile::tempdir().unwrap();
        for file in ["scene/wood.png", "scene/deep/wood.png", "other/secret"] {
            let path = place.path().join(file);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, file).unwrap();
        }
        let files = SceneFiles::in_folder(place.path().join("scene"), Vec::new());
        (place, files)
    }

    #[test]
    fn files_in_the_folder_are_read_by_whatever_way_that_stays_there() {
        let (place, files) = place();
        let link = |to: &Path, name: &str| symlink(to, place.path().join("scene").join(name));
        link(Path::new("deep/wood.png"), "link").unwrap();
        link(&place.path().join("scene/deep/wood.png"), "absolute").unwrap();
        for (name, expected) in [
            ("wood.png", "scene/wood.png"),
            ("./deep/wood.png", "scene/deep/wood.png"),
            ("deep/../wood.png", "scene/wood.png"),
            ("link", "scene/deep/wood.png"),
            ("absolute", "scene/deep/wood.png"),
        ] {
            assert_eq!(files.read(name).unwrap(), expected.as_bytes(), "{name}");
        }
        assert_eq!(files.read("gone").unwrap_err().kind(), io::ErrorKind::NotFound);
    }

    #[test]
    fn files_elsewhere_are_read_only_where_the_user_allows_it() {
        let (place, files) = place();
        let other = place.path().join("other");
        symlink(&other, place.path().join("scene/out")).unwrap();
        symlink(other.join("secret"), place.path().join("scene/absolute")).unwrap();
        symlink("/proc/self/root", place.path().join("scene/magic")).unwrap();
        let absolute = other.join("secret").display().to_string();
        let names =
            ["../other/secret", &absolute, "out/secret", "absolute", "deep/../../other/secret"];
        let allowing = SceneFiles::in_folder(place.path().join("scene"), vec![other]);
        for name in names {
            let error = files.read(name).unwrap_err();
            assert!(error.to_string().contains("outside of the scene's folder"), "{name}: {error}");
            assert_eq!(allowing.read(name).unwrap(), b"other/secret", "{name}");
        }
        for name in ["/etc/passwd", "magic/etc/passwd", "../gone", "../scene/../../etc/passwd"] {
            for files in [&files, &allowing] {
                let error = files.read(name).unwrap_err();
                assert!(error.to_string().contains("outside"), "{name}: {error}");
            }
        }
    }

    #[test]
    fn only_regular_files_are_read_and_no_other_is_waited_for() {
        let (place, files) = place();
        let pipe = place.path().join("scene/pipe");
        mknodat(CWD, &pipe, FileType::Fifo, Mode::RUSR | Mode::WUSR, 0).unwrap();
        assert_eq!(files.read("pipe").unwrap_err().to_string(), "it is no regular file");
        assert_eq!(files.read("deep").unwrap_err().to_string(), "it is a folder");
    }

    #[test]
    fn the_files_of_a_scene_have_so_many_bytes_together() {
        let (place, files) = place();
        let long = File::create(place.path().join("scene/long")).unwrap();
        long.set_len(MOST_BYTES - 10).unwrap();
        files.bytes_left.store(24, Ordering::Relaxed);
        assert_eq!(files.read("wood.png").unwrap().len(), 14);
        let error = files.read("wood.png").unwrap_err();
        assert!(error.to_string().contains("at most"), "{error}");
        files.read("long").unwrap_err();
    }
}
