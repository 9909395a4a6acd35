//! What those see who watch a farm: a stream of messages a picture, each made once for all who
//! watch it, and kept a while for those who come late or come again. Nobody who renders waits for
//! them, and while nobody watches nothing is made.

use std::{
    collections::{BTreeMap, VecDeque},
    io,
    sync::{Arc, Mutex, MutexGuard, Weak},
    time::Duration,
};

use base64::{Engine, prelude::BASE64_STANDARD};
use rtfarm_core::tile::{Area, TileGrid, TileId};
use rtfarm_job::Outcome;
use rtfarm_picture::{PictureFormat, View};
use rtfarm_proto::{Bytes, JobId, WorkerId};
use serde_json::{Value, json};
use tokio::{sync::watch, time::Instant};

use crate::{
    farm::{Arrived, JobEntry, JobPhase},
    job::Job,
    members::{MemberEntry, Standing},
    shell::Shell,
};

/// New tiles are shown so often.
const PERIOD: Duration = Duration::from_millis(100);

/// Workers, jobs and tiles in work are shown after so many periods.
const PERIODS_A_STATUS: u32 = 5;

/// What was told is kept for those who lost their connection so many periods after the last has
/// gone.
const PERIODS_OF_GRACE: u32 = 100;

/// The most tiles in one message. Their pixels stand one below the other in one picture, which must
/// not be too high.
const MOST_TILES: usize = 128;

/// The most bytes of messages that are kept. Who has seen fewer gets the whole picture.
const MOST_BYTES: usize = 1 << 23;

/// All that there is to know is made anew after so long, if there is more by then.
const FRESH: Duration = Duration::from_secs(1);

/// A coarse picture that has not come after so long is of no use.
const COARSE_PATIENCE: Duration = Duration::from_secs(60);

/// The most tiles in work that are told.
const MOST_IN_WORK: usize = 2000;

/// The pictures that somebody watches.
#[derive(Debug, Default)]
pub(crate) struct Live {
    feeds: Mutex<Feeds>,
}

#[derive(Debug, Default)]
struct Feeds {
    by_job: BTreeMap<Option<JobId>, Weak<Feed>>,
    count: u64,
}

/// The messages about one picture, or about a farm without any.
#[derive(Debug)]
pub(crate) struct Feed {
    /// No other feed of this process has it.
    number: u64,
    job: Option<Arc<Job>>,
    told: Mutex<Told>,
    whole: Mutex<Option<Whole>>,
    /// A coarse picture, as a PNG in base 64, once there is one.
    coarse: Mutex<Option<String>>,
    /// The number of the last message.
    news: watch::Sender<u64>,
}

/// What was told. Messages are numbered from 1.
#[derive(Debug, Default)]
struct Told {
    messages: VecDeque<(u64, Bytes)>,
    byte_count: usize,
    last: u64,
    generation: u32,
    /// Tiles that came and were told of.
    seen: usize,
    /// Events that were told of.
    events: u64,
    status: String,
}

/// All that there is to know, made once for all who come at about the same time.
#[derive(Debug)]
struct Whole {
    /// The number of the message before it.
    last: u64,
    messages: Vec<Bytes>,
    made: Instant,
}

/// What a viewer has seen.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Seen {
    feed: u64,
    message: u64,
}

impl Seen {
    /// Reads what stands in `Last-Event-ID`.
    pub(crate) fn read(text: &str) -> Option<Self> {
        let (feed, message) = text.split_once('-')?;
        Some(Self { feed: feed.parse().ok()?, message: message.parse().ok()? })
    }
}

impl Live {
    /// The feed of a job, or of a farm without any. It is made when nobody watched.
    pub(crate) fn feed(&self, shell: &Arc<Shell>, job: Option<Arc<Job>>) -> Arc<Feed> {
        let mut feeds = self.feeds.lock().expect("nothing here panics");
        let id = job.as_ref().map(|job| job.id);
        if let Some(feed) = feeds.by_job.get(&id).and_then(Weak::upgrade) {
            return feed;
        }
        feeds.by_job.retain(|_, feed| feed.strong_count() > 0);
        feeds.count += 1;
        let number = shell.identity.incarnation.0.wrapping_add(feeds.count);
        let (told, whole, coarse) = Default::default();
        let feed = Arc::new(Feed { number, job, told, whole, coarse, news: watch::Sender::new(0) });
        feeds.by_job.insert(id, Arc::downgrade(&feed));
        tokio::spawn(keep_told(Arc::clone(shell), Arc::clone(&feed)));
        tokio::spawn(show_coarse(Arc::clone(shell), Arc::clone(&feed)));
        feed
    }
}

