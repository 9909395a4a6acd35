//! Diagnostics drawn under the author's lines.

use std::{fmt::Write, ops::Range};

use annotate_snippets::{AnnotationKind, Group, Level, Renderer, Snippet};

use super::diagnostic::{BYTE_ORDER_MARK, Diagnostic, Severity};
use crate::scene::Place;

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
    /// Bytes that are quoted on either side of the marked ones, and of those at most.
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
    use super::{super::diagnostic::Places, *};

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
}
