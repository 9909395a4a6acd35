//! The core of rtfarm: scene text into a [`scene::Scene`], a scene into a
//! [`prepared::PreparedScene`] with its bounding volume hierarchy, a tile of it into pixels.
//!
//! Nothing here opens files, reads a clock, uses sockets or starts threads other than rayon's.

// What every room may speak of.
mod exact;
pub mod isa;
mod left_out;
pub mod sample;
pub mod scene;
mod text;
pub mod tile;
pub mod transfer;

// Text into a scene.
pub mod assets;
pub mod language;

// A scene into a prepared scene.
pub mod prepare;
pub mod prepared;

// A prepared scene into tiles.
mod light;
pub mod render;
mod shade;
mod trace;

#[doc(hidden)]
pub mod testing;
