//! An order: from a scene's text to what a job needs.

use rtfarm_core::{
    language::{Diagnostic, Omitted, Reading, Resolve, read_scene_with},
    prepare::{Form, PrepareError, prepare_as},
    prepared::PreparedBytes,
    render::{Quality, Sampling, Settings},
    scene::Scene,
    tile::{Area, Crop, Size, TileGrid},
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
    /// The part of the frame that the picture shows; all of it when missing.
    pub crop: Option<Crop>,
    /// How good the picture is to be.
    pub quality: Quality,
    /// The side of a tile in pixels; chosen by the frame's size when missing.
    pub tile_side: Option<u64>,
    /// What the numbers of colours say of light, in the scene and in a PNG.
    pub transfer: Transfer,
    /// How the picture is written.
    pub format: PictureFormat,
    /// What the prepared scene is to be good at.
    pub form: Form,
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
    /// The frame, what of it the picture shows, and its tiles.
    pub grid: TileGrid,
    /// What the numbers of colours said of light in the scene, and are to say in a PNG.
    pub transfer: Transfer,
    /// How the picture is written.
    pub format: PictureFormat,
}

/// A scene that was read and prepared already.
#[derive(Debug)]
pub struct ReadyScene {
    /// The frame that it asks for, or the one that fits its viewport.
    pub size: Size,
    /// The scene.
    pub prepared: PreparedBytes,
}

/// What came of a request and a scene's text.
#[derive(Debug)]
pub struct Placed {
    /// The order, or why there is none.
    pub order: Result<Order, Refusal>,
    /// The frame that the scene asks for, or the one that fits its viewport.
    pub size: Option<Size>,
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
        let size = scene.as_ref().and_then(own_size);
        let order = match &scene {
            Some(scene) => self.prepare(scene),
            None => Err(Refusal::Scene),
        };
        Placed { order, size, diagnostics, omitted }
    }

    /// Takes a scene as it was prepared for another request with the same transfer.
    pub fn place_ready(self, scene: ReadyScene) -> Result<Order, Refusal> {
        let (settings, grid) = self.frame(scene.size)?;
        Ok(self.order(scene.prepared, settings, grid))
    }

    fn prepare(self, scene: &Scene) -> Result<Order, Refusal> {
        let other = |error: PrepareError| Refusal::Other(error.to_string());
        let size = own_size(scene).ok_or(PrepareError::NoViewport).map_err(other)?;
        let (settings, grid) = self.frame(size)?;
        let prepared = prepare_as(scene, self.form).map_err(other)?;
        Ok(self.order(prepared, settings, grid))
    }

    /// The frame, its window and tiles, of a scene that asks for this size.
    fn frame(&self, own: Size) -> Result<(Settings, TileGrid), Refusal> {
        let other = |reason: String| Refusal::Other(reason);
        let size = self.size.unwrap_or(own);
        let window = match self.crop {
            Some(crop) => crop.of(size).map_err(|error| other(error.to_string()))?,
            None => Area::whole(size),
        };
        let grid = match self.tile_side {
            Some(side) => TileGrid::new(window, side).map_err(|error| other(error.to_string()))?,
            None => match self.quality.sampling {
                Sampling::Fixed(_) => TileGrid::balanced(window),
                Sampling::Adaptive { .. } => TileGrid::balanced(window).with_less_rim(),
            },
        };
        if grid.count() > MOST_TILES {
            return Err(other(format!(
                "a picture is cut into at most {MOST_TILES} tiles; {size} in tiles of {side}x{side} \
                 would be {count}",
                size = window.size(),
                side = grid.side(),
                count = grid.count()
            )));
        }
        Ok((Settings { size, quality: self.quality }, grid))
    }

    fn order(self, prepared: PreparedBytes, settings: Settings, grid: TileGrid) -> Order {
        let Self { name, transfer, format, .. } = self;
        Order { name, prepared, settings, grid, transfer, format }
    }
}

/// The frame that a scene asks for, or the one that fits its viewport.
fn own_size(scene: &Scene) -> Option<Size> {
    let viewport = scene.viewport?;
    Some(scene.size_hint.unwrap_or_else(|| viewport.default_size()))
}

#[cfg(test)]
mod tests {
    use std::io;

    use super::*;

    const VIEWPORT: &str = "viewport origin 0 0 9 topleft -1 1 0 bottomleft -1 -1 0 topright 1 1 0
        size 64 32 endviewport\n";

    fn request() -> RenderRequest {
        RenderRequest {
            name: "scene".to_owned(),
            strict: false,
            size: None,
            crop: None,
            quality: Quality::default(),
            tile_side: None,
            transfer: Transfer::None,
            format: PictureFormat::Png8,
            form: Form::Fast,
        }
    }

    fn place(request: RenderRequest, text: &str) -> Placed {
        request.place(text.as_bytes(), &|_| Err(io::Error::other("there are no files")))
    }

    #[test]
    fn a_size_that_is_asked_for_counts_more_than_the_scenes_own() {
        let order = place(request(), VIEWPORT).order.unwrap();
        assert_eq!(order.settings.size, Size::new(64, 32).unwrap());
        let size = Size::new(20, 10).unwrap();
        let wanted = RenderRequest { size: Some(size), ..request() };
        let order = place(wanted, VIEWPORT).order.unwrap();
        assert_eq!(order.settings.size, size);
    }

    #[test]
    fn a_crop_window_is_a_part_of_the_frame() {
        let crop = |corner, sides| Some(Crop { corner, sides });
        let wanted = RenderRequest { crop: crop([60, 30], [4, 2]), ..request() };
        let order = place(wanted, VIEWPORT).order.unwrap();
        assert_eq!(order.settings.size, Size::new(64, 32).unwrap());
        assert_eq!(Some(order.grid.window()), Area::new(order.settings.size, [60, 30], [4, 2]));
        for crop in [crop([60, 30], [5, 2]), crop([0, 0], [0, 1]), crop([u32::MAX, 0], [1, 1])] {
            let refused = place(RenderRequest { crop, ..request() }, VIEWPORT).order.unwrap_err();
            let Refusal::Other(reason) = refused else { panic!("the scene is innocent") };
            assert!(reason.contains("a frame of 64x32 pixels does not have"), "{reason}");
        }
    }

    #[test]
    fn too_many_tiles_are_refused() {
        let size = Some(Size::new(65_535, 65_535).unwrap());
        let wanted = RenderRequest { size, tile_side: Some(16), ..request() };
        let refused = place(wanted, VIEWPORT).order.unwrap_err();
        let Refusal::Other(reason) = refused else { panic!("the scene is innocent") };
        assert!(reason.contains("would be 16777216"), "{reason}");
    }

    #[test]
    fn a_strict_request_refuses_a_scene_with_a_warning() {
        let text = VIEWPORT.replace("size", "fog 3\n size");
        let placed = place(request(), &text);
        assert!(placed.order.is_ok() && placed.diagnostics.len() == 1, "{placed:?}");
        let placed = place(RenderRequest { strict: true, ..request() }, &text);
        assert!(matches!(placed.order, Err(Refusal::Scene)), "{placed:?}");
    }

    #[test]
    fn a_scene_without_a_viewport_is_refused() {
        let order = place(request(), "").order;
        assert!(order.is_err(), "{order:?}");
    }
}
