//! Wire messages to and from the core's types.

use prost::bytes::Bytes;
use rtfarm_core::{
    prepared::SceneHash,
    render::{Quality, SampleLimit, Sampling, Settings, StandardError, Tally},
    tile::{Crop, CropError, Size, SizeError},
    transfer::Transfer,
};
use rtfarm_picture::{PictureFormat, pixel_bytes};

use crate::wire;

/// Why a message means nothing.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum WireError {
    /// A part that must be there is not.
    #[error("the message lacks its {0}")]
    Missing(&'static str),
    /// A hash has another length than 32 bytes.
    #[error("a hash has 32 bytes, not {0}")]
    HashLength(usize),
    /// A number is out of its range.
    #[error("{0} samples a pixel are out of range")]
    Samples(u32),
    /// A number is out of its range.
    #[error("an error of {0} is out of range")]
    Error(f64),
    /// There is no such transfer curve.
    #[error("no transfer curve has the number {0}")]
    Transfer(i32),
    /// What a tile is said to have taken is impossible.
    #[error("a tally out of range")]
    Tally,
    /// The frame is none.
    #[error(transparent)]
    Size(#[from] SizeError),
    /// The frame does not have the window.
    #[error(transparent)]
    Crop(#[from] CropError),
}

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

impl From<wire::Crop> for Crop {
    fn from(wire::Crop { x, y, width, height }: wire::Crop) -> Self {
        Self { corner: [x, y], sides: [width, height] }
    }
}

impl From<Crop> for wire::Crop {
    fn from(Crop { corner: [x, y], sides: [width, height] }: Crop) -> Self {
        Self { x, y, width, height }
    }
}

impl TryFrom<wire::Settings> for Settings {
    type Error = WireError;

    fn try_from(settings: wire::Settings) -> Result<Self, WireError> {
        let frame = settings.frame.ok_or(WireError::Missing("frame"))?;
        let quality = settings.quality.ok_or(WireError::Missing("quality"))?;
        Ok(Self { size: frame.try_into()?, quality: quality.try_into()? })
    }
}

impl From<Settings> for wire::Settings {
    fn from(Settings { size, quality }: Settings) -> Self {
        Self { frame: Some(size.into()), quality: Some(quality.into()) }
    }
}

impl TryFrom<wire::Quality> for Quality {
    type Error = WireError;

    fn try_from(quality: wire::Quality) -> Result<Self, WireError> {
        let wire::Quality { sampling, seed, flat, secondary, clips } = quality;
        let sampling = match sampling.ok_or(WireError::Missing("sampling"))? {
            wire::quality::Sampling::Samples(count) => {
                Sampling::fixed(count).ok_or(WireError::Samples(count))?
            }
            wire::quality::Sampling::Adaptive(wire::Adaptive { error, most }) => {
                Sampling::Adaptive {
                    error: StandardError::new(error).ok_or(WireError::Error(error))?,
                    most: SampleLimit::new(most).ok_or(WireError::Samples(most))?,
                }
            }
        };
        Ok(Self { sampling, seed, flat, secondary, clips })
    }
}

impl From<Quality> for wire::Quality {
    fn from(quality: Quality) -> Self {
        let Quality { sampling, seed, flat, secondary, clips } = quality;
        let sampling = Some(match sampling {
            Sampling::Fixed(count) => wire::quality::Sampling::Samples(count.get()),
            Sampling::Adaptive { error, most } => {
                let (error, most) = (error.get(), most.get());
                wire::quality::Sampling::Adaptive(wire::Adaptive { error, most })
            }
        });
        Self { sampling, seed, flat, secondary, clips }
    }
}

impl TryFrom<wire::Tally> for Tally {
    type Error = WireError;

    fn try_from(tally: wire::Tally) -> Result<Self, WireError> {
        let wire::Tally { rays, samples, untraced, estimated, variance, capped, most_untraced } =
            tally;
        let is_possible = |sum: f64| sum.is_finite() && sum >= 0.0;
        [untraced, variance, most_untraced]
            .into_iter()
            .all(is_possible)
            .then_some(Self { rays, samples, untraced, most_untraced, estimated, variance, capped })
            .ok_or(WireError::Tally)
    }
}

impl From<Tally> for wire::Tally {
    fn from(tally: Tally) -> Self {
        let Tally { rays, samples, untraced, most_untraced, estimated, variance, capped } = tally;
        Self { rays, samples, untraced, estimated, variance, capped, most_untraced }
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

impl From<Transfer> for wire::Transfer {
    fn from(transfer: Transfer) -> Self {
        match transfer {
            Transfer::None => Self::None,
            Transfer::Srgb => Self::Srgb,
        }
    }
}

/// Reads a transfer curve's number.
pub fn transfer(number: i32) -> Result<Transfer, WireError> {
    match wire::Transfer::try_from(number) {
        Ok(wire::Transfer::None) => Ok(Transfer::None),
        Ok(wire::Transfer::Srgb) => Ok(Transfer::Srgb),
        Ok(wire::Transfer::Unspecified) => Err(WireError::Missing("transfer curve")),
        Err(_) => Err(WireError::Transfer(number)),
    }
}

/// Reads a scene's hash.
pub fn scene_hash(bytes: &[u8]) -> Result<SceneHash, WireError> {
    bytes.try_into().map(SceneHash).map_err(|_| WireError::HashLength(bytes.len()))
}

/// Pixels as they travel: little-endian f32, row by row. They are not copied.
pub fn pixels_to_bytes(pixels: Vec<[f32; 3]>) -> Bytes {
    struct Pixels(Vec<[f32; 3]>);
    impl AsRef<[u8]> for Pixels {
        fn as_ref(&self) -> &[u8] {
            pixel_bytes(&self.0)
        }
    }
    Bytes::from_owner(Pixels(pixels))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pixels_travel_bit_for_bit() {
        let pixels = [[0.0, -0.0, f32::INFINITY], [1e-45, f32::MAX, -1.5]];
        let bytes: Vec<u8> = pixels.as_flattened().iter().flat_map(|c| c.to_le_bytes()).collect();
        assert_eq!(pixels_to_bytes(pixels.to_vec()), bytes);
    }

    #[test]
    fn unknown_transfer_curves_are_refused() {
        for known in [Transfer::None, Transfer::Srgb] {
            assert_eq!(transfer(wire::Transfer::from(known).into()), Ok(known));
        }
        assert_eq!(transfer(0), Err(WireError::Missing("transfer curve")));
        for number in [-1, 3, i32::MAX] {
            assert_eq!(transfer(number), Err(WireError::Transfer(number)));
        }
    }

    #[test]
    fn settings_out_of_range_are_refused() {
        use wire::quality::Sampling::{Adaptive, Samples};
        let quality = wire::Quality {
            sampling: Some(Samples(1)),
            seed: 9,
            flat: true,
            secondary: false,
            clips: true,
        };
        let frame = wire::Frame { width: 2, height: 3 };
        let good = wire::Settings { frame: Some(frame), quality: Some(quality) };
        let settings = Settings::try_from(good).unwrap();
        assert_eq!(wire::Settings::from(settings), good);
        for frame in [wire::Frame { width: 0, ..frame }, wire::Frame { height: 65_536, ..frame }] {
            Settings::try_from(wire::Settings { frame: Some(frame), ..good })
                .expect_err("no frame");
        }
        let adaptive = |error, most| Some(Adaptive(wire::Adaptive { error, most }));
        Quality::try_from(wire::Quality { sampling: adaptive(0.1, 8), ..quality }).unwrap();
        for bad in [
            wire::Quality { sampling: None, ..quality },
            wire::Quality { sampling: Some(Samples(0)), ..quality },
            wire::Quality { sampling: Some(Samples(65_537)), ..quality },
            wire::Quality { sampling: adaptive(0.1, 7), ..quality },
            wire::Quality { sampling: adaptive(0.1, 65_537), ..quality },
            wire::Quality { sampling: adaptive(0.0, 8), ..quality },
            wire::Quality { sampling: adaptive(f64::NAN, 8), ..quality },
            wire::Quality { sampling: adaptive(f64::INFINITY, 8), ..quality },
        ] {
            Quality::try_from(bad).expect_err("out of range");
        }
    }
}
