//! The coordinator as a process part: its handle, and the loop that runs it.

use std::{
    io,
    sync::Arc,
    task::{Context, Poll, ready},
    time::Duration,
};

use rtfarm_core::tile::TileId;
use rtfarm_job::Order;
use rtfarm_picture::{Canvas, TileRecord, View};
use rtfarm_proto::JobId;
use tokio::{
    io::{AsyncRead, AsyncWrite},
    net::{TcpListener, TcpStream, UnixListener},
    sync::{Semaphore, mpsc},
    time::timeout,
};
use tokio_rustls::{TlsAcceptor, server::TlsStream};
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::sync::CancellationToken;
use tonic::transport::server::Router;

use crate::{
    accept::{Door, Greeted, Limits, WAITING, accept_all},
    identity::Identity,
    job::Job,
    live,
    record::Ticket,
    security::Security,
    service,
    shell::{Config, Shell, SubmitError},
    state::StateFolder,
};

/// A coordinator. Clones are the same one.
#[derive(Debug, Clone)]
pub struct Coordinator {
    shell: Arc<Shell>,
}

/// Where workers and clients come in.
#[derive(Debug)]
pub enum Listener {
    /// A socket on this machine.
    Unix(UnixListener),
    /// TCP, where nothing is encrypted and nobody is asked for a token.
    Tcp(TcpListener),
    /// TLS over TCP, for those who have a token.
    Tls(TcpListener, Security, Limits),
}

/// How long connections may take to close when the coordinator stops.
const CLOSING: Duration = Duration::from_millis(1500);

impl Coordinator {
    /// Makes a coordinator without jobs and workers, and draws its identity.
    pub fn new(config: Config) -> io::Result<Self> {
        Self::draw(config, None)
    }

    /// Makes a coordinator without workers, which goes on with the farm and its jobs in `folder`.
    pub fn with_state(config: Config, folder: StateFolder) -> io::Result<Self> {
        Self::draw(config, Some(folder))
    }

    fn draw(config: Config, folder: Option<StateFolder>) -> io::Result<Self> {
        let (mut random, mut secret) = ([0; 24], [0; 32]);
        for bytes in [&mut random[..], &mut secret] {
            rustix::rand::getrandom(bytes, rustix::rand::GetRandomFlags::empty())?;
        }
        let mut identity = Identity::from_random(random);
        if let Some(folder) = &folder {
            identity.farm = folder.farm();
        }
        Ok(Self { shell: Arc::new(Shell::new(config, identity, secret, folder)?) })
    }

    /// Takes an order. This writes files: never call it on the async runtime.
    pub fn submit(&self, order: Order) -> Result<Arc<Job>, SubmitError> {
        let ticket = Ticket { name: order.name.clone(), ..Ticket::default() };
        self.shell.submit(order, ticket)
    }

    /// Takes an order whose picture is `canvas`, cut as the order says; these tiles are in it
    /// already. This writes files: never call it on the async runtime.
    pub fn submit_on(
        &self,
        order: Order,
        canvas: Canvas,
        done: &[(TileId, TileRecord)],
    ) -> Result<Arc<Job>, SubmitError> {
        let ticket = Ticket { name: order.name.clone(), ..Ticket::default() };
        self.shell.submit_on(self.shell.number_job(), (order, ticket), canvas, done)
    }

    /// Ends a job, if it has not ended, and forgets it.
    pub fn cancel(&self, job: JobId) {
        self.shell.cancel(job);
    }

    /// Ends and forgets every job.
    pub fn cancel_all(&self) {
        for (entry, _) in self.shell.jobs() {
            self.shell.cancel(entry.id);
        }
    }

    /// Event: the process of a worker on this machine is known to be dead.
    pub fn on_process_exit(&self, process: u32, reason: &str) {
        self.shell.report_process_exit(process, reason);
    }

    /// Sends every worker home.
    pub fn close(&self) {
        self.shell.close();
    }

    /// What a view shows of a job's picture: `[y][x]`, red, green and blue. Where no tile has come
    /// yet that is a coarse picture's, if jobs begin so. This reads the picture: never call it on
    /// the async runtime.
    pub fn snapshot(&self, job: &Job, view: View) -> io::Result<Vec<u8>> {
        live::snapshot(&self.shell, job, view)
    }

    /// Serves the page to those on this machine who have this token, until the coordinator stops.
    pub async fn show(&self, listener: TcpListener, token: &str) -> Result<(), ServeError> {
        let door = Door { is_local: false, limits: Limits::default(), places: None };
        let router = service::page_router(&self.shell, token);
        let stop = self.shell.stop.clone();
        Ok(serve_accepted(router, accept_tcp(&listener), door, stop).await?)
    }

