//! The scene's text: long files are mapped, not copied.

use std::{
    collections::BTreeMap,
    fs::{self, File, Metadata},
    io::{self, Read},
    path::Path,
    time::SystemTime,
};

use anyhow::Context;
use memmap2::Mmap;
use rtfarm_core::language::referenced_files;
use tokio::task::spawn_blocking;
use tokio_util::sync::CancellationToken;

use crate::{args::SceneArgs, failure::Failure, scene_files::SceneFiles};

/// From here on a copy would count.
const LONG: u64 = 16 << 20;

/// The longest text of a device or a pipe: one that has no end is not waited for.
const LONGEST_STREAM: u64 = 4 << 30;

/// A scene's text, in memory or mapped.
#[derive(Debug)]
pub(crate) enum SceneText {
    Copied(Vec<u8>),
    Mapped { map: Mmap, file: File, state: FileState },
}

/// By which a file that was written to is known.
#[derive(Debug, PartialEq)]
pub(crate) struct FileState {
    length: u64,
    written: Option<SystemTime>,
}

impl FileState {
    fn new(metadata: &Metadata) -> Self {
        Self { length: metadata.len(), written: metadata.modified().ok() }
    }
}

impl SceneText {
    /// Reads the scene's file or standard input.
    pub(crate) async fn read(scene: &SceneArgs, stop: &CancellationToken) -> Result<Self, Failure> {
        let (path, is_from_stdin) = (scene.path.clone(), scene.is_from_stdin());
        let read = spawn_blocking(move || {
            if is_from_stdin {
                read_stream(io::stdin().lock(), LONGEST_STREAM).map(Self::Copied)
            } else {
                Self::open(&path)
            }
        });
        let text = tokio::select! {
            text = read => text?,
            () = stop.cancelled() => return Err(Failure::Interrupted),
        };
        let text = text.with_context(|| format!("cannot read the scene {}", scene.name()));
        text.map_err(Failure::Input)
    }

    #[expect(unsafe_code, reason = "a map is as good as what is known about its file")]
    fn open(path: &Path) -> io::Result<Self> {
        let metadata = fs::metadata(path)?;
        if metadata.is_dir() {
            return Err(io::Error::other("it is a folder"));
        }
        let file = File::open(path)?;
        if !metadata.is_file() || metadata.len() < LONG {
            return read_stream(file, LONGEST_STREAM).map(Self::Copied);
        }
        let state = FileState::new(&file.metadata()?);
        // SAFETY: the bytes are only ever read, by a reader that takes any bytes whatever and holds
        // no assumption about them from one look to the next; that nobody wrote to the file in
        // the meantime is asked afterwards, before anything is made of what was read. Who cuts a
        // file short while it is read ends the process (SIGBUS), as with every program that maps.
        let map = unsafe { Mmap::map(&file) }?;
        Ok(Self::Mapped { map, file, state })
    }

    /// Refuses a text whose file was written to since it was opened.
    pub(crate) fn ensure_unchanged(&self) -> io::Result<()> {
        match self {
            Self::Mapped { file, state, .. } if FileState::new(&file.metadata()?) != *state => {
                Err(io::Error::other("the file was written to while it was read"))
            }
            _ => Ok(()),
        }
    }
}

/// Reads all of it, which is at most so many bytes.
fn read_stream(stream: impl Read, most: u64) -> io::Result<Vec<u8>> {
    let mut text = Vec::new();
    if stream.take(most + 1).read_to_end(&mut text)? as u64 > most {
        let gigabytes = most >> 30;
        return Err(io::Error::other(format!("it goes on after {gigabytes} GiB, and is no file")));
    }
    Ok(text)
}

impl std::ops::Deref for SceneText {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        match self {
            Self::Copied(text) => text,
            Self::Mapped { map, .. } => map,
        }
    }
}

/// The files that a scene names, by the names that it has for them, each told before it is sent.
/// One that may not or cannot be read is left out: the coordinator will miss it where the scene
/// names it.
pub(crate) fn read_named_files(text: &[u8], files: &SceneFiles) -> BTreeMap<String, Vec<u8>> {
    let mut read = BTreeMap::new();
    for name in referenced_files(text) {
        if read.contains_key(&name) {
            continue;
        }
        match files.read(&name) {
            Ok(data) => {
                tracing::info!(file = name, bytes = data.len(), "sending a file of the scene");
                read.insert(name, data);
            }
            Err(error) => tracing::warn!(file = name, reason = %error, "not sent"),
        }
    }
    read
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use super::*;

    #[test]
    fn every_file_that_a_scene_names_is_read_once_if_it_is_there() {
        let folder = tempfile::tempdir().unwrap();
        for name in ["wood.png", "teapot.obj", "unnamed.png"] {
            fs::write(folder.path().join(name), name).unwrap();
        }
        let material = |name, texture| {
            format!("entry\n name {name}\n color 1 1 1\n texture {texture}\nendentry\n")
        };
        let materials =
            [material("a", "wood.png"), material("b", "wood.png"), material("c", "gone.png")];
        let mesh = "geometry\nmesh\n file teapot.obj\n material a\nendmesh\nendgeometry\n";
        let files = SceneFiles::in_folder(folder.path().to_owned(), Vec::new());
        let text = format!("materials\n{}endmaterials\n{mesh}", materials.concat());
        let read = read_named_files(text.as_bytes(), &files);
        let expected = ["teapot.obj", "wood.png"].map(|name| (name.to_owned(), name.into()));
        assert_eq!(read, BTreeMap::from(expected));
    }

    #[test]
    fn a_stream_without_an_end_is_refused() {
        assert_eq!(read_stream(&b"text"[..], 4).unwrap(), b"text");
        let endless = read_stream(io::repeat(b' '), 1 << 20).unwrap_err();
        assert!(endless.to_string().starts_with("it goes on"), "{endless}");
    }

    #[test]
    fn a_long_file_that_changes_is_refused() {
        let mut file = tempfile::NamedTempFile::new().unwrap();
        file.write_all(&vec![b' '; LONG as usize]).unwrap();
        let text = SceneText::open(file.path()).unwrap();
        assert!(matches!(text, SceneText::Mapped { .. }));
        assert_eq!(text.len() as u64, LONG);
        text.ensure_unchanged().unwrap();
        file.write_all(b"# more\n").unwrap();
        text.ensure_unchanged().unwrap_err();
    }
}
