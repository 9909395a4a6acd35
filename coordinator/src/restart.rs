//! A coordinator with a state that is killed, or whose disk fails, at each change that it makes
//! there; then the next one, on a good disk.

use std::{
    collections::BTreeMap,
    io::Cursor,
    path::{Path, PathBuf},
    sync::Arc,
    time::Duration,
};

use rtfarm_core::{
    prepare::Form,
    render::{Quality, Sampling, Tally},
    tile::{Size, TileId},
    transfer::Transfer,
};
use rtfarm_job::{Order, Outcome, RenderRequest};
use rtfarm_picture::{Cache, Disk, PictureFormat};
use rtfarm_proto::{JobId, LeaseName, WorkerId, pixels_to_bytes};
use tempfile::TempDir;

use crate::{
    farm::{Delivery, Keeping, Next, Verdict},
    identity::Identity,
    job::Job,
    members::{KeptOut, Mark, Process, Standing},
    record::Ticket,
    shell::{Config, Shell},
    state::{Durability, StateError, StateFolder},
    upload::OrderLimits,
};

const BUILD: &str = "1.2.3 test";

/// Nothing before the eye: a scene all the same.
const SCENE: &str = "viewport\norigin 0 0 -2\ntopleft -1 1 0\nbottomleft -1 -1 0\ntopright 1 1 0\n\
    background 10 20 30\nendviewport\n";

const DURABILITIES: [Durability; 2] = [Durability::Second, Durability::Tile];

/// A folder in which syncing takes no time, if there is one.
fn folder_in_memory() -> TempDir {
    tempfile::tempdir_in("/dev/shm").or_else(|_| TempDir::new()).unwrap()
}

/// A picture of 3 x 2 tiles of 8 x 8 pixels.
fn order() -> Order {
    let request = RenderRequest {
        name: "test".to_owned(),
        strict: false,
        size: Some(Size::new(24, 16).unwrap()),
        crop: None,
        form: Form::Fast,
        quality: Quality { sampling: Sampling::fixed(1).unwrap(), ..Quality::default() },
        tile_side: Some(8),
        transfer: Transfer::None,
        format: PictureFormat::Png8,
    };
    request.place(SCENE.as_bytes(), &|_| unreachable!("it names no files")).order.unwrap()
}

/// A coordinator without a network, and its only worker.
struct Coordinator {
    shell: Shell,
    worker: WorkerId,
}

impl Coordinator {
    fn open(disk: Disk, folder: &Path, durability: Durability) -> Result<Self, StateError> {
        let folder = StateFolder::open_on(disk, folder, BUILD, durability)?;
        let mut random = [0; 24];
        rustix::rand::getrandom(&mut random, rustix::rand::GetRandomFlags::empty()).unwrap();
        let identity = Identity { farm: folder.farm(), ..Identity::from_random(random) };
        let config = Config {
            version: "1.2.3".to_owned(),
            build: BUILD.to_owned(),
            reference: None,
            audit: 0.0,
            keeping: Keeping::default(),
            term: Duration::from_secs(4),
            upload_silence: Duration::from_secs(4),
            events: None,
            begins_coarsely: false,
            host: None,
            orders: OrderLimits::default(),
            scene_folder: PathBuf::new(),
            picture_folder: PathBuf::new(),
        };
        let shell = Shell::new(config, identity, [7; 32], Some(folder)).unwrap();
        let worker = shell.join(Process { nonce: 1, threads: 1, ..Process::default() }).unwrap();
        Ok(Self { shell, worker })
    }

    /// Tiles to be rendered, if there are any.
    async fn lease(&self) -> Vec<(LeaseName, TileId)> {
        match self.shell.ask(self.worker, 9, Duration::ZERO).await {
            Ok(Next::Render(run)) => run.tiles.into_iter().map(|tile| (run.lease, tile)).collect(),
            Ok(Next::Nothing) => Vec::new(),
            other => panic!("{other:?}"),
        }
    }

