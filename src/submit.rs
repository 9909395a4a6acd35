//! `rtfarm submit`: a picture from a farm. `rtfarm_client` follows the job; here are its user, its
//! files and its connection.

use std::{
    collections::BTreeMap,
    io::{self, Write},
    sync::Arc,
};

use anyhow::Context;
use rtfarm_client::{Ended, Finished, JobState, Order, Outside, Trouble};
use rtfarm_core::prepare::Form;
use rtfarm_job::{Progress, TimeLeft};
use rtfarm_proto::{
    Access, CHUNK_BYTES, ConnectError, JobId, MESSAGE_BYTES, PROTOCOL, Reached,
    wire::{self, jobs_client::JobsClient, submit_request::Part},
};
use serde_json::{Value, json};
use tokio::{sync::mpsc, task::spawn_blocking, time::Instant};
use tokio_stream::{Stream, wrappers::ReceiverStream};
use tokio_util::sync::CancellationToken;

use crate::{
    VERSION,
    args::SubmitArgs,
    console::{Bar, Console},
    failure::Failure,
    output::Output,
    queue,
    render::Summary,
    scene_files::SceneFiles,
    source::{SceneText, read_named_files},
};

pub(crate) async fn run(
    args: SubmitArgs,
    console: &Console,
    stop: &CancellationToken,
) -> Result<(), Failure> {
    let started = Instant::now();
    let mut output = args.picture.output().map_err(Failure::Input)?;
    output.check()?;
    let text = Arc::new(SceneText::read(&args.picture.scene, stop).await?);
    let access = args.coordinator.access().map_err(Failure::Input)?;
    let key = match &args.key {
        Some(key) => key.clone(),
        None => random_key()?,
    };
    let order = Order {
        scene: args.picture.scene.name(),
        coordinator: access.address().clone(),
        patience: args.patience,
        is_detached: args.detach,
    };
    let mut here =
        Here { args: &args, access, output: &output, console, stop, key, text, bar: None };
    let ended = rtfarm_client::run(&mut here, order, stop).await.map_err(Failure::of_client);

    // The bar that is taken away shares the terminal.
    let tell = |json: &Value, text: &str| {
        let told = console.answer(&queue::answer(args.json, json, text));
        Ok(told.context("cannot write to standard output")?)
    };
    let (job, finished) = match ended? {
        Ended::Finished(job, finished) => (job, finished),
        Ended::Detached(job, size) => {
            let JobId(job) = job;
            let json = json!({
                "job": job.to_string(), "width": size.width(), "height": size.height(),
            });
            return tell(&json, &job.to_string());
        }
    };
    let Finished { size, tally, worker_count, hosts, rendering } = finished;
    let request = args.picture.request(output.format());
    let (sampling, transfer) = (request.quality.sampling, request.transfer);
    let (workers, hosts) = (worker_count as usize, Arc::new(hosts.into_iter().collect()));
    let summary = Summary { size, tally, sampling, transfer, rendering, workers, hosts };
    if args.picture.sidecar {
        let (making, output, stop) = (summary.making(), output.clone(), stop.clone());
        spawn_blocking(move || making.write(&output, &stop)).await??;
    }
    if args.json {
        let mut json = queue::picture_json(job.0, output.name(), Some(size));
        json["seconds"] = rendering.as_secs_f64().into();
        json["workers"] = worker_count.into();
        json["rays"] = tally.rays.into();
        json["samples"] = tally.samples.into();
        json["error"] = tally.error().into();
        return tell(&json, "");
    }
    Ok(summary.tell(started, &output, console)?)
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

/// The user, the files and the network of this machine.
struct Here<'a> {
    args: &'a SubmitArgs,
    access: Access,
    output: &'a Output,
    console: &'a Console,
    stop: &'a CancellationToken,
    /// Tells the order from every other, though it may be sent again.
    key: String,
    text: Arc<SceneText>,
    bar: Option<Bar>,
}

