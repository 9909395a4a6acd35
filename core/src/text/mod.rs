//! Numbers and words as bytes of text, whatever the file's language.

pub(crate) mod bytes;
pub(crate) mod number;
