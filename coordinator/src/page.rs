//! The page on which a farm is watched, and figures for machines: what is served by HTTP besides
//! the gRPC services, to be looked at only.

use std::{
    convert::Infallible,
    io,
    net::IpAddr,
    pin::Pin,
    str::FromStr,
    sync::Arc,
    task::{Context, Poll},
    time::Duration,
};

use blake3::Hash;
use http_body::Frame;
use http_body_util::{Full, StreamBody};
use rtfarm_core::tile::Area;
use rtfarm_picture::pixel_values;
use rtfarm_proto::{Bytes, JobId};
use serde_json::json;
use tokio::sync::{Semaphore, mpsc};
use tokio_stream::wrappers::ReceiverStream;
use tonic::{
    Status,
    body::Body,
    codegen::{
        Service,
        http::{
            HeaderValue, Method, Request, Response, StatusCode,
            header::{AUTHORIZATION, HOST, WWW_AUTHENTICATE},
            request::Parts,
            uri::Authority,
        },
    },
};

use crate::{
    accept::Peer,
    job::Job,
    live::{Feed, Live, Seen, keep_alive},
    metrics,
    security::Security,
    shell::Shell,
};

/// So many may watch at the same time.
const MOST_VIEWERS: usize = 1024;

/// Something is sent at least so often, so that both sides see that the other is there.
const LONGEST_SILENCE: Duration = Duration::from_secs(15);

/// What every answer says to the browser: load nothing from elsewhere, be part of no other page,
/// take no text for markup, keep nothing.
const HEADERS: [(&str, &str); 7] = [
    (
        "content-security-policy",
        "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; \
         base-uri 'none'; form-action 'none'; frame-ancestors 'none'; \
         require-trusted-types-for 'script'",
    ),
    ("x-content-type-options", "nosniff"),
    ("referrer-policy", "no-referrer"),
    ("cache-control", "no-store"),
    ("cross-origin-opener-policy", "same-origin"),
    ("cross-origin-resource-policy", "same-origin"),
    ("x-frame-options", "DENY"),
];

/// Whom the page asks for a token.
#[derive(Debug, Clone)]
pub(crate) enum Keeper {
    /// Nobody: whoever reaches it may look.
    Nobody,
    /// Everybody, for one that may read.
    Farm(Arc<Security>),
    /// Everybody, for the one that hashes to this.
    Token(Hash),
}

/// The page of a farm.
#[derive(Debug, Clone)]
pub(crate) struct Page {
    shell: Arc<Shell>,
    live: Arc<Live>,
    keeper: Keeper,
    viewers: Arc<Semaphore>,
}

impl Page {
    pub(crate) fn new(shell: &Arc<Shell>, keeper: Keeper) -> Self {
        let (live, viewers) = (Arc::default(), Arc::new(Semaphore::new(MOST_VIEWERS)));
        Self { shell: Arc::clone(shell), live, keeper, viewers }
    }

    async fn answer(self, parts: Parts) -> Response<Body> {
        let path = parts.uri.path();
        if parts.method == Method::POST {
            // Somebody calls a service that there is not.
            return Status::unimplemented("").into_http();
        }
        if parts.method != Method::GET {
            return refused(StatusCode::METHOD_NOT_ALLOWED, "there is only something to look at");
        }
        if !self.is_host(&parts) {
            return refused(
                StatusCode::MISDIRECTED_REQUEST,
                "the page is asked for by another name than the coordinator's; --name says which it has",
            );
        }
        // What is the same for everybody is no secret.
        match path {
            "/" => return file("text/html; charset=utf-8", include_bytes!("../page/page.html")),
            "/page.css" => {
                return file("text/css; charset=utf-8", include_bytes!("../page/page.css"));
            }
            "/page.js" => {
                return file("text/javascript; charset=utf-8", include_bytes!("../page/page.js"));
            }
            _ => {}
        }
        if let Some(response) = self.refusal(&parts) {
            return response;
        }
        let answer = match path {
            "/page/events" => self.events(&parts),
            "/page/pixel" => self.pixel(&parts).await,
            "/metrics" => {
                let body = Body::new(Full::new(Bytes::from(metrics::text(&self.shell))));
                Ok(response(StatusCode::OK, "text/plain; version=0.0.4; charset=utf-8", body))
            }
            _ => Err((StatusCode::NOT_FOUND, "there is nothing here")),
        };
        answer.unwrap_or_else(|(status, reason)| refused(status, reason))
    }

