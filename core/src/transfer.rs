//! Transfer curves: from the numbers that stand for colours in scenes, images and pictures to
//! amounts of light, and back.
//!
//! Source: IEC 61966-2-1 (1999), the sRGB standard.

/// The relation of a colour's numbers to its light; 1 is full on both sides.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum Transfer {
    /// The numbers are the light.
    #[default]
    None,
    /// The numbers are encoded by the sRGB curve, which goes on above 1 by its formula.
    Srgb,
}

/// The slope of the curve near black, where it is a straight line, and the ends of that line.
const SLOPE: f64 = 12.92;
const LINE_ENDS_AT: f64 = 0.040_45;
const LINE_ENDS_AT_LIGHT: f64 = 0.003_130_8;

/// The offset of the curve elsewhere: the light is ((c + offset) / (1 + offset))^2.4.
const OFFSET: f64 = 0.055;

impl Transfer {
    /// Gives the light that a colour's number stands for. The number must not be negative; above
    /// 1e128 the light may not be finite.
    pub const fn decode(self, number: f64) -> f64 {
        match self {
            Self::None => number,
            Self::Srgb if number <= LINE_ENDS_AT => number / SLOPE,
            Self::Srgb => {
                let base = (number + OFFSET) / (1.0 + OFFSET);
                let square = base * base;
                square * root::<5>(square)
            }
        }
    }

    /// Gives the number that stands for an amount of light, which must lie in `0..=1`.
    pub fn encode(self, light: f64) -> f64 {
        match self {
            Self::None => light,
            Self::Srgb if light <= LINE_ENDS_AT_LIGHT => light * SLOPE,
            Self::Srgb => {
                // 1 / 2.4 = 1/4 + 1/6
                let half = light.sqrt();
                let power = half.sqrt() * root::<3>(half);
                power + OFFSET * (power - 1.0)
            }
        }
    }

    /// Gives the light that each 8-bit number stands for, in 255ths, so that sums are exact where
    /// numbers are the light.
    pub(crate) fn light_of_bytes(self) -> &'static [f64; 256] {
        static NONE: [f64; 256] = light_of_bytes(Transfer::None);
        static SRGB: [f64; 256] = light_of_bytes(Transfer::Srgb);
        match self {
            Self::None => &NONE,
            Self::Srgb => &SRGB,
        }
    }
}

const fn light_of_bytes(transfer: Transfer) -> [f64; 256] {
    let mut table = [0.0; 256];
    let mut byte = 0;
    while byte < 256 {
        table[byte] = match transfer {
            Transfer::None => byte as f64,
            Transfer::Srgb => 255.0 * transfer.decode(byte as f64 / 255.0),
        };
        byte += 1;
    }
    table
}

/// Computes the `N`th root of a normal number above 0 by Newton's method, in operations that round
/// alike everywhere. It is within 2 units in the last place for 3 and 5.
const fn root<const N: u32>(x: f64) -> f64 {
    // The exponent through N: less than 7 % off. Each step makes of an error e one of (N - 1)/2 e².
    let one = 1.0_f64.to_bits();
    let mut root = f64::from_bits(x.to_bits() / N as u64 + one / N as u64 * (N as u64 - 1));
    let mut step = 0;
    while step < 5 {
        let mut power = root;
        let mut k = 2;
        while k < N {
            power *= root;
            k += 1;
        }
        root -= (root - x / power) / N as f64;
        step += 1;
    }
    root
}

#[cfg(test)]
mod tests {
    use super::*;

    fn true_light(number: f64) -> f64 {
        if number <= 0.040_45 { number / 12.92 } else { libm::pow((number + 0.055) / 1.055, 2.4) }
    }

    fn true_number(light: f64) -> f64 {
        if light <= 0.003_130_8 {
            12.92 * light
        } else {
            1.055 * libm::pow(light, 1.0 / 2.4) - 0.055
        }
    }

    #[test]
    fn the_curve_is_that_of_the_standard() {
        let (mut decoding, mut encoding) = (0.0_f64, 0.0_f64);
        for k in 1..=1_000_000 {
            let at = f64::from(k) / 1e6;
            let off = |found: f64, truth: f64| (found / truth - 1.0).abs();
            decoding = decoding.max(off(Transfer::Srgb.decode(at), true_light(at)));
            decoding = decoding.max(off(Transfer::Srgb.decode(1e3 * at), true_light(1e3 * at)));
            encoding = encoding.max(off(Transfer::Srgb.encode(at), true_number(at)));
        }
        eprintln!("decoding is off by {decoding:.1e}, encoding by {encoding:.1e}");
        assert!(decoding < 2e-15 && encoding < 2e-15);
        let huge = Transfer::Srgb.decode(1e128);
        assert!((huge / true_light(1e128) - 1.0).abs() < 1e-13, "{huge:e}");
        assert!(!Transfer::Srgb.decode(1e200).is_finite());
    }

    #[test]
    fn black_and_white_are_fixed() {
        for transfer in [Transfer::None, Transfer::Srgb] {
            for end in [0.0, 1.0] {
                assert_eq!((transfer.decode(end), transfer.encode(end)), (end, end));
            }
        }
    }

    #[test]
    fn brighter_numbers_are_more_light() {
        let numbers = || (0..=200_000).map(|k| f64::from(k) / 1e5);
        assert!(numbers().map(|c| Transfer::Srgb.decode(c)).is_sorted_by(|a, b| a < b));
    }

    #[test]
    fn bytes_stand_for_what_they_stand_for_at_run_time() {
        for byte in 0..=u8::MAX {
            let number = f64::from(byte);
            let light = 255.0 * Transfer::Srgb.decode(std::hint::black_box(number / 255.0));
            assert_eq!(
                Transfer::Srgb.light_of_bytes()[usize::from(byte)].to_bits(),
                light.to_bits()
            );
            assert_eq!(Transfer::None.light_of_bytes()[usize::from(byte)], number);
        }
    }
}
