//! Yes or no about points, decided exactly: the sign of a determinant in floating point wherever
//! its error bound leaves no doubt, in whole numbers of any length otherwise. No scale is too
//! small or too large.
//!
//! They are written by hand, since packages of predicates decide orientation alone, and only where
//! no product under- or overflows. The whole numbers are num-bigint's. The oracle in the tests uses
//! dashu's instead, so that no mistake of one package can hide in both.
//!
//! Source of the bounds: Shewchuk, "Adaptive Precision Floating-Point Arithmetic and Fast Robust
//! Geometric Predicates" (1997), rounded up.

use std::cmp::Ordering;

use glam::{DVec2, DVec3};
use num_bigint::{BigInt, BigUint, Sign};

/// Half an ulp of 1.
const EPSILON: f64 = f64::EPSILON / 2.0;

/// A sum of products above this is so far from underflow that the lost bits cannot matter to the
/// bounds; below, whole numbers decide.
const SAFE: f64 = 1e-280;

/// Whether three points lie on one line, two equal ones included.
pub(crate) fn is_collinear(a: DVec3, b: DVec3, c: DVec3) -> bool {
    let (u, v) = (b - a, c - a);
    let is_certain = |p: f64, q: f64| {
        let sum = p.abs() + q.abs();
        (p - q).abs() > 4.0 * EPSILON * sum && sum > SAFE && sum.is_finite()
    };
    if is_certain(u.x * v.y, u.y * v.x)
        || is_certain(u.y * v.z, u.z * v.y)
        || is_certain(u.z * v.x, u.x * v.z)
    {
        return false;
    }
    if a == b || b == c || c == a {
        return true;
    }
    let [a, b, c] = whole([a, b, c]).0;
    cross(&less(&b, &a), &less(&c, &a)).iter().all(is_zero)
}

/// Whether four points lie in one plane.
pub(crate) fn is_coplanar(a: DVec3, b: DVec3, c: DVec3, d: DVec3) -> bool {
    let (u, v, w) = (b - a, c - a, d - a);
    let products = [
        u.x * (v.y * w.z),
        u.x * (v.z * w.y),
        u.y * (v.z * w.x),
        u.y * (v.x * w.z),
        u.z * (v.x * w.y),
        u.z * (v.y * w.x),
    ];
    let determinant =
        (products[0] - products[1]) + (products[2] - products[3]) + (products[4] - products[5]);
    let sum: f64 = products.iter().map(|product| product.abs()).sum();
    if determinant.abs() > 16.0 * EPSILON * sum && sum > SAFE && sum.is_finite() {
        return false;
    }
    let [a, b, c, d] = whole([a, b, c, d]).0;
    is_zero(&dot(&cross(&less(&b, &a), &less(&c, &a)), &less(&d, &a)))
}

/// Tells how a, b, c turn: `Greater` is counter-clockwise, `Equal` not at all.
fn turn(a: DVec2, b: DVec2, c: DVec2) -> Ordering {
    let (u, v) = (b - a, c - a);
    let (p, q) = (u.x * v.y, u.y * v.x);
    let sum = p.abs() + q.abs();
    if (p - q).abs() > 4.0 * EPSILON * sum && sum > SAFE && sum.is_finite() {
        return p.total_cmp(&q);
    }
    let [a, b, c] = whole([a, b, c].map(|point| point.extend(0.0))).0;
    let [.., z] = cross(&less(&b, &a), &less(&c, &a));
    z.cmp(&BigInt::ZERO)
}

/// Why four points are no quadrangle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum QuadrangleFault {
    /// All four are on one line.
    Degenerate,
    /// Two of them are equal.
    SamePlace,
    /// Two sides meet where they should not.
    Crossing,
    /// The corners are `deviation` away from their plane, more than the `tolerance`.
    NotPlanar {
        /// In scene units.
        deviation: f64,
        /// In scene units.
        tolerance: f64,
    },
}

