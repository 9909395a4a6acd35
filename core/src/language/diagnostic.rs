//! What the reader has to tell a scene's author.

use std::ops::Range;

use crate::scene::Place;

/// Whether a diagnostic stops the scene from being used.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Severity {
    /// The scene cannot be used.
    Error,
    /// Something had to be guessed.
    Warning,
}

impl std::fmt::Display for Severity {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Error => "error",
            Self::Warning => "warning",
        })
    }
}

/// One thing to tell the scene's author.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Diagnostic {
    /// How bad it is.
    pub severity: Severity,
    /// Where it is.
    pub at: Place,
    /// The bytes of the text that are meant; empty at the end of the text.
    pub span: Range<usize>,
    /// What is wrong and what would be right.
    pub message: String,
    /// Another place that has to do with it.
    pub related: Option<Related>,
}

/// A second place that explains a diagnostic.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Related {
    /// Where it is.
    pub at: Place,
    /// The bytes of the text that are meant.
    pub span: Range<usize>,
    /// What is there.
    pub label: String,
}

/// Diagnostics that were counted but not kept.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Omitted {
    /// Errors.
    pub errors: u64,
    /// Warnings.
    pub warnings: u64,
}

impl Omitted {
    /// Makes a line for people, or `None` when nothing was left out.
    pub fn summary(self) -> Option<String> {
        let count = |count: u64, noun: &str| {
            (count > 0).then(|| format!("{count} more {noun}{}", if count == 1 { "" } else { "s" }))
        };
        let parts: Vec<_> = [count(self.errors, "error"), count(self.warnings, "warning")]
            .into_iter()
            .flatten()
            .collect();
        (!parts.is_empty()).then(|| format!("and {}", parts.join(" and ")))
    }
}

/// Collects diagnostics while a text is read. Messages are only made for those that are kept, so
/// that a gigabyte of mistakes costs no more than reading it.
#[derive(Debug, Default)]
pub(super) struct Report {
    kept: Vec<Draft>,
    error_count: u64,
    warning_count: u64,
}

/// A diagnostic whose places are still byte offsets.
#[derive(Debug)]
struct Draft {
    severity: Severity,
    span: Range<usize>,
    message: String,
    related: Option<(Range<usize>, String)>,
}

impl Report {
    /// The number of errors that are kept, and of warnings.
    pub(super) const KEPT: u64 = 100;

    /// Notes that the scene cannot be used.
    pub(super) fn error(&mut self, span: Range<usize>, message: impl FnOnce() -> String) {
        self.error_with(span, message, || None);
    }

    /// Notes that the scene cannot be used, and a second place that shows why.
    pub(super) fn error_with(
        &mut self,
        span: Range<usize>,
        message: impl FnOnce() -> String,
        related: impl FnOnce() -> Option<(Range<usize>, String)>,
    ) {
        self.error_count += 1;
        if self.error_count <= Self::KEPT {
            let (message, related) = (message(), related());
            self.kept.push(Draft { severity: Severity::Error, span, message, related });
        }
    }

    /// Notes a guess.
    pub(super) fn warn(&mut self, span: Range<usize>, message: impl FnOnce() -> String) {
        self.warn_with(span, message, || None);
    }

    /// Notes a guess, and a second place that shows why.
    pub(super) fn warn_with(
        &mut self,
        span: Range<usize>,
        message: impl FnOnce() -> String,
        related: impl FnOnce() -> Option<(Range<usize>, String)>,
    ) {
        self.warning_count += 1;
        if self.warning_count <= Self::KEPT {
            let (message, related) = (message(), related());
            self.kept.push(Draft { severity: Severity::Warning, span, message, related });
        }
    }

    /// Whether the scene can be used.
    pub(super) fn is_free_of_errors(&self) -> bool {
        self.error_count == 0
    }

    /// Lists the byte offsets that [`Report::finish`] needs places for.
    pub(super) fn offsets(&self) -> impl Iterator<Item = usize> {
        self.kept.iter().flat_map(|draft| {
            [Some(draft.span.start), draft.related.as_ref().map(|(span, _)| span.start)]
                .into_iter()
                .flatten()
        })
    }

