//! What several files of tests need.

pub(crate) mod block;
pub(crate) mod judge;
pub(crate) mod parts;
pub(crate) mod studio;
