//! What the reader has to tell a scene's author, and how it is drawn under the author's line.

use std::{fmt::Write, ops::Range};

use annotate_snippets::{AnnotationKind, Group, Level, Renderer, Snippet};

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
    /// A line for people, or `None` when nothing was left out.
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
pub(crate) struct Report {
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
    /// How many errors are kept, and how many warnings.
    pub(crate) const KEPT: u64 = 100;

    /// Notes that the scene cannot be used.
    pub(crate) fn error(&mut self, span: Range<usize>, message: impl FnOnce() -> String) {
        self.error_with(span, message, || None);
    }

    /// Notes that the scene cannot be used, and a second place that shows why.
    pub(crate) fn error_with(
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
    pub(crate) fn warn(&mut self, span: Range<usize>, message: impl FnOnce() -> String) {
        self.warn_with(span, message, || None);
    }

    /// Notes a guess, and a second place that shows why.
    pub(crate) fn warn_with(
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
    pub(crate) fn is_free_of_errors(&self) -> bool {
        self.error_count == 0
    }

    /// All byte offsets that [`Report::finish`] needs places for.
    pub(crate) fn offsets(&self) -> impl Iterator<Item = usize> {
        self.kept.iter().flat_map(|draft| {
            [Some(draft.span.start), draft.related.as_ref().map(|(span, _)| span.start)]
                .into_iter()
                .flatten()
        })
    }

    /// The diagnostics in the order of the text, and how many were not kept.
    pub(crate) fn finish(mut self, places: &Places) -> (Vec<Diagnostic>, Omitted) {
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
pub(crate) struct Places(Vec<(usize, Place)>);

impl Places {
    /// Walks over `text` once. A byte order mark in front takes no column.
    pub(crate) fn new(text: &[u8], offsets: impl IntoIterator<Item = usize>) -> Self {
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

    /// The place of an offset that was asked for.
    pub(crate) fn place(&self, offset: usize) -> Place {
        let index = self.0.binary_search_by_key(&offset, |&(known, _)| known);
        self.0[index.expect("the offset was asked for")].1
    }
}

/// What some editors put in front of UTF-8.
pub(crate) const BYTE_ORDER_MARK: &[u8] = b"\xef\xbb\xbf";

/// `word` for a message: in backquotes, without what would break the line, cut when long.
pub(crate) fn shown(word: &[u8]) -> String {
    const LONGEST: usize = 60;
    let text = String::from_utf8_lossy(&word[..word.len().min(4 * LONGEST)]);
    let mut characters = text.chars();
    let mut shown = String::new();
    for character in characters.by_ref().take(LONGEST) {
        match character {
            '"' | '\'' | '\\' => shown.push(character),
            _ => shown.extend(character.escape_debug()),
        }
    }
    if characters.next().is_some() || word.len() > 4 * LONGEST {
        shown.push('…');
    }
    format!("`{shown}`")
}

/// Whether a drawing has colours.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Style {
    /// For files and pipes.
    Plain,
    /// For terminals.
    Colored,
}

/// Draws each diagnostic under its line of `text`. The first line of each is
/// `name:line:column: severity: message`. Long lines are cut around the place.
pub fn draw_diagnostics(
    name: &str,
    text: &[u8],
    diagnostics: &[Diagnostic],
    style: Style,
) -> String {
    let mut drawing = String::new();
    for diagnostic in diagnostics {
        let Diagnostic { severity, at, message, .. } = diagnostic;
        let (severity_on, bold, off) = match (style, severity) {
            (Style::Plain, _) => ("", "", ""),
            (Style::Colored, Severity::Error) => ("\x1b[1;31m", "\x1b[1m", "\x1b[0m"),
            (Style::Colored, Severity::Warning) => ("\x1b[1;33m", "\x1b[1m", "\x1b[0m"),
        };
        writeln!(drawing, "{bold}{name}:{at}: {severity_on}{severity}{off}{bold}: {message}{off}")
            .expect("strings take all");
        drawing.push_str(&draw_snippet(text, diagnostic, style));
        drawing.push_str("\n\n");
    }
    drawing
}

/// The lines of a diagnostic with its words underlined.
fn draw_snippet(text: &[u8], diagnostic: &Diagnostic, style: Style) -> String {
    let primary = Excerpt::new(text, diagnostic.at, &diagnostic.span);
    let level = match diagnostic.severity {
        Severity::Error => Level::ERROR,
        Severity::Warning => Level::WARNING,
    };
    let mut group = Group::with_level(level);
    // What is on the same line is seen anyway.
    let related = diagnostic
        .related
        .as_ref()
        .filter(|related| related.at.line != diagnostic.at.line)
        .map(|related| (related, Excerpt::new(text, related.at, &related.span)));
    let mut snippets = vec![(primary.line, primary.snippet(AnnotationKind::Primary, None))];
    if let Some((related, excerpt)) = &related {
        snippets
            .push((excerpt.line, excerpt.snippet(AnnotationKind::Context, Some(&related.label))));
    }
    snippets.sort_by_key(|&(line, _)| line);
    for (_, snippet) in snippets {
        group = group.element(snippet);
    }
    let renderer = match style {
        Style::Plain => Renderer::plain(),
        Style::Colored => Renderer::styled(),
    };
    renderer.render(&[group])
}

/// The part of a line around a place.
struct Excerpt {
    line: usize,
    source: String,
    marked: Range<usize>,
}

impl Excerpt {
    /// Bytes that are shown on either side of the marked ones, and of those at most.
    const REACH: usize = 60;

    fn new(text: &[u8], at: Place, span: &Range<usize>) -> Self {
        let end = span.end.clamp(span.start, span.start + Self::REACH).min(text.len());
        let marked = &text[span.start..end];
        let marked = &marked[..memchr::memchr(b'\n', marked).unwrap_or(marked.len())];
        let before = &text[span.start.saturating_sub(Self::REACH)..span.start];
        let line_start = memchr::memrchr(b'\n', before).map(|end| end + 1);
        let is_cut_before = line_start.is_none() && span.start > Self::REACH;
        let before = &before[line_start.unwrap_or(0)..];
        let behind = &text[span.start + marked.len()..];
        let behind = &behind[..behind.len().min(Self::REACH)];
        let line_end = memchr::memchr(b'\n', behind);
        let is_cut_behind =
            line_end.is_none() && span.start + marked.len() + behind.len() < text.len();
        let behind = &behind[..line_end.unwrap_or(behind.len())];

        let mut source = String::new();
        let before = before.strip_prefix(BYTE_ORDER_MARK).unwrap_or(before);
        if is_cut_before {
            source.push('…');
            let whole = before.iter().position(|byte| byte & 0xc0 != 0x80).unwrap_or(0);
            push_visible(&mut source, &before[whole..]);
        } else {
            push_visible(&mut source, before);
        }
        let start = source.len();
        push_visible(&mut source, marked);
        let end = source.len();
        let whole = match std::str::from_utf8(behind) {
            Err(error) if is_cut_behind && error.error_len().is_none() => error.valid_up_to(),
            _ => behind.len(),
        };
        push_visible(&mut source, behind[..whole].trim_ascii_end());
        if is_cut_behind {
            source.push('…');
        }
        Self { line: at.line as usize, source, marked: start..end }
    }

    fn snippet<'a>(
        &'a self,
        kind: AnnotationKind,
        label: Option<&'a str>,
    ) -> Snippet<'a, annotate_snippets::Annotation<'a>> {
        Snippet::source(self.source.as_str())
            .line_start(self.line)
            .annotation(kind.span(self.marked.clone()).label(label))
    }
}

/// Appends text as one line: what is no character or would move the cursor becomes `�`.
fn push_visible(line: &mut String, bytes: &[u8]) {
    line.extend(String::from_utf8_lossy(bytes).chars().map(|character| match character {
        '\t' => '\t',
        '\r' => ' ',
        character if character.is_control() => '\u{fffd}',
        character => character,
    }));
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check_drawing(text: &str, word: &str, expected: &str) {
        let start = text.find(word).unwrap();
        let places = Places::new(text.as_bytes(), [start]);
        let diagnostic = Diagnostic {
            severity: Severity::Error,
            at: places.place(start),
            span: start..start + word.len(),
            message: "wrong".into(),
            related: None,
        };
        let drawing = draw_diagnostics("a.rt", text.as_bytes(), &[diagnostic], Style::Plain);
        assert_eq!(drawing, expected, "\n{drawing}");
    }

    #[test]
    fn the_word_is_underlined() {
        check_drawing(
            "# Шар\nsphere\n\tcolor красный # ярко\nend",
            "красный",
            "a.rt:3:8: error: wrong\n  |\n3 |     color красный # ярко\n  |           ^^^^^^^\n\n",
        );
    }

    #[test]
    fn a_long_line_is_cut() {
        let text = format!("{}bad{}", "ы ".repeat(100_000), " я".repeat(100_000));
        let (before, behind) = (" ы".repeat(19), " я".repeat(20));
        check_drawing(
            &text,
            "bad",
            &format!(
                "a.rt:1:200001: error: wrong\n  |\n1 | …ы{before} bad{behind}…\n  |  {}^^^\n\n",
                " ".repeat(40)
            ),
        );
    }

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
        assert_eq!(shown(b"a\0b\x1b\xff"), "`a\\0b\\u{1b}\u{fffd}`");
        assert_eq!(shown("я".repeat(1000).as_bytes()), format!("`{}…`", "я".repeat(60)));
    }
}
