//! The core of rtfarm: scene text into a [`scene::Scene`], a scene into a
//! [`prepared::PreparedScene`] with its bounding volume hierarchy, a tile of it into pixels.
//!
//! Nothing here opens files, reads a clock, uses sockets or starts threads other than rayon's.

pub mod scene;
pub mod transfer;

// Text into a scene.
mod block;
mod diagnostic;
mod exact;
mod hash;
mod lexer;
pub mod mesh_file;
mod number;
mod obj;
mod ply;
mod polygon;
pub mod read;
mod shapes;
mod stl;
mod symbol;
pub mod texture;
mod triangles;

// A scene into a prepared scene.
mod bvh;
mod emitter_tree;
mod emitters;
mod node;
mod plane;
pub mod prepare;
pub mod prepared;
mod pyramid;
mod weld;

// A prepared scene into tiles.
mod beam;
mod emitter;
mod gather;
pub mod isa;
pub mod left_out;
mod pixel;
mod quadrangle;
mod ray;
pub mod render;
pub mod sample;
mod solid;
mod sphere;
mod spread;
mod texcoord;
mod texture_sampling;
pub mod tile;
pub mod trace;
mod triangle;
mod wavefront;

#[cfg(test)]
#[path = "../tests/long/mod.rs"]
mod long;
