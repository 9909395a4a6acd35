//! Runs of plain triangle blocks: three vertices, a material and nothing else. Large scenes hold
//! little else, so a scanner of their own parses them, pieces of the text in parallel. It gives up
//! at whatever is not plain and leaves it to the reader of all blocks, so that there is one place
//! that knows about mistakes, and any number of threads reads the same scene.

use rayon::prelude::*;

use glam::DVec3;

use super::{
    lexer::{Lexer, Quotes, Word},
    symbol::Symbols,
    triangles::{Triangles, hash_vertices},
};
use crate::{
    exact::{hash::HashFunction, predicates::is_collinear},
    scene::Triangle,
    text::{
        bytes::{Class, class},
        number::scan_number,
    },
};

/// Bytes of text that are parsed at once: enough to keep a thread busy, few enough that what is
/// parsed but not yet kept takes little memory.
pub(super) const PIECE: usize = 256 << 10;

/// Reads runs of plain triangle blocks.
#[derive(Debug)]
pub(super) struct Runs {
    /// About how many bytes a piece has.
    piece: usize,
    /// Before this byte the text has to be read in order.
    parallel_from: usize,
}

impl Runs {
    /// Starts before the first piece of about `piece` bytes.
    pub(super) fn new(piece: usize) -> Self {
        Self { piece, parallel_from: 0 }
    }

    /// Reads plain triangle blocks from byte `at` of `text`, where one should begin, and gives
    /// the place of the first word that it leaves to others. `primitive` is the number of the
    /// next primitive.
    pub(super) fn read<'t>(
        &mut self,
        text: &'t [u8],
        at: usize,
        triangles: &mut Triangles,
        primitive: &mut u64,
        symbols: &mut Symbols<'t>,
    ) -> usize {
        if (Scanner { text, at }).triangle().is_none() {
            return at;
        }
        let (piece, function) = (self.piece, triangles.hash_function.clone());
        let threads = rayon::current_num_threads();
        if at < self.parallel_from || threads == 1 {
            let piece = Piece::parse(text, at, at.saturating_add(piece), &function);
            return adopt(&[piece], triangles, primitive, symbols);
        }
        let count = PIECES_A_THREAD * threads;
        let mut window = Window::parse(text, at, piece, count, &function);
        loop {
            let (adopted, next) = rayon::join(
                || adopt(&window.pieces, triangles, primitive, symbols),
                || {
                    window
                        .is_whole
                        .then(|| Window::parse(text, window.end, piece, count, &function))
                },
            );
            if adopted < window.end {
                // Up to two windows were parsed in vain: read twice as far before trying again.
                self.parallel_from = adopted.saturating_add(4 * count * piece);
            }
            match next {
                Some(next) if window.end == adopted => window = next,
                _ => return adopted,
            }
        }
    }
}

/// Takes over what was parsed as far as it is what reading on from the first piece would
/// have given; the answer is where that ends.
fn adopt<'t>(
    pieces: &[Piece<'t>],
    triangles: &mut Triangles,
    primitive: &mut u64,
    symbols: &mut Symbols<'t>,
) -> usize {
    let mut at = pieces[0].start;
    for piece in pieces {
        if piece.start != at || *primitive + u64::from(piece.count) > u64::from(u32::MAX) {
            break;
        }
        let names: Vec<u32> = piece
            .names
            .iter()
            .map(|&(word, count)| symbols.use_on_flat(word, u64::from(count)))
            .collect();
        for (triangle, &hash) in piece.triangles.iter().zip(&piece.hashes) {
            let triangle = Triangle {
                material: names[triangle.material as usize],
                primitive: triangle.primitive + *primitive as u32,
                ..*triangle
            };
            triangles.add_solid(triangle, None, hash, symbols);
        }
        triangles.dropped.zero_area += u64::from(piece.count) - piece.triangles.len() as u64;
        *primitive += u64::from(piece.count);
        at = piece.stop;
    }
    at
}

/// Goes over plain triangle blocks from byte `at` of `text` on, and gives the place of the first
/// word that is none of theirs.
pub(super) fn skip_plain_triangles(text: &[u8], at: usize) -> usize {
    let mut scanner = Scanner { text, at };
    let mut end = at;
    while scanner.triangle().is_some() {
        end = scanner.at;
    }
    end
}

/// The pieces that a thread has to parse before their triangles are taken over.
const PIECES_A_THREAD: usize = 2;

/// Neighbouring pieces of text.
struct Window<'t> {
    /// At least one piece.
    pieces: Vec<Piece<'t>>,
    /// The end of the last piece, if all is plain up to there.
    end: usize,
    /// Whether another window may begin there.
    is_whole: bool,
}

impl<'t> Window<'t> {
    /// Parses up to `count` pieces from byte `at`.
    fn parse(
        text: &'t [u8],
        at: usize,
        piece: usize,
        count: usize,
        function: &HashFunction,
    ) -> Self {
        let mut bounds = vec![at];
        let mut end = at;
        while bounds.len() <= count
            && let Some(start) = find_triangle_line(text, end.saturating_add(piece), piece)
        {
            bounds.push(start);
            end = start;
        }
        let is_whole = bounds.len() > count;
        if !is_whole {
            end = end.saturating_add(piece).min(text.len());
            bounds.push(end);
        }
        let pieces = bounds
            .par_windows(2)
            .map(|bounds| Piece::parse(text, bounds[0], bounds[1], function))
            .collect();
        Self { pieces, end, is_whole }
    }
}

