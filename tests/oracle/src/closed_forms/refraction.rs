//! Where glass sends light.

#![expect(clippy::disallowed_methods, reason = "an arc's last bits decide nothing")]

/// How far a slab of this thickness moves a ray sideways. `angle` is that to its normal, in
/// radians, `ratio` n1/n2 from outside to inside.
pub fn slab_shift(thickness: f64, angle: f64, ratio: f64) -> f64 {
    let inside = (ratio * angle.sin()).asin();
    thickness * (angle - inside).sin() / inside.cos()
}

/// By how much a ball turns a ray that meets it at this angle to its normal, both in radians, if
/// the ray passes straight through it.
pub fn ball_deviation(angle: f64, ratio: f64) -> f64 {
    2.0 * (angle - (ratio * angle.sin()).asin())
}

#[cfg(test)]
mod tests {
    use std::f64::consts::FRAC_PI_3;

    use super::*;

    #[test]
    fn known_angles_give_known_answers() {
        // From 60° to 30° in a medium of √3.
        let ratio = 1.0 / 3f64.sqrt();
        assert!((ball_deviation(FRAC_PI_3, ratio) - FRAC_PI_3).abs() < 1e-15);
        // sin 30° / cos 30°.
        assert!((slab_shift(1.0, FRAC_PI_3, ratio) - ratio).abs() < 1e-15);
        assert_eq!(slab_shift(1.0, 0.7, 1.0), 0.0);
    }
}
