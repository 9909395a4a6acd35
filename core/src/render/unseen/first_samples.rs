//! The first samples of pixels.

use glam::DVec3;

use crate::{
    isa::Isa,
    prepared::layout::View,
    render::camera_rays::FirstPlaces,
    tile::Area,
    trace::{kernels::run_in_lanes, ray::Hit},
};

/// A pixel's first sample.
#[derive(Debug, Clone, Copy)]
pub(super) struct FirstSample {
    /// What its ray met, as seen from where the beam comes from.
    pub(super) hit: Hit,
    /// Where it lies on the screen, in pixels.
    pub(super) place: [f64; 2],
    /// What it saw.
    pub(super) color: DVec3,
}

/// The first samples of an area's pixels.
#[derive(Debug)]
pub(in crate::render) struct FirstSamples {
    area: Area,
    /// Row by row.
    samples: Vec<FirstSample>,
}

impl FirstSamples {
    /// Those that saw these colors and met these faces, row by row.
    pub(in crate::render) fn new(
        area: Area,
        seed: u64,
        colors: &[DVec3],
        hits: &[Hit],
        isa: Isa,
    ) -> Self {
        let mut places = Vec::with_capacity(area.pixel_count());
        run_in_lanes(isa, &mut FirstPlaces { area, seed, places: &mut places });
        let sample = |((&hit, &color), place)| FirstSample { hit, place, color };
        Self { area, samples: hits.iter().zip(colors).zip(places).map(sample).collect() }
    }

    /// That of a pixel.
    pub(super) fn of(&self, x: u32, y: u32) -> &FirstSample {
        &self.samples[self.area.index_of(x, y) as usize]
    }

    /// That of a pixel and those of the pixels beside it.
    pub(super) fn around(&self, x: u32, y: u32) -> impl Iterator<Item = &FirstSample> + Clone {
        self.area.neighbours(x, y).map(|index| &self.samples[index as usize])
    }

    /// Whether a pixel and those beside it met the same surface.
    pub(super) fn is_calm(&self, view: &View<'_>, x: u32, y: u32) -> bool {
        let own = &self.of(x, y).hit;
        let surface = |hit: &Hit| hit.face.surface(view);
        own.is_some()
            && self
                .around(x, y)
                .all(|FirstSample { hit, .. }| hit.rank == own.rank || surface(hit) == surface(own))
    }
}
