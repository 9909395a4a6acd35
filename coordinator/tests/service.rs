//! The coordinator as its workers and clients meet it: real gRPC, workers that misbehave.

use std::{
    sync::{Arc, Mutex},
    task::{Context, Poll},
    time::Duration,
};

use rtfarm_coordinator::{Config, Coordinator, Keeping, Listener, OrderLimits};
use rtfarm_core::{
    prepared::SceneHash,
    render::{Quality, Sampling, Settings},
    tile::{Size, TileGrid},
};
use rtfarm_proto::{
    Access, Address, Bytes, JobId, LeaseName, PROTOCOL, TileHasher, pixels_to_bytes, scene_hash,
    wire::{
        self, event::End, farm_client::FarmClient, jobs_client::JobsClient, lease_response::Next,
        submit_request::Part, submit_response::Outcome,
    },
};
use rtfarm_worker::simulation::{Outside, run_in};
use tempfile::TempDir;
use tokio::{net::TcpListener, task::JoinHandle, time::Instant};
use tonic::{
    Code, Response, Status,
    body::Body,
    codegen::{Service, http},
    transport::Channel,
};

/// Nothing before the eye: a scene all the same.
const SCENE: &str = "viewport\norigin 0 0 -2\ntopleft -1 1 0\nbottomleft -1 -1 0\ntopright 1 1 0\n\
    background 10 20 30\nendviewport\n";

const VERSION: &str = "1.2.3";
const BUILD: &str = "a1b2";
const REFERENCE: [u8; 32] = [0xab; 32];

/// A farm with one worker, played by the test, and one job of 2 x 1 tiles of 8 x 8 pixels.
struct Farm {
    _folder: TempDir,
    address: Address,
    tiles: FarmClient<Channel>,
    jobs: JobsClient<Channel>,
    worker: u32,
    incarnation: u64,
    /// The id that clients name.
    named: Bytes,
    job: u64,
    scene: SceneHash,
    settings: Settings,
}

impl Farm {
    async fn new() -> Self {
        Self::with(OrderLimits::default(), Duration::from_secs(60)).await
    }