/// Tells what is new, again and again, until nobody watches any more.
async fn keep_told(shell: Arc<Shell>, feed: Arc<Feed>) {
    let (mut idle, mut period) = (0, 0);
    while idle < PERIODS_OF_GRACE && !shell.stop.is_cancelled() {
        let (shell, told) = (Arc::clone(&shell), Arc::clone(&feed));
        let is_status = period % PERIODS_A_STATUS == 0;
        let telling = tokio::task::spawn_blocking(move || told.tell(&shell, is_status));
        if let Err(error) = telling.await.expect("telling never panics") {
            tracing::warn!(reason = %error, "cannot show a picture");
        }
        tokio::time::sleep(PERIOD).await;
        idle = if Arc::strong_count(&feed) > 1 { 0 } else { idle + 1 };
        period += 1;
    }
}

/// Has a coarse picture rendered of one that is hardly begun, and shows it.
async fn show_coarse(shell: Arc<Shell>, feed: Arc<Feed>) {
    let Some(job) = feed.job.clone() else { return };
    let is_early = {
        let progress = job.progress.borrow();
        progress.outcome.is_none() && progress.tiles_done <= progress.tile_count / 10
    };
    if !is_early {
        return;
    }
    let making = tokio::task::spawn_blocking(move || shell.coarse(&job));
    let Ok(Some(coarse)) = making.await else { return };
    let mut progress = coarse.progress();
    let ended = progress.wait_for(|progress| progress.outcome.is_some());
    let is_finished = match tokio::time::timeout(COARSE_PATIENCE, ended).await {
        Ok(Ok(progress)) => matches!(progress.outcome, Some(Outcome::Finished(_))),
        _ => false,
    };
    if !is_finished {
        return;
    }
    let window = coarse.grid.window();
    let encode = move || View::of(window).encode(coarse.picture(), &[window]);
    if let Ok(Ok(png)) = tokio::task::spawn_blocking(encode).await {
        let png = BASE64_STANDARD.encode(png);
        let data = json!({ "png": png }).to_string();
        *feed.coarse.lock().expect("nothing here panics") = Some(png);
        let mut told = feed.told();
        feed.push(&mut told, "coarse", &data);
        feed.news.send_replace(told.last);
    }
}