    /// Gives the diagnostics in the order of the text, and the number of those that were not kept.
    pub(super) fn finish(mut self, places: &Places) -> (Vec<Diagnostic>, Omitted) {
        self.kept.sort_by_key(|draft| draft.span.start);
        let diagnostics = self
            .kept
            .into_iter()
            .map(|draft| Diagnostic {
                severity: draft.severity,
                at: places.place(draft.span.start),
                span: draft.span,
                message: draft.message,
                related: draft.related.map(|(span, label)| Related {
                    at: places.place(span.start),
                    span,
                    label,
                }),
            })
            .collect();
        let omitted = Omitted {
            errors: self.error_count.saturating_sub(Self::KEPT),
            warnings: self.warning_count.saturating_sub(Self::KEPT),
        };
        (diagnostics, omitted)
    }
}

/// Lines and columns of some byte offsets of a text.
#[derive(Debug)]
pub(super) struct Places(Vec<(usize, Place)>);

impl Places {
    /// Walks over `text` once. A byte order mark in front takes no column.
    pub(super) fn new(text: &[u8], offsets: impl IntoIterator<Item = usize>) -> Self {
        let mut offsets: Vec<usize> = offsets.into_iter().collect();
        offsets.sort_unstable();
        offsets.dedup();
        let mut at = if text.starts_with(BYTE_ORDER_MARK) { BYTE_ORDER_MARK.len() } else { 0 };
        let (mut line, mut column) = (1_usize, 1_usize);
        let places = offsets
            .into_iter()
            .map(|offset| {
                let passed = &text[at.min(offset)..offset];
                let line_ends = memchr::memchr_iter(b'\n', passed).count();
                if line_ends > 0 {
                    line += line_ends;
                    column = 1;
                }
                let on_line =
                    memchr::memrchr(b'\n', passed).map_or(passed, |end| &passed[end + 1..]);
                column += on_line.iter().filter(|&&byte| byte & 0xc0 != 0x80).count();
                at = at.max(offset);
                let clamp = |number: usize| u32::try_from(number).unwrap_or(u32::MAX);
                (offset, Place { line: clamp(line), column: clamp(column) })
            })
            .collect();
        Self(places)
    }

    /// Gives the place of an offset that was asked for.
    pub(super) fn place(&self, offset: usize) -> Place {
        let index = self.0.binary_search_by_key(&offset, |&(known, _)| known);
        self.0[index.expect("the offset was asked for")].1
    }
}

/// The bytes that some editors put in front of UTF-8.
pub(super) const BYTE_ORDER_MARK: &[u8] = b"\xef\xbb\xbf";

/// A count of numbers for a message: `one number`, `3 numbers`.
pub(super) fn number_count(count: usize) -> String {
    if count == 1 { "one number".into() } else { format!("{count} numbers") }
}

/// Puts `word` into backquotes for a message, without what would break the line, and cuts it when
/// it is long.
pub(super) fn quoted(word: &[u8]) -> String {
    const LONGEST: usize = 60;
    let text = String::from_utf8_lossy(&word[..word.len().min(4 * LONGEST)]);
    let mut characters = text.chars();
    let mut visible = String::new();
    for character in characters.by_ref().take(LONGEST) {
        match character {
            '"' | '\'' | '\\' => visible.push(character),
            _ => visible.extend(character.escape_debug()),
        }
    }
    if characters.next().is_some() || word.len() > 4 * LONGEST {
        visible.push('…');
    }
    format!("`{visible}`")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_count_characters_after_a_byte_order_mark() {
        let text = "\u{feff}ыы x\r\n\t€y".as_bytes();
        let places = Places::new(text, [3, 8, 14, text.len()]);
        assert_eq!(places.place(3), Place { line: 1, column: 1 });
        assert_eq!(places.place(8), Place { line: 1, column: 4 });
        assert_eq!(places.place(14), Place { line: 2, column: 3 });
        assert_eq!(places.place(text.len()), Place { line: 2, column: 4 });
    }

    #[test]
    fn words_in_messages_are_short_and_visible() {
        assert_eq!(quoted(b"a\0b\x1b\xff"), "`a\\0b\\u{1b}\u{fffd}`");
        assert_eq!(quoted("я".repeat(1000).as_bytes()), format!("`{}…`", "я".repeat(60)));
    }
}
