//! The triangles of a scene text. Large scenes are little else, so plain triangle blocks are
//! parsed by a scanner of their own, pieces of the text in parallel. It gives up at whatever is
//! not plain and leaves it to the reader of all blocks, so that there is one place that knows
//! about mistakes, and any number of threads reads the same scene.

use std::hash::{BuildHasher, RandomState};

use glam::{DVec2, DVec3};
use hashbrown::{HashTable, hash_table::Entry};
use rayon::prelude::*;

use crate::{
    exact::is_collinear,
    lexer::{Class, Lexer, Quotes, Word, class, parse_number},
    scene::{Dropped, Triangle},
    symbol::Symbols,
};

/// Bytes of text that are parsed at once: enough to keep a thread busy, few enough that what is
/// parsed but not yet kept takes little memory.
pub(crate) const PIECE: usize = 256 << 10;

/// The triangles that a scene keeps: of an area above zero, each only once.
#[derive(Debug)]
pub(crate) struct Triangles {
    /// Their `material` is a symbol.
    pub(crate) list: Vec<Triangle>,
    /// By ascending index in `list`.
    pub(crate) texcoords: Vec<(u32, [DVec2; 3])>,
    pub(crate) dropped: Dropped,
    /// Index in `list` and half a hash of each triangle.
    table: HashTable<(u32, u32)>,
    /// Nobody can write a file whose hashes collide: the key differs from run to run. It has no
    /// influence on what is kept.
    key: u64,
    /// Before this byte the text has to be read in order.
    parallel_from: usize,
}

impl Triangles {
    /// None yet.
    pub(crate) fn new() -> Self {
        Self {
            list: Vec::new(),
            texcoords: Vec::new(),
            dropped: Dropped::default(),
            table: HashTable::new(),
            key: RandomState::new().hash_one(0),
            parallel_from: 0,
        }
    }

    /// Adds a triangle unless it has no area or is there already.
    pub(crate) fn add(
        &mut self,
        triangle: Triangle,
        texcoords: Option<[DVec2; 3]>,
        symbols: &mut Symbols<'_>,
    ) {
        let [a, b, c] = triangle.vertices;
        if is_collinear(a, b, c) {
            self.dropped.zero_area += 1;
        } else {
            self.add_solid(
                triangle,
                texcoords,
                hash_vertices(&triangle.vertices, self.key),
                symbols,
            );
        }
    }

    /// Adds a triangle of an area above zero.
    fn add_solid(
        &mut self,
        triangle: Triangle,
        texcoords: Option<[DVec2; 3]>,
        vertex_hash: u64,
        symbols: &mut Symbols<'_>,
    ) {
        let mut hash = mix(vertex_hash, u64::from(triangle.material));
        if let Some(texcoords) = texcoords {
            let first = first_vertex(&triangle.vertices);
            for k in 0..3 {
                let texcoord = texcoords[(first + k) % 3];
                hash = mix(mix(hash, texcoord.x.to_bits()), texcoord.y.to_bits());
            }
        }
        let half = (hash >> 32) as u32;
        let (list, known_texcoords) = (&self.list, &self.texcoords);
        let is_same = |&(index, other_half): &(u32, u32)| {
            other_half == half
                && is_copy(
                    &list[index as usize],
                    texcoords_at(known_texcoords, index),
                    &triangle,
                    texcoords,
                    symbols,
                )
        };
        match self.table.entry(spread(half), is_same, |&(_, half)| spread(half)) {
            Entry::Occupied(_) => self.dropped.duplicates += 1,
            Entry::Vacant(place) => {
                let index = self.list.len() as u32;
                place.insert((index, half));
                self.list.push(triangle);
                self.texcoords.extend(texcoords.map(|texcoords| (index, texcoords)));
            }
        }
    }