    /// Serves workers and clients until `shutdown` comes; returns when they have been sent home.
    pub async fn run(
        &self,
        listener: Listener,
        shutdown: impl Future<Output = ()>,
    ) -> Result<(), ServeError> {
        let serve = serve(&self.shell, listener, self.shell.stop.clone());
        let close = async {
            shutdown.await;
            self.shell.shut_down();
            self.shell.stop.cancelled().await;
            tokio::time::sleep(CLOSING).await;
        };
        let served = tokio::select! {
            served = serve => served,
            () = close => Ok(()),
            () = self.shell.keep_time() => unreachable!("time does not end"),
            () = self.shell.keep_synced() => unreachable!("there is always more to write"),
        };
        let shell = Arc::clone(&self.shell);
        tokio::task::spawn_blocking(move || shell.sync()).await.expect("syncing never panics");
        served
    }
}

/// Why nobody is served.
#[derive(Debug, thiserror::Error)]
pub enum ServeError {
    /// Connections cannot be served.
    #[error(transparent)]
    Transport(#[from] tonic::transport::Error),
    /// The certificate cannot be read.
    #[error("cannot read the certificate: {0}")]
    Certificate(#[from] io::Error),
}

async fn serve(
    shell: &Arc<Shell>,
    listener: Listener,
    stop: CancellationToken,
) -> Result<(), ServeError> {
    let door = |is_local| Door { is_local, limits: Limits::default(), places: None };
    match listener {
        Listener::Unix(listener) => {
            let accept = |context: &mut Context<'_>| {
                listener.poll_accept(context).map_ok(|(stream, _)| stream)
            };
            let router = service::router(shell, None);
            Ok(serve_accepted(router, accept, door(true), stop).await?)
        }
        Listener::Tcp(listener) => {
            let router = service::router(shell, None);
            Ok(serve_accepted(router, accept_tcp(&listener), door(false), stop).await?)
        }
        Listener::Tls(listener, security, limits) => {
            let tls = security.tls()?;
            let router = service::router(shell, Some(Arc::new(security)));
            let places = Some(Arc::new(Semaphore::new(limits.strangers)));
            let door = Door { is_local: false, limits, places };
            let (send, connections) = mpsc::channel(WAITING);
            let (send_secured, secured) = mpsc::channel(WAITING);
            let secured = ReceiverStream::new(secured);
            let serve = router.serve_with_incoming_shutdown(secured, stop.cancelled_owned());
            let (served, (), ()) = tokio::join!(
                serve,
                accept_all(accept_tcp(&listener), door, send),
                shake_hands(connections, tls, limits.handshake, send_secured),
            );
            Ok(served?)
        }
    }
}

/// Has those who connect speak TLS, and hands on those who do in time, until nobody takes them any
/// more.
async fn shake_hands<S: AsyncRead + AsyncWrite + Unpin + Send + 'static>(
    mut connections: mpsc::Receiver<io::Result<Greeted<S>>>,
    tls: TlsAcceptor,
    patience: Duration,
    send: mpsc::Sender<io::Result<Greeted<TlsStream<Greeted<S>>>>>,
) {
    loop {
        let connection = tokio::select! {
            connection = connections.recv() => connection,
            () = send.closed() => return,
        };
        let Some(Ok(connection)) = connection else { return };
        let (handshake, send) = (tls.accept(connection), send.clone());
        tokio::spawn(async move {
            match timeout(patience, handshake).await {
                Ok(Ok(stream)) => {
                    let secured = Greeted::around(stream);
                    // When nobody takes it the coordinator stops.
                    let _ = send.send(Ok(secured)).await;
                }
                Ok(Err(error)) => tracing::debug!(reason = %error, "a handshake failed"),
                Err(_) => tracing::debug!("a handshake took too long"),
            }
        });
    }
}

fn accept_tcp(
    listener: &TcpListener,
) -> impl FnMut(&mut Context<'_>) -> Poll<io::Result<TcpStream>> {
    |context| {
        let accepted = ready!(listener.poll_accept(context));
        // Messages are written whole: none gains by waiting for the next.
        Poll::Ready(accepted.and_then(|(stream, _)| stream.set_nodelay(true).map(|()| stream)))
    }
}