    /// Brings a tile, whose every pixel has its number. Says whether it is acknowledged.
    fn deliver(&self, (lease, tile): (LeaseName, TileId)) -> bool {
        let Some((_, job)) = self.shell.tile(lease.job, tile.number()) else { return false };
        let pixels = vec![[tile.number() as f32 / 9.0; 3]; job.grid.area(tile).pixel_count()];
        let pixels = pixels_to_bytes(pixels);
        let hash = job.hasher.hash(tile, &pixels);
        let tally = Tally { rays: 64, ..Tally::default() };
        let delivery = Delivery { worker: self.worker, lease, tile, hash, seconds: 0.1, tally };
        let mut verdicts = self.shell.deliver(vec![(delivery, pixels)]);
        self.shell.sync();
        verdicts.try_recv().is_ok_and(|verdicts| verdicts == [Verdict::Accepted])
    }

    /// Renders all there is; answers with what was acknowledged.
    async fn render(&self) -> Vec<(JobId, TileId)> {
        let mut acknowledged = Vec::new();
        loop {
            let tiles = self.lease().await;
            if tiles.is_empty() {
                return acknowledged;
            }
            for tile in tiles {
                if self.deliver(tile) {
                    acknowledged.push((tile.0.job, tile.1));
                }
            }
        }
    }
}

fn encode(job: &Job) -> Vec<u8> {
    let mut out = Cursor::new(Vec::new());
    job.picture().encode(&rtfarm_picture::Notes::default(), &mut out).unwrap();
    out.into_inner()
}

/// What a client and a worker were told before the disk failed.
#[derive(Default)]
struct Told {
    jobs: Vec<JobId>,
    cancelled: bool,
    tiles: Vec<(JobId, TileId)>,
    whole: bool,
}

/// Two jobs are ordered, the first is cancelled, the second rendered.
async fn work(folder: &Path, disk: Disk, durability: Durability) -> Told {
    let mut told = Told::default();
    let Ok(farm) = Coordinator::open(disk.clone(), folder, durability) else { return told };
    let first = farm.shell.submit(order(), Ticket::default());
    told.jobs.extend(first.as_ref().map(|job| job.id).ok());
    let second = farm.shell.submit(order(), Ticket::default());
    told.jobs.extend(second.as_ref().map(|job| job.id).ok());
    if let Ok(first) = first {
        farm.shell.cancel(first.id);
        // Who cancels a job hears nothing of the disk.
        told.cancelled = !disk.has_failed();
    }
    told.tiles = farm.render().await;
    if let Ok(second) = second {
        let progress = second.progress().borrow().clone();
        told.whole = matches!(progress.outcome, Some(Outcome::Finished(_)));
    }
    told
}

/// After the disk has failed at a change, a power cut takes every so many parts of what was not
/// synced, if there is one.
async fn check_at_every_change(
    disk_at: fn(u64) -> Disk,
    durability: Durability,
    power_cut: Option<u32>,
) {
    let mut expected = None;
    let may_lose_tiles = power_cut.is_some() && durability == Durability::Second;
    for change in 0.. {
        let folder = folder_in_memory();
        let path = folder.path().join("state");
        let cache = Cache::default();
        let disk = disk_at(change).with_cache(&cache);
        let told = work(&path, disk.clone(), durability).await;

        if let Some(one_in) = power_cut {
            let mut count = 0;
            cache.cut_power(|| {
                count += 1;
                count % one_in == 0
            });
        }
        let context = format!("change {change}, {durability:?}, {power_cut:?}");
        let farm = Coordinator::open(Disk::default(), &path, durability).expect(&context);
        let found = |&id: &JobId| farm.shell.job(id);
        let jobs: Vec<Arc<Job>> = told.jobs.iter().filter_map(found).collect();
        let lost = told.jobs.len() - jobs.len();
        assert!(lost == 0 || lost == 1 && jobs.iter().all(|job| job.id.0 == 2), "{context}");
        assert!(!told.cancelled || farm.shell.job(JobId(1)).is_none(), "{context}");
        for (id, tile) in &told.tiles {
            let Some(job) = farm.shell.job(*id) else {
                assert!(*id == JobId(1), "{context}");
                continue;
            };
            let done = job.canvas.done().unwrap();
            let is_done = done.iter().any(|(found, _)| found == tile);
            assert!(is_done || may_lose_tiles, "{context}: {tile:?} is lost");
        }
        let again = farm.render().await;
        let is_twice = again.iter().any(|tile| told.tiles.contains(tile));
        assert!(!is_twice || may_lose_tiles, "{context}: done twice");
        for job in jobs {
            let progress = job.progress().borrow().clone();
            match progress.outcome {
                Some(Outcome::Finished(_)) => {
                    assert_eq!(progress.tiles_done, 6, "{context}");
                    let expected = expected.get_or_insert_with(|| encode(&job));
                    assert!(encode(&job) == *expected, "{context}");
                }
                // The disk failed while it was rendered, or it was cancelled.
                Some(Outcome::Failed(_)) => assert!(!told.whole || job.id.0 == 1, "{context}"),
                None => panic!("{context}: it does not end"),
            }
        }
        let next = farm.shell.submit(order(), Ticket::default()).unwrap().id;
        assert!(told.jobs.iter().all(|&id| id < next), "{context}: a number is given twice");
        let left = std::fs::read_dir(path.join("jobs")).unwrap();
        let is_job = |name: String| name.parse::<u64>().is_ok();
        assert!(left.map(|entry| entry.unwrap().file_name().into_string().unwrap()).all(is_job));
        if !disk.has_failed() {
            assert!(told.whole && told.cancelled && told.jobs.len() == 2, "{context}");
            assert!(change > 60, "every write is a change: {change}");
            return;
        }
    }
}

