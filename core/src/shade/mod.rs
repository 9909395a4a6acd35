//! What a surface looks like where a ray meets it.

mod chart;
pub(crate) mod optics;
pub(crate) mod point;
pub(crate) mod ray_differential;
mod texture;
