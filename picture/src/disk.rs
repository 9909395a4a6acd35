//! Changes on disk that are to outlive their process, each through one door: a test makes it stop.

use std::{
    collections::BTreeSet,
    fs::{self, File},
    io,
    os::unix::fs::{FileExt, MetadataExt},
    path::{Path, PathBuf},
    sync::{
        Arc, Mutex, MutexGuard,
        atomic::{AtomicU64, Ordering},
    },
};

/// Where pictures and records are kept. By default each change is made; one for tests fails some,
/// and remembers what is not synced.
#[derive(Debug, Clone, Default)]
pub struct Disk {
    fault: Option<Arc<Fault>>,
    cache: Option<Cache>,
}

/// What a power cut may take, in the order in which it was written, for tests. A clone is the same
/// one.
#[derive(Debug, Clone, Default)]
pub struct Cache(Arc<Mutex<Vec<Unsynced>>>);

#[derive(Debug)]
enum Unsynced {
    /// A part of a file, within a sector, and what was there before.
    Part { file: Arc<File>, id: FileId, offset: u64, before: Vec<u8> },
    /// A name, the one that the file had before, and the bytes of the file that had the name
    /// before.
    Name { from: PathBuf, to: PathBuf, before: Option<Vec<u8>> },
}

/// A file's device and number.
type FileId = (u64, u64);

/// What a disk writes whole or not at all, in bytes.
const SECTOR: u64 = 512;

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
        Self::with_fault(at, true)
    }

    /// A disk that fails in the midst of change `at`, counted from 0, and makes all others.
    pub fn failing_at(at: u64) -> Self {
        Self::with_fault(at, false)
    }

    fn with_fault(at: u64, lasts: bool) -> Self {
        let fault = Fault { at, lasts, made: AtomicU64::new(0) };
        Self { fault: Some(Arc::new(fault)), cache: None }
    }

    /// The same disk, which remembers in `cache` what is not synced.
    #[must_use]
    pub fn with_cache(self, cache: &Cache) -> Self {
        Self { cache: Some(cache.clone()), ..self }
    }

    /// Stops a test's disk now, unless it makes every change: what its killed process does later
    /// has no effect.
    pub fn stop(&self) {
        if let Some(fault) = &self.fault {
            fault.made.store(fault.at + 1, Ordering::SeqCst);
        }
    }

    /// Says whether a test's disk has come to the change that fails.
    pub fn has_failed(&self) -> bool {
        self.fault.as_ref().is_some_and(|fault| fault.made.load(Ordering::SeqCst) > fault.at)
    }

    fn fate(&self) -> Fate {
        let Some(fault) = &self.fault else { return Fate::Made };
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
        let write = |bytes: &[u8]| {
            if let Some(cache) = &self.cache {
                cache.remember(file, bytes.len(), offset)?;
            }
            file.write_all_at(bytes, offset)
        };
        match self.fate() {
            Fate::Made => write(bytes),
            Fate::Torn => {
                write(&bytes[..bytes.len() / 2])?;
                Err(failed())
            }
            Fate::Lost => Err(failed()),
        }
    }

    /// Makes what was written into a file outlive a power cut.
    pub fn sync(&self, file: &File) -> io::Result<()> {
        self.change(|| file.sync_data())?;
        if let Some(cache) = &self.cache {
            let synced = id_of(file)?;
            cache
                .parts()
                .retain(|part| !matches!(part, Unsynced::Part { id, .. } if *id == synced));
        }
        Ok(())
    }

    /// Gives a file or a folder another name, in the same folder.
    pub fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        let before = self.cache.as_ref().and_then(|_| fs::read(to).ok());
        self.change(|| fs::rename(from, to))?;
        if let Some(cache) = &self.cache {
            let (from, to) = (from.to_owned(), to.to_owned());
            cache.parts().push(Unsynced::Name { from, to, before });
        }
        Ok(())
    }

    /// Puts a file in place that has these bytes, whatever was there: whole, or not at all, also
    /// after a power cut.
    pub fn replace(&self, path: &Path, bytes: &[u8]) -> io::Result<()> {
        let new = path.with_extension("new");
        let file = self.change(|| File::create(&new))?;
        self.write_at(&file, bytes, 0)?;
        self.sync(&file)?;
        self.rename(&new, path)?;
        self.sync_folder(path.parent().expect("a file lies in a folder"))
    }

    /// Makes the names in a folder outlive a power cut.
    pub fn sync_folder(&self, folder: &Path) -> io::Result<()> {
        self.change(|| File::open(folder)?.sync_all())?;
        if let Some(cache) = &self.cache {
            cache.parts().retain(
                |part| !matches!(part, Unsynced::Name { to, .. } if to.parent() == Some(folder)),
            );
        }
        Ok(())
    }
}

