//! Numbers that know their sign: fast ones that may have to say "too close to tell", exact ones
//! that never do. Every decision is written once and asked first of the fast, then of the exact.

use std::{
    cmp::Ordering,
    ops::{Add, Mul, Sub},
};

use crate::dyadic::Dyadic;

/// What a decision is computed with.
pub(crate) trait Number:
    Clone + Add<Output = Self> + Sub<Output = Self> + Mul<Output = Self>
{
    /// This arithmetic's version of a number that is kept in both.
    fn of(both: &Both) -> Self;

    /// Below, at or above zero; `None` when rounding hides it.
    fn sign(&self) -> Option<Ordering>;
}

/// A number in both arithmetics.
#[derive(Debug, Clone)]
pub(crate) struct Both {
    pub(crate) rough: Approx,
    pub(crate) exact: Dyadic,
}

impl From<Dyadic> for Both {
    fn from(exact: Dyadic) -> Self {
        Self { rough: Approx::from(&exact), exact }
    }
}

impl From<f64> for Both {
    fn from(value: f64) -> Self {
        Self { rough: Approx { value, error: 0.0 }, exact: Dyadic::from(value) }
    }
}

/// An `f64` and how far at most the true number is from it. Each operation adds its own rounding
/// to what its operands bring; where it overflows, the error is infinite or NaN and `sign` fails.
///
/// Source: Higham, "Accuracy and Stability of Numerical Algorithms" (2002), section 3.3, running
/// error analysis.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Approx {
    pub(crate) value: f64,
    pub(crate) error: f64,
}

/// Half an ulp of 1, the most that one operation errs relative to its result.
const UNIT: f64 = f64::EPSILON / 2.0;

/// Covers the rounding of the error terms themselves: there are at most eight a bound.
const SLACK: f64 = 1.0 + 16.0 * f64::EPSILON;

impl Approx {
    pub(crate) const ZERO: Self = Self { value: 0.0, error: 0.0 };

    fn is_zero(self) -> bool {
        self.value == 0.0 && self.error == 0.0
    }

    /// The least that the true number can be. NaN if nothing is known.
    pub(crate) fn low(self) -> f64 {
        (self.value - self.error).next_down()
    }

    /// The most that the true number can be. NaN if nothing is known.
    pub(crate) fn high(self) -> f64 {
        (self.value + self.error).next_up()
    }

    /// The quotient; unknown if the divisor may be zero.
    pub(crate) fn divided_by(self, divisor: Self) -> Self {
        let value = self.value / divisor.value;
        let least_divisor = divisor.value.abs() - divisor.error * SLACK;
        if least_divisor.is_nan() || least_divisor <= 0.0 {
            return Self { value, error: f64::INFINITY };
        }
        // |a/b - v| = |a - v b| / |b|, where a, b are the true numbers.
        let error = (self.error + value.abs() * divisor.error) / least_divisor;
        rounded(value, error)
    }

    /// The square root; unknown if the number may be below zero.
    pub(crate) fn square_root(self) -> Self {
        let value = self.value.sqrt();
        let least = self.value - self.error * SLACK;
        if least.is_nan() || least <= 0.0 {
            return Self { value, error: f64::INFINITY };
        }
        // |√a - √v| = |a - v| / (√a + √v) and √a > 0.
        rounded(value, self.error / value)
    }
}

/// `value` just computed by one rounded operation from operands that account for `inherited`.
fn rounded(value: f64, inherited: f64) -> Approx {
    // The smallest normal number covers results, and terms of the bound, that underflow.
    let error = (inherited + value.abs() * UNIT) * SLACK + f64::MIN_POSITIVE;
    Approx { value, error }
}

impl From<&Dyadic> for Approx {
    fn from(exact: &Dyadic) -> Self {
        let value = exact.to_f64();
        if !value.is_finite() {
            return Self { value: 0.0, error: f64::INFINITY };
        }
        let difference = exact.clone() - Dyadic::from(value);
        let is_exact = difference.sign() == Ordering::Equal;
        Self { value, error: if is_exact { 0.0 } else { difference.to_f64().abs().next_up() } }
    }
}

impl Number for Approx {
    fn of(both: &Both) -> Self {
        both.rough
    }

    fn sign(&self) -> Option<Ordering> {
        if self.is_zero() {
            Some(Ordering::Equal)
        } else if self.value.abs() > self.error && self.value.is_finite() {
            self.value.partial_cmp(&0.0)
        } else {
            None
        }
    }
}

impl Number for Dyadic {
    fn of(both: &Both) -> Self {
        both.exact.clone()
    }

    fn sign(&self) -> Option<Ordering> {
        Some(Dyadic::sign(self))
    }
}

impl Add for Approx {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        if other.is_zero() {
            return self;
        }
        if self.is_zero() {
            return other;
        }
        // A sum is exact where it underflows, and where it is zero.
        let value = self.value + other.value;
        Self { value, error: (self.error + other.error + value.abs() * UNIT) * SLACK }
    }
}

impl Sub for Approx {
    type Output = Self;

    fn sub(self, other: Self) -> Self {
        self + Self { value: -other.value, error: other.error }
    }
}

impl Mul for Approx {
    type Output = Self;

    fn mul(self, other: Self) -> Self {
        if self.is_zero() || other.is_zero() {
            return Self::ZERO;
        }
        let inherited = self.value.abs() * other.error
            + other.value.abs() * self.error
            + self.error * other.error;
        rounded(self.value * other.value, inherited)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Random;

    #[test]
    fn the_true_number_is_never_farther_than_the_error() {
        let mut random = Random::new(1);
        for _ in 0..20_000 {
            let numbers: Vec<f64> =
                (0..6).map(|_| random.sign() * random.log_uniform(1e-3, 1e3)).collect();
            let [a, b, c, d, e, f] = [0, 1, 2, 3, 4, 5].map(|k| Both::from(numbers[k]));
            let rough = a.rough * b.rough - c.rough * d.rough + a.rough * e.rough * f.rough;
            let exact = a.exact.clone() * b.exact - c.exact * d.exact + a.exact * e.exact * f.exact;
            let distance = (exact.clone() - Dyadic::from(rough.value)).to_f64().abs();
            assert!(distance <= rough.error, "{numbers:?}");

            let divisor = e.rough - Approx { value: 0.5, error: 1e-9 };
            let quotient = rough.divided_by(divisor);
            let true_quotient =
                exact.divided_by(&(Dyadic::from(numbers[4]) - Dyadic::from(0.5))).to_f64();
            assert!((true_quotient - quotient.value).abs() <= quotient.error * 1.000_001);
        }
    }

    #[test]
    fn overflow_is_no_sign() {
        let huge = Both::from(1e200).rough;
        assert_eq!((huge * huge).sign(), None);
        assert_eq!((huge * huge - huge * huge).sign(), None);
    }
}
