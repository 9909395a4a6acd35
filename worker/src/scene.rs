//! Prepared scenes: found on this machine or fetched, checked, mapped.

use std::{
    fs::File,
    io::{self, Write},
    path::Path,
    sync::Arc,
    time::Duration,
};

use rtfarm_core::{
    prepared::{PreparedError, PreparedScene, SceneHash},
    render::Settings,
    tile::{TileGrid, TileSideError},
};
use rtfarm_proto::{
    WireError, scene_hash,
    wire::{self, farm_client::FarmClient},
};
use tonic::{Status, transport::Channel};

use crate::{map::Map, pulse::Pulse};

pub(crate) type Scene = PreparedScene<Map>;

/// A piece of a scene must come within this time.
const CHUNK_DEADLINE: Duration = Duration::from_secs(30);

/// A job as a worker sees it.
#[derive(Debug, Clone)]
pub(crate) struct Description {
    pub(crate) hash: SceneHash,
    pub(crate) byte_count: u64,
    /// Where the scene is on this machine.
    pub(crate) path: Option<Arc<Path>>,
    pub(crate) settings: Settings,
    pub(crate) grid: TileGrid,
}

/// Why a job cannot be worked on.
#[derive(Debug, thiserror::Error)]
pub enum SceneError {
    /// The coordinator's message means nothing.
    #[error("the coordinator sent a job that makes no sense: {0}")]
    Wire(#[from] WireError),
    /// As above.
    #[error("the coordinator sent a job that makes no sense: {0}")]
    TileSide(#[from] TileSideError),
    /// A file of this machine fails.
    #[error("cannot read the prepared scene: {0}")]
    Io(#[from] io::Error),
    /// The coordinator does not send it.
    #[error("cannot fetch the prepared scene: {}", .0.message())]
    Fetch(#[from] Status),
    /// It is not the one that was promised.
    #[error("the prepared scene is another one: it does not have the hash it goes by")]
    Hash,
    /// It is not usable.
    #[error("cannot use the prepared scene: {0}")]
    Prepared(#[from] PreparedError),
}

impl TryFrom<wire::Job> for Description {
    type Error = SceneError;

    fn try_from(job: wire::Job) -> Result<Self, SceneError> {
        let settings: Settings = job.settings.ok_or(WireError::Missing("settings"))?.try_into()?;
        Ok(Self {
            hash: scene_hash(&job.scene_hash)?,
            byte_count: job.scene_bytes,
            path: (!job.scene_path.is_empty()).then(|| Path::new(&job.scene_path).into()),
            settings,
            grid: TileGrid::new(settings.size, job.tile_side.into())?,
        })
    }
}

/// Brings a job's scene into memory. Every sign of progress beats `pulse`.
pub(crate) async fn load(
    job: Description,
    client: FarmClient<Channel>,
    pulse: Arc<Pulse>,
) -> Result<Arc<Scene>, SceneError> {
    let file = match &job.path {
        Some(path) => File::open(path)?,
        None => fetch(&job, client, &pulse).await?,
    };
    let opened = tokio::task::spawn_blocking(move || open(&file, &job, &pulse)).await;
    opened.map_err(io::Error::other)?
}

async fn fetch(
    job: &Description,
    mut client: FarmClient<Channel>,
    pulse: &Pulse,
) -> Result<File, SceneError> {
    // It has no name, so that nothing stays behind.
    let mut file = tempfile::tempfile()?;
    let request = wire::FetchRequest { scene_hash: job.hash.0.to_vec().into() };
    let late = |_| Status::deadline_exceeded("the coordinator was silent for too long");
    let fetched = tokio::time::timeout(CHUNK_DEADLINE, client.fetch(request));
    let mut chunks = fetched.await.map_err(late)??.into_inner();
    let mut byte_count = 0;
    loop {
        let chunk = tokio::time::timeout(CHUNK_DEADLINE, chunks.message());
        let Some(chunk) = chunk.await.map_err(late)?? else { break };
        byte_count += chunk.data.len() as u64;
        if byte_count > job.byte_count {
            return Err(SceneError::Hash);
        }
        file.write_all(&chunk.data)?;
        pulse.beat();
    }
    Ok(file)
}

fn open(file: &File, job: &Description, pulse: &Pulse) -> Result<Arc<Scene>, SceneError> {
    let scene = PreparedScene::open_in_steps(Map::new(file)?, &mut || pulse.beat())?;
    if scene.hash() != job.hash {
        return Err(SceneError::Hash);
    }
    pulse.beat();
    Ok(Arc::new(scene))
}
