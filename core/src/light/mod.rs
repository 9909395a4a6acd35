//! Light that faces send on to others.
//!
//! A point that gathers estimates the importance of each emitter ([`importance`]), chooses among
//! many through a tree ([`tree`]), samples a direction ([`sampling`]) and sends a ray there
//! ([`gather`]). Each of these knows only those before it.

pub(crate) mod gather;
mod importance;
mod sampling;
mod tree;
