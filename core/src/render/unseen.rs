//! What may be seen in a pixel though none of its samples has met it: the faces in the beam of
//! all rays through the pixel.
//!
//! Beams go through the hierarchy in blocks of pixels. Boxes are filtered with a margin for
//! rounding, then a face's own outline on the screen decides, so what a pixel learns depends
//! neither on the tree nor on the block.
//!
//! Source: Heckbert & Hanrahan, "Beam Tracing Polygonal Objects" (1984).

use glam::DVec3;

use super::pixel::UNSEEN;
use crate::{
    prepared::{
        face::{Face, Part},
        layout::View,
        node::Child,
        record::{Item, Kind, LeafRecord, MaterialRecord},
    },
    sample::Samples,
    tile::{Area, Size},
    trace::ray::Hit,
};

/// Pixels on the side of a block that is searched in one go, and how many faces it may hold: else
/// it is cut into blocks of the next size. A pixel that holds more is crowded.
const BLOCKS: [(u32, usize); 3] = [(8, 128), (2, 64), (1, MOST_FACES)];

/// Faces that a pixel is searched for.
const MOST_FACES: usize = 128;

/// In a crowded pixel only what stands so many pixels' widths before all that the samples met is
/// searched for.
const BEFORE: f64 = 8.0;

/// A face counts in a pixel if it begins at most this many times as far away as what the pixel's
/// samples met.
const BEYOND: f64 = 1.25;

/// Of a picture's error: what a face may add unseen without being noted, and what all faces of a
/// pixel may add.
const NEGLIGIBLE: f64 = 1.0 / 64.0;
const NEGLIGIBLE_SUM: f64 = 1.0 / 8.0;

/// A sphere with a larger radius on the screen, in pixels, is met by the samples of its pixels or
/// their neighbours.
const LARGEST_SPHERE: f64 = 1.0;

/// Of the depth of its farthest corner: a face is cut off nearer to the eye than this.
const NEAR: f64 = 1.0 / (1 << 30) as f64;

/// Boxes are met with this much room for rounding, which is 2^12 times finer.
const MARGIN: f64 = 1.0 / (1_u64 << 40) as f64;

/// The radius of an octagon as large as a disc of radius 1.
const OCTAGON: f64 = 1.053_907_0;

/// The search for what pixels may hide.
pub(crate) struct Beams<'a> {
    view: &'a View<'a>,
    eye: DVec3,
    /// From the eye to the frame's top left corner, and a pixel's step to the right and down.
    screen: [DVec3; 3],
    /// Turn a point, relative to the eye, into its depth (1 on the screen), and into its place on
    /// the screen in pixels times its depth.
    rows: [DVec3; 3],
    /// A pixel's longer side at depth 1.
    step: f64,
    shows_plain_colors: bool,
    error: f64,
    outlines: Vec<Outline>,
    /// Of all outlines: place on the screen in pixels, and 1 / depth.
    corners: Vec<[f64; 3]>,
    waiting: Vec<Child>,
    /// Room to cut a polygon.
    polygon: Vec<[f64; 3]>,
    spare: Vec<[f64; 3]>,
    suspects: Vec<usize>,
    /// Where a pixel's first samples lie on the screen, and what they saw.
    places: Vec<[f64; 2]>,
    seen: Vec<Patch>,
}

/// What a pixel's first samples saw.
pub(crate) struct Look<'a> {
    /// What the camera rays met.
    pub(crate) hits: &'a [Hit],
    /// Where they went.
    pub(crate) samples: Samples,
    /// The mean of what they saw.
    pub(crate) mean: DVec3,
}

/// A face on the screen.
#[derive(Debug, Clone, Copy)]
struct Outline {
    face: Face,
    rank: u32,
    /// Of its corners.
    first: usize,
    count: usize,
    /// The smallest rectangle around it.
    low: [f64; 2],
    high: [f64; 2],
    /// The least depth.
    nearest: f64,
}

/// A small piece of a face.
#[derive(Debug, Clone, Copy)]
struct Patch {
    material: u32,
    /// Of length 1, towards the eye.
    normal: DVec3,
    /// Relative to the eye.
    place: DVec3,
}

