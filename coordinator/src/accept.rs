//! How connections are let in: errors are waited out, and who says nothing is sent away.

use std::{
    future::poll_fn,
    io,
    net::SocketAddr,
    pin::Pin,
    sync::{
        Arc, Mutex,
        atomic::{AtomicBool, Ordering},
    },
    task::{Context, Poll},
    time::Duration,
};

use tokio::{
    io::{AsyncRead, AsyncWrite, ReadBuf},
    net::{TcpListener, TcpSocket},
    sync::{OwnedSemaphorePermit, Semaphore, mpsc},
    time::{Sleep, sleep},
};
use tokio_rustls::server::TlsStream;
use tonic::transport::server::Connected;

/// How connections of strangers are limited.
#[derive(Debug, Clone, Copy)]
pub struct Limits {
    /// The longest that a handshake may take where there is TLS.
    pub handshake: Duration,
    /// Whoever connects must have said something after this time, or have shown a token where one
    /// is asked for.
    pub first_word: Duration,
    /// The most connections on which nobody has shown a token yet, where one is asked for. More
    /// wait to be accepted.
    pub strangers: usize,
}

impl Default for Limits {
    fn default() -> Self {
        let (handshake, first_word) = (Duration::from_secs(5), Duration::from_secs(10));
        Self { handshake, first_word, strangers: 64 }
    }
}

/// Who is at the other end of a connection.
#[derive(Debug, Clone)]
pub(crate) struct Peer {
    /// It is on this machine for certain.
    pub(crate) is_local: bool,
    /// Its place among the strangers, until it has shown a token. `None` where none is asked for.
    place: Option<Arc<Mutex<Option<OwnedSemaphorePermit>>>>,
    /// Nothing is to be said to it or heard of it any more.
    is_cut_off: Arc<AtomicBool>,
}

impl Peer {
    fn new(is_local: bool, permit: Option<OwnedSemaphorePermit>) -> Self {
        let place = permit.map(|permit| Mutex::new(Some(permit)).into());
        Self { is_local, place, is_cut_off: Arc::default() }
    }

    /// Has its connection closed, when that is next looked at: in ten seconds at the latest, by
    /// which connections show that they are alive.
    pub(crate) fn cut_off(&self) {
        self.is_cut_off.store(true, Ordering::Relaxed);
    }

    /// It has shown a token: its place is another one's.
    pub(crate) fn admit(&self) {
        if let Some(place) = &self.place {
            place.lock().expect("nothing here panics").take();
        }
    }

    /// Says whether it has to show a token still.
    fn is_stranger(&self) -> bool {
        let place = self.place.as_ref();
        place.is_some_and(|place| place.lock().expect("nothing here panics").is_some())
    }
}

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

/// A connection on which the other side has to say something soon, or to show a token.
#[derive(Debug)]
pub(crate) struct Greeted<S> {
    stream: S,
    peer: Peer,
    /// Until the first word has come, or a token was shown where one is asked for.
    deadline: Option<Pin<Box<Sleep>>>,
}

impl<S> Greeted<S> {
    fn new(stream: S, peer: Peer, patience: Duration) -> Self {
        Self { stream, peer, deadline: Some(Box::pin(sleep(patience))) }
    }
}

impl<S> Greeted<TlsStream<Greeted<S>>> {
    /// A connection whose hands are shaken; what lies below keeps the time.
    pub(crate) fn around(stream: TlsStream<Greeted<S>>) -> Self {
        let peer = stream.get_ref().0.peer.clone();
        Self { stream, peer, deadline: None }
    }
}

/// Whom to let in.
#[derive(Debug, Clone)]
pub(crate) struct Door {
    pub(crate) is_local: bool,
    pub(crate) limits: Limits,
    /// Places for those who have not shown a token yet; `None` where none is asked for.
    pub(crate) places: Option<Arc<Semaphore>>,
}