impl Feed {
    fn told(&self) -> MutexGuard<'_, Told> {
        self.told.lock().expect("telling never panics")
    }

    /// Told whenever there is another message.
    pub(crate) fn news(&self) -> watch::Receiver<u64> {
        self.news.subscribe()
    }

    /// The messages after those that a viewer has seen; `None` when he has seen too little.
    pub(crate) fn after(&self, seen: &mut Seen) -> Option<Vec<Bytes>> {
        let told = self.told();
        if seen.feed != self.number || !told.has_all_after(seen.message) {
            return None;
        }
        let new = told.messages.iter().filter(|&&(number, _)| number > seen.message);
        let new = new.map(|(_, bytes)| bytes.clone()).collect();
        seen.message = told.last;
        Some(new)
    }

    /// All that there is to know. This may read the whole picture: never call it on the async
    /// runtime.
    pub(crate) fn all(&self, shell: &Shell) -> io::Result<(Seen, Vec<Bytes>)> {
        let mut whole = self.whole.lock().expect("reading never panics");
        let (last, is_known) = {
            let told = self.told();
            let is_known = |whole: &Whole| {
                told.has_all_after(whole.last)
                    && (whole.last == told.last || whole.made.elapsed() < FRESH)
            };
            (told.last, whole.as_ref().is_some_and(is_known))
        };
        if !is_known {
            let mut messages = Vec::new();
            if let Some(job) = &self.job {
                messages.push(self.message(last, "picture", &self.whole_picture(shell, job)?));
            }
            let status = status(shell, self.job.as_deref());
            messages.push(self.message(last, "status", &status.to_string()));
            let (events, _) = shell.events.since(0);
            messages.push(self.message(last, "log", &Value::from(events).to_string()));
            *whole = Some(Whole { last, messages, made: Instant::now() });
        }
        let Whole { last, messages, .. } = whole.as_ref().expect("it was made");
        Ok((Seen { feed: self.number, message: *last }, messages.clone()))
    }

    /// A picture as it is: how it is cut, which tiles are in it, and what a view shows of it.
    fn whole_picture(&self, shell: &Shell, job: &Job) -> io::Result<String> {
        let grid: TileGrid = job.grid;
        let window = grid.window();
        // First which, then what they look like: what comes meanwhile is told again.
        let done = shell.done(job.id);
        let view = View::of(window);
        let png = view.encode(job.picture(), &[window])?;
        let mut bits = vec![0; grid.count().div_ceil(8) as usize];
        for (number, _) in done.iter().flatten().enumerate().filter(|(_, is_done)| **is_done) {
            bits[number / 8] |= 1 << (number % 8);
        }
        Ok(json!({
        "job": job.id.0.to_string(), "name": job.ticket.name,
        "width": window.width(), "height": window.height(), "x0": window.x0(), "y0": window.y0(),
        "step": view.step(), "viewWidth": view.size().width(), "viewHeight": view.size().height(),
        "side": grid.side(), "columns": grid.columns(), "count": grid.count(),
        "exact": view.step() == 1 && job.picture().format() == PictureFormat::Png8,
        "done": done.map(|_| BASE64_STANDARD.encode(bits)), "png": BASE64_STANDARD.encode(png),
        "coarse": *self.coarse.lock().expect("nothing here panics"),
    })
    .to_string())
    }

    fn message(&self, number: u64, name: &str, data: &str) -> Bytes {
        format!("id: {}-{number}\nevent: {name}\ndata: {data}\n\n", self.number).into()
    }

    fn push(&self, told: &mut Told, name: &str, data: &str) {
        told.last += 1;
        let message = self.message(told.last, name, data);
        told.byte_count += message.len();
        told.messages.push_back((told.last, message));
        while told.byte_count > MOST_BYTES
            && let Some((_, oldest)) = told.messages.pop_front()
        {
            told.byte_count -= oldest.len();
        }
    }

    /// Tells what is new. This reads tiles: never call it on the async runtime.
    fn tell(&self, shell: &Shell, is_status: bool) -> io::Result<()> {
        let (seen, generation, known_events) = {
            let told = self.told();
            (told.seen, told.generation, told.events)
        };
        let mut new: Vec<(&str, String)> = Vec::new();
        let arrived = self.job.as_ref().and_then(|job| shell.arrived(job.id, seen));
        let arrived = arrived.unwrap_or_else(|| Arrived { generation, ..Arrived::default() });
        let is_other = arrived.generation != generation;
        if let Some(job) = self.job.as_ref().filter(|_| !is_other) {
            for tiles in arrived.tiles.chunks(MOST_TILES) {
                new.push(("tiles", new_tiles(job, tiles)?));
            }
        }
        let (events, event_count) = shell.events.since(known_events);
        if !events.is_empty() {
            new.push(("log", Value::from(events).to_string()));
        }
        let status = is_status.then(|| status(shell, self.job.as_deref()).to_string());

        let mut told = self.told();
        if is_other {
            // What anybody has seen counts no more. The next period finds the tiles.
            *told = Told { last: told.last + 2, generation: arrived.generation, ..Told::default() };
        }
        told.seen += if is_other { 0 } else { arrived.tiles.len() };
        told.events = event_count;
        if let Some(status) = status.filter(|status| *status != told.status) {
            told.status.clone_from(&status);
            new.push(("status", status));
        }
        for (name, data) in new {
            self.push(&mut told, name, &data);
        }
        self.news.send_if_modified(|last| std::mem::replace(last, told.last) != told.last);
        Ok(())
    }
}

impl Told {
    /// Says whether each message after that one is kept.
    fn has_all_after(&self, number: u64) -> bool {
        let first = self.messages.front().map_or(self.last + 1, |&(number, _)| number);
        (first..=self.last + 1).contains(&(number + 1))
    }
}