/// The faces that may be seen in a pixel and that no sample has passed yet.
#[derive(Debug, Default)]
pub(crate) struct Unseen {
    faces: Vec<UnseenFace>,
    /// Of all faces.
    corners: Vec<[f64; 3]>,
    /// How far the colour of what nobody could look through may lie from that of the pixel.
    crowd: DVec3,
}

#[derive(Debug)]
struct UnseenFace {
    /// Of its corners.
    first: usize,
    count: usize,
    /// Between which y it lies.
    rows: [f64; 2],
    /// Of the pixel.
    share: f64,
    /// How far its colour may lie from that of the pixel.
    contrast: DVec3,
    is_front: bool,
    patch: Patch,
}

impl Unseen {
    /// Whether nothing hides.
    pub(crate) fn is_empty(&self) -> bool {
        self.faces.is_empty() && self.crowd == DVec3::ZERO
    }

    /// The expected square of what the mean of `count` samples lacks: the faces' contrast by their
    /// share of the pixel, if all samples missed them. Of a closed body only the side that faces
    /// the eye is seen, so the sides are not added. A crowd may cover any share.
    pub(crate) fn variance(&self, count: u32) -> DVec3 {
        let mut shares = [0.0; 2];
        let mut lacks = [DVec3::ZERO; 2];
        for face in &self.faces {
            let side = usize::from(face.is_front);
            shares[side] += face.share;
            lacks[side] += face.share * face.contrast;
        }
        let share = shares[0].max(shares[1]);
        let lack = lacks[0].max(lacks[1]) / share.max(1.0);
        let n = f64::from(count);
        lack * lack * power(1.0 - share.min(1.0), count)
            + self.crowd * self.crowd * (UNSEEN / (n * n * n))
    }

    /// Takes a face out that covers a place on the screen.
    fn take(&mut self, [x, y]: [f64; 2]) -> Option<Patch> {
        let passed = self.faces.iter().position(|face| {
            let [low, high] = face.rows;
            y >= low
                && y <= high
                && contains(&self.corners[face.first..face.first + face.count], [x, y])
        });
        passed.map(|face| self.faces.remove(face).patch)
    }
}

impl<'a> Beams<'a> {
    /// For a picture with that error; `None` where the screen is seen edge-on, so that a pixel has
    /// no beam.
    pub(crate) fn new(view: &'a View<'a>, size: Size, flat: bool, error: f64) -> Option<Self> {
        let camera = &view.header.camera;
        let top_left = DVec3::from_array(camera.top_left);
        let right = DVec3::from_array(camera.right) / f64::from(size.width());
        let down = DVec3::from_array(camera.down) / f64::from(size.height());
        let volume = top_left.dot(right.cross(down));
        let rows = [right.cross(down), down.cross(top_left), top_left.cross(right)]
            .map(|row| row / volume);
        rows.iter().all(|row| row.is_finite()).then(|| Self {
            view,
            eye: DVec3::from_array(camera.eye),
            screen: [top_left, right, down],
            rows,
            step: right.length().max(down.length()),
            shows_plain_colors: flat || view.header.features.is_lit == 0,
            error,
            outlines: Vec::new(),
            corners: Vec::new(),
            waiting: Vec::new(),
            polygon: Vec::new(),
            spare: Vec::new(),
            suspects: Vec::new(),
            places: Vec::new(),
            seen: Vec::new(),
        })
    }