/// Finds the first `triangle` from byte `from` on that begins a line, within `reach` bytes.
fn find_triangle_line(text: &[u8], from: usize, reach: usize) -> Option<usize> {
    let end = from.saturating_add(reach).min(text.len());
    memchr::memchr_iter(b'\n', text.get(from..end)?)
        .map(|line_end| {
            let mut scanner = Scanner { text, at: from + line_end + 1 };
            while matches!(text.get(scanner.at), Some(b' ' | b'\t')) {
                scanner.at += 1;
            }
            scanner.at
        })
        .find(|&start| Scanner { text, at: start }.skip_word(b"triangle").is_some())
}

/// The contents of a piece of the text, up to the first thing that is not a plain triangle block.
struct Piece<'t> {
    start: usize,
    /// The place of the next word.
    stop: usize,
    /// The number of blocks that were read.
    count: u32,
    /// The triangles of an area above zero. `material` counts in `names`, `primitive` in the piece.
    triangles: Vec<Triangle>,
    /// The hashes of their vertices.
    hashes: Vec<u64>,
    /// The first uses of materials, and the number of all uses.
    names: Vec<(Word<'t>, u32)>,
}

impl<'t> Piece<'t> {
    /// Parses from `start`; no block begins at `end` or after it.
    fn parse(text: &'t [u8], start: usize, end: usize, function: &HashFunction) -> Self {
        let mut piece = Self {
            start,
            stop: start,
            count: 0,
            triangles: Vec::new(),
            hashes: Vec::new(),
            names: Vec::new(),
        };
        let mut scanner = Scanner { text, at: start };
        let mut last_name = 0;
        while scanner.at < end
            && let Some((vertices, name)) = scanner.triangle()
        {
            if piece.names.get(last_name).is_none_or(|(known, _)| known.bytes != name.bytes) {
                last_name = piece
                    .names
                    .iter()
                    .position(|(known, _)| known.bytes == name.bytes)
                    .unwrap_or_else(|| {
                        piece.names.push((name, 0));
                        piece.names.len() - 1
                    });
                if piece.names.len() > Self::MOST_NAMES {
                    piece.names.pop();
                    break;
                }
            }
            piece.names[last_name].1 += 1;
            let [a, b, c] = vertices;
            if !is_collinear(a, b, c) {
                piece.triangles.push(Triangle {
                    vertices,
                    material: last_name as u32,
                    primitive: piece.count,
                });
                piece.hashes.push(hash_vertices(&vertices, function));
            }
            piece.count += 1;
            piece.stop = scanner.at;
        }
        piece
    }

    /// The most names in a piece: they are searched one by one.
    const MOST_NAMES: usize = 64;
}

/// Reads plain triangle blocks and nothing else.
struct Scanner<'t> {
    text: &'t [u8],
    at: usize,
}

impl<'t> Scanner<'t> {
    /// Reads a block and the space after it.
    fn triangle(&mut self) -> Option<([DVec3; 3], Word<'t>)> {
        self.skip_word(b"triangle")?;
        let vertices = [self.vertex()?, self.vertex()?, self.vertex()?];
        let field = self.at;
        self.skip_word(b"material")?;
        let mut lexer = Lexer::new(self.text, self.at);
        let name = lexer.next()?;
        // What could be another field, an end word or quoted is not plain.
        let is_plain = memchr::memchr(b'\n', &self.text[field..name.start]).is_none()
            && !name.bytes.starts_with(b"end")
            && name.quotes == Quotes::Bare;
        is_plain.then_some(())?;
        self.at = name.end;
        self.skip_space()?;
        self.skip_word(b"endtriangle")?;
        Some((vertices, name))
    }

    fn vertex(&mut self) -> Option<DVec3> {
        self.skip_word(b"vertex")?;
        Some(DVec3::new(self.number()?, self.number()?, self.number()?))
    }

    fn byte(&self) -> u8 {
        self.text.get(self.at).copied().unwrap_or(b' ')
    }

    /// Reads `word` and the space after it.
    fn skip_word(&mut self, word: &[u8]) -> Option<()> {
        self.text[self.at..].starts_with(word).then_some(())?;
        self.at += word.len();
        self.skip_space()
    }

    /// Reads the space after a word; `None` when the word goes on or the space is unusual.
    fn skip_space(&mut self) -> Option<()> {
        match class(self.byte()) {
            Class::Word | Class::Wide => return None,
            Class::Space if self.at < self.text.len() => self.at += 1,
            Class::Space | Class::Comment => {}
        }
        loop {
            match class(self.byte()) {
                Class::Space if self.at < self.text.len() => self.at += 1,
                Class::Word | Class::Space => return Some(()),
                Class::Comment | Class::Wide => {
                    let mut lexer = Lexer::new(self.text, self.at);
                    lexer.skip_space();
                    self.at = lexer.at();
                    return Some(());
                }
            }
        }
    }

    /// Reads a finite number and the space after it.
    fn number(&mut self) -> Option<f64> {
        let number = scan_number(self.text, &mut self.at)?;
        self.skip_space()?;
        Some(number)
    }
}