/// What a view shows of a job's picture: `[y][x]`, red, green and blue. Where no tile has come yet
/// that is a coarse picture's, if one was begun. This reads the picture: never call it on the async
/// runtime.
pub(crate) fn snapshot(shell: &Shell, job: &Job, view: View) -> io::Result<Vec<u8>> {
    // First which, then what they look like.
    let done = shell.done(job.id);
    let mut pixels = view.pixels(job.picture())?;
    let (Some(done), Some(coarse)) = (done, shell.coarse_of(job.id)) else { return Ok(pixels) };
    let coarse_view = View::of(coarse.grid.window());
    let coarse = coarse_view.pixels(coarse.picture())?;
    let (window, coarse_size) = (job.grid.window(), coarse_view.size());
    // The coarse pixel, along a side, that has a place of the window.
    let scaled = |place: u32, side: u32, coarse_side: u32| {
        (u64::from(place) * u64::from(coarse_side) / u64::from(side)) as usize
    };
    let places = |side: u32| (0..side).step_by(view.step() as usize);
    for (row, y) in
        pixels.chunks_exact_mut(3 * view.size().width() as usize).zip(places(window.height()))
    {
        for (pixel, x) in row.chunks_exact_mut(3).zip(places(window.width())) {
            let tile = y / job.grid.side() * job.grid.columns() + x / job.grid.side();
            if !done[tile as usize] {
                let x = scaled(x, window.width(), coarse_size.width());
                let y = scaled(y, window.height(), coarse_size.height());
                let at = 3 * (y * coarse_size.width() as usize + x);
                pixel.copy_from_slice(&coarse[at..at + 3]);
            }
        }
    }
    Ok(pixels)
}

/// Tiles that came: their numbers and workers, and what a view shows of them, one below the other.
fn new_tiles(job: &Job, tiles: &[(TileId, WorkerId)]) -> io::Result<String> {
    let areas: Vec<Area> = tiles.iter().map(|&(tile, _)| job.grid.area(tile)).collect();
    let png = View::of(job.grid.window()).encode(job.picture(), &areas)?;
    let numbers: Vec<[u32; 2]> =
        tiles.iter().map(|(tile, worker)| [tile.number(), worker.0]).collect();
    Ok(json!({ "tiles": numbers, "png": BASE64_STANDARD.encode(png) }).to_string())
}

/// Jobs, workers, and which tiles of a job are in work.
fn status(shell: &Shell, job: Option<&Job>) -> Value {
    let jobs: Vec<Value> = shell.jobs().iter().map(|(entry, job)| job_status(entry, job)).collect();
    let workers: Vec<Value> = shell.workers().iter().map(worker_status).collect();
    let work = job.map(|job| shell.in_work(job.id)).unwrap_or_default();
    let work: Vec<Value> = work
        .into_iter()
        .take(MOST_IN_WORK)
        .map(|(tile, worker, is_begun)| json!([tile.number(), worker.0, u8::from(is_begun)]))
        .collect();
    json!({ "jobs": jobs, "workers": workers, "work": work, "version": shell.config.version })
}

fn job_status(entry: &JobEntry, job: &Job) -> Value {
    let JobEntry { id, phase, terms, workers_now, progress, elapsed, .. } = entry;
    let state = match phase {
        JobPhase::Waiting => "waiting",
        JobPhase::Rendering => "rendering",
        JobPhase::Paused => "paused",
        JobPhase::Finished => "finished",
        JobPhase::Failed => "failed",
    };
    let reason = match &progress.outcome {
        Some(Outcome::Failed(reason)) => Some(reason),
        _ => progress.obstacle.as_ref(),
    };
    let size = job.grid.window().size();
    json!({
        "job": id.0.to_string(), "name": job.ticket.name, "owner": job.ticket.owner, "state": state,
        "priority": terms.priority, "workers": workers_now, "reason": reason,
        "done": progress.tiles_done, "count": progress.tile_count, "rays": progress.tally.rays,
        "left": progress.left.map(|left| left.mean.as_secs_f64()),
        "leftError": progress.left.map(|left| left.error.as_secs_f64()),
        "error": progress.tally.error(), "seconds": (elapsed.as_secs_f64() * 10.0).round() / 10.0,
        "width": size.width(), "height": size.height(),
    })
}

fn worker_status((entry, leased): &(MemberEntry, usize)) -> Value {
    let MemberEntry { worker, process, standing, tiles_done, silence } = entry;
    let standing = match standing {
        Standing::Active => "active",
        Standing::Draining => "draining",
        Standing::Disabled => "disabled",
    };
    json!({
        "worker": worker.0, "host": process.host, "process": process.number, "threads": process.threads,
        "isa": process.isa, "standing": standing, "done": tiles_done, "leased": leased,
        "silence": silence.as_secs(),
    })
}

/// A comment, which keeps a connection alive through which nothing else has gone for a while.
pub(crate) fn keep_alive() -> Bytes {
    Bytes::from_static(b":\n\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_viewer_has_seen_is_read_as_it_is_written() {
        assert_eq!(Seen::read("7-12"), Some(Seen { feed: 7, message: 12 }));
        for foreign in ["", "7", "-", "7-", "x-1", "7-12-3", "-1-2"] {
            assert_eq!(Seen::read(foreign), None, "{foreign}");
        }
    }
}