    /// Finds what may hide in the pixels of an area; `look` says what a pixel's samples saw.
    pub(crate) fn search<'l>(
        &mut self,
        area: Area,
        look: &impl Fn(u32, u32) -> Look<'l>,
        on_found: &mut impl FnMut(u32, u32, Unseen),
    ) {
        self.search_blocks(area, &BLOCKS, look, on_found);
    }

    fn search_blocks<'l>(
        &mut self,
        area: Area,
        sizes: &[(u32, usize)],
        look: &impl Fn(u32, u32) -> Look<'l>,
        on_found: &mut impl FnMut(u32, u32, Unseen),
    ) {
        let Some((&(side, most), smaller)) = sizes.split_first() else {
            let (x, y) = (area.x0, area.y0);
            return self.search_crowded(x, y, &look(x, y), on_found);
        };
        for block in blocks(area, side) {
            let deepest = pixels_of(block)
                .map(|(x, y)| self.depth_of(x, y, look(x, y).hits))
                .fold(0.0, f64::max);
            if !self.gather(block, deepest, most) {
                self.search_blocks(block, smaller, look, on_found);
                continue;
            }
            for (x, y) in pixels_of(block) {
                let look = look(x, y);
                let unseen = self.find_unseen(x, y, &look, self.depth_of(x, y, look.hits));
                if !unseen.is_empty() {
                    on_found(x, y, unseen);
                }
            }
        }
    }

    /// In a pixel with too many faces only those count that stand before all that was seen. If
    /// these are too many as well nobody knows which share of the pixel they cover.
    fn search_crowded(
        &mut self,
        x: u32,
        y: u32,
        look: &Look<'_>,
        on_found: &mut impl FnMut(u32, u32, Unseen),
    ) {
        let pixel = Area { x0: x, y0: y, width: 1, height: 1 };
        let nearest = look.hits.iter().map(|hit| hit.t).fold(f64::INFINITY, f64::min);
        let middle = self.direction([f64::from(x) + 0.5, f64::from(y) + 0.5]).length();
        let before = nearest / middle * (1.0 - BEFORE * self.step / middle);
        let unseen = if self.gather(pixel, before, MOST_FACES) {
            self.find_unseen(x, y, look, before)
        } else {
            Unseen { crowd: look.mean.max(DVec3::ONE - look.mean), ..Unseen::default() }
        };
        if !unseen.is_empty() {
            on_found(x, y, unseen);
        }
    }

    /// The depth up to which faces count in a pixel.
    fn depth_of(&self, x: u32, y: u32, hits: &[Hit]) -> f64 {
        let furthest = hits.iter().map(|hit| hit.t).fold(0.0, f64::max);
        let middle = self.direction([f64::from(x) + 0.5, f64::from(y) + 0.5]);
        BEYOND * furthest / middle.length()
    }

    /// From the eye to a place on the screen.
    fn direction(&self, [x, y]: [f64; 2]) -> DVec3 {
        self.screen[0] + x * self.screen[1] + y * self.screen[2]
    }

    /// Collects the outlines of the faces in a block's beam up to a depth; whether there are few
    /// enough.
    fn gather(&mut self, block: Area, deepest: f64, most: usize) -> bool {
        self.outlines.clear();
        self.corners.clear();
        self.waiting.clear();
        self.waiting.push(Child::ROOT);
        let view = self.view;
        let sides = self.sides(block, deepest);
        while let Some(child) = self.waiting.pop() {
            if child.is_leaf() {
                for &item in &view.items[child.items()] {
                    self.gather_item(item, block, deepest);
                }
                if self.outlines.len() > most {
                    return false;
                }
                continue;
            }
            let node = &view.nodes[child.node()];
            let mut mask = 0xFF;
            for side in &sides {
                mask &= side.touched(&node.planes);
                if mask == 0 {
                    break;
                }
            }
            while mask != 0 {
                let child = node.children[mask.trailing_zeros() as usize & 7];
                mask &= mask - 1;
                if child != Child::NONE {
                    self.waiting.push(child);
                }
            }
        }
        true
    }

    /// What bounds a block's beam, in the boxes' frame.
    fn sides(&self, block: Area, deepest: f64) -> [Side; 6] {
        let [depth, across, down] = self.rows;
        let frame = &self.view.header.frame;
        let origin = (DVec3::from_array(frame.origin) - self.eye) * frame.scale;
        let Area { x0, y0, width, height } = block;
        let side = |row: DVec3, factor: f64, sign: f64, depth_limit: f64| {
            let normal = sign * (row - factor * depth);
            let terms = row.abs() + factor * depth.abs();
            let slack = terms.dot(origin.abs() + 1.0) + depth_limit;
            Side { normal, least: -(normal.dot(origin) + depth_limit) - slack * MARGIN }
        };
        [
            side(across, f64::from(x0), 1.0, 0.0),
            side(across, f64::from(x0 + width), -1.0, 0.0),
            side(down, f64::from(y0), 1.0, 0.0),
            side(down, f64::from(y0 + height), -1.0, 0.0),
            side(depth, 0.0, 1.0, 0.0),
            side(depth, 0.0, -1.0, deepest * frame.scale),
        ]
    }

    fn gather_item(&mut self, item: Item, block: Area, deepest: f64) {
        let view = self.view;
        let face = Face::whole(item);
        match item.kind() {
            Some(Kind::Triangle | Kind::Coplanar | Kind::Quadrangle) => {
                let polygon = face.polygon(view).expect("a triangle or a quadrangle");
                let corners = polygon.relative_to(self.eye);
                self.gather_polygon(face, corners.corners(), block, deepest);
            }
            Some(Kind::Sphere) => {
                let sphere = &view.spheres[item.index()];
                let center = DVec3::from_array(sphere.center) - self.eye;
                self.gather_sphere(face, center, sphere.radius, block, deepest);
            }
            Some(Kind::Solid) => {
                let solid = &view.solids[item.index()];
                for (number, leaf) in (0..).zip(view.solid_leaves(solid)) {
                    // What is taken away is seen where something is left.
                    if leaf.is_reversed == 0 {
                        self.gather_leaf(item, number, leaf, block, deepest);
                    }
                }
            }
            None => {}
        }
    }

    fn gather_leaf(
        &mut self,
        item: Item,
        number: u32,
        leaf: &LeafRecord,
        block: Area,
        deepest: f64,
    ) {
        let part = |face: u32| Face { item, part: Part::new(number, face) };
        if leaf.is_sphere() {
            let center = DVec3::from_array(leaf.center) - self.eye;
            return self.gather_sphere(part(0), center, leaf.radius, block, deepest);
        }
        let planes = leaf.planes.map(|plane| &self.view.planes[plane.index()]);
        let normals = planes.map(|plane| DVec3::from_array(plane.normal));
        let heights = [0, 1, 2, 3, 4, 5]
            .map(|k| normals[k].dot(DVec3::from_array(planes[k].point) - self.eye));
        // The corner of three planes, by Cramer's rule.
        let corner = |i: usize, j: usize, k: usize| {
            let [a, b, c] = [normals[i], normals[j], normals[k]];
            let sum = heights[i] * b.cross(c) + heights[j] * c.cross(a) + heights[k] * a.cross(b);
            sum / a.dot(b.cross(c))
        };
        for face in 0..6 {
            let (u, v) = ((face / 2 * 2 + 2) % 6, (face / 2 * 2 + 4) % 6);
            let turned = u + 1 - face % 2;
            let straight = u + face % 2;
            let corners = [(turned, v), (straight, v), (straight, v + 1), (turned, v + 1)]
                .map(|(u, v)| corner(face, u, v));
            // Planes that are as good as parallel meet nowhere.
            if corners.iter().all(|corner| corner.is_finite()) {
                self.gather_polygon(part(face as u32), &corners, block, deepest);
            }
        }
    }

    /// A sphere that is small on the screen is an octagon as large as its disc.
    fn gather_sphere(&mut self, face: Face, center: DVec3, radius: f64, block: Area, deepest: f64) {
        let square = center.length_squared();
        let sine = radius * radius / square;
        let depth = self.rows[0].dot(center);
        let is_small = radius < LARGEST_SPHERE * self.step * depth;
        if !(sine < 1.0 && is_small) {
            return;
        }
        let radius = radius * (1.0 - sine).sqrt() * OCTAGON;
        let (u, v) = (center / square.sqrt()).any_orthonormal_pair();
        let (u, v) = (radius * u, radius * v);
        let (p, q) =
            ((u + v) * std::f64::consts::FRAC_1_SQRT_2, (v - u) * std::f64::consts::FRAC_1_SQRT_2);
        let middle = center * (1.0 - sine);
        let corners = [u, p, v, q, -u, -p, -v, -q].map(|corner| middle + corner);
        self.gather_polygon(face, &corners, block, deepest);
    }

    /// Adds the outline of a polygon, by its corners relative to the eye, if it meets the block and
    /// begins before the depth.
    fn gather_polygon(&mut self, face: Face, corners: &[DVec3], block: Area, deepest: f64) {
        let [depth, across, down] = self.rows;
        let first = self.corners.len();
        let (mut nearest, mut furthest) = (f64::INFINITY, 0.0_f64);
        for &corner in corners {
            let z = depth.dot(corner);
            nearest = nearest.min(z);
            furthest = furthest.max(z);
            self.corners.push([across.dot(corner), down.dot(corner), z]);
        }
        if furthest <= 0.0 {
            return self.corners.truncate(first); // Behind the eye.
        }
        let least = furthest * NEAR;
        if nearest < least {
            self.polygon.clear();
            self.polygon.extend(self.corners.drain(first..));
            cut(&mut self.polygon, &mut self.spare, |corner| corner[2] - least);
            self.corners.extend(&self.polygon);
            nearest = least;
        }
        let (mut low, mut high) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
        for corner in &mut self.corners[first..] {
            let inverse = 1.0 / corner[2];
            *corner = [corner[0] * inverse, corner[1] * inverse, inverse];
            for axis in 0..2 {
                low[axis] = low[axis].min(corner[axis]);
                high[axis] = high[axis].max(corner[axis]);
            }
        }
        let count = self.corners.len() - first;
        let rank = face.rank(self.view).expect("a face of the scene");
        let outline = Outline { face, rank, first, count, low, high, nearest };
        if nearest <= deepest && outline.meets(block) {
            self.outlines.push(outline);
        } else {
            self.corners.truncate(first);
        }
    }

    /// What may hide in a pixel up to a depth, among the outlines of its block.
    fn find_unseen(&mut self, x: u32, y: u32, look: &Look<'_>, deepest: f64) -> Unseen {
        let pixel = Area { x0: x, y0: y, width: 1, height: 1 };
        let mut unseen = Unseen::default();
        let mut suspects = std::mem::take(&mut self.suspects);
        suspects.clear();
        suspects.extend((0..self.outlines.len()).filter(|&index| {
            let outline = &self.outlines[index];
            outline.nearest <= deepest
                && outline.meets(pixel)
                && look.hits.iter().all(|hit| hit.rank != outline.rank)
        }));
        if !suspects.is_empty() {
            suspects.sort_unstable_by_key(|&index| self.outlines[index].rank);
            self.note_seen(look, (x, y));
            for &index in &suspects {
                self.judge(index, pixel, look, &mut unseen);
            }
            self.drop_negligible(&mut unseen, look.hits.len() as u32);
        }
        self.suspects = suspects;
        unseen
    }

    /// Notes where a pixel's first samples lie and what they saw, each flat face once.
    fn note_seen(&mut self, look: &Look<'_>, (x, y): (u32, u32)) {
        self.places.clear();
        self.seen.clear();
        for (number, hit) in (0..).zip(look.hits) {
            let place = look.samples.sample(number).place(x, y);
            self.places.push(place);
            let earlier = &look.hits[..number as usize];
            if !hit.is_some() || earlier.iter().any(|earlier| earlier.rank == hit.rank) {
                continue;
            }
            let direction = self.direction(place);
            let place = direction * (hit.t / direction.length());
            let normal = turned_to_eye(hit.face.normal(self.view, self.eye + place), place);
            let material = hit.face.material_index(self.view);
            self.seen.push(Patch { material, normal, place });
        }
    }

    /// Adds a face to what a pixel may hide, unless it shows nothing new there, is hidden or has
    /// been passed by a sample.
    fn judge(&mut self, index: usize, pixel: Area, look: &Look<'_>, unseen: &mut Unseen) {
        let outline = self.outlines[index];
        let material = outline.face.material_index(self.view);
        let mut contrast = self.contrast(material, look.mean);
        if outline.area_of_rectangle(pixel) * contrast.max_element() < NEGLIGIBLE * self.error {
            return;
        }
        let Some(piece) = self.cut_to(pixel, &outline) else { return };
        if piece.share * contrast.max_element() < NEGLIGIBLE * self.error {
            return;
        }
        // Beyond an edge of what is seen a face may begin, but not more than a pixel behind it.
        let near = self.place(piece.nearest);
        let room = self.step / piece.nearest[2];
        let is_behind = |seen: &Patch| seen.normal.dot(near - seen.place) < -room;
        if look.hits.iter().all(Hit::is_some) && self.seen.iter().all(is_behind) {
            return;
        }
        let place = self.place(piece.middle);
        let normal = turned_to_eye(self.normal(&outline, place), place);
        let patch = Patch { material, normal, place };
        for seen in &self.seen {
            contrast = contrast.min(self.contrast_between(&patch, seen));
        }
        if piece.share * contrast.max_element() < NEGLIGIBLE * self.error {
            return;
        }
        if self.places.iter().any(|&place| contains(&self.polygon, place)) {
            return;
        }
        let (first, count) = (unseen.corners.len(), self.polygon.len());
        unseen.corners.extend(&self.polygon);
        let Piece { share, is_front, .. } = piece;
        let rows = [outline.low[1], outline.high[1]];
        unseen.faces.push(UnseenFace { first, count, rows, share, contrast, is_front, patch });
    }

    /// What the next samples of the pixel, at these places on the screen, tell of what may hide in
    /// it; now there are `count`.
    pub(crate) fn pass(
        &self,
        unseen: &mut Unseen,
        places: impl Iterator<Item = [f64; 2]>,
        count: u32,
    ) {
        for place in places {
            while let Some(patch) = unseen.take(place) {
                for face in &mut unseen.faces {
                    face.contrast = face.contrast.min(self.contrast_between(&face.patch, &patch));
                }
            }
        }
        self.drop_negligible(unseen, count);
    }

    fn drop_negligible(&self, unseen: &mut Unseen, count: u32) {
        let lack = NEGLIGIBLE_SUM * self.error;
        if unseen.variance(count).max_element() < lack * lack {
            *unseen = Unseen::default();
        }
    }

    /// The part of a face that lies in a pixel; its outline is left in `polygon`.
    fn cut_to(&mut self, pixel: Area, outline: &Outline) -> Option<Piece> {
        let Area { x0, y0, .. } = pixel;
        let (x0, y0) = (f64::from(x0), f64::from(y0));
        let (polygon, spare) = (&mut self.polygon, &mut self.spare);
        polygon.clear();
        polygon.extend(&self.corners[outline.first..outline.first + outline.count]);
        if outline.low[0] < x0 {
            cut(polygon, spare, |corner| corner[0] - x0);
        }
        if outline.high[0] > x0 + 1.0 {
            cut(polygon, spare, |corner| x0 + 1.0 - corner[0]);
        }
        if outline.low[1] < y0 {
            cut(polygon, spare, |corner| corner[1] - y0);
        }
        if outline.high[1] > y0 + 1.0 {
            cut(polygon, spare, |corner| y0 + 1.0 - corner[1]);
        }
        let mut twice_area = 0.0;
        let mut middle = [0.0; 3];
        let mut nearest = [0.0; 3];
        let mut last = *polygon.last()?;
        for &corner in polygon.iter() {
            // From the pixel's own corner: far from the frame's nothing is lost.
            twice_area += (last[0] - x0) * (corner[1] - y0) - (last[1] - y0) * (corner[0] - x0);
            for (sum, coordinate) in middle.iter_mut().zip(corner) {
                *sum += coordinate / polygon.len() as f64;
            }
            if corner[2] > nearest[2] {
                nearest = corner;
            }
            last = corner;
        }
        let (share, is_front) = (twice_area.abs() / 2.0, twice_area > 0.0);
        Some(Piece { share, is_front, middle, nearest })
    }

    /// A place on the screen with 1 / depth, as a point relative to the eye.
    fn place(&self, [x, y, inverse_depth]: [f64; 3]) -> DVec3 {
        self.direction([x, y]) / inverse_depth
    }

    /// The unit normal of a face, to either side, where it is small or flat.
    fn normal(&self, outline: &Outline, place: DVec3) -> DVec3 {
        if outline.face.is_round(self.view) {
            -place / place.length()
        } else {
            outline.face.normal(self.view, place)
        }
    }

    /// How far the colour of a face that nobody has seen may lie from `mean`, where no more light
    /// than 1 falls on it.
    fn contrast(&self, material: u32, mean: DVec3) -> DVec3 {
        let material = &self.view.materials[material as usize];
        let Shares { own, other } = shares(material);
        let color = own * DVec3::from_array(material.color);
        let hidden = (own + other) * mean;
        if self.shows_plain(material) {
            (color - hidden).abs()
        } else {
            hidden.max(color + other - hidden)
        }
    }

    /// Whether a face has one colour wherever it is seen, save for what is straight behind it.
    fn shows_plain(&self, material: &MaterialRecord) -> bool {
        let is_plain = shares(material).other == 0.0 && material.texture == MaterialRecord::PLAIN;
        self.shows_plain_colors && is_plain
    }

    /// The same from another face, of which the first may be a continuation.
    fn contrast_between(&self, a: &Patch, b: &Patch) -> DVec3 {
        if a.material != b.material {
            return DVec3::INFINITY;
        }
        let material = &self.view.materials[a.material as usize];
        if self.shows_plain(material) {
            return DVec3::ZERO;
        }
        let room = self.step * self.rows[0].dot(a.place);
        if b.normal.dot(a.place - b.place).abs() > room {
            return DVec3::INFINITY;
        }
        let Shares { own, other } = shares(material);
        let brightest = own * DVec3::from_array(material.color) + other;
        brightest * (a.normal - b.normal).length().min(1.0)
    }
}

