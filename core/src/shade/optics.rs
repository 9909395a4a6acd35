//! Where mirrored and refracted light goes.

use glam::DVec3;

/// The direction of mirrored light; `cosine` is that between the normal and where it came from.
#[inline]
pub(crate) fn mirror(direction: DVec3, normal: DVec3, cosine: f64) -> DVec3 {
    let mirrored = direction + 2.0 * cosine * normal;
    mirrored / mirrored.length()
}

/// Finds the square of the cosine between the normal and the light behind a face with n1/n2 =
/// `ratio`, where `cosine` is that before it: Snell's law. It is below 0 on total reflection. The
/// sine is taken as (1 - c)(1 + c), which keeps its digits near the normal.
#[inline]
pub(super) fn squared_cosine_behind(cosine: f64, ratio: f64) -> f64 {
    1.0 - ratio * ratio * ((1.0 - cosine) * (1.0 + cosine))
}

/// Finds the unit direction of light behind a face with n1/n2 = `ratio`; `None` on total
/// reflection.
#[inline]
pub(crate) fn refract(direction: DVec3, normal: DVec3, cosine: f64, ratio: f64) -> Option<DVec3> {
    let square = squared_cosine_behind(cosine, ratio);
    (square >= 0.0).then(|| {
        let bent = ratio * direction + (ratio * cosine - square.sqrt()) * normal;
        bent / bent.length()
    })
}
