//! Leases under a clock of the test.

use rtfarm_core::tile::{Size, TileGrid};

use super::*;

const TERM: Duration = Duration::from_secs(4);
/// What a tile takes.
const COST: Duration = Duration::from_millis(200);
const JOB: JobId = JobId(1);
const A: WorkerId = WorkerId(1);
const B: WorkerId = WorkerId(2);

fn lease(id: u64) -> LeaseName {
    LeaseName { job: JOB, id: LeaseId(id) }
}

/// News of the scene of a lease.
fn renewal(id: u64, work: u64) -> Renewal {
    Renewal { lease: lease(id), work, tiles: Vec::new() }
}

/// News of tiles of a lease, which all are so far.
fn news(id: u64, tiles: &[TileId], work: u64) -> Renewal {
    let tiles = tiles.iter().map(|tile| (tile.number(), work)).collect();
    Renewal { lease: lease(id), work: 0, tiles }
}

/// A job of `columns` x `rows` tiles.
fn job(columns: u64, rows: u64) -> (Leases, Instant) {
    let grid = TileGrid::new(Size::new(columns * 16, rows * 16).unwrap(), 16).unwrap();
    let mut leases = Leases::new(TERM);
    leases.on_submit(JOB, Tiles::new(grid), 0);
    #[expect(clippy::disallowed_methods, reason = "any instant will do")]
    let start = Instant::now();
    (leases, start)
}

/// A job of a row of tiles, of which the first worker has leased all under lease 1.
fn all_leased(tile_count: u64) -> (Leases, Vec<TileId>, Instant) {
    let (mut leases, start) = job(tile_count, 1);
    let run = leases.on_idle(A, JOB, (16, 1), 64, start).unwrap();
    assert_eq!((run.lease, run.tiles.len() as u64), (lease(1), tile_count));
    assert!(!leases.has_free());
    (leases, run.tiles, start)
}

/// Pixels of a tile that is open, and whose pixels are stored at once.
fn deliver(leases: &mut Leases, worker: WorkerId, id: u64, tile: TileId, now: Instant) {
    let arrival = leases.on_pixels(worker, lease(id), (tile, COST), [7; 32], now);
    assert!(matches!(arrival, Some(Arrival::First(..))), "{arrival:?}");
    leases.on_stored(JOB, tile).unwrap();
    leases.check(|_| true);
}

/// From when on `worker` may render a tile of the quietest lease of others again.
fn quiet_for(leases: &Leases, worker: WorkerId) -> Option<(Instant, LeaseId)> {
    let mut others = leases.quietest(JOB).filter(|quiet| quiet.worker != worker);
    others.next().map(|quiet| (quiet.from, quiet.lease.id))
}

#[test]
fn a_lease_without_progress_is_lost_and_its_tiles_go_to_others() {
    let (mut leases, tiles, start) = all_leased(5);
    deliver(&mut leases, A, 1, tiles[0], start);
    assert_eq!(leases.on_time(start + TERM / 2), []);
    assert!(leases.on_renewal(A, &news(1, &tiles[1..2], 1), start + TERM / 2));
    assert_eq!(leases.on_time(start + TERM), [], "progress renews it");
    assert_eq!(leases.next_expiry(), Some(start + TERM * 3 / 2));

    let lost = leases.on_time(start + TERM * 3 / 2);
    let rest = tiles[1..].to_vec();
    let (aside, again) = (Vec::new(), Vec::new());
    assert_eq!(lost, [Loss { lease: lease(1), worker: A, tiles: rest.clone(), aside, again }]);
    leases.check(|_| true);
    assert!(!leases.on_renewal(A, &renewal(1, 2), start + TERM * 2));
    let run = leases.on_idle(B, JOB, (8, 1), 64, start + TERM * 2).unwrap();
    assert_eq!(run.tiles, rest[1..], "the first was in work");
}

#[test]
fn a_lease_lives_on_while_its_tiles_come() {
    let (mut leases, tiles, start) = all_leased(3);
    let now = start + TERM / 2;
    deliver(&mut leases, A, 1, tiles[0], now);
    assert_eq!(leases.next_expiry(), Some(now + TERM));
    assert_eq!(leases.quietest(JOB).next().unwrap().last_tile, now);
}