/// What a face shows of itself in a pixel.
struct Piece {
    /// Of the pixel.
    share: f64,
    is_front: bool,
    /// Places on the screen with 1 / depth.
    middle: [f64; 3],
    nearest: [f64; 3],
}

impl Outline {
    fn meets(&self, Area { x0, y0, width, height }: Area) -> bool {
        self.low[0] < f64::from(x0 + width)
            && self.high[0] > f64::from(x0)
            && self.low[1] < f64::from(y0 + height)
            && self.high[1] > f64::from(y0)
    }

    /// How much of a pixel the rectangle around the outline covers.
    fn area_of_rectangle(&self, Area { x0, y0, .. }: Area) -> f64 {
        let length = |axis: usize, start: u32| {
            let start = f64::from(start);
            self.high[axis].min(start + 1.0) - self.low[axis].max(start)
        };
        length(0, x0) * length(1, y0)
    }
}

/// A plane that bounds a beam: what may lie inside has `normal` · point >= `least`.
struct Side {
    normal: DVec3,
    least: f64,
}

impl Side {
    /// Which of a node's boxes reach inside, a bit each.
    fn touched(&self, planes: &[[f32; 8]; 6]) -> u32 {
        let normal = self.normal.to_array();
        let mut highest = [0.0; 8];
        for axis in 0..3 {
            let bound = if normal[axis] > 0.0 { &planes[axis + 3] } else { &planes[axis] };
            for (highest, &bound) in highest.iter_mut().zip(bound) {
                *highest += normal[axis] * f64::from(bound);
            }
        }
        let mut mask = 0;
        for (child, highest) in highest.iter().enumerate() {
            mask |= u32::from(*highest >= self.least) << child;
        }
        mask
    }
}

