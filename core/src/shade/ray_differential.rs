//! Ray differentials tell how far apart neighbouring samples' rays are, on their way through the
//! scene.
//!
//! Source: Igehy, "Tracing Ray Differentials" (1999).

use glam::DVec3;

use super::optics::squared_cosine_behind;

/// The derivatives of a ray by its sample's place on the screen, first across and then down. A step
/// of 1 is the width of the square that belongs to one sample.
#[derive(Debug, Clone, Copy)]
pub(crate) struct RayDifferential {
    /// The derivatives of the ray's origin, in the block's units. After
    /// [`RayDifferential::transfer`] they lie in the surface.
    pub(super) origin: [DVec3; 2],
    /// The derivatives of the ray's unit direction.
    direction: [DVec3; 2],
}

/// The part of a flat face that belongs to a sample. Its ray at (s, t), each in -1/2..=1/2, meets
/// the face at the middle + (s · first side + t · second side) / (1 + s · first taper + t · second
/// taper).
#[derive(Debug, Clone, Copy)]
pub(crate) struct SurfaceFootprint {
    /// The sides, in the block's units.
    pub(super) sides: [DVec3; 2],
    /// The changes of the denominator by s and by t: they draw the far end out.
    pub(super) tapers: [f64; 2],
}

impl SurfaceFootprint {
    /// A single point.
    pub(crate) const POINT: Self = Self { sides: [DVec3::ZERO; 2], tapers: [0.0; 2] };
}

impl RayDifferential {
    /// Makes that of a camera ray towards `target`, relative to the eye, which a sample's `steps`
    /// across and down the screen move.
    pub(crate) fn of_camera(target: DVec3, steps: [DVec3; 2]) -> Self {
        let length = target.length();
        let direction = target / length;
        let turn = |step: DVec3| (step - direction * direction.dot(step)) / length;
        Self { origin: [DVec3::ZERO; 2], direction: steps.map(turn) }
    }

    /// Moves it to where the ray along `direction` has met a surface at the distance `t`. It is not
    /// finite for a ray along the surface.
    pub(crate) fn transfer(&self, direction: DVec3, t: f64, normal: DVec3) -> Self {
        let origin = [0, 1].map(|k| {
            let moved = self.origin[k] + t * self.direction[k];
            moved - (moved.dot(normal) / direction.dot(normal)) * direction
        });
        Self { origin, ..*self }
    }

    /// The part that the sample sees of a flat face, which a ray along `direction` has just met.
    pub(crate) fn footprint(&self, direction: DVec3, normal: DVec3) -> SurfaceFootprint {
        let tapers = self.direction.map(|step| step.dot(normal) / direction.dot(normal));
        SurfaceFootprint { sides: self.origin, tapers }
    }

    /// Mirrors it: `direction` came in, towards the side of the unit `normal`, and a step along the
    /// surface turns the normal by `curvature` times the step.
    pub(crate) fn mirror(&self, direction: DVec3, normal: DVec3, curvature: f64) -> Self {
        let cosine = -direction.dot(normal);
        self.turn(direction, normal, curvature, [1.0, 2.0 * cosine, 2.0])
    }

    /// Refracts it by n1/n2 = `ratio`, above 0; see [`RayDifferential::mirror`]. It is not finite
    /// at the critical angle.
    pub(crate) fn refract(
        &self,
        direction: DVec3,
        normal: DVec3,
        curvature: f64,
        ratio: f64,
    ) -> Self {
        let cosine = -direction.dot(normal);
        let cosine_behind = squared_cosine_behind(cosine, ratio).sqrt();
        let slope = ratio - ratio * ratio * cosine / cosine_behind;
        self.turn(direction, normal, curvature, [ratio, ratio * cosine - cosine_behind, slope])
    }

