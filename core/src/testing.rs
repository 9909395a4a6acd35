//! Doors for tests, benchmarks and reports: no program that renders needs them.

pub use crate::{
    left_out::{BUILT_WITHOUT, FEATURES},
    trace::probe::{FaceTests, Probe, ProbeHit, Probing},
};

use crate::{
    prepare::{PrepareError, prepare_with},
    prepared::PreparedBytes,
    scene::Scene,
};

/// Prepares a scene without records of its emitters, so that light that faces send on is looked for
/// over the whole hemisphere alone: the noisier way that benchmarks compare with.
pub fn prepare_without_emitter_records(scene: &Scene) -> Result<PreparedBytes, PrepareError> {
    prepare_with(scene, false)
}