/// Cuts off the part of a polygon where `height`, which is linear, is below 0.
///
/// Source: Sutherland & Hodgman, "Reentrant Polygon Clipping" (1974).
fn cut(polygon: &mut Vec<[f64; 3]>, spare: &mut Vec<[f64; 3]>, height: impl Fn(&[f64; 3]) -> f64) {
    spare.clear();
    let Some(mut last) = polygon.last().copied() else { return };
    let mut last_height = height(&last);
    for &corner in polygon.iter() {
        let its_height = height(&corner);
        if (its_height < 0.0) != (last_height < 0.0) {
            let part = last_height / (last_height - its_height);
            spare.push([0, 1, 2].map(|k| last[k] + part * (corner[k] - last[k])));
        }
        if its_height >= 0.0 {
            spare.push(corner);
        }
        (last, last_height) = (corner, its_height);
    }
    std::mem::swap(polygon, spare);
}

/// Whether a place lies in a polygon on the screen: edges that cross a half-line are counted.
fn contains(polygon: &[[f64; 3]], [x, y]: [f64; 2]) -> bool {
    let mut inside = false;
    let Some(mut a) = polygon.last() else { return false };
    for b in polygon {
        if (a[1] > y) != (b[1] > y) {
            let crossing = a[0] + (y - a[1]) * ((b[0] - a[0]) / (b[1] - a[1]));
            inside ^= crossing > x;
        }
        a = b;
    }
    inside
}

