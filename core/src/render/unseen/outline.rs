//! Outlines: faces as they look on the screen, and the fragments that pixels cut out of them.

use std::f64::consts::FRAC_1_SQRT_2;

use glam::DVec3;

use super::screen::{Beam, Reach, Rectangle, Screen};
use crate::{
    exact::clip::clip,
    prepared::{
        face::{Face, Part},
        layout::View,
        record::{Item, Kind, LeafRecord},
    },
};

/// Spheres with a larger radius on the screen, in pixels, have no outline: the samples of their
/// pixels or of the neighbours meet them.
const LARGEST_SPHERE: f64 = 1.0;

/// The radius of an octagon as large as a disc of radius 1.
const OCTAGON: f64 = 1.053_907_0;

/// Faces are cut off nearer to the eye than this share of the depth of their farthest corner.
const NEAREST_SHARE: f64 = 1.0 / (1 << 30) as f64;

/// A corner on the screen: its place in pixels, and 1 / depth.
pub(super) type Corner = [f64; 3];

/// A face on the screen.
#[derive(Debug, Clone, Copy)]
pub(super) struct Outline {
    pub(super) face: Face,
    pub(super) rank: u32,
    /// The index of its first corner among those of all outlines.
    first: usize,
    corner_count: usize,
    /// The smallest rectangle around it.
    pub(super) bounds: Rectangle,
    /// The least depth of its corners.
    pub(super) nearest: f64,
}

/// The outlines of the faces in one beam.
#[derive(Debug, Default)]
pub(super) struct Outlines {
    faces: Vec<Outline>,
    /// The corners of all outlines.
    corners: Vec<Corner>,
    clipper: Clipper,
}

impl Outlines {
    pub(super) fn clear(&mut self) {
        self.faces.clear();
        self.corners.clear();
    }

    pub(super) fn as_slice(&self) -> &[Outline] {
        &self.faces
    }

    /// The indices of the outlines in the order of the faces' ranks.
    pub(super) fn by_rank(&self) -> Vec<usize> {
        let mut indices: Vec<usize> = (0..self.faces.len()).collect();
        indices.sort_unstable_by_key(|&index| self.faces[index].rank);
        indices
    }

    /// Adds the outlines of an item's faces that are in the beam.
    pub(super) fn add_item(&mut self, view: &View<'_>, screen: &Screen, item: Item, beam: &Beam) {
        let face = Face::whole(item);
        match item.kind() {
            Some(Kind::Triangle | Kind::Coplanar | Kind::Quadrangle) => {
                let polygon = face.polygon(view).expect("a triangle or a quadrangle");
                let corners = polygon.relative_to(screen.eye());
                self.add_polygon(view, screen, face, corners.corners(), beam);
            }
            Some(Kind::Sphere) => {
                let sphere = &view.spheres[item.index()];
                let center = DVec3::from_array(sphere.center) - screen.eye();
                self.add_sphere(view, screen, face, (center, sphere.radius), beam);
            }
            Some(Kind::Solid) => {
                let solid = &view.solids[item.index()];
                for (number, leaf) in (0..).zip(view.solid_leaves(solid)) {
                    // What is taken away is seen where something is left.
                    if leaf.is_reversed == 0 {
                        self.add_leaf(view, screen, (item, number), leaf, beam);
                    }
                }
            }
            None => {}
        }
    }

    /// Adds the outlines of the faces of a solid's leaf, whole as if nothing were cut off them.
    fn add_leaf(
        &mut self,
        view: &View<'_>,
        screen: &Screen,
        (item, number): (Item, u32),
        leaf: &LeafRecord,
        beam: &Beam,
    ) {
        let part = |face: u32| Face { item, part: Part::new(number, face) };
        if leaf.is_sphere() {
            let center = DVec3::from_array(leaf.center) - screen.eye();
            return self.add_sphere(view, screen, part(0), (center, leaf.radius), beam);
        }
        let planes = leaf.planes.map(|plane| &view.planes[plane.index()]);
        let normals = planes.map(|plane| DVec3::from_array(plane.normal));
        let heights = [0, 1, 2, 3, 4, 5]
            .map(|k| normals[k].dot(DVec3::from_array(planes[k].point) - screen.eye()));
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
                self.add_polygon(view, screen, part(face as u32), &corners, beam);
            }
        }
    }

    /// Adds a sphere that is small on the screen: its outline is an octagon as large as its disc.
    fn add_sphere(
        &mut self,
        view: &View<'_>,
        screen: &Screen,
        face: Face,
        (center, radius): (DVec3, f64),
        beam: &Beam,
    ) {
        let square = center.length_squared();
        let sine = radius * radius / square;
        let depth = screen.depth(center);
        let is_small = radius < LARGEST_SPHERE * screen.pixel_side() * depth;
        if !(sine < 1.0 && is_small) {
            return;
        }
        let radius = radius * (1.0 - sine).sqrt() * OCTAGON;
        let (u, v) = (center / square.sqrt()).any_orthonormal_pair();
        let (u, v) = (radius * u, radius * v);
        let (p, q) = ((u + v) * FRAC_1_SQRT_2, (v - u) * FRAC_1_SQRT_2);
        let middle = center * (1.0 - sine);
        let corners = [u, p, v, q, -u, -p, -v, -q].map(|corner| middle + corner);
        self.add_polygon(view, screen, face, &corners, beam);
    }

    /// Adds a polygon, by its corners relative to the eye, if it is in the beam.
    fn add_polygon(
        &mut self,
        view: &View<'_>,
        screen: &Screen,
        face: Face,
        corners: &[DVec3],
        beam: &Beam,
    ) {
        let [depth, across, down] = screen.inverse_rows();
        let first = self.corners.len();
        let (mut nearest, mut farthest) = (f64::INFINITY, 0.0_f64);
        for &corner in corners {
            let z = depth.dot(corner);
            nearest = nearest.min(z);
            farthest = farthest.max(z);
            self.corners.push([across.dot(corner), down.dot(corner), z]);
        }
        if farthest <= 0.0 {
            return self.corners.truncate(first); // It is behind the eye.
        }
        let least = farthest * NEAREST_SHARE;
        if nearest < least {
            self.clipper.start(&self.corners[first..]);
            self.clipper.clip(|corner| corner[2] - least);
            self.corners.truncate(first);
            self.corners.extend(self.clipper.polygon());
            nearest = least;
        }
        let mut bounds = Rectangle::EMPTY;
        for corner in &mut self.corners[first..] {
            let inverse = 1.0 / corner[2];
            *corner = [corner[0] * inverse, corner[1] * inverse, inverse];
            bounds.add([corner[0], corner[1]]);
        }
        let is_within_reach = matches!(beam.reach, Reach::Whole)
            || self.corners[first..].iter().any(|&corner| beam.reach.height(corner) >= 0.0)
                && !beam.reach.surely_misses(screen, corners, &beam.block);
        if nearest <= beam.deepest && bounds.overlaps(&beam.block) && is_within_reach {
            let corner_count = self.corners.len() - first;
            let rank = face.rank(view).expect("a face of the scene");
            self.faces.push(Outline { face, rank, first, corner_count, bounds, nearest });
        } else {
            self.corners.truncate(first);
        }
    }

    /// The corners of an outline.
    pub(super) fn corners_of(&self, outline: &Outline) -> &[Corner] {
        &self.corners[outline.first..outline.first + outline.corner_count]
    }
}

