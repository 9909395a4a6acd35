//! How the numbers of a picture are written.

use rtfarm_core::transfer::Transfer;

use crate::picture::{PIXEL_BYTES, channels};

/// How a picture is written. All light is on channels where 1.0 stands for 255 in a scene.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum PictureFormat {
    /// PNG with 8 bits a channel: clamped once, rounded once.
    Png8,
    /// PNG with 16 bits a channel: clamped once, rounded once.
    Png16,
    /// `OpenEXR` with 32-bit floats, never clamped.
    ExrF32,
}

impl PictureFormat {
    /// Bytes that a pixel takes in the picture's file.
    pub fn bytes_per_pixel(self) -> usize {
        match self {
            Self::Png8 => 3,
            Self::Png16 => 6,
            Self::ExrF32 => 12,
        }
    }

    /// Pixels, which come as little-endian f32, as the picture's file holds them.
    pub fn encode(self, pixels: &[u8], transfer: Transfer) -> Vec<u8> {
        let (pixels, _) = pixels.as_chunks::<PIXEL_BYTES>();
        let mut bytes = Vec::with_capacity(pixels.len() * self.bytes_per_pixel());
        for light in pixels.iter().flat_map(channels) {
            match self {
                Self::Png8 => bytes.push(quantize(light, transfer, 255.0) as u8),
                // PNG has the high byte first.
                Self::Png16 => {
                    let step = quantize(light, transfer, 65_535.0) as u16;
                    bytes.extend(step.to_be_bytes());
                }
                Self::ExrF32 => bytes.extend(light.to_ne_bytes()),
            }
        }
        bytes
    }
}

/// Clamps to `0..=1`, encodes and rounds to the nearest step, halves upwards.
pub(crate) fn quantize(channel: f32, transfer: Transfer, steps: f64) -> f64 {
    (transfer.encode(f64::from(channel).clamp(0.0, 1.0)) * steps + 0.5).floor()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn encoding_gives_the_nearest_step() {
        for steps in [255.0, 65_535.0] {
            let count = steps as u32;
            for step in 0..count {
                let (below, above) = (f64::from(step), f64::from(step + 1));
                let found = |light: f32| quantize(light, Transfer::Srgb, steps);
                assert_eq!(found(Transfer::Srgb.decode(below / steps) as f32), below);
                // The numbers next to where the curve is half-way between two steps.
                let number = (below + 0.5) / steps;
                let middle = if number <= 0.040_45 {
                    number / 12.92
                } else {
                    libm::pow((number + 0.055) / 1.055, 2.4)
                };
                let nearest = middle as f32;
                let is_above = f64::from(nearest) > middle;
                let (low, high) = if is_above {
                    (nearest.next_down(), nearest)
                } else {
                    (nearest, nearest.next_up())
                };
                assert_eq!((found(low), found(high)), (below, above), "{step} of {count}");
            }
            assert_eq!(quantize(1.0, Transfer::Srgb, steps), steps);
        }
    }
}
