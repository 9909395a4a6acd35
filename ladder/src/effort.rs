//! How much work goes into a report.

use rtfarm_core::render::SampleCount;

use crate::Reach;

/// How much work goes into a report.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Effort {
    /// Some seconds: whether it works.
    Smoke,
    /// Some minutes.
    Quick,
    /// Figures worth publishing.
    Full,
}

impl Effort {
    /// How far a ladder goes.
    pub fn reach(self) -> Reach {
        match self {
            Self::Smoke => Reach { rungs: 3, seeds: 2 },
            Self::Quick => Reach { rungs: 9, seeds: 8 },
            Self::Full => Reach { rungs: 11, seeds: 16 },
        }
    }

    /// Samples a pixel of the picture that stands for the truth of a user's scene.
    pub fn reference_samples(self) -> SampleCount {
        let count = match self {
            Self::Smoke => 512,
            Self::Quick => 4096,
            Self::Full => 16_384,
        };
        SampleCount::new(count).expect("all are in range")
    }
}
