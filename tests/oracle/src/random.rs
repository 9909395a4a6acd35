//! Random numbers that are the same everywhere.

use glam::DVec3;

/// A stream of random numbers, told apart by its seed alone.
///
/// Source: Steele, Lea & Flood, "Fast Splittable Pseudorandom Number Generators" (2014).
#[derive(Debug, Clone)]
pub struct Random(u64);

impl Random {
    /// The stream of `seed`.
    pub fn new(seed: u64) -> Self {
        Self(seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ 0x5851_f42d_4c95_7f2d)
    }

    /// 64 random bits.
    pub fn bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    /// Uniform in 0..1.
    pub fn unit(&mut self) -> f64 {
        (self.bits() >> 11) as f64 * (f64::EPSILON / 2.0)
    }

    /// Uniform in low..high.
    pub fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.unit()
    }

    /// Uniform in 0..count.
    pub fn below(&mut self, count: usize) -> usize {
        (self.bits() % count as u64) as usize
    }

    /// -1 or 1.
    pub fn sign(&mut self) -> f64 {
        if self.bits() >> 63 == 0 { 1.0 } else { -1.0 }
    }

    /// Happens with this probability.
    pub fn chance(&mut self, probability: f64) -> bool {
        self.unit() < probability
    }

    /// Between two numbers above 0, every order of magnitude alike, without the platform's `exp`:
    /// uniform over the numbers' bit patterns, which grow like their logarithm.
    pub fn log_uniform(&mut self, low: f64, high: f64) -> f64 {
        assert!(0.0 < low && low < high && high.is_finite());
        f64::from_bits(low.to_bits() + self.bits() % (high.to_bits() - low.to_bits()))
    }

    /// Uniform in the cube from -1 to 1.
    pub fn in_cube(&mut self) -> DVec3 {
        DVec3::new(self.between(-1.0, 1.0), self.between(-1.0, 1.0), self.between(-1.0, 1.0))
    }

    /// A random direction of length 1.
    pub fn direction(&mut self) -> DVec3 {
        loop {
            let vector = self.in_cube();
            if (0.01..=1.0).contains(&vector.length_squared()) {
                return vector.normalize();
            }
        }
    }
}
