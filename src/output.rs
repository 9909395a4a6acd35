//! The picture's file: checked before anything is done, written beside its place, then renamed.

use std::{
    fs::{self, File},
    io::{self, BufWriter, Seek, SeekFrom, Write},
    os::unix::fs::PermissionsExt,
    path::{Path, PathBuf},
};

use anyhow::{Context, bail, ensure};
use rtfarm_picture::PictureFormat;
use tempfile::NamedTempFile;
use tokio_util::sync::CancellationToken;

/// Where a picture goes and how it is written.
#[derive(Debug, Clone)]
pub(crate) struct Output {
    /// As the user wrote it.
    name: PathBuf,
    /// Where the file is, links followed.
    path: PathBuf,
    format: PictureFormat,
}

impl Output {
    /// Chooses the format by the path's extension and, for a PNG, the bits a channel.
    pub(crate) fn new(path: &Path, depth: Option<&str>) -> anyhow::Result<Self> {
        let extension = path.extension().map(|extension| extension.to_string_lossy());
        let format = match extension.map(|extension| extension.to_lowercase()).as_deref() {
            Some("png") if depth == Some("16") => PictureFormat::Png16,
            Some("png") => PictureFormat::Png8,
            Some("exr") => {
                ensure!(depth.is_none(), "--depth is for PNG; an EXR has 32-bit floats");
                PictureFormat::ExrF32
            }
            _ => bail!("the output {} must end in .png or .exr", path.display()),
        };
        Ok(Self { name: path.to_owned(), path: path.to_owned(), format })
    }

    /// The path as the user wrote it.
    pub(crate) fn name(&self) -> &Path {
        &self.name
    }

    /// Where the file is.
    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    pub(crate) fn format(&self) -> PictureFormat {
        self.format
    }

    /// The path of something that belongs to the picture and stands beside it.
    pub(crate) fn beside(&self, extension: &str) -> PathBuf {
        let mut path = self.path.clone().into_os_string();
        path.push(extension);
        path.into()
    }

    /// The folder that the picture will be in.
    pub(crate) fn folder(&self) -> PathBuf {
        folder_of(&self.path)
    }

    /// Finds out now whether the picture can be written later.
    pub(crate) fn check(&mut self) -> anyhow::Result<()> {
        if let Ok(metadata) = fs::metadata(&self.path) {
            let path = self.name.display();
            ensure!(!metadata.is_dir(), "the output {path} is a folder");
            ensure!(metadata.is_file(), "the output {path} is there and is no plain file");
            // A link stays one: the file that it leads to is replaced.
            self.path = fs::canonicalize(&self.path)?;
        }
        let folder = self.folder();
        tempfile::tempfile_in(&folder)
            .map(drop)
            .with_context(|| format!("cannot write into the folder {}", folder.display()))
    }

    /// Has `write` fill a file beside the picture's place, then puts it there. When that fails or
    /// `stop` comes, nothing is left behind. Never call this on the async runtime.
    pub(crate) fn write(
        &self,
        stop: &CancellationToken,
        write: impl FnOnce(&mut OutputFile<'_>) -> io::Result<()>,
    ) -> anyhow::Result<()> {
        self.write_at(&self.path, &self.name, stop, write)
    }

    /// The same for something that stands beside the picture.
    pub(crate) fn write_beside(
        &self,
        extension: &str,
        stop: &CancellationToken,
        write: impl FnOnce(&mut OutputFile<'_>) -> io::Result<()>,
    ) -> anyhow::Result<()> {
        let path = self.beside(extension);
        self.write_at(&path, &path, stop, write)
    }

    fn write_at(
        &self,
        path: &Path,
        name: &Path,
        stop: &CancellationToken,
        write: impl FnOnce(&mut OutputFile<'_>) -> io::Result<()>,
    ) -> anyhow::Result<()> {
        let in_place = || format!("cannot write {}", name.display());
        let mut file = tempfile::Builder::new()
            .prefix(".rtfarm-")
            .permissions(fs::Permissions::from_mode(0o666))
            .tempfile_in(self.folder())
            .with_context(in_place)?;
        let mut out = OutputFile { file: BufWriter::with_capacity(1 << 16, &mut file), stop };
        write(&mut out).and_then(|()| out.file.flush()).with_context(in_place)?;
        drop(out);
        // After a power cut there is the old file or the whole new one.
        file.as_file().sync_all().with_context(in_place)?;
        file.persist(path).map_err(|error| error.error).with_context(in_place)?;
        // Some file systems cannot sync a folder; the picture is written all the same.
        let _ = File::open(self.folder()).and_then(|folder| folder.sync_all());
        Ok(())
    }
}

/// A file being written, until somebody stops it.
#[derive(Debug)]
pub(crate) struct OutputFile<'a> {
    file: BufWriter<&'a mut NamedTempFile>,
    stop: &'a CancellationToken,
}

impl Write for OutputFile<'_> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        if self.stop.is_cancelled() {
            return Err(io::Error::other("interrupted"));
        }
        self.file.write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.file.flush()
    }
}

impl Seek for OutputFile<'_> {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        self.file.seek(to)
    }
}

/// The folder in which a file of that path stands.
pub(crate) fn folder_of(path: &Path) -> PathBuf {
    match path.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder.to_owned(),
        _ => PathBuf::from("."),
    }
}
