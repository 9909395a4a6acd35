//! Answers that can be written down.
//!
//! The platform's sines and arcs are good enough here: no answer hangs on their last bits.

mod coverage;
mod light;
mod refraction;

pub use coverage::{
    Ellipse, area, clip_to_pixel, polygon_coverage, polygon_outline, sphere_outline, wave_mean,
};
pub use light::{
    integrating_sphere_bounce, irradiance, one_bounce_from_disc, patch_to_polygon, patch_to_sphere,
};
pub use refraction::{ball_deviation, slab_screen_radius, slab_shift};
