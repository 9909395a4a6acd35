//! Scene text into words. Every line can be split off and read on its own: neither a comment nor
//! a quoted name goes on after its line.

use std::ops::Range;

use crate::text::{
    bytes::{Class, class},
    number::parse_number,
};

/// Walks over the words of a scene text.
#[derive(Debug, Clone)]
pub(super) struct Lexer<'t> {
    text: &'t [u8],
    at: usize,
}

/// A word of the text and its place.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Word<'t> {
    /// The word, without its quotes.
    pub(super) bytes: &'t [u8],
    /// Byte offset of its beginning, the opening quote included.
    pub(super) start: usize,
    /// Byte offset of its end, the closing quote included.
    pub(super) end: usize,
    /// The quotes around it.
    pub(super) quotes: Quotes,
}

/// The quotes around a word.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Quotes {
    /// None.
    Bare,
    /// One on either side.
    Closed,
    /// One that is still open at the end of its line.
    Open,
}

impl Word<'_> {
    /// Gives the bytes of the text that the word takes.
    pub(super) fn span(&self) -> Range<usize> {
        self.start..self.end
    }

    /// Gives the word as text, for messages and paths.
    pub(super) fn to_text(self) -> String {
        String::from_utf8_lossy(self.bytes).into_owned()
    }

    /// Whether it can only be meant as a number: it begins with a digit, a sign or a point.
    pub(super) fn is_number_like(&self) -> bool {
        let digits = unsigned(self.bytes);
        let is_signed = digits.len() < self.bytes.len();
        self.quotes == Quotes::Bare
            && !self.is_ellipsis()
            && (is_signed
                || matches!(digits, [b'0'..=b'9' | b'.', ..])
                || is_infinity_or_nan(digits))
    }

    /// Whether it is `…` or `...`, which people leave where a list goes on.
    pub(super) fn is_ellipsis(&self) -> bool {
        self.quotes == Quotes::Bare && matches!(self.bytes, b"..." | b"\xe2\x80\xa6")
    }

    /// Reads the word as a finite or infinite number; `None` when it is none or NaN.
    pub(super) fn number(&self) -> Option<f64> {
        if self.quotes != Quotes::Bare || self.is_named_infinity_or_nan() {
            return None;
        }
        parse_number(self.bytes)
    }

    /// Whether it spells NaN or infinity.
    pub(super) fn is_named_infinity_or_nan(&self) -> bool {
        is_infinity_or_nan(unsigned(self.bytes))
    }
}

/// Takes the sign off a number.
fn unsigned(word: &[u8]) -> &[u8] {
    word.strip_prefix(b"-").or(word.strip_prefix(b"+")).unwrap_or(word)
}

fn is_infinity_or_nan(unsigned: &[u8]) -> bool {
    ["nan", "inf", "infinity"].iter().any(|name| unsigned.eq_ignore_ascii_case(name.as_bytes()))
}

impl<'t> Lexer<'t> {
    /// Starts at byte `at` of `text`.
    pub(super) fn new(text: &'t [u8], at: usize) -> Self {
        Self { text, at }
    }

