//! A farm's state in a folder, which outlives its coordinator. It has these files:
//!
//! ```text
//! lock                      locked while a coordinator uses the folder; has the number of its process
//! farm                      the farm's id and the last number of a job: a record
//! jobs/12/job               what is rendered and how it ended: a record
//! jobs/12/scene             the prepared scene; jobs with the same scene share the file
//! jobs/12/picture, tiles    the pixels, and a record of each tile in it: a canvas
//! ```
//!
//! Records are replaced whole. A job's folder gets its name when all in it is safe, and loses it
//! before anything in it goes: one with another name than a number is what a killed process left.

use std::{
    collections::BTreeMap,
    fs::{self, DirBuilder, File},
    io::{self, Read, Write},
    os::unix::fs::DirBuilderExt,
    path::{Path, PathBuf},
    sync::Mutex,
    time::Duration,
};

use rtfarm_core::{
    prepared::{PreparedBytes, PreparedScene},
    tile::TileId,
};
use rtfarm_job::Progress;
use rtfarm_picture::{Canvas, Disk, TileRecord};
use rtfarm_proto::{FarmId, JobId, wire};
use rustix::{
    fs::{FlockOperation, flock},
    io::Errno,
};

use crate::{
    members::Mark,
    record::{
        FarmRecord, JobRecord, Plan, ProcessRecord, RecordError, Ticket, seal, to_progress, unseal,
    },
    store::SceneFile,
};

const LOCK: &str = "lock";
const FARM: &str = "farm";
const JOBS: &str = "jobs";
const JOB: &str = "job";
const SCENE: &str = "scene";

/// What becomes of a job's folder is decided by its name.
const BEGUN: &str = "begun-";
const GONE: &str = "gone-";

/// Why a folder cannot be used for a farm's state.
#[derive(Debug, thiserror::Error)]
pub enum StateError {
    /// It holds something else.
    #[error(
        "{} is not empty and holds no state of a farm; name an empty folder or one that does not \
         exist", .0.display()
    )]
    Foreign(PathBuf),
    /// Another coordinator uses it.
    #[error("another coordinator (process {process}) uses the state in {folder}", folder = .0.display(), process = .1)]
    Locked(PathBuf, String),
    /// A file does not have what was written into it.
    #[error("the state is damaged: {path}: {reason}", path = .0.display(), reason = .1)]
    Damaged(PathBuf, String),
    /// It cannot be read or written.
    #[error("cannot use the state in {folder}: {error}", folder = .0.display(), error = .1)]
    Io(PathBuf, io::Error),
}

/// How safe a tile is when its worker is told that it is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Durability {
    /// A killed coordinator loses nothing, a power cut the last second.
    Second,
    /// A power cut loses nothing either.
    Tile,
}

/// A farm's state, open. Nobody else can open it meanwhile.
#[derive(Debug)]
pub struct StateFolder {
    path: PathBuf,
    _lock: File,
    farm: FarmId,
    /// What is kept of the farm.
    record: Mutex<FarmRecord>,
    build: String,
    pub(crate) durability: Durability,
    disk: Disk,
    /// The jobs that were there when it was opened.
    pub(crate) kept: Vec<KeptJob>,
}

/// A job that an earlier coordinator left.
#[derive(Debug)]
pub(crate) struct KeptJob {
    pub(crate) id: JobId,
    pub(crate) ticket: Ticket,
    pub(crate) is_paused: bool,
    /// Another build began it.
    pub(crate) is_foreign: bool,
    pub(crate) plan: Plan,
    pub(crate) scene: SceneFile,
    pub(crate) canvas: Canvas,
    /// The tiles in its picture, unless it has ended.
    pub(crate) done: Vec<(TileId, TileRecord)>,
    /// How far it was at its end, and how long ago that was.
    pub(crate) end: Option<(Progress, Duration)>,
    pub(crate) folder: JobFolder,
}