impl Outside for Here<'_> {
    type Connection = Reached;

    fn connect(
        &self,
    ) -> impl Future<Output = Result<JobsClient<Reached>, Trouble>> + Send + 'static {
        let access = self.access.clone();
        async move {
            let reached = reach(&access).await;
            let address = access.address().clone();
            reached.map_err(|error| Trouble::Connect(address, error.to_string()))
        }
    }

    fn order(
        &self,
    ) -> impl Future<
        Output = Result<impl Stream<Item = wire::SubmitRequest> + Send + 'static, Trouble>,
    > + Send
    + 'static {
        let (mut order, text, scene) =
            (self.wire_order(), Arc::clone(&self.text), &self.args.picture.scene);
        let (scene_files, name) = (SceneFiles::new(scene), scene.name());
        async move {
            let files = spawn_blocking(move || {
                let files = read_named_files(&text, &scene_files);
                let hash = hash(&text, &files);
                text.ensure_unchanged().map(|()| (text, files, hash))
            });
            let (text, files, hash) = files
                .await
                .expect("reading never panics")
                .map_err(|error| Trouble::File(format!("cannot read the scene {name}: {error}")))?;
            order.sent = hash.as_bytes().to_vec().into();
            Ok(parts(order, text, files))
        }
    }

    fn tell_report(&mut self, report: &str) {
        self.console.tell_report(report);
    }

    fn show(&mut self, state: &JobState) {
        let bar = self.bar.get_or_insert_with(|| self.console.start_bar(state.tile_count));
        bar.show(&Progress {
            tiles_done: state.tiles_done,
            tile_count: state.tile_count,
            tally: state.tally,
            left: state.left.map(|[mean, error]| TimeLeft { mean, error }),
            ..Progress::default()
        });
        tracing::debug!(done = state.tiles_done, count = state.tile_count, "progress");
    }

    fn hide(&mut self) {
        self.bar = None;
    }

    fn warn_of_obstacle(&mut self, reason: &str) {
        tracing::warn!(reason, "the job waits");
    }

    fn warn_of_differing_tiles(&mut self, tiles: u32) {
        tracing::warn!(
            tiles,
            "two workers rendered the same tile differently; one of them is broken"
        );
    }

    fn write(
        &self,
        mut chunks: mpsc::Receiver<wire::Chunk>,
    ) -> impl Future<Output = Result<(), String>> + Send + 'static {
        let (output, stop) = (self.output.clone(), self.stop.clone());
        async move {
            let written = spawn_blocking(move || write_chunks(&output, &stop, &mut chunks));
            let written = written.await.expect("writing never panics");
            written.map_err(|error| format!("{error:#}"))
        }
    }
}

impl Here<'_> {
    fn wire_order(&self) -> wire::Order {
        let request = self.args.picture.request(self.output.format());
        wire::Order {
            version: VERSION.to_owned(),
            protocol: PROTOCOL,
            name: request.name,
            frame: request.size.map(Into::into),
            quality: Some(request.quality.into()),
            strict: request.strict,
            crop: request.crop.map(Into::into),
            compact: request.form == Form::Compact,
            title: self.args.name.clone().unwrap_or_default(),
            owner: self.args.owner.as_ref().map_or_else(login_name, ToString::to_string),
            key: self.key.clone(),
            priority: self.args.priority,
            max_workers: self.args.max_workers.unwrap_or(0),
            tile_side: request.tile_side.map_or(0, |side| side as u32),
            format: wire::Format::from(request.format).into(),
            transfer: wire::Transfer::from(request.transfer).into(),
            sent: Vec::new().into(),
        }
    }
}

/// Tells a scene's text and its files from others.
fn hash(text: &[u8], files: &BTreeMap<String, Vec<u8>>) -> blake3::Hash {
    let mut hasher = blake3::Hasher::new();
    hasher.update(blake3::hash(text).as_bytes());
    for (path, data) in files {
        hasher.update(blake3::hash(path.as_bytes()).as_bytes());
        hasher.update(blake3::hash(data).as_bytes());
    }
    hasher.finalize()
}

/// The pieces of an order, of its scene and its files.
fn parts(
    order: wire::Order,
    text: Arc<SceneText>,
    files: BTreeMap<String, Vec<u8>>,
) -> ReceiverStream<wire::SubmitRequest> {
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
    ReceiverStream::new(parts)
}

/// Reaches a coordinator.
pub(crate) async fn reach(access: &Access) -> Result<JobsClient<Reached>, ConnectError> {
    let client = JobsClient::new(access.connect().await?);
    Ok(client.max_decoding_message_size(MESSAGE_BYTES).max_encoding_message_size(MESSAGE_BYTES))
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
