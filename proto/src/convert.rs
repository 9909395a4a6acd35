//! Wire messages to and from the core's types.

use prost::bytes::Bytes;
use rtfarm_core::{
    picture::PictureFormat,
    prepared::SceneHash,
    render::Settings,
    tile::{Size, SizeError},
};

use crate::wire;

/// Why a message means nothing.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum WireError {
    /// A part that must be there is not.
    #[error("the message lacks its {0}")]
    Missing(&'static str),
    /// A hash has another length than 32 bytes.
    #[error("a hash has 32 bytes, not {0}")]
    HashLength(usize),
    /// Pixels are no whole number of three f32.
    #[error("pixels have 12 bytes each, which {0} bytes are not")]
    PixelLength(usize),
    /// A number is out of its range.
    #[error("{0} samples a pixel are out of range")]
    Samples(u32),
    /// The frame is none.
    #[error(transparent)]
    Size(#[from] SizeError),
}

/// Samples that a pixel may have.
pub const SAMPLES: std::ops::RangeInclusive<u32> = 1..=65_536;

impl TryFrom<wire::Frame> for Size {
    type Error = WireError;

    fn try_from(frame: wire::Frame) -> Result<Self, WireError> {
        Ok(Self::new(frame.width.into(), frame.height.into())?)
    }
}

impl From<Size> for wire::Frame {
    fn from(size: Size) -> Self {
        Self { width: size.width(), height: size.height() }
    }
}

impl TryFrom<wire::Settings> for Settings {
    type Error = WireError;

    fn try_from(settings: wire::Settings) -> Result<Self, WireError> {
        let wire::Settings { width, height, samples, seed, flat } = settings;
        if !SAMPLES.contains(&samples) {
            return Err(WireError::Samples(samples));
        }
        Ok(Self { size: wire::Frame { width, height }.try_into()?, samples, seed, flat })
    }
}

impl From<Settings> for wire::Settings {
    fn from(settings: Settings) -> Self {
        let Settings { size, samples, seed, flat } = settings;
        Self { width: size.width(), height: size.height(), samples, seed, flat }
    }
}

impl TryFrom<wire::Format> for PictureFormat {
    type Error = WireError;

    fn try_from(format: wire::Format) -> Result<Self, WireError> {
        match format {
            wire::Format::Unspecified => Err(WireError::Missing("picture format")),
            wire::Format::Png8 => Ok(Self::Png8),
            wire::Format::Png16 => Ok(Self::Png16),
            wire::Format::ExrF32 => Ok(Self::ExrF32),
        }
    }
}

impl From<PictureFormat> for wire::Format {
    fn from(format: PictureFormat) -> Self {
        match format {
            PictureFormat::Png8 => Self::Png8,
            PictureFormat::Png16 => Self::Png16,
            PictureFormat::ExrF32 => Self::ExrF32,
        }
    }
}

/// Reads a scene's hash.
pub fn scene_hash(bytes: &[u8]) -> Result<SceneHash, WireError> {
    bytes.try_into().map(SceneHash).map_err(|_| WireError::HashLength(bytes.len()))
}

/// Pixels as they travel: little-endian f32, row by row.
pub fn pixels_to_bytes(pixels: &[[f32; 3]]) -> Bytes {
    pixels.iter().flatten().flat_map(|channel| channel.to_le_bytes()).collect()
}

/// Reads pixels that have travelled.
pub fn pixels_from_bytes(bytes: &[u8]) -> Result<Vec<[f32; 3]>, WireError> {
    let (channels, rest) = bytes.as_chunks::<4>();
    let channels: Vec<f32> = channels.iter().map(|&bytes| f32::from_le_bytes(bytes)).collect();
    match channels.as_chunks::<3>() {
        (pixels, []) if rest.is_empty() => Ok(pixels.to_vec()),
        _ => Err(WireError::PixelLength(bytes.len())),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pixels_travel_bit_for_bit() {
        let pixels = [[0.0, -0.0, f32::INFINITY], [1e-45, f32::MAX, -1.5]];
        let back = pixels_from_bytes(&pixels_to_bytes(&pixels)).unwrap();
        let bits = |pixels: &[[f32; 3]]| -> Vec<u32> {
            pixels.iter().flatten().map(|channel| channel.to_bits()).collect()
        };
        assert_eq!(bits(&back), bits(&pixels));
    }

    #[test]
    fn pixels_cut_short_are_refused() {
        for length in [1, 4, 11, 13, 16, 20, 23] {
            assert_eq!(
                pixels_from_bytes(&vec![0; length]),
                Err(WireError::PixelLength(length)),
                "{length} bytes"
            );
        }
    }

    #[test]
    fn settings_out_of_range_are_refused() {
        let good = wire::Settings { width: 2, height: 3, samples: 1, seed: 9, flat: true };
        let settings = Settings::try_from(good).unwrap();
        assert_eq!(wire::Settings::from(settings), good);
        for bad in [
            wire::Settings { width: 0, ..good },
            wire::Settings { height: 65_536, ..good },
            wire::Settings { samples: 0, ..good },
            wire::Settings { samples: 65_537, ..good },
        ] {
            Settings::try_from(bad).expect_err("out of range");
        }
    }
}
