//! Frames, tiles and the order in which tiles are rendered.

use std::{fmt, ops::Range};

/// The size of a frame in pixels. Each side lies in `1..=Size::MAX_SIDE`, so that pixel
/// coordinates fit in 16 bits and pixel counts in 32.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Size {
    width: u32,
    height: u32,
}

/// A size that no frame can have.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("a picture is from 1x1 to {max}x{max} pixels, not {width}x{height}", max = Size::MAX_SIDE)]
pub struct SizeError {
    /// The width that was asked for, in pixels.
    pub width: u64,
    /// The height that was asked for, in pixels.
    pub height: u64,
}

impl Size {
    /// The longest side of a frame, in pixels.
    pub const MAX_SIDE: u32 = 65_535;

    /// Checks both sides against `1..=MAX_SIDE`.
    pub fn new(width: u64, height: u64) -> Result<Self, SizeError> {
        let sides = 1..=u64::from(Self::MAX_SIDE);
        if sides.contains(&width) && sides.contains(&height) {
            Ok(Self { width: width as u32, height: height as u32 })
        } else {
            Err(SizeError { width, height })
        }
    }

    /// Pixels in a row.
    pub fn width(self) -> u32 {
        self.width
    }

    /// Rows.
    pub fn height(self) -> u32 {
        self.height
    }

    /// Pixels in the whole frame; at most 65 535², which fits.
    pub fn pixel_count(self) -> u64 {
        u64::from(self.width) * u64::from(self.height)
    }
}

impl fmt::Display for Size {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}x{}", self.width, self.height)
    }
}

/// A rectangle of pixels of a frame, y downwards. It has at least one pixel and lies inside its
/// frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Area {
    frame: Size,
    x0: u32,
    y0: u32,
    width: u32,
    height: u32,
}

impl Area {
    /// The pixels `x0..x0 + width` of the rows `y0..y0 + height`; `None` where that is no pixel at
    /// all or where the frame does not have all of them.
    pub fn new(frame: Size, [x0, y0]: [u32; 2], [width, height]: [u32; 2]) -> Option<Self> {
        let is_within = |start: u32, length: u32, limit: u32| {
            length > 0 && start.checked_add(length).is_some_and(|end| end <= limit)
        };
        let is_inside = is_within(x0, width, frame.width) && is_within(y0, height, frame.height);
        is_inside.then_some(Self { frame, x0, y0, width, height })
    }

    /// The whole of a frame.
    pub fn whole(frame: Size) -> Self {
        Self { frame, x0: 0, y0: 0, width: frame.width, height: frame.height }
    }

    /// The frame that it is a part of.
    pub fn frame(self) -> Size {
        self.frame
    }

    /// Its size.
    pub fn size(self) -> Size {
        Size { width: self.width, height: self.height }
    }

    /// Whether all pixels of `other` are its own.
    pub fn has(self, other: Self) -> bool {
        let [columns, rows] = [self.columns(), self.rows()];
        self.frame == other.frame
            && columns.start <= other.x0
            && rows.start <= other.y0
            && other.columns().end <= columns.end
            && other.rows().end <= rows.end
    }

    /// The leftmost column.
    pub fn x0(self) -> u32 {
        self.x0
    }

    /// The topmost row.
    pub fn y0(self) -> u32 {
        self.y0
    }

    /// Columns, at least 1.
    pub fn width(self) -> u32 {
        self.width
    }

    /// Rows, at least 1.
    pub fn height(self) -> u32 {
        self.height
    }

    /// Pixels in the rectangle.
    pub fn pixel_count(self) -> usize {
        self.width as usize * self.height as usize
    }

    /// Its columns in the frame.
    pub fn columns(self) -> Range<u32> {
        self.x0..self.x0 + self.width
    }

    /// Its rows in the frame.
    pub fn rows(self) -> Range<u32> {
        self.y0..self.y0 + self.height
    }

    /// Its pixels (x, y) of the frame, row by row.
    pub fn pixels(self) -> impl Iterator<Item = (u32, u32)> {
        self.rows().flat_map(move |y| self.columns().map(move |x| (x, y)))
    }

    /// The pixel (x, y) of the frame, as its place among those of the area, row by row.
    pub fn index_of(self, x: u32, y: u32) -> u32 {
        (y - self.y0) * self.width + (x - self.x0)
    }

    /// The pixel (x, y) of the frame at a place among those of the area, row by row.
    pub fn pixel_at(self, index: u32) -> (u32, u32) {
        (self.x0 + index % self.width, self.y0 + index / self.width)
    }