/// Checks that the points are the corners of a simple, planar quadrangle. The answer is how far
/// they are from their plane when that is more than rounding explains.
pub(crate) fn check_quadrangle(corners: [DVec3; 4]) -> Result<Option<f64>, QuadrangleFault> {
    let triples = [[0, 1, 2], [1, 2, 3], [2, 3, 0], [3, 0, 1]].map(|t| t.map(|k| corners[k]));
    let pairs = [(0, 1), (1, 2), (2, 3), (3, 0), (0, 2), (1, 3)];
    if pairs.iter().any(|&(j, k)| corners[j] == corners[k]) {
        return Err(QuadrangleFault::SamePlace);
    }
    if triples.iter().all(|&[a, b, c]| is_collinear(a, b, c)) {
        return Err(QuadrangleFault::Degenerate);
    }

    // Powers of two keep every digit: now nothing overflows, and what underflows is beyond the
    // digits of the largest coordinate.
    let largest = corners.iter().map(|corner| corner.abs().max_element()).fold(0.0, f64::max);
    let shift = exponent(largest);
    let scaled = corners.map(|corner| corner.map(|number| scale_by_power(number, -shift)));
    // Newell's normal; of a quadrangle it is the cross product of the diagonals.
    let normal = (scaled[2] - scaled[0]).cross(scaled[3] - scaled[1]);
    if !is_simple(&corners, normal, &triples) {
        return Err(QuadrangleFault::Crossing);
    }

    let sides = [(0, 1), (1, 2), (2, 3), (3, 0)];
    let longest = sides.iter().map(|&(j, k)| scaled[k].distance(scaled[j])).fold(0.0, f64::max);
    let rounding = 8.0 * f64::EPSILON * 0.5; // ulps of a number in 0.5..1
    let tolerance = 1e-5 * longest + rounding;
    let deviation = deviation(&corners, &scaled, normal, shift, longest, rounding, tolerance);
    let in_scene_units = |length: f64| scale_by_power(length, shift);
    if deviation > tolerance {
        Err(QuadrangleFault::NotPlanar {
            deviation: in_scene_units(deviation),
            tolerance: in_scene_units(tolerance),
        })
    } else {
        Ok((deviation > rounding).then(|| in_scene_units(deviation)))
    }
}

/// Computes the distance of the corners, scaled by 2^-shift, from the plane of their Newell normal
/// through their mean. All four have the same: half the distance between the diagonals.
fn deviation(
    corners: &[DVec3; 4],
    scaled: &[DVec3; 4],
    normal: DVec3,
    shift: i32,
    longest: f64,
    rounding: f64,
    tolerance: f64,
) -> f64 {
    let length = normal.length();
    let rough = normal.dot(scaled[1] - scaled[0]).abs() / (2.0 * length);
    let doubt = 64.0 * EPSILON * longest * longest * longest / length;
    if rough + doubt <= rounding || (rough - doubt > rounding && rough + doubt <= tolerance) {
        return rough; // NaN and infinity fail both.
    }
    let ([a, b, c, d], unit) = whole(*corners);
    let normal = cross(&less(&c, &a), &less(&d, &b));
    let height = dot(&normal, &less(&b, &a));
    let square = ratio(height.magnitude().pow(2), dot(&normal, &normal).magnitude() << 2_u8);
    scale_by_power(square.sqrt(), unit - shift)
}