    /// With such limits, where who says nothing of a scene or takes nothing for that long is given
    /// up.
    async fn with(orders: OrderLimits, upload_silence: Duration) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address: Address =
            format!("http://{}", listener.local_addr().unwrap()).parse().unwrap();
        let coordinator = Coordinator::new(Config {
            version: VERSION.to_owned(),
            build: BUILD.to_owned(),
            reference: Some(REFERENCE),
            term: Duration::from_millis(300),
            audit: 0.0,
            keeping: Keeping::default(),
            upload_silence,
            events: None,
            begins_coarsely: false,
            host: None,
            orders,
            scene_folder: folder.path().to_owned(),
            picture_folder: folder.path().to_owned(),
        })
        .unwrap();
        tokio::spawn(async move {
            coordinator.run(Listener::Tcp(listener), std::future::pending()).await
        });
        let channel = address.connect().await.unwrap();
        let (mut tiles, mut jobs) = (FarmClient::new(channel.clone()), JobsClient::new(channel));
        let joined = tiles.join(join(VERSION)).await.unwrap().into_inner();
        let wire::JoinResponse { worker, incarnation, .. } = joined;
        let parts = [Part::Order(order(VERSION)), Part::Text(SCENE.into())]
            .map(|part| wire::SubmitRequest { part: Some(part) });
        let answer = jobs.submit(tokio_stream::iter(parts)).await.unwrap().into_inner();
        let Some(Outcome::Accepted(accepted)) = answer.outcome else { panic!("{answer:?}") };
        assert_eq!((accepted.tile_count, &accepted.farm), (2, &joined.farm));
        Self {
            _folder: folder,
            address,
            tiles,
            jobs,
            worker,
            incarnation,
            named: accepted.farm,
            job: accepted.job,
            scene: SceneHash([0; 32]),
            settings: Settings { size: Size::new(16, 8).unwrap(), quality: Quality::default() },
        }
    }

    /// Sends a scene whose preparing takes a while; answers with the call, and when all was sent.
    async fn begin_long_scene(
        &self,
    ) -> (JoinHandle<Result<Response<wire::SubmitResponse>, Status>>, Instant) {
        let (send, receive) = tokio::sync::mpsc::channel(1);
        let mut jobs = self.jobs.clone();
        let stream = tokio_stream::wrappers::ReceiverStream::new(receive);
        let submitting = tokio::spawn(async move { jobs.submit(stream).await });
        let text = long_scene();
        let pieces = text.as_bytes().chunks(1 << 20).map(|piece| Part::Text(piece.to_vec().into()));
        for part in std::iter::once(Part::Order(order(VERSION))).chain(pieces) {
            send.send(wire::SubmitRequest { part: Some(part) }).await.unwrap();
        }
        (submitting, Instant::now())
    }

    /// Cancels a job that was accepted.
    async fn cancel(&mut self, answer: wire::SubmitResponse) {
        let Some(Outcome::Accepted(accepted)) = answer.outcome else { panic!("{answer:?}") };
        let request = wire::CancelRequest { job: accepted.job, farm: accepted.farm };
        assert!(self.jobs.cancel(request).await.unwrap().into_inner().was_known);
    }

    /// Renders the job.
    async fn finish(&mut self) {
        while self.state().await.end.is_none() {
            let (lease, tiles) = self.lease().await;
            for tile in tiles {
                self.deliver(lease, tile, 0.5).await.unwrap();
            }
        }
    }

    /// Has a scene of some megabytes be the farm's next job.
    async fn submit_long_scene(&mut self) {
        let (submitting, _) = self.begin_long_scene().await;
        let answer = submitting.await.unwrap().unwrap().into_inner();
        let Some(Outcome::Accepted(accepted)) = answer.outcome else { panic!("{answer:?}") };
        self.job = accepted.job;
    }

    async fn lease(&mut self) -> (LeaseName, Vec<u32>) {
        let request = wire::LeaseRequest {
            worker: self.worker,
            max_tiles: 64,
            wait_ms: 5000,
            incarnation: self.incarnation,
            kept: None,
        };
        match self.tiles.lease(request).await.unwrap().into_inner().next {
            Some(Next::Run(run)) => {
                let job = run.job.unwrap();
                self.scene = scene_hash(&job.scene_hash).unwrap();
                self.settings = job.settings.unwrap().try_into().unwrap();
                (run.lease.unwrap().into(), run.tiles)
            }
            other => panic!("no tiles but {other:?}"),
        }
    }

    async fn deliver(
        &mut self,
        lease: LeaseName,
        tile: u32,
        value: f32,
    ) -> Result<wire::Verdict, Code> {
        let pixels = pixels_to_bytes(vec![[value; 3]; 64]);
        let hash = self.hash(tile, &pixels);
        self.send(lease, tile, pixels.to_vec(), hash).await
    }

    /// The hash that a worker gives such a tile; that of tile 0 when there is none of this number.
    fn hash(&self, tile: u32, pixels: &[u8]) -> Vec<u8> {
        let grid = TileGrid::new(self.settings.size, 8).unwrap();
        let tile = grid.tile(tile).or(grid.tile(0)).unwrap();
        let hasher = TileHasher::new(JobId(self.job), self.scene, self.settings, grid);
        hasher.hash(tile, pixels).to_vec()
    }

    async fn send(
        &mut self,
        lease: LeaseName,
        tile: u32,
        pixels: Vec<u8>,
        hash: Vec<u8>,
    ) -> Result<wire::Verdict, Code> {
        let finished = finished(lease, tile, pixels, hash);
        self.send_all(vec![finished]).await.map(|verdicts| verdicts[0])
    }

    async fn send_all(
        &mut self,
        tiles: Vec<wire::FinishedTile>,
    ) -> Result<Vec<wire::Verdict>, Code> {
        let (worker, incarnation) = (self.worker, self.incarnation);
        let delivery = wire::DeliverRequest { worker, incarnation, tiles };
        let answer = self.tiles.deliver(delivery).await;
        answer
            .map(|answer| answer.into_inner().verdicts().collect())
            .map_err(|status| status.code())
    }

    /// The state of the job now.
    async fn state(&mut self) -> wire::Event {
        let request = wire::WatchRequest { job: self.job, farm: self.named.clone() };
        let mut events = self.jobs.watch(request).await.unwrap().into_inner();
        events.message().await.unwrap().unwrap()
    }
}

fn finished(lease: LeaseName, tile: u32, pixels: Vec<u8>, hash: Vec<u8>) -> wire::FinishedTile {
    wire::FinishedTile {
        lease: Some(lease.into()),
        tile,
        pixels: pixels.into(),
        hash: hash.into(),
        seconds: 0.1,
        tally: Some(wire::Tally { rays: 64, ..wire::Tally::default() }),
    }
}

