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

/// How large a ball is seen through a slab, both square to the same axis through the eye: the
/// radius of its outline at distance 1. `distance` is from the eye to the ball's middle, the slab
/// somewhere between them, `ratio` n1/n2 from outside to inside.
pub fn slab_screen_radius(distance: f64, radius: f64, thickness: f64, ratio: f64) -> f64 {
    let tangent = |sine: f64| sine / ((1.0 - sine) * (1.0 + sine)).sqrt();
    // How far from the ball's middle a ray passes: it grows with the angle.
    let miss = |sine: f64| {
        let aside = (distance - thickness) * tangent(sine) + thickness * tangent(ratio * sine);
        aside * ((1.0 - sine) * (1.0 + sine)).sqrt()
    };
    let (mut low, mut high) = (0.0, 1.0 - f64::EPSILON);
    for _ in 0..100 {
        let middle = f64::midpoint(low, high);
        if miss(middle) < radius { low = middle } else { high = middle }
    }
    tangent(low)
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
        // Without bending, the tangent of the angle whose sine is 3 / 5.
        assert!((slab_screen_radius(5.0, 3.0, 1.0, 1.0) - 0.75).abs() < 1e-15);
    }
}
