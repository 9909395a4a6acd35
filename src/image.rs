//! `rtfarm image`: the picture of a job that a farm still keeps, or what there is of it.

use std::time::Duration;

use anyhow::anyhow;
use rtfarm_client::plain;
use rtfarm_core::render::Tally;
use rtfarm_proto::{
    Access,
    wire::{self, event},
};
use tokio::{sync::mpsc, task::spawn_blocking, time::timeout};
use tokio_util::sync::CancellationToken;

use crate::{
    args::ImageArgs,
    failure::Failure,
    output::Output,
    queue::{connect, late, picture_json, refused, tell},
    sidecar::Making,
    submit::write_chunks,
};

/// A coordinator that listens forgets a job at once.
const FORGET_DEADLINE: Duration = Duration::from_secs(3);

/// The longest that an answer may take which is there already.
const ANSWER_DEADLINE: Duration = Duration::from_secs(15);

/// Encoding a large picture takes a while.
const IMAGE_DEADLINE: Duration = Duration::from_secs(600);

/// The longest that a piece of the picture may be on its way.
const CHUNK_DEADLINE: Duration = Duration::from_secs(30);

pub(crate) async fn run(args: ImageArgs, stop: &CancellationToken) -> Result<(), Failure> {
    let mut output = Output::new(&args.output, None).map_err(Failure::Input)?;
    output.check()?;
    let access = args.coordinator.access().map_err(Failure::Input)?;
    let (send, mut chunks) = mpsc::channel(2);
    let writing = spawn_blocking({
        let (output, stop) = (output.clone(), stop.clone());
        move || write_chunks(&output, &stop, &mut chunks)
    });
    let fetched = tokio::select! {
        fetched = fetch(&args, &access, send) => fetched,
        () = stop.cancelled() => Err(Failure::Interrupted),
    };
    // The file is whole or removed when this process ends.
    let written = writing.await?;
    fetched?;
    written?;
    if args.sidecar {
        let making = ask_making(&args, &access).await?;
        let (output, stop) = (output.clone(), stop.clone());
        spawn_blocking(move || making.write(&output, &stop)).await??;
    }
    if !args.partial && !args.keep {
        forget(&args, &access).await;
    }
    if args.json {
        tell(true, &picture_json(args.job, output.name(), None), "")?;
    }
    Ok(())
}

/// Has the farm forget a job whose picture is here. If it does not it will keep it for a while.
async fn forget(args: &ImageArgs, access: &Access) {
    let request = wire::CancelRequest { job: args.job, ..wire::CancelRequest::default() };
    let cancel = async { connect(access).await?.cancel(request).await.map_err(refused) };
    let forgotten = match timeout(FORGET_DEADLINE, cancel).await {
        Ok(forgotten) => forgotten.map(drop),
        Err(elapsed) => Err(late(elapsed)),
    };
    if let Err(error) = forgotten {
        tracing::warn!(reason = %error, "the farm still keeps the picture");
    }
}

/// Asks how a finished picture came about.
async fn ask_making(args: &ImageArgs, access: &Access) -> anyhow::Result<Making> {
    let ask = async {
        let request = wire::WatchRequest { job: args.job, ..wire::WatchRequest::default() };
        let events = connect(access).await?.watch(request).await.map_err(refused)?;
        events.into_inner().message().await.map_err(refused)
    };
    let event = timeout(ANSWER_DEADLINE, ask).await.map_err(late)??;
    let senseless = || anyhow!("the coordinator's answer makes no sense");
    let wire::Event { tally, workers, hosts, end, .. } = event.ok_or_else(senseless)?;
    let Some(event::End::Finished(wire::Finished { seconds })) = end else {
        return Err(senseless());
    };
    Ok(Making {
        rendering: Duration::try_from_secs_f64(seconds).map_err(|_| senseless())?,
        workers: workers as usize,
        hosts: hosts.iter().map(|host| plain(host)).collect(),
        tally: Tally::try_from(tally.unwrap_or_default()).map_err(|_| senseless())?,
    })
}

/// Brings the picture and hands it on, piece by piece; the last one is empty.
async fn fetch(
    args: &ImageArgs,
    access: &Access,
    send: mpsc::Sender<wire::Chunk>,
) -> Result<(), Failure> {
    let mut client = connect(access).await?;
    let ImageArgs { job, partial, .. } = *args;
    let image = client.image(wire::ImageRequest { job, partial, ..wire::ImageRequest::default() });
    let image = timeout(IMAGE_DEADLINE, image).await.map_err(late)?;
    let mut chunks = image.map_err(refused)?.into_inner();
    loop {
        let chunk = timeout(CHUNK_DEADLINE, chunks.message()).await.map_err(late)?;
        let chunk = chunk.map_err(refused)?;
        let is_last = chunk.is_none();
        // The writer tells why it takes no more.
        if send.send(chunk.unwrap_or_default()).await.is_err() || is_last {
            return Ok(());
        }
    }
}
