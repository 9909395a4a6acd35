//! The section of the materials.

use glam::DVec3;

use super::{
    block::Block,
    diagnostic::{Report, quoted},
    field::{Field, decode},
    lexer::Word,
    suggestion::suggestion,
    symbol::Symbols,
    walk::Walk,
};
use crate::{scene::Material, transfer::Transfer};

/// The materials that are known.
#[derive(Debug, Default)]
pub(super) struct Materials<'t> {
    /// The materials in file order; their textures are not known yet.
    pub(super) list: Vec<Material>,
    /// The index of each material that has a texture, and the name of its file.
    pub(super) textures: Vec<(u32, Word<'t>)>,
}

impl<'t> Materials<'t> {
    /// Reads a `materials` block.
    pub(super) fn read_materials(
        &mut self,
        walk: &mut Walk<'t>,
        symbols: &mut Symbols<'t>,
        opening: Word<'t>,
        transfer: Transfer,
    ) {
        walk.enter(Block::Materials, opening);
        while let Some(word) = walk.next() {
            match word.bytes {
                b"entry" => self.read_entry(walk, symbols, word, transfer),
                _ => walk.skip_unknown_keyword(word),
            }
        }
    }

    fn read_entry(
        &mut self,
        walk: &mut Walk<'t>,
        symbols: &mut Symbols<'t>,
        opening: Word<'t>,
        transfer: Transfer,
    ) {
        walk.enter(Block::Entry, opening);
        let (mut name, mut color, mut texture) =
            (Field::default(), Field::default(), Field::default());
        let [mut alpha, mut reflect, mut refract] = [Field::default(); 3];
        while let Some(word) = walk.next() {
            match word.bytes {
                b"name" => {
                    let value = walk.value_word(word, "a name");
                    name.set(&mut walk.report, word, value);
                }
                b"color" => {
                    let value = walk.numbers(word).map(|parts| clamp_color(walk, parts, transfer));
                    color.set(&mut walk.report, word, value);
                }
                b"alpha" => {
                    let value = walk.number(word).map(|value| clamp_alpha(walk, value));
                    alpha.set(&mut walk.report, word, value);
                }
                b"reflect" => {
                    let value = walk.number(word).and_then(|value| share(walk, value));
                    reflect.set(&mut walk.report, word, value);
                }
                b"refract" => {
                    let value = walk.number_from_zero(word);
                    refract.set(&mut walk.report, word, value);
                }
                b"texture" | b"image" => {
                    if word.bytes == b"image" {
                        walk.warn_synonym(word, "`texture`");
                    }
                    let value = walk.file_name(word);
                    texture.set(&mut walk.report, word, value);
                }
                _ => walk.skip_unknown_keyword(word),
            }
        }
        let name = name.require(walk, opening, "name");
        let Some(name) = name else { return };
        let index = self.list.len() as u32;
        let symbol = symbols.symbol(name.bytes);
        if let Some((_, first)) = symbols.get(symbol).definition {
            walk.report.error_with(
                name.span(),
                || format!("another material is already named {}", quoted(name.bytes)),
                || Some((first.span(), "the first material of this name".into())),
            );
            return;
        }
        if !is_identifier(name.bytes) {
            walk.report.warn(name.span(), || {
                format!(
                    "{} is not an identifier (letters, digits and `_`, with no digit first), but it is used as it is",
                    quoted(name.bytes)
                )
            });
        }
        let entry = symbols.get_mut(symbol);
        entry.definition = Some((index, name));
        entry.is_textured = texture.value.is_some();
        self.list.push(Material {
            name: String::from_utf8_lossy(name.bytes).into_owned(),
            color: color.value.unwrap_or(DVec3::ONE),
            alpha: alpha.value.unwrap_or(if refract.value > Some(0.0) { 0.0 } else { 1.0 }),
            reflect: reflect.value.unwrap_or(0.0),
            refract: refract.value.unwrap_or(0.0),
            texture: None,
        });
        self.textures.extend(texture.value.map(|file| (index, file)));
    }

    /// Reports names that no material has, and textures that cannot show.
    pub(super) fn report_names(&self, symbols: &Symbols<'_>, report: &mut Report) {
        let candidates = if self.list.len() <= 10_000 { self.list.as_slice() } else { &[] };
        for symbol in symbols.iter() {
            if let (None, Some(word)) = (symbol.definition, symbol.used) {
                report.error(word.span(), || {
                    let names = candidates.iter().map(|known| known.name.as_str());
                    let hint = suggestion(symbol.name, names)
                        .map(|guess| format!("; did you mean {}?", quoted(guess.as_bytes())));
                    let times = (symbol.use_count > 1)
                        .then(|| format!(", but it is used {} times", symbol.use_count));
                    let (hint, times) = (hint.unwrap_or_default(), times.unwrap_or_default());
                    format!("no material is named {}{times}{hint}", quoted(symbol.name))
                });
            }
            if let (true, Some((word, shape))) = (symbol.is_textured, symbol.untexturable) {
                report.warn(word.span(), || {
                    format!(
                        "a texture shows only on triangles and quadrangles, not on this {shape}"
                    )
                });
            }
        }
    }
}

/// Turns a colour whose components must lie from 0 to 255 into light.
fn clamp_color(walk: &mut Walk<'_>, parts: [f64; 3], transfer: Transfer) -> DVec3 {
    let clamped = parts.map(|part| part.clamp(0.0, 255.0));
    if parts.iter().any(|part| !(0.0..=255.0).contains(part)) {
        walk.warn_of_value(|| {
            let [r, g, b] = clamped;
            format!("the components of a colour go from 0 to 255; this one is taken as {r} {g} {b}")
        });
    }
    decode(DVec3::from(clamped) / 255.0, transfer)
}

/// Brings an alpha into 0 to 1.
fn clamp_alpha(walk: &mut Walk<'_>, alpha: f64) -> f64 {
    let clamped = alpha.clamp(0.0, 1.0);
    if !(0.0..=1.0).contains(&alpha) {
        walk.warn_of_value(|| {
            format!("`alpha` goes from 0 (clear) to 1 (opaque); {alpha} is taken as {clamped}")
        });
    }
    clamped
}

/// Reads a mirrored share from a share or a percentage.
fn share(walk: &mut Walk<'_>, reflect: f64) -> Option<f64> {
    match reflect {
        0.0..=1.0 => Some(reflect),
        1.0..=100.0 => {
            let share = reflect / 100.0;
            walk.warn_of_value(|| {
                format!("`reflect` goes from 0 to 1; {reflect} is read as a percentage, {share}")
            });
            Some(share)
        }
        _ => {
            walk.refuse_value(|| format!("`reflect` must be from 0 to 1, but is {reflect}"));
            None
        }
    }
}

/// Whether C++ would take `name` as an identifier.
fn is_identifier(name: &[u8]) -> bool {
    let Ok(name) = std::str::from_utf8(name) else { return false };
    name.chars().all(|character| character == '_' || character.is_alphanumeric())
        && name.chars().next().is_some_and(|first| first == '_' || first.is_alphabetic())
}
