//! `rtfarm submit`: a picture from a farm.

use std::{
    collections::BTreeMap,
    fs,
    io::{self, Write},
    path::Path,
    sync::Mutex,
    time::Duration,
};

use anyhow::{Context, anyhow};
use rtfarm_core::{read::read_scene, tile::Size};
use rtfarm_job::{Progress, RenderRequest};
use rtfarm_proto::{
    CHUNK_BYTES, MESSAGE_BYTES, PROTOCOL,
    wire::{self, event, jobs_client::JobsClient, submit_request::Part, submit_response::Outcome},
};
use tokio::{sync::mpsc, task::spawn_blocking, time::Instant};
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::sync::CancellationToken;
use tonic::{Status, transport::Channel};

use crate::{
    VERSION,
    args::SubmitArgs,
    console::Console,
    failure::Failure,
    output::Output,
    render::Summary,
    source::{SceneText, scene_folder},
};

/// A scene may be large and take long to prepare.
const SUBMIT_DEADLINE: Duration = Duration::from_secs(1800);

/// Encoding a large picture takes a while.
const IMAGE_DEADLINE: Duration = Duration::from_secs(600);

const DEADLINE: Duration = Duration::from_secs(15);

pub(crate) async fn run(
    args: SubmitArgs,
    console: &Console,
    stop: &CancellationToken,
) -> Result<(), Failure> {
    let started = Instant::now();
    let mut output = args.picture.output().map_err(Failure::Input)?;
    output.check()?;
    let text = SceneText::read(&args.picture.scene, stop).await?;
    let channel = args.coordinator.connect().await;
    let channel =
        channel.with_context(|| format!("no coordinator answers at {}", args.coordinator))?;
    let mut client = JobsClient::new(channel)
        .max_decoding_message_size(MESSAGE_BYTES)
        .max_encoding_message_size(MESSAGE_BYTES);

    let submitted = tokio::select! {
        submitted = submit(&mut client, &args, &output, text, console) => submitted?,
        () = stop.cancelled() => return Err(Failure::Interrupted),
    };
    let watched = tokio::select! {
        watched = watch(client.clone(), submitted.job, console) => watched,
        () = stop.cancelled() => Err(Failure::Interrupted),
    };
    let rendered = match watched {
        Ok(watched) => fetch(client.clone(), submitted.job, &output, stop).await.map(|()| watched),
        Err(failure) => Err(failure),
    };
    let cancelled = client.cancel(wire::CancelRequest { job: submitted.job });
    let _ = tokio::time::timeout(DEADLINE, cancelled).await;
    let size = Size::try_from(submitted.frame.context("the coordinator names no size")?)?;
    let (event, rendering) = rendered?;
    let tally = event.tally.unwrap_or_default().try_into()?;
    let workers = event.workers as usize;
    let RenderRequest { quality, transfer, .. } = args.picture.request(output.format());
    let sampling = quality.sampling;
    Summary { size, tally, sampling, transfer, rendering, workers }.tell(started, &output)?;
    Ok(())
}

async fn submit(
    client: &mut JobsClient<Channel>,
    args: &SubmitArgs,
    output: &Output,
    text: SceneText,
    console: &Console,
) -> Result<wire::Accepted, Failure> {
    let request = args.picture.request(output.format());
    let order = wire::Order {
        version: VERSION.to_owned(),
        protocol: PROTOCOL,
        name: request.name.clone(),
        frame: request.size.map(Into::into),
        quality: Some(request.quality.into()),
        strict: request.strict,
        tile_side: request.tile_side.map_or(0, |side| side as u32),
        format: wire::Format::from(request.format).into(),
        transfer: wire::Transfer::from(request.transfer).into(),
    };
    let folder = scene_folder(&args.picture.scene);
    let (text, files) = spawn_blocking(move || {
        let files = named_files(&text, &folder);
        text.ensure_unchanged().map(|()| (text, files))
    })
    .await?
    .with_context(|| format!("cannot read the scene {}", args.picture.scene.name()))?;
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
    let submitting = client.submit(ReceiverStream::new(parts));
    let answer = within(SUBMIT_DEADLINE, submitting).await?.into_inner();
    console.tell_report(&answer.report);
    match answer.outcome {
        Some(Outcome::Accepted(accepted)) => Ok(accepted),
        Some(Outcome::Refused(reason)) if reason.is_empty() => Err(Failure::Told),
        Some(Outcome::Refused(reason)) => {
            Err(Failure::Input(anyhow!("the farm cannot render {}: {reason}", request.name)))
        }
        None => Err(Failure::Other(anyhow!("the coordinator's answer makes no sense"))),
    }
}

