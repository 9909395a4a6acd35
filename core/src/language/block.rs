//! The blocks of a scene text: which words open and end them, what they hold, and the walk
//! through them that survives every mistake.

use std::ops::Range;

use super::{
    diagnostic::{Report, shown},
    lexer::{Lexer, Quotes, Word},
};

/// A kind of block.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Block {
    File,
    Viewport,
    Screen,
    Materials,
    Entry,
    Lights,
    Reference,
    Point,
    Geometry,
    Sphere,
    Triangle,
    Quadrangle,
    Parallelepiped,
    Union,
    Intersection,
    Difference,
    Mesh,
    StlModel,
}

/// All blocks that a word opens, in the order of their numbers less one.
const OPENED: [Block; 17] = [
    Block::Viewport,
    Block::Screen,
    Block::Materials,
    Block::Entry,
    Block::Lights,
    Block::Reference,
    Block::Point,
    Block::Geometry,
    Block::Sphere,
    Block::Triangle,
    Block::Quadrangle,
    Block::Parallelepiped,
    Block::Union,
    Block::Intersection,
    Block::Difference,
    Block::Mesh,
    Block::StlModel,
];

impl Block {
    /// The word that opens it; empty for the file.
    pub(crate) fn word(self) -> &'static str {
        self.end().strip_prefix("end").unwrap_or("")
    }

    /// The word that ends it; empty for the file.
    pub(crate) fn end(self) -> &'static str {
        match self {
            Self::File => "",
            Self::Viewport => "endviewport",
            Self::Screen => "endscreen",
            Self::Materials => "endmaterials",
            Self::Entry => "endentry",
            Self::Lights => "endlights",
            Self::Reference => "endreference",
            Self::Point => "endpoint",
            Self::Geometry => "endgeometry",
            Self::Sphere => "endsphere",
            Self::Triangle => "endtriangle",
            Self::Quadrangle => "endquadrangle",
            Self::Parallelepiped => "endparallelepiped",
            Self::Union => "endunion",
            Self::Intersection => "endintersection",
            Self::Difference => "enddifference",
            Self::Mesh => "endmesh",
            Self::StlModel => "endstlmodel",
        }
    }

    /// The words that may stand in it besides the blocks, synonyms included.
    fn fields(self) -> &'static [&'static str] {
        const SCREEN: &[&str] = &[
            "topleft",
            "bottomleft",
            "topright",
            "size",
            "background",
            "resolution",
            "xres",
            "yres",
            "origin",
        ];
        match self {
            Self::File => &["background", "resolution", "xres", "yres"],
            Self::Viewport | Self::Screen => SCREEN,
            Self::Materials
            | Self::Geometry
            | Self::Union
            | Self::Intersection
            | Self::Difference => &[],
            Self::Entry => &[
                "name",
                "color",
                "alpha",
                "reflect",
                "refract",
                "texture",
                "image",
                "specular",
                "shininess",
            ],
            Self::Lights => &["ambient", "backlight"],
            Self::Reference => &["power", "distance"],
            Self::Point => &["coords", "power", "color", "position"],
            Self::Sphere => &["coords", "radius", "material", "position"],
            Self::Triangle | Self::Quadrangle => {
                &["vertex", "material", "texcoord", "textureCoord"]
            }
            Self::Parallelepiped => &["vertex", "material"],
            Self::Mesh | Self::StlModel => {
                &["file", "material", "scale", "rotate", "move", "filename"]
            }
        }
    }

    /// Whether it holds fields only.
    fn is_leaf(self) -> bool {
        !self.is_operation()
            && !matches!(
                self,
                Self::File | Self::Viewport | Self::Materials | Self::Lights | Self::Geometry
            )
    }

    /// Whether it joins solids.
    pub(crate) fn is_operation(self) -> bool {
        matches!(self, Self::Union | Self::Intersection | Self::Difference)
    }

    /// Whether it may stand directly in `outer`.
    pub(crate) fn stands_in(self, outer: Self) -> bool {
        match self {
            Self::File => false,
            Self::Viewport | Self::Materials | Self::Lights | Self::Geometry => outer == Self::File,
            Self::Screen => outer == Self::Viewport,
            Self::Entry => outer == Self::Materials,
            Self::Reference | Self::Point => outer == Self::Lights,
            // Flat shapes may not, but whoever reads the operation says so better.
            _ => outer == Self::Geometry || outer.is_operation(),
        }
    }

    /// Where it may stand, for people.
    fn home(self) -> &'static str {
        match self {
            Self::File | Self::Viewport | Self::Materials | Self::Lights | Self::Geometry => {
                "no other block"
            }
            Self::Screen => "`viewport`",
            Self::Entry => "`materials`",
            Self::Reference | Self::Point => "`lights`",
            _ => "`geometry`",
        }
    }

    /// The block that `word` opens.
    pub(crate) fn opened_by(word: &Word<'_>) -> Option<Self> {
        let block = match word.bytes {
            b"viewport" => Self::Viewport,
            b"screen" => Self::Screen,
            b"materials" => Self::Materials,
            b"entry" => Self::Entry,
            b"lights" => Self::Lights,
            b"reference" => Self::Reference,
            b"point" => Self::Point,
            b"geometry" => Self::Geometry,
            b"sphere" => Self::Sphere,
            b"triangle" => Self::Triangle,
            b"quadrangle" => Self::Quadrangle,
            b"parallelepiped" => Self::Parallelepiped,
            b"union" => Self::Union,
            b"intersection" => Self::Intersection,
            b"difference" => Self::Difference,
            b"mesh" => Self::Mesh,
            b"stlmodel" => Self::StlModel,
            _ => return None,
        };
        (word.quotes == Quotes::Bare).then_some(block)
    }

    /// The block that `word` ends.
    fn ended_by(word: &Word<'_>) -> Option<Self> {
        Self::opened_by(&Word { bytes: word.bytes.strip_prefix(b"end")?, ..*word })
    }
}

