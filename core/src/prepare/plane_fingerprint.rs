//! Numbers that tell planes apart, exactly.

use glam::DVec3;
use rayon::prelude::*;

/// A number that planes have in common exactly when they are the same plane, whichever points
/// they are given by and whichever way they face.
///
/// Coordinates are m · 2^e, so the plane's equation is computed without rounding modulo the prime
/// 2^61 - 1, in which powers of two are rotations, and scaled to a leading 1. Different planes
/// agree with a probability of 2^-61. `None` for points on one line.
pub(super) fn plane_fingerprints(
    faces: usize,
    corners: impl Fn(usize) -> [DVec3; 3] + Sync,
) -> Vec<Option<u64>> {
    const RUN: usize = 256;
    let mut fingerprints = vec![None; faces];
    fingerprints.par_chunks_mut(RUN).enumerate().for_each(|(run, fingerprints)| {
        // One inversion serves a whole run: Montgomery, "Speeding the Pollard and Elliptic Curve
        // Methods of Factorization" (1987).
        let mut equations = [[0; 4]; RUN];
        let mut products = [1; RUN];
        let mut product = 1;
        for k in 0..fingerprints.len() {
            equations[k] = equation(corners(run * RUN + k));
            products[k] = product;
            if let Some(leading) = leading(&equations[k]) {
                product = times(product, leading);
            }
        }
        let mut inverse = power(product, PRIME - 2);
        for k in (0..fingerprints.len()).rev() {
            let Some(leading) = leading(&equations[k]) else { continue };
            let scale = times(inverse, products[k]);
            inverse = times(inverse, leading);
            let [a, b, c, d] = equations[k].map(|term| times(term, scale));
            // Any fixed odd multipliers: two different quadruples rarely agree.
            fingerprints[k] = Some([b, c, d].into_iter().fold(a, |fingerprint: u64, term| {
                (fingerprint.rotate_left(23) ^ term).wrapping_mul(0x9E37_79B9_7F4A_7C15)
            }));
        }
    });
    fingerprints
}

const PRIME: u64 = (1 << 61) - 1;

/// a x + b y + c z = d with (a, b, c) the cross product of two edges.
fn equation([p, q, r]: [DVec3; 3]) -> [u64; 4] {
    let [p, q, r] = [p, q, r].map(|corner| corner.to_array().map(residue));
    let along = |to: [u64; 3]| [0, 1, 2].map(|axis| minus(to[axis], p[axis]));
    let (u, v) = (along(q), along(r));
    let cross = |i: usize, j: usize| minus(times(u[i], v[j]), times(u[j], v[i]));
    let normal = [cross(1, 2), cross(2, 0), cross(0, 1)];
    let d = (0..3).fold(0, |sum, axis| plus(sum, times(normal[axis], p[axis])));
    [normal[0], normal[1], normal[2], d]
}

fn leading(equation: &[u64; 4]) -> Option<u64> {
    equation[..3].iter().copied().find(|&term| term != 0)
}

/// A finite number modulo the prime.
fn residue(value: f64) -> u64 {
    let bits = value.to_bits();
    let exponent = (bits >> 52 & 0x7FF).cast_signed();
    let fraction = bits & ((1 << 52) - 1);
    let mantissa = if exponent == 0 { fraction } else { fraction | 1 << 52 };
    let shift = (exponent.max(1) - 1075).rem_euclid(61) as u32;
    // 2^61 = 1, so what leaves at the top comes in at the bottom.
    let size = (mantissa << shift & PRIME) | mantissa >> (61 - shift);
    if bits >> 63 == 1 { minus(0, size) } else { reduce(size) }
}

fn reduce(value: u64) -> u64 {
    if value >= PRIME { value - PRIME } else { value }
}

fn plus(a: u64, b: u64) -> u64 {
    reduce(a + b)
}

fn minus(a: u64, b: u64) -> u64 {
    reduce(a + PRIME - b)
}

fn times(a: u64, b: u64) -> u64 {
    let product = u128::from(a) * u128::from(b);
    reduce((product as u64 & PRIME) + (product >> 61) as u64)
}

fn power(mut base: u64, mut exponent: u64) -> u64 {
    let mut result = 1;
    while exponent > 0 {
        if exponent & 1 == 1 {
            result = times(result, base);
        }
        base = times(base, base);
        exponent >>= 1;
    }
    result
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fingerprint(corners: [[f64; 3]; 3]) -> Option<u64> {
        plane_fingerprints(1, |_| corners.map(DVec3::from_array))[0]
    }

    #[test]
    fn residues_add_and_multiply_like_the_numbers() {
        for (a, b) in [(1.5, -2.25), (1e-300, 3.0), (0.1, 1024.0), (-7.0, -1e15)] {
            // Both results are exact in f64 for the first and last pair only where they fit.
            let product: f64 = a * b;
            if product / b == a && (a == 1.5 || a == -7.0) {
                assert_eq!(times(residue(a), residue(b)), residue(product));
            }
            assert_eq!(plus(residue(a), residue(-a)), 0);
        }
        assert_eq!(plus(residue(0.5), residue(0.25)), residue(0.75));
        assert_eq!(times(residue(0.5), 2), 1);
    }

    #[test]
    fn faces_in_one_plane_share_a_fingerprint() {
        // x + y + z = 1, three ways round.
        let a = fingerprint([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]);
        let b = fingerprint([[0.5, 0.25, 0.25], [0.0, 2.0, -1.0], [-3.0, 3.5, 0.5]]);
        assert!(a.is_some());
        assert_eq!(a, b);
    }

    #[test]
    fn a_plane_one_ulp_away_is_another() {
        let flat = |y: f64| fingerprint([[0.0, y, 0.0], [1.0, y, 0.0], [0.0, y, 1.0]]);
        assert_ne!(flat(1.0), flat(1.0 + f64::EPSILON));
        assert_ne!(flat(0.0), flat(5e-324));
        assert_eq!(flat(3.0), fingerprint([[7.0, 3.0, 0.1], [0.3, 3.0, 0.7], [0.0, 3.0, 1e9]]));
    }

    #[test]
    fn points_on_a_line_have_no_plane() {
        assert_eq!(fingerprint([[0.0; 3], [1.0, 2.0, 3.0], [2.0, 4.0, 6.0]]), None);
    }
}
