//! The faces of a block of pixels, pixel by pixel.

use super::outline::{Corner, Outline, Outlines};
use crate::tile::Area;

/// Room for rounding in the test of an edge, relative to its terms; rounding is 2^10 times finer.
const MARGIN: f64 = 1.0 / (1_u64 << 40) as f64;

/// Which of the outlines in a block's beam reach into which of its pixels.
#[derive(Debug, Default)]
pub(super) struct Bins {
    block: Option<Area>,
    /// For each pixel, row by row: the depth up to which faces count in it.
    deepest: Vec<f64>,
    /// For each pixel the indices of the outlines that count, in the order of the faces' ranks.
    faces: Vec<Vec<usize>>,
}

impl Bins {
    /// Begins with a block; `deepest` tells the depth up to which faces count in a pixel.
    pub(super) fn start(&mut self, block: Area, deepest: impl Fn(u32, u32) -> f64) {
        self.block = Some(block);
        self.deepest.clear();
        self.deepest.extend(block.pixels().map(|(x, y)| deepest(x, y)));
        let count = self.deepest.len();
        self.faces.resize_with(self.faces.len().max(count), Vec::new);
        self.faces[..count].iter_mut().for_each(Vec::clear);
    }

    /// The largest depth up to which faces count.
    pub(super) fn deepest(&self) -> f64 {
        self.deepest.iter().copied().fold(0.0, f64::max)
    }

    /// Sorts the outlines of the block's beam into the pixels.
    pub(super) fn fill(&mut self, outlines: &Outlines) {
        let Some(block) = self.block else { return };
        for index in outlines.by_rank() {
            let Outline { bounds, nearest, .. } = &outlines.as_slice()[index];
            // The pixels that an interval has a part of.
            let within = |axis: usize, start: u32, end: u32| {
                let first = (bounds.low[axis].max(f64::from(start))) as u32;
                let last = bounds.high[axis].min(f64::from(end)).ceil() as u32;
                first..last
            };
            let columns = within(0, block.columns().start, block.columns().end);
            let rows = within(1, block.rows().start, block.rows().end);
            let triangle = Triangle::new(outlines.corners_of(&outlines.as_slice()[index]))
                .filter(|_| columns.len() > 1 && rows.len() > 1);
            for y in rows {
                for x in columns.clone() {
                    let pixel = block.index_of(x, y) as usize;
                    let is_passed =
                        || triangle.as_ref().is_some_and(|triangle| triangle.surely_passes(x, y));
                    if *nearest <= self.deepest[pixel] && !is_passed() {
                        self.faces[pixel].push(index);
                    }
                }
            }
        }
    }

    /// The pixels, the depths up to which faces count in them, and these.
    pub(super) fn pixels(&self) -> impl Iterator<Item = ((u32, u32), f64, &[usize])> {
        let pixels = self.block.into_iter().flat_map(Area::pixels);
        let faces = self.faces.iter().map(Vec::as_slice);
        pixels
            .zip(&self.deepest)
            .zip(faces)
            .map(|((pixel, &deepest), faces)| (pixel, deepest, faces))
    }
}

/// A triangle's edges on the screen.
struct Triangle {
    /// Their starts, and their steps in the sense in which the triangle's inside is to their right.
    edges: [([f64; 2], [f64; 2]); 3],
}

impl Triangle {
    /// It is `None` for other polygons.
    fn new(corners: &[Corner]) -> Option<Self> {
        let &[a, b, c] = corners else { return None };
        let twice_area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]);
        let sign = 1.0_f64.copysign(twice_area);
        let edges = [(a, b), (b, c), (c, a)]
            .map(|(p, q)| ([p[0], p[1]], [sign * (q[0] - p[0]), sign * (q[1] - p[1])]));
        Some(Self { edges })
    }

    /// Whether a pixel surely lies beyond one of the edges.
    fn surely_passes(&self, x: u32, y: u32) -> bool {
        let (x, y) = (f64::from(x), f64::from(y));
        self.edges.iter().any(|&([from_x, from_y], [dx, dy])| {
            // Its first corner's height over the edge, and how much higher another one may be.
            let (p, q) = (dx * (y - from_y), dy * (x - from_x));
            let more = dx.max(0.0) + (-dy).max(0.0);
            p - q + more < -MARGIN * (p.abs() + q.abs() + more)
        })
    }
}