    /// The area and the pixels around it that the frame has.
    pub(crate) fn with_rim(self) -> Self {
        let (x0, y0) = (self.x0.saturating_sub(1), self.y0.saturating_sub(1));
        let width = self.frame.width.min(self.x0 + self.width + 1) - x0;
        let height = self.frame.height.min(self.y0 + self.height + 1) - y0;
        Self { x0, y0, width, height, ..self }
    }

    /// The pixel (x, y) of the frame and those beside it that the area has, by their places in it.
    pub(crate) fn neighbours(self, x: u32, y: u32) -> impl Iterator<Item = u32> + Clone {
        let [columns, rows] = [(x, self.columns()), (y, self.rows())]
            .map(|(middle, all)| all.start.max(middle.saturating_sub(1))..all.end.min(middle + 2));
        rows.flat_map(move |y| columns.clone().map(move |x| self.index_of(x, y)))
    }

    /// Whether it has the pixel (x, y) of the frame.
    pub(crate) fn contains(self, x: u32, y: u32) -> bool {
        self.columns().contains(&x) && self.rows().contains(&y)
    }

    /// The squares of `side` pixels, as the frame is cut into them, that have pixels of the area.
    pub(crate) fn squares_of_frame(self, side: u32) -> impl Iterator<Item = Self> {
        let (x0, y0) = (self.x0 / side * side, self.y0 / side * side);
        let right = self.frame.width.min((self.x0 + self.width).next_multiple_of(side));
        let bottom = self.frame.height.min((self.y0 + self.height).next_multiple_of(side));
        Self { x0, y0, width: right - x0, height: bottom - y0, ..self }.blocks(side)
    }

    /// The pixels that it has in common with another area of the frame, row by row.
    pub(crate) fn common_pixels(self, other: Self) -> impl Iterator<Item = (u32, u32)> {
        self.pixels().filter(move |&(x, y)| other.contains(x, y))
    }

    /// The area cut into squares of `side` pixels, row by row; those at the right and bottom edge
    /// may be narrower.
    pub(crate) fn blocks(self, side: u32) -> impl Iterator<Item = Self> {
        (0..self.height).step_by(side as usize).flat_map(move |y| {
            (0..self.width).step_by(side as usize).map(move |x| Self {
                x0: self.x0 + x,
                y0: self.y0 + y,
                width: side.min(self.width - x),
                height: side.min(self.height - y),
                ..self
            })
        })
    }
}

impl From<Area> for Crop {
    fn from(area: Area) -> Self {
        Self { corner: [area.x0, area.y0], sides: [area.width, area.height] }
    }
}

impl From<Size> for Area {
    /// The whole of a frame.
    fn from(frame: Size) -> Self {
        Self::whole(frame)
    }
}

/// A rectangle of pixels of a frame that is not known yet, y downwards.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Crop {
    /// Its leftmost column and topmost row.
    pub corner: [u32; 2],
    /// Its columns and rows.
    pub sides: [u32; 2],
}

/// A crop window that the frame does not have.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("a frame of {frame} pixels does not have all of the crop window {crop}")]
pub struct CropError {
    crop: Crop,
    frame: Size,
}

impl Crop {
    /// Its pixels of `frame`; an error where the frame lacks some of them or it is empty.
    pub fn of(self, frame: Size) -> Result<Area, CropError> {
        Area::new(frame, self.corner, self.sides).ok_or(CropError { crop: self, frame })
    }
}

impl fmt::Display for Crop {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let ([x, y], [width, height]) = (self.corner, self.sides);
        write!(f, "{x},{y},{width},{height}")
    }
}

/// A tile of one frame, numbered row by row from the top left.
/// Only [`TileGrid`] makes one, so it always lies inside the frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct TileId(u32);

impl TileId {
    /// The tile's number, `0..grid.count()`.
    pub fn number(self) -> u32 {
        self.0
    }

    /// The tile's number as an index.
    pub fn index(self) -> usize {
        self.0 as usize
    }
}

/// The window of a frame that a picture shows, often the whole frame, cut into squares of one side;
/// those at the right and bottom edge may be narrower.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TileGrid {
    window: Area,
    side: u32,
}

/// A tile side that cannot be used.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("a tile's side is from {low} to {high} pixels, not {0}", low = TileGrid::SIDES.start(), high = TileGrid::SIDES.end())]
pub struct TileSideError(pub u64);

