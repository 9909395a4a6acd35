//! An order: from a scene's text to what a job needs.

use rtfarm_core::{
    picture::PictureFormat,
    prepared::{PreparedBytes, prepare},
    read::{Diagnostic, Resolve, read_scene},
    render::Settings,
    scene::Scene,
    tile::{Size, TileGrid},
};

/// The most tiles that a picture may be cut into; each costs the coordinator some 100 bytes.
pub const MOST_TILES: u32 = 1 << 20;

/// What somebody wants rendered, before the scene is known.
#[derive(Debug, Clone)]
pub struct Wish {
    /// What the scene is called in logs.
    pub name: String,
    /// The frame; the scene's own wish when missing.
    pub size: Option<Size>,
    /// Samples in every pixel.
    pub samples: u32,
    /// Chooses the random numbers.
    pub seed: u64,
    /// Plain colours.
    pub flat: bool,
    /// The side of a tile in pixels; chosen by the frame's size when missing.
    pub tile_side: Option<u64>,
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
    /// How the picture is written.
    pub format: PictureFormat,
}

/// What came of a wish and a scene's text.
#[derive(Debug)]
pub struct Placed {
    /// The order, or why there is none. The diagnostics may say more.
    pub order: Result<Order, String>,
    /// What there is to tell the scene's author.
    pub diagnostics: Vec<Diagnostic>,
}

impl Wish {
    /// Reads and prepares the scene. This takes long: never call it on the async runtime.
    pub fn place(self, text: &[u8], resolve: &Resolve<'_>) -> Placed {
        let reading = read_scene(text, resolve);
        let order = match &reading.scene {
            Some(scene) => self.prepare(scene),
            None => Err("the scene has errors".to_owned()),
        };
        Placed { order, diagnostics: reading.diagnostics }
    }

    fn prepare(self, scene: &Scene) -> Result<Order, String> {
        let size = self.size.unwrap_or_else(|| default_size(scene));
        let grid = match self.tile_side {
            Some(side) => TileGrid::new(size, side).map_err(|error| error.to_string())?,
            None => TileGrid::balanced(size),
        };
        if grid.count() > MOST_TILES {
            return Err(format!(
                "a picture is cut into at most {MOST_TILES} tiles; {size} in tiles of {side}x{side} \
                 would be {count}",
                side = grid.side(),
                count = grid.count()
            ));
        }
        let prepared = prepare(scene).map_err(|error| error.to_string())?;
        let Self { name, samples, seed, flat, format, .. } = self;
        Ok(Order { name, prepared, settings: Settings { size, samples, seed, flat }, grid, format })
    }
}

/// The frame of a picture whose size nobody chose.
fn default_size(scene: &Scene) -> Size {
    scene.size_hint.unwrap_or_else(|| Size::new(1280, 720).expect("it is in range"))
}
