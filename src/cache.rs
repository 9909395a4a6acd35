//! Prepared scenes that are kept between renders, in the user's cache folder.
//!
//! An entry is found by the scene's text, and used if every file that the scene names has the
//! content that it had; so nobody has to say when something changed. It is a file: a line with a
//! hash and what it is the hash of, as JSON, and the prepared scene, which has a hash of its own.
//! One that is damaged, foreign or of another build is as good as none.

use std::{
    fs::{self, DirBuilder, File, Metadata},
    io::{self, BufRead, BufReader, Read, Write},
    os::unix::fs::{DirBuilderExt, FileExt, MetadataExt},
    path::{Path, PathBuf},
    sync::Mutex,
    time::Duration,
};

use blake3::Hash;
use rtfarm_core::{
    prepare::Form,
    prepared::{PreparedBytes, PreparedScene},
    tile::Size,
    transfer::Transfer,
};
use rtfarm_job::ReadyScene;
use rustix::{
    fs::{AtFlags, CWD, Timespec, Timestamps, UTIME_NOW, utimensat},
    process::geteuid,
};
use serde_json::{Value, json};
use tempfile::NamedTempFile;

use crate::BUILD;

/// Smaller scenes are prepared in some 20 ms.
const SMALLEST: usize = 1 << 20;

/// The most bytes that all entries have together; those that were used least lately go first.
const MOST_BYTES: u64 = 4 << 30;

/// A file that is no entry yet, and is older than this, was left by a process that was killed.
const ABANDONED: Duration = Duration::from_secs(3600);

/// An entry's line is at most so long; a scene whose report and files make it longer is not found.
const LONGEST_LINE: u64 = 1 << 24;

/// What an entry's name ends with.
const EXTENSION: &str = "scene";

/// The cache folder of a user.
#[derive(Debug)]
pub(crate) struct Cache {
    folder: PathBuf,
    most_bytes: u64,
}

/// A scene that was found, and what its author was told.
#[derive(Debug)]
pub(crate) struct Found {
    pub(crate) scene: ReadyScene,
    pub(crate) report: String,
}

/// The files that a scene named while it was read, and what was in them.
#[derive(Debug, Default)]
pub(crate) struct NamedFiles(Mutex<Vec<(String, Hash)>>);

impl NamedFiles {
    pub(crate) fn saw(&self, name: &str, data: &[u8]) {
        let seen = (name.to_owned(), content_hash(data));
        self.0.lock().expect("nothing here panics").push(seen);
    }
}

impl Cache {
    /// The user's, unless there is no such folder and none can be made, or others may write to it.
    pub(crate) fn of_user() -> Option<Self> {
        let base = std::env::var_os("XDG_CACHE_HOME").map(PathBuf::from);
        let base = base.filter(|base| base.is_absolute());
        let base = base.or_else(|| std::env::home_dir().map(|home| home.join(".cache")))?;
        Self::open(base.join("rtfarm"), MOST_BYTES)
    }

    fn open(folder: PathBuf, most_bytes: u64) -> Option<Self> {
        if let Err(error) = DirBuilder::new().recursive(true).mode(0o700).create(&folder) {
            tracing::debug!(folder = %folder.display(), %error, "no cache of prepared scenes");
            return None;
        }
        let is_ours = |found: &Metadata| {
            found.is_dir() && found.uid() == geteuid().as_raw() && found.mode() & 0o022 == 0
        };
        match fs::symlink_metadata(&folder) {
            Ok(found) if is_ours(&found) => Some(Self { folder, most_bytes }),
            _ => {
                let folder = folder.display();
                tracing::warn!(%folder, "not used as a cache: it is not this user's alone");
                None
            }
        }
    }

    /// By which a scene is found; `name` is what its report calls it.
    pub(crate) fn key(name: &str, text: &[u8], transfer: Transfer, form: Form) -> Hash {
        let mut hasher = blake3::Hasher::new();
        hasher.update(format!("{BUILD}\n{transfer:?} {form:?}\n{name}\0").as_bytes()).update(text);
        hasher.finalize()
    }

    /// The scene that was prepared under this key, if the files that it names are as they were.
    pub(crate) fn find(
        &self,
        key: &Hash,
        read: impl Fn(&str) -> io::Result<Vec<u8>>,
    ) -> Option<Found> {
        let path = self.path(key);
        let found = open_entry(key, &File::open(&path).ok()?, read);
        if found.is_some() {
            let now = Timespec { tv_sec: 0, tv_nsec: UTIME_NOW };
            // If it cannot be marked as used it goes sooner, which is all.
            let used = Timestamps { last_access: now, last_modification: now };
            let _ = utimensat(CWD, &path, &used, AtFlags::empty());
        }
        found
    }