#[tokio::test]
async fn a_coordinator_that_is_killed_at_any_change_loses_nothing_that_it_acknowledged() {
    for durability in DURABILITIES {
        check_at_every_change(Disk::stopping_at, durability, None).await;
    }
}

#[tokio::test]
async fn a_power_cut_at_any_change_takes_nothing_that_was_said_to_be_safe() {
    for durability in DURABILITIES {
        for one_in in 1..=3 {
            check_at_every_change(Disk::stopping_at, durability, Some(one_in)).await;
        }
    }
}

#[tokio::test]
async fn what_a_start_has_found_outlives_a_power_cut_though_the_start_before_was_killed() {
    for durability in DURABILITIES {
        for change in 0.. {
            let (folder, cache) = (folder_in_memory(), Cache::default());
            let path = folder.path().join("state");
            let disk = Disk::stopping_at(change).with_cache(&cache);
            work(&path, disk.clone(), durability).await;
            let found = || {
                let disk = Disk::default().with_cache(&cache);
                let farm = Coordinator::open(disk, &path, durability).unwrap();
                let jobs = (1..=2).filter_map(|id| farm.shell.job(JobId(id)));
                let look = |job: Arc<Job>| {
                    let has_ended = job.progress().borrow().outcome.is_some();
                    (job.id, has_ended, job.canvas.done().unwrap())
                };
                jobs.map(look).collect::<Vec<_>>()
            };
            let before = found();
            cache.cut_power(|| true);
            assert_eq!(found(), before, "change {change}, {durability:?}");
            if !disk.has_failed() {
                break;
            }
        }
    }
}

#[tokio::test]
async fn a_disk_that_fails_at_any_change_makes_nothing_worse() {
    for durability in DURABILITIES {
        check_at_every_change(Disk::failing_at, durability, None).await;
    }
}

fn open(path: &Path, build: &str) -> Result<StateFolder, StateError> {
    StateFolder::open(path, build, Durability::Second)
}

fn check_refused(path: &Path, reason: &str) {
    let files = || -> Vec<(PathBuf, Vec<u8>)> {
        let entries = std::fs::read_dir(path).unwrap().map(|entry| entry.unwrap().path());
        let files = entries.filter(|path| path.is_file() && !path.ends_with("lock"));
        files.map(|path| (path.clone(), std::fs::read(path).unwrap())).collect()
    };
    let before = files();
    let error = open(path, BUILD).expect_err("it is refused").to_string();
    assert!(error.contains(reason), "{error}");
    assert_eq!(files(), before, "nothing is touched");
}

