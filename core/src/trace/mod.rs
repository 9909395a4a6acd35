//! Rays through a prepared scene: what they meet.

pub mod batch;
pub(crate) mod boxes;
pub(crate) mod quadrangle;
pub(crate) mod ray;
pub(crate) mod solid;
pub(crate) mod sphere;
pub(crate) mod triangle;

pub use batch::{FaceTests, Probe, ProbeHit};
