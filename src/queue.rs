//! What people ask of a farm's queue: lists of its jobs and workers, and changes to them. An answer
//! is a table or a line for people, or one JSON document.

use std::{
    fmt::Write as _,
    io::{self, Write},
    time::Duration,
};

use anyhow::{Context, anyhow};
use blake3::Hash;
use rtfarm_client::{FIRST_PAUSE, LONGEST_PAUSE, is_lost, plain, time_left};
use rtfarm_core::{render::Tally, tile::Size};
use rtfarm_job::{Progress, TimeLeft};
use rtfarm_proto::{
    Access, Reached,
    wire::{self, Standing, control_request::Change, event, jobs_client::JobsClient},
};
use serde_json::{Value, json};
use tokio::time::{Instant, sleep, timeout};
use tokio_util::sync::CancellationToken;
use tonic::Status;

use crate::{
    args::{FarmArgs, WatchArgs},
    console::Console,
    failure::Failure,
    submit::reach,
};

/// The longest that a coordinator may take to answer.
const DEADLINE: Duration = Duration::from_secs(15);

/// What is asked of a farm.
#[derive(Debug)]
pub(crate) enum Wish {
    Jobs,
    Workers,
    Cancel(u64),
    Change(u64, Change),
    Explain(u64, u32),
    Station(u32, Standing),
}

/// Asks, and tells the answer.
pub(crate) async fn run(
    args: FarmArgs,
    wish: Wish,
    stop: &CancellationToken,
) -> Result<(), Failure> {
    let access = args.coordinator.access().map_err(Failure::Input)?;
    let asked = async {
        let client = connect(&access).await?;
        timeout(DEADLINE, ask(client, wish)).await.map_err(late)?
    };
    let answer = tokio::select! {
        answer = asked => answer?,
        () = stop.cancelled() => return Err(Failure::Interrupted),
    };
    answer.tell(args.json)
}

/// An answer, for machines and for people.
#[derive(Debug)]
struct Answer {
    json: Value,
    text: String,
}

impl Answer {
    fn tell(&self, as_json: bool) -> Result<(), Failure> {
        tell(as_json, &self.json, &self.text)
    }
}

/// One JSON document, or a text without control characters.
pub(crate) fn answer(as_json: bool, json: &Value, text: &str) -> String {
    if as_json { format!("{json:#}") } else { plain(text).trim_end().to_owned() }
}

/// Writes it to standard output.
pub(crate) fn tell(as_json: bool, json: &Value, text: &str) -> Result<(), Failure> {
    let told = writeln!(io::stdout().lock(), "{}", answer(as_json, json, text));
    Ok(told.context("cannot write to standard output")?)
}

/// Reaches the coordinator.
pub(crate) async fn connect(access: &Access) -> anyhow::Result<JobsClient<Reached>> {
    let client = timeout(DEADLINE, reach(access)).await.map_err(late)?;
    client.with_context(|| format!("no coordinator answers at {}", access.address()))
}

pub(crate) fn late(_: tokio::time::error::Elapsed) -> anyhow::Error {
    anyhow!("the coordinator does not answer")
}

#[expect(clippy::needless_pass_by_value, reason = "`map_err` hands it over")]
pub(crate) fn refused(status: Status) -> anyhow::Error {
    anyhow!("the coordinator says: {}", plain(status.message()))
}

