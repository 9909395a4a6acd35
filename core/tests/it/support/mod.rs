//! What several files of tests need.

pub(crate) mod judge;
pub(crate) mod long;
pub(crate) mod parts;
pub(crate) mod studio;
