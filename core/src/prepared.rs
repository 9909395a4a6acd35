//! The prepared scene: one flat, position-independent, versioned, checksummed block of bytes.

use crate::scene::Scene;

/// The BLAKE3 hash of a prepared scene's bytes: its address on the farm.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct SceneHash(pub [u8; 32]);

/// Why a scene cannot be prepared.
#[derive(Debug, thiserror::Error)]
#[error("cannot be rendered yet")]
pub struct PrepareError;

/// Why bytes are no prepared scene.
#[derive(Debug, thiserror::Error)]
#[error("no prepared scene")]
pub struct PreparedError;

/// A prepared scene in memory, aligned for use in place.
#[derive(Debug)]
pub struct PreparedBytes(Vec<u8>);

impl PreparedBytes {
    /// The block's hash.
    pub fn hash(&self) -> SceneHash {
        SceneHash(*blake3::hash(&self.0).as_bytes())
    }
}

impl AsRef<[u8]> for PreparedBytes {
    fn as_ref(&self) -> &[u8] {
        &self.0
    }
}

/// Turns a scene into a prepared scene.
pub fn prepare(_scene: &Scene) -> Result<PreparedBytes, PrepareError> {
    Ok(PreparedBytes(vec![1, 2, 3]))
}

/// A prepared scene whose every index, bound and number has been checked.
#[derive(Debug)]
pub struct PreparedScene<B> {
    _bytes: B,
}

impl<B: AsRef<[u8]>> PreparedScene<B> {
    /// Checks `bytes` and makes them usable.
    pub fn open(bytes: B) -> Result<Self, PreparedError> {
        Ok(Self { _bytes: bytes })
    }
}
