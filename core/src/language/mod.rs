//! The rt language: text into a scene, every mistake told at its place.

mod block;
mod diagnostic;
mod drawing;
mod field;
mod geometry;
mod lexer;
mod pieces;
pub mod reader;
mod suggestion;
mod symbol;
mod triangles;
mod walk;