/// Where a job is kept.
#[derive(Debug)]
pub(crate) struct JobFolder {
    path: PathBuf,
    disk: Disk,
    /// `None` when the job is forgotten.
    record: Mutex<Option<JobRecord>>,
}

impl StateFolder {
    /// Opens the state in the folder `path`, which is made if there is none. Tiles that do not
    /// match their records are not done. A job that another `build` began cannot be finished and
    /// has failed.
    pub fn open(path: &Path, build: &str, durability: Durability) -> Result<Self, StateError> {
        Self::open_on(Disk::default(), path, build, durability)
    }

    pub(crate) fn open_on(
        disk: Disk,
        path: &Path,
        build: &str,
        durability: Durability,
    ) -> Result<Self, StateError> {
        let io = |error| StateError::Io(path.to_owned(), error);
        if !path.exists() {
            disk.change(|| DirBuilder::new().mode(0o700).create(path)).map_err(io)?;
        }
        let names = fs::read_dir(path).and_then(Iterator::collect::<io::Result<Vec<_>>>);
        let names: Vec<_> = names.map_err(io)?.iter().map(fs::DirEntry::file_name).collect();
        let farm_path = path.join(FARM);
        let (is_known, jobs) = (farm_path.exists(), path.join(JOBS));
        // Certificates may have been made before, and a file system of its own has a folder as
        // well.
        let known = [LOCK, "farm.new", JOBS, "access", "lost+found"];
        if !is_known && names.iter().any(|name| !known.iter().any(|known| name == known)) {
            return Err(StateError::Foreign(path.to_owned()));
        }
        let lock = lock(path, &disk)?;
        if !is_known && jobs.exists() {
            return Err(StateError::Damaged(farm_path, "it is missing".to_owned()));
        }
        let record = if is_known { read_record(&farm_path)? } else { new_farm().map_err(io)? };
        let farm = record.farm.as_slice().try_into().map(FarmId);
        let farm =
            farm.map_err(|_| StateError::Damaged(farm_path.clone(), "it has no id".to_owned()))?;
        // Written anew each time: whether the folder can be written to is known at once.
        disk.replace(&farm_path, &seal(&record)).map_err(io)?;
        if !jobs.exists() {
            disk.change(|| fs::create_dir(&jobs)).map_err(io)?;
            disk.sync_folder(path).map_err(io)?;
        }
        let mut state = Self {
            path: path.to_owned(),
            _lock: lock,
            farm,
            record: Mutex::new(record),
            build: build.to_owned(),
            durability,
            disk,
            kept: Vec::new(),
        };
        state.kept = state.read_jobs()?;
        Ok(state)
    }

    pub(crate) fn farm(&self) -> FarmId {
        self.farm
    }

    /// The last number that was given to a job.
    pub(crate) fn last_job(&self) -> JobId {
        JobId(self.record.lock().expect("writing never panics").last_job)
    }

    /// What is remembered of processes, by their nonces.
    pub(crate) fn marks(&self) -> BTreeMap<u64, Mark> {
        self.record.lock().expect("writing never panics").marks()
    }

    /// Keeps what is remembered of processes.
    pub(crate) fn keep_marks(&self, marks: &BTreeMap<u64, Mark>) -> io::Result<()> {
        self.change(|record| record.processes = marks.iter().map(ProcessRecord::new).collect())
    }

    /// The jobs, the earliest first. What a killed process left is removed.
    fn read_jobs(&self) -> Result<Vec<KeptJob>, StateError> {
        let folder = self.path.join(JOBS);
        let io = |error| StateError::Io(folder.clone(), error);
        let mut jobs = Vec::new();
        // What is found here counts as safe, and the process before may not have come to it.
        self.disk.sync_folder(&folder).map_err(io)?;
        for entry in fs::read_dir(&folder).map_err(io)? {
            let entry = entry.map_err(io)?;
            let name = entry.file_name().into_string().unwrap_or_default();
            if name.starts_with(BEGUN) || name.starts_with(GONE) {
                self.disk.change(|| fs::remove_dir_all(entry.path())).map_err(io)?;
            } else if let Ok(number) = name.parse() {
                jobs.push(self.read_job(JobId(number), &entry.path())?);
            }
        }
        jobs.sort_by_key(|job| job.id);
        Ok(jobs)
    }

