//! What a farm's state says of a job and of the farm, as it stands in files.

use std::{collections::BTreeMap, sync::Arc};

use prost::Message;
use rtfarm_core::{
    prepared::SceneHash,
    render::{Settings, Tally},
    tile::{Crop, TileGrid, TileSideError},
    transfer::Transfer,
};
use rtfarm_job::{Outcome, Progress};
use rtfarm_picture::PictureFormat;
use rtfarm_proto::{
    WireError, WorkerId, scene_hash, transfer,
    wire::{self, event},
};

use crate::members::{Mark, Standing};

/// What a file begins with that holds a record; then comes the record's hash, then the record.
const MAGIC: [u8; 8] = *b"rtfarm 1";

/// A farm.
#[derive(Clone, PartialEq, Message)]
pub(crate) struct FarmRecord {
    /// 16 random bytes.
    #[prost(bytes = "vec", tag = "1")]
    pub(crate) farm: Vec<u8>,
    /// The last number that was given to a job.
    #[prost(uint64, tag = "2")]
    pub(crate) last_job: u64,
    /// Processes that are kept out, drained or disabled.
    #[prost(message, repeated, tag = "3")]
    pub(crate) processes: Vec<ProcessRecord>,
}

/// What is remembered of a process.
#[derive(Clone, PartialEq, Message)]
pub(crate) struct ProcessRecord {
    #[prost(fixed64, tag = "1")]
    pub(crate) nonce: u64,
    /// The worker as which it lied; 0 if it did not.
    #[prost(uint32, tag = "2")]
    pub(crate) liar: u32,
    /// What it gets, if it did not.
    #[prost(enumeration = "wire::Standing", tag = "3")]
    pub(crate) standing: i32,
}

/// A job. A field that is added later has its default in records that lack it.
#[derive(Clone, PartialEq, Message)]
pub(crate) struct JobRecord {
    /// What its scene is called in logs.
    #[prost(string, tag = "1")]
    pub(crate) name: String,
    /// The build that prepared its scene and renders it; to another one both may be something else.
    #[prost(string, tag = "2")]
    pub(crate) build: String,
    /// What workers are told of it.
    #[prost(message, optional, tag = "3")]
    pub(crate) job: Option<wire::Job>,
    #[prost(enumeration = "wire::Format", tag = "4")]
    pub(crate) format: i32,
    #[prost(enumeration = "wire::Transfer", tag = "5")]
    pub(crate) transfer: i32,
    /// How far it was at its end, once it has ended.
    #[prost(message, optional, tag = "6")]
    pub(crate) end: Option<wire::Event>,
    /// Who wants it.
    #[prost(string, tag = "7")]
    pub(crate) owner: String,
    /// The same order with the same key is for the same job.
    #[prost(string, tag = "8")]
    pub(crate) key: String,
    #[prost(sint32, tag = "9")]
    pub(crate) priority: i32,
    #[prost(bool, tag = "10")]
    pub(crate) is_paused: bool,
    /// The most workers that render it at the same time; 0: any number.
    #[prost(uint32, tag = "11")]
    pub(crate) most_workers: u32,
    /// Whose budget it is in; empty: that of all who have no token of their own.
    #[prost(string, tag = "12")]
    pub(crate) account: String,
    /// Tells what was ordered from what others order.
    #[prost(bytes = "vec", tag = "13")]
    pub(crate) wanted: Vec<u8>,
}

/// What a client says of a job besides what it renders.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Ticket {
    /// What it is called.
    pub(crate) name: String,
    /// Who wants it.
    pub(crate) owner: String,
    /// Whose budget it is in: the owner of the token that it was ordered by; empty if that has
    /// none.
    pub(crate) account: String,
    /// An order of the same account with the same key is for the same job; empty if none is.
    pub(crate) key: String,
    /// Tells what it renders from what other orders with its key want.
    pub(crate) wanted: Vec<u8>,
    pub(crate) priority: i32,
    /// That render it at the same time.
    pub(crate) most_workers: Option<u32>,
}

/// What a job renders.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Plan {
    pub(crate) scene: SceneHash,
    pub(crate) scene_byte_count: u64,
    pub(crate) settings: Settings,
    pub(crate) grid: TileGrid,
    pub(crate) format: PictureFormat,
    pub(crate) transfer: Transfer,
}