fn turned_to_eye(normal: DVec3, place: DVec3) -> DVec3 {
    if normal.dot(place) > 0.0 { -normal } else { normal }
}

/// What a face is seen by, besides what is straight behind it.
struct Shares {
    /// Its own colour.
    own: f64,
    /// What it mirrors or bends: that may be anything.
    other: f64,
}

fn shares(material: &MaterialRecord) -> Shares {
    let own = (1.0 - material.reflect) * material.alpha;
    let bends = material.refract != 0.0 && material.refract != 1.0;
    let straight = if bends { 0.0 } else { material.transmittance() };
    // Exactly 0 where nothing is mirrored or bent.
    let other = if bends { 1.0 - own } else { material.reflect };
    debug_assert!((own + other + straight - 1.0).abs() < 1e-9);
    Shares { own, other }
}

/// An area in blocks, row by row.
pub(crate) fn blocks(area: Area, side: u32) -> impl Iterator<Item = Area> {
    let Area { x0, y0, width, height } = area;
    (0..height).step_by(side as usize).flat_map(move |y| {
        (0..width).step_by(side as usize).map(move |x| Area {
            x0: x0 + x,
            y0: y0 + y,
            width: side.min(width - x),
            height: side.min(height - y),
        })
    })
}

/// The pixels of an area, row by row.
fn pixels_of(Area { x0, y0, width, height }: Area) -> impl Iterator<Item = (u32, u32)> {
    (y0..y0 + height).flat_map(move |y| (x0..x0 + width).map(move |x| (x, y)))
}

