//! The judge decides which faces in a pixel's beam its samples missed.

use glam::DVec3;

use super::{
    contrast::{Contrasts, Surfel},
    faces::{Gap, UnseenFaces},
    first_samples::FirstSample,
    outline::{Clipper, Corner, Fragment, Outline, Outlines, contains, fills},
    screen::{Reach, Rectangle, Screen},
};
use crate::prepared::layout::View;

/// The share of a picture's error that one face may add unseen without being noted.
const NEGLIGIBLE: f64 = 1.0 / 64.0;

/// The share of a picture's error that all faces of a pixel may add unseen.
const NEGLIGIBLE_SUM: f64 = 1.0 / 8.0;

/// A face counts in a pixel if it begins at most this many times as deep as the deepest of what the
/// pixel's samples met.
pub(super) const DEPTH_RATIO: f64 = 1.25;

/// A beam of a pixel, and what counts in it.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sight<'a> {
    /// The beam starts here.
    pub(super) screen: &'a Screen,
    /// Tells apart what beams meet.
    pub(super) beam: u32,
    pub(super) reach: Reach,
    /// What is seen in it counts so much in the pixel, 0..=1.
    pub(super) weight: f64,
    /// Faces that begin at a larger depth do not count.
    pub(super) deepest: f64,
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
    /// What was cut out of the first of the faces in a pixel, `None` where nothing is seen of one,
    /// and the corners of it all.
    pieces: Vec<Option<Piece>>,
    corners: Vec<Corner>,
}

/// What a pixel cuts out of a face.
#[derive(Debug, Clone, Copy)]
struct Piece {
    fragment: Fragment,
    /// The index of its first corner among those of all pieces.
    first: usize,
    corner_count: usize,
}

impl<'a> Judge<'a> {
    pub(super) fn new(view: &'a View<'a>, flat: bool, error: f64) -> Self {
        Self {
            view,
            contrasts: Contrasts::new(view, flat),
            error,
            clipper: Clipper::default(),
            suspects: Vec::new(),
            pieces: Vec::new(),
            corners: Vec::new(),
        }
    }