/// Accepts connections and hands them on, until nobody takes them any more.
pub(crate) async fn accept_all<S>(
    mut accept: impl FnMut(&mut Context<'_>) -> Poll<io::Result<S>>,
    door: Door,
    send: mpsc::Sender<io::Result<Greeted<S>>>,
) {
    let mut pause = FIRST_PAUSE;
    while let Ok(place) = send.reserve().await {
        let permit = async {
            let places = door.places.clone()?;
            Some(places.acquire_owned().await.expect("it is never closed"))
        };
        let accepting = async { (permit.await, poll_fn(&mut accept).await) };
        let (permit, accepted) = tokio::select! {
            accepted = accepting => accepted,
            () = send.closed() => return,
        };
        match accepted {
            Ok(stream) => {
                pause = FIRST_PAUSE;
                let is_local = door.is_local;
                let peer = Peer::new(is_local, permit);
                place.send(Ok(Greeted::new(stream, peer, door.limits.first_word)));
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
        if self.peer.is_cut_off.load(Ordering::Relaxed) {
            return Poll::Ready(Err(io::ErrorKind::ConnectionAborted.into()));
        }
        let is_stranger = self.peer.is_stranger();
        if self.peer.place.is_some() && !is_stranger {
            // It has shown a token.
            self.deadline = None;
        }
        let is_over = |deadline: &mut Pin<Box<Sleep>>| deadline.as_mut().poll(context).is_ready();
        let is_late = self.deadline.as_mut().is_some_and(is_over);
        let late = || Poll::Ready(Err(io::ErrorKind::TimedOut.into()));
        if is_late && is_stranger {
            // However much it says.
            return late();
        }
        let read = Pin::new(&mut self.stream).poll_read(context, buffer);
        if read.is_ready() && !is_stranger {
            self.deadline = None;
        }
        if is_late && read.is_pending() { late() } else { read }
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

impl<S> Connected for Greeted<S> {
    type ConnectInfo = Peer;

    fn connect_info(&self) -> Peer {
        self.peer.clone()
    }
}

#[cfg(test)]
mod tests {
    use tokio::{net::UnixStream, time::timeout};

    use super::*;

    fn peer(permit: Option<OwnedSemaphorePermit>) -> Peer {
        Peer::new(false, permit)
    }

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
        let mut stream = Greeted::new(here, peer(None), patience);
        assert_eq!(read(&mut stream).await.unwrap_err().kind(), io::ErrorKind::TimedOut);

        let (there, here) = UnixStream::pair().unwrap();
        let mut stream = Greeted::new(here, peer(None), patience);
        there.try_write(b"PRI").unwrap();
        assert_eq!(read(&mut stream).await.unwrap(), 3);
        timeout(4 * patience, read(&mut stream)).await.expect_err("it is waited for");
    }

    #[tokio::test(start_paused = true)]
    async fn connections_that_cannot_be_accepted_are_tried_again_after_a_pause() {
        let mut attempts = 0;
        let accept = |_: &mut Context<'_>| {
            attempts += 1;
            Poll::Ready(Err::<UnixStream, _>(io::Error::from_raw_os_error(24)))
        };
        let (send, _connections) = mpsc::channel(WAITING);
        let door = Door { is_local: true, limits: Limits::default(), places: None };
        timeout(Duration::from_millis(250), accept_all(accept, door, send)).await.unwrap_err();
        assert!((1..=2).contains(&attempts), "{attempts} attempts");
    }

    #[tokio::test]
    async fn who_shows_no_token_is_sent_away_however_much_it_says() {
        let patience = Duration::from_millis(100);
        let places = Arc::new(Semaphore::new(1));
        let (there, here) = UnixStream::pair().unwrap();
        let permit = Arc::clone(&places).acquire_owned().await.unwrap();
        let mut stranger = Greeted::new(here, peer(Some(permit)), patience);
        let begun = tokio::time::Instant::now();
        let error = loop {
            there.try_write(b"x").unwrap();
            tokio::time::sleep(patience / 10).await;
            if let Err(error) = read(&mut stranger).await {
                break error;
            }
        };
        assert_eq!(error.kind(), io::ErrorKind::TimedOut);
        assert!(begun.elapsed() >= patience && places.available_permits() == 0);
        drop(stranger);
        assert_eq!(places.available_permits(), 1, "its place is free with its connection");

        let (_silent, here) = UnixStream::pair().unwrap();
        let permit = Arc::clone(&places).acquire_owned().await.unwrap();
        let mut member = Greeted::new(here, peer(Some(permit)), patience);
        member.peer.admit();
        assert_eq!(places.available_permits(), 1);
        timeout(3 * patience, read(&mut member)).await.expect_err("it may be silent");
    }

    #[tokio::test]
    async fn so_many_strangers_and_no_more_are_accepted() {
        let mut peers = Vec::new();
        let accept = |_: &mut Context<'_>| {
            let (there, here) = UnixStream::pair().unwrap();
            peers.push(there);
            Poll::Ready(Ok(here))
        };
        let (send, mut connections) = mpsc::channel(WAITING);
        let places = Some(Arc::new(Semaphore::new(2)));
        let door = Door { is_local: false, limits: Limits::default(), places };
        tokio::select! {
            () = accept_all(accept, door, send) => panic!("it goes on"),
            () = async {
                let first = connections.recv().await.unwrap().unwrap();
                let _second = connections.recv().await.unwrap().unwrap();
                let none = timeout(Duration::from_millis(50), connections.recv()).await;
                assert!(none.is_err(), "there is no place for a third");
                first.peer.admit();
                connections.recv().await.unwrap().unwrap();
            } => {}
        }
    }
}