    fn read_job(&self, id: JobId, path: &Path) -> Result<KeptJob, StateError> {
        let damaged = |name: &str, error: &dyn ToString| {
            StateError::Damaged(path.join(name), error.to_string())
        };
        self.disk.sync_folder(path).map_err(|error| damaged("", &error))?;
        let record: JobRecord = read_record(&path.join(JOB))?;
        let of_record = |error: RecordError| damaged(JOB, &error);
        let plan = record.plan().map_err(of_record)?;
        let Plan { scene: hash, scene_byte_count, grid, format, transfer, .. } = plan;
        let scene = SceneFile::kept(path.join(SCENE), hash, scene_byte_count);
        let canvas = Canvas::open(path, grid, (format, transfer), &self.subject(id), &self.disk);
        let canvas = canvas.map_err(|error| damaged("", &error))?;
        let mut end = record.end.as_ref().map(to_progress).transpose().map_err(of_record)?;
        let mut done = Vec::new();
        let folder = JobFolder {
            path: path.to_owned(),
            disk: self.disk.clone(),
            record: Mutex::new(Some(record.clone())),
        };
        if end.is_none() && record.build != self.build {
            let reason = format!(
                "it was begun by rtfarm {}, and this is {}; submit it again",
                record.build, self.build
            );
            let failed = wire::Event {
                end: Some(wire::event::End::Failed(reason)),
                ..no_event(grid.count())
            };
            end = Some(to_progress(&failed).map_err(of_record)?);
            folder
                .change(|record| record.end = Some(failed))
                .map_err(|error| damaged(JOB, &error))?;
        }
        if end.is_none() {
            let bytes = fs::read(scene.path()).map_err(|error| damaged(SCENE, &error))?;
            let opened = PreparedScene::open(PreparedBytes::copy_from(&bytes));
            let opened = opened.map_err(|error| damaged(SCENE, &error))?;
            if opened.hash() != hash {
                return Err(damaged(SCENE, &"it is another scene"));
            }
            canvas.sync().map_err(|error| damaged("", &error))?;
            done = canvas.done().map_err(|error| damaged("", &error))?;
        }
        let ticket = record.ticket();
        let (is_paused, is_foreign) = (record.is_paused, record.build != self.build);
        // The record is written last at its end.
        let age = || fs::metadata(path.join(JOB)).ok()?.modified().ok()?.elapsed().ok();
        let end = end.map(|end| (end, age().unwrap_or_default()));
        Ok(KeptJob { id, ticket, is_paused, is_foreign, plan, scene, canvas, done, end, folder })
    }

    /// Keeps a job before anybody is told of it. `same` is a file with the same scene, if there is
    /// one.
    pub(crate) fn create_job(
        &self,
        id: JobId,
        (ticket, plan): (&Ticket, &Plan),
        prepared: &PreparedBytes,
        same: Option<&Path>,
    ) -> io::Result<(SceneFile, Canvas, JobFolder)> {
        self.keep_number(id)?;
        let jobs = self.path.join(JOBS);
        let (begun, path) = (jobs.join(format!("{BEGUN}{id}")), jobs.join(id.to_string()));
        let create = || -> io::Result<(Canvas, JobRecord)> {
            self.disk.change(|| fs::create_dir(&begun))?;
            SceneFile::keep(&begun.join(SCENE), prepared, same, &self.disk)?;
            let looks = (plan.format, plan.transfer);
            let canvas = Canvas::create(&begun, plan.grid, looks, &self.subject(id), &self.disk)?;
            let record = JobRecord::new(ticket, &self.build, plan);
            self.disk.replace(&begun.join(JOB), &seal(&record))?;
            self.disk.rename(&begun, &path)?;
            self.disk.sync_folder(&jobs)?;
            Ok((canvas, record))
        };
        let (canvas, record) = create().inspect_err(|_| {
            let _ = self.disk.change(|| fs::remove_dir_all(&begun));
        })?;
        let scene = SceneFile::kept(path.join(SCENE), plan.scene, plan.scene_byte_count);
        let record = Mutex::new(Some(record));
        Ok((scene, canvas, JobFolder { path, disk: self.disk.clone(), record }))
    }