/// A question of a worker for a tile, which waits for nothing.
fn lease_of(worker: u32, incarnation: u64) -> wire::LeaseRequest {
    wire::LeaseRequest { worker, max_tiles: 1, wait_ms: 0, incarnation, kept: None }
}

fn order(version: &str) -> wire::Order {
    wire::Order {
        version: version.to_owned(),
        protocol: PROTOCOL,
        name: "test".to_owned(),
        frame: Some(wire::Frame { width: 16, height: 8 }),
        quality: Some(
            Quality { sampling: Sampling::fixed(1).unwrap(), ..Quality::default() }.into(),
        ),
        tile_side: 8,
        format: wire::Format::Png8.into(),
        transfer: wire::Transfer::None.into(),
        ..wire::Order::default()
    }
}

fn join(version: &str) -> wire::JoinRequest {
    wire::JoinRequest {
        version: version.to_owned(),
        protocol: PROTOCOL,
        nonce: 1,
        threads: 1,
        isa: "avx2".to_owned(),
        build: BUILD.to_owned(),
        reference: REFERENCE.to_vec().into(),
        ..wire::JoinRequest::default()
    }
}

#[tokio::test]
async fn a_worker_that_would_make_other_pixels_is_refused_and_told_why() {
    let mut farm = Farm::new().await;
    let refusals = [
        (join("1.2.4"), "rtfarm 1.2.4"),
        (
            wire::JoinRequest { build: "c3d4".to_owned(), ..join(VERSION) },
            "built from other sources (build `c3d4`) than the coordinator (build `a1b2`)",
        ),
        (
            wire::JoinRequest { reference: vec![0xcd; 32].into(), ..join(VERSION) },
            "with avx2, makes other pixels of the reference tile",
        ),
        (wire::JoinRequest { reference: vec![].into(), ..join(VERSION) }, "reference tile"),
    ];
    for (request, reason) in refusals {
        let status = farm.tiles.join(request).await.unwrap_err();
        assert_eq!(status.code(), Code::FailedPrecondition);
        assert!(status.message().contains(reason), "{}", status.message());
    }
    farm.tiles.join(join(VERSION)).await.unwrap();
}

#[tokio::test]
async fn a_second_copy_that_differs_is_counted_and_changes_nothing() {
    let mut farm = Farm::new().await;
    let (lease, tiles) = farm.lease().await;
    assert_eq!(farm.deliver(lease, tiles[0], 0.5).await, Ok(wire::Verdict::Accepted));
    assert_eq!(farm.deliver(lease, tiles[0], 0.5).await, Ok(wire::Verdict::Duplicate));
    assert_eq!(farm.state().await.differing_tiles, 0);
    assert_eq!(farm.deliver(lease, tiles[0], 0.6).await, Ok(wire::Verdict::Duplicate));
    let state = farm.state().await;
    assert_eq!((state.differing_tiles, state.tiles_done), (1, 1));
}

#[tokio::test]
async fn a_lease_without_progress_is_given_again_and_late_pixels_count() {
    let mut farm = Farm::new().await;
    let (late, tiles) = farm.lease().await;
    let (second, again) = loop {
        // The first run may hold one tile; the other is free until it is leased.
        let (lease, more) = farm.lease().await;
        if more.contains(&tiles[0]) {
            break (lease, more);
        }
    };
    let renewal = wire::RenewRequest {
        worker: farm.worker,
        renewals: vec![wire::Renewal { lease: Some(late.into()), work: 1, tiles: vec![] }],
        incarnation: farm.incarnation,
    };
    let lost = farm.tiles.renew(renewal).await.unwrap().into_inner().lost;
    assert_eq!(lost, [late.into()]);
    assert_eq!(farm.deliver(late, tiles[0], 0.5).await, Ok(wire::Verdict::Accepted));
    assert_eq!(farm.deliver(second, again[0], 0.5).await, Ok(wire::Verdict::Duplicate));
}

