//! What a picture's file says of its picture: all that it depends on, and how good it is. Nothing
//! of who rendered it and when, so that a picture's bytes are the same whoever did. Lines of a word
//! and a value.

use std::fmt::Write;

use rtfarm_core::{
    prepared::SceneHash,
    render::{Quality, SampleCount, SampleLimit, Sampling, Settings, StandardError, Tally},
    tile::{Crop, Size, TileGrid},
    transfer::Transfer,
};
use rtfarm_picture::PictureFormat;

/// What a picture depends on.
#[derive(Debug, Clone, PartialEq)]
pub struct Provenance {
    /// Of the package that rendered it, and of the sources that pixels depend on.
    pub build: String,
    /// The scene, as it was prepared.
    pub scene: SceneHash,
    /// What the picture depends on besides.
    pub settings: Settings,
    /// The frame, what of it the picture shows, and its tiles: no pixel depends on them, the number
    /// of rays does.
    pub grid: TileGrid,
    /// What the numbers of colours said of light.
    pub transfer: Transfer,
    /// How the picture is written.
    pub format: PictureFormat,
}

/// A text that does not say where a picture comes from.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("it does not say its {0}")]
pub struct ProvenanceError(&'static str);

impl Provenance {
    /// The text for the picture's file. `tally` is the sum of those of its tiles by their numbers.
    pub fn text(&self, tally: &Tally) -> String {
        let Self { build, scene, settings, grid, transfer, format } = self;
        let Settings { size, quality: Quality { sampling, seed, flat, secondary, clips } } =
            settings;
        let Crop { corner: [x, y], sides: [width, height] } = Crop::from(grid.window());
        let mut text = format!("build {build}\nscene {scene}\nframe {size}\n");
        let sampling = match sampling {
            Sampling::Fixed(count) => format!("samples {}", count.get()),
            Sampling::Adaptive { error, most } => {
                format!("error {}\nmax-samples {}", error.get(), most.get())
            }
        };
        let transfer = match transfer {
            Transfer::None => "none",
            Transfer::Srgb => "srgb",
        };
        let format = match format {
            PictureFormat::Png8 => "png8",
            PictureFormat::Png16 => "png16",
            PictureFormat::ExrF32 => "exr",
        };
        let _ = write!(
            text,
            "window {x},{y},{width},{height}\ntile {side}\n{sampling}\nseed {seed}\nflat {flat}\n\
             secondary {secondary}\nclips {clips}\ntransfer {transfer}\nformat {format}\n\
             rays {rays}\nsampled {sampled}\n",
            side = grid.side(),
            rays = tally.rays,
            sampled = tally.samples,
        );
        if let Some(error) = tally.error() {
            let _ = writeln!(text, "estimated-error {error:e}");
        }
        text
    }

    /// Reads what [`Provenance::text`] wrote.
    pub fn read(text: &str) -> Result<Self, ProvenanceError> {
        let field = |name: &'static str| {
            let mut lines = text.lines().filter_map(|line| line.split_once(' '));
            lines
                .find(|(word, _)| *word == name)
                .map(|(_, value)| value)
                .ok_or(ProvenanceError(name))
        };
        let number = |name| field(name)?.parse::<u64>().map_err(|_| ProvenanceError(name));
        let flag = |name| field(name)?.parse::<bool>().map_err(|_| ProvenanceError(name));
        let numbers = |name, separator: char| -> Result<Vec<u32>, ProvenanceError> {
            let numbers = field(name)?.split(separator).map(str::parse);
            numbers.collect::<Result<_, _>>().map_err(|_| ProvenanceError(name))
        };
        let small = |name| u32::try_from(number(name)?).map_err(|_| ProvenanceError(name));
        let size = match numbers("frame", 'x')?[..] {
            [width, height] => Size::new(width.into(), height.into()).ok(),
            _ => None,
        };
        let size = size.ok_or(ProvenanceError("frame"))?;
        let window = match numbers("window", ',')?[..] {
            [x, y, width, height] => Crop { corner: [x, y], sides: [width, height] }.of(size).ok(),
            _ => None,
        };
        let window = window.ok_or(ProvenanceError("window"))?;
        let grid = TileGrid::new(window, number("tile")?).map_err(|_| ProvenanceError("tile"))?;
        let sampling = if field("samples").is_ok() {
            let count = SampleCount::new(small("samples")?);
            Sampling::Fixed(count.ok_or(ProvenanceError("samples"))?)
        } else {
            let error = field("error")?.parse().ok().and_then(StandardError::new);
            let most = SampleLimit::new(small("max-samples")?);
            Sampling::Adaptive {
                error: error.ok_or(ProvenanceError("error"))?,
                most: most.ok_or(ProvenanceError("max-samples"))?,
            }
        };
        let quality = Quality {
            sampling,
            seed: number("seed")?,
            flat: flag("flat")?,
            secondary: flag("secondary")?,
            clips: flag("clips")?,
        };
        Ok(Self {
            build: field("build")?.to_owned(),
            scene: scene_hash(field("scene")?).ok_or(ProvenanceError("scene"))?,
            settings: Settings { size, quality },
            grid,
            transfer: match field("transfer")? {
                "none" => Transfer::None,
                "srgb" => Transfer::Srgb,
                _ => return Err(ProvenanceError("transfer")),
            },
            format: match field("format")? {
                "png8" => PictureFormat::Png8,
                "png16" => PictureFormat::Png16,
                "exr" => PictureFormat::ExrF32,
                _ => return Err(ProvenanceError("format")),
            },
        })
    }
}