    /// Reads plain triangle blocks from byte `at` of `text`, where one should begin, and gives
    /// the place of the first word that it leaves to others. `primitive` is the number of the
    /// next primitive.
    pub(crate) fn read_run<'t>(
        &mut self,
        text: &'t [u8],
        at: usize,
        piece: usize,
        primitive: &mut u64,
        symbols: &mut Symbols<'t>,
    ) -> usize {
        let key = self.key;
        let count = if at < self.parallel_from {
            1
        } else {
            PIECES_A_THREAD * rayon::current_num_threads()
        };
        let mut window = Window::parse(text, at, piece, count, key);
        loop {
            let next_start = window.next_start;
            let (adopted, next) = rayon::join(
                || self.adopt(&window, primitive, symbols),
                || next_start.map(|start| Window::parse(text, start, piece, count, key)),
            );
            match next {
                Some(next) if next_start == Some(adopted) => window = next,
                Some(_) => {
                    // Up to two windows were parsed in vain: read twice as far before trying again.
                    self.parallel_from = adopted.saturating_add(4 * count * piece);
                    return adopted;
                }
                None => return adopted,
            }
        }
    }

    /// Takes over what was parsed as far as it is what reading on from the first piece would
    /// have given; the answer is where that ends.
    fn adopt<'t>(
        &mut self,
        window: &Window<'t>,
        primitive: &mut u64,
        symbols: &mut Symbols<'t>,
    ) -> usize {
        let mut at = window.pieces[0].start;
        for piece in &window.pieces {
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
                self.add_solid(triangle, None, hash, symbols);
            }
            self.dropped.zero_area += u64::from(piece.count) - piece.triangles.len() as u64;
            *primitive += u64::from(piece.count);
            at = piece.stop;
        }
        at
    }
}

/// Pieces that a thread has to parse before their triangles are taken over.
const PIECES_A_THREAD: usize = 2;

/// Neighbouring pieces of text.
struct Window<'t> {
    /// At least one.
    pieces: Vec<Piece<'t>>,
    /// Where the next window begins if all is plain up to there; `None` when nobody can tell.
    next_start: Option<usize>,
}

impl<'t> Window<'t> {
    /// Parses up to `count` pieces from byte `at`.
    fn parse(text: &'t [u8], at: usize, piece: usize, count: usize, key: u64) -> Self {
        let mut starts = vec![at];
        while starts.len() < count + 1
            && let Some(start) =
                find_triangle_line(text, starts[starts.len() - 1].saturating_add(piece), piece)
        {
            starts.push(start);
        }
        let is_whole = starts.len() == count + 1;
        let next_start = (is_whole && count > 1).then(|| starts[count]);
        if !is_whole {
            let last = starts[starts.len() - 1];
            starts.push(last.saturating_add(piece).min(text.len()));
        }
        let pieces = starts
            .par_windows(2)
            .map(|bounds| Piece::parse(text, bounds[0], bounds[1], key))
            .collect();
        Self { pieces, next_start }
    }
}

/// The first `triangle` from byte `from` on that begins a line, within `reach` bytes.
fn find_triangle_line(text: &[u8], from: usize, reach: usize) -> Option<usize> {
    let end = from.saturating_add(reach).min(text.len());
    memchr::memchr_iter(b'\n', text.get(from..end)?)
        .map(|line_end| {
            let mut scanner = Scanner { text, at: from + line_end + 1 };
            while matches!(scanner.byte(), b' ' | b'\t') {
                scanner.at += 1;
            }
            scanner.at
        })
        .find(|&start| Scanner { text, at: start }.skip_word(b"triangle").is_some())
}

/// What a piece of the text holds up to the first thing that is not a plain triangle block.
struct Piece<'t> {
    start: usize,
    /// Where the next word stands.
    stop: usize,
    /// Blocks that were read.
    count: u32,
    /// Those of an area above zero. `material` counts in `names`, `primitive` in the piece.
    triangles: Vec<Triangle>,
    /// Of their vertices.
    hashes: Vec<u64>,
    /// First uses of materials, and how many follow.
    names: Vec<(Word<'t>, u32)>,
}

impl<'t> Piece<'t> {
    /// Parses from `start`; no block begins at `end` or behind it.
    fn parse(text: &'t [u8], start: usize, end: usize, key: u64) -> Self {
        // The shortest blocks that people write have some 100 bytes.
        let expected = (end - start) / 128;
        let mut piece = Self {
            start,
            stop: start,
            count: 0,
            triangles: Vec::with_capacity(expected),
            hashes: Vec::with_capacity(expected),
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
                piece.hashes.push(hash_vertices(&vertices, key));
            }
            piece.count += 1;
            piece.stop = scanner.at;
        }
        piece
    }

    /// Names are looked for one by one.
    const MOST_NAMES: usize = 64;
}

/// Reads plain triangle blocks and nothing else.
struct Scanner<'t> {
    text: &'t [u8],
    at: usize,
}

impl<'t> Scanner<'t> {
    /// Reads a block and the space behind it.
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

    /// Reads `word` and the space behind it.
    fn skip_word(&mut self, word: &[u8]) -> Option<()> {
        self.text[self.at..].starts_with(word).then_some(())?;
        self.at += word.len();
        self.skip_space()
    }

    /// Reads the space behind a word; `None` when the word goes on or the space is unusual.
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

