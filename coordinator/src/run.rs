//! The coordinator as a process part: what its services share, and the loop that runs them.

use std::{
    collections::BTreeMap,
    io,
    path::PathBuf,
    sync::{Arc, Mutex, MutexGuard},
    time::Duration,
};

use rtfarm_core::tile::TileId;
use rtfarm_job::{Order, Outcome, Progress};
use rtfarm_picture::Picture;
use rtfarm_proto::{JobId, WorkerId};
use tokio::{
    net::{TcpListener, UnixListener},
    sync::watch,
    time::Instant,
};
use tokio_stream::wrappers::{TcpListenerStream, UnixListenerStream};
use tokio_util::sync::CancellationToken;
use tonic::transport::server::Router;

use crate::{job::Job, jobs::Jobs, lease::Loss, service, store::SceneFile};

/// How a coordinator works.
#[derive(Debug, Clone)]
pub struct Config {
    /// Workers and clients of another version are refused.
    pub version: String,
    /// How long a lease lives without progress.
    pub term: Duration,
    /// For prepared scenes: a folder that is nobody else's.
    pub scene_folder: PathBuf,
    /// For pictures while they are rendered.
    pub picture_folder: PathBuf,
}

/// A coordinator. Clones are the same one.
#[derive(Debug, Clone)]
pub struct Coordinator {
    pub(crate) shared: Arc<Shared>,
}

/// Where workers and clients come in.
#[derive(Debug)]
pub enum Listener {
    /// A socket on this machine.
    Unix(UnixListener),
    /// TCP.
    Tcp(TcpListener),
}

/// Why an order is not taken.
#[derive(Debug, thiserror::Error)]
pub enum SubmitError {
    /// The scene cannot be written.
    #[error("cannot write the prepared scene into {folder}: {error}", folder = .0.display(), error = .1)]
    Scene(PathBuf, io::Error),
    /// The picture cannot be made.
    #[error("cannot make the picture's file in {folder}: {error}", folder = .0.display(), error = .1)]
    Picture(PathBuf, io::Error),
}

/// What the services share. Each mutex is held for a moment, never two at once.
#[derive(Debug)]
pub(crate) struct Shared {
    pub(crate) config: Config,
    jobs: Mutex<Jobs>,
    /// Jobs that run or whose pictures may still be asked for.
    kept: Mutex<BTreeMap<JobId, Arc<Job>>>,
    processes: Mutex<BTreeMap<WorkerId, u32>>,
    /// Sent when a waiting worker may find work.
    pub(crate) changed: watch::Sender<()>,
    /// Workers are sent home.
    pub(crate) closing: CancellationToken,
}

/// Finished or failed jobs that are kept for their clients.
const KEPT_AFTER_END: usize = 16;

/// How often leases are looked at that may have run out.
const TICK: Duration = Duration::from_millis(100);

/// How long workers may take to go home, and connections to close.
const FAREWELL: Duration = Duration::from_millis(1500);

impl Coordinator {
    /// A coordinator without jobs and workers.
    pub fn new(config: Config) -> Self {
        let jobs = Mutex::new(Jobs::new(config.term));
        let shared = Shared {
            config,
            jobs,
            kept: Mutex::default(),
            processes: Mutex::default(),
            changed: watch::Sender::new(()),
            closing: CancellationToken::new(),
        };
        Self { shared: Arc::new(shared) }
    }

    /// Takes an order. This writes files: never call it on the async runtime.
    pub fn submit(&self, order: Order) -> Result<Arc<Job>, SubmitError> {
        let Config { scene_folder, picture_folder, .. } = &self.shared.config;
        let Order { name, prepared, settings, grid, transfer, format } = order;
        let scene = SceneFile::write(scene_folder, &prepared)
            .map_err(|error| SubmitError::Scene(scene_folder.clone(), error))?;
        drop(prepared);
        let picture = Picture::new_in(picture_folder, settings.size, format, transfer)
            .map_err(|error| SubmitError::Picture(picture_folder.clone(), error))?;

        let id = self.shared.jobs().number_job();
        let progress =
            watch::Sender::new(Progress { tile_count: grid.count(), ..Progress::default() });
        let started = Instant::now();
        let workers = Mutex::default();
        let job =
            Arc::new(Job { id, name, scene, settings, grid, picture, started, progress, workers });
        self.shared.keep(&job);
        tracing::info!(
            job = id.0,
            scene = job.name,
            size = %settings.size,
            sampling = ?settings.quality.sampling,
            ?transfer,
            tiles = grid.count(),
            side = grid.side(),
            scene_bytes = job.scene.byte_count(),
            "job started"
        );
        // Only now, so that nobody gets a lease on a job that is not kept yet.
        self.shared.jobs().on_submit(id, grid);
        self.shared.changed.send_replace(());
        Ok(job)
    }

    /// Ends a job, if it has not ended, and forgets it.
    pub fn cancel(&self, job: JobId) {
        self.shared.jobs().on_end(job);
        let forgotten = self.shared.kept().remove(&job);
        if let Some(job) = forgotten
            && job.end(Outcome::Failed("it was cancelled".to_owned()))
        {
            tracing::info!(job = job.id.0, "job cancelled");
        }
    }

    /// Event: the process of a worker on this machine is known to be dead.
    pub fn on_process_exit(&self, process: u32, reason: &str) {
        let worker = {
            let processes = self.shared.processes();
            processes.iter().find(|(_, known)| **known == process).map(|(&worker, _)| worker)
        };
        if let Some(worker) = worker {
            self.shared.lose_worker(worker, reason);
        }
    }