#[test]
fn a_renewal_without_new_work_keeps_no_lease_alive() {
    let (mut leases, _, start) = all_leased(2);
    assert!(leases.on_renewal(A, &renewal(1, 7), start + TERM / 4));
    for (work, quarter) in [(7, 2), (0, 3), (6, 4)] {
        assert!(leases.on_renewal(A, &renewal(1, work), start + TERM * quarter / 4));
    }
    assert_eq!(leases.on_time(start + TERM * 5 / 4).len(), 1);
}

#[test]
fn one_lease_does_not_live_on_the_work_of_another() {
    let (mut leases, start) = job(4, 1);
    for id in 1..=2 {
        assert_eq!(leases.on_idle(A, JOB, (1, 1), 1, start).unwrap().lease, lease(id));
    }
    assert!(leases.on_renewal(A, &renewal(2, 1), start + TERM / 2));
    let lost = leases.on_time(start + TERM);
    assert_eq!(lost.iter().map(|loss| loss.lease).collect::<Vec<_>>(), [lease(1)]);
}

#[test]
fn a_lease_that_runs_out_takes_along_what_its_worker_has_not_come_to() {
    let (mut leases, start) = job(4, 1);
    for (id, now) in [(1, start), (2, start + TERM / 2)] {
        assert_eq!(leases.on_idle(A, JOB, (1, 1), 1, now).unwrap().lease, lease(id));
        assert_eq!(leases.tile_count(A) as u64, id);
    }
    let lost = leases.on_time(start + TERM);
    assert_eq!(lost.iter().map(|loss| loss.lease).collect::<Vec<_>>(), [lease(1), lease(2)]);
    assert_eq!(leases.tile_count(A), 0);
}

#[test]
fn a_lease_waits_for_those_that_its_worker_got_before() {
    let (mut leases, start) = job(4, 1);
    for id in 1..=2 {
        assert_eq!(leases.on_idle(A, JOB, (1, 1), 1, start).unwrap().lease, lease(id));
    }
    for work in 1..9 {
        let now = start + TERM * work / 2;
        assert!(leases.on_renewal(A, &renewal(1, work.into()), now));
        assert_eq!(leases.on_time(now), [], "its tiles are not begun");
        leases.check(|_| true);
    }
    assert_eq!(leases.on_time(start + TERM * 6).len(), 2, "nothing goes on");
}

#[test]
fn a_lease_whose_turn_comes_has_a_whole_term() {
    let (mut leases, start) = job(4, 1);
    let runs = [(); 2].map(|()| leases.on_idle(A, JOB, (1, 1), 1, start).unwrap());
    deliver(&mut leases, A, 1, runs[0].tiles[0], start + TERM * 3 / 4);
    assert_eq!(leases.on_time(start + TERM), []);
    assert_eq!(leases.on_time(start + TERM * 7 / 4).len(), 1);
}

#[test]
fn nobody_renews_the_lease_of_another_worker_or_job() {
    let (mut leases, _, start) = all_leased(2);
    assert!(!leases.on_renewal(B, &renewal(1, 1), start));
    let other_job = LeaseName { job: JobId(2), ..lease(1) };
    assert!(!leases.on_renewal(A, &Renewal { lease: other_job, ..renewal(1, 1) }, start));
    assert_eq!(leases.on_time(start + TERM).len(), 1);
}

#[test]
fn late_pixels_of_a_lost_lease_are_the_first_copy() {
    let (mut leases, tiles, start) = all_leased(2);
    leases.on_worker_lost(A, false);
    deliver(&mut leases, A, 1, tiles[0], start);
    let run = leases.on_idle(B, JOB, (8, 1), 64, start).unwrap();
    assert_eq!(run.tiles, tiles[1..]);
}

