//! The core of rtfarm: scene text into a [`scene::Scene`], a scene into a
//! [`prepared::PreparedScene`] with its bounding volume hierarchy, a tile of it into pixels.
//!
//! Nothing here opens files, reads a clock, uses sockets or starts threads other than rayon's.

pub mod scene;

pub mod read;

pub mod prepared;

mod bvh;
mod node;
mod plane;
mod weld;

pub mod isa;
pub mod render;
pub mod sample;
pub mod tile;
pub mod trace;

mod quadrangle;
mod ray;
mod sphere;
mod triangle;