#[tokio::test]
async fn a_foreign_a_used_and_a_damaged_folder_are_refused_and_left_alone() {
    let folder = TempDir::new().unwrap();
    std::fs::write(folder.path().join("letter.txt"), "dear").unwrap();
    check_refused(folder.path(), "is not empty and holds no state of a farm");
    assert!(!folder.path().join("lock").exists());
    open(&folder.path().join("none/state"), BUILD).expect_err("its parent must be there");

    let path = folder.path().join("state");
    let farm = Coordinator::open(Disk::default(), &path, Durability::Second).unwrap();
    let id = farm.shell.submit(order(), Ticket::default()).unwrap().id;
    farm.render().await;
    let running = farm.shell.submit(order(), Ticket::default()).unwrap().id;
    assert_eq!((id, running), (JobId(1), JobId(2)));
    let process = std::process::id();
    check_refused(&path, &format!("another coordinator (process {process}) uses the state in"));
    drop(farm);

    let job = |id: u32, name: &str| path.join(format!("jobs/{id}/{name}"));
    for (file, reason) in [
        (path.join("farm"), "farm: its bytes are not those that were written"),
        (job(1, "job"), "jobs/1/job: its bytes are not those that were written"),
        (job(2, "scene"), "jobs/2/scene: "),
        (job(2, "picture"), "picture has another length than it must"),
        (job(1, "tiles"), "tiles has another length than it must"),
    ] {
        let good = std::fs::read(&file).unwrap();
        let mut bad = good.clone();
        let last = bad.pop().unwrap();
        if !file.ends_with("picture") && !file.ends_with("tiles") {
            bad.push(!last);
        }
        // A scene is read only.
        std::fs::remove_file(&file).unwrap();
        std::fs::write(&file, bad).unwrap();
        check_refused(&path, reason);
        std::fs::write(&file, "").unwrap();
        check_refused(&path, &file.file_name().unwrap().to_string_lossy());
        std::fs::remove_file(&file).unwrap();
        check_refused(&path, &file.file_name().unwrap().to_string_lossy());
        std::fs::write(&file, good).unwrap();
    }
    assert_eq!(open(&path, BUILD).unwrap().kept.len(), 2, "all is well again");
}

#[test]
fn what_is_known_of_workers_outlives_the_coordinator() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("state");
    let state = open(&path, BUILD).unwrap();
    assert!(state.marks().is_empty());
    let marks = BTreeMap::from([
        (5, Mark::Liar(WorkerId(7))),
        (2, Mark::Stationed(Standing::Draining)),
        (u64::MAX, Mark::Stationed(Standing::Disabled)),
    ]);
    state.keep_marks(&marks).unwrap();
    drop(state);
    let state = open(&path, BUILD).unwrap();
    assert_eq!(state.marks(), marks);
    drop(state);
    let farm = Coordinator::open(Disk::default(), &path, Durability::Second).unwrap();
    let process = Process { nonce: 5, ..Process::default() };
    assert_eq!(farm.shell.join(process), Err(KeptOut(WorkerId(7))));
    farm.shell.submit(order(), Ticket::default()).unwrap();
    drop(farm);
    assert_eq!(open(&path, BUILD).unwrap().marks(), marks, "numbers of jobs stand beside them");
}

#[tokio::test]
async fn a_job_that_another_build_began_fails_and_says_why() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("state");
    let farm = Coordinator::open(Disk::default(), &path, Durability::Second).unwrap();
    farm.shell.submit(order(), Ticket::default()).unwrap();
    farm.render().await;
    farm.shell.submit(order(), Ticket::default()).unwrap();
    drop(farm);
    let ends: Vec<Option<Outcome>> = open(&path, "1.2.4")
        .unwrap()
        .kept
        .into_iter()
        .map(|job| job.end.and_then(|end| end.0.outcome))
        .collect();
    let [Some(Outcome::Finished(_)), Some(Outcome::Failed(reason))] = &ends[..] else {
        panic!("{ends:?}")
    };
    assert_eq!(reason, "it was begun by rtfarm 1.2.3 test, and this is 1.2.4; submit it again");
}

#[tokio::test]
async fn a_farm_that_stops_in_good_order_goes_on_later() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("state");
    let farm = Coordinator::open(Disk::default(), &path, Durability::Second).unwrap();
    let job = farm.shell.submit(order(), Ticket::default()).unwrap();
    let first = farm.lease().await[0];
    assert!(farm.deliver(first));
    let name = farm.shell.identity;
    farm.shell.shut_down();
    assert_eq!(job.progress().borrow().outcome, None);
    drop((farm, job));

    let farm = Coordinator::open(Disk::default(), &path, Durability::Second).unwrap();
    assert_eq!(farm.shell.identity.farm, name.farm);
    assert_ne!(farm.shell.identity.incarnation, name.incarnation);
    assert_eq!(farm.render().await.len(), 5);
    let job = farm.shell.job(JobId(1)).unwrap();
    let progress = job.progress().borrow().clone();
    assert_eq!((progress.tiles_done, progress.tally.rays), (6, 6 * 64));
}
