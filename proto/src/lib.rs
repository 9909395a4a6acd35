//! What coordinator, workers and clients of a farm say to each other: the messages of
//! `farm.proto`, names for what they number, their conversions to and from the core's types, and
//! where a coordinator is found. Nothing is decided here.

mod access;
mod address;
mod convert;
mod name;
mod tile_hash;

pub use access::{Access, AccessError, CERTIFIED_NAME, ConnectError, Reached};
pub use address::{Address, AddressError, Connection};
pub use convert::{WireError, pixels_to_bytes, scene_hash, transfer};
pub use name::{FarmId, Incarnation, JobId, LeaseId, LeaseName, Renewal, WorkerId};
pub use prost::bytes::Bytes;
pub use tile_hash::TileHasher;

/// The messages, clients and servers that `proto/generate` writes from `farm.proto`.
#[expect(
    missing_docs,
    clippy::pedantic,
    clippy::allow_attributes_without_reason,
    reason = "generated; farm.proto has the words"
)]
pub mod wire {
    include!("generated/rtfarm.v1.rs");
}

/// The version of `farm.proto`. Both sides must have the same, and the same package version.
pub const PROTOCOL: u32 = 11;

/// The largest message that either side takes: a tile of the largest side, 12 bytes a pixel, and
/// room for what stands around it.
pub const MESSAGE_BYTES: usize = 1024 * 1024 * 12 + (1 << 16);

/// Tiles in one message have at most so many bytes of pixels together, unless it is one tile.
pub const DELIVERY_BYTES: usize = 1 << 20;

/// The size of a piece of a stream.
pub const CHUNK_BYTES: usize = 1 << 20;

/// How long a worker's question for tiles may wait for its answer.
pub const LONGEST_WAIT: std::time::Duration = std::time::Duration::from_secs(10);