#[test]
fn a_second_copy_meets_the_first_ones_hash() {
    let (mut leases, tiles, start) = all_leased(1);
    let copy = |leases: &mut Leases, hash| {
        leases.on_pixels(A, lease(1), (tiles[0], COST), [hash; 32], start)
    };
    assert!(matches!(copy(&mut leases, 1), Some(Arrival::First(..))));
    let first = Rendering { worker: A, hash: [1; 32] };
    assert_eq!(copy(&mut leases, 2), Some(Arrival::WhileStoring(first)));
    assert_eq!(leases.on_stored(JOB, tiles[0]), Some(1));
    assert_eq!(copy(&mut leases, 2), Some(Arrival::AfterDone(first)));
}

#[test]
fn a_quiet_lease_is_rendered_twice_from_its_end_and_once_only() {
    let (mut leases, tiles, start) = all_leased(2);
    let later = start + LONGEST_QUIET;
    assert_eq!(quiet_for(&leases, B), Some((later, LeaseId(1))));
    assert_eq!(quiet_for(&leases, A), None, "it is its own");
    for (id, &tile) in (2..).zip(tiles.iter().rev()) {
        let run = Run { lease: lease(id), tiles: vec![tile] };
        assert_eq!(leases.on_idle_at_the_end(B, LeaseId(1), later), Some(run));
        leases.check(|_| true);
    }
    assert_eq!(leases.on_idle_at_the_end(B, LeaseId(1), later), None);
    assert_eq!(quiet_for(&leases, B), None);

    for (id, &tile) in (2..).zip(tiles.iter().rev()) {
        deliver(&mut leases, B, id, tile, later);
    }
    assert!(leases.is_empty(), "nothing is left open");
}

#[test]
fn a_tile_whose_second_rendering_is_lost_may_have_another() {
    let (mut leases, tiles, start) = all_leased(1);
    leases.on_idle_at_the_end(B, LeaseId(1), start).unwrap();
    assert_eq!(leases.on_worker_lost(B, false).len(), 1);
    leases.check(|_| true);
    assert!(!leases.has_free(), "its first holder still has it");
    let run = leases.on_idle_at_the_end(B, LeaseId(1), start).unwrap();
    assert_eq!(leases.on_worker_lost(A, false).len(), 1);
    leases.check(|_| true);
    deliver(&mut leases, B, run.lease.id.0, tiles[0], start);
    assert!(leases.is_empty());
}

#[test]
fn the_leases_of_an_ended_job_are_lost() {
    let (mut leases, tiles, start) = all_leased(4);
    leases.on_end(JOB);
    leases.check(|_| true);
    assert!(leases.is_empty() && !leases.has_free());
    assert!(!leases.on_renewal(A, &renewal(1, 1), start));
    assert_eq!(leases.on_pixels(A, lease(1), (tiles[0], COST), [0; 32], start), None);
    assert_eq!(leases.on_stored(JOB, tiles[0]), None);
}

#[test]
fn runs_shorten_towards_the_end_and_are_shorter_for_the_slow() {
    for (cost, longest) in [(COST, 118), (COST * 10, 12)] {
        let (mut leases, start) = job(100, 10);
        let first = leases.on_idle(A, JOB, (1, 4), 1000, start).unwrap();
        assert_eq!(first.tiles.len(), FIRST_RUN, "nobody knows how slow it is");
        // Another worker shows what tiles cost.
        let of_others = leases.on_idle(B, JOB, (16, 16), 1000, start).unwrap();
        for tile in of_others.tiles {
            leases.on_pixels(B, of_others.lease, (tile, COST), [7; 32], start).unwrap();
        }
        let tile = (first.tiles[0], cost);
        leases.on_pixels(A, first.lease, tile, [7; 32], start).unwrap();
        let lengths: Vec<usize> =
            std::iter::from_fn(|| leases.on_idle(A, JOB, (1, 4), 1000, start))
                .map(|run| run.tiles.len())
                .collect();
        assert!(lengths.is_sorted_by(|a, b| a >= b), "{lengths:?}");
        assert!((longest * 8 / 10..=longest * 14 / 10).contains(&lengths[0]), "{lengths:?}");
        assert_eq!(lengths.last(), Some(&1));
    }
}

