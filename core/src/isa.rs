//! The instruction sets that the kernels are compiled for.

use std::{fmt, str::FromStr};

/// An instruction set. All of them give the same bytes; they differ in speed alone.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Isa {
    /// Plain Rust, on every CPU.
    Scalar,
    /// x86-64's baseline, four lanes.
    Sse2,
    /// x86-64 with AVX2, eight lanes, and with the instructions for bits that its CPUs have had as
    /// long: BMI1, BMI2, LZCNT and POPCNT.
    Avx2,
    /// x86-64 with AVX-512 (F and VL), a triangle on eight rays at once.
    Avx512,
}

impl Isa {
    /// Every instruction set, slowest first.
    pub const ALL: [Self; 4] = [Self::Scalar, Self::Sse2, Self::Avx2, Self::Avx512];

    /// The fastest that this machine runs.
    pub fn fastest() -> Self {
        Self::ALL.into_iter().rfind(|isa| isa.is_supported()).unwrap_or(Self::Scalar)
    }

    /// Whether this machine runs it.
    pub fn is_supported(self) -> bool {
        match self {
            Self::Scalar => true,
            #[cfg(target_arch = "x86_64")]
            Self::Sse2 => true,
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => {
                std::arch::is_x86_feature_detected!("avx2")
                    && std::arch::is_x86_feature_detected!("bmi1")
                    && std::arch::is_x86_feature_detected!("bmi2")
                    && std::arch::is_x86_feature_detected!("lzcnt")
                    && std::arch::is_x86_feature_detected!("popcnt")
            }
            #[cfg(target_arch = "x86_64")]
            Self::Avx512 => {
                Self::Avx2.is_supported()
                    && std::arch::is_x86_feature_detected!("avx512f")
                    && std::arch::is_x86_feature_detected!("avx512vl")
            }
            #[cfg(not(target_arch = "x86_64"))]
            Self::Sse2 | Self::Avx2 | Self::Avx512 => false,
        }
    }
}

impl fmt::Display for Isa {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Scalar => "scalar",
            Self::Sse2 => "sse2",
            Self::Avx2 => "avx2",
            Self::Avx512 => "avx512",
        })
    }
}

/// A name that is no instruction set, or one that this machine lacks.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("`{0}` is not an instruction set of this machine; it has {list}", list = supported())]
pub struct IsaError(String);

fn supported() -> String {
    let names: Vec<String> =
        Isa::ALL.iter().filter(|isa| isa.is_supported()).map(Isa::to_string).collect();
    names.join(", ")
}

impl FromStr for Isa {
    type Err = IsaError;

    /// Reads `scalar`, `sse2`, `avx2` or `avx512`; one that this machine cannot run is an error.
    fn from_str(name: &str) -> Result<Self, IsaError> {
        Self::ALL
            .into_iter()
            .find(|isa| isa.to_string() == name && isa.is_supported())
            .ok_or_else(|| IsaError(name.to_owned()))
    }
}
