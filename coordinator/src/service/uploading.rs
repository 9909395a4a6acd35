//! A scene as it comes from a client, piece by piece.

use std::{io, sync::Arc, time::Duration};

use prost::Message;
use rtfarm_proto::{
    WireError,
    wire::{self, submit_request},
};
use tonic::{Status, Streaming};

use super::{PIECE_BYTES, blocking, check_version, invalid};
use crate::{
    job::Job,
    record::Ticket,
    security::Owner,
    shell::Shell,
    upload::{Spool, Uploads},
};

/// The most bytes that a scene and its files may have.
pub(super) const LONGEST_BUNDLE: u64 = 1 << 31;

/// A scene as a client sends it.
pub(super) struct Bundle {
    pub(super) order: wire::Order,
    pub(super) ticket: Ticket,
    pub(super) spool: Spool,
}

/// Whose jobs are those that this owner's token orders; empty for a token that has no owner.
pub(super) fn account(owner: Option<&Owner>) -> String {
    owner.map(Owner::to_string).unwrap_or_default()
}

pub(super) fn cannot_spool(error: &io::Error) -> Status {
    Status::resource_exhausted(format!("the scene cannot be kept while it comes: {error}"))
}

/// What a client sent.
pub(super) enum Received {
    New(Box<Bundle>),
    /// An order whose job is there already.
    Known(Arc<Job>),
}

pub(super) async fn receive(
    parts: Streaming<wire::SubmitRequest>,
    holder: Option<&Owner>,
    shell: &Shell,
    uploads: &Uploads,
) -> Result<Received, Status> {
    // A piece that is decoded, and one that is written.
    let _room = shell.arriving.take(2 * PIECE_BYTES).await;
    let mut parts = Upload { parts, silence: shell.config.upload_silence };
    // What is not wanted is refused before it is sent.
    let Some(submit_request::Part::Order(order)) = parts.next().await?.and_then(|part| part.part)
    else {
        return Err(invalid(WireError::Missing("order")));
    };
    check_version("client", &order.version, order.protocol, shell)?;
    let ticket = to_ticket(&order, holder);
    let claimed = shell.claim(&ticket);
    if let Some(job) = claimed.map_err(|error| Status::already_exists(error.to_string()))? {
        return Ok(Received::Known(job));
    }
    let mut spool = Spool::new(&shell.config.scene_folder, uploads);
    let most = shell.config.orders.upload_bytes;
    let mut names = 0;
    while let Some(part) = parts.next().await? {
        let (path, piece) = match part.part {
            Some(submit_request::Part::Order(_)) => {
                return Err(Status::invalid_argument("a scene has one order"));
            }
            Some(submit_request::Part::Text(piece)) => (None, piece),
            Some(submit_request::Part::File(piece)) => (Some(piece.path), piece.data),
            None => continue,
        };
        names += path.as_ref().map_or(0, String::len) as u64;
        spool = blocking(move || {
            let mut spool = spool.map_err(|error| cannot_spool(&error))?;
            spool.put(path, &piece).map_err(|error| cannot_spool(&error))?;
            Ok(Ok(spool))
        })
        .await?;
        let Ok(spool) = &spool else { continue };
        if spool.byte_count() + names > LONGEST_BUNDLE {
            return Err(Status::resource_exhausted("the scene and its files are too long"));
        }
        if spool.bytes_of_all() > most {
            return Err(Status::resource_exhausted(format!(
                "scenes that are being sent may have {:.2} GB together; try again later",
                most as f64 / 1e9
            )));
        }
    }
    let spool = spool.map_err(|error| cannot_spool(&error))?;
    Ok(Received::New(Box::new(Bundle { order, ticket, spool })))
}

/// What a client sends, piece by piece.
pub(super) struct Upload {
    parts: Streaming<wire::SubmitRequest>,
    /// The longest that a piece may be on its way.
    silence: Duration,
}

impl Upload {
    /// The next piece; `None` after the last.
    async fn next(&mut self) -> Result<Option<wire::SubmitRequest>, Status> {
        let next = tokio::time::timeout(self.silence, self.parts.message()).await;
        next.unwrap_or_else(|_| {
            let seconds = self.silence.as_secs_f64();
            let reason = format!("nothing of the scene has come for {seconds:.1} s");
            Err(Status::deadline_exceeded(reason))
        })
    }
}

/// What an order says, of which whoever has a token as an owner is the owner.
pub(super) fn to_ticket(order: &wire::Order, holder: Option<&Owner>) -> Ticket {
    let wire::Order { name, title, owner, key, priority, max_workers, .. } = order.clone();
    let name = if title.is_empty() { name } else { title };
    let most_workers = (max_workers > 0).then_some(max_workers);
    let account = account(holder);
    let owner = if account.is_empty() { owner } else { account.clone() };
    let wanted = blake3::hash(&wanted(order.clone()).encode_to_vec()).as_bytes().to_vec();
    Ticket { name, owner, account, key, wanted, priority, most_workers }
}

/// What an order says of the picture, without who wants it and how.
pub(super) fn wanted(order: wire::Order) -> wire::Order {
    let [version, name, title, owner, key] = [(); 5].map(|()| String::new());
    let (protocol, priority, max_workers) = (0, 0, 0);
    wire::Order { version, protocol, name, title, owner, key, priority, max_workers, ..order }
}