async fn ask(mut client: JobsClient<Reached>, wish: Wish) -> anyhow::Result<Answer> {
    Ok(match wish {
        Wish::Jobs => {
            let list = client.list(wire::ListRequest {}).await.map_err(refused)?;
            list_jobs(&list.into_inner().jobs)
        }
        Wish::Workers => {
            let list = client.workers(wire::WorkersRequest {}).await.map_err(refused)?;
            list_workers(&list.into_inner().workers)
        }
        Wish::Cancel(job) => {
            let request = wire::CancelRequest { job, ..wire::CancelRequest::default() };
            let cancelled = client.cancel(request).await.map_err(refused)?.into_inner();
            if !cancelled.was_known {
                return Err(anyhow!("the coordinator says: there is no such job"));
            }
            done(&[("job", job.to_string().into())], format!("job {job} is cancelled"))
        }
        Wish::Change(job, change) => {
            let (key, value, text) = match change {
                Change::Paused(true) => ("paused", true.into(), "is paused".to_owned()),
                Change::Paused(false) => ("paused", false.into(), "goes on".to_owned()),
                Change::Priority(n) => ("priority", n.into(), format!("has priority {n}")),
                Change::Retry(_) => ("retried", true.into(), "is tried again".to_owned()),
            };
            let change = Some(change);
            let request = wire::ControlRequest { job, change, ..wire::ControlRequest::default() };
            client.control(request).await.map_err(refused)?;
            done(&[("job", job.to_string().into()), (key, value)], format!("job {job} {text}"))
        }
        Wish::Explain(job, tile) => {
            let request = wire::ExplainRequest { job, tile, ..wire::ExplainRequest::default() };
            let told = client.explain(request).await.map_err(refused)?.into_inner();
            explain(job, tile, &told)
        }
        Wish::Station(worker, standing) => {
            let request = wire::StationRequest { worker, standing: standing.into() };
            let answer = client.station(request).await.map_err(refused)?.into_inner();
            if !answer.was_known {
                return Err(anyhow!("the coordinator says: there is no such worker"));
            }
            let standing = standing_name(standing);
            let json = [("worker", worker.into()), ("standing", standing.into())];
            done(&json, format!("worker {worker} is {standing}"))
        }
    })
}

fn done(fields: &[(&str, Value)], text: String) -> Answer {
    let fields = fields.iter().map(|(key, value)| ((*key).to_owned(), value.clone()));
    Answer { json: Value::Object(fields.collect()), text }
}

fn list_jobs(jobs: &[wire::JobEntry]) -> Answer {
    let head =
        ["JOB", "STATE", "TILES", "WORKERS", "PRIORITY", "TIME", "OWNER", "SIZE", "KEPT", "NAME"];
    let rows = jobs.iter().map(|job| {
        let wire::Event { tiles_done, tile_count, .. } = job.progress.clone().unwrap_or_default();
        let wire::Frame { width, height } = job.frame.unwrap_or_default();
        vec![
            job.job.to_string(),
            state_name(job.state()).to_owned(),
            format!("{tiles_done}/{tile_count}"),
            most_of(job.workers_now, job.max_workers),
            job.priority.to_string(),
            format!("{:.1}s", job.seconds),
            job.owner.clone(),
            format!("{width}x{height}"),
            if has_ended(job) {
                format!("{:.1}h", job.expires_in / 3600.0)
            } else {
                "-".to_owned()
            },
            job.name.clone(),
        ]
    });
    let mut text = table(&head, rows.collect());
    for job in jobs {
        let obstacle = job.progress.as_ref().map_or("", |progress| &progress.obstacle);
        if !obstacle.is_empty() {
            let _ = writeln!(text, "job {} waits: {obstacle}", job.job);
        }
    }
    Answer { json: Value::Array(jobs.iter().map(job_json).collect()), text }
}

fn most_of(now: u32, most: u32) -> String {
    if most == 0 { now.to_string() } else { format!("{now} of {most}") }
}

fn has_ended(job: &wire::JobEntry) -> bool {
    matches!(job.state(), wire::JobState::Finished | wire::JobState::Failed)
}

