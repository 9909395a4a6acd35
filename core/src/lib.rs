//! The core of rtfarm: scene text into a [`scene::Scene`], a scene into a
//! [`prepared::PreparedScene`] with its bounding volume hierarchy, a tile of it into pixels.
//!
//! Nothing here opens files, reads a clock, uses sockets or starts threads other than rayon's.

pub mod isa;
pub mod picture;
pub mod prepared;
pub mod read;
pub mod render;
pub mod scene;
pub mod tile;