/// What a pixel cuts out of an outline.
#[derive(Debug, Clone, Copy)]
pub(super) struct Fragment {
    /// The share of the pixel's area, 0..=1.
    pub(super) share: f64,
    /// Whether its corners turn clockwise on the screen.
    pub(super) is_front: bool,
    /// The mean of its corners.
    pub(super) middle: Corner,
    /// The corner of the least depth.
    pub(super) nearest: Corner,
}

impl Fragment {
    /// Cuts the outline with these corners and bounds to a pixel and to what is within reach; the
    /// fragment's own corners are left in `clipper`. It is `None` where nothing is left.
    pub(super) fn new(
        corners: &[Corner],
        bounds: &Rectangle,
        pixel: &Rectangle,
        reach: &Reach,
        clipper: &mut Clipper,
    ) -> Option<Self> {
        let ([x0, y0], [x1, y1]) = (pixel.low, pixel.high);
        clipper.start(corners);
        if bounds.low[0] < x0 {
            clipper.clip(|corner| corner[0] - x0);
        }
        if bounds.high[0] > x1 {
            clipper.clip(|corner| x1 - corner[0]);
        }
        if bounds.low[1] < y0 {
            clipper.clip(|corner| corner[1] - y0);
        }
        if bounds.high[1] > y1 {
            clipper.clip(|corner| y1 - corner[1]);
        }
        if !matches!(reach, Reach::Whole) {
            clipper.clip(|corner| reach.height(corner));
        }
        let polygon = clipper.polygon();
        let mut twice_area = 0.0;
        let mut middle = [0.0; 3];
        let mut nearest = [0.0; 3];
        let mut last = *polygon.last()?;
        for &corner in polygon {
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
        Some(Self { share, is_front, middle, nearest })
    }
}

/// A polygon that is being clipped, and room to do so without allocating.
#[derive(Debug, Default)]
pub(super) struct Clipper {
    polygon: Vec<Corner>,
    spare: Vec<Corner>,
}

impl Clipper {
    fn start(&mut self, corners: &[Corner]) {
        self.polygon.clear();
        self.polygon.extend(corners);
    }

    /// Cuts off the part of the polygon where `height`, which is linear, is below 0.
    fn clip(&mut self, height: impl Fn(Corner) -> f64) {
        let between =
            |p: Corner, q: Corner, share: f64| [0, 1, 2].map(|k| p[k] + share * (q[k] - p[k]));
        clip(&mut self.polygon, &mut self.spare, height, between);
    }

    /// What is left of the polygon.
    pub(super) fn polygon(&self) -> &[Corner] {
        &self.polygon
    }
}

/// Whether a polygon surely fills a rectangle: its edges, lengthened, pass by it and it holds the
/// middle.
pub(super) fn fills(polygon: &[Corner], rectangle: &Rectangle) -> bool {
    let Rectangle { low: [x0, y0], high: [x1, y1] } = *rectangle;
    let middle = [x0.midpoint(x1), y0.midpoint(y1)];
    let Some(mut a) = polygon.last() else { return false };
    for b in polygon {
        let (dx, dy) = (b[0] - a[0], b[1] - a[1]);
        let height = dx * (middle[1] - a[1]) - dy * (middle[0] - a[0]);
        let reach = dx.abs() * (y1 - y0) + dy.abs() * (x1 - x0);
        if 2.0 * height.abs() < reach {
            return false;
        }
        a = b;
    }
    contains(polygon, middle)
}

/// Whether a place lies in a polygon on the screen, convex or not. It does if a half-line from it
/// crosses an odd number of edges.
pub(super) fn contains(polygon: &[Corner], [x, y]: [f64; 2]) -> bool {
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
