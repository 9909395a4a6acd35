//! The fields of blocks: their values, and what is said of those that cannot be used.

use glam::DVec3;

use super::{
    block::{Block, is_keyword},
    diagnostic::{Report, number_count, quoted},
    lexer::{Quotes, Word},
    walk::Walk,
};
use crate::transfer::Transfer;

/// A field of a block: unset, set, or set to something that was reported.
#[derive(Debug, Clone, Copy)]
pub(super) struct Field<'t, T> {
    /// The keyword, once it was seen.
    pub(super) word: Option<Word<'t>>,
    /// Its value, if that is sound.
    pub(super) value: Option<T>,
}

impl<T> Default for Field<'_, T> {
    fn default() -> Self {
        Self { word: None, value: None }
    }
}

impl<'t, T> Field<'t, T> {
    /// Takes a value; the last one wins, with a warning.
    pub(super) fn set(&mut self, report: &mut Report, word: Word<'t>, value: Option<T>) {
        if let Some(earlier) = self.word.replace(word) {
            report.warn_with(
                word.span(),
                || {
                    format!(
                        "{} is given again; this value replaces the earlier one",
                        quoted(word.bytes)
                    )
                },
                || Some((earlier.span(), "the earlier value".into())),
            );
        }
        self.value = value;
    }

    /// Gives the value, and reports a field that was never set unless the text is cut off.
    pub(super) fn require(self, walk: &mut Walk<'t>, block: Word<'t>, field: &str) -> Option<T> {
        if self.word.is_none() && !walk.is_cut {
            walk.report
                .error(block.span(), || format!("this {} has no `{field}`", quoted(block.bytes)));
        }
        self.value
    }
}

impl<'t> Walk<'t> {
    /// Reads the `N` numbers of a field; `None` when that failed and was reported.
    pub(super) fn numbers<const N: usize>(&mut self, field: Word<'t>) -> Option<[f64; N]> {
        self.last_field = Some((field, N));
        let mut numbers = [0.0; N];
        let mut is_sound = true;
        let mut end = field.end;
        self.value_span = field.span();
        for (count, number) in numbers.iter_mut().enumerate() {
            let Some(word) = self.lexer.peek().filter(|word| self.is_value(word, end)) else {
                if is_sound {
                    self.report_missing_numbers(field, end, count, N);
                }
                return None;
            };
            self.lexer.go_to(word.end);
            end = word.end;
            self.value_span = if count == 0 { word.start } else { self.value_span.start }..end;
            match word.number() {
                Some(value) if value.is_finite() => *number = value,
                _ if is_sound => {
                    is_sound = false;
                    self.report_bad_number(&word, N);
                }
                _ => {}
            }
        }
        is_sound.then_some(numbers)
    }

    /// Reads one number.
    pub(super) fn number(&mut self, field: Word<'t>) -> Option<f64> {
        self.numbers::<1>(field).map(|[number]| number)
    }

    /// Counts those of the next two words that can only be numbers.
    pub(super) fn numbers_that_follow(&self) -> usize {
        let mut ahead = self.lexer.clone();
        std::iter::from_fn(|| ahead.next()).take(2).take_while(Word::is_number_like).count()
    }

    /// Whether a word after byte `end` is meant as a value: anything on the same line but a
    /// keyword, and on later lines what looks like a number.
    fn is_value(&self, word: &Word<'t>, end: usize) -> bool {
        word.is_number_like() || (self.is_on_one_line(end..word.start) && !is_keyword(word))
    }

    fn report_missing_numbers(&mut self, field: Word<'t>, end: usize, count: usize, needed: usize) {
        self.report.error(field.start..end, || {
            let numbers = number_count(needed);
            let found = match count {
                0 => "none is given".into(),
                1 => "only 1 is given".into(),
                _ => format!("only {count} are given"),
            };
            format!("{} takes {numbers}, but {found}", quoted(field.bytes))
        });
    }

    fn report_bad_number(&mut self, word: &Word<'t>, needed: usize) {
        let field = self.last_field.map_or(*word, |(field, _)| field);
        self.report.error(word.span(), || {
            let found = quoted(word.bytes);
            if word.is_named_infinity_or_nan() {
                return format!("expected a finite number, found {found}");
            }
            if word.number().is_some() {
                return format!("{found} is too large; the largest number is about 1.8e308");
            }
            let with_points: Vec<u8> =
                word.bytes.iter().map(|&byte| if byte == b',' { b'.' } else { byte }).collect();
            let pointed = Word { bytes: &with_points, ..*word };
            if let Some(number) = word.bytes.strip_suffix(b",")
                && (Word { bytes: number, ..*word }).number().is_some()
            {
                return format!(
                    "{found} is not a number; numbers are separated by spaces, not by commas"
                );
            }
            if pointed.number().is_some() {
                let right = pointed.to_text();
                return format!("{found} is not a number; write its decimal point as in `{right}`");
            }
            let (field, numbers) = (quoted(field.bytes), number_count(needed));
            format!("{found} is not a number; {field} takes {numbers}")
        });
    }

