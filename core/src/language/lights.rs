//! The section of the lights.

use glam::DVec3;

use super::{block::Block, diagnostic::Report, field::Field, lexer::Word, walk::Walk};
use crate::{
    scene::{Light, Scene},
    transfer::Transfer,
};

/// The lights that are known.
#[derive(Debug, Default)]
pub(super) struct Lights<'t> {
    /// Power and distance of each `reference`.
    references: Vec<(f64, f64)>,
    points: Vec<PointLight<'t>>,
    ambient: Field<'t, DVec3>,
}

/// A point light before the reference that governs it is known.
#[derive(Debug)]
struct PointLight<'t> {
    word: Word<'t>,
    position: DVec3,
    power: f64,
    color: DVec3,
    /// The number of references before it.
    references_before: usize,
}

impl<'t> Lights<'t> {
    /// Reads a `lights` block.
    pub(super) fn read_lights(
        &mut self,
        walk: &mut Walk<'t>,
        opening: Word<'t>,
        transfer: Transfer,
    ) {
        walk.enter(Block::Lights, opening);
        while let Some(word) = walk.next() {
            match word.bytes {
                b"reference" => self.read_reference(walk, word),
                b"point" => self.read_point(walk, word, transfer),
                b"ambient" => {
                    let light = read_ambient(walk, word);
                    self.ambient.set(&mut walk.report, word, light);
                }
                b"backlight" => {
                    walk.warn_synonym(word, "`ambient`");
                    let light = walk.color(word);
                    self.ambient.set(&mut walk.report, word, light);
                }
                _ => walk.skip_unknown_keyword(word),
            }
        }
    }

    fn read_reference(&mut self, walk: &mut Walk<'t>, opening: Word<'t>) {
        walk.enter(Block::Reference, opening);
        let [mut power, mut distance] = [Field::default(); 2];
        while let Some(word) = walk.next() {
            let field = match word.bytes {
                b"power" => &mut power,
                b"distance" => &mut distance,
                _ => {
                    walk.skip_unknown_keyword(word);
                    continue;
                }
            };
            let value = walk.number_above_zero(word);
            field.set(&mut walk.report, word, value);
        }
        for (field, name) in [(&power, "power"), (&distance, "distance")] {
            if field.word.is_none() {
                walk.report.warn(opening.span(), || {
                    format!("this `reference` has no `{name}`, which is taken as 1")
                });
            }
        }
        self.references.push((power.value.unwrap_or(1.0), distance.value.unwrap_or(1.0)));
    }

    fn read_point(&mut self, walk: &mut Walk<'t>, opening: Word<'t>, transfer: Transfer) {
        walk.enter(Block::Point, opening);
        let (mut coords, mut power, mut color) =
            (Field::default(), Field::default(), Field::default());
        while let Some(word) = walk.next() {
            match word.bytes {
                b"coords" | b"position" => walk.read_coords(word, &mut coords),
                b"power" => {
                    let value = walk.number_from_zero(word);
                    power.set(&mut walk.report, word, value);
                }
                b"color" => {
                    let value = walk.light(word, transfer);
                    color.set(&mut walk.report, word, value);
                }
                _ => walk.skip_unknown_keyword(word),
            }
        }
        let position = coords.require(walk, opening, "coords");
        let power = power.require(walk, opening, "power");
        if let (Some(position), Some(power)) = (position, power) {
            self.points.push(PointLight {
                word: opening,
                position,
                power,
                color: color.value.unwrap_or(DVec3::ONE),
                references_before: self.references.len(),
            });
        }
    }

    /// Gives what was read to the scene.
    pub(super) fn finish(self, report: &mut Report, scene: &mut Scene) {
        scene.ambient = self.ambient.value;
        for light in self.points {
            let governing = self.references.get(light.references_before.saturating_sub(1));
            let (power, distance) = governing.copied().unwrap_or((1.0, 1.0));
            let intensity = light.power / power * distance * distance * light.color;
            if !intensity.is_finite() {
                report.error(light.word.span(), || {
                    "this light is too bright: its power divided by the reference's, times the square of \
                     the reference's distance, exceeds 1.8e308"
                        .into()
                });
            }
            scene.lights.push(Light { position: light.position, intensity });
        }
    }
}

/// Reads one number, or the three of a colour.
fn read_ambient<'t>(walk: &mut Walk<'t>, word: Word<'t>) -> Option<DVec3> {
    let first = walk.number(word)?;
    let light = match walk.numbers_that_follow() {
        0 => DVec3::splat(first),
        1 => {
            walk.refuse_value(|| "`ambient` takes one number or three, but two are given".into());
            walk.number(word);
            return None;
        }
        _ => walk.numbers(word).map(|[g, b]| DVec3::new(first, g, b) / 255.0)?,
    };
    if light.min_element() < 0.0 {
        walk.refuse_value(|| "the numbers of `ambient` must be 0 or more".into());
        return None;
    }
    Some(light)
}
