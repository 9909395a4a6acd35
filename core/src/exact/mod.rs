//! Arithmetic without rounding, and decisions that rest on it.

pub(crate) mod clip;
pub(crate) mod float;
pub(crate) mod hash;
pub(crate) mod polygon;
pub(crate) mod predicates;
pub(crate) mod welding;
