//! The shell of a submission: it does what is decided, and tells what came of it.

use std::{error::Error, future::pending, ops::ControlFlow, panic::resume_unwind, time::Duration};

use rtfarm_core::{render::Tally, tile::Size};
use rtfarm_proto::{
    Address, Bytes, Connection, JobId, WireError,
    wire::{self, event, jobs_client::JobsClient, submit_response},
};
use tokio::{sync::mpsc, task::JoinHandle, time::Instant};
use tokio_stream::Stream;
use tokio_util::sync::CancellationToken;
use tonic::{Code, Status, Streaming};

use crate::{
    plain::plain,
    submission::{
        Action, Ended, JobEnd, JobState, NoPicture, Submission, SubmitOutcome, Submitted, Trouble,
    },
};

/// What a client reaches the world by: the network, its user and its files.
pub trait Outside: Send {
    /// Reaches a coordinator.
    type Connection: Connection;

    /// Reaches the coordinator.
    fn connect(
        &self,
    ) -> impl Future<Output = Result<JobsClient<Self::Connection>, Trouble>> + Send + 'static;

    /// The order, its scene and the scene's files. They are the same each time.
    fn order(
        &self,
    ) -> impl Future<
        Output = Result<impl Stream<Item = wire::SubmitRequest> + Send + 'static, Trouble>,
    > + Send
    + 'static;

    /// Tells the user what the coordinator says of the scene.
    fn tell_report(&mut self, report: &str);

    /// Shows the user how far the job is.
    fn show(&mut self, state: &JobState);

    /// Shows no longer how far the job is.
    fn hide(&mut self);

    /// Warns the user that the job waits, and why.
    fn warn_of_obstacle(&mut self, reason: &str);

    /// Warns the user that so many tiles had a second copy that differed from the first.
    fn warn_of_differing_tiles(&mut self, tiles: u32);

    /// Writes the picture's pieces as they come; an empty one is the last. What was written is
    /// whole or removed when this ends.
    fn write(
        &self,
        chunks: mpsc::Receiver<wire::Chunk>,
    ) -> impl Future<Output = Result<(), String>> + Send + 'static;
}

/// What is ordered, and where.
#[derive(Debug, Clone)]
pub struct Order {
    /// What the scene is called in messages.
    pub scene: String,
    /// Where the coordinator is.
    pub coordinator: Address,
    /// How long a coordinator that was reached may be gone.
    pub patience: Duration,
    /// The job goes on by itself when it is known.
    pub is_detached: bool,
}

/// Orders a picture and follows it to its end, or until somebody stops it.
pub async fn run<O: Outside>(
    outside: &mut O,
    order: Order,
    stop: &CancellationToken,
) -> Result<Ended, NoPicture> {
    let Order { scene, coordinator, patience, is_detached } = order;
    let submission = Submission::new(scene, coordinator, patience, is_detached, now());
    let mut shell = Shell {
        outside,
        client: None,
        farm: Bytes::new(),
        reports: mpsc::channel(1).1,
        running: None,
        writing: None,
    };
    let ended = shell.follow(submission, stop).await;
    shell.close().await;
    ended
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
struct Shell<'a, O: Outside> {
    outside: &'a mut O,
    client: Option<JobsClient<O::Connection>>,
    /// The id of the farm that took the order.
    farm: Bytes,
    /// What the running task tells.
    reports: mpsc::Receiver<Report<O::Connection>>,
    running: Option<JoinHandle<()>>,
    /// The task that writes the picture.
    writing: Option<JoinHandle<()>>,
}

/// What a task tells.
enum Report<C> {
    Connected(JobsClient<C>),
    Submitted(Submitted, Bytes),
    Watching,
    JobState(JobState),
    ChunkAwaited,
    Chunk,
    Fetched,
    Cancelled,
    Trouble(Trouble),
}

type Reports<C> = mpsc::Sender<Report<C>>;