    /// Reads the one word of a field, a `what`; `None` when that failed and was reported.
    pub(super) fn value_word(&mut self, field: Word<'t>, what: &str) -> Option<Word<'t>> {
        self.last_field = Some((field, 0));
        let is_missing = |word: &Word<'t>| {
            Block::ended_by(word).is_some()
                || (is_keyword(word) && !self.is_on_one_line(field.end..word.start))
        };
        let Some(word) = self.lexer.peek().filter(|word| !is_missing(word)) else {
            self.report.error(field.span(), || {
                format!("{} takes {what}, but none is given", quoted(field.bytes))
            });
            return None;
        };
        self.lexer.go_to(word.end);
        match word.quotes {
            Quotes::Open => {
                self.report
                    .error(word.span(), || "this name has no closing quote on its line".into());
                None
            }
            Quotes::Closed if word.bytes.is_empty() => {
                self.report.error(word.span(), || {
                    format!(
                        "{} takes {what}, but nothing is between the quotes",
                        quoted(field.bytes)
                    )
                });
                None
            }
            _ => Some(word),
        }
    }

    /// Whether a file name is the last value on its line. If it is not, it needs quotes, which is
    /// reported.
    pub(super) fn ends_file_name(&mut self, name: Word<'t>) -> bool {
        let is_continued = name.quotes == Quotes::Bare
            && self.lexer.peek().is_some_and(|next| {
                self.is_on_one_line(name.end..next.start)
                    && !is_keyword(&next)
                    && !next.is_ellipsis()
            });
        if is_continued {
            self.skip_line();
            let end = self.lexer.at();
            self.report.error(name.start..end, || {
                "a file name with spaces must be in double quotes".into()
            });
        }
        !is_continued
    }

    /// Reads the name of a file.
    pub(super) fn file_name(&mut self, field: Word<'t>) -> Option<Word<'t>> {
        let name = self.value_word(field, "a file name")?;
        self.ends_file_name(name).then_some(name)
    }

    /// Reads a number that must be above 0.
    pub(super) fn number_above_zero(&mut self, field: Word<'t>) -> Option<f64> {
        let value = self.number(field)?;
        if value <= 0.0 {
            self.refuse_value(|| {
                format!("{} must be above 0, but is {value}", quoted(field.bytes))
            });
        }
        (value > 0.0).then_some(value)
    }

    /// Reads a number that must be 0 or more.
    pub(super) fn number_from_zero(&mut self, field: Word<'t>) -> Option<f64> {
        let value = self.number(field)?;
        if value < 0.0 {
            self.refuse_value(|| {
                format!("{} must be 0 or more, but is {value}", quoted(field.bytes))
            });
        }
        (value >= 0.0).then_some(value)
    }

    /// Reads a position.
    pub(super) fn position(&mut self, field: Word<'t>) -> Option<DVec3> {
        self.numbers(field).map(DVec3::from)
    }

    /// Reads a `coords` field or its synonym into `coords`.
    pub(super) fn read_coords(&mut self, field: Word<'t>, coords: &mut Field<'t, DVec3>) {
        if field.bytes == b"position" {
            self.warn_synonym(field, "`coords`");
        }
        let value = self.position(field);
        coords.set(&mut self.report, field, value);
    }

    /// Reads a colour where 255 is 1, that may be brighter but not negative.
    pub(super) fn color(&mut self, field: Word<'t>) -> Option<DVec3> {
        let color = self.position(field)?;
        let is_color = color.min_element() >= 0.0;
        if !is_color {
            self.refuse_value(|| {
                format!(
                    "the components of a colour must be 0 or more, but one is {}",
                    color.min_element()
                )
            });
        }
        is_color.then_some(color / 255.0)
    }

    /// Reads such a colour that is encoded by `transfer`, as light.
    pub(super) fn light(&mut self, field: Word<'t>, transfer: Transfer) -> Option<DVec3> {
        let light = decode(self.color(field)?, transfer);
        if !light.is_finite() {
            self.refuse_value(|| {
                "this colour is too bright; the largest amount of light is about 1.8e308".into()
            });
        }
        light.is_finite().then_some(light)
    }

    /// Reports that the value that was read last cannot be used.
    pub(super) fn refuse_value(&mut self, message: impl FnOnce() -> String) {
        self.report.error(self.value_span.clone(), message);
    }

    /// Reports what the value that was read last is taken for.
    pub(super) fn warn_of_value(&mut self, message: impl FnOnce() -> String) {
        self.report.warn(self.value_span.clone(), message);
    }

    /// Reports that a word of another dialect is taken for `instead`.
    pub(super) fn warn_synonym(&mut self, word: Word<'t>, instead: &str) {
        self.report.warn(word.span(), || format!("{} is read as {instead}", quoted(word.bytes)));
    }
}

/// Turns a colour into light.
pub(super) fn decode(color: DVec3, transfer: Transfer) -> DVec3 {
    color.map(|number| transfer.decode(number))
}
