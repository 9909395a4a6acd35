//! The faces of a block of pixels, pixel by pixel.

use super::outline::{Outline, Outlines};
use crate::tile::Area;

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
            for y in within(1, block.rows().start, block.rows().end) {
                for x in columns.clone() {
                    let pixel = block.index_of(x, y) as usize;
                    if *nearest <= self.deepest[pixel] {
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
