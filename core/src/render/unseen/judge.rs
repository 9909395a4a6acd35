//! The judge decides which faces in a pixel's beam its samples missed.

use glam::DVec3;

use super::{
    contrast::{Contrasts, Surfel},
    faces::UnseenFaces,
    outline::{Clipper, Fragment, Outline, Outlines, contains},
    screen::{Rectangle, Screen},
};
use crate::{prepared::layout::View, sample::Samples, trace::ray::Hit};

/// The share of a picture's error that one face may add unseen without being noted.
const NEGLIGIBLE: f64 = 1.0 / 64.0;

/// The share of a picture's error that all faces of a pixel may add unseen.
const NEGLIGIBLE_SUM: f64 = 1.0 / 8.0;

/// What a pixel's first samples saw.
pub(in crate::render) struct FirstSamples<'a> {
    /// What their camera rays met, one hit each.
    pub(in crate::render) hits: &'a [Hit],
    /// Where they lie in the pixel.
    pub(in crate::render) samples: Samples,
    /// The mean of what they saw.
    pub(in crate::render) mean: DVec3,
}

/// Judges faces in the beam of one pixel after another.
pub(super) struct Judge<'a> {
    view: &'a View<'a>,
    contrasts: Contrasts<'a>,
    /// The standard error that the picture may have, above 0.
    error: f64,
    clipper: Clipper,
    /// The indices of the outlines that the pixel's samples did not meet.
    suspects: Vec<usize>,
    /// Where the pixel's first samples lie on the screen.
    places: Vec<[f64; 2]>,
    /// What they saw.
    seen: Vec<Surfel>,
}

impl<'a> Judge<'a> {
    pub(super) fn new(view: &'a View<'a>, flat: bool, error: f64) -> Self {
        Self {
            view,
            contrasts: Contrasts::new(view, flat),
            error,
            clipper: Clipper::default(),
            suspects: Vec::new(),
            places: Vec::new(),
            seen: Vec::new(),
        }
    }

    /// Finds what a pixel may hide up to a depth, among the outlines of its block.
    pub(super) fn find_unseen(
        &mut self,
        screen: &Screen,
        outlines: &Outlines,
        (x, y): (u32, u32),
        first: &FirstSamples<'_>,
        deepest: f64,
    ) -> UnseenFaces {
        let pixel = Rectangle::of_pixel(x, y);
        let mut unseen = UnseenFaces::default();
        let mut suspects = std::mem::take(&mut self.suspects);
        suspects.clear();
        suspects.extend((0..outlines.as_slice().len()).filter(|&index| {
            let outline = &outlines.as_slice()[index];
            outline.nearest <= deepest
                && outline.bounds.overlaps(&pixel)
                && first.hits.iter().all(|hit| hit.rank != outline.rank)
        }));
        if !suspects.is_empty() {
            suspects.sort_unstable_by_key(|&index| outlines.as_slice()[index].rank);
            self.note_seen(screen, first, (x, y));
            for &index in &suspects {
                let outline = &outlines.as_slice()[index];
                self.judge(screen, outlines, outline, &pixel, first, &mut unseen);
            }
            self.drop_negligible(&mut unseen, first.hits.len() as u32);
        }
        self.suspects = suspects;
        unseen
    }

    /// Notes where a pixel's first samples lie and what they saw, each face once.
    fn note_seen(&mut self, screen: &Screen, first: &FirstSamples<'_>, (x, y): (u32, u32)) {
        self.places.clear();
        self.seen.clear();
        for (number, hit) in (0..).zip(first.hits) {
            let place = first.samples.sample(number).place(x, y);
            self.places.push(place);
            let earlier = &first.hits[..number as usize];
            if !hit.is_some() || earlier.iter().any(|earlier| earlier.rank == hit.rank) {
                continue;
            }
            let direction = screen.direction(place);
            let point = direction * (hit.t / direction.length());
            let normal = hit.face.normal(self.view, screen.eye() + point);
            self.seen.push(Surfel::new(hit.face.material_index(self.view), normal, point));
        }
    }

    /// Adds a face to what a pixel may hide, unless it shows nothing new there, is hidden or has
    /// been passed by a sample.
    fn judge(
        &mut self,
        screen: &Screen,
        outlines: &Outlines,
        outline: &Outline,
        pixel: &Rectangle,
        first: &FirstSamples<'_>,
        unseen: &mut UnseenFaces,
    ) {
        let material = outline.face.material_index(self.view);
        let mut contrast = self.contrasts.with_mean(material, first.mean);
        if self.is_negligible(outline.bounds.common_area(pixel), contrast) {
            return;
        }
        let corners = outlines.corners_of(outline);
        let Some(fragment) = Fragment::new(corners, &outline.bounds, pixel, &mut self.clipper)
        else {
            return;
        };
        if self.is_negligible(fragment.share, contrast) {
            return;
        }
        // Beyond an edge of what is seen a face may begin, but not more than a pixel behind it.
        let nearest = screen.point(fragment.nearest);
        let pixel_side = screen.pixel_side() / fragment.nearest[2];
        let is_behind = |seen: &Surfel| seen.normal.dot(nearest - seen.point) < -pixel_side;
        if first.hits.iter().all(Hit::is_some) && self.seen.iter().all(is_behind) {
            return;
        }
        let point = screen.point(fragment.middle);
        let surfel = Surfel::new(material, self.normal(outline, point), point);
        for seen in &self.seen {
            contrast = contrast.min(self.contrasts.between(screen, &surfel, seen));
        }
        if self.is_negligible(fragment.share, contrast) {
            return;
        }
        if self.places.iter().any(|&place| contains(self.clipper.polygon(), place)) {
            return;
        }
        let rows = [outline.bounds.low[1], outline.bounds.high[1]];
        unseen.add(&fragment, self.clipper.polygon(), rows, contrast, surfel);
    }

    /// The unit normal of a face, to either side, where it is small or flat: a sphere that is so
    /// small is seen as a disc.
    fn normal(&self, outline: &Outline, point: DVec3) -> DVec3 {
        if outline.face.is_round(self.view) {
            -point / point.length()
        } else {
            outline.face.normal(self.view, point)
        }
    }

    /// Whether a face that covers this share of the pixel adds so little that it is not noted.
    fn is_negligible(&self, share: f64, contrast: DVec3) -> bool {
        share * contrast.max_element() < NEGLIGIBLE * self.error
    }

    /// Takes out of what a pixel may hide the faces that its next samples, at these places on the
    /// screen, have passed. What they saw bounds the contrast of those that may continue them. The
    /// pixel has `count` samples now.
    pub(super) fn note_samples(
        &self,
        screen: &Screen,
        unseen: &mut UnseenFaces,
        places: impl Iterator<Item = [f64; 2]>,
        count: u32,
    ) {
        for place in places {
            while let Some(passed) = unseen.remove_at(place) {
                unseen.limit_contrasts(|face| self.contrasts.between(screen, face, &passed));
            }
        }
        self.drop_negligible(unseen, count);
    }

    fn drop_negligible(&self, unseen: &mut UnseenFaces, count: u32) {
        let lack = NEGLIGIBLE_SUM * self.error;
        if unseen.variance(count).max_element() < lack * lack {
            *unseen = UnseenFaces::default();
        }
    }
}