/// Why a record says nothing.
#[derive(Debug, thiserror::Error)]
pub(crate) enum RecordError {
    #[error("it is no record of a farm")]
    Foreign,
    #[error("its bytes are not those that were written")]
    Damaged,
    #[error(transparent)]
    Wire(#[from] WireError),
    #[error(transparent)]
    TileSide(#[from] TileSideError),
    #[error(transparent)]
    Message(#[from] prost::DecodeError),
}

/// The bytes of a file that holds a record.
pub(crate) fn seal(record: &impl Message) -> Vec<u8> {
    let record = record.encode_to_vec();
    [&MAGIC[..], blake3::hash(&record).as_bytes(), &record].concat()
}

/// Reads the bytes of a file that holds a record.
pub(crate) fn unseal<M: Message + Default>(bytes: &[u8]) -> Result<M, RecordError> {
    let sealed = bytes.strip_prefix(&MAGIC).ok_or(RecordError::Foreign)?;
    let (hash, record) = sealed.split_at_checked(32).ok_or(RecordError::Damaged)?;
    if blake3::hash(record) != *<&[u8; 32]>::try_from(hash).expect("32 bytes") {
        return Err(RecordError::Damaged);
    }
    Ok(M::decode(record)?)
}

impl FarmRecord {
    /// What is remembered of processes, by their nonces.
    pub(crate) fn marks(&self) -> BTreeMap<u64, Mark> {
        let mark = |process: &ProcessRecord| match (process.liar, process.standing()) {
            (0, wire::Standing::Draining) => Mark::Stationed(Standing::Draining),
            (0, wire::Standing::Disabled) => Mark::Stationed(Standing::Disabled),
            (0, _) => Mark::Stationed(Standing::Active),
            (liar, _) => Mark::Liar(WorkerId(liar)),
        };
        self.processes.iter().map(|process| (process.nonce, mark(process))).collect()
    }
}

impl ProcessRecord {
    pub(crate) fn new((&nonce, mark): (&u64, &Mark)) -> Self {
        let (liar, standing) = match *mark {
            Mark::Liar(WorkerId(liar)) => (liar, wire::Standing::Unspecified),
            Mark::Stationed(standing) => (0, to_standing(standing)),
        };
        Self { nonce, liar, standing: standing.into() }
    }
}

/// What a worker gets, for messages and records.
pub(crate) fn to_standing(standing: Standing) -> wire::Standing {
    match standing {
        Standing::Active => wire::Standing::Active,
        Standing::Draining => wire::Standing::Draining,
        Standing::Disabled => wire::Standing::Disabled,
    }
}

impl JobRecord {
    pub(crate) fn new(ticket: &Ticket, build: &str, plan: &Plan) -> Self {
        let &Plan { scene, scene_byte_count, settings, grid, format, transfer } = plan;
        let job = wire::Job {
            scene_hash: scene.0.to_vec().into(),
            scene_bytes: scene_byte_count,
            scene_path: String::new(),
            settings: Some(settings.into()),
            tile_side: grid.side(),
            window: Some(Crop::from(grid.window()).into()),
        };
        let Ticket { name, owner, account, key, wanted, priority, most_workers } = ticket.clone();
        Self {
            name,
            owner,
            account,
            key,
            wanted,
            priority,
            is_paused: false,
            most_workers: most_workers.unwrap_or(0),
            build: build.to_owned(),
            job: Some(job),
            format: wire::Format::from(format).into(),
            transfer: wire::Transfer::from(transfer).into(),
            end: None,
        }
    }

    pub(crate) fn ticket(&self) -> Ticket {
        let Self { name, owner, account, key, wanted, priority, most_workers, .. } = self.clone();
        let most_workers = (most_workers > 0).then_some(most_workers);
        Ticket { name, owner, account, key, wanted, priority, most_workers }
    }

    pub(crate) fn plan(&self) -> Result<Plan, RecordError> {
        let job = self.job.as_ref().ok_or(WireError::Missing("job"))?;
        let settings: Settings = job.settings.ok_or(WireError::Missing("settings"))?.try_into()?;
        let window = Crop::from(job.window.ok_or(WireError::Missing("window"))?);
        let window = window.of(settings.size).map_err(WireError::from)?;
        Ok(Plan {
            scene: scene_hash(&job.scene_hash)?,
            scene_byte_count: job.scene_bytes,
            settings,
            grid: TileGrid::new(window, job.tile_side.into())?,
            format: self.format().try_into()?,
            transfer: transfer(self.transfer)?,
        })
    }
}

/// How far a job is, for those who watch it and for its record.
pub(crate) fn to_event(progress: &Progress) -> wire::Event {
    wire::Event {
        tiles_done: progress.tiles_done,
        tile_count: progress.tile_count,
        tally: Some(progress.tally.into()),
        workers: progress.worker_count,
        hosts: progress.outcome.iter().flat_map(|_| progress.hosts.iter().cloned()).collect(),
        differing_tiles: progress.differing_tiles,
        obstacle: progress.obstacle.clone().unwrap_or_default(),
        left: progress.left.map(|left| wire::TimeLeft {
            mean: left.mean.as_secs_f64(),
            error: left.error.as_secs_f64(),
        }),
        end: progress.outcome.as_ref().map(|outcome| match outcome {
            Outcome::Finished(time) => {
                event::End::Finished(wire::Finished { seconds: time.as_secs_f64() })
            }
            Outcome::Failed(reason) => event::End::Failed(reason.clone()),
        }),
    }
}

/// How far a job was according to its record.
pub(crate) fn to_progress(event: &wire::Event) -> Result<Progress, RecordError> {
    let outcome = event.end.as_ref().map(|end| match end {
        event::End::Finished(wire::Finished { seconds }) => {
            Outcome::Finished(std::time::Duration::try_from_secs_f64(*seconds).unwrap_or_default())
        }
        event::End::Failed(reason) => Outcome::Failed(reason.clone()),
    });
    Ok(Progress {
        tiles_done: event.tiles_done,
        tile_count: event.tile_count,
        tally: Tally::try_from(event.tally.unwrap_or_default())?,
        worker_count: event.workers,
        hosts: Arc::new(event.hosts.iter().cloned().collect()),
        differing_tiles: event.differing_tiles,
        outcome,
        ..Progress::default()
    })
}