/// Numbers of jobs have 64 bits, for which many readers of JSON have no room: they are strings.
fn job_json(job: &wire::JobEntry) -> Value {
    let wire::Frame { width, height } = job.frame.unwrap_or_default();
    let mut value = json!({
        "job": job.job.to_string(),
        "name": job.name,
        "owner": job.owner,
        "state": state_name(job.state()),
        "priority": job.priority,
        "workers_now": job.workers_now,
        "max_workers": (job.max_workers > 0).then_some(job.max_workers),
        "width": width,
        "height": height,
        "seconds": job.seconds,
        "bytes": job.bytes,
        "expires_in_seconds": has_ended(job).then_some(job.expires_in),
    });
    let progress = progress_json(&job.progress.clone().unwrap_or_default());
    if let (Value::Object(value), Value::Object(progress)) = (&mut value, progress) {
        value.extend(progress);
    }
    value
}

fn progress_json(event: &wire::Event) -> Value {
    let reason = match &event.end {
        Some(event::End::Failed(reason)) => Some(reason),
        _ => None,
    };
    json!({
        "tiles_done": event.tiles_done,
        "tile_count": event.tile_count,
        "workers": event.workers,
        "differing_tiles": event.differing_tiles,
        "failure": reason,
        "left_seconds": event.left.map(|left| left.mean),
        "left_seconds_error": event.left.map(|left| left.error),
        "obstacle": (!event.obstacle.is_empty()).then_some(&event.obstacle),
    })
}

fn explain(job: u64, tile: u32, told: &wire::ExplainResponse) -> Answer {
    let wire::Crop { x, y, width, height } = told.area.unwrap_or_default();
    let state = match told.state() {
        wire::TileState::Done => "done",
        wire::TileState::InWork => "in work",
        _ => "open",
    };
    let tally = told.tally.unwrap_or_default();
    let hash = Hash::from_slice(&told.hash).map(|hash| hash.to_hex()).ok();
    let is_known = hash.is_some();
    let attempts = told.attempts.iter().map(|attempt| {
        json!({
            "worker": attempt.worker, "host": attempt.host, "lease": attempt.lease,
            "seconds_ago": attempt.age, "in_picture": attempt.won,
            "lost": (!attempt.lost.is_empty()).then_some(&attempt.lost),
        })
    });
    let json = json!({
        "job": job.to_string(), "tile": tile, "state": state, "area": [x, y, width, height],
        "worker": (told.worker > 0).then_some(told.worker), "host": told.host,
        "seconds": is_known.then_some(told.seconds), "rays": is_known.then_some(tally.rays),
        "samples": is_known.then_some(tally.samples), "hash": hash.as_deref(),
        "attempts": attempts.collect::<Vec<Value>>(),
    });
    let mut text = format!("tile {tile} of job {job}, {width}x{height} at ({x}, {y}): {state}\n");
    if let Some(hash) = hash {
        let by = match told.worker {
            0 => "under an earlier start of the coordinator".to_owned(),
            worker => format!("by worker {worker} on {}", told.host),
        };
        let (seconds, rays) = (told.seconds, tally.rays);
        let _ = writeln!(text, "rendered {by} in {seconds:.3} s, {rays} rays\nhash {hash}");
    }
    for attempt in &told.attempts {
        let end = match (attempt.won, attempt.lost.as_str()) {
            (true, _) => "is in the picture".to_owned(),
            (false, "") => "brought nothing yet, or another was earlier".to_owned(),
            (false, lost) => format!("lost: {lost}"),
        };
        let wire::Attempt { worker, host, age, .. } = attempt;
        let _ = writeln!(text, "{age:.1} s ago to worker {worker} on {host}: {end}");
    }
    Answer { json, text }
}

