//! `rtfarm submit`: a picture from a farm. It does what [`Submission`] decides, and tells it what
//! came of it.

use std::{
    collections::BTreeMap,
    error::Error,
    future::pending,
    io::{self, Write},
    ops::ControlFlow,
    panic::resume_unwind,
    sync::Arc,
};

use anyhow::Context;
use rtfarm_core::{render::Tally, tile::Size};
use rtfarm_job::Progress;
use rtfarm_proto::{
    Access, Bytes, CHUNK_BYTES, ConnectError, Connection, JobId, MESSAGE_BYTES, PROTOCOL,
    WireError,
    wire::{self, event, jobs_client::JobsClient, submit_request::Part, submit_response},
};
use serde_json::json;
use tokio::{
    sync::mpsc,
    task::{JoinHandle, spawn_blocking},
    time::Instant,
};
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::sync::CancellationToken;
use tonic::{Code, Status, Streaming};

use crate::{
    VERSION,
    args::SubmitArgs,
    console::{Bar, Console},
    failure::Failure,
    output::Output,
    plain::plain,
    queue,
    render::Summary,
    scene_files::SceneFiles,
    source::{SceneText, read_named_files},
    submission::{
        Action, Ended, Finished, JobEnd, JobState, Submission, SubmitOutcome, Submitted, Trouble,
    },
};

pub(crate) async fn run(
    args: SubmitArgs,
    console: &Console,
    stop: &CancellationToken,
) -> Result<(), Failure> {
    let started = Instant::now();
    let mut output = args.picture.output().map_err(Failure::Input)?;
    output.check()?;
    let text = SceneText::read(&args.picture.scene, stop).await?;
    let access = args.coordinator.access().map_err(Failure::Input)?;
    let (scene, coordinator) = (args.picture.scene.name(), access.address().clone());
    let mut submission = Submission::new(scene, coordinator, args.patience, args.detach, now());
    let key = match &args.key {
        Some(key) => key.clone(),
        None => random_key()?,
    };
    let mut shell = Shell {
        args: &args,
        access,
        output: &output,
        console,
        stop,
        key,
        text: Arc::new(text),
        client: None,
        farm: Bytes::new(),
        reports: mpsc::channel(1).1,
        running: None,
        writing: None,
        bar: None,
    };
    let ended = shell.follow(&mut submission).await;
    shell.close().await;

    let (job, finished) = match ended? {
        Ended::Finished(job, finished) => (job, finished),
        Ended::Detached(job, size) => {
            let JobId(job) = job;
            let json = json!({
                "job": job.to_string(), "width": size.width(), "height": size.height(),
            });
            return queue::tell(args.json, &json, &job.to_string());
        }
    };
    let Finished { size, tally, worker_count, rendering } = finished;
    if args.json {
        let mut json = queue::picture_json(job.0, output.name(), Some(size));
        json["seconds"] = rendering.as_secs_f64().into();
        json["workers"] = worker_count.into();
        json["rays"] = tally.rays.into();
        json["samples"] = tally.samples.into();
        json["error"] = tally.error().into();
        return queue::tell(true, &json, "");
    }
    let request = args.picture.request(output.format());
    let (sampling, transfer) = (request.quality.sampling, request.transfer);
    let workers = worker_count as usize;
    Summary { size, tally, sampling, transfer, rendering, workers }
        .tell(started, &output, console)?;
    Ok(())
}

/// A key that no other order has.
fn random_key() -> io::Result<String> {
    let mut bytes = [0; 16];
    rustix::rand::getrandom(&mut bytes, rustix::rand::GetRandomFlags::empty())?;
    Ok(format!("{:032x}", u128::from_ne_bytes(bytes)))
}

/// The user's login name; his number when nothing tells it.
fn login_name() -> String {
    let told = ["USER", "LOGNAME"].iter().filter_map(|name| std::env::var(name).ok());
    told.into_iter()
        .find(|name| !name.is_empty())
        .unwrap_or_else(|| rustix::process::getuid().as_raw().to_string())
}

fn now() -> std::time::Instant {
    Instant::now().into_std()
}

/// Waits for a moment; for ever when there is none.
async fn sleep_until(moment: Option<std::time::Instant>) {
    match moment {
        Some(moment) => tokio::time::sleep_until(Instant::from_std(moment)).await,
        None => pending().await,
    }
}

/// What is being done, and what it needs.
struct Shell<'a> {
    args: &'a SubmitArgs,
    access: Access,
    output: &'a Output,
    console: &'a Console,
    stop: &'a CancellationToken,
    /// Tells the order from every other, though it may be sent again.
    key: String,
    text: Arc<SceneText>,
    client: Option<JobsClient<Connection>>,
    /// The id of the farm that took the order.
    farm: Bytes,
    /// What the running task tells.
    reports: mpsc::Receiver<Report>,
    running: Option<JoinHandle<()>>,
    /// The thread that writes the picture.
    writing: Option<JoinHandle<()>>,
    bar: Option<Bar>,
}

