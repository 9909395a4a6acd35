//! The oracle's own tests, in one program: it is built and linked once.

mod branches;
mod coverage;
mod hits;
mod light;
mod solids;
