//! A job as a worker sees it.

use std::{path::Path, sync::Arc};

use rtfarm_core::{
    prepared::SceneHash,
    render::Settings,
    tile::{Crop, TileGrid, TileSideError},
};
use rtfarm_proto::{Incarnation, JobId, TileHasher, WireError, scene_hash, wire};

/// What a worker needs to know to render tiles of a job.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Job {
    /// The start of the coordinator that has this job.
    pub(crate) incarnation: Incarnation,
    pub(crate) scene: SceneHash,
    pub(crate) scene_byte_count: u64,
    /// Where the scene is on this machine; `None` when it has to be fetched.
    pub(crate) scene_path: Option<Arc<Path>>,
    pub(crate) settings: Settings,
    pub(crate) grid: TileGrid,
    /// Hashes its pixels.
    pub(crate) hasher: TileHasher,
}

/// Why a message describes no job.
#[derive(Debug, thiserror::Error)]
pub(crate) enum JobError {
    #[error(transparent)]
    Wire(#[from] WireError),
    #[error(transparent)]
    TileSide(#[from] TileSideError),
}

impl Job {
    /// Reads what a coordinator says of a job.
    pub(crate) fn new(
        id: JobId,
        job: &wire::Job,
        incarnation: Incarnation,
    ) -> Result<Self, JobError> {
        let settings: Settings = job.settings.ok_or(WireError::Missing("settings"))?.try_into()?;
        let scene = scene_hash(&job.scene_hash)?;
        let window = Crop::from(job.window.ok_or(WireError::Missing("window"))?);
        let window = window.of(settings.size).map_err(WireError::from)?;
        let grid = TileGrid::new(window, job.tile_side.into())?;
        Ok(Self {
            incarnation,
            scene,
            scene_byte_count: job.scene_bytes,
            scene_path: (!job.scene_path.is_empty()).then(|| Path::new(&job.scene_path).into()),
            settings,
            grid,
            hasher: TileHasher::new(id, scene, settings, grid),
        })
    }
}
