//! Where in its pixel a sample lies.

use sobol_burley::parts::{hash, owen_scramble_rev, u32_to_f32_norm};

/// The most samples that a pixel may have.
pub const MOST_SAMPLES: u32 = 1 << 16;

/// Independent runs of samples in a pixel: how far their means lie apart tells the pixel's error.
pub const RUNS: u32 = 4;

/// The fewest samples of a pixel whose error is estimated: two in each run.
pub const FEWEST_FOR_ERROR: u32 = 2 * RUNS;

/// The samples of one pixel, a pure function of (seed, pixel, sample).
///
/// One sample alone lies in the pixel's middle. Up to seven are points of the Sobol sequence,
/// scrambled anew in every pixel. More are dealt out to [`RUNS`] sequences, each scrambled
/// independently. Source: Burley, "Practical Hash-based Owen Scrambling" (2020).
#[derive(Debug, Clone, Copy)]
pub struct Samples {
    count: u32,
    key: u64,
}

impl Samples {
    /// The samples of pixel (x, y) where it has `count` of them or, if that is at least
    /// [`FEWEST_FOR_ERROR`], the first of any larger number.
    pub fn new(count: u32, seed: u64, x: u32, y: u32) -> Self {
        let pixel = u64::from(y) << 32 | u64::from(x);
        Self { count, key: mix(mix(seed) ^ pixel) }
    }

    /// The sample of a number below [`MOST_SAMPLES`].
    pub fn sample(&self, number: u32) -> Sample {
        if self.count < FEWEST_FOR_ERROR {
            return Sample { index: number, key: self.key, is_alone: self.count == 1 };
        }
        let key = mix(self.key ^ u64::from(number % RUNS));
        Sample { index: number / RUNS, key, is_alone: false }
    }
}

/// The random numbers of one sample.
#[derive(Debug, Clone, Copy)]
pub struct Sample {
    /// The place in its sequence.
    index: u32,
    key: u64,
    is_alone: bool,
}

impl Sample {
    /// Its place across and down the pixel, each in `0..1`.
    pub fn position(&self) -> [f64; 2] {
        if self.is_alone {
            return [0.5; 2];
        }
        self.pair(self.key)
    }

    /// Its place in the frame, in pixels, where the pixel is (x, y).
    pub(crate) fn place(&self, x: u32, y: u32) -> [f64; 2] {
        let [across, down] = self.position();
        [f64::from(x) + across, f64::from(y) + down]
    }

    /// The numbers for what a place on its way gathers. Places are told apart by `node`, and each
    /// has a sequence of its own: its first two dimensions are the best spread ones.
    pub(crate) fn gather_numbers(&self, node: u64) -> GatherNumbers {
        GatherNumbers(Self { key: mix(self.key ^ node), ..*self })
    }

    /// The number in `0..1` that decides by Russian roulette which of the sample's branches at a
    /// depth above 0 are followed.
    pub(crate) fn roulette(&self, depth: u32) -> f64 {
        // A place's number is mixed, so none is a depth.
        self.gather_numbers(u64::from(depth)).choice()
    }

    /// The first two dimensions of the sequence of a key.
    fn pair(&self, key: u64) -> [f64; 2] {
        sobol_pair(self.index, (key >> 32) as u32).map(f64::from)
    }
}

/// Samples whose places are found at once.
pub(crate) const AT_ONCE: usize = 8;

/// Finds the places of samples: `[across or down][sample]`, each as [`Sample::position`] does.
#[inline(always)]
pub(crate) fn positions(samples: &[Sample; AT_ONCE]) -> [[f64; AT_ONCE]; 2] {
    let mut places = [[0.5; AT_ONCE]; 2];
    if samples.iter().any(|sample| sample.is_alone) {
        for (place, sample) in samples.iter().enumerate() {
            [places[0][place], places[1][place]] = sample.position();
        }
        return places;
    }
    let (mut indices, mut seeds) = ([0; AT_ONCE], [0; AT_ONCE]);
    for (place, sample) in samples.iter().enumerate() {
        indices[place] = sample.index;
        seeds[place] = (sample.key >> 32) as u32;
    }
    for place in 0..AT_ONCE {
        let [across, down] = sobol_pair(indices[place], seeds[place]);
        places[0][place] = f64::from(across);
        places[1][place] = f64::from(down);
    }
    places
}

/// Random numbers for one ray that gathers, all in `0..1`.
#[derive(Debug, Clone, Copy)]
pub(crate) struct GatherNumbers(Sample);

