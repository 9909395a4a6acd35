//! What a picture depends on besides the scene.

use std::ops::RangeInclusive;

use crate::{
    sample::{FEWEST_FOR_ERROR, MOST_SAMPLES},
    tile::Size,
};

/// What a picture depends on besides the scene.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Settings {
    /// The frame in pixels.
    pub size: Size,
    /// How good it is to be.
    pub quality: Quality,
}

/// How good a picture is to be, and what it shows.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Quality {
    /// How many samples pixels get.
    pub sampling: Sampling,
    /// Chooses the random numbers.
    pub seed: u64,
    /// Every surface shows its plain colour, as in a scene without light.
    pub flat: bool,
    /// Surfaces that mirror light others.
    pub secondary: bool,
    /// A mirrored or transmitted branch whose weight in its sample is below this is not traced:
    /// it counts as background. 0..=1.
    pub cutoff: f64,
}

impl Default for Quality {
    fn default() -> Self {
        Self {
            sampling: Sampling::Adaptive { error: DEFAULT_ERROR, most: DEFAULT_MOST_SAMPLES },
            seed: 0,
            flat: false,
            secondary: true,
            cutoff: DEFAULT_CUTOFF,
        }
    }
}

/// How many samples pixels get.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Sampling {
    /// The same number everywhere, one of [`Sampling::COUNTS`].
    Fixed(u32),
    /// As many as a pixel needs.
    Adaptive {
        /// A pixel is sampled until its standard error is below this in each channel. 0..=1, not 0.
        error: f64,
        /// But at most so often, one of [`Sampling::MOST_COUNTS`].
        most: u32,
    },
}

impl Sampling {
    /// How many samples a pixel may be given.
    pub const COUNTS: RangeInclusive<u32> = 1..=MOST_SAMPLES;

    /// The least upper limit is what an error can be estimated from.
    pub const MOST_COUNTS: RangeInclusive<u32> = FEWEST_FOR_ERROR..=MOST_SAMPLES;

    /// Whether a standard error can be asked for: above 0, at most 1.
    pub fn is_error(error: f64) -> bool {
        error > 0.0 && error <= 1.0
    }
}

/// The standard error of a pixel where nobody chose one: an 8-bit step.
pub const DEFAULT_ERROR: f64 = 1.0 / 255.0;

/// The most samples of a pixel where nobody chose their number.
pub const DEFAULT_MOST_SAMPLES: u32 = 256;

/// The cut-off where nobody chose one: a sixteenth of an 8-bit step.
pub const DEFAULT_CUTOFF: f64 = 1.0 / 4096.0;
