//! Files on their way out, piece by piece.

use std::{
    io::Read,
    pin::Pin,
    sync::Arc,
    task::{Context, Poll, ready},
};

use rtfarm_proto::{CHUNK_BYTES, wire};
use tokio::sync::{Notify, OwnedSemaphorePermit, mpsc};
use tokio_stream::Stream;
use tonic::Status;

use super::{blocking, broken};
use crate::{accept::Peer, job::Job, shell::Shell};

pub(super) type Chunks = Pin<Box<dyn Stream<Item = Result<wire::Chunk, Status>> + Send>>;

/// Streams a file in pieces; `job` is kept until the last one has gone. A piece is read when the
/// one before it is on the wire: a reader that takes none holds no thread, and in the end loses its
/// connection.
pub(super) fn stream_file(
    file: std::fs::File,
    job: Arc<Job>,
    peer: Option<Peer>,
    shell: &Shell,
) -> Chunks {
    let (send, receive) = mpsc::channel(1);
    let (flight, silence) = (shell.leaving.clone(), shell.config.upload_silence);
    let asked = Arc::new(Notify::new());
    let pieces = Pieces { receive, asked: Arc::clone(&asked), is_asked: false, on_its_way: None };
    tokio::spawn(async move {
        let mut rest = Some(file);
        while let Some(file) = rest.take() {
            tokio::select! {
                () = asked.notified() => {}
                () = send.closed() => break,
                () = tokio::time::sleep(silence) => {
                    peer.as_ref().inspect(|peer| peer.cut_off());
                    break;
                }
            }
            let room = flight.take(CHUNK_BYTES).await;
            let chunk = match blocking(move || read_chunk(file)).await {
                Ok(None) => break,
                Ok(Some((file, chunk))) => {
                    rest = Some(file);
                    Ok(chunk)
                }
                Err(status) => Err(status),
            };
            if send.send((chunk, room)).await.is_err() {
                break;
            }
        }
        drop(job);
    });
    Box::pin(pieces)
}

/// Pieces of a file. Each has its room until the next is asked for: then it is on the wire.
pub(super) struct Pieces {
    receive: mpsc::Receiver<(Result<wire::Chunk, Status>, OwnedSemaphorePermit)>,
    asked: Arc<Notify>,
    is_asked: bool,
    on_its_way: Option<OwnedSemaphorePermit>,
}

impl Stream for Pieces {
    type Item = Result<wire::Chunk, Status>;

    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        self.on_its_way = None;
        if !std::mem::replace(&mut self.is_asked, true) {
            self.asked.notify_one();
        }
        let next = ready!(self.receive.poll_recv(context));
        self.is_asked = false;
        Poll::Ready(next.map(|(chunk, room)| {
            self.on_its_way = Some(room);
            chunk
        }))
    }
}

/// The next piece of a file, and the file; `None` at its end.
pub(super) fn read_chunk(
    mut file: std::fs::File,
) -> Result<Option<(std::fs::File, wire::Chunk)>, Status> {
    let mut data = Vec::with_capacity(CHUNK_BYTES);
    match (&mut file).take(CHUNK_BYTES as u64).read_to_end(&mut data) {
        Ok(0) => Ok(None),
        Ok(_) => Ok(Some((file, wire::Chunk { data: data.into() }))),
        Err(error) => Err(broken(&error)),
    }
}
