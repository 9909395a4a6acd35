//! What must hold for any message from the wire. A fuzz target calls this, and so does an ordinary
//! test with every file of its corpus.

use prost::Message;
use rtfarm_core::{
    render::Settings,
    tile::{Area, Size},
};
use rtfarm_picture::{PictureFormat, TilePixels};
use rtfarm_proto::{LeaseName, scene_hash, transfer, wire};

/// A message of the kind that the first byte says: it is refused, or written again it is read as
/// the same, and what it means is refused or written back as it was.
pub(crate) fn message(data: &[u8]) {
    let Some((kind, data)) = data.split_first() else { return };
    match kind % 24 {
        0 => check::<wire::JoinRequest>(data, |_| ()),
        1 => check::<wire::JoinResponse>(data, |_| ()),
        2 => check::<wire::LeaseRequest>(data, |_| ()),
        3 => check::<wire::LeaseResponse>(data, |message| {
            if let Some(wire::lease_response::Next::Run(run)) = message.next {
                check_run(run);
            }
        }),
        4 => check(data, check_run),
        5 => check(data, check_job),
        6 => check(data, check_settings),
        7 => check::<wire::RenewRequest>(data, |message| {
            let renewals = message.renewals.into_iter();
            renewals.filter_map(|renewal| renewal.lease).for_each(check_lease);
        }),
        8 => check::<wire::RenewResponse>(data, |message| {
            message.lost.into_iter().for_each(check_lease);
        }),
        9 => check(data, check_delivery),
        10 => check::<wire::DeliverResponse>(data, |message| {
            let _ = message.verdicts().count();
        }),
        11 => check::<wire::LeaveRequest>(data, |_| ()),
        12 => check::<wire::FetchRequest>(data, |message| {
            let _ = scene_hash(&message.scene_hash);
        }),
        13 => check::<wire::Chunk>(data, |_| ()),
        14 => check::<wire::SubmitRequest>(data, |message| {
            if let Some(wire::submit_request::Part::Order(order)) = message.part {
                check_order(order);
            }
        }),
        15 => check(data, check_order),
        16 => check::<wire::SubmitResponse>(data, |_| ()),
        17 => check::<wire::WatchRequest>(data, |_| ()),
        18 => check::<wire::Event>(data, |message| message.tally.into_iter().for_each(check_tally)),
        19 => check::<wire::ImageRequest>(data, |_| ()),
        20 => check::<wire::CancelRequest>(data, |_| ()),
        21 => check(data, check_tally),
        22 => check::<wire::Quality>(data, |quality| {
            let frame = Some(wire::Frame { width: 1, height: 1 });
            check_settings(wire::Settings { frame, quality: Some(quality) });
        }),
        _ => check_pixels(data),
    }
}

fn check<M: Message + Default>(data: &[u8], means: impl FnOnce(M)) {
    let Ok(message) = M::decode(data) else { return };
    let bytes = message.encode_to_vec();
    assert!(bytes.len() == message.encoded_len());
    let again = M::decode(bytes.as_slice()).expect("what was written can be read");
    // As bytes: a NaN is not equal to itself.
    assert_eq!(again.encode_to_vec(), bytes);
    means(message);
}

fn check_run(run: wire::Run) {
    run.lease.into_iter().for_each(check_lease);
    run.job.into_iter().for_each(check_job);
}

fn check_lease(lease: wire::LeaseName) {
    assert_eq!(wire::LeaseName::from(LeaseName::from(lease)), lease);
}

fn check_job(job: wire::Job) {
    let hash = scene_hash(&job.scene_hash);
    assert_eq!(hash.is_ok(), job.scene_hash.len() == 32);
    job.settings.into_iter().for_each(check_settings);
}

fn check_settings(settings: wire::Settings) {
    if let Ok(known) = Settings::try_from(settings) {
        assert!((1..=65_535).contains(&known.size.width()));
        assert!((1..=65_535).contains(&known.size.height()));
        assert_eq!(wire::Settings::from(known), settings);
    }
}

fn check_tally(tally: wire::Tally) {
    if let Ok(known) = rtfarm_core::render::Tally::try_from(tally) {
        assert!([known.variance, known.untraced, known.most_untraced].iter().all(|x| *x >= 0.0));
        assert_eq!(wire::Tally::from(known), tally);
    }
}

fn check_delivery(delivery: wire::DeliverRequest) {
    for tile in delivery.tiles {
        tile.lease.into_iter().for_each(check_lease);
        tile.tally.into_iter().for_each(check_tally);
        check_pixels(&tile.pixels);
        let _ = scene_hash(&tile.hash);
    }
}

fn check_pixels(bytes: &[u8]) {
    let area = Area::whole(Size::new(2, 1).expect("it is a size"));
    let is_good = TilePixels { area, bytes }.check().is_ok();
    assert!(!is_good || bytes.len() == 24);
}

fn check_order(order: wire::Order) {
    if let Some(Ok(size)) = order.frame.map(Size::try_from) {
        assert_eq!(Some(wire::Frame::from(size)), order.frame);
    }
    let quality = order.quality;
    check_settings(wire::Settings { frame: order.frame, quality });
    if let Ok(known) = PictureFormat::try_from(order.format()) {
        assert_eq!(wire::Format::from(known), order.format());
    }
    if let Ok(known) = transfer(order.transfer) {
        assert_eq!(wire::Transfer::from(known), order.transfer());
    }
}
