//! What may be seen in a pixel though none of its samples has met it: faces in the beam of all rays
//! through the pixel.
//!
//! The search goes through the hierarchy in blocks of pixels. A block has a [`screen::Beam`], and
//! [`frustum`] collects the faces in it: boxes are filtered with a margin for rounding, then a
//! face's own [`outline`] on the screen decides. So what a pixel learns depends neither on the tree
//! nor on the block. The [`judge`] cuts the outlines to the pixel and keeps those that no sample
//! has met or passed, and whose colour may lie far enough from what was seen ([`contrast`]), and
//! the gap that the face that was seen and those beside it leave, whatever stands behind. They are
//! the pixel's [`UnseenFaces`], and tell how much its mean may lack; later samples take them out
//! one by one.
//!
//! The same search goes on from flat surfaces ([`onward`]): towards the lights, for shadows, into
//! mirrors and through what does not bend.

mod bins;
mod contrast;
mod faces;
mod first_samples;
mod frustum;
mod judge;
mod onward;
mod outline;
mod screen;

pub(super) use self::{faces::UnseenFaces, first_samples::FirstSamples};

use glam::DVec3;

use self::{
    bins::Bins,
    frustum::FrustumSearch,
    judge::{DEPTH_RATIO, Judge, Sight},
    onward::{OnwardSearch, Tools},
    screen::{Beam, Reach, Rectangle, Screen},
};
use crate::{
    isa::Isa,
    prepared::layout::View,
    tile::{Area, Size},
    trace::ray::Hit,
};

/// Sides, in pixels, of blocks that are searched in one go, and how many faces may be in their
/// beams: a block with more is cut into those of the next size.
const BLOCKS: [(u32, usize); 3] = [(8, 1024), (2, 256), (1, MOST_FACES)];

/// The most faces that a pixel is searched for. One with more is crowded.
const MOST_FACES: usize = 128;

/// In a crowded pixel faces count that stand this many pixels' widths before all that its samples
/// met.
const CROWDED_CLEARANCE: f64 = 8.0;

/// The search for what pixels may hide.
pub(super) struct UnseenSearch<'a> {
    view: &'a View<'a>,
    screen: Screen,
    frustum_search: FrustumSearch,
    bins: Bins,
    judge: Judge<'a>,
    /// It is `None` where no surface sends beams on.
    onward: Option<OnwardSearch<'a>>,
}

impl<'a> UnseenSearch<'a> {
    /// Prepares the search in a picture with the standard error `error`, above 0, that shows plain
    /// colours if it is `flat`. It is `None` where the screen is seen edge-on, so that a pixel has
    /// no beam.
    pub(super) fn new(
        view: &'a View<'a>,
        frame: Size,
        flat: bool,
        error: f64,
        isa: Isa,
    ) -> Option<Self> {
        let screen = Screen::new(&view.header.camera, frame)?;
        let judge = Judge::new(view, flat, error);
        let (frustum_search, bins) = (FrustumSearch::new(isa), Bins::default());
        let onward = OnwardSearch::new(view, flat, isa);
        Some(Self { view, screen, frustum_search, bins, judge, onward })
    }

    /// The rays that the search has traced.
    pub(super) fn rays(&self) -> u64 {
        self.onward.as_ref().map_or(0, OnwardSearch::rays)
    }

    /// Finds what may hide in the pixels of an area: `on_found` gets each pixel that may hide
    /// something. `firsts` have the pixels around it, too.
    pub(super) fn search(
        &mut self,
        area: Area,
        firsts: &FirstSamples,
        on_found: &mut impl FnMut(u32, u32, UnseenFaces),
    ) {
        self.search_blocks(area, &BLOCKS, firsts, on_found);
        if let Some(onward) = &mut self.onward {
            let look = |x, y| firsts.is_calm(self.view, x, y).then(|| *firsts.of(x, y));
            let (frustum_search, judge) = (&mut self.frustum_search, &mut self.judge);
            let tools = Tools { frustum_search, judge, on_found };
            onward.search(&self.screen, area, tools, &look);
        }
    }

