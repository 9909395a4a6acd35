//! Light that faces send on to others.

pub(crate) mod gather;
pub(crate) mod importance;
pub(crate) mod sampling;
pub(crate) mod tree;
