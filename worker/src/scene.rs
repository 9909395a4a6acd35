//! Prepared scenes: found on this machine or fetched, checked, mapped.

use std::{
    fs::File,
    io::{self, Write},
    sync::Arc,
    time::Duration,
};

use rtfarm_core::prepared::{PreparedError, PreparedScene};
use rtfarm_proto::{
    LeaseName,
    wire::{self, farm_client::FarmClient},
};
use tonic::{Status, transport::Channel};

use crate::{job::Job, map::Map, pulse::Pulse};

pub(crate) type Scene = PreparedScene<Map>;

/// Why a job's scene cannot be rendered.
#[derive(Debug, thiserror::Error)]
pub enum SceneError {
    /// A file on this machine fails.
    #[error("cannot read the prepared scene: {0}")]
    Io(#[from] io::Error),
    /// The coordinator does not send the scene.
    #[error("cannot fetch the prepared scene: {0}")]
    Fetch(String),
    /// The bytes are not those of the scene that the job names.
    #[error("the prepared scene does not have the hash that the job names")]
    Hash,
    /// The bytes are no usable scene.
    #[error("cannot use the prepared scene: {0}")]
    Prepared(#[from] PreparedError),
}

impl From<Status> for SceneError {
    fn from(status: Status) -> Self {
        Self::Fetch(status.message().to_owned())
    }
}

/// Brings the scene of a job of which tiles are leased into memory. Every sign of progress beats
/// `pulse`; no piece of the scene
/// may take the coordinator longer than `silence`.
pub(crate) async fn load(
    job: Arc<Job>,
    lease: LeaseName,
    silence: Duration,
    client: FarmClient<Channel>,
    pulse: Arc<Pulse>,
) -> Result<Arc<Scene>, SceneError> {
    let file = match &job.scene_path {
        Some(path) => File::open(path)?,
        None => fetch(&job, silence, client, &|| pulse.beat(lease)).await?,
    };
    let opened =
        tokio::task::spawn_blocking(move || open(&file, &job, &|| pulse.beat(lease))).await;
    opened.map_err(io::Error::other)?
}

async fn fetch(
    job: &Job,
    silence: Duration,
    mut client: FarmClient<Channel>,
    beat: &(dyn Fn() + Sync),
) -> Result<File, SceneError> {
    // The file has no name, so that nothing stays behind.
    let mut file = tempfile::tempfile()?;
    let request = wire::FetchRequest {
        scene_hash: job.scene.0.to_vec().into(),
        incarnation: job.incarnation.0,
    };
    let late = |_| SceneError::Fetch("the coordinator was silent for too long".to_owned());
    let fetched = tokio::time::timeout(silence, client.fetch(request));
    let mut chunks = fetched.await.map_err(late)??.into_inner();
    let mut byte_count = 0;
    loop {
        let chunk = tokio::time::timeout(silence, chunks.message());
        let Some(chunk) = chunk.await.map_err(late)?? else { break };
        byte_count += chunk.data.len() as u64;
        if byte_count > job.scene_byte_count {
            return Err(SceneError::Hash);
        }
        file.write_all(&chunk.data)?;
        beat();
    }
    Ok(file)
}

fn open(file: &File, job: &Job, beat: &dyn Fn()) -> Result<Arc<Scene>, SceneError> {
    let scene = PreparedScene::open_in_steps(Map::new(file)?, &mut || beat())?;
    if scene.hash() != job.scene {
        return Err(SceneError::Hash);
    }
    beat();
    Ok(Arc::new(scene))
}