    fn search_blocks(
        &mut self,
        area: Area,
        sizes: &[(u32, usize)],
        firsts: &FirstSamples,
        on_found: &mut impl FnMut(u32, u32, UnseenFaces),
    ) {
        let Some((&(side, most), smaller)) = sizes.split_first() else {
            return self.search_crowded((area.x0(), area.y0()), firsts, on_found);
        };
        for block in area.blocks(side) {
            let mut bins = std::mem::take(&mut self.bins);
            bins.start(block, |x, y| self.deepest(x, y, &firsts.of(x, y).hit));
            let (block_bounds, deepest) = (Rectangle::of_block(block), bins.deepest());
            let beam = Beam { block: block_bounds, deepest, reach: Reach::Whole };
            if self.frustum_search.collect(self.view, &self.screen, &beam, most) {
                bins.fill(&self.frustum_search.outlines);
                for ((x, y), deepest, faces) in bins.pixels() {
                    if faces.len() <= MOST_FACES {
                        self.find_unseen((x, y), deepest, faces, firsts, on_found);
                    }
                }
                let is_crowded = |(_, _, faces): &(_, _, &[usize])| faces.len() > MOST_FACES;
                for (pixel, ..) in bins.pixels().filter(is_crowded) {
                    self.search_crowded(pixel, firsts, on_found);
                }
            } else {
                self.search_blocks(block, smaller, firsts, on_found);
            }
            self.bins = bins;
        }
    }

    /// Searches a pixel with too many faces: only those count that stand before all that was seen.
    /// If these are too many as well, nobody knows which share of the pixel they cover.
    fn search_crowded(
        &mut self,
        (x, y): (u32, u32),
        firsts: &FirstSamples,
        on_found: &mut impl FnMut(u32, u32, UnseenFaces),
    ) {
        let first = firsts.of(x, y);
        let middle = self.screen.pixel_direction(x, y).length();
        let clearance = 1.0 - CROWDED_CLEARANCE * self.screen.pixel_side() / middle;
        let deepest = first.hit.t / middle * clearance;
        let beam = Beam { block: Rectangle::of_pixel(x, y), deepest, reach: Reach::Whole };
        if self.frustum_search.collect(self.view, &self.screen, &beam, MOST_FACES) {
            let faces = self.frustum_search.outlines.by_rank();
            self.find_unseen((x, y), deepest, &faces, firsts, on_found);
        } else {
            let contrast = first.color.max(DVec3::ONE - first.color);
            on_found(x, y, UnseenFaces::uncounted(contrast));
        }
    }

    /// The depth up to which faces count in a pixel.
    fn deepest(&self, x: u32, y: u32, hit: &Hit) -> f64 {
        DEPTH_RATIO * hit.t / self.screen.pixel_direction(x, y).length()
    }

    /// Judges the faces in a pixel's beam, in the order of their ranks.
    fn find_unseen(
        &mut self,
        (x, y): (u32, u32),
        deepest: f64,
        faces: &[usize],
        firsts: &FirstSamples,
        on_found: &mut impl FnMut(u32, u32, UnseenFaces),
    ) {
        let screen = &self.screen;
        let sight = Sight { screen, beam: 0, reach: Reach::Whole, weight: 1.0, deepest };
        let faces = (&self.frustum_search.outlines, faces);
        let around = firsts.around(x, y);
        let unseen = self.judge.find_unseen(&sight, faces, (x, y), firsts.of(x, y), around);
        if !unseen.is_empty() {
            on_found(x, y, unseen);
        }
    }

    /// Takes out of what a pixel may hide what its next samples, at these places in pixels on the
    /// screen, tell of it; with them it has `count` samples.
    pub(super) fn note_samples(
        &self,
        unseen: &mut UnseenFaces,
        places: impl Iterator<Item = [f64; 2]>,
        count: u32,
    ) {
        self.judge.note_samples(unseen, places, count);
    }
}

#[cfg(test)]
mod tests {
    use std::fmt::Write;

    use super::{
        outline::{Clipper, Fragment, Outline, Outlines},
        screen::Sheet,
        *,
    };
    use crate::{
        language::read_scene,
        prepare::prepare,
        prepared::{PreparedBytes, PreparedScene},
    };