    /// Says whether the browser knows the coordinator by a name that it has. Another one may be
    /// that of somebody who wants to look through the eyes of the browser's user.
    fn is_host(&self, parts: &Parts) -> bool {
        let header = || parts.headers.get(HOST).and_then(|host| host.to_str().ok());
        let host = parts.uri.authority().map(Authority::as_str).or_else(header);
        let Some(host) = host else { return false };
        let name = match host.rsplit_once(':') {
            Some((name, port)) if port.parse::<u16>().is_ok() => name,
            _ => host,
        };
        let address = name.trim_start_matches('[').trim_end_matches(']');
        name.eq_ignore_ascii_case("localhost")
            || address.parse::<IpAddr>().is_ok()
            || self.shell.config.host.as_ref().is_some_and(|ours| ours.eq_ignore_ascii_case(name))
    }

    /// Answers who shows no token that may read.
    fn refusal(&self, parts: &Parts) -> Option<Response<Body>> {
        let shown = parts.headers.get(AUTHORIZATION).map(HeaderValue::as_bytes);
        let checked = match &self.keeper {
            Keeper::Nobody => Ok(()),
            Keeper::Farm(security) => security.check(parts.uri.path(), shown).map(drop),
            Keeper::Token(hash) => {
                let token = shown.and_then(|shown| shown.strip_prefix(b"Bearer "));
                // Hashes of this kind are compared in constant time.
                let is_known = token.is_some_and(|token| blake3::hash(token) == *hash);
                if is_known { Ok(()) } else { Err(Status::unauthenticated("a token is asked for")) }
            }
        };
        if let Err(status) = checked {
            tracing::warn!(path = parts.uri.path(), reason = status.message(), "refused a viewer");
            let code = match status.code() {
                tonic::Code::PermissionDenied => StatusCode::FORBIDDEN,
                _ => StatusCode::UNAUTHORIZED,
            };
            let mut response = refused(code, status.message());
            response.headers_mut().insert(WWW_AUTHENTICATE, HeaderValue::from_static("Bearer"));
            return Some(response);
        }
        if let Some(peer) = parts.extensions.get::<Peer>() {
            peer.admit();
        }
        None
    }

    /// Streams what there is to see of a job, or of a farm without any, as server-sent events.
    fn events(&self, parts: &Parts) -> Result<Response<Body>, (StatusCode, &'static str)> {
        let viewer = Arc::clone(&self.viewers).try_acquire_owned();
        let viewer = viewer.map_err(|_| (StatusCode::SERVICE_UNAVAILABLE, "too many watch"))?;
        let job = match asked::<u64>(parts, "job") {
            Some(_) => Some(self.job(parts)?),
            None => None,
        };
        let seen =
            parts.headers.get("last-event-id").and_then(|seen| Seen::read(seen.to_str().ok()?));
        let feed = self.live.feed(&self.shell, job);
        let (send, receive) = mpsc::channel(4);
        let shell = Arc::clone(&self.shell);
        tokio::spawn(async move {
            tokio::select! {
                () = tell(&shell, &feed, seen, &send) => {}
                () = send.closed() => {}
                () = shell.stop.cancelled() => {}
            }
            drop(viewer);
        });
        let body = Body::new(StreamBody::new(ReceiverStream::new(receive)));
        Ok(response(StatusCode::OK, "text/event-stream", body))
    }

    /// Tells the numbers of one pixel, as the picture has them.
    async fn pixel(&self, parts: &Parts) -> Result<Response<Body>, (StatusCode, &'static str)> {
        let job = self.job(parts)?;
        let window = job.grid.window();
        let pixel = asked(parts, "x").zip(asked(parts, "y")).and_then(|(x, y): (u32, u32)| {
            let corner = [window.x0().checked_add(x)?, window.y0().checked_add(y)?];
            Area::new(window.frame(), corner, [1, 1]).filter(|&pixel| window.has(pixel))
        });
        let pixel = pixel.ok_or((StatusCode::NOT_FOUND, "the picture has no such pixel"))?;
        let values = tokio::task::spawn_blocking(move || pixel_values(job.picture(), pixel)).await;
        match values {
            Ok(Ok(values)) => {
                let body = Body::new(Full::new(Bytes::from(json!({ "rgb": values }).to_string())));
                Ok(response(StatusCode::OK, "application/json", body))
            }
            _ => Err((StatusCode::INTERNAL_SERVER_ERROR, "the picture cannot be read")),
        }
    }

