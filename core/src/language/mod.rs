//! The rt language: text into a scene, every mistake told at its place.

mod block;
mod diagnostic;
mod geometry;
pub(crate) mod lexer;
pub mod reader;
mod symbol;
mod triangles;
