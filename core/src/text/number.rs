//! Decimal numbers, rounded correctly; -0 becomes 0.

use super::bytes::{Class, class};

/// Reads the number that `word` spells; it is infinite when it is beyond f64.
pub(crate) fn parse_number(word: &[u8]) -> Option<f64> {
    let number: f64 = fast_float2::parse(word).ok()?;
    Some(number + 0.0)
}

/// Reads a finite number at byte `at` of `text` and leaves `at` at the space, comment or end that
/// follows it.
///
/// The short way is written by hand, since it reads files of short numbers a quarter faster than
/// fast-float2 alone, which reads all others. Source of the short way: Clinger, "How to Read
/// Floating Point Numbers Accurately" (1990): whole numbers below 2^53 and powers of ten up to
/// 10^22 are exact, so that one division rounds once.
pub(crate) fn scan_number(text: &[u8], at: &mut usize) -> Option<f64> {
    let byte_at = |at: usize| text.get(at).copied().unwrap_or(b' ');
    let start = *at;
    let mut here = start;
    let is_negative = byte_at(here) == b'-';
    here += usize::from(is_negative || byte_at(here) == b'+');
    let mut mantissa = 0_u64;
    let mut scan_digits = |here: &mut usize| {
        let start = *here;
        while let Some(&digit @ b'0'..=b'9') = text.get(*here) {
            mantissa = mantissa.wrapping_mul(10).wrapping_add(u64::from(digit - b'0'));
            *here += 1;
        }
        *here - start
    };
    let mut digit_count = scan_digits(&mut here);
    let mut decimals = 0;
    if byte_at(here) == b'.' {
        here += 1;
        decimals = scan_digits(&mut here);
        digit_count += decimals;
    }
    let is_short =
        (1..=19).contains(&digit_count) && mantissa <= 1 << 53 && decimals < POWERS_OF_TEN.len();
    let number = if is_short && is_end(byte_at(here)) {
        let size = mantissa as f64 / POWERS_OF_TEN[decimals];
        if is_negative { 0.0 - size } else { size }
    } else {
        while class(byte_at(here)) == Class::Word {
            here += 1;
        }
        is_end(byte_at(here)).then_some(())?;
        parse_number(&text[start..here]).filter(|number| number.is_finite())?
    };
    *at = here;
    Some(number)
}

/// Reads a finite number as [`scan_number`] does, in a text without comments: it ends at white
/// space or with the text.
#[inline]
pub(crate) fn scan_number_without_comment(text: &[u8], at: &mut usize) -> Option<f64> {
    let number = scan_number(text, at)?;
    (text.get(*at) != Some(&b'#')).then_some(number)
}

/// Rounds the number that `word` spells to single precision; `double` is the same number rounded to
/// f64. It is infinite when it is beyond f32.
///
/// Numbers halfway between two singles are doubles, so a double that is none lies on the side of
/// each of them on which the number itself lies, and rounds to the same single. Source of the pitfall:
/// Figueroa, "When Is Double Rounding Innocuous?" (1995).
pub(crate) fn round_to_single(double: f64, word: &[u8]) -> Option<f32> {
    // A single keeps 24 of the 53 bits; below the normal ones it keeps fewer.
    let is_halfway = double.to_bits() & ((1 << 29) - 1) == 1 << 28;
    if is_halfway || double.abs() < f64::from(f32::MIN_POSITIVE) {
        let single: f32 = fast_float2::parse(word).ok()?;
        return Some(single + 0.0);
    }
    Some(double as f32)
}

fn is_end(byte: u8) -> bool {
    matches!(class(byte), Class::Space | Class::Comment)
}

const POWERS_OF_TEN: [f64; 23] = [
    1e0, 1e1, 1e2, 1e3, 1e4, 1e5, 1e6, 1e7, 1e8, 1e9, 1e10, 1e11, 1e12, 1e13, 1e14, 1e15, 1e16,
    1e17, 1e18, 1e19, 1e20, 1e21, 1e22,
];

#[cfg(test)]
mod tests {
    use super::*;

    fn check_scan(text: &str) {
        let mut at = 0;
        let expected = parse_number(text.as_bytes()).filter(|number| number.is_finite());
        for rest in ["", " 1", "\n", "#"] {
            at = 0;
            let scanned = scan_number(format!("{text}{rest}").as_bytes(), &mut at);
            assert_eq!(scanned.map(f64::to_bits), expected.map(f64::to_bits), "{text:?} {rest:?}");
        }
        assert!(expected.is_none() || at == text.len(), "{text:?}");
    }

    #[test]
    fn scanning_equals_parsing() {
        for text in [
            "0",
            "-0",
            "-0.0",
            "+1.5",
            "20.",
            ".5",
            "1e-05",
            "-.",
            ".",
            "",
            "-",
            "+",
            "1e400",
            "1e",
            "0x1",
            "1,5",
            "123456789012345678",
            "1234567890123456789",
            "12345678901234567890",
            "9007199254740993",
            "0.00000000000000000000001",
            "0.000000000000000000000001",
            "4.9e-324",
            "1.7976931348623157e308",
            "nan",
        ] {
            check_scan(text);
        }
    }

    #[test]
    fn singles_are_rounded_once() {
        let check = |word: &str| {
            let double = parse_number(word.as_bytes()).unwrap();
            let single: f32 = fast_float2::parse(word).unwrap();
            let found = round_to_single(double, word.as_bytes()).unwrap();
            assert_eq!(found.to_bits(), (single + 0.0).to_bits(), "{word}");
        };
        // Just above and just below halfway by less than f64 tells, and at the ends of the range.
        for word in [
            "1.000000059604644775390625",
            "1.0000000596046447753906250000001",
            "1.0000000596046447753906249999999",
            "-1.0000000596046447753906250000001",
            "1.1754943508222875e-38",
            "1.1754943157898258e-38",
            "7.0064923216240853546186479164495e-46",
            "7.0064923216240853546186479164497e-46",
            "1e-60",
            "-1e-60",
            "0",
            "-0",
            "3.4028235677973366e38",
            "3.4028235677973365e38",
            "1e39",
        ] {
            check(word);
        }
        let mut state = 1_u64;
        for _ in 0..20_000 {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            // Halfway or beside it.
            let single = f64::from(f32::from_bits((state >> 33) as u32 & 0x7f7f_ffff));
            let near = f64::from_bits(single.to_bits() + (1 << 28) + (state >> 20) % 3 - 1);
            check(&format!("{near:e}"));
            check(&format!("{near:.30e}"));
            check(&format!("{single:e}"));
        }
    }

    #[test]
    fn scanning_equals_parsing_for_random_numbers() {
        // Source of the factor: Knuth, "The Art of Computer Programming", MMIX's generator.
        let mut state = 1_u64;
        let mut random = |below: u64| {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            (state >> 20) % below
        };
        for _ in 0..20_000 {
            let sign = ["", "-", "+"][random(3) as usize];
            let mut digits =
                |most: u64| (0..random(most)).map(|_| random(10).to_string()).collect::<String>();
            let (whole, decimals) = (digits(20), digits(24));
            check_scan(&format!("{sign}{whole}.{decimals}"));
            check_scan(&format!("{sign}{whole}"));
            check_scan(&format!("{sign}{whole}.{decimals}e{}", random(400).cast_signed() - 200));
        }
        for _ in 0..20_000 {
            let number = f64::from_bits(random(u64::MAX) << 20 ^ random(u64::MAX));
            check_scan(&format!("{number}"));
            check_scan(&format!("{number:e}"));
        }
    }
}