    fn job(&self, parts: &Parts) -> Result<Arc<Job>, (StatusCode, &'static str)> {
        let job = asked(parts, "job").and_then(|job| self.shell.job(JobId(job)));
        job.ok_or((StatusCode::NOT_FOUND, "there is no such job"))
    }
}

type Sender = mpsc::Sender<io::Result<Frame<Bytes>>>;

/// Tells a viewer all there is, and then what is new, until he goes.
async fn tell(shell: &Arc<Shell>, feed: &Arc<Feed>, seen: Option<Seen>, send: &Sender) {
    let (mut seen, mut news) = (seen, feed.news());
    loop {
        news.mark_unchanged();
        let new = seen.as_mut().and_then(|seen| feed.after(seen));
        let messages = if let Some(messages) = new {
            messages
        } else {
            let (shell, feed) = (Arc::clone(shell), Arc::clone(feed));
            let all = tokio::task::spawn_blocking(move || feed.all(&shell)).await;
            let Ok(Ok((at, messages))) = all else { return };
            seen = Some(at);
            messages
        };
        for message in messages {
            if send.send(Ok(Frame::data(message))).await.is_err() {
                return;
            }
        }
        if let Ok(changed) = tokio::time::timeout(LONGEST_SILENCE, news.changed()).await {
            if changed.is_err() {
                return;
            }
        } else if send.send(Ok(Frame::data(keep_alive()))).await.is_err() {
            return;
        }
    }
}

/// What a request's query says of `name`.
fn asked<T: FromStr>(parts: &Parts, name: &str) -> Option<T> {
    let fields = parts.uri.query()?.split('&').filter_map(|field| field.split_once('='));
    fields.into_iter().find(|(known, _)| *known == name)?.1.parse().ok()
}

fn file(kind: &'static str, bytes: &'static [u8]) -> Response<Body> {
    response(StatusCode::OK, kind, Body::new(Full::new(Bytes::from_static(bytes))))
}

fn refused(status: StatusCode, reason: &str) -> Response<Body> {
    let body = Body::new(Full::new(Bytes::from(format!("{reason}\n"))));
    response(status, "text/plain; charset=utf-8", body)
}

fn response(status: StatusCode, kind: &'static str, body: Body) -> Response<Body> {
    let mut response = Response::new(body);
    *response.status_mut() = status;
    let headers = HEADERS.into_iter().chain([("content-type", kind)]);
    for (name, value) in headers {
        response.headers_mut().insert(name, HeaderValue::from_static(value));
    }
    response
}

impl<B: Send + 'static> Service<Request<B>> for Page {
    type Response = Response<Body>;
    type Error = Infallible;
    type Future = Pin<Box<dyn Future<Output = Result<Response<Body>, Infallible>> + Send>>;

    fn poll_ready(&mut self, _: &mut Context<'_>) -> Poll<Result<(), Infallible>> {
        Poll::Ready(Ok(()))
    }

    fn call(&mut self, request: Request<B>) -> Self::Future {
        let (page, (parts, _)) = (self.clone(), request.into_parts());
        Box::pin(async move { Ok(page.answer(parts).await) })
    }
}

#[cfg(test)]
mod tests {
    use rtfarm_core::{
        render::{Quality, Tally},
        tile::Size,
        transfer::Transfer,
    };
    use rtfarm_picture::{Canvas, CanvasTile, PictureFormat, TileRecord, View};
    use rtfarm_proto::Access;

    use super::*;
    use crate::{identity::Identity, live, record::Ticket, shell::Config};

    /// What becomes of a request for a path, with a token or without.
    async fn ask(page: &Page, path: &str, host: &str, token: Option<&str>) -> Response<Body> {
        let mut request = Request::get(path).header(HOST, host);
        if let Some(token) = token {
            request = request.header(AUTHORIZATION, format!("Bearer {token}"));
        }
        page.clone().call(request.body(()).unwrap()).await.unwrap()
    }

    fn page(folder: &std::path::Path, keeper: Keeper) -> Page {
        let config = Config {
            version: String::new(),
            build: String::new(),
            reference: None,
            term: Duration::from_secs(4),
            audit: 0.0,
            keeping: crate::farm::Keeping::default(),
            upload_silence: Duration::from_secs(1),
            events: None,
            begins_coarsely: false,
            host: Some("farm.example".to_owned()),
            orders: crate::upload::OrderLimits::default(),
            scene_folder: folder.to_owned(),
            picture_folder: folder.to_owned(),
        };
        let shell = Shell::new(config, Identity::from_random([7; 24]), [7; 32], None).unwrap();
        Page::new(&Arc::new(shell), keeper)
    }