#[tokio::test]
async fn tiles_of_one_message_are_decided_one_by_one() {
    let mut farm = Farm::new().await;
    let (lease, tiles) = farm.lease().await;
    let bytes = vec![0; 64 * 12];
    let good = finished(lease, tiles[0], bytes.clone(), farm.hash(tiles[0], &bytes));
    let unknown = finished(lease, 99, bytes.clone(), farm.hash(99, &bytes));
    let damaged = finished(lease, tiles[0], bytes, vec![7; 32]);
    let verdicts = farm.send_all(vec![good.clone(), damaged]).await;
    assert_eq!(verdicts, Err(Code::DataLoss), "the message is sent again");
    assert_eq!(farm.state().await.tiles_done, 0);
    let verdicts = farm.send_all(vec![unknown, good.clone(), good.clone()]).await;
    let [rejected, accepted, duplicate] =
        [wire::Verdict::Rejected, wire::Verdict::Accepted, wire::Verdict::Duplicate];
    assert_eq!(verdicts, Ok(vec![rejected, accepted, duplicate]));
    assert_eq!(farm.send_all(vec![good]).await, Ok(vec![duplicate]));
    assert_eq!(farm.send_all(vec![]).await, Ok(vec![]));
    assert_eq!(farm.state().await.tiles_done, 1);
}

#[tokio::test]
async fn damaged_and_senseless_pixels_are_refused() {
    let mut farm = Farm::new().await;
    let (lease, tiles) = farm.lease().await;
    let bytes = vec![0; 64 * 12];
    let hash = farm.hash(tiles[0], &bytes);
    assert_eq!(farm.send(lease, tiles[0], bytes.clone(), vec![0; 32]).await, Err(Code::DataLoss));
    let short = vec![0; 13];
    let short_hash = farm.hash(tiles[0], &short);
    let other_tile = farm.hash(1 - tiles[0], &bytes);
    assert_eq!(farm.send(lease, tiles[0], bytes.clone(), other_tile).await, Err(Code::DataLoss));
    let plain = blake3::hash(&bytes).as_bytes().to_vec();
    assert_eq!(farm.send(lease, tiles[0], bytes.clone(), plain).await, Err(Code::DataLoss));
    let rejected = Ok(wire::Verdict::Rejected);
    assert_eq!(farm.send(lease, tiles[0], short, short_hash).await, rejected);
    assert_eq!(farm.send(lease, 99, vec![0; 64 * 12], hash).await, rejected);
    assert_eq!(farm.state().await.tiles_done, 0);

    assert_eq!(farm.deliver(lease, tiles[0], f32::NAN).await, rejected);
    assert!(farm.state().await.end.is_none(), "the worker is to blame");
    let (lease, tiles) = farm.lease().await;
    assert_eq!(farm.deliver(lease, tiles[0], f32::NAN).await, rejected);
    let Some(End::Failed(reason)) = farm.state().await.end else { panic!("it goes on") };
    assert!(reason.contains("is not a number"), "{reason}");
}

#[tokio::test]
async fn strangers_are_told_what_is_wrong() {
    let mut farm = Farm::new().await;
    let status = farm.tiles.join(join("1.2.4")).await.unwrap_err();
    assert_eq!(status.code(), Code::FailedPrecondition);
    assert!(status.message().contains("rtfarm 1.2.4") && status.message().contains(VERSION));
    let incarnation = farm.incarnation;
    let request = lease_of(77, incarnation);
    assert_eq!(farm.tiles.lease(request).await.unwrap_err().code(), Code::NotFound);
    let request = wire::FetchRequest { scene_hash: vec![1; 32].into(), incarnation };
    assert_eq!(farm.tiles.fetch(request).await.unwrap_err().code(), Code::NotFound);
    let request = wire::WatchRequest { job: 77, farm: farm.named.clone() };
    assert_eq!(farm.jobs.watch(request).await.unwrap_err().code(), Code::NotFound);
    let request = wire::ImageRequest { job: farm.job, farm: farm.named.clone(), partial: false };
    assert_eq!(farm.jobs.image(request).await.unwrap_err().code(), Code::FailedPrecondition);
}

/// A scene that takes a while to prepare.
fn long_scene() -> String {
    let triangle = |k: u32| {
        let (x, y) = (f64::from(k % 300) / 300.0, f64::from(k / 300) / 300.0);
        let (right, up) = (x + 0.003, y + 0.003);
        format!(
            "triangle\nvertex {x} {y} 1\nvertex {right} {y} 1\nvertex {x} {up} 1\n\
            material m\nendtriangle\n"
        )
    };
    let triangles: String = (0..90_000).map(triangle).collect();
    let materials = "materials\nentry\nname m\ncolor 1 2 3\nendentry\nendmaterials\n";
    format!("{SCENE}{materials}geometry\n{triangles}endgeometry\n")
}

