//! Where on a ray a surface is met, exactly.

use std::cmp::Ordering;

use crate::dyadic::Dyadic;

/// The number (p + s √q) / a, with a > 0 and s one of -1, 0, 1; q is above zero, but zero where s
/// is. Planes give s = 0, spheres the other two.
#[derive(Debug, Clone)]
pub(crate) struct Root {
    p: Dyadic,
    s: Ordering,
    q: Dyadic,
    a: Dyadic,
}

impl Root {
    /// `numerator` / `denominator`, which is not zero.
    pub(crate) fn quotient(numerator: Dyadic, denominator: Dyadic) -> Self {
        let (s, q) = (Ordering::Equal, Dyadic::zero());
        if denominator.sign() == Ordering::Less {
            Self { p: numerator.negated(), s, q, a: denominator.negated() }
        } else {
            Self { p: numerator, s, q, a: denominator }
        }
    }

    /// (p ± √q) / a; the sign is that of `s`, and neither it nor q is zero.
    pub(crate) fn quadratic(p: Dyadic, s: Ordering, q: Dyadic, a: Dyadic) -> Self {
        assert!(s.is_ne() && q.sign().is_gt());
        Self { p, s, q, a }
    }

    /// Below, at or above zero.
    pub(crate) fn sign(&self) -> Ordering {
        sign_of_two(&self.p, self.s, &self.q)
    }

    /// Which is smaller.
    pub(crate) fn compare(&self, other: &Self) -> Ordering {
        // Both over the common denominator a·a'.
        let p = self.p.clone() * other.a.clone() - other.p.clone() * self.a.clone();
        let q = self.q.clone() * other.a.squared();
        let other_q = other.q.clone() * self.a.squared();
        sign_of_three(&p, self.s, &q, other.s.reverse(), &other_q)
    }

    /// The number to more digits than an `f64` has: more than 100 bits are right.
    pub(crate) fn to_dyadic(&self) -> Dyadic {
        if self.s == Ordering::Equal {
            return self.p.divided_by(&self.a);
        }
        let root = self.q.square_root();
        let signed = |s| if s == Ordering::Less { root.negated() } else { root.clone() };
        if self.p.sign() == self.s.reverse() {
            // The terms cancel: p + s√q = (p² - q) / (p - s√q), whose terms do not.
            let product = self.p.squared() - self.q.clone();
            let conjugate = self.p.clone() + signed(self.s.reverse());
            product.divided_by(&(conjugate * self.a.clone()))
        } else {
            (self.p.clone() + signed(self.s)).divided_by(&self.a)
        }
    }
}

/// The sign of p + s √q.
fn sign_of_two(p: &Dyadic, s: Ordering, q: &Dyadic) -> Ordering {
    match (p.sign(), s) {
        (Ordering::Equal, sign) | (sign, Ordering::Equal) => sign,
        (a, b) if a == b => a,
        (Ordering::Greater, _) => (p.squared() - q.clone()).sign(),
        (Ordering::Less, _) => (q.clone() - p.squared()).sign(),
    }
}

/// The sign of p + s √q + t √r.
fn sign_of_three(p: &Dyadic, s: Ordering, q: &Dyadic, t: Ordering, r: &Dyadic) -> Ordering {
    let roots = match (s, t) {
        (Ordering::Equal, sign) | (sign, Ordering::Equal) => sign,
        (a, b) if a == b => a,
        (Ordering::Greater, _) => (q.clone() - r.clone()).sign(),
        (Ordering::Less, _) => (r.clone() - q.clone()).sign(),
    };
    match (p.sign(), roots) {
        (Ordering::Equal, sign) | (sign, Ordering::Equal) => sign,
        (a, b) if a == b => a,
        (sign, _) => {
            // Whose square is greater wins: p² against q + r + 2 s t √(q r).
            let rest = p.squared() - q.clone() - r.clone();
            let mixed = match (s, t) {
                (Ordering::Equal, _) | (_, Ordering::Equal) => Ordering::Equal,
                _ if s == t => Ordering::Less,
                _ => Ordering::Greater,
            };
            let product = Dyadic::from(4.0) * q.clone() * r.clone();
            match sign_of_two(&rest, mixed, &product) {
                Ordering::Greater => sign,
                Ordering::Equal => Ordering::Equal,
                Ordering::Less => sign.reverse(),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Random;

    fn root(p: f64, s: Ordering, q: f64, a: f64) -> Root {
        if s.is_eq() || q == 0.0 {
            return Root::quotient(Dyadic::from(p), Dyadic::from(a));
        }
        Root::quadratic(Dyadic::from(p), s, Dyadic::from(q), Dyadic::from(a))
    }

    #[test]
    fn equal_numbers_written_differently_are_equal() {
        // (3 + √8) / 2 = (6 + √32) / 4, (1 + √4) / 3 = 1, (5 - √9) / 2 = (3 - √1) / 2 = 1.
        use Ordering::{Equal, Greater, Less};
        let same = |a: Root, b: Root| {
            assert_eq!(a.compare(&b), Equal);
            assert_eq!(b.compare(&a), Equal);
        };
        same(root(3.0, Greater, 8.0, 2.0), root(6.0, Greater, 32.0, 4.0));
        same(root(1.0, Greater, 4.0, 3.0), root(1.0, Equal, 0.0, 1.0));
        same(root(5.0, Less, 9.0, 2.0), root(3.0, Less, 1.0, 2.0));
        assert_eq!(root(-3.0, Greater, 9.0, 2.0).sign(), Equal);
    }

    #[test]
    fn order_and_value_agree() {
        let mut random = Random::new(2);
        let signs = [Ordering::Less, Ordering::Equal, Ordering::Greater];
        let mut make = || {
            let small = |random: &mut Random| random.between(-3.0, 3.0).round();
            root(
                small(&mut random),
                signs[random.below(3)],
                small(&mut random).abs(),
                small(&mut random).abs() + 1.0,
            )
        };
        for _ in 0..5_000 {
            let (a, b) = (make(), make());
            let difference = a.to_dyadic().to_f64() - b.to_dyadic().to_f64();
            let order = if difference.abs() < 1e-14 {
                Ordering::Equal
            } else {
                difference.partial_cmp(&0.0).unwrap()
            };
            assert_eq!(a.compare(&b), order, "{a:?} {b:?}");
            assert_eq!(b.compare(&a), order.reverse());
        }
    }

    #[test]
    fn a_root_near_zero_keeps_its_digits() {
        // The roots of t² - 2·10^7 t + 1: the smaller is 1 / the greater.
        let q = 1e14 - 1.0;
        let small = root(1e7, Ordering::Less, q, 1.0).to_dyadic().to_f64();
        let great = root(1e7, Ordering::Greater, q, 1.0).to_dyadic().to_f64();
        assert_eq!(small, 1.0 / great);
    }
}
