//! Directions of vectors of any length.

use glam::DVec3;

/// Gives the vector of length 1 along `vector`, however long that is.
pub(super) fn direction(vector: DVec3) -> DVec3 {
    let scaled = vector / vector.abs().max_element();
    scaled / scaled.length()
}