#[tokio::test(flavor = "multi_thread")]
async fn a_client_that_goes_while_its_scene_is_prepared_leaves_no_job() {
    let mut farm = Farm::new().await;
    for _ in 0..2 {
        let (lease, tiles) = farm.lease().await;
        for tile in tiles {
            farm.deliver(lease, tile, 0.5).await.unwrap();
        }
        if farm.state().await.end.is_some() {
            break;
        }
    }
    // How long the farm prepares a scene that it has: half of it later it still does, or a quarter.
    let (mut submitting, sent) = farm.begin_long_scene().await;
    let answer = (&mut submitting).await.unwrap().unwrap().into_inner();
    let mut delay = sent.elapsed() / 2;
    farm.cancel(answer).await;
    loop {
        (submitting, _) = farm.begin_long_scene().await;
        tokio::time::sleep(delay).await;
        if !submitting.is_finished() {
            break submitting.abort();
        }
        farm.cancel(submitting.await.unwrap().unwrap().into_inner()).await;
        delay /= 2;
    }
    let request = wire::LeaseRequest {
        worker: farm.worker,
        incarnation: farm.incarnation,
        max_tiles: 64,
        wait_ms: 5000,
        kept: None,
    };
    let next = farm.tiles.lease(request).await.unwrap().into_inner().next;
    assert!(matches!(next, Some(Next::Nothing(_))), "{next:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn scenes_that_nobody_takes_keep_no_tile_waiting() {
    let mut farm = Farm::new().await;
    farm.finish().await;
    farm.submit_long_scene().await;
    let (lease, tiles) = farm.lease().await;
    let request = wire::FetchRequest {
        scene_hash: farm.scene.0.to_vec().into(),
        incarnation: farm.incarnation,
    };
    // More than there are threads for what blocks, on connections that have room for so many.
    let mut streams = Vec::new();
    for _ in 0..6 {
        let mut client = FarmClient::new(farm.address.connect().await.unwrap());
        for _ in 0..100 {
            streams.push(client.fetch(request.clone()).await.unwrap().into_inner());
        }
    }
    tokio::time::sleep(Duration::from_millis(500)).await;
    let delivering = farm.deliver(lease, tiles[0], 0.5);
    let delivered = tokio::time::timeout(Duration::from_secs(40), delivering).await;
    assert_eq!(delivered.expect("an answer"), Ok(wire::Verdict::Accepted));
    drop(streams);
}

#[tokio::test(flavor = "multi_thread")]
async fn what_is_on_its_way_has_so_many_bytes_and_who_takes_nothing_loses_its_connection() {
    // Room for four pieces each way: two streams have as many on their way.
    let orders = OrderLimits { flight_bytes: 4 << 20, ..OrderLimits::default() };
    let mut farm = Farm::with(orders, Duration::from_secs(1)).await;
    farm.finish().await;
    farm.submit_long_scene().await;
    farm.lease().await;
    let request = wire::FetchRequest {
        scene_hash: farm.scene.0.to_vec().into(),
        incarnation: farm.incarnation,
    };
    // Who takes nothing has all of it, and is not waited for beyond its patience.
    let idle = farm.address.connect().await.unwrap();
    let mut streams = Vec::new();
    for _ in 0..12 {
        let mut client = FarmClient::new(idle.clone());
        streams.push(client.fetch(request.clone()).await.unwrap().into_inner());
    }
    let mut client = FarmClient::new(farm.address.connect().await.unwrap());
    let mut pieces = client.fetch(request).await.unwrap().into_inner();
    let first = tokio::time::timeout(Duration::from_millis(300), pieces.message()).await;
    assert!(first.is_err(), "there is no room: {first:?}");
    let whole = async {
        let mut byte_count = 0;
        while let Some(chunk) = pieces.message().await.unwrap() {
            byte_count += chunk.data.len();
        }
        byte_count
    };
    let byte_count = tokio::time::timeout(Duration::from_secs(40), whole).await.unwrap();
    assert!(byte_count > 4 << 20, "{byte_count}");
    let mut cut = 0;
    for mut stream in streams {
        let end = async {
            while stream.message().await?.is_some() {}
            Ok::<(), tonic::Status>(())
        };
        cut +=
            u32::from(tokio::time::timeout(Duration::from_secs(40), end).await.unwrap().is_err());
    }
    assert!(cut > 0, "the connection is closed");
}

/// Begins to submit and goes on no further than the order.
async fn begin_to_submit(farm: &Farm, version: &str) -> tokio::task::JoinHandle<Code> {
    let (send, receive) = tokio::sync::mpsc::channel(1);
    send.send(wire::SubmitRequest { part: Some(Part::Order(order(version))) }).await.unwrap();
    let mut jobs = farm.jobs.clone();
    let stream = tokio_stream::wrappers::ReceiverStream::new(receive);
    tokio::spawn(async move {
        let code = jobs.submit(stream).await.unwrap_err().code();
        drop(send);
        code
    })
}

#[tokio::test]
async fn a_client_of_another_version_is_refused_before_it_sends_its_scene() {
    let farm = Farm::new().await;
    let refused = begin_to_submit(&farm, "1.2.4").await;
    let refused = tokio::time::timeout(Duration::from_secs(40), refused).await;
    assert_eq!(refused.expect("an answer before the end").unwrap(), Code::FailedPrecondition);
}

#[tokio::test]
async fn an_upload_that_stands_still_is_dropped() {
    let farm = Farm::with(OrderLimits::default(), Duration::from_millis(600)).await;
    let dropped = begin_to_submit(&farm, VERSION).await;
    let dropped = tokio::time::timeout(Duration::from_secs(40), dropped).await;
    assert_eq!(dropped.expect("it is dropped").unwrap(), Code::DeadlineExceeded);
}

#[tokio::test]
async fn what_is_being_sent_has_so_many_bytes_of_all_clients_together() {
    let orders = OrderLimits { upload_bytes: 3000, ..OrderLimits::default() };
    let farm = Farm::with(orders, Duration::from_secs(60)).await;
    let part = |part| wire::SubmitRequest { part: Some(part) };
    let long = || part(Part::Text(vec![b' '; 2000].into()));
    let begin = async || {
        let (send, receive) = tokio::sync::mpsc::channel(4);
        send.send(part(Part::Order(order(VERSION)))).await.unwrap();
        send.send(long()).await.unwrap();
        let mut jobs = farm.jobs.clone();
        let stream = tokio_stream::wrappers::ReceiverStream::new(receive);
        (send, tokio::spawn(async move { jobs.submit(stream).await }))
    };
    let mut jobs = farm.jobs.clone();
    let mut second = async || {
        let parts = [part(Part::Order(order(VERSION))), long(), part(Part::Text(SCENE.into()))];
        jobs.submit(tokio_stream::iter(parts)).await
    };
    // The first is not at its end, and there is no room for a second as long.
    let (mut send, mut first) = begin().await;
    loop {
        match second().await {
            // It was earlier than the other, for which there may have been no room meanwhile.
            Ok(_) if first.is_finished() => (send, first) = begin().await,
            Ok(_) => tokio::task::yield_now().await,
            Err(status) => {
                assert_eq!(status.code(), Code::ResourceExhausted);
                assert!(status.message().contains("scenes that are being sent"), "{status}");
                break;
            }
        }
    }
    send.send(part(Part::Text(SCENE.into()))).await.unwrap();
    drop(send);
    assert!(matches!(
        first.await.unwrap().unwrap().into_inner().outcome,
        Some(Outcome::Accepted(_))
    ));
    second().await.unwrap();
}

#[tokio::test]
async fn calls_meant_for_another_start_of_the_coordinator_are_refused() {
    let mut farm = Farm::new().await;
    let (lease, tiles) = farm.lease().await;
    let (worker, job, incarnation) = (farm.worker, farm.job, farm.incarnation ^ 1);
    let request = lease_of(worker, incarnation);
    let status = farm.tiles.lease(request).await.unwrap_err();
    assert_eq!(status.code(), Code::NotFound);
    assert!(status.message().contains("not meant for this start"), "{status}");
    let renewals = vec![wire::Renewal { lease: Some(lease.into()), work: 1, tiles: vec![] }];
    let request = wire::RenewRequest { worker, incarnation, renewals };
    assert_eq!(farm.tiles.renew(request).await.unwrap_err().code(), Code::NotFound);
    let request = wire::LeaveRequest { worker, incarnation, reason: String::new() };
    assert_eq!(farm.tiles.leave(request).await.unwrap_err().code(), Code::NotFound);
    let another: Bytes = farm.named.iter().map(|byte| byte ^ 1).collect();
    let request = wire::WatchRequest { job, farm: another.clone() };
    assert_eq!(farm.jobs.watch(request).await.unwrap_err().code(), Code::NotFound);
    let request = wire::CancelRequest { job, farm: another };
    assert_eq!(farm.jobs.cancel(request).await.unwrap_err().code(), Code::NotFound);
    farm.incarnation ^= 1;
    assert_eq!(farm.deliver(lease, tiles[0], 0.5).await, Err(Code::NotFound));
    farm.incarnation ^= 1;
    assert_eq!(farm.state().await.tiles_done, 0);
    assert_eq!(farm.deliver(lease, tiles[0], 0.5).await, Ok(wire::Verdict::Accepted));
}

#[tokio::test]
async fn who_never_joined_brings_no_pixels() {
    let mut farm = Farm::new().await;
    let (lease, tiles) = farm.lease().await;
    let member = std::mem::replace(&mut farm.worker, 77);
    assert_eq!(farm.deliver(lease, tiles[0], 0.5).await, Ok(wire::Verdict::Rejected));
    assert_eq!(farm.state().await.tiles_done, 0);
    farm.worker = member;
    assert_eq!(farm.deliver(lease, tiles[0], 0.5).await, Ok(wire::Verdict::Accepted));
}

/// A connection to a coordinator, by its number, that notes what is called over it.
#[derive(Clone)]
struct Noted {
    channel: Channel,
    number: usize,
    calls: Arc<Mutex<Vec<(usize, String)>>>,
}

impl Service<http::Request<Body>> for Noted {
    type Response = http::Response<Body>;
    type Error = tonic::transport::Error;
    type Future = <Channel as Service<http::Request<Body>>>::Future;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<Result<(), Self::Error>> {
        Service::poll_ready(&mut self.channel, context)
    }

    fn call(&mut self, request: http::Request<Body>) -> Self::Future {
        self.calls.lock().unwrap().push((self.number, request.uri().path().to_owned()));
        Service::call(&mut self.channel, request)
    }
}

/// A worker's surroundings, whose connections are noted.
struct Surroundings {
    connection_count: Mutex<usize>,
    calls: Arc<Mutex<Vec<(usize, String)>>>,
}

impl Outside for Surroundings {
    type Connection = Noted;

    async fn connect(&self, access: &Access) -> Result<Noted, String> {
        let channel = access.address().connect().await.map_err(|error| error.to_string())?;
        let mut number = self.connection_count.lock().unwrap();
        *number += 1;
        Ok(Noted { channel, number: *number, calls: Arc::clone(&self.calls) })
    }

    fn render(&self, work: impl FnOnce(tokio::time::Instant) + Send + 'static) {
        work(tokio::time::Instant::now());
    }

    async fn block<T: Send + 'static>(&self, work: impl FnOnce() -> T + Send + 'static) -> T {
        work()
    }
}

