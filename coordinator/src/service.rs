//! The gRPC services: requests to events, answers to responses. A `Status` is chosen here and
//! nowhere else.

mod jobs;
mod streaming;
mod uploading;
mod workers;

use std::{io, sync::Arc, time::Duration};

use rtfarm_proto::{
    CHUNK_BYTES, MESSAGE_BYTES, PROTOCOL, WireError,
    wire::{farm_server, jobs_server},
};
use rustix::io::Errno;
use tonic::{
    Status,
    service::Routes,
    transport::{Server, server::Router},
};

pub(crate) use self::{jobs::JobsService, workers::FarmService};
use crate::{
    guard::Guarded,
    identity::Stranger,
    members::NoMember,
    page::{Keeper, Page},
    security::Security,
    shell::Shell,
    upload::Uploads,
};

/// The longest message of a client: a piece of a scene, or of a file with its path.
const PIECE_BYTES: usize = CHUNK_BYTES + (1 << 16);

/// Both services over one coordinator and its page, for those who have a token if there is
/// `security`.
pub(crate) fn router(shell: &Arc<Shell>, security: Option<Arc<Security>>) -> Router {
    const WINDOW_BYTES: u32 = 1 << 22;
    // A frame of a delivery; each costs both sides a call of the system.
    const FRAME_BYTES: u32 = 1 << 17;
    let (farm, jobs) = services(shell);
    // Who asks for it may have no token: it says that the coordinator serves, and no more.
    let (reporter, health) = tonic_health::server::health_reporter();
    drop(reporter);
    let keeper = security.clone().map_or(Keeper::Nobody, Keeper::Farm);
    let arriving = shell.arriving.clone();
    let routes = Routes::new(Guarded::new(farm, security.clone(), arriving.clone()))
        .add_service(Guarded::new(jobs, security, arriving))
        .add_service(health)
        .into_axum_router()
        .fallback_service(Page::new(shell, keeper));
    Server::builder()
        .initial_stream_window_size(WINDOW_BYTES)
        .initial_connection_window_size(WINDOW_BYTES)
        .max_frame_size(FRAME_BYTES)
        .http2_keepalive_interval(Some(Duration::from_secs(10)))
        .http2_keepalive_timeout(Some(Duration::from_secs(20)))
        // Browsers speak it where nothing is encrypted, and may elsewhere.
        .accept_http1(true)
        .add_routes(routes.into())
}

/// The page alone, for those who have this token.
pub(crate) fn page_router(shell: &Arc<Shell>, token: &str) -> Router {
    let page = Page::new(shell, Keeper::Token(blake3::hash(token.as_bytes())));
    let routes = Routes::default().into_axum_router().fallback_service(page);
    Server::builder().accept_http1(true).add_routes(routes.into())
}

/// What workers call, and what clients call.
pub(crate) fn services(
    shell: &Arc<Shell>,
) -> (farm_server::FarmServer<FarmService>, jobs_server::JobsServer<JobsService>) {
    let farm = farm_server::FarmServer::new(FarmService { shell: Arc::clone(shell) })
        .max_decoding_message_size(MESSAGE_BYTES)
        .max_encoding_message_size(MESSAGE_BYTES);
    let jobs = jobs_server::JobsServer::new(JobsService {
        shell: Arc::clone(shell),
        uploads: Uploads::default(),
    })
    .max_decoding_message_size(PIECE_BYTES)
    .max_encoding_message_size(MESSAGE_BYTES);
    (farm, jobs)
}

fn check_version(who: &str, version: &str, protocol: u32, shell: &Shell) -> Result<(), Status> {
    let ours = &shell.config.version;
    if version == ours && protocol == PROTOCOL {
        return Ok(());
    }
    tracing::warn!(version, protocol, "refused a {who} of another version");
    Err(Status::failed_precondition(format!(
        "this {who} is rtfarm {version} (protocol {protocol}), the coordinator is rtfarm {ours} \
         (protocol {PROTOCOL}); both must be the same"
    )))
}

#[expect(clippy::needless_pass_by_value, reason = "`map_err` hands it over")]
fn invalid(error: WireError) -> Status {
    Status::invalid_argument(error.to_string())
}

fn no_member(error: NoMember) -> Status {
    Status::not_found(error.to_string())
}

fn stranger(error: Stranger) -> Status {
    Status::not_found(error.to_string())
}

/// What is short for a while can be asked for again; what is broken cannot.
fn broken(error: &io::Error) -> Status {
    let short = [Errno::MFILE, Errno::NFILE, Errno::NOMEM].map(Errno::raw_os_error);
    if error.raw_os_error().is_some_and(|number| short.contains(&number)) {
        Status::unavailable(error.to_string())
    } else {
        Status::internal(error.to_string())
    }
}

async fn blocking<T: Send + 'static>(
    work: impl FnOnce() -> Result<T, Status> + Send + 'static,
) -> Result<T, Status> {
    if cfg!(test) {
        // A simulation has one thread.
        return work();
    }
    match tokio::task::spawn_blocking(work).await {
        Ok(result) => result,
        Err(error) => Err(Status::internal(error.to_string())),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tonic::Code;

    /// A worker that is refused for good ends; one that may ask again does.
    #[test]
    fn what_is_short_for_a_while_can_be_asked_for_again() {
        let code = |errno: Errno| broken(&errno.into()).code();
        for errno in [Errno::MFILE, Errno::NFILE, Errno::NOMEM] {
            assert_eq!(code(errno), Code::Unavailable, "{errno}");
        }
        for errno in [Errno::IO, Errno::NOSPC, Errno::ROFS] {
            assert_eq!(code(errno), Code::Internal, "{errno}");
        }
    }
}