    /// Makes sure that a number is never given again.
    fn keep_number(&self, id: JobId) -> io::Result<()> {
        self.change(|record| record.last_job = id.0.max(record.last_job))
    }

    fn change(&self, change: impl FnOnce(&mut FarmRecord)) -> io::Result<()> {
        let mut kept = self.record.lock().expect("writing never panics");
        let mut record = kept.clone();
        change(&mut record);
        self.disk.replace(&self.path.join(FARM), &seal(&record))?;
        *kept = record;
        Ok(())
    }

    /// What tells a job's picture from every other.
    fn subject(&self, job: JobId) -> Vec<u8> {
        [&self.farm.0[..], &job.0.to_le_bytes()].concat()
    }
}

impl JobFolder {
    /// Changes what is kept of the job; does nothing when it is forgotten.
    pub(crate) fn change(&self, change: impl FnOnce(&mut JobRecord)) -> io::Result<()> {
        let mut kept = self.record.lock().expect("writing never panics");
        let Some(record) = kept.as_mut() else { return Ok(()) };
        let mut changed = record.clone();
        change(&mut changed);
        if changed == *record {
            return Ok(());
        }
        self.disk.replace(&self.path.join(JOB), &seal(&changed))?;
        *record = changed;
        Ok(())
    }

    /// Forgets the job. When this returns no later coordinator finds it.
    pub(crate) fn forget(&self) -> io::Result<()> {
        let mut kept = self.record.lock().expect("writing never panics");
        let (Some(jobs), Some(id)) = (self.path.parent(), self.path.file_name()) else {
            return Ok(());
        };
        if kept.take().is_none() {
            return Ok(());
        }
        let gone = jobs.join(format!("{GONE}{}", id.display()));
        self.disk.rename(&self.path, &gone)?;
        self.disk.sync_folder(jobs)?;
        self.disk.change(|| fs::remove_dir_all(&gone))
    }
}

/// Takes the folder for this process.
fn lock(folder: &Path, disk: &Disk) -> Result<File, StateError> {
    let io = |error| StateError::Io(folder.to_owned(), error);
    let mut options = File::options();
    options.read(true).write(true).create(true).truncate(false);
    let mut file = disk.change(|| options.open(folder.join(LOCK))).map_err(io)?;
    match flock(&file, FlockOperation::NonBlockingLockExclusive) {
        Ok(()) => {}
        Err(Errno::WOULDBLOCK) => {
            let mut process = String::new();
            let _ = file.read_to_string(&mut process);
            return Err(StateError::Locked(folder.to_owned(), process.trim().to_owned()));
        }
        Err(error) => return Err(io(error.into())),
    }
    // For the message above alone: a full disk may cut it short.
    let _ = disk.change(|| file.set_len(0).and_then(|()| writeln!(file, "{}", std::process::id())));
    Ok(file)
}

fn new_farm() -> io::Result<FarmRecord> {
    let mut farm = vec![0; 16];
    rustix::rand::getrandom(&mut farm, rustix::rand::GetRandomFlags::empty())?;
    Ok(FarmRecord { farm, ..FarmRecord::default() })
}

fn read_record<M: prost::Message + Default>(path: &Path) -> Result<M, StateError> {
    let damaged = |error: &dyn ToString| StateError::Damaged(path.to_owned(), error.to_string());
    let bytes = fs::read(path).map_err(|error| damaged(&error))?;
    unseal(&bytes).map_err(|error| damaged(&error))
}

/// Nothing was done of a job.
fn no_event(tile_count: u32) -> wire::Event {
    wire::Event { tile_count, ..wire::Event::default() }
}
