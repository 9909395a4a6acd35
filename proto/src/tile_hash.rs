//! What the hash of a delivered tile covers.

use prost::Message;
use rtfarm_core::{
    prepared::SceneHash,
    render::Settings,
    tile::{TileGrid, TileId},
};

use crate::{JobId, wire};

/// Says what the key of a job is for. Another meaning needs another text.
const CONTEXT: &str = "rtfarm 2026-11-26 pixels of a tile";

/// Hashes pixels of one job's tiles. A hash covers the job, its scene and settings, the tile and
/// its pixels: pixels of another tile, or of the same tile in another job, never match.
#[derive(Debug, Clone, PartialEq)]
pub struct TileHasher {
    key: [u8; 32],
}

impl TileHasher {
    /// Derives a job's key.
    pub fn new(job: JobId, scene: SceneHash, settings: Settings, grid: TileGrid) -> Self {
        let mut hasher = blake3::Hasher::new_derive_key(CONTEXT);
        hasher.update(&job.0.to_le_bytes());
        hasher.update(&scene.0);
        let window = grid.window();
        for number in [grid.side(), window.x0(), window.y0(), window.width(), window.height()] {
            hasher.update(&number.to_le_bytes());
        }
        hasher.update(&wire::Settings::from(settings).encode_to_vec());
        Self { key: *hasher.finalize().as_bytes() }
    }

    /// Hashes a tile's pixels as they travel.
    pub fn hash(&self, tile: TileId, pixels: &[u8]) -> [u8; 32] {
        let mut hasher = blake3::Hasher::new_keyed(&self.key);
        hasher.update(&tile.number().to_le_bytes());
        hasher.update(pixels);
        *hasher.finalize().as_bytes()
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use rtfarm_core::{
        render::Quality,
        tile::{Area, Size},
    };

    use super::*;

    #[test]
    fn pixels_of_another_tile_job_scene_or_settings_never_match() {
        let size = |height| Size::new(64, height).unwrap();
        let settings = |height, seed| Settings {
            size: size(height),
            quality: Quality { seed, ..Quality::default() },
        };
        let grid = TileGrid::new(size(64), 16).unwrap();
        let tile = |number| grid.tile(number).unwrap();
        let hasher = |job, scene, settings: Settings, side| {
            let grid = TileGrid::new(settings.size, side).unwrap();
            TileHasher::new(JobId(job), SceneHash([scene; 32]), settings, grid)
        };
        let cropped = |corner| {
            let window = Area::new(size(64), corner, [32, 32]).unwrap();
            let grid = TileGrid::new(window, 16).unwrap();
            TileHasher::new(JobId(1), SceneHash([1; 32]), settings(64, 0), grid)
        };
        let ours = || hasher(1, 1, settings(64, 0), 16);
        assert_eq!(ours().hash(tile(3), b"same"), ours().hash(tile(3), b"same"));
        let hashes = BTreeSet::from([
            ours().hash(tile(3), b"same"),
            ours().hash(tile(4), b"same"),
            ours().hash(tile(3), b"else"),
            hasher(2, 1, settings(64, 0), 16).hash(tile(3), b"same"),
            hasher(1, 2, settings(64, 0), 16).hash(tile(3), b"same"),
            hasher(1, 1, settings(65, 0), 16).hash(tile(3), b"same"),
            hasher(1, 1, settings(64, 1), 16).hash(tile(3), b"same"),
            hasher(1, 1, settings(64, 0), 17).hash(tile(3), b"same"),
            cropped([0, 0]).hash(tile(3), b"same"),
            cropped([16, 0]).hash(tile(3), b"same"),
            cropped([0, 16]).hash(tile(3), b"same"),
        ]);
        assert_eq!(hashes.len(), 11);
    }
}