/// What a task tells.
enum Report {
    Connected(JobsClient<Connection>),
    Submitted(Submitted, Bytes),
    Watching,
    JobState(JobState),
    ChunkAwaited,
    Chunk,
    Fetched,
    Cancelled,
    Trouble(Trouble),
}

impl Shell<'_> {
    /// Does what is decided, to the end.
    async fn follow(&mut self, submission: &mut Submission) -> Result<Ended, Failure> {
        let stop = self.stop;
        let mut is_stopped = false;
        loop {
            while let Some(action) = submission.next_action() {
                if let ControlFlow::Break(end) = self.execute(action) {
                    return end;
                }
            }
            let wake_at = submission.wake_at();
            tokio::select! {
                // An interruption goes first: others may be its consequences.
                biased;
                () = stop.cancelled(), if !is_stopped => {
                    is_stopped = true;
                    submission.on_stop(now());
                }
                report = self.next_report() => self.pass_on(report, submission),
                () = sleep_until(wake_at) => submission.on_tick(now()),
            }
        }
    }

    /// Waits until the picture's file is whole or removed.
    async fn close(&mut self) {
        self.end_task();
        if let Some(writing) = self.writing.take() {
            let _ = writing.await;
        }
    }

    fn execute(&mut self, action: Action) -> ControlFlow<Result<Ended, Failure>> {
        match action {
            Action::Connect => {
                let access = self.access.clone();
                self.start(|reports| connect(access, reports));
            }
            Action::Submit => {
                let order = self.order();
                let (client, text) = (self.client(), Arc::clone(&self.text));
                let scene = &self.args.picture.scene;
                let (scene_files, name) = (SceneFiles::new(scene), scene.name());
                self.start(|reports| async move {
                    let files = spawn_blocking(move || {
                        let files = read_named_files(&text, &scene_files);
                        text.ensure_unchanged().map(|()| (text, files))
                    });
                    let report = match files.await.expect("reading never panics") {
                        Ok((text, files)) => submit(client, order, text, files).await,
                        Err(error) => {
                            let reason = format!("cannot read the scene {name}: {error}");
                            Report::Trouble(Trouble::File(reason))
                        }
                    };
                    let _ = reports.send(report).await;
                });
            }
            Action::TellReport(report) => self.console.tell_report(&report),
            Action::Watch(job) => {
                let request = wire::WatchRequest { job: job.0, farm: self.farm.clone() };
                let client = self.client();
                self.start(|reports| watch(client, request, reports));
            }
            Action::Show(state) => self.show(&state),
            Action::WarnOfObstacle(reason) => tracing::warn!(reason, "the job waits"),
            Action::WarnOfDifferingTiles(tiles) => {
                self.bar = None;
                tracing::warn!(
                    tiles,
                    "two workers rendered the same tile differently; one of them is broken"
                );
            }
            Action::Fetch(job) => {
                let (send, chunks) = mpsc::channel(2);
                let request =
                    wire::ImageRequest { job: job.0, farm: self.farm.clone(), partial: false };
                let client = self.client();
                let reports = self.start(|reports| fetch(client, request, send, reports));
                self.writing = Some(write(self.output.clone(), self.stop.clone(), chunks, reports));
            }
            Action::Cancel(job) => {
                let mut client = self.client();
                let request = wire::CancelRequest { job: job.0, farm: self.farm.clone() };
                self.start(|reports| async move {
                    let cancelled = client.cancel(request).await;
                    let report =
                        cancelled.map_or_else(|status| failed(&status), |_| Report::Cancelled);
                    let _ = reports.send(report).await;
                });
            }
            Action::End(end) => {
                self.bar = None;
                return ControlFlow::Break(end);
            }
        }
        ControlFlow::Continue(())
    }

    /// Ends the running task and starts another. Answers with where it tells its reports.
    fn start<F>(&mut self, task: impl FnOnce(mpsc::Sender<Report>) -> F) -> mpsc::Sender<Report>
    where
        F: Future<Output = ()> + Send + 'static,
    {
        self.end_task();
        self.bar = None;
        let (send, receive) = mpsc::channel(1);
        self.reports = receive;
        self.running = Some(tokio::spawn(task(send.clone())));
        send
    }

    fn end_task(&mut self) {
        self.reports.close();
        if let Some(running) = self.running.take() {
            running.abort();
        }
    }

    async fn next_report(&mut self) -> Report {
        if let Some(report) = self.reports.recv().await {
            return report;
        }
        // A task that has nothing more to tell has told what ends it, or has panicked.
        if let Some(running) = self.running.take()
            && let Err(error) = running.await
            && error.is_panic()
        {
            resume_unwind(error.into_panic());
        }
        pending().await
    }

    fn pass_on(&mut self, report: Report, submission: &mut Submission) {
        match report {
            Report::Connected(client) => {
                self.client = Some(client);
                submission.on_connected(now());
            }
            Report::Submitted(submitted, farm) => {
                self.farm = farm;
                submission.on_submitted(submitted, now());
            }
            Report::Watching => submission.on_watching(),
            Report::JobState(state) => submission.on_job_state(state, now()),
            Report::ChunkAwaited => submission.on_chunk_awaited(now()),
            Report::Chunk => submission.on_chunk(),
            Report::Fetched => submission.on_fetched(now()),
            Report::Cancelled => submission.on_cancelled(),
            Report::Trouble(trouble) => submission.on_trouble(trouble, now()),
        }
    }

    fn client(&self) -> JobsClient<Connection> {
        self.client.clone().expect("a submission connects first")
    }

    fn show(&mut self, state: &JobState) {
        let bar = self.bar.get_or_insert_with(|| self.console.start_bar(state.tile_count));
        bar.show(&Progress {
            tiles_done: state.tiles_done,
            tile_count: state.tile_count,
            tally: state.tally,
            ..Progress::default()
        });
        tracing::debug!(done = state.tiles_done, count = state.tile_count, "progress");
    }

    fn order(&self) -> wire::Order {
        let request = self.args.picture.request(self.output.format());
        wire::Order {
            version: VERSION.to_owned(),
            protocol: PROTOCOL,
            name: request.name,
            frame: request.size.map(Into::into),
            quality: Some(request.quality.into()),
            strict: request.strict,
            crop: request.crop.map(Into::into),
            title: self.args.name.clone().unwrap_or_default(),
            owner: self.args.owner.clone().unwrap_or_else(login_name),
            key: self.key.clone(),
            priority: self.args.priority,
            max_workers: self.args.max_workers.unwrap_or(0),
            tile_side: request.tile_side.map_or(0, |side| side as u32),
            format: wire::Format::from(request.format).into(),
            transfer: wire::Transfer::from(request.transfer).into(),
        }
    }
}