/// `base` to a whole power, by squaring.
fn power(base: f64, exponent: u32) -> f64 {
    let (mut product, mut square, mut left) = (1.0, base, exponent);
    while left > 0 {
        if left & 1 == 1 {
            product *= square;
        }
        square *= square;
        left >>= 1;
    }
    product
}

#[cfg(test)]
mod tests {
    use std::fmt::Write;

    use super::*;
    use crate::{
        language::reader::read_scene,
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
        let mut beams = Beams::new(&view, Size::new(40, 30).unwrap(), false, 1.0).unwrap();
        let mut total = 0;
        for block in [1, 2, 8]
            .into_iter()
            .flat_map(|side| blocks(Area { x0: 0, y0: 0, width: 40, height: 30 }, side))
        {
            for deepest in [0.7, 2.0, f64::INFINITY] {
                assert!(beams.gather(block, deepest, usize::MAX));
                let mut found: Vec<u32> = beams.outlines.iter().map(|face| face.rank).collect();
                beams.outlines.clear();
                beams.corners.clear();
                view.items.iter().for_each(|&item| beams.gather_item(item, block, deepest));
                let mut all: Vec<u32> = beams.outlines.iter().map(|face| face.rank).collect();
                found.sort_unstable();
                all.sort_unstable();
                assert_eq!(found, all, "{block:?}");
                total += all.len();
            }
        }
        eprintln!("{total} faces in all beams");
        assert!(total > 1000);
    }

