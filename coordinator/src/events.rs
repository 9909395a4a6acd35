//! What happens on a farm, for machines: a JSON object each, in a file line by line, and the last
//! of them for those who watch.

use std::{
    collections::{BTreeMap, VecDeque},
    fs::File,
    io::{self, Write},
    path::{Path, PathBuf},
    sync::{
        Mutex,
        mpsc::{SyncSender, TrySendError, sync_channel},
    },
    thread,
    time::{Duration, SystemTime},
};

use rtfarm_core::tile::TileId;
use rtfarm_proto::JobId;
use serde_json::{Map, Value, json};

use crate::{
    farm::{Delivery, Notice},
    members::Process,
};

/// So many events are kept for those who begin to watch.
const MOST_KEPT: usize = 100;

/// So many lines may wait to be written. What comes while there is no room is counted, not kept.
const MOST_WAITING: usize = 1 << 14;

/// The events of one start of a farm.
#[derive(Debug, Default)]
pub(crate) struct Events {
    kept: Mutex<Kept>,
    counts: Mutex<Counts>,
    file: Option<EventFile>,
}

/// What happened so far, counted.
#[derive(Debug, Clone, Default)]
pub(crate) struct Counts {
    /// Tiles that came into pictures, rays that were traced for them, and seconds on one thread.
    pub(crate) tiles: u64,
    pub(crate) rays: u64,
    pub(crate) seconds: f64,
    /// Other events, by their names.
    pub(crate) by_name: BTreeMap<&'static str, u64>,
}

#[derive(Debug, Default)]
struct Kept {
    events: VecDeque<Value>,
    /// Of all that there were.
    count: u64,
}

#[derive(Debug)]
struct EventFile {
    lines: SyncSender<String>,
    lost: Mutex<u64>,
}

impl Events {
    /// Appends them to a file besides, if one is named.
    pub(crate) fn new(path: Option<&Path>) -> io::Result<Self> {
        let file = path.map(EventFile::open).transpose()?;
        Ok(Self { file, ..Self::default() })
    }

    /// Notes what happens. Nobody waits for the file.
    pub(crate) fn on_notice(&self, notice: &Notice) {
        let is_tile = if let Notice::TileDone { delivery, .. } = notice {
            let mut counts = self.counts.lock().expect("nothing here panics");
            counts.tiles += 1;
            counts.rays = counts.rays.saturating_add(delivery.tally.rays);
            counts.seconds += delivery.seconds;
            true
        } else {
            false
        };
        if is_tile && self.file.is_none() {
            return;
        }
        let (name, fields) = describe(notice);
        self.note(name, fields, !is_tile);
    }

    /// Notes that a job is there to be rendered.
    pub(crate) fn on_job(&self, job: JobId, name: &str) {
        self.note("job started", json!({ "job": job.0.to_string(), "name": name }), true);
    }

    /// Notes that a job has finished, after that time.
    pub(crate) fn on_finished(&self, job: JobId, time: Duration) {
        let fields = json!({ "job": job.0.to_string(), "seconds": time.as_secs_f64() });
        self.note("job finished", fields, true);
    }

    /// What happened so far, counted.
    pub(crate) fn counts(&self) -> Counts {
        self.counts.lock().expect("nothing here panics").clone()
    }

    fn note(&self, name: &'static str, fields: Value, is_kept: bool) {
        if is_kept {
            let mut counts = self.counts.lock().expect("nothing here panics");
            *counts.by_name.entry(name).or_default() += 1;
        }
        let mut event = Map::new();
        event.insert("time".to_owned(), seconds_since_1970().into());
        event.insert("event".to_owned(), name.into());
        if let Value::Object(fields) = fields {
            event.extend(fields);
        }
        let event = Value::Object(event);
        if let Some(file) = &self.file {
            file.push(format!("{event}\n"));
        }
        if is_kept {
            let mut kept = self.kept.lock().expect("nothing here panics");
            kept.count += 1;
            kept.events.push_back(event);
            if kept.events.len() > MOST_KEPT {
                kept.events.pop_front();
            }
        }
    }

    /// The last events but for finished tiles, the earliest first, without the first `seen` that
    /// there were; and how many there were.
    pub(crate) fn since(&self, seen: u64) -> (Vec<Value>, u64) {
        let kept = self.kept.lock().expect("nothing here panics");
        let new = kept.events.len().min((kept.count - seen.min(kept.count)) as usize);
        (kept.events.iter().skip(kept.events.len() - new).cloned().collect(), kept.count)
    }
}