impl TileGrid {
    /// The sides that a tile may have, in pixels: below it the overhead of a tile dominates,
    /// above it a tile no longer fits a message.
    pub const SIDES: std::ops::RangeInclusive<u64> = 4..=1024;

    /// Cuts `window`, or the whole of a frame, into squares of `side` pixels.
    pub fn new(window: impl Into<Area>, side: u64) -> Result<Self, TileSideError> {
        if Self::SIDES.contains(&side) {
            Ok(Self { window: window.into(), side: side as u32 })
        } else {
            Err(TileSideError(side))
        }
    }

    /// Cuts `window`, or the whole of a frame, into tiles of the power of two from 16 to 256 that
    /// gives nearest to 1000.
    pub fn balanced(window: impl Into<Area>) -> Self {
        let window = window.into();
        [16, 32, 64, 128, 256]
            .map(|side| Self { window, side })
            .into_iter()
            .min_by_key(|grid| grid.count().abs_diff(1000))
            .expect("five sides were tried")
    }

    /// The same window in tiles of twice the side, unless they are above 64 pixels or fewer than
    /// 150 then: where first samples are taken around a tile, too, larger ones need fewer of them.
    #[must_use]
    pub fn with_less_rim(self) -> Self {
        let wider = Self { side: 2 * self.side, ..self };
        if wider.side <= 64 && wider.count() >= 150 { wider } else { self }
    }

    /// The pixels that are cut.
    pub fn window(self) -> Area {
        self.window
    }

    /// The side of a whole tile, in pixels.
    pub fn side(self) -> u32 {
        self.side
    }

    /// Tiles in a row.
    pub fn columns(self) -> u32 {
        self.window.width.div_ceil(self.side)
    }

    /// Rows of tiles.
    pub fn rows(self) -> u32 {
        self.window.height.div_ceil(self.side)
    }

    /// Tiles in the window. At most 16 384² for the smallest side, which fits.
    pub fn count(self) -> u32 {
        self.columns() * self.rows()
    }

    /// Turns a number from the wire into a tile; `None` when the window has no such tile.
    pub fn tile(self, number: u32) -> Option<TileId> {
        (number < self.count()).then_some(TileId(number))
    }

    /// The pixels of a tile.
    pub fn area(self, tile: TileId) -> Area {
        let (x, y) = (tile.0 % self.columns() * self.side, tile.0 / self.columns() * self.side);
        Area {
            frame: self.window.frame,
            x0: self.window.x0 + x,
            y0: self.window.y0 + y,
            width: self.side.min(self.window.width - x),
            height: self.side.min(self.window.height - y),
        }
    }

    /// All tiles in the order they are rendered in: square rings of 8 x 8 blocks from the middle
    /// out, where people look first, and along a Hilbert curve inside each block, so that
    /// neighbours in time are neighbours on the screen and share what the caches hold.
    pub fn render_order(self) -> Vec<TileId> {
        const BLOCK: u32 = 8;
        let (middle_x, middle_y) = (self.columns() / 2 / BLOCK, self.rows() / 2 / BLOCK);
        let mut keyed: Vec<((u32, u32), u32, TileId)> = (0..self.count())
            .map(|number| {
                let (x, y) = (number % self.columns(), number / self.columns());
                let (block_x, block_y) = (x / BLOCK, y / BLOCK);
                let ring = block_x.abs_diff(middle_x).max(block_y.abs_diff(middle_y));
                let block = block_y * self.columns().div_ceil(BLOCK) + block_x;
                ((ring, block), hilbert_index(BLOCK, x % BLOCK, y % BLOCK), TileId(number))
            })
            .collect();
        keyed.sort_unstable();
        keyed.into_iter().map(|(_, _, tile)| tile).collect()
    }
}

/// The place of cell (x, y) along the Hilbert curve that fills a square of `side` cells, a power
/// of two. Source: Hilbert, "Über die stetige Abbildung einer Linie auf ein Flächenstück" (1891).
fn hilbert_index(side: u32, mut x: u32, mut y: u32) -> u32 {
    let mut index = 0;
    let mut half = side / 2;
    while half > 0 {
        let (right, below) = (u32::from(x & half > 0), u32::from(y & half > 0));
        index += half * half * ((3 * right) ^ below);
        if below == 0 {
            if right == 1 {
                (x, y) = (side - 1 - x, side - 1 - y);
            }
            (x, y) = (y, x);
        }
        half /= 2;
    }
    index
}

#[cfg(test)]
mod tests {
    use super::*;

    fn grid(width: u64, height: u64, side: u64) -> TileGrid {
        TileGrid::new(Size::new(width, height).unwrap(), side).unwrap()
    }

