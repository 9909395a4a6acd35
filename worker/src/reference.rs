//! The reference tile, by which a coordinator sees that a worker makes the pixels that it should.

use std::{io, ops::ControlFlow};

use rtfarm_core::{
    isa::Isa,
    language::{Reading, read_scene_with},
    prepare::prepare,
    prepared::PreparedScene,
    render::{Quality, SampleLimit, Sampling, Settings, StandardError, render_tile},
    tile::{Size, TileGrid},
    transfer::Transfer,
};
use rtfarm_proto::{JobId, TileHasher, pixels_to_bytes};

const SCENE: &[u8] = include_bytes!("reference.rt");

/// The frame is one tile.
const FRAME: (u64, u64) = (20, 12);

/// Renders the reference tile with the kernels of `isa`, which this machine must support, and
/// hashes it: with all that makes pixels, some tens of milliseconds of work. Whatever renders as it
/// should has the same hash.
pub fn reference(isa: Isa) -> [u8; 32] {
    let resolve = |path: &str| match path {
        "tile.png" => Ok(include_bytes!("../../scenes/tile.png").to_vec()),
        "gem.obj" => Ok(include_bytes!("../../scenes/gem.obj").to_vec()),
        _ => Err(io::Error::from(io::ErrorKind::NotFound)),
    };
    let Reading { scene, diagnostics, .. } = read_scene_with(SCENE, &resolve, Transfer::Srgb);
    assert!(diagnostics.is_empty(), "{diagnostics:?}");
    let prepared = prepare(&scene.expect("it is right")).expect("it has all it needs");
    let most = SampleLimit::new(8).expect("it is in range");
    let sampling = Sampling::Adaptive { error: StandardError::EIGHT_BIT_STEP, most };
    let size = Size::new(FRAME.0, FRAME.1).expect("it is in range");
    let settings = Settings { size, quality: Quality { sampling, ..Quality::default() } };
    let grid = TileGrid::new(size, FRAME.0).expect("it is in range");
    let tile = grid.tile(0).expect("there is one");
    let hasher = TileHasher::new(JobId(0), prepared.hash(), settings, grid);

    let scene = PreparedScene::open(prepared).expect("it was prepared here");
    let mut go_on = || ControlFlow::Continue(());
    let rendered = render_tile(&scene, &settings.quality, grid.area(tile), isa, &mut go_on);
    hasher.hash(tile, &pixels_to_bytes(rendered.expect("nobody stops it").pixels))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_instruction_set_renders_the_same_reference_tile() {
        let expected = reference(Isa::Scalar);
        for isa in Isa::ALL.into_iter().filter(|isa| isa.is_supported()) {
            #[expect(clippy::disallowed_methods, reason = "this measures")]
            let start = std::time::Instant::now();
            assert_eq!(reference(isa), expected, "{isa}");
            eprintln!("{isa}: {:?}", start.elapsed());
        }
    }
}
