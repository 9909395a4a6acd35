//! What a picture is to be.

use std::path::PathBuf;

use clap::{Args as ClapArgs, ValueEnum};
use rtfarm_core::{
    prepare::Form,
    render::{Quality, SampleCount, SampleLimit, Sampling, StandardError},
    tile::{Crop, Size, TileGrid},
    transfer::Transfer,
};
use rtfarm_job::RenderRequest;
use rtfarm_picture::PictureFormat;

use super::{
    PICTURE, SceneArgs, WORK,
    values::{
        parse_crop, parse_error, parse_max_samples, parse_samples, parse_size, parse_transfer,
        whole_number,
    },
};
use crate::output::Output;

/// What a picture depends on besides its scene, as far as it is said.
#[derive(Debug, Clone, ClapArgs)]
pub(crate) struct SettingArgs {
    /// The picture's size in pixels; the size that the scene asks for by default.
    #[arg(long, value_name = "WxH", value_parser = parse_size, help_heading = PICTURE)]
    size: Option<Size>,

    /// Show only the window whose upper left pixel is X,Y, of W columns and H rows.
    ///
    /// Its pixels are those of the whole picture, to the bit.
    #[arg(long, value_name = "X,Y,W,H", value_parser = parse_crop, help_heading = PICTURE)]
    crop: Option<Crop>,

    /// The same number of samples in every pixel.
    #[arg(long, value_name = "N", value_parser = parse_samples, conflicts_with_all = ["error", "max_samples"], help_heading = PICTURE)]
    samples: Option<SampleCount>,

    /// Sample each pixel until its standard error is below this, where 1 is full light [default:
    /// 1/255].
    ///
    /// It is an error of light, not of encoded values, whatever the --transfer.
    #[arg(long, value_name = "ERROR", value_parser = parse_error, help_heading = PICTURE)]
    error: Option<StandardError>,

    /// But at most so often [default: 256].
    #[arg(long, value_name = "N", value_parser = parse_max_samples, help_heading = PICTURE)]
    max_samples: Option<SampleLimit>,

    /// Chooses the random numbers [default: 0].
    #[arg(long, value_name = "N", value_parser = whole_number(0..=u64::MAX), help_heading = PICTURE)]
    seed: Option<u64>,

    /// Show every surface in its plain colour, as in a scene without light.
    #[arg(long, help_heading = PICTURE)]
    flat: bool,

    /// Whether surfaces that mirror light others [default: on].
    #[arg(long, value_name = "on|off", hide_possible_values = true, help_heading = PICTURE)]
    secondary: Option<Switch>,

    /// The side of a tile in pixels; by default the one that gives about 1000 tiles, or 150 at
    /// least.
    #[arg(long, value_name = "N", value_parser = whole_number(TileGrid::SIDES), help_heading = PICTURE)]
    tile: Option<u64>,

    /// What the numbers of colours say: the light itself, or light encoded by the sRGB curve
    /// [default: none].
    ///
    /// Then colours of materials, textures, point lights and the background are decoded, and a PNG
    /// is encoded; an EXR holds light.
    #[arg(long, value_name = "none|srgb", value_parser = parse_transfer, help_heading = PICTURE)]
    transfer: Option<Transfer>,

    /// Bits a channel of a PNG.
    #[arg(long, value_name = "BITS", value_parser = ["8", "16"], help_heading = PICTURE)]
    depth: Option<String>,
}

/// What picture is wanted.
#[derive(Debug, Clone, ClapArgs)]
pub(crate) struct PictureArgs {
    #[command(flatten)]
    pub(crate) scene: SceneArgs,

    /// Where the picture goes; the extension, .png or .exr, says how it is written.
    #[arg(short, long = "output", value_name = "FILE")]
    pub(crate) output: PathBuf,

    #[command(flatten)]
    settings: SettingArgs,

    /// Prepare the scene to take little memory; pictures are the same.
    ///
    /// A triangle takes some 32 bytes instead of 55; 38 if single precision does not hold its
    /// corners exactly, as it does those of binary meshes. To prepare it takes as much memory as
    /// before.
    #[arg(long, help_heading = WORK)]
    pub(crate) compact: bool,

    /// Say beside the picture, in FILE.json, when, how long and on which hosts it was rendered.
    ///
    /// What FILE itself says, scene and settings, is there too.
    #[arg(long, help_heading = PICTURE)]
    pub(crate) sidecar: bool,
}

/// Yes or no.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(super) enum Switch {
    /// Yes.
    On,
    /// No.
    Off,
}

impl PictureArgs {
    /// Where the picture goes and how it is written.
    pub(crate) fn output(&self) -> anyhow::Result<Output> {
        Output::new(&self.output, self.settings.depth.as_deref())
    }

    /// What is wanted of the scene.
    pub(crate) fn request(&self, format: PictureFormat) -> RenderRequest {
        let settings = &self.settings;
        RenderRequest {
            name: self.scene.name(),
            strict: self.scene.strict,
            size: settings.size,
            quality: Quality {
                sampling: match settings.samples {
                    Some(count) => Sampling::Fixed(count),
                    None => Sampling::Adaptive {
                        error: settings.error.unwrap_or(StandardError::EIGHT_BIT_STEP),
                        most: settings.max_samples.unwrap_or(SampleLimit::DEFAULT),
                    },
                },
                seed: settings.seed.unwrap_or(0),
                flat: settings.flat,
                secondary: !matches!(settings.secondary, Some(Switch::Off)),
                clips: format != PictureFormat::ExrF32,
            },
            crop: settings.crop,
            tile_side: settings.tile,
            transfer: settings.transfer.unwrap_or(Transfer::None),
            format,
            form: form(self.compact),
        }
    }
}

pub(crate) fn form(is_compact: bool) -> Form {
    if is_compact { Form::Compact } else { Form::Fast }
}

impl SettingArgs {
    /// What is said of a picture, as the options that say it and as a picture's file has it: words
    /// and their values.
    pub(crate) fn said(&self) -> Vec<(&'static str, &'static str, String)> {
        let Self { size, crop, samples, error, max_samples, .. } = self;
        let Self { seed, flat, secondary, tile, transfer, depth, .. } = self;
        let window = |crop: Crop| {
            let Crop { corner: [x, y], sides: [width, height] } = crop;
            format!("{x},{y},{width},{height}")
        };
        let secondary = secondary.map(|switch| (switch == Switch::On).to_string());
        let transfer = transfer.map(|transfer| match transfer {
            Transfer::None => "none",
            Transfer::Srgb => "srgb",
        });
        [
            ("size", "frame", size.map(|size| size.to_string())),
            ("crop", "window", crop.map(window)),
            ("samples", "samples", samples.map(|count| count.get().to_string())),
            ("error", "error", error.map(|error| error.get().to_string())),
            ("max-samples", "max-samples", max_samples.map(|most| most.get().to_string())),
            ("seed", "seed", seed.map(|seed| seed.to_string())),
            ("flat", "flat", flat.then(|| "true".to_owned())),
            ("secondary", "secondary", secondary),
            ("tile", "tile", tile.map(|side| side.to_string())),
            ("transfer", "transfer", transfer.map(str::to_owned)),
            ("depth", "format", depth.as_ref().map(|bits| format!("png{bits}"))),
        ]
        .into_iter()
        .filter_map(|(option, word, value)| Some((option, word, value?)))
        .collect()
    }
}
