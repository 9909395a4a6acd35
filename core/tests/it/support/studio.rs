//! From scene text to a picture in one go, for tests that look at pixels.

use std::ops::ControlFlow;

use rtfarm_core::{
    isa::Isa,
    language::read_scene,
    prepare::prepare,
    prepared::{PreparedBytes, PreparedScene},
    render::{Quality, Sampling, Settings, render_tile},
    scene::Scene,
    testing::render_trees,
    tile::{Area, Size},
};
use rtfarm_oracle::Settings as OracleSettings;

/// The scene of a text without a fault.
pub(crate) fn read(text: &str) -> Scene {
    let nothing = |_: &str| Err(std::io::ErrorKind::NotFound.into());
    let reading = read_scene(text.as_bytes(), &nothing);
    assert!(reading.diagnostics.is_empty(), "{:?}", reading.diagnostics);
    reading.scene.expect("no errors")
}

pub(crate) fn prepared(scene: &Scene) -> PreparedScene<PreparedBytes> {
    PreparedScene::open(prepare(scene).expect("a plain scene")).expect("a valid block")
}

pub(crate) fn settings(width: u64, height: u64, samples: u32) -> Settings {
    Settings { size: Size::new(width, height).unwrap(), quality: quality(samples, 5) }
}

pub(crate) fn quality(samples: u32, seed: u64) -> Quality {
    Quality {
        sampling: Sampling::fixed(samples).unwrap(),
        seed,
        secondary: false,
        ..Quality::default()
    }
}

pub(crate) fn whole(size: Size) -> Area {
    Area::whole(size)
}

/// The pixels of an area, row by row. Every channel of every picture is finite and not negative.
pub(crate) fn pixels(
    scene: &PreparedScene<PreparedBytes>,
    settings: &Settings,
    area: Area,
) -> Vec<[f32; 3]> {
    let go_on = &mut || ControlFlow::Continue(());
    let pixels = render_tile(scene, &settings.quality, area, Isa::fastest(), go_on).unwrap().pixels;
    for (k, pixel) in pixels.iter().enumerate() {
        assert!(pixel.iter().all(|c| c.is_finite() && *c >= 0.0), "pixel {k}: {pixel:?}");
    }
    pixels
}

/// The whole picture, row by row, without roulette, cut off where the oracle cuts off.
pub(crate) fn tree_picture(scene: &Scene, settings: &Settings) -> Vec<[f32; 3]> {
    let (area, cutoff) = (whole(settings.size), OracleSettings::default().cutoff);
    render_trees(&prepared(scene), &settings.quality, area, Isa::fastest(), cutoff).pixels
}

/// The whole picture, row by row.
pub(crate) fn picture(scene: &Scene, settings: &Settings) -> Vec<[f32; 3]> {
    pixels(&prepared(scene), settings, whole(settings.size))
}
