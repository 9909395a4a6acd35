//! Whole trees of branches, for tests and reports.

use std::ops::ControlFlow;

use super::{Quality, RenderedTile, render};
use crate::{isa::Isa, prepared::PreparedScene, tile::Area};

/// Renders an area without roulette: every branch of at least the weight `cutoff` is followed and
/// lighter ones count as background. That is biased and may take for ever, but as chance has no
/// part in it, it can be held to a truth ray by ray.
pub fn render_trees<B: AsRef<[u8]>>(
    scene: &PreparedScene<B>,
    quality: &Quality,
    area: Area,
    isa: Isa,
    cutoff: f64,
) -> RenderedTile {
    let go_on = &mut || ControlFlow::Continue(());
    render(scene, quality, area, isa, Some(cutoff), go_on).expect("nobody stops it")
}
