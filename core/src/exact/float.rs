//! Numbers in floating point, without rounding or with rounding to a side.

/// Multiplies a by b into the rounded product and what rounding took away, exact while neither
/// overflows nor underflows. Source: Dekker, "A floating-point technique for extending the
/// available precision" (1971), with Veltkamp's splitting.
pub(crate) fn exact_product(a: f64, b: f64) -> (f64, f64) {
    let product = a * b;
    let (a_high, a_low) = split(a);
    let (b_high, b_low) = split(b);
    let error = a_low * b_low - (((product - a_high * b_high) - a_low * b_high) - a_high * b_low);
    (product, error)
}

fn split(a: f64) -> (f64, f64) {
    const SPLITTER: f64 = 134_217_729.0; // 2^27 + 1
    let c = SPLITTER * a;
    let high = c - (c - a);
    (high, a - high)
}

/// Finds the power of two that brings `value` into 0.5..1, which is 1 for 0. It is limited to where
/// both it and its inverse are normal numbers.
pub(crate) fn power_of_two_below_inverse(value: f64) -> f64 {
    let exponent = (value.to_bits() >> 52 & 0x7FF).cast_signed() - 1022;
    let exponent = if value == 0.0 { 0 } else { exponent.clamp(-1020, 1020) };
    f64::from_bits(((1023 - exponent) as u64) << 52)
}

/// Gives the largest f32 that is not above `value`.
#[inline(always)]
pub(crate) fn below(value: f64) -> f32 {
    let rounded = value as f32;
    stepped(rounded, -i32::from(f64::from(rounded) > value))
}

/// Gives the smallest f32 that is not below `value`.
#[inline(always)]
pub(crate) fn above(value: f64) -> f32 {
    let rounded = value as f32;
    stepped(rounded, i32::from(f64::from(rounded) < value))
}

/// Goes up by a step between floating-point numbers, down by minus one or nowhere by none, without
/// a branch, as nobody can guess how a number was rounded. A zero is left only to the side of its
/// sign.
#[inline(always)]
fn stepped(number: f32, step: i32) -> f32 {
    let bits = number.to_bits();
    let sign = bits.cast_signed() >> 31 | 1;
    f32::from_bits(bits.wrapping_add_signed(sign * step))
}

#[cfg(test)]
mod tests {
    use rtfarm_oracle::random::Random;

    use super::*;

    #[test]
    fn numbers_are_rounded_to_the_nearest_on_their_side() {
        let random = &mut Random::new(31);
        let mut values = vec![0.0, -0.0, 1e300, -1e300, 1e-300, -1e-300, 1e-45, -1e-45, 1.0, -1.0];
        values.extend((0..10_000).map(|_| {
            let size = random.log_uniform(1e-46, 1e39);
            size * random.between(-1.0, 1.0)
        }));
        for value in values {
            let (low, high) = (below(value), above(value));
            assert!(f64::from(low) <= value && value < f64::from(low.next_up()), "{value:e}");
            assert!(f64::from(high) >= value && value > f64::from(high.next_down()), "{value:e}");
        }
    }
}
