//! What a picture depends on besides the scene.

use std::{fmt, ops::RangeInclusive};

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
    /// More than full light is worth no more: who keeps the picture clips it. Adaptive pixels that
    /// are certainly above it get no more samples, and have no error there.
    pub clips: bool,
}

impl Default for Quality {
    fn default() -> Self {
        let (error, most) = (StandardError::EIGHT_BIT_STEP, SampleLimit::DEFAULT);
        let sampling = Sampling::Adaptive { error, most };
        Self { sampling, seed: 0, flat: false, secondary: true, clips: false }
    }
}

/// How many samples pixels get.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Sampling {
    /// The same number everywhere.
    Fixed(SampleCount),
    /// As many as a pixel needs.
    Adaptive {
        /// A pixel is sampled until its standard error is below this in each channel.
        error: StandardError,
        /// No pixel gets more samples than this.
        most: SampleLimit,
    },
}

impl Sampling {
    /// `count` samples in every pixel; `None` for a number outside [`SampleCount::RANGE`].
    pub fn fixed(count: u32) -> Option<Self> {
        SampleCount::new(count).map(Self::Fixed)
    }

    /// Samples until the standard error is below `error`, at most `most`; `None` where
    /// [`StandardError::new`] or [`SampleLimit::new`] gives none.
    pub fn adaptive(error: f64, most: u32) -> Option<Self> {
        Some(Self::Adaptive { error: StandardError::new(error)?, most: SampleLimit::new(most)? })
    }
}

impl fmt::Display for Sampling {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Fixed(count) => write!(f, "{count} samples"),
            Self::Adaptive { error, most } => {
                write!(f, "error {error:.3e}, at most {most} samples")
            }
        }
    }
}

/// A number of samples in a pixel: one of [`SampleCount::RANGE`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct SampleCount(u32);

impl SampleCount {
    /// How many samples a pixel may have.
    pub const RANGE: RangeInclusive<u32> = 1..=MOST_SAMPLES;

    /// `None` for a number outside [`SampleCount::RANGE`].
    pub fn new(count: u32) -> Option<Self> {
        Self::RANGE.contains(&count).then_some(Self(count))
    }

    /// The number.
    pub fn get(self) -> u32 {
        self.0
    }
}

impl fmt::Display for SampleCount {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(&self.0, f)
    }
}

/// The most samples that a pixel may get while its error is estimated: one of
/// [`SampleLimit::RANGE`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct SampleLimit(u32);

impl SampleLimit {
    /// No error can be estimated from fewer samples than the least of these.
    pub const RANGE: RangeInclusive<u32> = FEWEST_FOR_ERROR..=MOST_SAMPLES;

    /// The limit where nobody chose one.
    pub const DEFAULT: Self = Self(256);

    /// `None` for a number outside [`SampleLimit::RANGE`].
    pub fn new(count: u32) -> Option<Self> {
        Self::RANGE.contains(&count).then_some(Self(count))
    }

    /// The number.
    pub fn get(self) -> u32 {
        self.0
    }
}

impl fmt::Display for SampleLimit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(&self.0, f)
    }
}

/// A standard error that a pixel's channels shall not exceed, where 1 is full light: above 0, at
/// most 1.
#[derive(Debug, Clone, Copy, PartialEq, PartialOrd)]
pub struct StandardError(f64);

impl StandardError {
    /// The error where nobody chose one: a step of 8 bits.
    pub const EIGHT_BIT_STEP: Self = Self(1.0 / 255.0);

    /// `None` for a number that is not above 0 and at most 1.
    pub fn new(error: f64) -> Option<Self> {
        (error > 0.0 && error <= 1.0).then_some(Self(error))
    }

    /// The number.
    pub fn get(self) -> f64 {
        self.0
    }
}

impl fmt::LowerExp for StandardError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::LowerExp::fmt(&self.0, f)
    }
}

impl fmt::Display for StandardError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(&self.0, f)
    }
}