/// The files that a scene names, by the names that it has for them. One that cannot be read is
/// left out: the coordinator will miss it where the scene names it.
fn named_files(text: &[u8], folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let files = Mutex::new(BTreeMap::new());
    read_scene(text, &|path: &str| {
        let data = fs::read(folder.join(path))?;
        files.lock().expect("nothing here panics").insert(path.to_owned(), data.clone());
        Ok(data)
    });
    files.into_inner().expect("nothing here panics")
}

/// Waits for the job's end. Answers with the last event and the time that the rendering took.
async fn watch(
    mut client: JobsClient<Channel>,
    job: u64,
    console: &Console,
) -> Result<(wire::Event, Duration), Failure> {
    let mut events = within(DEADLINE, client.watch(wire::WatchRequest { job })).await?.into_inner();
    let mut bar = None;
    let (last, seconds) = loop {
        let event = events.message().await.map_err(|status| describe(&status))?;
        let event = event.context("the coordinator is gone")?;
        bar.get_or_insert_with(|| console.start_bar(event.tile_count)).show(&Progress {
            tiles_done: event.tiles_done,
            tile_count: event.tile_count,
            tally: event.tally.and_then(|tally| tally.try_into().ok()).unwrap_or_default(),
            ..Progress::default()
        });
        tracing::debug!(done = event.tiles_done, count = event.tile_count, "progress");
        match &event.end {
            Some(event::End::Finished(finished)) => {
                let seconds = finished.seconds;
                break (event, seconds);
            }
            Some(event::End::Failed(reason)) => {
                return Err(Failure::Other(anyhow!("the farm failed: {reason}")));
            }
            None => {}
        }
    };
    drop(bar);
    if last.differing_tiles > 0 {
        tracing::warn!(
            tiles = last.differing_tiles,
            "two workers rendered the same tile differently; one of them is broken"
        );
    }
    Ok((last, Duration::try_from_secs_f64(seconds)?))
}

/// Brings a finished job's picture.
async fn fetch(
    mut client: JobsClient<Channel>,
    job: u64,
    output: &Output,
    stop: &CancellationToken,
) -> Result<(), Failure> {
    let asking = within(IMAGE_DEADLINE, client.image(wire::ImageRequest { job }));
    let mut chunks = tokio::select! {
        chunks = asking => chunks?.into_inner(),
        () = stop.cancelled() => return Err(Failure::Interrupted),
    };
    let (send, mut received) = mpsc::channel::<wire::Chunk>(2);
    let (output, token) = (output.clone(), stop.clone());
    let writing = spawn_blocking(move || {
        output.write(&token, |file| {
            let mut is_whole = false;
            while let Some(chunk) = received.blocking_recv() {
                // The last chunk is empty: a stream that is cut short has none.
                is_whole = chunk.data.is_empty();
                file.write_all(&chunk.data)?;
            }
            if is_whole { Ok(()) } else { Err(io::Error::other("the picture was cut short")) }
        })
    });
    let receiving = async move {
        loop {
            let chunk = tokio::select! {
                chunk = within(DEADLINE * 2, chunks.message()) => chunk?,
                () = stop.cancelled() => return Err(Failure::Interrupted),
            };
            let is_last = chunk.is_none();
            if send.send(chunk.unwrap_or_default()).await.is_err() || is_last {
                return Ok(());
            }
        }
    };
    let (received, written) = tokio::join!(receiving, writing);
    received?;
    Ok(written??)
}

async fn within<T>(
    deadline: Duration,
    call: impl Future<Output = Result<T, Status>>,
) -> Result<T, Failure> {
    match tokio::time::timeout(deadline, call).await {
        Ok(answer) => answer.map_err(|status| describe(&status)),
        Err(_) => Err(Failure::Other(anyhow!("the coordinator does not answer"))),
    }
}

fn describe(status: &Status) -> Failure {
    Failure::Other(anyhow!("the coordinator says: {}", status.message()))
}