#[tokio::test]
async fn a_scene_comes_over_a_connection_of_its_own() {
    let mut farm = Farm::new().await;
    let calls = Arc::default();
    let surroundings =
        Surroundings { connection_count: Mutex::default(), calls: Arc::clone(&calls) };
    let config = rtfarm_worker::Config {
        coordinator: farm.address.clone().into(),
        threads: 1,
        isa: rtfarm_core::isa::Isa::Scalar,
        version: VERSION.to_owned(),
        build: BUILD.to_owned(),
        reference: Some(REFERENCE),
        memory: None,
        patience: Duration::from_secs(5),
    };
    let worker = tokio::spawn(run_in(surroundings, config, 1, std::future::pending()));
    let request = wire::WatchRequest { job: farm.job, farm: farm.named.clone() };
    let mut events = farm.jobs.watch(request).await.unwrap().into_inner();
    while let Some(event) = events.message().await.unwrap() {
        if event.end.is_some() {
            assert!(matches!(event.end, Some(End::Finished(_))), "{event:?}");
            break;
        }
    }
    worker.abort();
    let calls: Vec<(usize, String)> = std::mem::take(&mut calls.lock().unwrap());
    let connections = |name: &str| -> Vec<usize> {
        let of_name = calls.iter().filter(|(_, path)| path.ends_with(name));
        of_name.map(|(connection, _)| *connection).collect()
    };
    assert_eq!(connections("/Fetch"), [2], "{calls:?}");
    assert!(connections("/Deliver").iter().all(|&connection| connection == 1), "{calls:?}");
    assert!(!connections("/Deliver").is_empty());
}