/// Whether `word` is a keyword anywhere in the language.
fn is_keyword(word: &Word<'_>) -> bool {
    Block::opened_by(word).is_some()
        || Block::ended_by(word).is_some()
        || (word.quotes == Quotes::Bare
            && OPENED
                .iter()
                .any(|block| block.fields().iter().any(|field| field.as_bytes() == word.bytes)))
}

/// A field of a block: unset, set, or set to something that was reported.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Field<'t, T> {
    /// The keyword, once it was seen.
    pub(crate) word: Option<Word<'t>>,
    /// Its value, if that is sound.
    pub(crate) value: Option<T>,
}

impl<T> Default for Field<'_, T> {
    fn default() -> Self {
        Self { word: None, value: None }
    }
}

impl<'t, T> Field<'t, T> {
    /// Takes a value; the last one wins, with a warning.
    pub(crate) fn set(&mut self, report: &mut Report, word: Word<'t>, value: Option<T>) {
        if let Some(earlier) = self.word.replace(word) {
            report.warn_with(
                word.span(),
                || format!("{} stands here again; this one counts", shown(word.bytes)),
                || Some((earlier.span(), "the earlier one".into())),
            );
        }
        self.value = value;
    }

    /// The value; it is an error when the field was never set, unless the text is cut off.
    pub(crate) fn require(
        self,
        blocks: &mut Blocks<'t>,
        block: Word<'t>,
        field: &str,
    ) -> Option<T> {
        if self.word.is_none() && !blocks.is_cut {
            blocks
                .report
                .error(block.span(), || format!("this {} has no `{field}`", shown(block.bytes)));
        }
        self.value
    }
}