async fn serve_accepted<S>(
    router: Router,
    accept: impl FnMut(&mut Context<'_>) -> Poll<io::Result<S>>,
    door: Door,
    stop: CancellationToken,
) -> Result<(), tonic::transport::Error>
where
    S: AsyncRead + AsyncWrite + Unpin + Send + 'static,
{
    let (send, connections) = mpsc::channel(WAITING);
    let connections = ReceiverStream::new(connections);
    let serve = router.serve_with_incoming_shutdown(connections, stop.cancelled_owned());
    // Accepting ends when nobody takes connections any more.
    let (served, ()) = tokio::join!(serve, accept_all(accept, door, send));
    served
}

#[cfg(test)]
mod tests {
    use std::fs;

    use rtfarm_proto::{Access, Address};
    use tempfile::TempDir;
    use tokio::task::JoinHandle;

    use super::*;
    use crate::{farm::Keeping, security::make_certificates, upload::OrderLimits};

    /// How a coordinator is reached, whose certificate is good to that day, who serves it, and its
    /// folder.
    async fn start(
        last_day: (i32, u8, u8),
    ) -> (Access, JoinHandle<Result<(), ServeError>>, TempDir) {
        let state = tempfile::tempdir().unwrap();
        let folder = state.path().join("access");
        fs::create_dir(&folder).unwrap();
        make_certificates(&folder, last_day).unwrap();
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address: Address =
            format!("https://{}", listener.local_addr().unwrap()).parse().unwrap();
        let security = Security::open(state.path(), &address).unwrap();
        let coordinator = Coordinator::new(Config {
            version: String::new(),
            build: String::new(),
            reference: None,
            term: Duration::from_secs(1),
            audit: 0.0,
            keeping: Keeping::default(),
            upload_silence: Duration::from_secs(1),
            events: None,
            begins_coarsely: false,
            host: None,
            orders: OrderLimits::default(),
            scene_folder: state.path().to_owned(),
            picture_folder: state.path().to_owned(),
        })
        .unwrap();
        let listener = Listener::Tls(listener, security, Limits::default());
        let serving =
            tokio::spawn(async move { coordinator.run(listener, std::future::pending()).await });
        let access = Access::read(&fs::read_to_string(folder.join("read")).unwrap()).unwrap();
        (access, serving, state)
    }

    /// What becomes of a connection to a coordinator whose certificate is good to that day.
    async fn connect(last_day: (i32, u8, u8)) -> Result<(), String> {
        let (access, serving, _state) = start(last_day).await;
        let connected = access.connect().await;
        serving.abort();
        connected.map(drop).map_err(|error| with_reasons(&error))
    }

    /// An error with all its reasons.
    fn with_reasons(error: &dyn std::error::Error) -> String {
        let reasons = std::iter::successors(error.source(), |error| error.source());
        reasons.fold(error.to_string(), |text, reason| format!("{text}: {reason}"))
    }

    #[tokio::test]
    async fn an_expired_certificate_is_not_believed() {
        assert_eq!(connect((4096, 1, 1)).await, Ok(()));
        let refused = connect((2020, 1, 1)).await.unwrap_err();
        assert!(refused.contains("expired"), "{refused}");
    }

    /// A browser that asks for HTTP/2 gets it, one that asks for HTTP/1.1 or for nothing gets that.
    #[tokio::test]
    async fn a_page_is_shown_in_http_1_over_tls_too() {
        use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
        use tokio_rustls::{
            TlsConnector,
            rustls::{
                ClientConfig, RootCertStore,
                pki_types::{CertificateDer, ServerName, pem::PemObject as _},
            },
        };
        let (access, serving, _state) = start((4096, 1, 1)).await;
        let text = access.text().unwrap();
        let authority = CertificateDer::from_pem_slice(text.as_bytes()).unwrap();
        let mut roots = RootCertStore::empty();
        roots.add(authority).unwrap();
        let address = access.address().to_string().replace("https://", "");
        for (asked, chosen) in [
            (&["h2", "http/1.1"][..], Some(&b"h2"[..])),
            (&["http/1.1"], Some(b"http/1.1")),
            (&[], None),
        ] {
            let config = ClientConfig::builder().with_root_certificates(roots.clone());
            let mut config = config.with_no_client_auth();
            config.alpn_protocols = asked.iter().map(|&name| Vec::from(name)).collect();
            let tcp = TcpStream::connect(&address).await.unwrap();
            let name = ServerName::try_from("rtfarm").unwrap();
            let connector = TlsConnector::from(Arc::new(config));
            let mut stream = connector.connect(name, tcp).await.unwrap();
            assert_eq!(stream.get_ref().1.alpn_protocol(), chosen);
            if chosen == Some(b"h2") {
                continue;
            }
            let ask = format!("GET / HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n");
            stream.write_all(ask.as_bytes()).await.unwrap();
            let mut answer = Vec::new();
            // Not everybody says farewell in TLS.
            let _ = stream.read_to_end(&mut answer).await;
            let answer = String::from_utf8_lossy(&answer).to_lowercase();
            assert!(answer.starts_with("http/1.1 200 "), "{answer}");
            assert!(answer.contains("<!doctype html>"), "{answer}");
        }
        serving.abort();
    }
}
