//! The screen: points of the scene have a place in pixels and a depth on it.

use glam::DVec3;

use crate::{
    prepared::record::Camera,
    tile::{Area, Size},
};

/// The screen as the eye sees it. Points are relative to the eye, in the block's units; places are
/// in pixels from the frame's top left corner, y downwards; depths are 1 on the screen.
#[derive(Debug, Clone, Copy)]
pub(super) struct Screen {
    eye: DVec3,
    /// From the eye to the frame's top left corner, a pixel's step to the right, and one down.
    axes: [DVec3; 3],
    /// The inverse of `axes`, row by row: they turn a point into its depth, and into its column and
    /// its row times the depth.
    inverse_rows: [DVec3; 3],
    /// A pixel's longer side at depth 1.
    pixel_side: f64,
}

impl Screen {
    /// Makes the screen of a camera; `None` where it is seen edge-on, so that a pixel has no beam.
    pub(super) fn new(camera: &Camera, size: Size) -> Option<Self> {
        let top_left = DVec3::from_array(camera.top_left);
        let right = DVec3::from_array(camera.right) / f64::from(size.width());
        let down = DVec3::from_array(camera.down) / f64::from(size.height());
        Self::with_axes(DVec3::from_array(camera.eye), [top_left, right, down])
    }

    fn with_axes(eye: DVec3, axes: [DVec3; 3]) -> Option<Self> {
        let [top_left, right, down] = axes;
        let volume = top_left.dot(right.cross(down));
        let inverse_rows = [right.cross(down), down.cross(top_left), top_left.cross(right)]
            .map(|row| row / volume);
        let pixel_side = right.length().max(down.length());
        let is_finite = inverse_rows.iter().all(|row| row.is_finite());
        is_finite.then_some(Self { eye, axes, inverse_rows, pixel_side })
    }

    /// The same pixels of a flat surface as a light at `position` sees them: places and the
    /// surface's depths are those on this screen.
    pub(super) fn seen_by_light(&self, sheet: &Sheet, position: DVec3) -> Option<Self> {
        let away = self.eye - position;
        let axes = [0, 1, 2].map(|k| self.axes[k] + sheet.inverse_depth[k] * away);
        Self::with_axes(position, axes)
    }

    /// What is seen in a flat surface as if it were a window.
    pub(super) fn mirrored(&self, sheet: &Sheet) -> Option<Self> {
        let normal = sheet.normal;
        let eye = self.eye + 2.0 * sheet.distance * normal;
        Self::with_axes(eye, self.axes.map(|axis| axis - 2.0 * normal.dot(axis) * normal))
    }

    /// The eye, in the block's coordinates.
    pub(super) fn eye(&self) -> DVec3 {
        self.eye
    }

    /// From the eye to the frame's top left corner, a pixel's step to the right, and one down.
    pub(super) fn axes(&self) -> [DVec3; 3] {
        self.axes
    }

    /// The rows that turn a point into its depth, and into its column and its row times the depth.
    pub(super) fn inverse_rows(&self) -> [DVec3; 3] {
        self.inverse_rows
    }

    /// The vector from the eye to a place on the screen, at depth 1.
    pub(super) fn direction(&self, [x, y]: [f64; 2]) -> DVec3 {
        self.axes[0] + x * self.axes[1] + y * self.axes[2]
    }

    /// The vector from the eye through the middle of a pixel, at depth 1.
    pub(super) fn pixel_direction(&self, x: u32, y: u32) -> DVec3 {
        self.direction([f64::from(x) + 0.5, f64::from(y) + 0.5])
    }

    /// The point at a place with an inverse depth.
    pub(super) fn point(&self, [x, y, inverse_depth]: [f64; 3]) -> DVec3 {
        self.direction([x, y]) / inverse_depth
    }

    /// The depth of a point.
    pub(super) fn depth(&self, point: DVec3) -> f64 {
        self.inverse_rows[0].dot(point)
    }

    /// A pixel's longer side at depth 1, in the block's units; at another depth it grows with it.
    pub(super) fn pixel_side(&self) -> f64 {
        self.pixel_side
    }
}

/// A flat surface as a screen sees it.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sheet {
    /// Its unit normal, to either side.
    pub(super) normal: DVec3,
    /// How far it is from the origin of the block's coordinates along `normal`, and from the eye.
    height: f64,
    distance: f64,
    /// Its inverse depth at the frame's top left corner, and how that grows with a pixel to the
    /// right and one down.
    inverse_depth: [f64; 3],
}

/// Faces begin this share of their depth before or behind a surface.
const CLEARANCE: f64 = 1e-9;

/// With this clearance they surely do, although polygons are flat only within rounding.
const SURE_CLEARANCE: f64 = 1.0 / 1024.0;

impl Sheet {
    /// The plane through a point; `None` where the eye is in it.
    pub(super) fn new(screen: &Screen, point: DVec3, normal: DVec3) -> Option<Self> {
        let (height, distance) = (normal.dot(point), normal.dot(point - screen.eye));
        let inverse_depth = screen.axes.map(|axis| normal.dot(axis) / distance);
        let is_finite = inverse_depth.iter().all(|depth| depth.is_finite());
        is_finite.then_some(Self { normal, height, distance, inverse_depth })
    }

    /// Its inverse depth at a place on the screen.
    pub(super) fn inverse_depth(&self, [x, y]: [f64; 2]) -> f64 {
        let [corner, across, down] = self.inverse_depth;
        corner + x * across + y * down
    }

