//! `rtfarm image`: the picture of a finished job that a farm still keeps.

use std::time::Duration;

use anyhow::{Context, anyhow};
use rtfarm_proto::wire;
use tokio::{sync::mpsc, task::spawn_blocking, time::timeout};
use tokio_util::sync::CancellationToken;
use tonic::Status;

use crate::{
    args::ImageArgs,
    failure::Failure,
    output::Output,
    plain::plain,
    submit::{reach, write_chunks},
};

/// The longest that reaching the coordinator may take.
const DEADLINE: Duration = Duration::from_secs(15);

/// Encoding a large picture takes a while.
const IMAGE_DEADLINE: Duration = Duration::from_secs(600);

/// The longest that a piece of the picture may be on its way.
const CHUNK_DEADLINE: Duration = Duration::from_secs(30);

pub(crate) async fn run(args: ImageArgs, stop: &CancellationToken) -> Result<(), Failure> {
    let mut output = Output::new(&args.output, None).map_err(Failure::Input)?;
    output.check()?;
    let (send, mut chunks) = mpsc::channel(2);
    let writing = spawn_blocking({
        let (output, stop) = (output.clone(), stop.clone());
        move || write_chunks(&output, &stop, &mut chunks)
    });
    let fetched = tokio::select! {
        fetched = fetch(&args, send) => fetched,
        () = stop.cancelled() => Err(Failure::Interrupted),
    };
    // The file is whole or removed when this process ends.
    let written = writing.await?;
    fetched?;
    Ok(written?)
}

/// Brings the picture and hands it on, piece by piece; the last one is empty.
async fn fetch(args: &ImageArgs, send: mpsc::Sender<wire::Chunk>) -> Result<(), Failure> {
    let address = &args.coordinator;
    let late = |_| anyhow!("the coordinator does not answer");
    let refused = |status: Status| anyhow!("the coordinator says: {}", plain(status.message()));
    let client = timeout(DEADLINE, reach(address)).await.map_err(late)?;
    let mut client = client.with_context(|| format!("no coordinator answers at {address}"))?;
    let image = client.image(wire::ImageRequest { job: args.job, ..wire::ImageRequest::default() });
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
