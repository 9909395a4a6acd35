//! Where in its pixel a sample lies.

/// The most samples that a pixel may have.
pub const MOST_SAMPLES: u32 = 1 << 16;

/// The sample positions of one pixel, a pure function of (seed, pixel, sample).
///
/// One sample alone lies in the pixel's middle. More are points of the Sobol sequence, scrambled
/// anew in every pixel. Source: Burley, "Practical Hash-based Owen Scrambling" (2020).
#[derive(Debug, Clone, Copy)]
pub struct Samples {
    count: u32,
    scramble: u32,
}

impl Samples {
    /// The samples of pixel (x, y).
    pub fn new(count: u32, seed: u64, x: u32, y: u32) -> Self {
        let pixel = u64::from(y) << 32 | u64::from(x);
        Self { count, scramble: (mix(mix(seed) ^ pixel) >> 32) as u32 }
    }

    /// A sample's place across and down its pixel, each in `0..1`.
    pub fn position(&self, sample: u32) -> [f64; 2] {
        if self.count == 1 {
            return [0.5; 2];
        }
        [0, 1].map(|dimension| {
            f64::from(sobol_burley::sample(sample % MOST_SAMPLES, dimension, self.scramble))
        })
    }
}

/// Spreads every bit over all. Source: Steele, Lea & Flood, "Fast Splittable Pseudorandom Number
/// Generators" (2014).
fn mix(value: u64) -> u64 {
    let value = value.wrapping_add(0x9E37_79B9_7F4A_7C15);
    let value = (value ^ value >> 30).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    let value = (value ^ value >> 27).wrapping_mul(0x94D0_49BB_1331_11EB);
    value ^ value >> 31
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sixteen_samples_lie_in_sixteen_cells() {
        for pixel in 0..100 {
            let samples = Samples::new(16, 7, pixel, 3);
            let mut cells = [0; 16];
            for sample in 0..16 {
                let [x, y] = samples.position(sample);
                cells[(x * 4.0) as usize * 4 + (y * 4.0) as usize] += 1;
            }
            assert_eq!(cells, [1; 16], "pixel {pixel}");
        }
    }

    #[test]
    fn pixels_and_seeds_have_samples_of_their_own() {
        let first = |seed, x, y| Samples::new(16, seed, x, y).position(0);
        assert_ne!(first(0, 1, 2), first(0, 2, 1));
        assert_ne!(first(0, 1, 2), first(1, 1, 2));
        assert_eq!(first(5, 1, 2), first(5, 1, 2));
    }
}
