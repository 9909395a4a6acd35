//! What a coordinator carries: simulated workers that render nothing, each with its own connection
//! over loopback, join at once and bring tiles of 16 x 16 pixels in time with a given rate.
//!
//! `cargo bench -p rtfarm-coordinator --bench load [-- WORKERS RATE TILES SECONDS FOLDER STATE
//! SIDE]`
//!
//! RATE is in tiles a second, over all workers; with 0 each worker brings its next tiles as soon as
//! it has an answer. TILES of SIDE x SIDE pixels, 16 by default, come in one delivery. The picture
//! is made in FOLDER; with STATE `second` or `tile` it outlives the coordinator, which is as safe
//! when a tile is acknowledged as with `--state` and `--durable`. Latencies are from the moment
//! when a delivery was to be sent to its answer, processor time is that of the coordinator and the
//! simulated workers together.

use std::{
    env,
    io::{self, Write},
    path::PathBuf,
    time::Duration,
};

use rtfarm_coordinator::{
    Config, Coordinator, Durability, Keeping, Listener, OrderLimits, StateFolder, listen,
};
use rtfarm_core::{
    prepare::Form,
    render::{Quality, Sampling},
    tile::{Size, TileGrid},
    transfer::Transfer,
};
use rtfarm_job::{Order, RenderRequest};
use rtfarm_picture::PictureFormat;
use rtfarm_proto::{
    Address, Bytes, JobId, PROTOCOL, TileHasher, pixels_to_bytes, scene_hash,
    wire::{self, farm_client::FarmClient, lease_response::Next},
};
use tokio::{
    task::JoinSet,
    time::{Instant, sleep_until},
};
use tonic::transport::Channel;

const VERSION: &str = "bench";

const SCENE: &str = "viewport\norigin 0 0 -2\ntopleft -1 1 0\nbottomleft -1 -1 0\ntopright 1 1 0\n\
    endviewport\n";

#[derive(Debug, Clone, Copy)]
struct Load {
    workers: u32,
    rate: f64,
    tiles: usize,
    time: Duration,
    state: Option<Durability>,
    /// The side of a tile in pixels.
    side: u32,
}

type Error = Box<dyn std::error::Error + Send + Sync>;

fn main() -> Result<(), Error> {
    let words: Vec<String> = env::args().skip(1).filter(|word| word != "--bench").collect();
    let word = |index: usize, default: &str| {
        words.get(index).map_or_else(|| default.to_owned(), String::clone)
    };
    let load = Load {
        workers: word(0, "1000").parse()?,
        rate: word(1, "12000").parse()?,
        tiles: word(2, "4").parse()?,
        time: Duration::from_secs_f64(word(3, "10").parse()?),
        state: match &*word(5, "none") {
            "second" => Some(Durability::Second),
            "tile" => Some(Durability::Tile),
            _ => None,
        },
        side: word(6, "16").parse()?,
    };
    let folder = PathBuf::from(word(4, "/dev/shm"));
    tokio::runtime::Builder::new_multi_thread().enable_all().build()?.block_on(run(load, folder))
}

async fn run(load: Load, folder: PathBuf) -> Result<(), Error> {
    let scenes = tempfile::tempdir()?;
    let listener = listen("127.0.0.1:0".parse()?)?;
    let address: Address = format!("http://{}", listener.local_addr()?).parse()?;
    let state = tempfile::tempdir_in(&folder)?;
    let config = Config {
        version: VERSION.to_owned(),
        build: VERSION.to_owned(),
        reference: None,
        audit: 0.0,
        term: Duration::from_secs(60),
        upload_silence: Duration::from_secs(30),
        events: None,
        begins_coarsely: false,
        host: None,
        orders: OrderLimits::default(),
        scene_folder: scenes.path().to_owned(),
        picture_folder: folder,
        keeping: Keeping::default(),
    };
    let coordinator = match load.state {
        None => Coordinator::new(config)?,
        Some(durability) => {
            let folder = StateFolder::open(state.path(), VERSION, durability)?;
            Coordinator::with_state(config, folder)?
        }
    };
    let job = tokio::task::spawn_blocking({
        let coordinator = coordinator.clone();
        move || coordinator.submit(order(load.side))
    });
    let job = job.await??;
    let progress = job.progress();
    tokio::spawn(
        async move { coordinator.run(Listener::Tcp(listener), std::future::pending()).await },
    );

    let started = Instant::now();
    let mut joining = JoinSet::new();
    for number in 0..load.workers {
        joining.spawn(join(number, address.clone()));
    }
    let mut members = Vec::new();
    while let Some(joined) = joining.join_next().await {
        members.push(joined??);
    }
    let mut out = io::stdout().lock();
    let joined = started.elapsed();
    writeln!(out, "{} workers joined in {:.3} s", load.workers, joined.as_secs_f64())?;

    let (before, begun) = (processor_time(), Instant::now());
    let mut workers = JoinSet::new();
    for (number, (farm, member)) in (0..).zip(members) {
        workers.spawn(work(number, load, farm, member));
    }
    let mut latencies = Vec::new();
    while let Some(worked) = workers.join_next().await {
        latencies.append(&mut worked??);
    }
    let (time, processor) = (begun.elapsed(), processor_time().saturating_sub(before));
    latencies.sort_unstable();
    let at = |part: f64| {
        let index = (part * latencies.len() as f64) as usize;
        latencies.get(index.min(latencies.len() - 1)).map_or(f64::NAN, |l| l.as_secs_f64() * 1e3)
    };
    let tiles = progress.borrow().tiles_done;
    writeln!(
        out,
        "{tiles} tiles in {:.2} s: {:.0} tiles/s, {:.1} us of processor time a tile; \
         deliveries of {} tiles: median {:.1} ms, p99 {:.1} ms, longest {:.1} ms",
        time.as_secs_f64(),
        f64::from(tiles) / time.as_secs_f64(),
        processor.as_secs_f64() * 1e6 / f64::from(tiles),
        load.tiles,
        at(0.5),
        at(0.99),
        at(1.0),
    )?;
    Ok(())
}