    /// Keeps a prepared scene, if preparing it took long enough. Nothing depends on it: whatever is
    /// wrong is told for those who look for it.
    pub(crate) fn keep(
        &self,
        key: &Hash,
        prepared: &PreparedBytes,
        size: Size,
        report: &str,
        files: NamedFiles,
    ) {
        let hash = prepared.hash().to_string();
        let prepared = prepared.as_ref();
        if prepared.len() < SMALLEST || prepared.len() as u64 > self.most_bytes / 4 {
            return;
        }
        let files = files.0.into_inner().expect("nothing here panics");
        let files: Vec<_> =
            files.iter().map(|(name, hash)| json!([name, hash.to_hex().as_str()])).collect();
        let told = json!({
            "key": key.to_hex().as_str(),
            "size": [size.width(), size.height()],
            "report": report,
            "files": files,
            "prepared": hash,
        })
        .to_string();
        let keep = || -> io::Result<()> {
            self.make_room(prepared.len() as u64)?;
            let mut file = NamedTempFile::new_in(&self.folder)?;
            writeln!(file, "{} {told}", blake3::hash(told.as_bytes()).to_hex())?;
            file.write_all(prepared)?;
            file.persist(self.path(key)).map_err(io::Error::from)?;
            Ok(())
        };
        if let Err(error) = keep() {
            tracing::debug!(folder = %self.folder.display(), %error, "a prepared scene is not kept");
        }
    }

    fn path(&self, key: &Hash) -> PathBuf {
        self.folder.join(key.to_hex().as_str()).with_extension(EXTENSION)
    }

    /// Removes entries until `wanted` bytes have room, and what killed processes left half-written.
    fn make_room(&self, wanted: u64) -> io::Result<()> {
        let mut entries = Vec::new();
        for entry in fs::read_dir(&self.folder)? {
            let (path, found) = entry.and_then(|entry| Ok((entry.path(), entry.metadata()?)))?;
            if found.is_file() {
                entries.push((found.modified()?, found.len(), path));
            }
        }
        entries.sort();
        let mut total: u64 = entries.iter().map(|(_, length, _)| length).sum();
        for (used, length, path) in entries {
            let is_entry = path.extension().is_some_and(|found| found == EXTENSION);
            let is_left = !is_entry && used.elapsed().is_ok_and(|age| age > ABANDONED);
            if is_left || (is_entry && total + wanted > self.most_bytes) {
                remove(&path)?;
                total -= length;
            }
        }
        Ok(())
    }
}

/// Removes a file that may be gone already.
fn remove(path: &Path) -> io::Result<()> {
    match fs::remove_file(path) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
        _ => Ok(()),
    }
}

/// The hash of a file's content, made on rayon's threads.
fn content_hash(data: &[u8]) -> Hash {
    blake3::Hasher::new().update_rayon(data).finalize()
}