    /// Sends every worker home.
    pub fn close(&self) {
        self.shared.closing.cancel();
    }

    /// Serves workers and clients until `shutdown` comes; returns when they have been sent home.
    pub async fn run(
        &self,
        listener: Listener,
        shutdown: impl Future<Output = ()>,
    ) -> Result<(), tonic::transport::Error> {
        let stop = CancellationToken::new();
        let serve = serve(service::router(&self.shared), listener, stop.clone());
        let close = async {
            shutdown.await;
            self.close();
            self.shared.end_all("the coordinator was stopped");
            let _ = tokio::time::timeout(FAREWELL, self.shared.all_gone()).await;
            stop.cancel();
            tokio::time::sleep(FAREWELL).await;
        };
        tokio::select! {
            served = serve => served,
            () = close => Ok(()),
            () = self.shared.tick() => unreachable!("time does not end"),
        }
    }
}

async fn serve(
    router: Router,
    listener: Listener,
    stop: CancellationToken,
) -> Result<(), tonic::transport::Error> {
    let stop = stop.cancelled_owned();
    match listener {
        Listener::Unix(listener) => {
            router.serve_with_incoming_shutdown(UnixListenerStream::new(listener), stop).await
        }
        Listener::Tcp(listener) => {
            router.serve_with_incoming_shutdown(TcpListenerStream::new(listener), stop).await
        }
    }
}

impl Shared {
    pub(crate) fn jobs(&self) -> MutexGuard<'_, Jobs> {
        self.jobs.lock().expect("deciding never panics")
    }

    fn kept(&self) -> MutexGuard<'_, BTreeMap<JobId, Arc<Job>>> {
        self.kept.lock().expect("a map never panics")
    }

    pub(crate) fn processes(&self) -> MutexGuard<'_, BTreeMap<WorkerId, u32>> {
        self.processes.lock().expect("a map never panics")
    }

    /// A job that has not been forgotten.
    pub(crate) fn job(&self, job: JobId) -> Option<Arc<Job>> {
        self.kept().get(&job).cloned()
    }

    pub(crate) fn kept_jobs(&self) -> Vec<Arc<Job>> {
        self.kept().values().cloned().collect()
    }

    fn keep(&self, job: &Arc<Job>) {
        let mut kept = self.kept();
        let ended: Vec<JobId> = kept
            .iter()
            .filter(|(_, job)| job.progress.borrow().outcome.is_some())
            .map(|(&id, _)| id)
            .collect();
        for old in ended.iter().take(ended.len().saturating_sub(KEPT_AFTER_END)) {
            kept.remove(old);
        }
        kept.insert(job.id, Arc::clone(job));
    }

    /// Ends a job, unless it has ended.
    pub(crate) fn end(&self, job: JobId, outcome: Outcome) {
        self.jobs().on_end(job);
        if let Some(job) = self.job(job) {
            let reason =
                if let Outcome::Failed(reason) = &outcome { reason.clone() } else { String::new() };
            if job.end(outcome) && !reason.is_empty() {
                tracing::warn!(job = job.id.0, reason, "job failed");
            }
        }
    }

    fn end_all(&self, reason: &str) {
        for job in self.kept_jobs() {
            self.end(job.id, Outcome::Failed(reason.to_owned()));
        }
    }

    /// Takes every lease from a worker that is no more.
    pub(crate) fn lose_worker(&self, worker: WorkerId, reason: &str) {
        let was_known = self.processes().remove(&worker).is_some();
        let losses = self.jobs().on_worker_lost(worker);
        if was_known && losses.is_empty() {
            tracing::info!(worker = worker.0, reason, "worker gone");
        }
        self.tell_losses(&losses, reason);
    }

    fn tell_losses(&self, losses: &[(JobId, Loss)], reason: &str) {
        for (job, loss) in losses {
            tracing::warn!(
                worker = loss.worker.0,
                tiles = %list(&loss.tiles),
                reason,
                job = job.0,
                lease = loss.lease.0,
                "lease lost"
            );
        }
        if !losses.is_empty() {
            self.changed.send_replace(());
        }
    }

    async fn tick(&self) {
        let reason = format!("no progress for {:.1} s", self.config.term.as_secs_f64());
        let mut ticks = tokio::time::interval(TICK);
        loop {
            ticks.tick().await;
            let losses = self.jobs().on_tick(Instant::now().into_std());
            self.tell_losses(&losses, &reason);
        }
    }

    async fn all_gone(&self) {
        while !self.processes().is_empty() {
            tokio::time::sleep(TICK / 10).await;
        }
    }
}

/// Tile numbers, ascending, neighbours drawn together: `3,17-24`.
fn list(tiles: &[TileId]) -> String {
    let mut numbers: Vec<u32> = tiles.iter().map(|tile| tile.number()).collect();
    numbers.sort_unstable();
    let spans = numbers.chunk_by(|a, b| a + 1 == *b).map(|span| match span {
        [only] => only.to_string(),
        span => format!("{}-{}", span[0], span[span.len() - 1]),
    });
    spans.collect::<Vec<String>>().join(",")
}

#[cfg(test)]
mod tests {
    use rtfarm_core::tile::{Size, TileGrid};

    use super::*;

    #[test]
    fn tiles_are_listed_as_spans() {
        let grid = TileGrid::new(Size::new(160, 160).unwrap(), 16).unwrap();
        let tiles: Vec<TileId> =
            [24, 3, 18, 17, 19, 99].iter().map(|&number| grid.tile(number).unwrap()).collect();
        assert_eq!(list(&tiles), "3,17-19,24,99");
    }
}