fn order(side: u32) -> Order {
    let request = RenderRequest {
        name: "load".to_owned(),
        strict: false,
        size: Some(Size::new(16_384, 16_384).expect("a size")),
        crop: None,
        form: Form::Fast,
        quality: Quality { sampling: Sampling::fixed(1).expect("a number"), ..Quality::default() },
        tile_side: Some(side.into()),
        transfer: Transfer::None,
        format: PictureFormat::Png8,
    };
    let placed = request.place(SCENE.as_bytes(), &|_| Err(io::Error::other("there are no files")));
    placed.order.expect("the scene is good")
}

/// Connects and joins.
async fn join(
    number: u32,
    address: Address,
) -> Result<(FarmClient<Channel>, wire::JoinResponse), Error> {
    let mut farm = FarmClient::new(address.connect().await?);
    let introduction = wire::JoinRequest {
        version: VERSION.to_owned(),
        build: VERSION.to_owned(),
        reference: vec![0; 32].into(),
        protocol: PROTOCOL,
        nonce: number.into(),
        threads: 1,
        ..wire::JoinRequest::default()
    };
    let member = farm.join(introduction).await?.into_inner();
    Ok((farm, member))
}

/// A worker's life, which ends after the time of the load. Answers with how long each delivery
/// took.
async fn work(
    number: u32,
    load: Load,
    mut farm: FarmClient<Channel>,
    member: wire::JoinResponse,
) -> Result<Vec<Duration>, Error> {
    let start = Instant::now();
    let period = (load.rate > 0.0)
        .then(|| Duration::from_secs_f64(f64::from(load.workers) * load.tiles as f64 / load.rate));
    // Workers take turns.
    let mut due = start + period.unwrap_or_default() * number / load.workers;
    let pixels = pixels_to_bytes(vec![[0.5; 3]; (load.side * load.side) as usize]);
    let mut latencies = Vec::new();
    'life: loop {
        let tiles = lease(&mut farm, &member, load.side, &pixels).await?;
        for tiles in tiles.chunks(load.tiles) {
            if period.is_some() {
                sleep_until(due).await;
            }
            let sent = period.map_or_else(Instant::now, |_| due);
            if start.elapsed() > load.time {
                break 'life;
            }
            let request = wire::DeliverRequest {
                worker: member.worker,
                incarnation: member.incarnation,
                tiles: tiles.to_vec(),
            };
            farm.deliver(request).await?;
            latencies.push(sent.elapsed());
            due += period.unwrap_or_default();
        }
    }
    Ok(latencies)
}

/// Tiles that are as good as rendered.
async fn lease(
    farm: &mut FarmClient<Channel>,
    member: &wire::JoinResponse,
    side: u32,
    pixels: &Bytes,
) -> Result<Vec<wire::FinishedTile>, Error> {
    let request = wire::LeaseRequest {
        worker: member.worker,
        incarnation: member.incarnation,
        max_tiles: 64,
        wait_ms: 10_000,
        ..wire::LeaseRequest::default()
    };
    let Some(Next::Run(run)) = farm.lease(request).await?.into_inner().next else {
        return Err("there are no tiles left".into());
    };
    let (lease, job) = (run.lease.ok_or("no lease")?, run.job.ok_or("no job")?);
    let settings = job.settings.ok_or("no settings")?.try_into()?;
    let grid = TileGrid::new(Size::new(16_384, 16_384)?, side.into())?;
    let hasher = TileHasher::new(JobId(lease.job), scene_hash(&job.scene_hash)?, settings, grid);
    let finish = |&tile: &u32| wire::FinishedTile {
        lease: Some(lease),
        tile,
        pixels: pixels.clone(),
        hash: hasher.hash(grid.tile(tile).expect("a tile"), pixels).to_vec().into(),
        seconds: 1e-4,
        tally: Some(wire::Tally::default()),
    };
    Ok(run.tiles.iter().map(finish).collect())
}

/// The time that this process has had on processors.
fn processor_time() -> Duration {
    let now = rustix::time::clock_gettime(rustix::time::ClockId::ProcessCPUTime);
    Duration::new(now.tv_sec.cast_unsigned(), now.tv_nsec as u32)
}