/// Whether no two sides meet but neighbours at their corner. Decided on the coordinate plane
/// that sees the most of the quadrangle.
fn is_simple(corners: &[DVec3; 4], normal: DVec3, triples: &[[DVec3; 3]; 4]) -> bool {
    let size = normal.abs();
    let mut axes = [0, 1, 2];
    axes.sort_by(|&j, &k| size[k].total_cmp(&size[j]));
    let is_flat = |axis: usize| {
        triples.iter().all(|triple| {
            let [a, b, c] = triple.map(|point| project(axis, point));
            turn(a, b, c) == Ordering::Equal
        })
    };
    let Some(axis) = axes.into_iter().find(|&axis| !is_flat(axis)) else { return false };
    let [a, b, c, d] = corners.map(|corner| project(axis, corner));
    let is_spike = |a: DVec2, b: DVec2, c: DVec2| {
        let is_beside = |p: f64, q: f64, r: f64| (p < q && r < q) || (p > q && r > q);
        turn(a, b, c) == Ordering::Equal && (is_beside(a.x, b.x, c.x) || is_beside(a.y, b.y, c.y))
    };
    !segments_touch([a, b], [c, d])
        && !segments_touch([b, c], [d, a])
        && ![[a, b, c], [b, c, d], [c, d, a], [d, a, b]].iter().any(|&[a, b, c]| is_spike(a, b, c))
}

/// Projects a point along a coordinate axis; counter-clockwise stays so.
pub(super) fn project(axis: usize, point: DVec3) -> DVec2 {
    match axis {
        0 => DVec2::new(point.y, point.z),
        1 => DVec2::new(point.z, point.x),
        _ => DVec2::new(point.x, point.y),
    }
}

/// Whether two segments have a point in common.
fn segments_touch([a, b]: [DVec2; 2], [c, d]: [DVec2; 2]) -> bool {
    let turns = [turn(a, b, c), turn(a, b, d), turn(c, d, a), turn(c, d, b)];
    if turns[0] != turns[1] && turns[2] != turns[3] {
        return true;
    }
    let is_within =
        |p: DVec2, [q, r]: [DVec2; 2]| p.cmpge(q.min(r)).all() && p.cmple(q.max(r)).all();
    (turns[0] == Ordering::Equal && is_within(c, [a, b]))
        || (turns[1] == Ordering::Equal && is_within(d, [a, b]))
        || (turns[2] == Ordering::Equal && is_within(a, [c, d]))
        || (turns[3] == Ordering::Equal && is_within(b, [c, d]))
}

/// A point in whole multiples of some power of two.
type Whole = [BigInt; 3];

/// Writes points as whole numbers of units of 2^exponent, and gives the exponent.
fn whole<const N: usize>(points: [DVec3; N]) -> ([Whole; N], i32) {
    let numbers = points.map(|point| point.to_array().map(decode));
    let unit = numbers
        .iter()
        .flatten()
        .filter(|(mantissa, _)| *mantissa != 0)
        .map(|&(_, exponent)| exponent)
        .min()
        .unwrap_or(0);
    let points = numbers.map(|point| {
        point.map(|(mantissa, exponent)| match mantissa {
            0 => BigInt::ZERO,
            _ => BigInt::from(mantissa) << (exponent - unit) as u32,
        })
    });
    (points, unit)
}

/// Splits `number` into mantissa · 2^exponent.
fn decode(number: f64) -> (i64, i32) {
    let bits = number.to_bits();
    let fraction = (bits & ((1 << 52) - 1)).cast_signed();
    let biased = (bits >> 52 & 0x7ff) as i32;
    let (mantissa, exponent) =
        if biased == 0 { (fraction, -1074) } else { (fraction | 1 << 52, biased - 1075) };
    let zeros = if mantissa == 0 { 0 } else { mantissa.trailing_zeros() };
    let mantissa = mantissa >> zeros;
    (if number.is_sign_negative() { -mantissa } else { mantissa }, exponent + zeros.cast_signed())
}

/// Finds the exponent that makes `number` · 2^-exponent lie in 0.5..1; it is 0 for zero.
pub(super) fn exponent(number: f64) -> i32 {
    let (mantissa, exponent) = decode(number);
    if mantissa == 0 {
        0
    } else {
        exponent + (64 - mantissa.unsigned_abs().leading_zeros().cast_signed())
    }
}

/// Multiplies `number` by 2^power.
pub(super) fn scale_by_power(mut number: f64, mut power: i32) -> f64 {
    const STEP: i32 = 1000;
    let power_of_two = |power: i32| f64::from_bits(((1023 + power) as u64) << 52);
    while power > STEP {
        number *= power_of_two(STEP);
        power -= STEP;
    }
    while power < -STEP {
        number *= power_of_two(-STEP);
        power += STEP;
    }
    number * power_of_two(power)
}