fn list_workers(workers: &[wire::WorkerEntry]) -> Answer {
    let head = [
        "WORKER", "STANDING", "TILES", "DONE", "THREADS", "MEMORY", "ISA", "SILENT", "PROCESS",
        "HOST",
    ];
    let rows = workers.iter().map(|worker| {
        vec![
            worker.worker.to_string(),
            standing_name(worker.standing()).to_owned(),
            worker.tiles_leased.to_string(),
            worker.tiles_done.to_string(),
            worker.threads.to_string(),
            if worker.memory == 0 {
                "-".to_owned()
            } else {
                format!("{:.1}GB", worker.memory as f64 / 1e9)
            },
            worker.isa.clone(),
            format!("{:.1}s", worker.silence),
            worker.process.to_string(),
            worker.host.clone(),
        ]
    });
    let worker_json = |worker: &wire::WorkerEntry| {
        json!({
            "worker": worker.worker,
            "standing": standing_name(worker.standing()),
            "tiles_leased": worker.tiles_leased,
            "tiles_done": worker.tiles_done,
            "threads": worker.threads,
            "memory": (worker.memory > 0).then_some(worker.memory),
            "isa": worker.isa,
            "silent_seconds": worker.silence,
            "process": worker.process,
            "host": worker.host,
        })
    };
    Answer {
        json: Value::Array(workers.iter().map(worker_json).collect()),
        text: table(&head, rows.collect()),
    }
}

fn state_name(state: wire::JobState) -> &'static str {
    match state {
        wire::JobState::Unspecified => "unknown",
        wire::JobState::Waiting => "waiting",
        wire::JobState::Rendering => "rendering",
        wire::JobState::Paused => "paused",
        wire::JobState::Finished => "finished",
        wire::JobState::Failed => "failed",
    }
}

fn standing_name(standing: Standing) -> &'static str {
    match standing {
        Standing::Unspecified => "unknown",
        Standing::Active => "active",
        Standing::Draining => "draining",
        Standing::Disabled => "disabled",
    }
}

/// A line for each row under a heading, cells of a column under each other; lines in a cell become
/// one.
fn table(head: &[&str], rows: Vec<Vec<String>>) -> String {
    let head = head.iter().map(|&name| name.to_owned()).collect();
    let clean = |cell: &String| plain(cell).split_whitespace().collect::<Vec<_>>().join(" ");
    let rows: Vec<Vec<String>> = std::iter::once(head)
        .chain(rows)
        .map(|row: Vec<String>| row.iter().map(clean).collect())
        .collect();
    let width = |column: usize| rows.iter().map(|row| row[column].chars().count()).max();
    let mut text = String::new();
    for row in &rows {
        let cells = row.iter().enumerate();
        let cells = cells.map(|(k, cell)| format!("{cell:0$}", width(k).unwrap_or(0)));
        text.push_str(cells.collect::<Vec<_>>().join("  ").trim_end());
        text.push('\n');
    }
    text
}

/// `rtfarm watch`: shows how far a job is until it has ended.
pub(crate) async fn watch(
    args: WatchArgs,
    console: &Console,
    stop: &CancellationToken,
) -> Result<(), Failure> {
    let access = args.farm.coordinator.access().map_err(Failure::Input)?;
    let last = tokio::select! {
        last = follow(&args, &access, console) => last?,
        () = stop.cancelled() => return Err(Failure::Interrupted),
    };
    let tell = |json: &Value, text: &str| {
        let told = console.answer(&answer(args.farm.json, json, text));
        told.context("cannot write to standard output")
    };
    let mut json = progress_json(&last);
    json["job"] = args.job.to_string().into();
    match last.end {
        Some(event::End::Finished(wire::Finished { seconds })) => {
            json["state"] = "finished".into();
            json["seconds"] = seconds.into();
            Ok(tell(&json, &format!("job {} finished in {seconds:.2} s", args.job))?)
        }
        Some(event::End::Failed(reason)) => {
            json["state"] = "failed".into();
            if args.farm.json {
                tell(&json, "")?;
            }
            Err(anyhow!("the job failed: {}", plain(&reason)).into())
        }
        None => Err(anyhow!("the coordinator is gone").into()),
    }
}

