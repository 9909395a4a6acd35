//! Contrast: how far the colour of a face that nobody has seen may lie from what was seen.

use glam::DVec3;

use super::screen::Screen;
use crate::prepared::{layout::View, record::MaterialRecord};

/// A small piece of a face. The name is from Pfister et al., "Surfels: Surface Elements as
/// Rendering Primitives" (2000).
#[derive(Debug, Clone, Copy)]
pub(super) struct Surfel {
    /// The index of its material.
    pub(super) material: u32,
    /// The unit normal towards the eye.
    pub(super) normal: DVec3,
    /// Where it is, relative to the eye, in the block's units.
    pub(super) point: DVec3,
    /// A pixel's side there.
    pub(super) pixel_side: f64,
    /// Which beam has met it; what it shows may continue only in the same.
    pub(super) beam: u32,
}

impl Surfel {
    /// A piece at a place on the screen; `normal` is turned towards the eye.
    pub(super) fn new(
        screen: &Screen,
        beam: u32,
        material: u32,
        normal: DVec3,
        point: DVec3,
    ) -> Self {
        let normal = if normal.dot(point) > 0.0 { -normal } else { normal };
        let pixel_side = screen.pixel_side() * screen.depth(point);
        Self { material, normal, point, pixel_side, beam }
    }
}

/// What bounds contrasts: the materials, and whether light is shown.
#[derive(Debug, Clone, Copy)]
pub(super) struct Contrasts<'a> {
    materials: &'a [MaterialRecord],
    shows_plain_colors: bool,
}

impl<'a> Contrasts<'a> {
    /// Bounds contrasts in a picture; a `flat` one shows plain colours.
    pub(super) fn new(view: &View<'a>, flat: bool) -> Self {
        let shows_plain_colors = flat || view.header.features.is_lit == 0;
        Self { materials: view.materials, shows_plain_colors }
    }

    /// Bounds how far the colour of a face that nobody has seen may lie from `mean`, channel by
    /// channel, where no more light than 1 falls on it.
    pub(super) fn with_mean(&self, material: u32, mean: DVec3) -> DVec3 {
        let material = &self.materials[material as usize];
        let Shares { own, other } = Shares::of(material);
        let color = own * DVec3::from_array(material.color);
        let hidden = (own + other) * mean;
        if self.shows_plain(material) {
            (color - hidden).abs()
        } else {
            hidden.max(color + other - hidden)
        }
    }

    /// Bounds how far the colour of surfel `a` may lie from that of `b`, which it may continue;
    /// infinite where it does not.
    pub(super) fn between(&self, a: &Surfel, b: &Surfel) -> DVec3 {
        if a.material != b.material || a.beam != b.beam {
            return DVec3::INFINITY;
        }
        let is_continued = b.normal.dot(a.point - b.point).abs() <= a.pixel_side;
        if !is_continued && !self.shows_plain(&self.materials[a.material as usize]) {
            return DVec3::INFINITY;
        }
        self.between_continued(a, b)
    }

    /// The same of surfels that have a material in common and of which one continues the other.
    pub(super) fn between_continued(&self, a: &Surfel, b: &Surfel) -> DVec3 {
        let material = &self.materials[a.material as usize];
        if self.shows_plain(material) {
            return DVec3::ZERO;
        }
        let Shares { own, other } = Shares::of(material);
        let brightest = own * DVec3::from_array(material.color) + other;
        brightest * (a.normal - b.normal).length().min(1.0)
    }

    /// Whether a face has one colour wherever it is seen, save for what is straight behind it.
    fn shows_plain(&self, material: &MaterialRecord) -> bool {
        let is_plain =
            Shares::of(material).other == 0.0 && material.texture == MaterialRecord::PLAIN;
        self.shows_plain_colors && is_plain
    }
}

/// The shares of what a face shows, each in 0..=1, besides that of what is straight behind it.
struct Shares {
    /// The share of its own colour.
    own: f64,
    /// The share of what it mirrors or bends, which may have any colour.
    other: f64,
}

impl Shares {
    fn of(material: &MaterialRecord) -> Self {
        let own = (1.0 - material.reflect) * material.alpha;
        let bends = material.refract != 0.0 && material.refract != 1.0;
        let straight = if bends { 0.0 } else { material.transmittance() };
        // Exactly 0 where nothing is mirrored or bent.
        let other = if bends { 1.0 - own } else { material.reflect };
        debug_assert!((own + other + straight - 1.0).abs() < 1e-9);
        Self { own, other }
    }
}