    /// Triangles, quadrangles, boxes and specks all around the eye.
    fn clutter() -> PreparedScene<PreparedBytes> {
        let mut text = "viewport origin 0.1 0.2 0.3 topleft -1 1 -1 bottomleft -1 -1 -1.2
            topright 1 1 -0.9 endviewport materials entry name a endentry endmaterials geometry "
            .to_owned();
        let mut state = 1_u32;
        let mut random = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            f64::from(state >> 8) / f64::from(1 << 24)
        };
        for k in 0..400 {
            let mut place = || [0; 3].map(|_| 6.0 * random() - 3.0);
            let ([x, y, z], [u, v, w]) = (place(), place().map(|c| 0.2 * c));
            let corners = format!("vertex {x} {y} {z} vertex {} {y} {}", x + u, z + w);
            match k % 4 {
                0 => write!(
                    text,
                    "triangle {corners} vertex {x} {} {z} material a endtriangle ",
                    y + v
                ),
                1 => write!(
                    text,
                    "quadrangle {corners} vertex {} {} {} vertex {x} {} {z} material a
                     endquadrangle ",
                    x + u,
                    y + v,
                    z + w,
                    y + v
                ),
                2 => write!(
                    text,
                    "union parallelepiped {corners} vertex {x} {} {z} vertex {} {y} {}
                     material a endparallelepiped sphere coords {x} {y} {z} radius 0.01 material a
                     endsphere endunion ",
                    y + v,
                    x - w,
                    z + u
                ),
                _ => write!(text, "sphere coords {x} {y} {z} radius 0.01 material a endsphere "),
            }
            .unwrap();
        }
        let nothing = |_: &str| Err(std::io::ErrorKind::NotFound.into());
        let scene = read_scene((text + "endgeometry").as_bytes(), &nothing).scene.unwrap();
        PreparedScene::open(prepare(&scene).unwrap()).unwrap()
    }

    #[test]
    fn beams_meet_the_faces_that_they_meet_without_the_hierarchy() {
        let scene = clutter();
        let view = scene.view();
        let size = Size::new(40, 30).unwrap();
        let screen = Screen::new(&view.header.camera, size).unwrap();
        let ranks = |outlines: &Outlines| {
            let mut ranks: Vec<u32> = outlines.as_slice().iter().map(|face| face.rank).collect();
            ranks.sort_unstable();
            ranks
        };
        let mut search = FrustumSearch::new(Isa::fastest());
        let point = screen.eye() + 1.5 * screen.pixel_direction(20, 15);
        let sheet = Sheet::new(&screen, point, DVec3::new(0.6, 0.0, 0.8)).unwrap();
        let mut totals = [0; 3];
        for block in [1, 2, 8].into_iter().flat_map(|side| Area::whole(size).blocks(side)) {
            for deepest in [0.7, 2.0, f64::INFINITY] {
                let reaches = [Reach::Whole, Reach::Before(sheet), Reach::Behind(sheet)];
                for (reach, total) in reaches.into_iter().zip(&mut totals) {
                    let beam = Beam { block: Rectangle::of_block(block), deepest, reach };
                    assert!(search.collect(&view, &screen, &beam, usize::MAX));
                    let mut all = Outlines::default();
                    view.all_items().for_each(|item| all.add_item(&view, &screen, item, &beam));
                    assert_eq!(ranks(&search.outlines), ranks(&all), "{block:?} {reach:?}");
                    *total += all.as_slice().len();
                }
            }
        }
        let [whole, before, behind] = totals;
        eprintln!("{totals:?} faces in all beams");
        assert!(before > 1000 && behind > 1000 && before < whole && behind < whole);
    }

    #[test]
    fn fragments_of_a_face_in_all_pixels_are_the_face() {
        let scene = clutter();
        let view = scene.view();
        let size = Size::new(40, 30).unwrap();
        let screen = Screen::new(&view.header.camera, size).unwrap();
        let frame = Area::whole(size);
        let block = Rectangle::of_block(frame);
        let beam = Beam { block, deepest: f64::INFINITY, reach: Reach::Whole };
        let mut search = FrustumSearch::new(Isa::fastest());
        assert!(search.collect(&view, &screen, &beam, usize::MAX));
        let inside = |&&Outline { bounds: Rectangle { low, high }, .. }: &&Outline| {
            low[0] > 0.0 && low[1] > 0.0 && high[0] < 40.0 && high[1] < 30.0
        };
        let faces: Vec<&Outline> = search.outlines.as_slice().iter().filter(inside).collect();
        assert!(faces.len() > 20);
        let mut clipper = Clipper::default();
        for face in faces {
            let corners = search.outlines.corners_of(face);
            let mut area = 0.0;
            for (k, a) in corners.iter().enumerate() {
                let b = &corners[(k + 1) % corners.len()];
                area += (a[0] * b[1] - a[1] * b[0]) / 2.0;
            }
            let shares = frame.pixels().filter_map(|(x, y)| {
                let pixel = Rectangle::of_pixel(x, y);
                let overlaps = face.bounds.overlaps(&pixel);
                let cut =
                    || Fragment::new(corners, &face.bounds, &pixel, &Reach::Whole, &mut clipper);
                overlaps.then(cut)?.map(|fragment| fragment.share)
            });
            let sum: f64 = shares.sum();
            assert!((sum - area.abs()).abs() < 1e-9, "{sum} of {area}");
        }
    }
}
