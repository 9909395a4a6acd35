//! The walk through the blocks of a scene text that survives every mistake.

use std::ops::Range;

use super::{
    block::{Block, OPENED},
    diagnostic::{Report, number_count, quoted},
    lexer::{Lexer, Quotes, Word},
    suggestion::suggestion,
};

/// The walk through the blocks of a text.
#[derive(Debug)]
pub(super) struct Walk<'t> {
    pub(super) lexer: Lexer<'t>,
    pub(super) report: Report,
    /// The open blocks and the words that opened them, the outermost first.
    open: Vec<(Block, Word<'t>)>,
    /// The number of open blocks of each kind.
    open_counts: [usize; 18],
    /// The field that was read last in the innermost block and how many numbers it takes.
    pub(super) last_field: Option<(Word<'t>, usize)>,
    /// The bytes of that field's value.
    pub(super) value_span: Range<usize>,
    /// Whether the text ended in the middle of a block, so that nobody knows what it lacks.
    pub(super) is_cut: bool,
    /// Bytes that may still be looked through for the end of unknown blocks. Without a limit
    /// each of a million unknown words could look through the whole file.
    look_ahead: usize,
}

impl<'t> Walk<'t> {
    /// Starts at the beginning of `text`.
    pub(super) fn new(text: &'t [u8], report: Report) -> Self {
        Self {
            lexer: Lexer::new(text, 0),
            report,
            open: Vec::new(),
            open_counts: [0; 18],
            last_field: None,
            value_span: 0..0,
            is_cut: false,
            look_ahead: text.len().saturating_add(1 << 16),
        }
    }

    /// Notes that the block which `word` opens begins.
    pub(super) fn enter(&mut self, block: Block, word: Word<'t>) {
        self.open.push((block, word));
        self.open_counts[block as usize] += 1;
        self.last_field = None;
    }

    /// Gives the innermost open block.
    pub(super) fn innermost(&self) -> Block {
        self.open.last().map_or(Block::File, |&(block, _)| block)
    }

    fn leave(&mut self) {
        if let Some((block, _)) = self.open.pop() {
            self.open_counts[block as usize] -= 1;
        }
        self.last_field = None;
    }

    /// Reads the next word in the innermost block: a keyword that it may hold, or a word that
    /// nobody knows. `None` when the block is over.
    pub(super) fn next(&mut self) -> Option<Word<'t>> {
        loop {
            let block = self.innermost();
            let Some(word) = self.lexer.peek() else {
                if let Some(&(_, opening)) = self.open.last() {
                    self.is_cut = true;
                    self.report.error(opening.span(), || {
                        format!(
                            "this {} is never closed: `{}` is missing",
                            quoted(opening.bytes),
                            block.end()
                        )
                    });
                    self.leave();
                }
                return None;
            };
            if let Some(ended) = Block::ended_by(&word) {
                if ended == block {
                    self.lexer.go_to(word.end);
                    self.leave();
                    return None;
                }
                if self.open_counts[ended as usize] > 0 {
                    self.report_missing_end(&word);
                    self.leave();
                    return None;
                }
                self.lexer.go_to(word.end);
                if block.is_leaf() {
                    self.report_wrong_end(&word);
                    self.leave();
                    return None;
                }
                self.report.error(word.span(), || {
                    let ended = ended.word();
                    format!("{} ends nothing, because no `{ended}` is open", quoted(word.bytes))
                });
                continue;
            }
            if let Some(opened) = Block::opened_by(&word) {
                if opened.is_allowed_in(block) {
                    self.lexer.go_to(word.end);
                    self.last_field = None;
                    return Some(word);
                }
                if self
                    .open
                    .iter()
                    .rev()
                    .skip(1)
                    .take(3)
                    .any(|&(outer, _)| opened.is_allowed_in(outer))
                    || (opened.is_allowed_in(Block::File) && block != Block::File)
                {
                    self.report_missing_end(&word);
                    self.leave();
                    return None;
                }
                self.lexer.go_to(word.end);
                self.report.error(word.span(), || {
                    format!(
                        "{} is not allowed here; it belongs in {}",
                        quoted(word.bytes),
                        opened.home()
                    )
                });
                self.skip_unknown(&word);
                continue;
            }
            self.lexer.go_to(word.end);
            if word.is_ellipsis() {
                self.report.warn(word.span(), || {
                    format!("{} has no meaning here and is skipped", quoted(word.bytes))
                });
            } else if word.is_number_like() {
                self.report_stray_number(&word);
            } else if word.bytes.starts_with(b"end") && word.quotes == Quotes::Bare {
                // A misspelt end word: an author who ends a block ends the one that is open.
                if self.finish_unknown_end(&word) {
                    return None;
                }
            } else {
                return Some(word);
            }
        }
    }

    /// Reports a leaf that another block's word ends: whoever ends something means what is open.
    fn report_wrong_end(&mut self, word: &Word<'t>) {
        if let Some(&(block, opening)) = self.open.last() {
            self.report.error_with(
                word.span(),
                || {
                    let found = quoted(word.bytes);
                    format!(
                        "{found} cannot end this `{}`; expected `{}`",
                        block.word(),
                        block.end()
                    )
                },
                || Some((opening.span(), "the block begins here".into())),
            );
        }
    }

    fn report_missing_end(&mut self, before: &Word<'t>) {
        if let Some(&(block, opening)) = self.open.last() {
            self.report.error_with(
                before.span(),
                || format!("`{}` is missing before {}", block.end(), quoted(before.bytes)),
                || Some((opening.span(), "the block begins here".into())),
            );
        }
    }

    fn report_stray_number(&mut self, word: &Word<'t>) {
        let last_field = self.last_field;
        self.report.error(word.span(), || match last_field {
            Some((field, 1)) => {
                format!("{} takes one number, but a second one follows", quoted(field.bytes))
            }
            Some((field, 0)) => {
                format!("{} takes a name, but a number follows it", quoted(field.bytes))
            }
            Some((field, count)) => {
                format!("{} takes {count} numbers, but one more follows", quoted(field.bytes))
            }
            None => format!("expected a keyword, found {}", quoted(word.bytes)),
        });
        while let Some(next) = self.lexer.peek().filter(Word::is_number_like) {
            self.lexer.go_to(next.end);
        }
    }

    /// Reports a word that begins with `end` and ends nothing; whether it closed the block.
    fn finish_unknown_end(&mut self, word: &Word<'t>) -> bool {
        let end = self.innermost().end();
        let is_open = !self.open.is_empty();
        let closes = is_open
            && word.bytes.len().abs_diff(end.len()) <= 3
            && suggestion(word.bytes, [end]).is_some();
        self.report.error(word.span(), || {
            let ends = OPENED.iter().map(|block| block.end());
            let guess = if closes { Some(end.to_owned()) } else { suggestion(word.bytes, ends) };
            match (guess, is_open) {
                (Some(guess), _) => {
                    format!("no block ends with {}; did you mean `{guess}`?", quoted(word.bytes))
                }
                (None, true) => {
                    format!("no block ends with {}; expected `{end}`", quoted(word.bytes))
                }
                (None, false) => format!("no block ends with {}", quoted(word.bytes)),
            }
        });
        if closes {
            self.leave();
        }
        closes
    }

    /// Reports a word that the innermost block does not know, and skips what belongs to it: up
    /// to its end word if it has one, else the rest of its line.
    pub(super) fn skip_unknown_keyword(&mut self, word: Word<'t>) {
        let block = self.innermost();
        if block == Block::Entry && matches!(word.bytes, b"specular" | b"shininess") {
            self.report.warn(word.span(), || {
                format!("materials have no {}, so its line is skipped", quoted(word.bytes))
            });
            self.skip_line();
            return;
        }
        let is_block = self.skip_unknown(&word);
        let hint = || {
            let inner =
                OPENED.iter().filter(|inner| inner.is_allowed_in(block)).map(|inner| inner.word());
            if let Some(guess) = suggestion(word.bytes, block.fields().iter().copied().chain(inner))
            {
                return format!("; did you mean `{guess}`?");
            }
            let homes: Vec<_> = OPENED
                .iter()
                .filter(|home| home.fields().iter().any(|field| field.as_bytes() == word.bytes))
                .map(|home| format!("`{}`", home.word()))
                .take(4)
                .collect();
            match (block, &homes[..]) {
                (Block::Union | Block::Intersection | Block::Difference, _)
                    if word.bytes == b"material" =>
                {
                    "; each solid in it has its own".into()
                }
                (_, []) => String::new(),
                (_, [home]) => format!("; {} belongs in {home}", quoted(word.bytes)),
                (_, [others @ .., last]) => {
                    let others = others.join(", ");
                    format!("; {} belongs in {others} or {last}", quoted(word.bytes))
                }
            }
        };
        match (block, is_block) {
            (Block::File, false) => self.report.error(word.span(), || match hint() {
                hint if hint.is_empty() => format!(
                    "{} is not a section; the sections are `viewport`, `materials`, `lights` and `geometry`",
                    quoted(word.bytes)
                ),
                hint => format!("{} is not a section{hint}", quoted(word.bytes)),
            }),
            (_, true) => self.report.warn(word.span(), || {
                format!("the block {} is unknown and is skipped{}", quoted(word.bytes), hint())
            }),
            (_, false) => {
                let last_field =
                    self.last_field.filter(|(field, _)| self.is_on_one_line(field.end..word.start));
                self.report.warn(word.span(), || {
                    let unknown = quoted(word.bytes);
                    if let Some((field, count)) = last_field {
                        let field = quoted(field.bytes);
                        let values = if count == 0 { "one word".into() } else { number_count(count) };
                        format!("{field} takes {values}; the line is skipped from {unknown} on")
                    } else {
                        let (block, hint) = (block.word(), hint());
                        format!("`{block}` has no {unknown}, so its line is skipped{hint}")
                    }
                });
            }
        }
    }

    /// Skips a block that `word` opens, or the rest of the line; whether it was a block.
    fn skip_unknown(&mut self, word: &Word<'t>) -> bool {
        if word.quotes == Quotes::Bare && word.bytes.len() <= 64 {
            let mut ahead = self.lexer.clone();
            let limit = ahead.at() + self.look_ahead;
            while let Some(next) = ahead.next().filter(|next| next.start < limit) {
                if next.bytes.strip_prefix(b"end") == Some(word.bytes) {
                    self.look_ahead -= next.start - word.end;
                    self.lexer.go_to(next.end);
                    return true;
                }
                if Block::ended_by(&next).is_some_and(|ended| self.open_counts[ended as usize] > 0)
                {
                    break;
                }
            }
            self.look_ahead = limit.saturating_sub(ahead.at());
        }
        self.skip_line();
        false
    }

    /// Skips to the end of the line, or to a word on it that opens or ends a block here.
    pub(super) fn skip_line(&mut self) {
        let block = self.innermost();
        let stops = |word: &Word<'t>| {
            Block::ended_by(word).is_some_and(|ended| self.open_counts[ended as usize] > 0)
                || Block::opened_by(word).is_some_and(|opened| opened.is_allowed_in(block))
        };
        let mut ahead = self.lexer.clone();
        let mut end = ahead.at();
        while let Some(word) = ahead.next()
            && self.is_on_one_line(end..word.start)
            && !stops(&word)
        {
            end = word.end;
        }
        self.lexer.go_to(end);
    }

    pub(super) fn is_on_one_line(&self, gap: Range<usize>) -> bool {
        memchr::memchr(b'\n', &self.lexer.text()[gap]).is_none()
    }
}