#[test]
fn a_tile_that_stands_still_leaves_its_lease_which_lives_on() {
    let (mut leases, tiles, start) = all_leased(6);
    assert!(leases.on_renewal(A, &news(1, &tiles[..2], 1), start));
    // The other thread goes on, and the first is said to be where it was.
    for half in 1..=2 {
        let told = Renewal {
            tiles: vec![(tiles[0].number(), 1), (tiles[1].number(), 1 + half)],
            ..news(1, &[], 0)
        };
        assert!(leases.on_renewal(A, &told, start + TERM * half as u32 / 2));
    }
    let now = start + TERM;
    let lost = leases.on_time(now);
    assert_eq!(lost.iter().map(|loss| &loss.tiles[..]).collect::<Vec<_>>(), [&tiles[..1]]);
    leases.check(|_| true);
    assert!(leases.on_renewal(A, &news(1, &tiles[..1], 2), now), "it has the others still");
    assert!(leases.is_granted(A, lease(1), tiles[0]), "and its pixels are welcome");

    assert!(leases.on_idle(B, JOB, (1, 1), 64, now).is_none(), "nothing free but a suspect");
    let run = leases.on_trial(B, JOB, now).unwrap();
    assert_eq!(run.tiles, tiles[..1]);
    assert!(leases.is_on_trial(B) && !leases.is_on_trial(A));
    leases.check(|_| true);
    deliver(&mut leases, B, 2, tiles[0], now);
    assert!(leases.is_without(B));
}

#[test]
fn a_tile_with_which_three_workers_are_lost_is_set_aside() {
    let (mut leases, tiles, start) = all_leased(3);
    assert!(leases.on_renewal(A, &news(1, &tiles[1..2], 1), start));
    let [loss] = &leases.on_worker_lost(A, true)[..] else { panic!("it had one lease") };
    assert_eq!((&loss.tiles, &loss.aside), (&tiles, &Vec::new()));
    let others = leases.on_idle(A, JOB, (16, 1), 64, start).unwrap();
    assert_eq!(others.tiles, [tiles[0], tiles[2]], "these were not begun");
    for (worker, is_aside) in [(WorkerId(3), false), (WorkerId(4), true)] {
        let run = leases.on_trial(worker, JOB, start).unwrap();
        assert_eq!(run.tiles, tiles[1..2]);
        assert_eq!(quiet_for(&leases, worker).unwrap().1, others.lease.id, "not this");
        let [loss] = &leases.on_worker_lost(worker, true)[..] else { panic!("it had one") };
        assert_eq!(loss.aside, if is_aside { tiles[1..2].to_vec() } else { Vec::new() });
        leases.check(|_| true);
    }
    assert!(leases.on_trial(B, JOB, start).is_none() && !leases.has_free());
    for tile in others.tiles {
        deliver(&mut leases, A, 2, tile, start);
    }
    let of_job = leases.tiles(JOB).unwrap();
    assert!(of_job.is_over() && of_job.aside() == tiles[1..2]);
    deliver(&mut leases, A, 1, tiles[1], start);
    assert_eq!(leases.tiles(JOB).unwrap().aside(), [], "however late");
}

#[test]
fn where_a_worker_was_is_guessed_when_it_has_not_told() {
    let (mut leases, start) = job(8, 1);
    let runs = [(); 2].map(|()| leases.on_idle(A, JOB, (2, 2), 64, start).unwrap());
    assert_eq!(leases.on_worker_lost(A, true).len(), 2);
    assert_eq!(leases.tiles(JOB).unwrap().free_count(), 6);
    for expected in &runs[0].tiles[..2] {
        assert_eq!(leases.on_trial(B, JOB, start).unwrap().tiles, [*expected]);
    }
    assert!(leases.on_trial(B, JOB, start).is_none());
}

#[test]
fn who_leaves_brings_no_tile_under_suspicion() {
    let (mut leases, tiles, start) = all_leased(3);
    assert!(leases.on_renewal(A, &news(1, &tiles, 1), start));
    assert_eq!(leases.on_worker_lost(A, false).len(), 1);
    assert!(leases.on_trial(B, JOB, start).is_none());
}
