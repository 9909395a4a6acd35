//! Lets only those in who may come: each call is looked at before its body is read.

use std::{
    convert::Infallible,
    future::ready,
    pin::Pin,
    sync::Arc,
    task::{Context, Poll},
    time::Duration,
};

use rtfarm_proto::MESSAGE_BYTES;
use tokio::time::timeout;

use tonic::{
    Status,
    body::Body,
    codegen::{
        Service,
        http::{HeaderValue, Request, Response, Version, header::AUTHORIZATION},
    },
    server::NamedService,
};

use crate::{accept::Peer, flight::Flight, security::Security};

/// The call that brings pixels.
const DELIVER: &str = "/rtfarm.v1.Farm/Deliver";

/// A worker waits for no answer that long.
const DELIVERY_DEADLINE: Duration = Duration::from_secs(60);

/// A service whose callers must show a token, unless there is nobody to ask for one.
#[derive(Clone)]
pub(crate) struct Guarded<S> {
    service: S,
    security: Option<Arc<Security>>,
    arriving: Flight,
}

impl<S> Guarded<S> {
    pub(crate) fn new(service: S, security: Option<Arc<Security>>, arriving: Flight) -> Self {
        Self { service, security, arriving }
    }
}

impl<S: NamedService> NamedService for Guarded<S> {
    const NAME: &'static str = S::NAME;
}

type Answering = Pin<Box<dyn Future<Output = Result<Response<Body>, Infallible>> + Send>>;

impl<S> Service<Request<Body>> for Guarded<S>
where
    S: Service<Request<Body>, Response = Response<Body>, Error = Infallible, Future = Answering>,
    S: Clone + Send + 'static,
{
    type Response = Response<Body>;
    type Error = Infallible;
    type Future = Answering;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<Result<(), Infallible>> {
        self.service.poll_ready(context)
    }

    fn call(&mut self, mut request: Request<Body>) -> Answering {
        if request.version() < Version::HTTP_2 {
            // Pages from anywhere can have a browser say that, and nobody else does.
            let status = Status::failed_precondition("gRPC is spoken in HTTP/2");
            return Box::pin(ready(Ok(status.into_http())));
        }
        if let Some(security) = &self.security {
            let path = request.uri().path();
            let shown = request.headers().get(AUTHORIZATION).map(HeaderValue::as_bytes);
            let holder = match security.check(path, shown) {
                Ok(holder) => holder,
                Err(status) => {
                    tracing::warn!(path, reason = status.message(), "refused a call");
                    return Box::pin(ready(Ok(status.into_http())));
                }
            };
            request.extensions_mut().insert(holder);
            if let Some(peer) = request.extensions().get::<Peer>() {
                peer.admit();
            }
        }
        if request.uri().path() != DELIVER {
            return self.service.call(request);
        }
        let (mut service, arriving) = (self.service.clone(), self.arriving.clone());
        Box::pin(async move {
            let _room = arriving.take(MESSAGE_BYTES).await;
            let answered = timeout(DELIVERY_DEADLINE, service.call(request)).await;
            let late = |_| Ok(Status::deadline_exceeded("the pixels do not come").into_http());
            answered.unwrap_or_else(late)
        })
    }
}