fn scene_hash(hex: &str) -> Option<SceneHash> {
    let digits = hex.is_ascii().then_some(hex).filter(|hex| hex.len() == 64)?;
    let mut bytes = [0; 32];
    for (k, byte) in bytes.iter_mut().enumerate() {
        *byte = u8::from_str_radix(&digits[2 * k..2 * k + 2], 16).ok()?;
    }
    Some(SceneHash(bytes))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn provenance(sampling: Sampling, format: PictureFormat) -> Provenance {
        let size = Size::new(640, 480).unwrap();
        let window = Crop { corner: [3, 4], sides: [100, 50] }.of(size).unwrap();
        Provenance {
            build: "0.1.0 (abc)".to_owned(),
            scene: SceneHash([0xa7; 32]),
            settings: Settings {
                size,
                quality: Quality { sampling, seed: u64::MAX, flat: true, ..Quality::default() },
            },
            grid: TileGrid::new(window, 16).unwrap(),
            transfer: Transfer::Srgb,
            format,
        }
    }

    #[test]
    fn what_is_written_is_read() {
        let adaptive = Sampling::Adaptive {
            error: StandardError::new(0.1 + 0.2).unwrap(),
            most: SampleLimit::new(512).unwrap(),
        };
        let fixed = Sampling::Fixed(SampleCount::new(7).unwrap());
        for (sampling, format) in [(adaptive, PictureFormat::Png16), (fixed, PictureFormat::ExrF32)]
        {
            let provenance = provenance(sampling, format);
            let text = provenance.text(&Tally { rays: 5, ..Tally::default() });
            assert_eq!(Provenance::read(&text), Ok(provenance));
            assert!(text.is_ascii() && text.contains("\nrays 5\n"), "{text}");
            // Without any line but those of its figures it says too little, and says what lacks.
            for line in text.lines().filter(|line| !line.starts_with("rays")) {
                let (word, _) = line.split_once(' ').unwrap();
                let less = text.replace(&format!("{line}\n"), "");
                if !["sampled", "estimated-error", "samples"].contains(&word) {
                    let error = Provenance::read(&less).unwrap_err();
                    assert_eq!(error.to_string(), format!("it does not say its {word}"));
                }
            }
        }
        for bad in ["", "frame 0x0", "scene é", "hello"] {
            Provenance::read(bad).unwrap_err();
        }
    }
}
