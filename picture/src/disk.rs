//! Changes on disk that are to outlive their process, each through one door: a test makes it stop.

use std::{
    fs::{self, File},
    io,
    os::unix::fs::FileExt,
    path::Path,
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
};

/// Where pictures and records are kept. By default each change is made; one for tests fails some.
#[derive(Debug, Clone, Default)]
pub struct Disk(Option<Arc<Fault>>);

/// What a test has a disk do.
#[derive(Debug)]
struct Fault {
    /// The change that fails, from 0.
    at: u64,
    /// All later ones fail as well.
    lasts: bool,
    made: AtomicU64,
}

/// What becomes of a change.
enum Fate {
    Made,
    /// Half of what is written is.
    Torn,
    Lost,
}

impl Disk {
    /// A disk that stops in the midst of change `at`, counted from 0, as for a process that is
    /// killed then: what it does later has no effect.
    pub fn stopping_at(at: u64) -> Self {
        Self(Some(Arc::new(Fault { at, lasts: true, made: AtomicU64::new(0) })))
    }

    /// A disk that fails in the midst of change `at`, counted from 0, and makes all others.
    pub fn failing_at(at: u64) -> Self {
        Self(Some(Arc::new(Fault { at, lasts: false, made: AtomicU64::new(0) })))
    }

    /// Says whether a test's disk has come to the change that fails.
    pub fn has_failed(&self) -> bool {
        self.0.as_ref().is_some_and(|fault| fault.made.load(Ordering::SeqCst) > fault.at)
    }

    fn fate(&self) -> Fate {
        let Some(fault) = &self.0 else { return Fate::Made };
        match fault.made.fetch_add(1, Ordering::SeqCst) {
            made if made == fault.at => Fate::Torn,
            made if made > fault.at && fault.lasts => Fate::Lost,
            _ => Fate::Made,
        }
    }

    /// Makes a change that is made whole or not at all.
    pub fn change<T>(&self, change: impl FnOnce() -> io::Result<T>) -> io::Result<T> {
        match self.fate() {
            Fate::Made => change(),
            Fate::Torn | Fate::Lost => Err(failed()),
        }
    }

    /// Writes `bytes` at an offset.
    pub fn write_at(&self, file: &File, bytes: &[u8], offset: u64) -> io::Result<()> {
        match self.fate() {
            Fate::Made => file.write_all_at(bytes, offset),
            Fate::Torn => {
                file.write_all_at(&bytes[..bytes.len() / 2], offset)?;
                Err(failed())
            }
            Fate::Lost => Err(failed()),
        }
    }

    /// Puts a file in place that has these bytes, whatever was there: whole, or not at all, also
    /// after a power cut.
    pub fn replace(&self, path: &Path, bytes: &[u8]) -> io::Result<()> {
        let new = path.with_extension("new");
        let file = self.change(|| File::create(&new))?;
        self.write_at(&file, bytes, 0)?;
        self.change(|| file.sync_all())?;
        self.change(|| fs::rename(&new, path))?;
        self.sync_folder(path.parent().expect("a file lies in a folder"))
    }

    /// Makes the names in a folder outlive a power cut.
    pub fn sync_folder(&self, folder: &Path) -> io::Result<()> {
        self.change(|| File::open(folder)?.sync_all())
    }
}

fn failed() -> io::Error {
    io::Error::other("a test has the disk fail")
}
