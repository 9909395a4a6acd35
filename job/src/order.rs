//! An order: from a scene's text to what a job needs.

use rtfarm_core::{
    prepare::{PrepareError, prepare},
    prepared::PreparedBytes,
    read::{Diagnostic, Omitted, Reading, Resolve, read_scene_with},
    render::{Quality, Settings},
    scene::Scene,
    tile::{Size, TileGrid},
    transfer::Transfer,
};
use rtfarm_picture::PictureFormat;

/// The most tiles that a picture may be cut into; each costs the coordinator some 100 bytes.
pub const MOST_TILES: u32 = 1 << 20;

/// What somebody wants rendered, before the scene is known.
#[derive(Debug, Clone)]
pub struct RenderRequest {
    /// What the scene is called in logs.
    pub name: String,
    /// Every warning is an error.
    pub strict: bool,
    /// The frame; the size that the scene asks for when missing.
    pub size: Option<Size>,
    /// How good the picture is to be.
    pub quality: Quality,
    /// The side of a tile in pixels; chosen by the frame's size when missing.
    pub tile_side: Option<u64>,
    /// What the numbers of colours say of light, in the scene and in a PNG.
    pub transfer: Transfer,
    /// How the picture is written.
    pub format: PictureFormat,
}

/// All that a job needs.
#[derive(Debug)]
pub struct Order {
    /// What the scene is called in logs.
    pub name: String,
    /// The scene.
    pub prepared: PreparedBytes,
    /// What the picture depends on besides.
    pub settings: Settings,
    /// The frame and its tiles.
    pub grid: TileGrid,
    /// What the numbers of colours said of light in the scene, and are to say in a PNG.
    pub transfer: Transfer,
    /// How the picture is written.
    pub format: PictureFormat,
}

/// What came of a request and a scene's text.
#[derive(Debug)]
pub struct Placed {
    /// The order, or why there is none.
    pub order: Result<Order, Refusal>,
    /// What there is to tell the scene's author.
    pub diagnostics: Vec<Diagnostic>,
    /// What there is besides.
    pub omitted: Omitted,
}

/// Why a request cannot be rendered.
#[derive(Debug)]
pub enum Refusal {
    /// The diagnostics say it.
    Scene,
    /// The scene is innocent.
    Other(String),
}

impl RenderRequest {
    /// Reads and prepares the scene. This takes long: never call it on the async runtime.
    pub fn place(self, text: &[u8], resolve: &Resolve<'_>) -> Placed {
        let reading = read_scene_with(text, resolve, self.transfer);
        let reading = if self.strict { reading.into_strict() } else { reading };
        let Reading { scene, diagnostics, omitted } = reading;
        let order = match &scene {
            Some(scene) => self.prepare(scene),
            None => Err(Refusal::Scene),
        };
        Placed { order, diagnostics, omitted }
    }

    fn prepare(self, scene: &Scene) -> Result<Order, Refusal> {
        let other = |reason: String| Refusal::Other(reason);
        let viewport = scene.viewport.ok_or(PrepareError::NoViewport);
        let viewport = viewport.map_err(|error| other(error.to_string()))?;
        let size = self.size.or(scene.size_hint).unwrap_or_else(|| viewport.default_size());
        let grid = match self.tile_side {
            Some(side) => TileGrid::new(size, side).map_err(|error| other(error.to_string()))?,
            None => TileGrid::balanced(size),
        };
        if grid.count() > MOST_TILES {
            return Err(other(format!(
                "a picture is cut into at most {MOST_TILES} tiles; {size} in tiles of {side}x{side} \
                 would be {count}",
                side = grid.side(),
                count = grid.count()
            )));
        }
        let prepared = prepare(scene).map_err(|error| other(error.to_string()))?;
        let Self { name, quality, transfer, format, .. } = self;
        let settings = Settings { size, quality };
        Ok(Order { name, prepared, settings, grid, transfer, format })
    }
}