    #[tokio::test]
    async fn who_may_read_may_look_and_nobody_else() {
        let state = tempfile::tempdir().unwrap();
        let address = "https://farm.example:7878".parse().unwrap();
        let security = Arc::new(Security::open(state.path(), &address).unwrap());
        let page = page(state.path(), Keeper::Farm(security));
        for path in ["/page/events", "/metrics", "/page/pixel?job=1&x=0&y=0"] {
            for (role, expected) in [("read", 200), ("submit", 200), ("admin", 200), ("work", 403)]
            {
                let text = std::fs::read_to_string(state.path().join("access").join(role)).unwrap();
                let access = Access::read(&text).unwrap();
                let found = ask(&page, path, "farm.example:7878", access.token()).await.status();
                let expected =
                    if path.contains("pixel") && expected == 200 { 404 } else { expected };
                assert_eq!(found.as_u16(), expected, "{role} {path}");
            }
            for token in [None, Some("guess")] {
                let response = ask(&page, path, "farm.example:7878", token).await;
                assert_eq!(response.status(), StatusCode::UNAUTHORIZED, "{path}");
            }
        }
        for open in ["/", "/page.js", "/page.css"] {
            assert_eq!(ask(&page, open, "farm.example", None).await.status(), StatusCode::OK);
        }
        assert_eq!(ask(&page, "/page/x", "farm.example", None).await.status().as_u16(), 401);
    }

    #[tokio::test]
    async fn metrics_are_those_of_prometheus() {
        let folder = tempfile::tempdir().unwrap();
        let page = page(folder.path(), Keeper::Nobody);
        page.shell.events.on_job(JobId(7), "scene");
        let response = ask(&page, "/metrics", "localhost", None).await;
        let kind = response.headers()["content-type"].to_str().unwrap();
        assert!(kind.starts_with("text/plain; version=0.0.4"), "{kind}");
        let body = http_body_util::BodyExt::collect(response.into_body()).await.unwrap();
        let text = String::from_utf8(body.to_bytes().to_vec()).unwrap();
        let mut families = std::collections::BTreeMap::new();
        for line in text.lines() {
            if let Some(help) = line.strip_prefix("# HELP ") {
                let (name, help) = help.split_once(' ').unwrap();
                assert!(!help.is_empty() && families.insert(name.to_owned(), "").is_none());
            } else if let Some(kind) = line.strip_prefix("# TYPE ") {
                let (name, kind) = kind.split_once(' ').unwrap();
                assert!(families.contains_key(name), "{name}");
                assert_eq!(name.ends_with("_total"), kind == "counter", "{name}");
            } else {
                let (sample, value) = line.rsplit_once(' ').unwrap();
                let name = sample.split('{').next().unwrap();
                assert!(families.contains_key(name) && value.parse::<f64>().is_ok(), "{line}");
            }
        }
        assert!(text.contains("rtfarm_events_total{event=\"job started\"} 1\n"), "{text}");
        assert!(text.contains("rtfarm_jobs{state=\"rendering\"} 0\n"), "{text}");
        // Where there is Prometheus, it has the last word.
        let promtool = std::process::Command::new("promtool")
            .args(["check", "metrics"])
            .stdin(std::process::Stdio::piped())
            .stdout(std::process::Stdio::piped())
            .stderr(std::process::Stdio::piped())
            .spawn();
        let Ok(mut promtool) = promtool else { return eprintln!("there is no promtool") };
        let mut input = promtool.stdin.take().unwrap();
        io::Write::write_all(&mut input, text.as_bytes()).unwrap();
        drop(input);
        let output = promtool.wait_with_output().unwrap();
        assert!(output.status.success() && output.stderr.is_empty(), "{output:?}");
    }