impl GatherNumbers {
    /// The numbers of one of several rays: together those of all samples are one sequence.
    pub(crate) fn of_ray(self, ray: u32, ray_count: u32) -> Self {
        Self(Sample { index: self.0.index * ray_count + ray, ..self.0 })
    }

    /// Decides by Russian roulette whether the ray is sent.
    pub(crate) fn roulette(&self) -> f64 {
        self.fraction(1)
    }

    /// What it aims at. A choice among many needs more than the 23 bits of a number.
    pub(crate) fn choice(&self) -> f64 {
        let choice = sobol_burley::sample(self.0.index, 2, (self.0.key >> 32) as u32);
        f64::from(choice) + self.fraction(0) * (1.0 / f64::from(1 << 23))
    }

    /// Its direction.
    pub(crate) fn direction(&self) -> [f64; 2] {
        self.0.pair(self.0.key)
    }

    /// A number of 52 bits, spread no better than by chance.
    fn fraction(&self, purpose: u64) -> f64 {
        let bits = mix(self.0.key ^ u64::from(self.0.index) ^ purpose << 32) >> 12;
        bits as f64 * (1.0 / (1_u64 << 52) as f64)
    }
}

/// Finds the first two dimensions of a point of Sobol's sequence, scrambled by `seed`: what
/// [`sobol_burley::sample`] gives for them, in a fourth of its instructions. The index is shuffled
/// once for both, and no table of directions is gone through: the first dimension is the index with
/// its bits reversed, the second its product with Pascal's triangle modulo 2, whose columns double
/// in four steps.
#[inline(always)]
fn sobol_pair(index: u32, seed: u32) -> [f32; 2] {
    let shuffled =
        owen_scramble_rev(index.reverse_bits(), hash(seed ^ 0x79c6_8e4a)).reverse_bits() & 0xffff;
    let mut pascal = shuffled;
    for (step, columns) in [(1, 0xaaaa), (2, 0xcccc), (4, 0xf0f0), (8, 0xff00)] {
        pascal ^= (pascal & columns) >> step;
    }
    let seed = seed.wrapping_mul(0x9c8f_2d3b);
    let scrambled = |sobol, dimension| {
        u32_to_f32_norm(owen_scramble_rev(sobol, hash(seed ^ dimension)).reverse_bits())
    };
    [scrambled(shuffled, 0x912f_69ba), scrambled(pascal, 0x174f_18ab)]
}

/// The number of a branch that leaves the place of number `node`.
pub(crate) fn node_after(node: u64, branch: u64) -> u64 {
    mix(node ^ branch).max(1)
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
    fn sixteen_samples_of_a_run_lie_in_sixteen_cells() {
        for pixel in 0..100 {
            let samples = Samples::new(64, 7, pixel, 3);
            for run in 0..RUNS {
                let mut cells = [0; 16];
                for number in 0..16 {
                    let [x, y] = samples.sample(number * RUNS + run).position();
                    cells[(x * 4.0) as usize * 4 + (y * 4.0) as usize] += 1;
                }
                assert_eq!(cells, [1; 16], "pixel {pixel}, run {run}");
            }
        }
    }

    #[test]
    fn pairs_are_the_first_two_dimensions() {
        for index in (0..300).chain((300..MOST_SAMPLES).step_by(251)) {
            for seed in [0, 1, 0xffff_ffff, 0x1234_5678, index.wrapping_mul(0x9e37_79b9)] {
                let both = [0, 1].map(|dimension| sobol_burley::sample(index, dimension, seed));
                assert_eq!(sobol_pair(index, seed), both, "{index}, {seed:#x}");
            }
        }
    }

    #[test]
    fn places_at_once_are_those_of_each() {
        for count in [1, 4, 16, 1000] {
            let samples: [Sample; AT_ONCE] = std::array::from_fn(|k| {
                Samples::new(count, 3, 5 + k as u32 / 3, 7).sample(k as u32 % count)
            });
            let [across, down] = positions(&samples);
            for (k, sample) in samples.iter().enumerate() {
                assert_eq!([across[k], down[k]], sample.position(), "{count}, {k}");
            }
        }
    }

    #[test]
    fn pixels_and_seeds_have_samples_of_their_own() {
        let first = |seed, x, y| Samples::new(16, seed, x, y).sample(0).position();
        assert_ne!(first(0, 1, 2), first(0, 2, 1));
        assert_ne!(first(0, 1, 2), first(1, 1, 2));
        assert_eq!(first(5, 1, 2), first(5, 1, 2));
    }
}