/// The walk through the blocks of a text.
#[derive(Debug)]
pub(crate) struct Blocks<'t> {
    pub(crate) lexer: Lexer<'t>,
    pub(crate) report: Report,
    /// Outermost first.
    open: Vec<(Block, Word<'t>)>,
    /// How many of each kind are open.
    open_counts: [usize; 18],
    /// The field that was read last in the innermost block and how many numbers it takes.
    last_field: Option<(Word<'t>, usize)>,
    /// Its value.
    value_span: Range<usize>,
    /// Whether the text ended in the middle of a block, so that nobody knows what it lacks.
    pub(crate) is_cut: bool,
    /// Bytes that may still be looked through for the end of unknown blocks. Without a limit
    /// each of a million unknown words could look through the whole file.
    look_ahead: usize,
}

impl<'t> Blocks<'t> {
    /// Starts at the beginning of `text`.
    pub(crate) fn new(text: &'t [u8], report: Report) -> Self {
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
    pub(crate) fn enter(&mut self, block: Block, word: Word<'t>) {
        self.open.push((block, word));
        self.open_counts[block as usize] += 1;
        self.last_field = None;
    }

    /// The innermost open block.
    pub(crate) fn innermost(&self) -> Block {
        self.open.last().map_or(Block::File, |&(block, _)| block)
    }

    fn leave(&mut self) {
        if let Some((block, _)) = self.open.pop() {
            self.open_counts[block as usize] -= 1;
        }
        self.last_field = None;
    }

    /// Reads the next word in the innermost block: a keyword that may stand there, or one that
    /// nobody knows. `None` when the block is over.
    pub(crate) fn next(&mut self) -> Option<Word<'t>> {
        loop {
            let block = self.innermost();
            let Some(word) = self.lexer.peek() else {
                if let Some(&(_, opening)) = self.open.last() {
                    self.is_cut = true;
                    self.report.error(opening.span(), || {
                        format!(
                            "this {} is never closed: `{}` is missing",
                            shown(opening.bytes),
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
                    let ended = shown(ended.word().as_bytes());
                    format!("no {ended} is open that {} could end", shown(word.bytes))
                });
                continue;
            }
            if let Some(opened) = Block::opened_by(&word) {
                if opened.stands_in(block) {
                    self.lexer.go_to(word.end);
                    self.last_field = None;
                    return Some(word);
                }
                if self.open.iter().rev().skip(1).take(3).any(|&(outer, _)| opened.stands_in(outer))
                    || (opened.stands_in(Block::File) && block != Block::File)
                {
                    self.report_missing_end(&word);
                    self.leave();
                    return None;
                }
                self.lexer.go_to(word.end);
                self.report.error(word.span(), || {
                    format!(
                        "{} cannot stand here: it belongs in {}",
                        shown(word.bytes),
                        opened.home()
                    )
                });
                self.skip_unknown(&word);
                continue;
            }
            self.lexer.go_to(word.end);
            if word.is_ellipsis() {
                self.report
                    .warn(word.span(), || format!("a stray {} is skipped", shown(word.bytes)));
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

    /// A leaf that is ended by another's word: whoever ends something means what is open.
    fn report_wrong_end(&mut self, word: &Word<'t>) {
        if let Some(&(block, opening)) = self.open.last() {
            self.report.error_with(
                word.span(),
                || format!("{} cannot end this: `{}` does", shown(word.bytes), block.end()),
                || Some((opening.span(), "opened here".into())),
            );
        }
    }

    fn report_missing_end(&mut self, before: &Word<'t>) {
        if let Some(&(block, opening)) = self.open.last() {
            self.report.error_with(
                before.span(),
                || format!("`{}` is missing before {}", block.end(), shown(before.bytes)),
                || Some((opening.span(), "opened here".into())),
            );
        }
    }

    fn report_stray_number(&mut self, word: &Word<'t>) {
        let last_field = self.last_field;
        self.report.error(word.span(), || match last_field {
            Some((field, 1)) => {
                format!("{} takes one number; this is one more", shown(field.bytes))
            }
            Some((field, 0)) => {
                format!("{} takes a name; a number stands behind it", shown(field.bytes))
            }
            Some((field, count)) => {
                format!("{} takes {count} numbers; this is one more", shown(field.bytes))
            }
            None => format!("a keyword should stand here, not {}", shown(word.bytes)),
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
                    format!("{} ends no block; did you mean `{guess}`?", shown(word.bytes))
                }
                (None, true) => {
                    format!("{} ends no block; `{end}` would end this one", shown(word.bytes))
                }
                (None, false) => format!("{} ends no block", shown(word.bytes)),
            }
        });
        if closes {
            self.leave();
        }
        closes
    }

    /// Reports a word that the innermost block does not know, and skips what belongs to it: up
    /// to its end word if it has one, else the rest of its line.
    pub(crate) fn skip_unknown_keyword(&mut self, word: Word<'t>) {
        let block = self.innermost();
        if block == Block::Entry && matches!(word.bytes, b"specular" | b"shininess") {
            self.report.warn(word.span(), || {
                format!("no material here has {}; skipped", shown(word.bytes))
            });
            self.skip_line();
            return;
        }
        let is_block = self.skip_unknown(&word);
        let hint = || {
            let inner =
                OPENED.iter().filter(|inner| inner.stands_in(block)).map(|inner| inner.word());
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
                    "; each of the solids has its own".into()
                }
                (_, []) => String::new(),
                (_, [home]) => format!("; it belongs in {home}"),
                (_, [others @ .., last]) => {
                    format!("; it belongs in {} or {last}", others.join(", "))
                }
            }
        };
        match (block, is_block) {
            (Block::File, false) => self.report.error(word.span(), || match hint() {
                hint if hint.is_empty() => format!(
                    "{} begins no section: a file consists of `viewport`, `materials`, `lights` and `geometry`",
                    shown(word.bytes)
                ),
                hint => format!("{} begins no section{hint}", shown(word.bytes)),
            }),
            (_, true) => self.report.warn(word.span(), || {
                format!("the block {} is unknown and skipped{}", shown(word.bytes), hint())
            }),
            (_, false) => {
                let last_field =
                    self.last_field.filter(|(field, _)| self.is_on_one_line(field.end..word.start));
                self.report.warn(word.span(), || {
                    let unknown = shown(word.bytes);
                    match last_field {
                        Some((field, count)) => {
                            let values = match count {
                                0 => "one word".into(),
                                1 => "one number".into(),
                                _ => format!("{count} numbers"),
                            };
                            format!("{} takes {values}; from {unknown} on the line is skipped", shown(field.bytes))
                        }
                        None => format!("{unknown} is not known in `{}`, and its line is skipped{}", block.word(), hint()),
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
    fn skip_line(&mut self) {
        let block = self.innermost();
        let stops = |word: &Word<'t>| {
            Block::ended_by(word).is_some_and(|ended| self.open_counts[ended as usize] > 0)
                || Block::opened_by(word).is_some_and(|opened| opened.stands_in(block))
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

    /// Reads the `N` numbers of a field; `None` when that failed and was reported.
    pub(crate) fn numbers<const N: usize>(&mut self, field: Word<'t>) -> Option<[f64; N]> {
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
    pub(crate) fn number(&mut self, field: Word<'t>) -> Option<f64> {
        self.numbers::<1>(field).map(|[number]| number)
    }

    /// How many of the next two words can only be numbers.
    pub(crate) fn numbers_that_follow(&self) -> usize {
        let mut ahead = self.lexer.clone();
        std::iter::from_fn(|| ahead.next()).take(2).take_while(Word::is_number_like).count()
    }

    /// Where the numbers stand that were read last.
    pub(crate) fn value_span(&self) -> Range<usize> {
        self.value_span.clone()
    }

    /// Whether a word behind byte `end` is meant as a value: anything on the same line but a
    /// keyword, and on later lines what looks like a number.
    fn is_value(&self, word: &Word<'t>, end: usize) -> bool {
        word.is_number_like() || (self.is_on_one_line(end..word.start) && !is_keyword(word))
    }

    fn is_on_one_line(&self, gap: Range<usize>) -> bool {
        memchr::memchr(b'\n', &self.lexer.text()[gap]).is_none()
    }

    fn report_missing_numbers(&mut self, field: Word<'t>, end: usize, count: usize, needed: usize) {
        self.report.error(field.start..end, || {
            let numbers =
                if needed == 1 { "one number".into() } else { format!("{needed} numbers") };
            let found = match count {
                0 => "none".into(),
                _ => format!("only {count}"),
            };
            format!(
                "{} takes {numbers}, but {found} {} here",
                shown(field.bytes),
                if count > 1 { "stand" } else { "stands" }
            )
        });
    }

    fn report_bad_number(&mut self, word: &Word<'t>, needed: usize) {
        let field = self.last_field.map_or(*word, |(field, _)| field);
        self.report.error(word.span(), || {
            let shown = shown(word.bytes);
            if word.is_named_infinity_or_nan() {
                return format!(
                    "{shown} cannot be computed with; a finite number should stand here"
                );
            }
            if word.number().is_some() {
                return format!("{shown} is too large: numbers go up to about 1.8e308");
            }
            let with_points: Vec<u8> =
                word.bytes.iter().map(|&byte| if byte == b',' { b'.' } else { byte }).collect();
            let pointed = Word { bytes: &with_points, ..*word };
            if let Some(number) = word.bytes.strip_suffix(b",")
                && (Word { bytes: number, ..*word }).number().is_some()
            {
                return format!(
                    "{shown} is no number: spaces alone stand between numbers, no commas"
                );
            }
            if pointed.number().is_some() {
                let right = String::from_utf8_lossy(&with_points).into_owned();
                return format!(
                    "{shown} is no number: the decimal sign is a point, as in `{right}`"
                );
            }
            let numbers =
                if needed == 1 { "one number".into() } else { format!("{needed} numbers") };
            format!(
                "{shown} is no number; {} takes {numbers}",
                crate::language::diagnostic::shown(field.bytes)
            )
        });
    }

    /// Reads the one word of a field, a `what`; `None` when that failed and was reported.
    pub(crate) fn value_word(&mut self, field: Word<'t>, what: &str) -> Option<Word<'t>> {
        self.last_field = Some((field, 0));
        let is_missing = |word: &Word<'t>| {
            Block::ended_by(word).is_some()
                || (is_keyword(word) && !self.is_on_one_line(field.end..word.start))
        };
        let Some(word) = self.lexer.peek().filter(|word| !is_missing(word)) else {
            self.report.error(field.span(), || {
                format!("{} takes {what}, but none stands here", shown(field.bytes))
            });
            return None;
        };
        self.lexer.go_to(word.end);
        match word.quotes {
            Quotes::Open => {
                self.report.error(word.span(), || "this quote is not closed on its line".into());
                None
            }
            Quotes::Closed if word.bytes.is_empty() => {
                self.report.error(word.span(), || {
                    format!("{} takes {what}, not nothing", shown(field.bytes))
                });
                None
            }
            _ => Some(word),
        }
    }

    /// Whether a file name is all that stands on its line; if not, it wants quotes, and that is
    /// reported.
    pub(crate) fn ends_file_name(&mut self, name: Word<'t>) -> bool {
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
                "a file name with spaces stands in double quotes".into()
            });
        }
        !is_continued
    }
}

/// The candidate that `word` is most likely a misspelling of.
pub(crate) fn suggestion<'a>(
    word: &[u8],
    candidates: impl IntoIterator<Item = &'a str>,
) -> Option<String> {
    let word = std::str::from_utf8(word).ok().filter(|word| word.len() <= 64)?;
    let lower = word.to_lowercase();
    let distance = |candidate: &str| match candidate.to_lowercase() {
        same if same == lower => 0,
        other => 1 + strsim::damerau_levenshtein(&lower, &other),
    };
    candidates
        .into_iter()
        .filter(|candidate| candidate.len() <= 64)
        .map(|candidate| (distance(candidate), candidate))
        .filter(|(distance, candidate)| {
            *distance <= 1 + lower.chars().count().max(candidate.chars().count()) / 3
        })
        .min_by_key(|&(distance, _)| distance)
        .map(|(_, candidate)| candidate.to_owned())
}