/// What a call failed of: the coordinator says it, or the connection.
fn failed(status: &Status) -> Report {
    let reason = plain(status.message());
    Report::Trouble(if is_lost(status) { Trouble::Lost(reason) } else { Trouble::Call(reason) })
}

/// Says whether a call failed of its connection.
pub(crate) fn is_lost(status: &Status) -> bool {
    status.source().is_some()
        || matches!(status.code(), Code::Unavailable | Code::Unknown | Code::Cancelled)
}

/// Reaches a coordinator.
pub(crate) async fn reach(access: &Access) -> Result<JobsClient<Connection>, ConnectError> {
    let client = JobsClient::new(access.connect().await?);
    Ok(client.max_decoding_message_size(MESSAGE_BYTES).max_encoding_message_size(MESSAGE_BYTES))
}

async fn connect(access: Access, reports: mpsc::Sender<Report>) {
    let report = match reach(&access).await.map_err(anyhow::Error::from) {
        Ok(client) => Report::Connected(client),
        Err(error) => {
            let address = access.address().clone();
            Report::Trouble(Trouble::Connect(address, format!("{error:#}")))
        }
    };
    let _ = reports.send(report).await;
}

async fn submit(
    mut client: JobsClient<Connection>,
    order: wire::Order,
    text: Arc<SceneText>,
    files: BTreeMap<String, Vec<u8>>,
) -> Report {
    let (send, parts) = mpsc::channel(2);
    tokio::spawn(async move {
        let pieces = text.chunks(CHUNK_BYTES).map(|piece| Part::Text(piece.to_vec().into()));
        let files = files.iter().flat_map(|(path, data)| {
            // An empty file is one empty piece.
            let count = data.len().div_ceil(CHUNK_BYTES).max(1);
            (0..count).map(move |k| {
                let end = data.len().min((k + 1) * CHUNK_BYTES);
                let data = data[k * CHUNK_BYTES..end].to_vec().into();
                Part::File(wire::FilePiece { path: path.clone(), data })
            })
        });
        for part in std::iter::once(Part::Order(order)).chain(pieces).chain(files) {
            if send.send(wire::SubmitRequest { part: Some(part) }).await.is_err() {
                return;
            }
        }
    });
    match client.submit(ReceiverStream::new(parts)).await {
        Ok(answer) => match read_submitted(answer.into_inner()) {
            Ok((submitted, farm)) => Report::Submitted(submitted, farm),
            Err(error) => nonsense(&error),
        },
        Err(status) => failed(&status),
    }
}

