//! Classes of bytes: what separates words and what begins a comment.

/// The effect of a byte on the words around it.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum Class {
    Word,
    Space,
    Comment,
    /// Part of a character beyond ASCII, which may be white space.
    Wide,
}

/// Gives the class of a byte.
pub(crate) fn class(byte: u8) -> Class {
    CLASSES[byte as usize]
}

const CLASSES: [Class; 256] = {
    let mut classes = [Class::Word; 256];
    let mut byte = 0;
    while byte < 256 {
        classes[byte] = match byte as u8 {
            b' ' | b'\t' | b'\n' | b'\r' | 0x0b | 0x0c => Class::Space,
            b'#' => Class::Comment,
            0x80.. => Class::Wide,
            _ => Class::Word,
        };
        byte += 1;
    }
    classes
};
