//! Exact numbers.

#![expect(clippy::cast_possible_wrap, reason = "exponents and bit lengths are far below 2^63")]

use std::{
    cmp::Ordering,
    ops::{Add, Mul, Sub},
};

use dashu_int::{
    IBig, UBig,
    ops::{BitTest, SquareRoot},
};

/// A number m · 2^e, exactly. All finite `f64` are such numbers, and so are their sums,
/// differences and products, whatever their size.
#[derive(Debug, Clone)]
pub(crate) struct Dyadic {
    mantissa: IBig,
    exponent: i64,
}

/// Bits that a quotient or a square root keeps: enough that rounding them to `f64` afterwards is
/// off by 2^-60 ulp more than rounding the true value.
const KEPT_BITS: i64 = 128;

impl Dyadic {
    /// Nothing.
    pub(crate) fn zero() -> Self {
        Self { mantissa: IBig::ZERO, exponent: 0 }
    }

    /// Below, at or above zero.
    pub(crate) fn sign(&self) -> Ordering {
        self.mantissa.cmp(&IBig::ZERO)
    }

    /// The same distance from zero on the other side.
    pub(crate) fn negated(&self) -> Self {
        Self { mantissa: -&self.mantissa, exponent: self.exponent }
    }

    /// Times itself.
    pub(crate) fn squared(&self) -> Self {
        self.clone() * self.clone()
    }

    /// The nearest `f64`, ties to even (twice rounded if it is subnormal).
    pub(crate) fn to_f64(&self) -> f64 {
        // An odd last bit stands for all that is shifted out, so that ties stay what they are.
        let (sign, magnitude) = self.mantissa.clone().into_parts();
        let excess = magnitude.bit_len().saturating_sub(KEPT_BITS as usize);
        let mut kept = &magnitude >> excess;
        if magnitude.trailing_zeros().is_some_and(|zeros| zeros < excess) {
            kept |= UBig::ONE;
        }
        let value = times_power_of_two(kept.to_f64().value(), self.exponent + excess as i64);
        if sign == dashu_int::Sign::Negative { -value } else { value }
    }

    /// `self` / `divisor`, which is not zero, cut to [`KEPT_BITS`].
    pub(crate) fn divided_by(&self, divisor: &Self) -> Self {
        let (length, divisor_length) = (self.bit_length(), divisor.bit_length());
        let shift = (KEPT_BITS + 1 + divisor_length - length).max(0);
        Self {
            mantissa: (&self.mantissa << shift as usize) / &divisor.mantissa,
            exponent: self.exponent - shift - divisor.exponent,
        }
    }

    /// The square root of `self` >= 0, cut to [`KEPT_BITS`].
    pub(crate) fn square_root(&self) -> Self {
        let mut shift = (2 * KEPT_BITS - self.bit_length()).max(0);
        shift += (self.exponent - shift).rem_euclid(2);
        Self {
            mantissa: IBig::from((&self.mantissa << shift as usize).sqrt()),
            exponent: (self.exponent - shift) / 2,
        }
    }

    fn bit_length(&self) -> i64 {
        self.mantissa.clone().into_parts().1.bit_len() as i64
    }

    /// Both mantissas at the smaller exponent.
    fn aligned(self, other: Self) -> (IBig, IBig, i64) {
        let exponent = self.exponent.min(other.exponent);
        let lower = |number: Self| number.mantissa << (number.exponent - exponent) as usize;
        (lower(self), lower(other), exponent)
    }
}

impl From<f64> for Dyadic {
    /// Exact. `value` is finite.
    fn from(value: f64) -> Self {
        assert!(value.is_finite(), "{value} in the scene or a ray");
        if value == 0.0 {
            return Self::zero();
        }
        let bits = value.to_bits();
        let (biased, fraction) = ((bits >> 52 & 0x7ff) as i64, (bits & ((1 << 52) - 1)) as i64);
        let magnitude = if biased == 0 { fraction } else { fraction | 1 << 52 };
        let zeros = magnitude.trailing_zeros();
        let mantissa = IBig::from(magnitude >> zeros);
        Self {
            mantissa: if value < 0.0 { -mantissa } else { mantissa },
            exponent: biased.max(1) - 1075 + i64::from(zeros),
        }
    }
}

impl Add for Dyadic {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        let (mantissa, other, exponent) = self.aligned(other);
        Self { mantissa: mantissa + other, exponent }
    }
}

impl Sub for Dyadic {
    type Output = Self;

    fn sub(self, other: Self) -> Self {
        let (mantissa, other, exponent) = self.aligned(other);
        Self { mantissa: mantissa - other, exponent }
    }
}

impl Mul for Dyadic {
    type Output = Self;

    fn mul(self, other: Self) -> Self {
        Self { mantissa: self.mantissa * other.mantissa, exponent: self.exponent + other.exponent }
    }
}

/// `value` · 2^`exponent` in steps that stay in range as long as the result does.
fn times_power_of_two(mut value: f64, mut exponent: i64) -> f64 {
    while exponent != 0 && value != 0.0 && value.is_finite() {
        let step = exponent.clamp(-1000, 1000);
        value *= f64::from_bits(((1023 + step) as u64) << 52);
        exponent -= step;
    }
    value
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_come_back_as_they_went_in() {
        for value in [0.0, 1.0, -0.1, 1e300, -1e-300, f64::MAX, f64::MIN_POSITIVE, 5e-324] {
            assert_eq!(Dyadic::from(value).to_f64().to_bits(), value.to_bits());
        }
    }

    #[test]
    fn sums_and_products_lose_nothing() {
        let (huge, tiny) = (Dyadic::from(1e300), Dyadic::from(1e-300));
        let sum = huge.clone() + tiny.clone();
        assert_eq!((sum.clone() - huge.clone()).to_f64(), 1e-300);
        let squared = sum.squared() - huge.squared() - tiny.squared();
        assert_eq!((squared - Dyadic::from(2.0) * huge * tiny).sign(), Ordering::Equal);
    }

    #[test]
    fn quotients_and_roots_round_like_the_cpu() {
        for (a, b) in [(1.0, 3.0), (-2.0, 7.0), (1e-200, 3e100), (0.0, 5.0), (1e17, -0.3)] {
            let quotient = Dyadic::from(a).divided_by(&Dyadic::from(b));
            assert_eq!(quotient.to_f64(), a / b);
        }
        for a in [2.0, 1e-7, 3e300, 0.0, 49.0, 5e-324] {
            assert_eq!(Dyadic::from(a).square_root().to_f64(), a.sqrt());
        }
    }

    #[test]
    fn a_tie_is_no_tie_when_anything_follows_it() {
        let half_ulp = Dyadic::from(f64::EPSILON / 2.0);
        let tie = Dyadic::from(1.0) + half_ulp;
        assert_eq!(tie.to_f64(), 1.0);
        assert_eq!((tie + Dyadic::from(1e-200)).to_f64(), 1.0 + f64::EPSILON);
    }
}