    /// Gives the whole text.
    pub(super) fn text(&self) -> &'t [u8] {
        self.text
    }

    /// Gives the offset of the byte that is looked at next.
    pub(super) fn at(&self) -> usize {
        self.at
    }

    /// Goes on from byte `at`.
    pub(super) fn go_to(&mut self, at: usize) {
        self.at = at;
    }

    /// Reads one word.
    pub(super) fn next(&mut self) -> Option<Word<'t>> {
        self.skip_space();
        let start = self.at;
        let first = *self.text.get(start)?;
        if first == b'"' {
            return Some(self.quoted_word(start));
        }
        while let Some(&byte) = self.text.get(self.at) {
            match class(byte) {
                Class::Word => self.at += 1,
                Class::Space | Class::Comment => break,
                Class::Wide => match wide_space_length(&self.text[self.at..]) {
                    0 => self.at += 1,
                    _ => break,
                },
            }
        }
        let bytes = &self.text[start..self.at];
        Some(Word { bytes, start, end: self.at, quotes: Quotes::Bare })
    }

    /// Reads the word that [`Lexer::next`] would read, and stays before it.
    pub(super) fn peek(&self) -> Option<Word<'t>> {
        self.clone().next()
    }

    /// Goes to the end of the line.
    pub(super) fn skip_line(&mut self) {
        let rest = &self.text[self.at..];
        self.at += memchr::memchr(b'\n', rest).unwrap_or(rest.len());
    }

    /// Goes over white space and comments.
    pub(super) fn skip_space(&mut self) {
        while let Some(&byte) = self.text.get(self.at) {
            match class(byte) {
                Class::Space => self.at += 1,
                Class::Word => break,
                Class::Comment => self.skip_line(),
                Class::Wide => match wide_space_length(&self.text[self.at..]) {
                    0 => break,
                    length => self.at += length,
                },
            }
        }
    }

    fn quoted_word(&mut self, start: usize) -> Word<'t> {
        let rest = &self.text[start + 1..];
        let length = memchr::memchr2(b'"', b'\n', rest).unwrap_or(rest.len());
        let (bytes, end, quotes) = if rest.get(length) == Some(&b'"') {
            (&rest[..length], start + length + 2, Quotes::Closed)
        } else {
            let line = rest[..length].strip_suffix(b"\r").unwrap_or(&rest[..length]);
            (line, start + 1 + line.len(), Quotes::Open)
        };
        self.at = end;
        Word { bytes, start, end, quotes }
    }
}

/// Measures the white space character beyond ASCII that `text` begins with, 0 for none. A byte
/// order mark counts, since files that begin with one get appended to others.
fn wide_space_length(text: &[u8]) -> usize {
    match text {
        [0xc2, 0x85 | 0xa0, ..] => 2,
        [0xe1, 0x9a, 0x80, ..]
        | [0xe2, 0x80, 0x80..=0x8a | 0xa8 | 0xa9 | 0xaf, ..]
        | [0xe2, 0x81, 0x9f, ..]
        | [0xe3, 0x80, 0x80, ..]
        | [0xef, 0xbb, 0xbf, ..] => 3,
        _ => 0,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check_words(text: &str, expected: &[&str]) {
        let mut lexer = Lexer::new(text.as_bytes(), 0);
        let words: Vec<_> = std::iter::from_fn(|| lexer.next())
            .map(|word| String::from_utf8(word.bytes.to_vec()).unwrap())
            .collect();
        assert_eq!(words, expected, "{text:?}");
    }

    fn check_number(text: &str, expected: Option<f64>) {
        let word = Lexer::new(text.as_bytes(), 0).next().unwrap();
        assert_eq!(word.number().map(f64::to_bits), expected.map(f64::to_bits), "{text:?}");
    }

    #[test]
    fn any_white_space_splits_words() {
        check_words(
            "a\tb\r\nc\x0b\x0cd\u{a0}e\u{3000}f\u{2003}g\u{feff}h",
            &["a", "b", "c", "d", "e", "f", "g", "h"],
        );
        check_words("я…я\u{200b}ю", &["я…я\u{200b}ю"]);
    }

    #[test]
    fn a_comment_may_be_glued_to_a_word() {
        check_words("a 20.#c\n#\n b# \"x\nc", &["a", "20.", "b", "c"]);
    }

    #[test]
    fn quotes_hold_spaces_and_hashes_but_no_line_ends() {
        check_words(
            "file \"a b#c.png\" x \"open\r\nnext",
            &["file", "a b#c.png", "x", "open", "next"],
        );
        check_words("\"\" a\"b\"", &["", "a\"b\""]);
    }

    #[test]
    fn numbers_are_decimal_and_rounded_correctly() {
        for (text, number) in [
            ("20.", 20.0),
            (".5", 0.5),
            ("+1", 1.0),
            ("-0", 0.0),
            ("1e-05", 1e-5),
            ("9007199254740993", 9_007_199_254_740_992.0),
            ("0.1", 0.1),
            ("1e400", f64::INFINITY),
            ("1e-400", 0.0),
            ("2.2250738585072011e-308", 2.225_073_858_507_201e-308),
        ] {
            check_number(text, Some(number));
        }
        for text in ["1,5", "0x10", "1_000", "nan", "-inf", "1.2.3", "-", ".", "e5", "\"1\"", "1e"]
        {
            check_number(text, None);
        }
    }
}