impl Cache {
    fn parts(&self) -> MutexGuard<'_, Vec<Unsynced>> {
        self.0.lock().expect("nothing here panics")
    }

    /// Remembers what a write is about to change.
    fn remember(&self, file: &File, byte_count: usize, offset: u64) -> io::Result<()> {
        let (id, end) = (id_of(file)?, offset + byte_count as u64);
        let file = Arc::new(file.try_clone()?);
        let mut at = offset;
        while at < end {
            let next = end.min((at / SECTOR + 1) * SECTOR);
            let mut before = vec![0; (next - at) as usize];
            // Of what cannot be read, zeros are left.
            let _ = file.read_at(&mut before, at);
            self.parts().push(Unsynced::Part { file: Arc::clone(&file), id, offset: at, before });
            at = next;
        }
        Ok(())
    }

    /// Cuts the power: of what was not synced, each part is lost of which `is_lost` says so.
    pub fn cut_power(&self, mut is_lost: impl FnMut() -> bool) {
        let mut kept = BTreeSet::new();
        let parts = std::mem::take(&mut *self.parts());
        for part in parts.into_iter().rev() {
            match part {
                Unsynced::Part { file, id, offset, before } => {
                    // A sector that was written last has all that was written to it before.
                    let sector = (id, offset / SECTOR);
                    if !kept.contains(&sector) {
                        if is_lost() {
                            let _ = file.write_all_at(&before, offset);
                        } else {
                            kept.insert(sector);
                        }
                    }
                }
                Unsynced::Name { from, to, before } => {
                    if is_lost() {
                        let _ = fs::rename(&to, from);
                        before.map(|bytes| fs::write(to, bytes));
                    }
                }
            }
        }
    }
}

fn id_of(file: &File) -> io::Result<FileId> {
    let metadata = file.metadata()?;
    Ok((metadata.dev(), metadata.ino()))
}

fn failed() -> io::Error {
    io::Error::other("a test has the disk fail")
}

#[cfg(test)]
mod tests {
    use tempfile::TempDir;

    use super::*;

    #[test]
    fn a_power_cut_takes_what_was_not_synced_and_nothing_else() {
        let folder = TempDir::new().unwrap();
        let (path, cache) = (folder.path().join("file"), Cache::default());
        let disk = Disk::default().with_cache(&cache);
        disk.replace(&path, &[1; 1500]).unwrap();
        let mut options = File::options();
        let file = options.read(true).write(true).open(&path).unwrap();
        disk.write_at(&file, &[2; 100], 0).unwrap();
        disk.sync(&file).unwrap();
        // These lie in two sectors, then in the second alone.
        disk.write_at(&file, &[3; 600], 300).unwrap();
        disk.write_at(&file, &[4; 10], 600).unwrap();
        let mut is_lost = [false, true].into_iter();
        cache.cut_power(|| is_lost.next().unwrap());
        let bytes = fs::read(&path).unwrap();
        assert_eq!((bytes[99], bytes[300], bytes[511]), (2, 1, 1), "the first sector is lost");
        assert_eq!((bytes[512], bytes[600], bytes[899]), (3, 4, 3), "and the second is not");

        disk.rename(&path, &folder.path().join("other")).unwrap();
        cache.cut_power(|| true);
        assert_eq!(fs::read(&path).unwrap(), bytes);
        disk.rename(&path, &folder.path().join("other")).unwrap();
        disk.sync_folder(folder.path()).unwrap();
        cache.cut_power(|| true);
        assert!(!path.exists());
    }
}
