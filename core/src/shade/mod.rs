//! What a surface looks like where a ray meets it.

pub(crate) mod chart;
pub(crate) mod optics;
pub(crate) mod point;
pub(crate) mod ray_differential;
pub(crate) mod texture;
