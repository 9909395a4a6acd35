//! The core of rtfarm: scene text into a [`scene::Scene`], a scene into a
//! [`prepared::PreparedScene`] with its bounding volume hierarchy, a tile of it into pixels.
//!
//! Nothing here opens files, reads a clock, uses sockets or starts threads other than rayon's.

mod block;
mod diagnostic;
mod exact;
mod hash;
pub mod isa;
mod lexer;
pub mod mesh_file;
mod number;
mod obj;
mod ply;
mod polygon;
pub mod prepared;
pub mod read;
pub mod render;
pub mod scene;
mod shapes;
mod stl;
mod symbol;
pub mod texture;
pub mod tile;
mod triangles;
