//! Doors for tests, benchmarks and reports: no program that renders needs them.

pub use crate::{
    left_out::{BUILT_WITHOUT, FEATURES},
    prepare::prepare_with,
    render::trees::render_trees,
    trace::probe::{FaceTests, Probe, ProbeHit, Probing},
};