fn open_entry(
    key: &Hash,
    entry: &File,
    read: impl Fn(&str) -> io::Result<Vec<u8>>,
) -> Option<Found> {
    let mut line = String::new();
    BufReader::new(entry.take(LONGEST_LINE)).read_line(&mut line).ok()?;
    let start = line.len() as u64;
    let line = line.strip_suffix('\n')?;
    let (hash, told) = line.split_once(' ')?;
    if Hash::from_hex(hash).ok()? != blake3::hash(told.as_bytes()) {
        return None;
    }
    let told: Value = serde_json::from_str(told).ok()?;
    if told["key"].as_str()? != key.to_hex().as_str() {
        return None;
    }
    for file in told["files"].as_array()? {
        let (name, hash) = (file[0].as_str()?, Hash::from_hex(file[1].as_str()?).ok()?);
        if content_hash(&read(name).ok()?) != hash {
            return None;
        }
    }
    let size = Size::new(told["size"][0].as_u64()?, told["size"][1].as_u64()?).ok()?;
    let length = entry.metadata().ok()?.len().checked_sub(start)?;
    let read = |place: &mut [u8], at: usize| entry.read_exact_at(place, start + at as u64);
    let prepared = PreparedBytes::read(usize::try_from(length).ok()?, read).ok()?;
    let scene = PreparedScene::open(&prepared).ok()?;
    if told["prepared"].as_str()? != scene.hash().to_string() {
        return None;
    }
    Some(Found {
        report: told["report"].as_str()?.to_owned(),
        scene: ReadyScene { size, prepared },
    })
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt;

    use rtfarm_core::{language::read_scene, prepare::prepare};
    use tempfile::TempDir;

    use super::*;

    const TRANSFER: Transfer = Transfer::None;

    fn cache(most_bytes: u64) -> (TempDir, Cache) {
        let folder = tempfile::tempdir().unwrap();
        let cache = Cache::open(folder.path().join("rtfarm"), most_bytes).unwrap();
        (folder, cache)
    }

    /// A scene of more than [`SMALLEST`] bytes.
    fn large() -> PreparedBytes {
        let ball = |n: u32| {
            format!("sphere coords {n} {} {} radius 0.4 material m endsphere\n", n * n % 97, n % 31)
        };
        let balls: String = (0..24_000).map(ball).collect();
        let text = format!(
            "viewport origin 0 0 9 topleft -1 1 0 bottomleft -1 -1 0 topright 1 1 0 endviewport
             materials entry name m endentry endmaterials geometry {balls} endgeometry"
        );
        let scene = read_scene(text.as_bytes(), &|_| Err(io::Error::other("none"))).scene.unwrap();
        prepare(&scene).unwrap()
    }

    fn keep(cache: &Cache, key: &Hash, prepared: &PreparedBytes) {
        let files = NamedFiles::default();
        files.saw("mesh.obj", b"v 0 0 0");
        cache.keep(key, prepared, Size::new(64, 36).unwrap(), "a warning", files);
    }

    fn read(name: &str) -> io::Result<Vec<u8>> {
        let is_there = name == "mesh.obj";
        is_there.then(|| b"v 0 0 0".to_vec()).ok_or(io::ErrorKind::NotFound.into())
    }

    #[test]
    fn what_was_kept_is_found_as_long_as_nothing_changes() {
        let (_folder, cache) = cache(1 << 30);
        let prepared = large();
        let key = Cache::key("a.rt", b"text", TRANSFER, Form::Fast);
        assert!(cache.find(&key, read).is_none());
        keep(&cache, &key, &prepared);
        let found = cache.find(&key, read).unwrap();
        assert_eq!(found.scene.prepared.as_ref(), prepared.as_ref());
        assert_eq!(found.scene.size, Size::new(64, 36).unwrap());
        assert_eq!(found.report, "a warning");
        assert!(cache.find(&key, |_| Ok(b"v 0 0 1".to_vec())).is_none(), "a file changed");
        assert!(cache.find(&key, |_| Err(io::Error::other("gone"))).is_none());
        for other in [
            Cache::key("b.rt", b"text", TRANSFER, Form::Fast),
            Cache::key("a.rt", b"texts", TRANSFER, Form::Fast),
            Cache::key("a.rt", b"text", Transfer::Srgb, Form::Fast),
            Cache::key("a.rt", b"text", TRANSFER, Form::Compact),
        ] {
            assert!(cache.find(&other, read).is_none());
        }
    }

    #[test]
    fn a_damaged_or_foreign_entry_is_as_good_as_none() {
        let (_folder, cache) = cache(1 << 30);
        let key = Cache::key("a.rt", b"text", TRANSFER, Form::Fast);
        keep(&cache, &key, &large());
        let path = cache.path(&key);
        let whole = fs::read(&path).unwrap();
        let line = whole.iter().position(|&byte| byte == b'\n').unwrap();
        for place in [0, 70, 90, line, line + 1, line + 900, whole.len() / 2, whole.len() - 1] {
            let mut damaged = whole.clone();
            damaged[place] ^= 1;
            fs::write(&path, damaged).unwrap();
            assert!(cache.find(&key, read).is_none(), "byte {place}");
        }
        for length in [0, 10, line, line + 1, whole.len() - 1] {
            fs::write(&path, &whole[..length]).unwrap();
            assert!(cache.find(&key, read).is_none(), "{length} bytes");
        }
        fs::write(&path, whole).unwrap();
        assert!(cache.find(&key, read).is_some());
        let other = Cache::key("b.rt", b"text", TRANSFER, Form::Fast);
        fs::copy(&path, cache.path(&other)).unwrap();
        assert!(cache.find(&other, read).is_none(), "an entry under another's name");
    }

    #[test]
    fn those_used_least_lately_go_first_and_small_ones_are_not_kept() {
        let prepared = large();
        let bytes = prepared.as_ref().len() as u64;
        let (_folder, cache) = cache(4 * bytes + 4096);
        let keys: Vec<_> =
            (0..5_u8).map(|n| Cache::key("a.rt", &[n], TRANSFER, Form::Fast)).collect();
        for key in &keys[..3] {
            keep(&cache, key, &prepared);
        }
        assert!(cache.find(&keys[0], read).is_some());
        for key in &keys[3..] {
            keep(&cache, key, &prepared);
        }
        let is_kept: Vec<bool> = keys.iter().map(|key| cache.find(key, read).is_some()).collect();
        assert_eq!(is_kept, [true, false, true, true, true]);
        let small = read_scene(
            b"viewport origin 0 0 9 topleft -1 1 0 bottomleft -1 -1 0 topright 1 1 0 endviewport",
            &|_| Err(io::Error::other("none")),
        );
        let key = Cache::key("small.rt", b"", TRANSFER, Form::Fast);
        keep(&cache, &key, &prepare(&small.scene.unwrap()).unwrap());
        assert!(cache.find(&key, read).is_none());
    }

    #[test]
    fn a_folder_that_others_write_to_is_not_used() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("rtfarm");
        fs::create_dir(&path).unwrap();
        fs::set_permissions(&path, fs::Permissions::from_mode(0o777)).unwrap();
        assert!(Cache::open(path.clone(), 1 << 30).is_none());
        fs::remove_dir(&path).unwrap();
        std::os::unix::fs::symlink(folder.path(), &path).unwrap();
        assert!(Cache::open(path, 1 << 30).is_none(), "a link");
        assert!(Cache::open("/dev/null/rtfarm".into(), 1 << 30).is_none());
    }
}