    /// Finds what a pixel may hide among the faces in its beam, in the order of their ranks.
    /// `around` are the first samples of the pixels beside it that came the same way: those that
    /// passed a gap tell what is there.
    pub(super) fn find_unseen<'f>(
        &mut self,
        sight: &Sight<'_>,
        (outlines, suspects): (&Outlines, &[usize]),
        (x, y): (u32, u32),
        first: &FirstSample,
        around: impl Iterator<Item = &'f FirstSample> + Clone,
    ) -> UnseenFaces {
        let pixel = Rectangle::of_pixel(x, y);
        let mut unseen = UnseenFaces::default();
        let own = suspects
            .iter()
            .map(|&index| &outlines.as_slice()[index])
            .find(|outline| outline.rank == first.hit.rank);
        let is_filled = own.is_none_or(|own| fills(outlines.corners_of(own), &pixel));
        if suspects.len() > usize::from(own.is_some()) || !is_filled {
            let seen = self.seen(sight, first).map(|seen| Seen::new(sight, seen));
            self.pieces.clear();
            self.corners.clear();
            if let (Some(seen), false) = (&seen, is_filled) {
                let faces = (outlines, suspects);
                if let Some(gap) = self.find_gap(sight, faces, &pixel, (first, seen), around) {
                    unseen.add_gap(gap);
                }
            }
            for (place, &index) in suspects.iter().enumerate() {
                let outline = &outlines.as_slice()[index];
                let met = (first, seen.as_ref());
                let piece = self.pieces.get(place).copied();
                if first.hit.rank != outline.rank && !matches!(piece, Some(None)) {
                    let piece = piece.flatten();
                    self.judge(sight, (outlines, outline), &pixel, met, piece, &mut unseen);
                }
            }
            self.drop_negligible(&mut unseen, 1);
        }
        unseen
    }

    /// What a pixel's first sample saw.
    fn seen(&self, sight: &Sight<'_>, first: &FirstSample) -> Option<Surfel> {
        first.hit.is_some().then(|| {
            let (screen, hit) = (sight.screen, &first.hit);
            let direction = screen.direction(first.place);
            let point = direction * (hit.t / direction.length());
            let normal = hit.face.normal(self.view, screen.eye() + point);
            let material = hit.face.material_index(self.view);
            Surfel::new(screen, sight.beam, material, normal, point)
        })
    }

    /// Finds what the face that was seen and those that continue it leave uncovered. `suspects` are
    /// all faces in the pixel, in the order of their ranks.
    fn find_gap<'f>(
        &mut self,
        sight: &Sight<'_>,
        (outlines, suspects): (&Outlines, &[usize]),
        pixel: &Rectangle,
        (first, seen): (&FirstSample, &Seen),
        around: impl Iterator<Item = &'f FirstSample> + Clone,
    ) -> Option<Gap> {
        // What stands behind a face that is not in the beam is not in it either.
        if sight.screen.depth(seen.surfel.point) > sight.deepest {
            return None;
        }
        let apart = |other: &FirstSample| (other.color - first.color).abs();
        let of_nothing = first.color.max(DVec3::splat(sight.weight) - first.color);
        let most = around.clone().map(apart).fold(of_nothing, DVec3::max);
        // What covers the pixel, first without its corners: few gaps are worth noting.
        let mut shares = [0.0; 2];
        let left = |shares: [f64; 2]| 1.0 - f64::max(shares[0], shares[1]);
        for &index in suspects {
            let piece = self.cut(sight, (outlines, &outlines.as_slice()[index]), pixel, seen);
            if let Some(Piece { fragment, .. }) = piece {
                shares[usize::from(fragment.is_front)] += fragment.share;
            }
            self.pieces.push(piece);
            // The more there is the less is left.
            if self.is_negligible(left(shares), most) {
                return None;
            }
        }
        let passed = around.filter(|other| {
            self.seen(sight, other).is_none_or(|other| is_behind(sight, other.point, &seen.surfel))
        });
        let contrast = passed.map(apart).reduce(DVec3::max).unwrap_or(of_nothing);
        let share = left(shares);
        if self.is_negligible(share, contrast) {
            return None;
        }
        let covers = self.pieces.iter().flatten().map(|piece| self.corners_of(piece).to_vec());
        let covers = covers.collect();
        Some(Gap { covers, share, contrast })
    }

    /// Cuts a face to the pixel, if what is left does not stand behind what was seen.
    fn cut(
        &mut self,
        sight: &Sight<'_>,
        (outlines, outline): (&Outlines, &Outline),
        pixel: &Rectangle,
        seen: &Seen,
    ) -> Option<Piece> {
        let corners = outlines.corners_of(outline);
        if seen.surely_hides(corners) {
            return None;
        }
        let (bounds, clipper) = (&outline.bounds, &mut self.clipper);
        let fragment = Fragment::new(corners, bounds, pixel, &sight.reach, clipper)?;
        if is_behind(sight, sight.screen.point(fragment.nearest), &seen.surfel) {
            return None;
        }
        let (first, corner_count) = (self.corners.len(), clipper.polygon().len());
        self.corners.extend(clipper.polygon());
        Some(Piece { fragment, first, corner_count })
    }

    fn corners_of(&self, piece: &Piece) -> &[Corner] {
        &self.corners[piece.first..piece.first + piece.corner_count]
    }

    /// Adds a face to what a pixel may hide, unless it shows nothing new there, is hidden or has
    /// been passed by a sample. `piece` is what was cut out of it, if that was done.
    fn judge(
        &mut self,
        sight: &Sight<'_>,
        (outlines, outline): (&Outlines, &Outline),
        pixel: &Rectangle,
        (first, seen): (&FirstSample, Option<&Seen>),
        piece: Option<Piece>,
        unseen: &mut UnseenFaces,
    ) {
        let material = outline.face.material_index(self.view);
        let mut contrast = self.contrast(sight, material, first.color);
        let most_share = outline.bounds.common_area(pixel);
        if self.is_negligible(most_share, contrast) {
            return;
        }
        let corners = outlines.corners_of(outline);
        if let Some(seen) = seen {
            if piece.is_none() && seen.surely_hides(corners) {
                return;
            }
            let is_flat = !outline.face.is_round(self.view);
            if is_flat && seen.surfel.material == material && seen.is_surely_continued_by(corners) {
                // Any piece of a flat face tells how it is turned.
                let piece = self.surfel(sight, outline, corners[0]);
                let most = sight.weight * self.contrasts.between_continued(&piece, &seen.surfel);
                if self.is_negligible(most_share, contrast.min(most))
                    && seen.surely_faces_the_eye(&piece, corners)
                {
                    return;
                }
            }
        }
        let (bounds, clipper) = (&outline.bounds, &mut self.clipper);
        let fragment = match &piece {
            Some(piece) => Some(piece.fragment),
            None => Fragment::new(corners, bounds, pixel, &sight.reach, clipper),
        };
        let Some(fragment) = fragment else { return };
        if self.is_negligible(fragment.share, contrast) {
            return;
        }
        let seen = seen.map(|seen| &seen.surfel);
        let hides = |seen| is_behind(sight, sight.screen.point(fragment.nearest), seen);
        if piece.is_none() && seen.is_some_and(hides) {
            return;
        }
        let surfel = self.surfel(sight, outline, fragment.middle);
        if let Some(seen) = seen {
            contrast = contrast.min(sight.weight * self.contrasts.between(&surfel, seen));
        }
        if self.is_negligible(fragment.share, contrast) {
            return;
        }
        let polygon = piece.as_ref().map_or(self.clipper.polygon(), |piece| self.corners_of(piece));
        if contains(polygon, first.place) {
            return;
        }
        let rows = [outline.bounds.low[1], outline.bounds.high[1]];
        unseen.add(&fragment, polygon, rows, contrast, surfel);
    }

    /// The piece of a face at a corner.
    fn surfel(&self, sight: &Sight<'_>, outline: &Outline, corner: Corner) -> Surfel {
        let point = sight.screen.point(corner);
        let normal = self.normal(outline, point);
        let material = outline.face.material_index(self.view);
        Surfel::new(sight.screen, sight.beam, material, normal, point)
    }

    /// How far the colour of a face may change that of the pixel, whose first samples saw `mean`.
    fn contrast(&self, sight: &Sight<'_>, material: u32, mean: DVec3) -> DVec3 {
        if sight.weight == 1.0 {
            return self.contrasts.with_mean(material, mean);
        }
        // The rest of the pixel hides how much of that mean was seen there.
        let most = self.contrasts.with_mean(material, mean / sight.weight);
        sight.weight * most.max(self.contrasts.with_mean(material, DVec3::ZERO))
    }

    /// Finds the faces in a beam between a pixel and a light whose shadows no sample may have met.
    /// `light` is what of its first sample, at `place`, may be this light's.
    pub(super) fn find_shadows(
        &mut self,
        sight: &Sight<'_>,
        outlines: &Outlines,
        (x, y): (u32, u32),
        (place, light): ([f64; 2], DVec3),
        is_ignored: impl Fn(&Outline) -> bool,
    ) -> UnseenFaces {
        let pixel = Rectangle::of_pixel(x, y);
        let mut unseen = UnseenFaces::default();
        let mut suspects = std::mem::take(&mut self.suspects);
        suspects.clear();
        suspects.extend((0..outlines.as_slice().len()).filter(|&index| {
            let outline = &outlines.as_slice()[index];
            outline.nearest <= sight.deepest
                && outline.bounds.overlaps(&pixel)
                && !is_ignored(outline)
        }));
        suspects.sort_unstable_by_key(|&index| outlines.as_slice()[index].rank);
        let share_kept = |outline: &Outline| outline.face.material(self.view).transmittance();
        // What lies in the way of the sample itself.
        let mut light = light;
        let mut clipper = std::mem::take(&mut self.clipper);
        let cut = |outline: &Outline, clipper: &mut Clipper| {
            let corners = outlines.corners_of(outline);
            Fragment::new(corners, &outline.bounds, &pixel, &sight.reach, clipper)
        };
        suspects.retain(|&index| {
            let outline = &outlines.as_slice()[index];
            let is_passed = !self.is_negligible(1.0, light)
                && contains(outlines.corners_of(outline), place)
                && cut(outline, &mut clipper).is_some()
                && contains(clipper.polygon(), place);
            if is_passed {
                light *= share_kept(outline);
            }
            !is_passed
        });
        if self.is_negligible(1.0, light) {
            suspects.clear();
        }
        for &index in &suspects {
            let outline = &outlines.as_slice()[index];
            let contrast = (1.0 - share_kept(outline)) * light;
            if self.is_negligible(outline.bounds.common_area(&pixel), contrast) {
                continue;
            }
            let Some(fragment) = cut(outline, &mut clipper) else { continue };
            if !self.is_negligible(fragment.share, contrast) {
                let surfel = self.surfel(sight, outline, fragment.middle);
                let rows = [outline.bounds.low[1], outline.bounds.high[1]];
                unseen.add(&fragment, clipper.polygon(), rows, contrast, surfel);
            }
        }
        self.clipper = clipper;
        self.suspects = suspects;
        self.drop_negligible(&mut unseen, 1);
        unseen
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
    pub(super) fn is_negligible(&self, share: f64, contrast: DVec3) -> bool {
        share * contrast.max_element() < NEGLIGIBLE * self.error
    }

    /// Takes out of what a pixel may hide the faces that its next samples, at these places on the
    /// screen, have passed. What they saw bounds the contrast of those that may continue them. The
    /// pixel has `count` samples now.
    pub(super) fn note_samples(
        &self,
        unseen: &mut UnseenFaces,
        places: impl Iterator<Item = [f64; 2]>,
        count: u32,
    ) {
        for place in places {
            unseen.remove_gaps_at(place);
            while let Some(passed) = unseen.remove_at(place) {
                unseen.limit_contrasts(|face| self.contrasts.between(face, &passed));
            }
        }
        self.drop_negligible(unseen, count);
    }

    fn drop_negligible(&self, unseen: &mut UnseenFaces, count: u32) {
        let lack = NEGLIGIBLE_SUM * self.error;
        if unseen.variance(count).max_element() < lack * lack {
            unseen.forget_unseen();
        }
    }
}