/// Tells of a job until there is nothing more to tell.
async fn watch(
    mut client: JobsClient<Connection>,
    request: wire::WatchRequest,
    reports: mpsc::Sender<Report>,
) {
    let trouble = match client.watch(request).await {
        Ok(events) => tell_events(events.into_inner(), &reports).await,
        Err(status) => failed(&status),
    };
    let _ = reports.send(trouble).await;
}

/// Returns with what ends the stream of events.
async fn tell_events(mut events: Streaming<wire::Event>, reports: &mpsc::Sender<Report>) -> Report {
    let mut report = Report::Watching;
    loop {
        if reports.send(report).await.is_err() {
            return Report::Trouble(Trouble::Gone);
        }
        report = match events.message().await {
            Ok(Some(event)) => match read_event(event) {
                Ok(state) => Report::JobState(state),
                Err(error) => return nonsense(&error),
            },
            Ok(None) => return Report::Trouble(Trouble::Gone),
            Err(status) => return failed(&status),
        };
    }
}

/// Brings a finished job's picture and hands it on, piece by piece.
async fn fetch(
    mut client: JobsClient<Connection>,
    request: wire::ImageRequest,
    send: mpsc::Sender<wire::Chunk>,
    reports: mpsc::Sender<Report>,
) {
    let mut chunks = match client.image(request).await {
        Ok(chunks) => chunks.into_inner(),
        Err(status) => {
            let _ = reports.send(failed(&status)).await;
            return;
        }
    };
    loop {
        let _ = reports.send(Report::ChunkAwaited).await;
        let chunk = match chunks.message().await {
            Ok(chunk) => chunk,
            Err(status) => {
                let _ = reports.send(failed(&status)).await;
                return;
            }
        };
        let _ = reports.send(Report::Chunk).await;
        // The last chunk is empty: a stream that is cut short has none.
        let is_last = chunk.is_none();
        if send.send(chunk.unwrap_or_default()).await.is_err() || is_last {
            return;
        }
    }
}

/// Writes the picture as its pieces come, on a thread of its own.
fn write(
    output: Output,
    stop: CancellationToken,
    mut chunks: mpsc::Receiver<wire::Chunk>,
    reports: mpsc::Sender<Report>,
) -> JoinHandle<()> {
    spawn_blocking(move || {
        let written = write_chunks(&output, &stop, &mut chunks);
        let report = match written {
            Ok(()) => Report::Fetched,
            Err(error) => Report::Trouble(Trouble::File(format!("{error:#}"))),
        };
        // Nobody listens when the submission has gone on without the picture.
        let _ = reports.blocking_send(report);
    })
}

/// Writes a picture's pieces as they come; an empty one is the last. Never call this on the async
/// runtime.
pub(crate) fn write_chunks(
    output: &Output,
    stop: &CancellationToken,
    chunks: &mut mpsc::Receiver<wire::Chunk>,
) -> anyhow::Result<()> {
    output.write(stop, |file| {
        let mut is_whole = false;
        while let Some(chunk) = chunks.blocking_recv() {
            is_whole = chunk.data.is_empty();
            file.write_all(&chunk.data)?;
        }
        if is_whole { Ok(()) } else { Err(io::Error::other("the picture was cut short")) }
    })
}

/// An answer that cannot be understood.
fn nonsense(error: &anyhow::Error) -> Report {
    Report::Trouble(Trouble::Nonsense(format!("{error:#}")))
}

fn read_submitted(answer: wire::SubmitResponse) -> anyhow::Result<(Submitted, Bytes)> {
    let mut farm = Bytes::new();
    let outcome = match answer.outcome.context("it has no outcome")? {
        submit_response::Outcome::Accepted(accepted) => {
            farm = accepted.farm;
            SubmitOutcome::Accepted {
                job: JobId(accepted.job),
                size: Size::try_from(accepted.frame.ok_or(WireError::Missing("frame"))?)?,
            }
        }
        submit_response::Outcome::Refused(reason) => SubmitOutcome::Refused(plain(&reason)),
    };
    Ok((Submitted { outcome, report: plain(&answer.report) }, farm))
}

fn read_event(event: wire::Event) -> anyhow::Result<JobState> {
    let end = match event.end {
        Some(event::End::Finished(finished)) => {
            Some(JobEnd::Finished(std::time::Duration::try_from_secs_f64(finished.seconds)?))
        }
        Some(event::End::Failed(reason)) => Some(JobEnd::Failed(plain(&reason))),
        None => None,
    };
    Ok(JobState {
        tiles_done: event.tiles_done,
        tile_count: event.tile_count,
        tally: Tally::try_from(event.tally.unwrap_or_default())?,
        worker_count: event.workers,
        differing_tiles: event.differing_tiles,
        obstacle: event.obstacle,
        end,
    })
}
