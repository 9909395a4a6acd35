//! A worker that lies, as a client of the farm's own protocol.

use rtfarm_core::{
    isa::Isa,
    tile::{Crop, TileGrid},
};
use rtfarm_proto::{
    Address, JobId, PROTOCOL, TileHasher, pixels_to_bytes, scene_hash,
    wire::{self, farm_client::FarmClient, lease_response::Next},
};

use tokio::sync::oneshot;

use super::*;

/// What the liar says of itself when it joins.
fn introduction() -> wire::JoinRequest {
    wire::JoinRequest {
        version: env!("CARGO_PKG_VERSION").to_owned(),
        protocol: PROTOCOL,
        nonce: 666,
        threads: 1,
        build: env!("RTFARM_BUILD").to_owned(),
        reference: rtfarm_worker::reference(Isa::Scalar).to_vec().into(),
        ..wire::JoinRequest::default()
    }
}

/// Joins, and brings grey tiles with the right hashes until nobody wants them any more. Answers
/// with how many were taken, and why it was refused in the end. Once some were taken it waits until
/// others are there, who know better: alone it would finish the picture.
async fn lie(url: &str, others: oneshot::Receiver<()>) -> (usize, tonic::Status) {
    let mut others = Some(others);
    let address: Address = url.parse().unwrap();
    let mut client = FarmClient::new(address.connect().await.unwrap());
    let joined = client.join(introduction()).await.unwrap().into_inner();
    let wire::JoinResponse { worker, incarnation, .. } = joined;
    let mut accepted = 0;
    loop {
        let request = wire::LeaseRequest {
            worker,
            incarnation,
            max_tiles: 4,
            wait_ms: 100,
            ..wire::LeaseRequest::default()
        };
        let next = match client.lease(request).await {
            Ok(answer) => answer.into_inner().next,
            // It is no member any more, and cannot become one.
            Err(_) => return (accepted, client.join(introduction()).await.unwrap_err()),
        };
        let Some(Next::Run(run)) = next else { continue };
        let (lease, job) = (run.lease.unwrap(), run.job.unwrap());
        let settings = rtfarm_core::render::Settings::try_from(job.settings.unwrap()).unwrap();
        let window = Crop::from(job.window.unwrap()).of(settings.size).unwrap();
        let grid = TileGrid::new(window, job.tile_side.into()).unwrap();
        let scene = scene_hash(&job.scene_hash).unwrap();
        let hasher = TileHasher::new(JobId(lease.job), scene, settings, grid);
        let tiles = run.tiles.iter().map(|&number| {
            let tile = grid.tile(number).unwrap();
            let pixels = pixels_to_bytes(vec![[0.5; 3]; grid.area(tile).pixel_count()]);
            wire::FinishedTile {
                lease: Some(lease),
                tile: number,
                hash: hasher.hash(tile, &pixels).to_vec().into(),
                pixels,
                seconds: 0.001,
                tally: Some(wire::Tally::default()),
            }
        });
        let tiles = tiles.collect();
        let request = wire::DeliverRequest { worker, incarnation, tiles };
        let verdicts = client.deliver(request).await.unwrap().into_inner().verdicts;
        let is_taken = |verdict: &&i32| **verdict == i32::from(wire::Verdict::Accepted);
        accepted += verdicts.iter().filter(is_taken).count();
        if accepted >= 4
            && let Some(others) = others.take()
        {
            others.await.unwrap();
        }
    }
}

#[test]
fn a_worker_that_lies_is_kept_out_also_by_the_next_coordinator_and_leaves_no_pixel() {
    let place = Place::new();
    let picture = ["--size", "96x64", "--tile", "8", "--samples", "64"];
    let here = place.render("here.png", &[&picture[..], &["--workers", "0"]].concat());
    let args = ["coordinator", "--insecure", "--state", "state", "--listen"];
    let mut coordinator = place.start("first.log", &[&args[..], &[&own_address()]].concat());
    let line = coordinator.read_line();
    let url = line.trim().strip_prefix("listening on ").expect(&line).to_owned();
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let submit = ["submit", "scene.rt", "-o", "out.png", "--coordinator", &url];
    let mut submit = place.start("submit.log", &[&submit[..], &picture].concat());
    let (tell, others_are_there) = oneshot::channel();
    let liar = runtime.spawn({
        let url = url.clone();
        async move { lie(&url, others_are_there).await }
    });
    poll(|| (coordinator.tiles_done() >= 4).then_some(()));
    let worker = ["worker", "--threads", "1", "--coordinator", &url];
    let workers = ["a.log", "b.log"].map(|log| place.start(log, &worker));
    poll(|| coordinator.log().contains("worker joined worker=3").then_some(()));
    tell.send(()).unwrap();
    assert!(submit.wait().success(), "{}", submit.log());
    assert!(fs::read(place.path("out.png")).unwrap() == here, "{}", coordinator.log());
    let (accepted, refusal) = runtime.block_on(liar).unwrap();
    assert!(accepted >= 4 && refusal.message().contains("brought wrong pixels"), "{refusal}");
    let log = coordinator.log();
    assert!(
        log.contains("it is kept out from now on") && log.contains("are rendered again"),
        "{log}"
    );

    coordinator.signal(Signal::KILL);
    coordinator.wait();
    let address = url.strip_prefix("http://").unwrap();
    let mut next = place.start("next.log", &[&args[..], &[address]].concat());
    next.read_line();
    let refusal = runtime.block_on(async {
        let address: Address = url.parse().unwrap();
        FarmClient::new(address.connect().await.unwrap()).join(introduction()).await.unwrap_err()
    });
    assert!(refusal.message().contains("brought wrong pixels"), "{refusal}");
    drop(workers);
}
