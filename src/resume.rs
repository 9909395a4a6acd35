//! What an interrupted `rtfarm render --resume` leaves in a folder beside its picture, for the next
//! one to go on with.

use std::{
    fs::{self, File},
    io,
    path::PathBuf,
};

use anyhow::{Context, bail};
use rtfarm_core::tile::TileId;
use rtfarm_job::Order;
use rtfarm_picture::{Canvas, Disk, TileRecord};
use rustix::{
    fs::{FlockOperation, flock},
    io::Errno,
};

use crate::{BUILD, VERSION, output::Output};

/// Says what the folder's picture shows.
const ABOUT: &str = "about";
const LOCK: &str = "lock";

/// All that the folder may hold.
const NAMES: [&str; 5] = [LOCK, ABOUT, "about.new", "picture", "tiles"];

/// A picture under way, and the tiles that are in it.
pub(crate) type Begun = (Canvas, Vec<(TileId, TileRecord)>);

/// A folder with a picture under way. Nobody else renders in it meanwhile.
#[derive(Debug)]
pub(crate) struct Resume {
    folder: PathBuf,
    _lock: File,
}

impl Resume {
    /// The folder of a picture that is under way.
    pub(crate) fn folder(output: &Output) -> PathBuf {
        output.beside(".rtfarm")
    }

    /// Takes up the picture that an order left, or begins it. Never call this on the async runtime.
    pub(crate) fn open(output: &Output, order: &Order) -> anyhow::Result<(Self, Begun)> {
        let folder = Self::folder(output);
        let in_place = || format!("cannot keep the picture under way in {}", folder.display());
        let lock = lock(&folder).with_context(in_place)?;
        let (resume, about) = (Self { folder: folder.clone(), _lock: lock }, about(order));
        let looks = (order.format, order.transfer);
        let (grid, disk) = (order.grid, Disk::default());
        match fs::read_to_string(folder.join(ABOUT)) {
            Ok(known) if known == about => {
                let canvas = Canvas::open(&folder, grid, looks, about.as_bytes(), &disk);
                match canvas.and_then(|canvas| Ok((canvas.done()?, canvas))) {
                    Ok((done, canvas)) => {
                        let count = grid.count();
                        tracing::info!("going on with {} of {count} tiles", done.len());
                        return Ok((resume, (canvas, done)));
                    }
                    Err(error) => {
                        let folder = folder.display();
                        tracing::warn!("beginning anew, since {folder} is damaged: {error}");
                    }
                }
            }
            Ok(_) => tracing::warn!(
                "beginning anew, since {} is of another scene, other settings (as --compact) or another rtfarm",
                folder.display()
            ),
            Err(error) if error.kind() == io::ErrorKind::NotFound => {}
            Err(error) => return Err(error).with_context(in_place),
        }
        let begin = || {
            for name in NAMES.iter().filter(|&&name| name != LOCK) {
                remove(folder.join(name))?;
            }
            let canvas = Canvas::create(&folder, grid, looks, about.as_bytes(), &disk)?;
            disk.replace(&folder.join(ABOUT), about.as_bytes())?;
            Ok::<Canvas, io::Error>(canvas)
        };
        Ok((resume, (begin().with_context(in_place)?, Vec::new())))
    }

    /// Removes the folder: the picture is there.
    pub(crate) fn remove(self) -> anyhow::Result<()> {
        let remove_all = || {
            NAMES.iter().try_for_each(|name| remove(self.folder.join(name)))?;
            fs::remove_dir(&self.folder)
        };
        remove_all().with_context(|| format!("cannot remove {}", self.folder.display()))
    }
}

/// Makes the folder if there is none, and takes it.
fn lock(folder: &PathBuf) -> anyhow::Result<File> {
    match fs::create_dir(folder) {
        Err(error) if error.kind() != io::ErrorKind::AlreadyExists => return Err(error.into()),
        _ => {}
    }
    for entry in fs::read_dir(folder)? {
        let name = entry?.file_name();
        if !NAMES.iter().any(|ours| name == *ours) {
            bail!("it holds something else: {}", name.display());
        }
    }
    let lock = File::options().write(true).create(true).truncate(false).open(folder.join(LOCK))?;
    match flock(&lock, FlockOperation::NonBlockingLockExclusive) {
        Ok(()) => Ok(lock),
        Err(Errno::WOULDBLOCK) => bail!("another rtfarm is rendering there"),
        Err(error) => Err(error.into()),
    }
}

fn remove(path: PathBuf) -> io::Result<()> {
    match fs::remove_file(path) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
        _ => Ok(()),
    }
}

/// All that a picture's bytes depend on.
fn about(order: &Order) -> String {
    let Order { name: _, prepared, settings, grid, transfer, format } = order;
    let scene = prepared.hash();
    format!(
        "rtfarm {VERSION} ({BUILD})\n{scene}\n{settings:?}\n{grid:?}\n{transfer:?} {format:?}\n"
    )
}