/// What a pixel's first sample saw, and its plane on the screen. Times the inverse depth the height
/// of a point over the plane is linear in the place and the inverse depth, so that corners answer
/// for all between them.
struct Seen {
    surfel: Surfel,
    /// The height over a plane through the eye: at the frame's corner, and what a pixel to the
    /// right and one down add.
    rows: [f64; 3],
    /// The height of what was seen.
    height: f64,
    /// The lengths of the terms, for their rounding: of `rows`, and of the point that was seen.
    lengths: [f64; 4],
    pixel_side: f64,
}

/// Room for rounding, relative to the terms; rounding is 2^10 times finer.
const MARGIN: f64 = 1.0 / (1_u64 << 40) as f64;

impl Seen {
    fn new(sight: &Sight<'_>, surfel: Surfel) -> Self {
        let Surfel { normal, point, .. } = surfel;
        let [a, b, c] = sight.screen.axes();
        let rows = [a, b, c].map(|axis| normal.dot(axis));
        let lengths = [a, b, c, point].map(DVec3::length);
        let pixel_side = sight.screen.pixel_side();
        Self { surfel, rows, height: normal.dot(point), lengths, pixel_side }
    }

    /// A corner's height over the plane times its inverse depth, and the room for its rounding.
    fn height_of(&self, [x, y, inverse_depth]: Corner) -> (f64, f64) {
        let [a, b, c] = self.rows;
        let [of_a, of_b, of_c, of_point] = self.lengths;
        let height = a + x * b + y * c - self.height * inverse_depth;
        let terms = of_a + x.abs() * of_b + y.abs() * of_c + of_point * inverse_depth;
        (height, MARGIN * (terms + self.pixel_side))
    }