    /// Turns the direction: the new one is `kept` times the old one and `added` times the normal.
    /// `slope` is the derivative of `added` by the cosine between the normal and where the ray came
    /// from.
    fn turn(
        &self,
        direction: DVec3,
        normal: DVec3,
        curvature: f64,
        [kept, added, slope]: [f64; 3],
    ) -> Self {
        let directions = [0, 1].map(|k| {
            let normal_step = curvature * self.origin[k];
            let cosine_step = -(self.direction[k].dot(normal) + direction.dot(normal_step));
            kept * self.direction[k] + added * normal_step + (slope * cosine_step) * normal
        });
        Self { direction: directions, ..*self }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A bundle of rays from (x, y) on a screen onto a unit sphere at the origin, or the plane
    /// z = 1: where one meets it, and its direction after.
    fn follow(x: f64, y: f64, is_round: bool, ratio: Option<f64>) -> (DVec3, DVec3) {
        let eye = DVec3::new(0.3, -0.2, 4.0);
        let direction = (DVec3::new(x, y, -1.0)).normalize();
        let t = if is_round {
            let half_b = eye.dot(direction);
            -half_b - (half_b * half_b - eye.length_squared() + 1.0).sqrt()
        } else {
            (1.0 - eye.z) / direction.z
        };
        let point = eye + t * direction;
        let normal = if is_round { point } else { DVec3::Z };
        let cosine = -direction.dot(normal);
        let after = match ratio {
            None => direction + 2.0 * cosine * normal,
            Some(ratio) => {
                let behind = (1.0 - ratio * ratio * (1.0 - cosine * cosine)).sqrt();
                ratio * direction + (ratio * cosine - behind) * normal
            }
        };
        (point, after)
    }

    #[test]
    fn it_is_the_difference_of_neighbouring_rays() {
        let (x, y, step) = (0.03, 0.1, 1e-5);
        for is_round in [false, true] {
            for ratio in [None, Some(0.7), Some(1.4)] {
                let (point, after) = follow(x, y, is_round, ratio);
                let target = DVec3::new(x, y, -1.0);
                let eye = DVec3::new(0.3, -0.2, 4.0);
                let direction = target.normalize();
                let (normal, curvature) = if is_round { (point, 1.0) } else { (DVec3::Z, 0.0) };
                let met = RayDifferential::of_camera(target, [DVec3::X, DVec3::Y]).transfer(
                    direction,
                    (point - eye).length(),
                    normal,
                );
                let turned = match ratio {
                    None => met.mirror(direction, normal, curvature),
                    Some(ratio) => met.refract(direction, normal, curvature, ratio),
                };
                for (k, [dx, dy]) in [[step, 0.0], [0.0, step]].into_iter().enumerate() {
                    let ahead = follow(x + dx, y + dy, is_round, ratio);
                    let behind = follow(x - dx, y - dy, is_round, ratio);
                    let points = (ahead.0 - behind.0) / (2.0 * step);
                    let directions = (ahead.1 - behind.1) / (2.0 * step);
                    let off = (turned.origin[k] - points)
                        .length()
                        .max((turned.direction[k] - directions).length());
                    assert!(off < 1e-7, "{is_round} {ratio:?} {k}: {off:e}, {after}");
                }
            }
        }
    }

    #[test]
    fn a_footprint_reaches_to_the_horizon_as_rays_do() {
        // A floor one below the eye, seen from 2 to 3 hundredths below the horizon.
        let (normal, target) = (DVec3::Y, DVec3::new(0.3, -0.025, -1.0));
        let steps = [DVec3::X * 0.01, DVec3::Y * 0.01];
        let met = |target: DVec3| target / -target.y;
        let (direction, t) = (target.normalize(), met(target).length());
        let differential = RayDifferential::of_camera(target, steps).transfer(direction, t, normal);
        let SurfaceFootprint { sides, tapers } = differential.footprint(direction, normal);
        for (s, t) in [(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5), (0.0, 0.5), (0.2, -0.1)]
        {
            let truth = met(target + s * steps[0] + t * steps[1]) - met(target);
            let found = (s * sides[0] + t * sides[1]) / (1.0 + s * tapers[0] + t * tapers[1]);
            let off = (found - truth).length() / truth.length();
            assert!(off < 0.005, "{s} {t}: {found}, not {truth}");
        }
    }
}