    #[test]
    fn pieces_of_a_face_in_all_pixels_are_the_face() {
        let scene = clutter();
        let view = scene.view();
        let size = Size::new(40, 30).unwrap();
        let whole = Area { x0: 0, y0: 0, width: 40, height: 30 };
        let mut beams = Beams::new(&view, size, false, 1.0).unwrap();
        assert!(beams.gather(whole, f64::INFINITY, usize::MAX));
        let inside = |face: &Outline| {
            face.low[0] > 0.0 && face.low[1] > 0.0 && face.high[0] < 40.0 && face.high[1] < 30.0
        };
        let faces: Vec<Outline> = beams.outlines.iter().copied().filter(inside).collect();
        assert!(faces.len() > 20);
        for face in faces {
            let corners = &beams.corners[face.first..face.first + face.count];
            let mut area = 0.0;
            for (k, a) in corners.iter().enumerate() {
                let b = &corners[(k + 1) % corners.len()];
                area += (a[0] * b[1] - a[1] * b[0]) / 2.0;
            }
            let pieces = pixels_of(whole).filter_map(|(x0, y0)| {
                let pixel = Area { x0, y0, width: 1, height: 1 };
                face.meets(pixel).then(|| beams.cut_to(pixel, &face))?.map(|piece| piece.share)
            });
            let sum: f64 = pieces.sum();
            assert!((sum - area.abs()).abs() < 1e-9, "{sum} of {area}");
        }
    }

    #[test]
    fn a_power_is_a_product() {
        assert_eq!(power(0.5, 0), 1.0);
        assert_eq!(power(0.5, 13), 1.0 / 8192.0);
        assert_eq!(power(0.0, 8), 0.0);
    }
}