fn less(a: &Whole, b: &Whole) -> Whole {
    std::array::from_fn(|k| &a[k] - &b[k])
}

fn cross(a: &Whole, b: &Whole) -> Whole {
    let minor = |j: usize, k: usize| &a[j] * &b[k] - &a[k] * &b[j];
    [minor(1, 2), minor(2, 0), minor(0, 1)]
}

fn dot(a: &Whole, b: &Whole) -> BigInt {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

fn is_zero(number: &BigInt) -> bool {
    number.sign() == Sign::NoSign
}

/// Divides two whole numbers, to some 15 digits; a divisor of 0 gives infinity.
fn ratio(dividend: BigUint, divisor: BigUint) -> f64 {
    let leading = |number: BigUint| {
        let excess = number.bits().saturating_sub(64);
        let head = number >> excess;
        (head.iter_u64_digits().next().unwrap_or(0) as f64, excess.cast_signed())
    };
    let ((dividend, dividend_excess), (divisor, divisor_excess)) =
        (leading(dividend), leading(divisor));
    if dividend == 0.0 && divisor == 0.0 {
        return f64::INFINITY;
    }
    scale_by_power(dividend / divisor, (dividend_excess - divisor_excess) as i32)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn two_to(power: i32) -> f64 {
        scale_by_power(1.0, power)
    }

    fn check_quadrangle_at_all_scales(
        corners: [[f64; 3]; 4],
        expected: fn(&Result<Option<f64>, QuadrangleFault>) -> bool,
    ) {
        for scale in [1.0, 1e-300, 1e300, two_to(-1000), two_to(900)] {
            for turned in 0..4 {
                let corner = |k: usize| DVec3::from(corners[(k + turned) % 4]) * scale;
                let result = check_quadrangle([corner(0), corner(1), corner(2), corner(3)]);
                assert!(
                    expected(&result),
                    "{corners:?} turned {turned} scaled {scale:e}: {result:?}"
                );
            }
        }
    }

    #[test]
    fn collinearity_is_exact_at_any_scale() {
        let check = |points: [[f64; 3]; 3], expected: bool| {
            for scale in [1.0, two_to(-1060), two_to(1000)] {
                let [a, b, c] = points.map(|point| DVec3::from(point) * scale);
                assert_eq!(is_collinear(a, b, c), expected, "{points:?} {scale:e}");
            }
        };
        check([[0.0; 3], [1.0, 1.0, 1.0], [3.0, 3.0, 3.0]], true);
        check([[1.0, 2.0, 3.0], [1.0, 2.0, 3.0], [4.0, 0.0, 0.0]], true);
        check([[0.0; 3], [1.0, 0.0, 0.0], [2.0, 0.25, 0.0]], false);
        assert!(!is_collinear(DVec3::ZERO, DVec3::ONE, DVec3::new(2.0, 2.0, 2.0_f64.next_up())));
        assert!(!is_collinear(DVec3::ZERO, DVec3::X, DVec3::new(0.5, 5e-324, 0.0)));
        assert!(!is_collinear(
            DVec3::splat(-1e308),
            DVec3::splat(1e308),
            DVec3::new(1e308, 1e308, 0.0)
        ));
    }

    #[test]
    fn coplanarity_is_exact_at_any_scale() {
        for scale in [1.0, two_to(-1060), two_to(1000)] {
            let points = |z: f64| {
                [[1.0, 2.0, 3.0], [3.0, 3.0, 3.0], [5.0, 1.0, 3.0], [7.0, 4.0, z]]
                    .map(|point| DVec3::from(point) * scale)
            };
            let [a, b, c, d] = points(3.0);
            assert!(is_coplanar(a, b, c, d));
            let [a, b, c, d] = points(3.25);
            assert!(!is_coplanar(a, b, c, d));
        }
        assert!(!is_coplanar(DVec3::ZERO, DVec3::X, DVec3::Y, DVec3::new(3.0, 5.0, 5e-324)));
    }

    #[test]
    fn bounds_never_decide_what_whole_numbers_do_not() {
        // Source of the factor: Knuth, "The Art of Computer Programming", MMIX's generator.
        let mut state = 3_u64;
        let mut random = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            (state >> 11) as f64 / 2.0_f64.powi(53) - 0.5
        };
        let (mut flat, mut solid) = (0, 0);
        for round in 0..20_000 {
            let [a, u, v] = [(); 3].map(|()| DVec3::new(random(), random(), random()));
            // Almost on the line and in the plane, and sometimes exactly.
            let size = two_to(-10 * (round % 7));
            let on_line = a + random() * u * size;
            let in_plane = a + (random() * u + random() * v) * size;
            let [p, q, r] = whole([a, a + u, on_line]).0;
            let exactly = cross(&less(&q, &p), &less(&r, &p)).iter().all(is_zero);
            assert_eq!(is_collinear(a, a + u, on_line), exactly);
            let [p, q, r, s] = whole([a, a + u, a + v, in_plane]).0;
            let exactly = is_zero(&dot(&cross(&less(&q, &p), &less(&r, &p)), &less(&s, &p)));
            assert_eq!(is_coplanar(a, a + u, a + v, in_plane), exactly);
            flat += usize::from(exactly);
            solid += usize::from(!exactly);
        }
        assert!(flat > 0 && solid > 0, "{flat} {solid}");
    }

    #[test]
    fn simple_quadrangles_pass_at_any_scale() {
        for corners in [
            [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]],
            [[0.0, 0.0, 1.0], [4.0, 0.0, 1.0], [1.0, 1.0, 1.0], [0.0, 4.0, 1.0]],
            [[0.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 2.0, 0.0], [0.0, 1.0, 1.0]],
            [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, two_to(-40), 0.0], [0.0, two_to(-40), 0.0]],
        ] {
            check_quadrangle_at_all_scales(corners, |result| *result == Ok(None));
        }
    }

    #[test]
    fn sides_that_meet_are_found() {
        for corners in [
            [[0.0, 0.0, 0.0], [1.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]],
            [[0.0, 0.0, 0.0], [2.0, 2.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]],
            [[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0]],
            [[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [2.0, 1.0, 0.0], [1.0, 0.0, 0.0]],
        ] {
            check_quadrangle_at_all_scales(corners, |result| {
                *result == Err(QuadrangleFault::Crossing)
            });
        }
    }

    #[test]
    fn flat_quadrangles_are_degenerate() {
        let on_a_line = [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0], [2.0, 2.0, 2.0], [3.0, 3.0, 3.0]];
        check_quadrangle_at_all_scales(on_a_line, |result| {
            *result == Err(QuadrangleFault::Degenerate)
        });
        for corners in [
            [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]],
            [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 1.0, 0.0]],
        ] {
            check_quadrangle_at_all_scales(corners, |result| {
                *result == Err(QuadrangleFault::SamePlace)
            });
        }
    }

    #[test]
    fn bent_quadrangles_are_measured_at_any_scale() {
        let bent = |z: f64| [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, z], [0.0, 1.0, 0.0]];
        check_quadrangle_at_all_scales(bent(two_to(-14)), |result| {
            matches!(result, Err(QuadrangleFault::NotPlanar { .. }))
        });
        check_quadrangle_at_all_scales(bent(two_to(-20)), |result| matches!(result, Ok(Some(_))));
        check_quadrangle_at_all_scales(bent(two_to(-51)), |result| *result == Ok(None));
        let unit = check_quadrangle(bent(two_to(-20)).map(DVec3::from)).unwrap().unwrap();
        assert!(
            (unit / two_to(-22) - 1.0).abs() < 1e-9,
            "a quarter of the fourth corner's height: {unit:e}"
        );
    }
}
