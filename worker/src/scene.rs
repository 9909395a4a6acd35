//! Prepared scenes: found on this machine or fetched, checked, mapped.

use std::{
    fs::File,
    io::{self, Write},
    os::unix::fs::OpenOptionsExt,
    path::Path,
    sync::Arc,
    time::Duration,
};

use rtfarm_core::prepared::{PreparedError, PreparedScene};
use rtfarm_proto::{
    Connection,
    wire::{self, farm_client::FarmClient},
};
use rustix::fs::OFlags;
use tonic::{Code, Status};

use crate::{job::Job, map::Map};

pub(crate) type Scene = PreparedScene<Map>;

/// Why a job's scene cannot be rendered.
#[derive(Debug, thiserror::Error)]
pub enum SceneError {
    /// A file on this machine fails.
    #[error("cannot read the prepared scene: {0}")]
    Io(#[from] io::Error),
    /// The scene is not there any more, or its coordinator is not: the job may have been cancelled
    /// since its tiles were leased.
    #[error("the prepared scene is gone: {0}")]
    Gone(String),
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
        let reason = status.message().to_owned();
        match status.code() {
            Code::NotFound
            | Code::Unavailable
            | Code::DeadlineExceeded
            | Code::Unknown
            | Code::Cancelled => Self::Gone(reason),
            _ => Self::Fetch(reason),
        }
    }
}

/// Brings the scene of a job here. Every sign of progress is a `beat`; neither a connection nor a
/// piece of the scene may take longer than `silence`. Only a coordinator that is certainly on this
/// machine, `is_local`, can know where the scene is here.
pub(crate) async fn bring<C: Connection>(
    job: &Job,
    is_local: bool,
    silence: Duration,
    connect: impl AsyncFnOnce() -> Result<FarmClient<C>, String>,
    beat: &(dyn Fn() + Sync),
) -> Result<File, SceneError> {
    match &job.scene_path {
        Some(path) if is_local => find(path),
        _ => {
            let late = |_| SceneError::Gone("no connection came about".to_owned());
            let connected = tokio::time::timeout(silence, connect()).await.map_err(late)?;
            fetch(job, silence, connected.map_err(SceneError::Gone)?, beat).await
        }
    }
}

/// Opens a scene's file. Nothing else is opened in its place, nor waited for.
fn find(path: &Path) -> Result<File, SceneError> {
    let file = File::options()
        .read(true)
        .custom_flags(OFlags::NONBLOCK.bits().cast_signed())
        .open(path)
        .map_err(|error| match error.kind() {
            io::ErrorKind::NotFound => SceneError::Gone(error.to_string()),
            _ => SceneError::Io(error),
        })?;
    if file.metadata()?.is_file() {
        Ok(file)
    } else {
        Err(io::Error::other("it is no regular file").into())
    }
}

async fn fetch<C: Connection>(
    job: &Job,
    silence: Duration,
    mut client: FarmClient<C>,
    beat: &(dyn Fn() + Sync),
) -> Result<File, SceneError> {
    // The file has no name, so that nothing stays behind.
    let mut file = tempfile::tempfile()?;
    let request = wire::FetchRequest {
        scene_hash: job.scene.0.to_vec().into(),
        incarnation: job.incarnation.0,
    };
    let late = |_| SceneError::Gone("the coordinator was silent for too long".to_owned());
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

/// Checks a scene and maps it into memory.
pub(crate) fn open(file: &File, job: &Job, beat: &dyn Fn()) -> Result<Arc<Scene>, SceneError> {
    let scene = PreparedScene::open_in_steps(Map::new(file)?, &mut || beat())?;
    if scene.hash() != job.scene {
        return Err(SceneError::Hash);
    }
    beat();
    Ok(Arc::new(scene))
}

#[cfg(test)]
mod tests {
    use rtfarm_core::{
        prepared::SceneHash,
        render::{Quality, Settings},
        tile::{Size, TileGrid},
    };
    use rtfarm_proto::{Address, Incarnation, JobId, TileHasher};
    use rustix::fs::{CWD, FileType, Mode, mknodat};
    use tonic::transport::{Channel, Endpoint};

    use super::*;

    fn job(scene_path: Option<Arc<Path>>) -> Job {
        let size = Size::new(16, 16).unwrap();
        let settings = Settings { size, quality: Quality::default() };
        let grid = TileGrid::new(size, 16).unwrap();
        Job {
            incarnation: Incarnation(1),
            scene: SceneHash([0; 32]),
            scene_byte_count: 1,
            scene_path,
            settings,
            grid,
            hasher: TileHasher::new(JobId(1), SceneHash([0; 32]), settings, grid),
        }
    }

    #[tokio::test(start_paused = true)]
    async fn a_connection_that_does_not_come_about_is_given_up() {
        let never = async || std::future::pending::<Result<FarmClient<Channel>, String>>().await;
        let job = job(None);
        let brought = bring(&job, false, Duration::from_secs(20), never, &|| {});
        let brought = tokio::time::timeout(Duration::from_secs(21), brought).await;
        assert!(matches!(brought, Ok(Err(SceneError::Gone(_)))), "{brought:?}");
    }

    /// What comes of a job whose scene is said to be at `path`, with a coordinator that is gone.
    async fn bring_from(path: &Path, is_local: bool) -> Result<File, SceneError> {
        let job = job(Some(path.into()));
        let nowhere = Address::Tcp("127.0.0.1:1".to_owned()).to_string();
        let client = FarmClient::new(Endpoint::from_shared(nowhere).unwrap().connect_lazy());
        bring(&job, is_local, Duration::from_secs(20), async || Ok(client), &|| {}).await
    }

    #[tokio::test]
    async fn what_is_no_regular_file_is_not_waited_for() {
        let folder = tempfile::tempdir().unwrap();
        let pipe = folder.path().join("pipe");
        mknodat(CWD, &pipe, FileType::Fifo, Mode::RUSR | Mode::WUSR, 0).unwrap();
        let error = bring_from(&pipe, true).await.unwrap_err();
        assert!(error.to_string().contains("it is no regular file"), "{error}");
    }

    #[tokio::test]
    async fn a_coordinator_elsewhere_cannot_name_a_file_here() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let error = bring_from(file.path(), false).await.unwrap_err();
        assert!(matches!(error, SceneError::Gone(_)), "it is asked for the scene: {error}");
    }
}
