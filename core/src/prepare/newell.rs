//! Normals of flat faces.

use glam::DVec3;

use crate::exact::float::{exact_product, power_of_two_below_inverse};

/// Newell's normal of a polygon, of length 1, each component right to a few ulp of 1 however thin
/// the polygon is: differences and products keep what rounding would take.
///
/// Source: Sutherland, Sproull & Schumacker, "A Characterization of Ten Hidden-Surface
/// Algorithms" (1974), who credit M. E. Newell.
pub(super) fn unit_normal(corners: &[DVec3]) -> DVec3 {
    let extent = corners.iter().map(|&c| (c - corners[0]).abs().max_element()).fold(0.0, f64::max);
    let scale = power_of_two_below_inverse(extent);
    let first = (corners[0] * scale).to_array();
    let along = |corner: DVec3| {
        let corner = (corner * scale).to_array();
        [0, 1, 2].map(|axis| Pair::difference(corner[axis], first[axis]))
    };
    let mut sum = [Pair::ZERO; 3];
    for edge in corners[1..].windows(2) {
        let (u, v) = (along(edge[0]), along(edge[1]));
        for (axis, sum) in sum.iter_mut().enumerate() {
            let (i, j) = ((axis + 1) % 3, (axis + 2) % 3);
            *sum = sum.plus(u[i].times(v[j])).plus(u[j].times(v[i]).negated());
        }
    }
    let normal = DVec3::from_array(sum.map(|pair| pair.high + pair.low));
    let normal = normal * power_of_two_below_inverse(normal.abs().max_element());
    normal / normal.length()
}

/// A number in two parts, of some 106 bits.
/// Source: Dekker, "A floating-point technique for extending the available precision" (1971).
#[derive(Clone, Copy)]
struct Pair {
    high: f64,
    low: f64,
}

impl Pair {
    const ZERO: Self = Self { high: 0.0, low: 0.0 };

    /// a + b, exactly. Source: Knuth, "The Art of Computer Programming 2" (1969).
    fn sum(a: f64, b: f64) -> Self {
        let high = a + b;
        let b_part = high - a;
        Self { high, low: (a - (high - b_part)) + (b - b_part) }
    }

    fn difference(a: f64, b: f64) -> Self {
        Self::sum(a, -b)
    }

    fn negated(self) -> Self {
        Self { high: -self.high, low: -self.low }
    }

    fn plus(self, other: Self) -> Self {
        let sum = Self::sum(self.high, other.high);
        Self::sum(sum.high, sum.low + (self.low + other.low))
    }

    fn times(self, other: Self) -> Self {
        let (high, low) = exact_product(self.high, other.high);
        Self::sum(high, low + (self.high * other.low + self.low * other.high))
    }
}
