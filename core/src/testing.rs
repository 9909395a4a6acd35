//! Doors for tests, benchmarks and reports: no program that renders needs them.

pub use crate::{
    left_out::{BUILT_WITHOUT, FEATURES},
    prepare::{hierarchy_of, prepare_with},
    render::trees::render_trees,
    trace::{
        probe::{FaceTests, Probe, ProbeHit, Probing},
        timed::TimedKernels,
    },
};
