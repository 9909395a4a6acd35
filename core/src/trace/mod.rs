//! Rays through a prepared scene: what they meet.

pub(crate) mod batch;
pub(crate) mod boxes;
pub(crate) mod hit;
pub(crate) mod probe;
pub(crate) mod quadrangle;
pub(crate) mod ray;
pub(crate) mod solid;
pub(crate) mod sphere;
pub(crate) mod traversal;
pub(crate) mod triangle;

pub use probe::{FaceTests, Probe, ProbeHit};