/// Follows a job to its end. A coordinator that was reached once and is gone is looked for until
/// `--patience` is over.
async fn follow(
    args: &WatchArgs,
    access: &Access,
    console: &Console,
) -> anyhow::Result<wire::Event> {
    let mut gone_since: Option<Instant> = None;
    let mut pause = FIRST_PAUSE;
    let mut last = None;
    loop {
        let mut seen = None;
        let gone = match watch_once(args, access, console, &mut seen).await {
            Ok(last) => return Ok(last),
            Err(Ended::Refused(error)) => return Err(error),
            Err(Ended::Gone(error)) => error,
        };
        if seen.is_some() {
            (last, gone_since, pause) = (seen, None, FIRST_PAUSE);
        }
        let until = *gone_since.get_or_insert_with(Instant::now) + args.patience;
        if last.is_none() || until <= Instant::now() + pause {
            return Err(gone);
        }
        tracing::debug!(reason = %gone, ?pause, "looking for the coordinator again");
        sleep(pause).await;
        pause = LONGEST_PAUSE.min(pause * 2);
    }
}

/// Why nothing more is told of a job.
enum Ended {
    /// The coordinator does not want to.
    Refused(anyhow::Error),
    /// It cannot be heard; it may be there again later.
    Gone(anyhow::Error),
}

/// Shows what the coordinator tells of a job, the last of which is in `seen`; answers with its end.
async fn watch_once(
    args: &WatchArgs,
    access: &Access,
    console: &Console,
    seen: &mut Option<wire::Event>,
) -> Result<wire::Event, Ended> {
    let judged = |status: Status| {
        if is_lost(&status) {
            Ended::Gone(refused(status))
        } else {
            Ended::Refused(refused(status))
        }
    };
    let mut client = connect(access).await.map_err(Ended::Gone)?;
    let request = wire::WatchRequest { job: args.job, ..wire::WatchRequest::default() };
    let events = timeout(DEADLINE, client.watch(request)).await;
    let events = events.map_err(|elapsed| Ended::Gone(late(elapsed)))?;
    let mut events = events.map_err(judged)?.into_inner();
    let mut bar = None;
    while let Some(event) = events.message().await.map_err(judged)? {
        let Some(tally) = event.tally.and_then(|tally| Tally::try_from(tally).ok()) else {
            return Err(Ended::Refused(anyhow!("the coordinator's answer makes no sense")));
        };
        let known = seen.as_ref().map_or("", |event| &event.obstacle);
        if event.obstacle != known && !event.obstacle.is_empty() {
            tracing::warn!(reason = event.obstacle, "the job waits");
        }
        bar.get_or_insert_with(|| console.start_bar(event.tile_count)).show(&Progress {
            tiles_done: event.tiles_done,
            tile_count: event.tile_count,
            tally,
            left: time_left(event.left).map(|[mean, error]| TimeLeft { mean, error }),
            ..Progress::default()
        });
        if event.end.is_some() {
            return Ok(event);
        }
        *seen = Some(event);
    }
    Err(Ended::Gone(anyhow!("the coordinator is gone")))
}

/// What there is to say of a picture that was fetched.
pub(crate) fn picture_json(job: u64, path: &std::path::Path, size: Option<Size>) -> Value {
    json!({
        "job": job.to_string(),
        "picture": path.display().to_string(),
        "width": size.map(Size::width),
        "height": size.map(Size::height),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_table_has_a_line_a_row_and_its_columns_are_aligned() {
        let row = |cells: [&str; 3]| cells.map(str::to_owned).to_vec();
        let rows = vec![row(["7", "two\nlines \x1b[2J", "x"]), row(["1234", "", "yz"])];
        let text = table(&["JOB", "NAME", "N"], rows);
        let expected = "JOB   NAME           N\n7     two lines [2J  x\n1234                 yz\n";
        assert_eq!(text, expected);
    }

    #[test]
    fn a_jobs_number_keeps_its_64_bits_in_json() {
        let entry = wire::JobEntry { job: u64::MAX, ..wire::JobEntry::default() };
        let Answer { json, text } = list_jobs(&[entry]);
        assert_eq!(json[0]["job"], "18446744073709551615");
        assert!(
            text.lines().nth(1).unwrap().starts_with("18446744073709551615  unknown"),
            "{text}"
        );
    }
}