    /// Whether all between these corners surely stands behind, as [`is_behind`] says.
    fn surely_hides(&self, corners: &[Corner]) -> bool {
        corners.iter().all(|&corner| {
            let (height, room) = self.height_of(corner);
            height + self.pixel_side < -room
        })
    }

    /// Whether all between these corners is surely so near to the plane that it may continue what
    /// was seen.
    fn is_surely_continued_by(&self, corners: &[Corner]) -> bool {
        corners.iter().all(|&corner| {
            let (height, room) = self.height_of(corner);
            height.abs() < self.pixel_side - room
        })
    }

    /// Whether the eye surely sees the same side of the whole flat face that a piece is of.
    fn surely_faces_the_eye(&self, piece: &Surfel, corners: &[Corner]) -> bool {
        let [of_a, of_b, of_c, _] = self.lengths;
        let distance = -piece.normal.dot(piece.point);
        corners.iter().all(|&[x, y, inverse_depth]| {
            distance * inverse_depth > MARGIN * (of_a + x.abs() * of_b + y.abs() * of_c)
        })
    }
}

/// Whether a face that begins at `point` stands behind what was seen: beyond an edge of that it may
/// begin, but not more than a pixel behind it.
fn is_behind(sight: &Sight<'_>, point: DVec3, seen: &Surfel) -> bool {
    let pixel_side = sight.screen.pixel_side() * sight.screen.depth(point);
    seen.normal.dot(point - seen.point) < -pixel_side
}