    #[test]
    fn tiles_cover_every_pixel_once() {
        let grid = grid(101, 67, 16);
        let mut seen = vec![0; 101 * 67];
        for tile in grid.render_order() {
            let area = grid.area(tile);
            for (x, y) in area.pixels() {
                seen[(y * 101 + x) as usize] += 1;
            }
        }
        assert!(seen.iter().all(|&count| count == 1));
    }

    #[test]
    fn tiles_of_a_window_cover_it_and_no_more() {
        let frame = Size::new(101, 67).unwrap();
        let window = Area::new(frame, [13, 7], [40, 21]).unwrap();
        let grid = TileGrid::new(window, 16).unwrap();
        let tiles = (0..grid.count()).map(|number| grid.area(grid.tile(number).unwrap()));
        let mut pixels: Vec<(u32, u32)> = tiles.clone().flat_map(Area::pixels).collect();
        pixels.sort_unstable_by_key(|&(x, y)| (y, x));
        assert_eq!(pixels, window.pixels().collect::<Vec<_>>());
        assert!(tiles.clone().all(|area| window.has(area) && !area.has(window)));
        assert!(!window.has(Area::whole(frame)) && Area::whole(frame).has(window));
        assert!(!window.has(Area::whole(window.size())), "it is one of another frame");
    }

    #[test]
    fn neighbours_in_a_block_are_neighbours_on_the_screen() {
        let grid = grid(8 * 16, 8 * 16, 16);
        let order = grid.render_order();
        for pair in order.windows(2) {
            let [a, b] = [grid.area(pair[0]), grid.area(pair[1])];
            assert_eq!(a.x0.abs_diff(b.x0) + a.y0.abs_diff(b.y0), 16, "{a:?} then {b:?}");
        }
    }

    #[test]
    fn the_balanced_side_gives_nearest_to_a_thousand_tiles() {
        assert_eq!(TileGrid::balanced(Size::new(1280, 720).unwrap()).side(), 32);
        assert_eq!(TileGrid::balanced(Size::new(16_384, 16_384).unwrap()).side(), 256);
        assert_eq!(TileGrid::balanced(Size::new(1, 1).unwrap()).count(), 1);
    }

    #[test]
    fn sides_are_doubled_where_enough_tiles_are_left() {
        for (width, height, side) in
            [(1280, 720, 64), (640, 360, 32), (400, 300, 16), (1920, 1080, 64)]
        {
            let grid = TileGrid::balanced(Size::new(width, height).unwrap()).with_less_rim();
            assert_eq!(grid.side(), side, "{width}x{height}");
        }
    }

    #[test]
    fn an_area_lies_in_its_frame() {
        let frame = Size::new(10, 6).unwrap();
        assert_eq!(Area::new(frame, [0, 0], [10, 6]), Some(Area::whole(frame)));
        for (start, sides) in [
            ([0, 0], [11, 6]),
            ([0, 0], [10, 7]),
            ([9, 5], [2, 1]),
            ([10, 0], [1, 1]),
            ([0, 0], [0, 1]),
            ([0, 0], [1, 0]),
            ([1, 1], [u32::MAX, 1]),
        ] {
            assert_eq!(Area::new(frame, start, sides), None, "{start:?} {sides:?}");
        }
    }

    #[test]
    fn blocks_cover_an_area_once_and_its_rim_stays_in_the_frame() {
        let frame = Size::new(10, 6).unwrap();
        let area = Area::new(frame, [3, 1], [7, 5]).unwrap();
        let mut pixels: Vec<(u32, u32)> = area.blocks(4).flat_map(Area::pixels).collect();
        pixels.sort_unstable_by_key(|&(x, y)| (y, x));
        assert_eq!(pixels, area.pixels().collect::<Vec<_>>());
        assert_eq!(Some(area.with_rim()), Area::new(frame, [2, 0], [8, 6]));
        for (index, (x, y)) in (0..).zip(area.pixels()) {
            assert_eq!((area.index_of(x, y), area.pixel_at(index)), (index, (x, y)));
        }
    }

    #[test]
    fn sizes_out_of_range_are_refused() {
        for (width, height) in [(0, 1), (1, 0), (65_536, 1), (100_000, 100_000), (u64::MAX, 1)] {
            assert_eq!(Size::new(width, height), Err(SizeError { width, height }));
        }
        assert_eq!(Size::new(65_535, 65_535).unwrap().pixel_count(), 4_294_836_225);
    }
}