impl EventFile {
    fn open(path: &Path) -> io::Result<Self> {
        let mut file = File::options().append(true).create(true).open(path)?;
        let (lines, waiting) = sync_channel::<String>(MOST_WAITING);
        let path: PathBuf = path.to_owned();
        thread::Builder::new().name("events".to_owned()).spawn(move || {
            for line in waiting {
                if let Err(error) = file.write_all(line.as_bytes()) {
                    tracing::error!(reason = %error, "no more events go into {}", path.display());
                    return;
                }
            }
        })?;
        Ok(Self { lines, lost: Mutex::default() })
    }

    fn push(&self, line: String) {
        let mut lost = self.lost.lock().expect("nothing here panics");
        if *lost > 0 {
            let told =
                json!({ "time": seconds_since_1970(), "event": "events lost", "count": *lost });
            if self.lines.try_send(format!("{told}\n")).is_ok() {
                *lost = 0;
            }
        }
        if let Err(TrySendError::Full(_)) = self.lines.try_send(line) {
            *lost += 1;
        }
    }
}

#[expect(clippy::disallowed_methods, reason = "events are told with the time of day")]
fn seconds_since_1970() -> f64 {
    let since = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
    since.as_millis() as f64 / 1e3
}

/// What happened, and to whom. Numbers of jobs are texts: JSON's numbers have 53 bits.
fn describe(notice: &Notice) -> (&'static str, Value) {
    let numbers = |tiles: &[TileId]| tiles.iter().map(|tile| tile.number()).collect::<Vec<u32>>();
    let job = |job: JobId| job.0.to_string();
    match notice {
        Notice::Joined(worker, Process { host, number, threads, isa, .. }) => (
            "worker joined",
            json!({ "worker": worker.0, "host": host, "process": number, "threads": threads, "isa": isa }),
        ),
        Notice::Gone(worker, reason) => {
            ("worker gone", json!({ "worker": worker.0, "reason": reason }))
        }
        Notice::LeaseLost(loss, reason) => (
            "lease lost",
            json!({
                "worker": loss.worker.0, "tiles": numbers(&loss.tiles), "reason": reason,
                "job": job(loss.lease.job), "lease": loss.lease.id.0,
            }),
        ),
        Notice::SetAside(id, tile) => {
            ("tile set aside", json!({ "job": job(*id), "tile": tile.number() }))
        }
        Notice::TileDone { delivery, progress, elapsed } => {
            let Delivery { worker, lease, tile, hash, seconds, tally } = delivery;
            let fields = json!({
                "job": job(lease.job), "tile": tile.number(), "worker": worker.0,
                "seconds": seconds, "rays": tally.rays, "samples": tally.samples,
                "hash": blake3::Hash::from_bytes(*hash).to_hex().as_str(),
                "done": progress.tiles_done, "count": progress.tile_count,
                "elapsed": elapsed.as_secs_f64(),
            });
            ("tile done", fields)
        }
        Notice::CopiesDiffer { second, first } => (
            "copies differ",
            json!({
                "job": job(second.lease.job), "tile": second.tile.number(),
                "worker": second.worker.0, "other": first.worker.0,
            }),
        ),
        Notice::Liar { worker, job: id, tile } => (
            "worker kept out: it lied",
            json!({ "worker": worker.0, "job": job(*id), "tile": tile.number() }),
        ),
        Notice::TakenBack { worker, job: id, tiles } => (
            "tiles taken back",
            json!({ "worker": worker.0, "job": job(*id), "tiles": numbers(tiles) }),
        ),
        Notice::NoAudit => ("tiles are not compared: nobody can", json!({})),
        Notice::NotCompared(id, tile) => {
            ("tile not compared", json!({ "job": job(*id), "tile": tile.number() }))
        }
        Notice::JobFailed(id, reason) => {
            ("job failed", json!({ "job": job(*id), "reason": reason }))
        }
        Notice::NoRoom(id, reason) => ("job waits", json!({ "job": job(*id), "reason": reason })),
        Notice::JobCancelled(id) => ("job cancelled", json!({ "job": job(*id) })),
        Notice::JobExpired(id) => ("job forgotten", json!({ "job": job(*id) })),
        Notice::JobChanged(id, change) => {
            ("job changed", json!({ "job": job(*id), "change": format!("{change:?}") }))
        }
        Notice::Stationed(worker, standing) => (
            "worker's standing changed",
            json!({ "worker": worker.0, "standing": format!("{standing:?}") }),
        ),
        Notice::NotGranted { worker, lease, tile, count } => (
            "pixels came that nobody was to render so",
            json!({
                "worker": worker.0, "job": job(lease.job), "tile": tile.number(), "count": count,
            }),
        ),
        Notice::Suspect { worker, job: id, tile, reason } => (
            "pixels make no sense",
            json!({
                "worker": worker.0, "job": job(*id), "tile": tile.number(), "reason": reason,
            }),
        ),
        Notice::Strangers(count) => ("calls for another start refused", json!({ "count": count })),
    }
}
