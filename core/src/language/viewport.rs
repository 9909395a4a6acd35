//! The section of the eye and the screen, and what it says of the picture as a whole.

use glam::DVec3;

use super::{
    block::Block,
    diagnostic::{Report, quoted},
    direction::direction,
    field::Field,
    lexer::Word,
    walk::Walk,
};
use crate::{
    exact::predicates,
    scene::{Scene, Viewport},
    tile::Size,
    transfer::Transfer,
};

/// What is known of the picture.
#[derive(Debug, Default)]
pub(super) struct Picture<'t> {
    /// The word that opened the first `viewport`.
    opening: Option<Word<'t>>,
    viewport: Option<Viewport>,
    width: Field<'t, u32>,
    height: Field<'t, u32>,
    background: Field<'t, DVec3>,
}

impl<'t> Picture<'t> {
    /// Reads a `viewport` block.
    pub(super) fn read_viewport(
        &mut self,
        walk: &mut Walk<'t>,
        opening: Word<'t>,
        transfer: Transfer,
    ) {
        if let Some(first) = self.opening {
            walk.report.error_with(
                opening.span(),
                || "a scene has only one `viewport`, but this is another".into(),
                || Some((first.span(), "the first `viewport` is here".into())),
            );
        }
        walk.enter(Block::Viewport, opening);
        let [mut origin, mut top_left, mut bottom_left, mut top_right] = [Field::default(); 4];
        loop {
            let Some(word) = walk.next() else {
                if walk.innermost() == Block::Viewport {
                    continue; // That was the end of `screen`.
                }
                break;
            };
            let corner = match word.bytes {
                b"origin" => &mut origin,
                b"topleft" => &mut top_left,
                b"bottomleft" => &mut bottom_left,
                b"topright" => &mut top_right,
                b"screen" => {
                    walk.report.warn(word.span(), || {
                        "`screen` is not needed: its corners are read as those of `viewport`".into()
                    });
                    walk.enter(Block::Screen, word);
                    continue;
                }
                _ if self.read_field(walk, word, transfer) => continue,
                _ => {
                    walk.skip_unknown_keyword(word);
                    continue;
                }
            };
            let value = walk.position(word);
            corner.set(&mut walk.report, word, value);
        }
        let (eye_word, corner_word) =
            (origin.word.unwrap_or(opening), top_left.word.unwrap_or(opening));
        let origin = origin.require(walk, opening, "origin");
        let corners = [(top_left, "topleft"), (bottom_left, "bottomleft"), (top_right, "topright")]
            .map(|(corner, name)| corner.require(walk, opening, name));
        if self.opening.is_none()
            && let (Some(eye), [Some(top_left), Some(bottom_left), Some(top_right)]) =
                (origin, corners)
        {
            let viewport = Viewport { eye, top_left, bottom_left, top_right };
            check_viewport(&viewport, eye_word, corner_word, &mut walk.report);
            self.viewport = Some(viewport);
        }
        self.opening.get_or_insert(opening);
    }

    /// Reads a field that belongs to the picture as a whole; whether `word` is one.
    pub(super) fn read_field(
        &mut self,
        walk: &mut Walk<'t>,
        word: Word<'t>,
        transfer: Transfer,
    ) -> bool {
        let is_at_home = matches!(walk.innermost(), Block::Viewport | Block::Screen);
        match word.bytes {
            b"background" => {
                if !is_at_home {
                    walk.report.warn(word.span(), || {
                        "`background` belongs in `viewport`, and is read as if it were there".into()
                    });
                }
                let color = walk.light(word, transfer);
                self.background.set(&mut walk.report, word, color);
            }
            b"size" if is_at_home => self.read_size(walk, word),
            b"resolution" => {
                walk.warn_synonym(word, "`size` in `viewport`");
                self.read_size(walk, word);
            }
            b"xres" | b"yres" => {
                let which = if word.bytes == b"xres" { "width" } else { "height" };
                walk.warn_synonym(word, &format!("the {which} in `size`"));
                let side = walk.number(word).and_then(|number| side(walk, number));
                let field = if word.bytes == b"xres" { &mut self.width } else { &mut self.height };
                field.set(&mut walk.report, word, side);
            }
            _ => return false,
        }
        true
    }

    fn read_size(&mut self, walk: &mut Walk<'t>, word: Word<'t>) {
        let sides = walk
            .numbers(word)
            .and_then(|[width, height]| Some((side(walk, width)?, side(walk, height)?)));
        self.width.set(&mut walk.report, word, sides.map(|(width, _)| width));
        self.height.word = Some(word);
        self.height.value = sides.map(|(_, height)| height);
    }

    /// Gives what was read to the scene.
    pub(super) fn finish(self, report: &mut Report, scene: &mut Scene) {
        for (set, other, name) in
            [(self.width, self.height, "yres"), (self.height, self.width, "xres")]
        {
            if let (Some(word), None) = (set.word, other.word) {
                report.warn(word.span(), || {
                    format!("{} is ignored, because there is no `{name}`", quoted(word.bytes))
                });
            }
        }
        if let (Some(width), Some(height)) = (self.width.value, self.height.value) {
            scene.size_hint = Size::new(width.into(), height.into()).ok();
        }
        scene.viewport = self.viewport;
        scene.background = self.background.value.unwrap_or_default();
    }
}

/// Checks a side of the picture, in pixels.
fn side(walk: &mut Walk<'_>, side: f64) -> Option<u32> {
    let is_sound = side.fract() == 0.0 && (1.0..=f64::from(Size::MAX_SIDE)).contains(&side);
    if !is_sound {
        walk.refuse_value(|| {
            format!("the width and the height of a picture must be whole numbers from 1 to {}, but one is {side}", Size::MAX_SIDE)
        });
    }
    is_sound.then_some(side as u32)
}

/// Reports what makes the viewport unfit for rendering.
fn check_viewport(
    viewport: &Viewport,
    eye_word: Word<'_>,
    corner_word: Word<'_>,
    report: &mut Report,
) {
    let Viewport { eye, top_left, bottom_left, top_right } = *viewport;
    if predicates::is_collinear(top_left, bottom_left, top_right) {
        report
            .error(corner_word.span(), || "the three corners of the screen lie on one line".into());
    } else if predicates::is_coplanar(top_left, bottom_left, top_right, eye) {
        report
            .error(eye_word.span(), || "the eye, `origin`, lies in the plane of the screen".into());
    } else if ![bottom_left - top_left, top_right - top_left, eye - top_left]
        .iter()
        .all(|edge| edge.is_finite())
    {
        report.error(corner_word.span(), || {
            "this viewport is too large; the longest edge is about 1.8e308".into()
        });
    } else {
        let (left, top) = (direction(bottom_left - top_left), direction(top_right - top_left));
        let cosine = left.dot(top);
        if cosine.abs() > RIGHT_ANGLE {
            report.warn(corner_word.span(), || {
                "the screen is not a rectangle: its edges at `topleft` are not at a right angle, so the picture \
                 is sheared"
                    .into()
            });
        }
    }
}

/// The largest cosine that passes for a right angle: it shears the largest picture by less than
/// a pixel.
const RIGHT_ANGLE: f64 = 1e-5;