    #[tokio::test]
    async fn a_page_is_shown_under_the_coordinators_own_names_and_believes_no_other_page() {
        let folder = tempfile::tempdir().unwrap();
        let page = page(folder.path(), Keeper::Nobody);
        for host in ["localhost:7878", "127.0.0.1:1", "[::1]:1", "FARM.example", "10.0.0.7"] {
            let response = ask(&page, "/", host, None).await;
            assert_eq!(response.status(), StatusCode::OK, "{host}");
            let headers = response.headers();
            let policy = headers["content-security-policy"].to_str().unwrap();
            assert!(policy.starts_with("default-src 'none'; script-src 'self';"), "{policy}");
            assert!(!policy.contains("unsafe") && !policy.contains('*'), "{policy}");
            assert!(headers.keys().all(|name| !name.as_str().starts_with("access-control")));
        }
        for host in ["evil.example", "evil.example:7878", "127.0.0.1.evil.example", ""] {
            for path in ["/", "/page/events"] {
                let response = ask(&page, path, host, None).await;
                assert_eq!(response.status(), StatusCode::MISDIRECTED_REQUEST, "{host} {path}");
            }
        }
    }

    /// Nothing before the eye: a scene all the same.
    const SCENE: &str = "viewport\norigin 0 0 -2\ntopleft -1 1 0\nbottomleft -1 -1 0\ntopright 1 1 0\n\
        background 10 20 30\nendviewport\n";

    #[tokio::test]
    async fn a_snapshot_has_the_tiles_that_came_and_a_coarse_picture_elsewhere() {
        let folder = tempfile::tempdir().unwrap();
        let shell = page(folder.path(), Keeper::Nobody).shell;
        let request = rtfarm_job::RenderRequest {
            name: "test".to_owned(),
            strict: false,
            size: Some(Size::new(512, 256).unwrap()),
            crop: None,
            quality: Quality::default(),
            tile_side: Some(64),
            transfer: Transfer::None,
            form: rtfarm_core::prepare::Form::Fast,
            format: PictureFormat::Png8,
        };
        let order = request.place(SCENE.as_bytes(), &|_| unreachable!("it names no files"));
        let order = order.order.unwrap();
        let (grid, format, transfer) = (order.grid, order.format, order.transfer);
        let canvas = Canvas::new_in(folder.path(), grid, format, transfer).unwrap();
        // The third tile of the second row has come.
        let tile = grid.tile(8 + 2).unwrap();
        let white = vec![[1.0; 3]; 64 * 64];
        let record = TileRecord {
            arrived: [0; 32],
            tally: Tally::default(),
            seconds: 1.0,
            elapsed: 1.0,
            worker_count: 1,
        };
        let bytes = rtfarm_picture::pixel_bytes(&white);
        canvas.put_all(&[CanvasTile { tile, bytes, record }]).unwrap();
        let order = (order, Ticket::default());
        let job = shell.submit_on(JobId(7), order, canvas, &[(tile, record)]).unwrap();
        let view = View::within(grid.window(), [171, 256]);
        assert_eq!(view.step(), 3);
        // Of a coarse picture nothing has come yet, then all: its places are those of the whole
        // one.
        for [across, down] in [[0.0; 2], [1.0; 2]] {
            if across > 0.0 {
                let coarse = shell.coarse(&job).unwrap();
                let window = coarse.grid.window();
                let place = |(x, y)| [across * x as f32 / 255.0, down * y as f32 / 255.0, 0.0];
                let pixels: Vec<[f32; 3]> = window.pixels().map(place).collect();
                coarse.picture().put(window, &pixels).unwrap();
            }
            let pixels = live::snapshot(&shell, &job, view).unwrap();
            for (at, pixel) in pixels.chunks_exact(3).enumerate() {
                let [x, y] = [at % 171 * 3, at / 171 * 3];
                if (128..192).contains(&x) && (64..128).contains(&y) {
                    assert_eq!(pixel, [255; 3], "({x}, {y})");
                } else {
                    // A coarse pixel has two of each row and column.
                    let near = |place: usize, found: u8, most: f32| {
                        (most * place as f32 / 2.0 - f32::from(found)).abs() <= 1.0
                    };
                    let is_near = near(x, pixel[0], across) && near(y, pixel[1], down);
                    assert!(is_near && pixel[2] == 0, "({x}, {y}): {pixel:?}");
                }
            }
        }
    }

    #[tokio::test]
    async fn a_page_has_no_script_of_its_own_and_loads_nothing_from_elsewhere() {
        let [html, script] = [include_str!("../page/page.html"), include_str!("../page/page.js")];
        for text in [html, script, include_str!("../page/page.css")] {
            assert!(!text.contains("://"), "an address stands in it");
        }
        for word in ["onclick=", "style=", "<style"] {
            assert!(!html.contains(word), "{word}");
        }
        for word in ["innerHTML", "outerHTML", "insertAdjacentHTML", "document.write", "eval("] {
            assert!(!script.contains(word), "{word}");
        }
    }
}
