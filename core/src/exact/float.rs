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
    if f64::from(rounded) > value { rounded.next_down() } else { rounded }
}

/// Gives the smallest f32 that is not below `value`.
#[inline(always)]
pub(crate) fn above(value: f64) -> f32 {
    let rounded = value as f32;
    if f64::from(rounded) < value { rounded.next_up() } else { rounded }
}
