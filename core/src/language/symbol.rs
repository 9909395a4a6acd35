//! The names of materials: where each is defined and where it is used, in any order.

use std::collections::HashMap;

use super::lexer::Word;

/// All names in the order of their first appearance.
#[derive(Debug, Default)]
pub(super) struct Symbols<'t> {
    by_name: HashMap<&'t [u8], u32>,
    list: Vec<Symbol<'t>>,
    /// Materials that are known from an earlier reading to have a texture.
    textured: Vec<Vec<u8>>,
}

/// The name of a material.
#[derive(Debug)]
pub(super) struct Symbol<'t> {
    pub(super) name: &'t [u8],
    /// Index of the material and the word that names it.
    pub(super) definition: Option<(u32, Word<'t>)>,
    /// Whether the material has a texture, as far as is known.
    pub(super) is_textured: bool,
    /// The first use.
    pub(super) used: Option<Word<'t>>,
    /// The number of uses.
    pub(super) use_count: u64,
    /// The first use by something that takes no texture, and what that is.
    pub(super) untexturable: Option<(Word<'t>, &'static str)>,
    /// Whether a copy was dropped that is none if the material has a texture.
    was_turned: bool,
}

impl<'t> Symbols<'t> {
    /// Starts without names. Materials of `textured` names will have textures.
    pub(super) fn new(textured: &[Vec<u8>]) -> Self {
        Self { textured: textured.to_vec(), ..Self::default() }
    }

    /// Finds or makes the symbol of a name.
    pub(super) fn symbol(&mut self, name: &'t [u8]) -> u32 {
        *self.by_name.entry(name).or_insert_with(|| {
            self.list.push(Symbol {
                name,
                definition: None,
                is_textured: self.textured.iter().any(|textured| textured == name),
                used: None,
                use_count: 0,
                untexturable: None,
                was_turned: false,
            });
            self.list.len() as u32 - 1
        })
    }

    /// Notes `count` uses by flat shapes, the first of them at `word`.
    pub(super) fn use_on_flat(&mut self, word: Word<'t>, count: u64) -> u32 {
        let symbol = self.symbol(word.bytes);
        let entry = self.get_mut(symbol);
        entry.used.get_or_insert(word);
        entry.use_count += count;
        symbol
    }

    /// Notes a use by a shape that takes no texture.
    pub(super) fn use_on_untexturable(&mut self, word: Word<'t>, shape: &'static str) -> u32 {
        let symbol = self.use_on_flat(word, 1);
        self.get_mut(symbol).untexturable.get_or_insert((word, shape));
        symbol
    }

    pub(super) fn get(&self, symbol: u32) -> &Symbol<'t> {
        &self.list[symbol as usize]
    }

    pub(super) fn get_mut(&mut self, symbol: u32) -> &mut Symbol<'t> {
        &mut self.list[symbol as usize]
    }

    /// Lists all symbols.
    pub(super) fn iter(&self) -> impl Iterator<Item = &Symbol<'t>> {
        self.list.iter()
    }

    /// Whether a shape without texture coordinates looks the same when its vertices are turned:
    /// the default coordinates hang on the first vertex.
    pub(super) fn may_turn(&mut self, symbol: u32) -> bool {
        let symbol = self.get_mut(symbol);
        symbol.was_turned |= !symbol.is_textured;
        !symbol.is_textured
    }

    /// Lists the names for which [`Symbols::may_turn`] gave an answer that a later texture made
    /// wrong.
    pub(super) fn textured_after_use(&self) -> Vec<Vec<u8>> {
        self.list
            .iter()
            .filter(|symbol| symbol.was_turned && symbol.is_textured)
            .map(|symbol| symbol.name.to_vec())
            .collect()
    }
}
