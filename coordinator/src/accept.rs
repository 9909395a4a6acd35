//! How connections are let in: errors are waited out, and who says nothing is sent away.

use std::{
    future::poll_fn,
    io,
    net::SocketAddr,
    pin::Pin,
    task::{Context, Poll},
    time::Duration,
};

use tokio::{
    io::{AsyncRead, AsyncWrite, ReadBuf},
    net::{TcpListener, TcpSocket},
    sync::mpsc,
    time::{Sleep, sleep},
};
use tonic::transport::server::Connected;

/// Whoever connects must have said something after this time.
const FIRST_WORD: Duration = Duration::from_secs(10);

/// The pause after a connection that could not be accepted, as when descriptors run out. It doubles
/// each time, up to [`LONGEST_PAUSE`].
const FIRST_PAUSE: Duration = Duration::from_millis(100);

const LONGEST_PAUSE: Duration = Duration::from_secs(1);

/// So many connections may wait in the system's queue, if that allows it: a whole farm may come at
/// once, and who finds no room tries again a second later.
const BACKLOG: u32 = 4096;

/// Connections wait for the server so many at a time; the rest waits in the system's queue.
pub(crate) const WAITING: usize = 16;

/// Listens on an address, with room for a whole farm.
pub fn listen(address: SocketAddr) -> io::Result<TcpListener> {
    let socket = if address.is_ipv4() { TcpSocket::new_v4()? } else { TcpSocket::new_v6()? };
    // The port of a coordinator that ended a moment ago is free.
    socket.set_reuseaddr(true)?;
    socket.bind(address)?;
    socket.listen(BACKLOG)
}

/// A connection on which the other side has to say something soon.
#[derive(Debug)]
pub(crate) struct Greeted<S> {
    stream: S,
    /// Until the first word has come.
    deadline: Option<Pin<Box<Sleep>>>,
}

impl<S> Greeted<S> {
    fn new(stream: S, patience: Duration) -> Self {
        Self { stream, deadline: Some(Box::pin(sleep(patience))) }
    }
}

/// Accepts connections and hands them on, until nobody takes them any more.
pub(crate) async fn accept_all<S>(
    mut accept: impl FnMut(&mut Context<'_>) -> Poll<io::Result<S>>,
    send: mpsc::Sender<io::Result<Greeted<S>>>,
) {
    let mut pause = FIRST_PAUSE;
    while let Ok(place) = send.reserve().await {
        let accepted = tokio::select! {
            accepted = poll_fn(&mut accept) => accepted,
            () = send.closed() => return,
        };
        match accepted {
            Ok(stream) => {
                pause = FIRST_PAUSE;
                place.send(Ok(Greeted::new(stream, FIRST_WORD)));
            }
            Err(error) => {
                tracing::warn!(reason = %error, ?pause, "cannot accept a connection");
                sleep(pause).await;
                pause = LONGEST_PAUSE.min(pause * 2);
            }
        }
    }
}

impl<S: AsyncRead + Unpin> AsyncRead for Greeted<S> {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        let read = Pin::new(&mut self.stream).poll_read(context, buffer);
        let Some(deadline) = &mut self.deadline else { return read };
        if read.is_ready() {
            self.deadline = None;
            return read;
        }
        deadline.as_mut().poll(context).map(|()| Err(io::ErrorKind::TimedOut.into()))
    }
}

impl<S: AsyncWrite + Unpin> AsyncWrite for Greeted<S> {
    fn poll_write(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.stream).poll_write(context, bytes)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        slices: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.stream).poll_write_vectored(context, slices)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(context)
    }
}

impl<S: Connected> Connected for Greeted<S> {
    type ConnectInfo = S::ConnectInfo;

    fn connect_info(&self) -> S::ConnectInfo {
        self.stream.connect_info()
    }
}

#[cfg(test)]
mod tests {
    use tokio::{net::UnixStream, time::timeout};

    use super::*;

    async fn read(stream: &mut Greeted<UnixStream>) -> io::Result<usize> {
        let mut bytes = [0; 8];
        let mut buffer = ReadBuf::new(&mut bytes);
        poll_fn(|context| Pin::new(&mut *stream).poll_read(context, &mut buffer)).await?;
        Ok(buffer.filled().len())
    }

    #[tokio::test]
    async fn who_says_nothing_is_sent_away_and_who_has_spoken_may_be_silent() {
        let patience = Duration::from_millis(50);
        let (_silent, here) = UnixStream::pair().unwrap();
        let mut stream = Greeted::new(here, patience);
        assert_eq!(read(&mut stream).await.unwrap_err().kind(), io::ErrorKind::TimedOut);

        let (there, here) = UnixStream::pair().unwrap();
        let mut stream = Greeted::new(here, patience);
        there.try_write(b"PRI").unwrap();
        assert_eq!(read(&mut stream).await.unwrap(), 3);
        timeout(4 * patience, read(&mut stream)).await.expect_err("it is waited for");
    }

    #[tokio::test]
    async fn connections_that_cannot_be_accepted_are_tried_again_after_a_pause() {
        let mut attempts = 0;
        let accept = |_: &mut Context<'_>| {
            attempts += 1;
            Poll::Ready(Err::<UnixStream, _>(io::Error::from_raw_os_error(24)))
        };
        let (send, _connections) = mpsc::channel(WAITING);
        timeout(Duration::from_millis(250), accept_all(accept, send)).await.unwrap_err();
        assert!((1..=2).contains(&attempts), "{attempts} attempts");
    }
}
