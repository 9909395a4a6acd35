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
        let volume = top_left.dot(right.cross(down));
        let inverse_rows = [right.cross(down), down.cross(top_left), top_left.cross(right)]
            .map(|row| row / volume);
        inverse_rows.iter().all(|row| row.is_finite()).then(|| Self {
            eye: DVec3::from_array(camera.eye),
            axes: [top_left, right, down],
            inverse_rows,
            pixel_side: right.length().max(down.length()),
        })
    }

    /// The eye, in the block's coordinates.
    pub(super) fn eye(&self) -> DVec3 {
        self.eye
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
}