    /// Reads a finite number and the space behind it.
    ///
    /// Source of the short way: Clinger, "How to Read Floating Point Numbers Accurately" (1990):
    /// whole numbers below 2^53 and powers of ten up to 10^22 are exact, so that one division
    /// rounds once.
    fn number(&mut self) -> Option<f64> {
        let start = self.at;
        let mut byte = self.byte();
        let is_negative = byte == b'-';
        if is_negative || byte == b'+' {
            self.at += 1;
            byte = self.byte();
        }
        let digits_start = self.at;
        let mut mantissa = 0_u64;
        while byte.is_ascii_digit() {
            mantissa = mantissa.wrapping_mul(10).wrapping_add(u64::from(byte - b'0'));
            self.at += 1;
            byte = self.byte();
        }
        let mut digit_count = self.at - digits_start;
        let mut decimals = 0;
        if byte == b'.' {
            self.at += 1;
            let decimals_start = self.at;
            byte = self.byte();
            while byte.is_ascii_digit() {
                mantissa = mantissa.wrapping_mul(10).wrapping_add(u64::from(byte - b'0'));
                self.at += 1;
                byte = self.byte();
            }
            decimals = self.at - decimals_start;
            digit_count += decimals;
        }
        let number = if digit_count > 0
            && digit_count <= 19
            && mantissa <= 1 << 53
            && decimals < POWERS_OF_TEN.len()
            && matches!(class(byte), Class::Space | Class::Comment)
        {
            let size = mantissa as f64 / POWERS_OF_TEN[decimals];
            if is_negative { 0.0 - size } else { size }
        } else {
            while class(self.byte()) == Class::Word {
                self.at += 1;
            }
            parse_number(&self.text[start..self.at]).filter(|number| number.is_finite())?
        };
        self.skip_space()?;
        Some(number)
    }
}

const POWERS_OF_TEN: [f64; 23] = [
    1e0, 1e1, 1e2, 1e3, 1e4, 1e5, 1e6, 1e7, 1e8, 1e9, 1e10, 1e11, 1e12, 1e13, 1e14, 1e15, 1e16,
    1e17, 1e18, 1e19, 1e20, 1e21, 1e22,
];

/// Whether two triangles are the same but for the vertex that they begin with.
fn is_copy(
    old: &Triangle,
    old_texcoords: Option<[DVec2; 3]>,
    new: &Triangle,
    new_texcoords: Option<[DVec2; 3]>,
    symbols: &mut Symbols<'_>,
) -> bool {
    if old.material != new.material {
        return false;
    }
    let is_turned_by =
        |turn: usize| (0..3).all(|k| old.vertices[(k + turn) % 3] == new.vertices[k]);
    let Some(turn) = (0..3).find(|&turn| is_turned_by(turn)) else { return false };
    match (old_texcoords, new_texcoords) {
        (None, None) => turn == 0 || symbols.may_turn(old.material),
        (Some(old), Some(new)) => (0..3).all(|k| old[(k + turn) % 3] == new[k]),
        _ => false,
    }
}

/// The explicit texture coordinates of a triangle in the list.
fn texcoords_at(texcoords: &[(u32, [DVec2; 3])], index: u32) -> Option<[DVec2; 3]> {
    let place = texcoords.binary_search_by_key(&index, |&(known, _)| known).ok()?;
    Some(texcoords[place].1)
}

/// The vertex that comes first in an order of all points; turning the triangle does not move it.
fn first_vertex(vertices: &[DVec3; 3]) -> usize {
    let key = |k: usize| vertices[k].to_array().map(f64::to_bits);
    let first = usize::from(key(1) < key(0));
    if key(2) < key(first) { 2 } else { first }
}

/// A hash that does not change when the triangle is turned.
fn hash_vertices(vertices: &[DVec3; 3], key: u64) -> u64 {
    let first = first_vertex(vertices);
    let mut hash = key;
    for k in 0..3 {
        for number in vertices[(first + k) % 3].to_array() {
            hash = mix(hash, number.to_bits());
        }
    }
    hash
}

/// Mixes `word` into a hash: both halves of a product, which hang on all bits of both factors.
fn mix(hash: u64, word: u64) -> u64 {
    let product = u128::from(hash ^ word) * 0x9e37_79b9_7f4a_7c15;
    (product as u64) ^ (product >> 64) as u64
}

/// Half a hash as a whole one: tables take the place from the low bits and a tag from the high.
fn spread(half: u32) -> u64 {
    u64::from(half) | u64::from(half) << 32
}