    /// Whether a point is on the side that the eye sees.
    pub(super) fn is_before(&self, point: DVec3) -> bool {
        (self.height - self.normal.dot(point)) * self.distance > 0.0
    }
}

/// Which faces in a beam count.
#[derive(Debug, Clone, Copy)]
pub(super) enum Reach {
    /// All of them.
    Whole,
    /// What of them is before a surface.
    Before(Sheet),
    /// What of them is behind one.
    Behind(Sheet),
}

impl Reach {
    /// How far within reach a corner on the screen is; below 0 it is not.
    pub(super) fn height(&self, [x, y, inverse_depth]: [f64; 3]) -> f64 {
        match self {
            Self::Whole => 0.0,
            Self::Before(sheet) => inverse_depth - sheet.inverse_depth([x, y]) * (1.0 + CLEARANCE),
            Self::Behind(sheet) => sheet.inverse_depth([x, y]) * (1.0 - CLEARANCE) - inverse_depth,
        }
    }

    /// Whether all of a flat polygon, by its corners relative to the eye, that is in a rectangle of
    /// the screen is surely out of reach.
    pub(super) fn surely_misses(
        &self,
        screen: &Screen,
        corners: &[DVec3],
        rectangle: &Rectangle,
    ) -> bool {
        let (&[a, b, c, ..], Self::Before(sheet) | Self::Behind(sheet)) = (corners, self) else {
            return false;
        };
        let normal = (b - a).cross(c - a);
        let Some(own) = Sheet::new(screen, a + screen.eye, normal) else { return false };
        rectangle.corners().iter().all(|&corner| {
            let (own, sheet) = (own.inverse_depth(corner), sheet.inverse_depth(corner));
            let room = SURE_CLEARANCE * (own.abs() + sheet.abs());
            if matches!(self, Self::Before(_)) { own + room < sheet } else { own - room > sheet }
        })
    }

    /// The same times the depth, as a sum over the depth and the place times the depth, and what is
    /// added to it: `None` where all is within reach.
    pub(super) fn factors(&self) -> Option<([f64; 3], f64)> {
        let times = |sheet: &Sheet, factor: f64| sheet.inverse_depth.map(|depth| depth * factor);
        match self {
            Self::Whole => None,
            Self::Before(sheet) => Some((times(sheet, -1.0 - CLEARANCE), 1.0)),
            Self::Behind(sheet) => Some((times(sheet, 1.0 - CLEARANCE), -1.0)),
        }
    }
}

/// A rectangle on the screen, in pixels: from the lowest (x, y) to the highest.
#[derive(Debug, Clone, Copy)]
pub(super) struct Rectangle {
    pub(super) low: [f64; 2],
    pub(super) high: [f64; 2],
}

impl Rectangle {
    /// The smallest rectangle around places that are yet to be added.
    pub(super) const EMPTY: Self = Self { low: [f64::INFINITY; 2], high: [f64::NEG_INFINITY; 2] };

    /// The rectangle of a block of pixels.
    pub(super) fn of_block(block: Area) -> Self {
        let (columns, rows) = (block.columns(), block.rows());
        Self {
            low: [columns.start.into(), rows.start.into()],
            high: [columns.end.into(), rows.end.into()],
        }
    }

    /// The square of a pixel.
    pub(super) fn of_pixel(x: u32, y: u32) -> Self {
        Self { low: [x.into(), y.into()], high: [(x + 1).into(), (y + 1).into()] }
    }

    /// Its corners.
    fn corners(&self) -> [[f64; 2]; 4] {
        let Self { low: [x0, y0], high: [x1, y1] } = *self;
        [[x0, y0], [x0, y1], [x1, y0], [x1, y1]]
    }

    /// Grows to hold a place.
    pub(super) fn add(&mut self, [x, y]: [f64; 2]) {
        self.low = [self.low[0].min(x), self.low[1].min(y)];
        self.high = [self.high[0].max(x), self.high[1].max(y)];
    }

    /// Whether the insides of both have places in common.
    pub(super) fn overlaps(&self, other: &Self) -> bool {
        (0..2).all(|axis| self.low[axis] < other.high[axis] && self.high[axis] > other.low[axis])
    }

    /// The area, in square pixels, that both have in common, if they overlap.
    pub(super) fn common_area(&self, other: &Self) -> f64 {
        let length = |axis: usize| {
            self.high[axis].min(other.high[axis]) - self.low[axis].max(other.low[axis])
        };
        length(0) * length(1)
    }
}

/// The beam of all rays through a block of pixels, up to a depth.
///
/// Source: Heckbert & Hanrahan, "Beam Tracing Polygonal Objects" (1984).
#[derive(Debug, Clone, Copy)]
pub(super) struct Beam {
    pub(super) block: Rectangle,
    /// Faces that begin at a larger depth do not count.
    pub(super) deepest: f64,
    /// Nor do faces that are out of reach as a whole.
    pub(super) reach: Reach,
}

impl Beam {
    /// A beam up to a surface.
    pub(super) fn before(sheet: &Sheet, block: Rectangle) -> Self {
        let least = block
            .corners()
            .map(|corner| sheet.inverse_depth(corner))
            .into_iter()
            .fold(f64::INFINITY, f64::min);
        let deepest = if least > 0.0 { 1.0 / least } else { f64::INFINITY };
        Self { block, deepest, reach: Reach::Before(*sheet) }
    }
}