impl<O: Outside> Shell<'_, O> {
    /// Does what is decided, to the end.
    async fn follow(
        &mut self,
        mut submission: Submission,
        stop: &CancellationToken,
    ) -> Result<Ended, NoPicture> {
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
                report = self.next_report() => self.pass_on(report, &mut submission),
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

    fn execute(&mut self, action: Action) -> ControlFlow<Result<Ended, NoPicture>> {
        match action {
            Action::Connect => {
                let connect = self.outside.connect();
                self.start(|reports| async move {
                    tell(&reports, connect.await.map(Report::Connected)).await;
                });
            }
            Action::Submit => {
                let (order, mut client) = (self.outside.order(), self.client());
                self.start(|reports| async move {
                    let submitted = match order.await {
                        Ok(parts) => match client.submit(parts).await {
                            Ok(answer) => read_submitted(answer.into_inner()),
                            Err(status) => Err(failed(&status)),
                        },
                        Err(trouble) => Err(trouble),
                    };
                    let submitted = submitted.map(|(told, farm)| Report::Submitted(told, farm));
                    tell(&reports, submitted).await;
                });
            }
            Action::TellReport(report) => self.outside.tell_report(&report),
            Action::Watch(job) => {
                let request = wire::WatchRequest { job: job.0, farm: self.farm.clone() };
                let client = self.client();
                self.start(|reports| watch(client, request, reports));
            }
            Action::Show(state) => self.outside.show(&state),
            Action::WarnOfObstacle(reason) => self.outside.warn_of_obstacle(&reason),
            Action::WarnOfDifferingTiles(tiles) => {
                self.outside.hide();
                self.outside.warn_of_differing_tiles(tiles);
            }
            Action::Fetch(job) => {
                let (send, chunks) = mpsc::channel(2);
                let request =
                    wire::ImageRequest { job: job.0, farm: self.farm.clone(), partial: false };
                let client = self.client();
                let reports = self.start(|reports| fetch(client, request, send, reports));
                let written = self.outside.write(chunks);
                self.writing = Some(tokio::spawn(async move {
                    let fetched = written.await.map(|()| Report::Fetched).map_err(Trouble::File);
                    // Nobody listens when the submission has gone on without the picture.
                    tell(&reports, fetched).await;
                }));
            }
            Action::Cancel(job) => {
                let mut client = self.client();
                let request = wire::CancelRequest { job: job.0, farm: self.farm.clone() };
                self.start(|reports| async move {
                    let cancelled = client.cancel(request).await;
                    let cancelled = cancelled.map(|_| Report::Cancelled);
                    tell(&reports, cancelled.map_err(|status| failed(&status))).await;
                });
            }
            Action::End(end) => {
                self.outside.hide();
                return ControlFlow::Break(end);
            }
        }
        ControlFlow::Continue(())
    }

    /// Ends the running task and starts another. Answers with where it tells its reports.
    fn start<F>(&mut self, task: impl FnOnce(Reports<O::Connection>) -> F) -> Reports<O::Connection>
    where
        F: Future<Output = ()> + Send + 'static,
    {
        self.end_task();
        self.outside.hide();
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

    async fn next_report(&mut self) -> Report<O::Connection> {
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

    fn pass_on(&mut self, report: Report<O::Connection>, submission: &mut Submission) {
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

    fn client(&self) -> JobsClient<O::Connection> {
        self.client.clone().expect("a submission connects first")
    }
}

/// Tells what came of a call. Whether anybody listens is all the same.
async fn tell<C>(reports: &Reports<C>, report: Result<Report<C>, Trouble>) {
    let _ = reports.send(report.unwrap_or_else(Report::Trouble)).await;
}

/// What a call failed of: the coordinator says it, or the connection.
fn failed(status: &Status) -> Trouble {
    let reason = plain(status.message());
    match status.code() {
        _ if is_lost(status) => Trouble::Lost(reason),
        Code::Unauthenticated | Code::PermissionDenied => Trouble::Forbidden(reason),
        _ => Trouble::Call(reason),
    }
}

/// Says whether a call failed of its connection.
pub fn is_lost(status: &Status) -> bool {
    status.source().is_some()
        || matches!(status.code(), Code::Unavailable | Code::Unknown | Code::Cancelled)
}

/// Tells of a job until there is nothing more to tell.
async fn watch<C: Connection>(
    mut client: JobsClient<C>,
    request: wire::WatchRequest,
    reports: Reports<C>,
) {
    let trouble = match client.watch(request).await {
        Ok(events) => tell_events(events.into_inner(), &reports).await,
        Err(status) => failed(&status),
    };
    tell(&reports, Err(trouble)).await;
}

/// Returns with what ends the stream of events.
async fn tell_events<C>(mut events: Streaming<wire::Event>, reports: &Reports<C>) -> Trouble {
    let mut report = Report::Watching;
    loop {
        if reports.send(report).await.is_err() {
            return Trouble::Gone;
        }
        report = match events.message().await {
            Ok(Some(event)) => match read_event(event) {
                Ok(state) => Report::JobState(state),
                Err(trouble) => return trouble,
            },
            Ok(None) => return Trouble::Gone,
            Err(status) => return failed(&status),
        };
    }
}

/// Brings a finished job's picture and hands it on, piece by piece.
async fn fetch<C: Connection>(
    mut client: JobsClient<C>,
    request: wire::ImageRequest,
    send: mpsc::Sender<wire::Chunk>,
    reports: Reports<C>,
) {
    let mut chunks = match client.image(request).await {
        Ok(chunks) => chunks.into_inner(),
        Err(status) => return tell(&reports, Err(failed(&status))).await,
    };
    loop {
        tell(&reports, Ok(Report::ChunkAwaited)).await;
        let chunk = match chunks.message().await {
            Ok(chunk) => chunk,
            Err(status) => return tell(&reports, Err(failed(&status))).await,
        };
        tell(&reports, Ok(Report::Chunk)).await;
        // The last chunk is empty: a stream that is cut short has none.
        let is_last = chunk.is_none();
        if send.send(chunk.unwrap_or_default()).await.is_err() || is_last {
            return;
        }
    }
}

/// Says of an answer that it cannot be understood.
#[expect(clippy::needless_pass_by_value, reason = "it maps errors")]
fn nonsense(error: impl ToString) -> Trouble {
    Trouble::Nonsense(error.to_string())
}

fn read_submitted(answer: wire::SubmitResponse) -> Result<(Submitted, Bytes), Trouble> {
    let mut farm = Bytes::new();
    let outcome = match answer.outcome.ok_or_else(|| nonsense("it has no outcome"))? {
        submit_response::Outcome::Accepted(accepted) => {
            farm = accepted.farm;
            let frame = accepted.frame.ok_or(WireError::Missing("frame")).map_err(nonsense)?;
            let size = Size::try_from(frame).map_err(nonsense)?;
            SubmitOutcome::Accepted { job: JobId(accepted.job), size }
        }
        submit_response::Outcome::Refused(reason) => SubmitOutcome::Refused(plain(&reason)),
    };
    Ok((Submitted { outcome, report: plain(&answer.report) }, farm))
}

/// What a coordinator says of the time that a job will take yet, if that makes sense.
/// It comes with one standard deviation.
pub fn time_left(told: Option<wire::TimeLeft>) -> Option<[Duration; 2]> {
    let wire::TimeLeft { mean, error } = told?;
    let seconds = |seconds| Duration::try_from_secs_f64(seconds).ok();
    Some([seconds(mean)?, seconds(error)?])
}

fn read_event(event: wire::Event) -> Result<JobState, Trouble> {
    let end = match event.end {
        Some(event::End::Finished(finished)) => {
            let rendering = Duration::try_from_secs_f64(finished.seconds).map_err(nonsense)?;
            Some(JobEnd::Finished(rendering))
        }
        Some(event::End::Failed(reason)) => Some(JobEnd::Failed(plain(&reason))),
        None => None,
    };
    Ok(JobState {
        tiles_done: event.tiles_done,
        tile_count: event.tile_count,
        tally: Tally::try_from(event.tally.unwrap_or_default()).map_err(nonsense)?,
        worker_count: event.workers,
        hosts: event.hosts.iter().map(|host| plain(host)).collect(),
        differing_tiles: event.differing_tiles,
        obstacle: plain(&event.obstacle),
        left: time_left(event.left),
        end,
    })
}
