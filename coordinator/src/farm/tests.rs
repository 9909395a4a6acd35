//! A farm under a clock of the test, with workers played by hand or by chance.

use rtfarm_core::{
    render::Tally,
    tile::{Size, TileGrid},
};
use rtfarm_job::{Outcome, Progress};

use super::*;
use crate::{members::Standing, tiles::Tiles};

const TERM: Duration = Duration::from_secs(4);
const SECOND: Duration = Duration::from_secs(1);

/// A farm and its clock.
struct World {
    farm: Farm,
    now: Instant,
    last_number: u64,
}

impl World {
    fn new() -> Self {
        Self::with_audit(0.0)
    }

    fn with_audit(fraction: f64) -> Self {
        #[expect(clippy::disallowed_methods, reason = "any instant will do")]
        let now = Instant::now();
        let identity = Identity::from_random([1; 24]);
        Self { farm: Farm::new(identity, TERM, Audit::new(fraction, [9; 32])), now, last_number: 0 }
    }

    fn number(&mut self) -> u64 {
        self.last_number += 1;
        self.last_number
    }

    fn join(&mut self) -> WorkerId {
        let nonce = self.number();
        let process = Process { nonce, number: nonce as u32, threads: 1, ..Process::default() };
        self.farm.on_join(process, self.now).0.unwrap()
    }

    /// Orders a picture of a row of tiles; answers also with what that leads to.
    fn submit(&mut self, tile_count: u64) -> (JobId, Vec<Action>) {
        let grid = TileGrid::new(Size::new(tile_count * 16, 16).unwrap(), 16).unwrap();
        let job = self.farm.number_job();
        let actions = self.farm.on_submit(job, Tiles::new(grid), self.now);
        self.farm.check();
        (job, actions)
    }

    /// Orders a picture of a row of tiles on these terms.
    fn submit_with(&mut self, tile_count: u64, terms: Terms) -> JobId {
        let grid = TileGrid::new(Size::new(tile_count * 16, 16).unwrap(), 16).unwrap();
        let job = self.farm.number_job();
        self.farm.on_order(job, Tiles::new(grid), Earlier::default(), terms, self.now);
        self.farm.check();
        job
    }

    /// Asks for up to nine tiles.
    fn ask(&mut self, worker: WorkerId, wait: Duration) -> (AskId, Vec<Action>) {
        let id = AskId(self.number());
        let ask = Ask { worker, most: 9, until: self.now + wait };
        let actions = self.farm.on_ask(id, ask, self.now);
        self.farm.check();
        (id, actions)
    }

    /// Asks and gets tiles at once.
    fn lease(&mut self, worker: WorkerId) -> Run {
        let (id, actions) = self.ask(worker, Duration::ZERO);
        let [(answered, Ok(Next::Render(run)))] = &answers(&actions)[..] else {
            panic!("{actions:?}")
        };
        assert_eq!(*answered, id);
        run.clone()
    }

    fn deliver(&mut self, worker: WorkerId, run: &Run, hash: u8) -> (DeliveryId, Vec<Action>) {
        let id = DeliveryId(self.number());
        let delivery = Delivery {
            worker,
            lease: run.lease,
            tile: run.tiles[0],
            hash: [hash; 32],
            seconds: 0.1,
            tally: Tally { rays: 10, ..Tally::default() },
        };
        let actions = self.farm.on_pixels(id, delivery, self.now);
        self.farm.check();
        (id, actions)
    }

    fn senseless(&mut self, worker: WorkerId, run: &Run) -> Vec<Action> {
        let (lease, tile) = (run.lease, run.tiles[0]);
        let actions = self.farm.on_senseless_pixels(worker, lease, tile, "it is NaN", self.now);
        self.farm.check();
        actions
    }

    fn store(&mut self, run: &Run) -> Vec<Action> {
        let actions = self.farm.on_stored(run.lease.job, run.tiles[0], self.now);
        self.farm.check();
        actions
    }

    /// Brings and stores the first tile of a run; answers with what the storing leads to.
    fn stitch(&mut self, worker: WorkerId, run: &Run) -> Vec<Action> {
        let (id, actions) = self.deliver(worker, run, 7);
        assert!(matches!(actions[..], [Action::Store(stored, ..)] if stored == id));
        self.store(run)
    }

    fn pass(&mut self, time: Duration) -> Vec<Action> {
        self.now += time;
        let actions = self.farm.on_time(self.now);
        self.farm.check();
        actions
    }
}

/// What is written into the log of workers that lie and tiles that are taken back.
fn found(actions: &[Action]) -> Vec<String> {
    let found = |action: &Action| match action {
        Action::Log(Notice::Liar { worker, tile, .. }) => {
            Some(format!("{worker} lies of {}", tile.number()))
        }
        Action::Log(Notice::TakenBack { worker, tiles, .. }) => {
            let tiles: Vec<u32> = tiles.iter().map(|tile| tile.number()).collect();
            Some(format!("{tiles:?} of {worker}"))
        }
        Action::Log(Notice::NoAudit) => Some("no audit".to_owned()),
        Action::Log(Notice::NotCompared(_, tile)) => {
            Some(format!("{} is not compared", tile.number()))
        }
        Action::Log(Notice::JobFailed(_, reason)) => Some(reason.clone()),
        _ => None,
    };
    actions.iter().filter_map(found).collect()
}

fn answers(actions: &[Action]) -> Vec<(AskId, Result<Next, NoMember>)> {
    let answer = |action: &Action| match action {
        Action::Answer(ask, answer) => Some((*ask, answer.clone())),
        _ => None,
    };
    actions.iter().filter_map(answer).collect()
}

fn verdicts(actions: &[Action]) -> Vec<(DeliveryId, Verdict)> {
    let verdict = |action: &Action| match action {
        Action::Acknowledge(delivery, verdict) => Some((*delivery, *verdict)),
        _ => None,
    };
    actions.iter().filter_map(verdict).collect()
}

/// The last state that was published.
fn shown(actions: &[Action]) -> Progress {
    let shown = |action: &Action| match action {
        Action::Publish(_, progress) => Some(progress.clone()),
        _ => None,
    };
    actions.iter().rev().find_map(shown).expect("something is published")
}

/// The jobs that are forgotten.
fn forgotten(actions: &[Action]) -> Vec<JobId> {
    let job = |action: &Action| if let Action::Forget(job) = action { Some(*job) } else { None };
    actions.iter().filter_map(job).collect()
}

#[test]
fn a_call_meant_for_another_incarnation_is_refused_and_counted() {
    let mut world = World::new();
    let ours = world.farm.incarnation();
    assert!(matches!(world.farm.on_call(ours), (Ok(()), actions) if actions.is_empty()));
    let mut told = Vec::new();
    for _ in 0..5 {
        let (admitted, actions) = world.farm.on_call(Incarnation(ours.0 + 1));
        assert_eq!(admitted, Err(Stranger));
        told.extend(actions.into_iter().map(|action| match action {
            Action::Log(Notice::Strangers(count)) => count,
            other => panic!("{other:?}"),
        }));
    }
    assert_eq!(told, [1, 2, 4], "strangers cannot fill the log");
}

#[test]
fn a_job_is_published_from_its_first_tile_on() {
    let (_, actions) = World::new().submit(2);
    assert!(actions.is_empty(), "{actions:?}");
}

#[test]
fn incarnations_number_their_jobs_differently() {
    let identities = [[1; 24], [2; 24]].map(Identity::from_random);
    let mut farms = identities.map(|identity| Farm::new(identity, TERM, Audit::new(0.0, [0; 32])));
    let numbers: BTreeSet<JobId> =
        farms.iter_mut().flat_map(|farm| [farm.number_job(), farm.number_job()]).collect();
    assert_eq!(numbers.len(), 4);
    let far_apart = |job: &&JobId| job.0 >> 24 == 0x01_0101_0101 || job.0 >> 24 == 0x02_0202_0202;
    assert_eq!(numbers.iter().filter(far_apart).count(), 4, "no start has so many jobs");
}

#[test]
fn a_tile_counts_and_is_acknowledged_when_it_is_stored() {
    let mut world = World::new();
    let worker = world.join();
    world.submit(2);
    let run = world.lease(worker);
    let (id, actions) = world.deliver(worker, &run, 7);
    assert!(matches!(actions[..], [Action::Store(..)]), "{actions:?}");
    let actions = world.store(&run);
    assert_eq!(verdicts(&actions), [(id, Verdict::Accepted)]);
    let progress = shown(&actions);
    assert_eq!((progress.tiles_done, progress.worker_count, progress.tally.rays), (1, 1, 10));
    assert_eq!((progress.outcome, progress.hosts.len()), (None, 1));
}

#[test]
fn a_job_is_finished_with_its_last_tile_so_long_after_its_start() {
    let mut world = World::new();
    let worker = world.join();
    world.submit(2);
    for _ in 0..2 {
        let run = world.lease(worker);
        world.now += SECOND;
        let actions = world.stitch(worker, &run);
        let progress = shown(&actions);
        let is_last = progress.tiles_done == 2;
        assert_eq!(progress.outcome, is_last.then_some(Outcome::Finished(2 * SECOND)));
    }
}

#[test]
fn a_copy_that_comes_while_the_first_is_stored_waits_for_it() {
    let mut world = World::new();
    let worker = world.join();
    world.submit(2);
    let run = world.lease(worker);
    let (first, _) = world.deliver(worker, &run, 7);
    let (copy, actions) = world.deliver(worker, &run, 7);
    assert!(actions.is_empty(), "{actions:?}");
    let expected = [(first, Verdict::Accepted), (copy, Verdict::Duplicate)];
    assert_eq!(verdicts(&world.store(&run)), expected);
    let (late, actions) = world.deliver(worker, &run, 7);
    assert_eq!(verdicts(&actions), [(late, Verdict::Duplicate)]);
}

#[test]
fn pixels_are_taken_only_from_a_worker_that_was_to_render_them_under_that_lease() {
    let mut world = World::new();
    let (worker, other) = (world.join(), world.join());
    let (job, _) = world.submit(2);
    let (first, second) = (world.lease(worker), world.lease(worker));
    let with = |lease, tile: TileId| Run { lease, tiles: vec![tile] };
    let no_lease = LeaseName { job, id: LeaseId(99) };
    for (from, run) in [
        (other, first.clone()),
        (WorkerId(77), first.clone()),
        (worker, with(first.lease, second.tiles[0])),
        (worker, with(no_lease, first.tiles[0])),
    ] {
        let (id, actions) = world.deliver(from, &run, 9);
        assert_eq!(verdicts(&actions), [(id, Verdict::Rejected)], "{from} {run:?}");
    }
    // However late, and though the worker is no member any more.
    world.pass(LONGEST_SILENCE * 2);
    assert!(!world.farm.members.contains(worker));
    let actions = world.stitch(worker, &first);
    assert_eq!(shown(&actions).tiles_done, 1);
    let mut told = Vec::new();
    for _ in 0..5 {
        told.extend(world.deliver(other, &second, 9).1.into_iter().filter_map(
            |action| match action {
                Action::Log(Notice::NotGranted { count, .. }) => Some(count),
                _ => None,
            },
        ));
    }
    assert_eq!(told, [8], "strangers cannot fill the log");
}

#[test]
fn a_picture_that_cannot_be_written_ends_its_job() {
    let mut world = World::new();
    let worker = world.join();
    let (job, _) = world.submit(2);
    let run = world.lease(worker);
    let (first, _) = world.deliver(worker, &run, 7);
    let (copy, _) = world.deliver(worker, &run, 7);
    let actions = world.farm.on_store_failed(job, "the disk is full".to_owned(), world.now);
    let expected = [(first, Verdict::Rejected), (copy, Verdict::Rejected)];
    assert_eq!(verdicts(&actions), expected);
    let failed = Outcome::Failed("the disk is full".to_owned());
    assert_eq!(shown(&actions).outcome, Some(failed));
    let (late, actions) = world.deliver(worker, &run, 7);
    assert_eq!(verdicts(&actions), [(late, Verdict::Rejected)]);
}

#[test]
fn a_copy_that_differs_is_counted_once_each_time() {
    let mut world = World::new();
    let worker = world.join();
    world.submit(2);
    let run = world.lease(worker);
    world.stitch(worker, &run);
    for count in 1..3 {
        let (_, actions) = world.deliver(worker, &run, 8);
        assert_eq!(shown(&actions).differing_tiles, count);
    }
}

#[test]
fn pixels_that_make_no_sense_blame_the_worker_and_the_job_when_two_agree() {
    let mut world = World::new();
    let [bad, good, third] = [world.join(), world.join(), world.join()];
    let (job, _) = world.submit(2);
    let run = world.lease(bad);
    let tile = run.tiles[0];
    // A stranger's say nothing.
    assert!(world.senseless(good, &run).len() <= 1);
    let actions = world.senseless(bad, &run);
    let is_told = |action: &Action| match action {
        Action::Log(Notice::Suspect { worker, .. }) => *worker == bad,
        _ => false,
    };
    assert!(actions.iter().any(is_told), "{actions:?}");
    assert!(world.senseless(bad, &run).is_empty(), "a delivery may be repeated");
    let (ask, actions) = world.ask(bad, 9 * SECOND);
    assert!(actions.is_empty(), "it gets no more of this job");
    let other_job = world.submit(1);
    assert_eq!(answers(&other_job.1)[0].0, ask, "but of another");

    let again = world.lease(good);
    assert_eq!(again.tiles, [tile]);
    let actions = world.senseless(good, &again);
    let reason = format!("workers 1 and 2 rendered tile {}: it is NaN", tile.number());
    assert_eq!(shown(&actions).outcome, Some(Outcome::Failed(reason)));
    assert_eq!(world.farm.tile(job, 1), None);
    let (_, actions) = world.ask(third, Duration::ZERO);
    assert!(matches!(answers(&actions)[..], [(_, Ok(Next::Nothing))]));
}

#[test]
fn a_worker_that_is_alone_gets_a_tile_again_of_which_it_brought_no_sense() {
    let mut world = World::new();
    let worker = world.join();
    world.submit(1);
    let run = world.lease(worker);
    assert_eq!(verdicts(&world.senseless(worker, &run)), []);
    let again = world.lease(worker);
    assert_eq!(again.tiles, run.tiles);
    let actions = world.senseless(worker, &again);
    assert!(matches!(shown(&actions).outcome, Some(Outcome::Failed(_))), "no wait for ever");
}

#[test]
fn a_third_worker_says_who_of_two_lies_and_the_liars_tiles_are_rendered_again() {
    for liar_is_first in [true, false] {
        let mut world = World::with_audit(1e-9);
        let [first, second, third] = [world.join(), world.join(), world.join()];
        world.submit(4);
        let said = if liar_is_first { [9, 7] } else { [7, 9] };
        // Both may be the first of their job, and the second tile of the first worker is not.
        let run = world.lease(first);
        world.deliver(first, &run, said[0]);
        world.store(&run);
        let other = world.lease(first);
        world.deliver(first, &other, said[0]);
        world.store(&other);
        let again = world.lease(second);
        assert_eq!(again.tiles, run.tiles, "to be compared");
        let (id, actions) = world.deliver(second, &again, said[1]);
        assert_eq!(verdicts(&actions), [(id, Verdict::Duplicate)]);
        assert_eq!(shown(&actions).differing_tiles, 1);
        let last = world.lease(third);
        assert_eq!(last.tiles, run.tiles, "to be decided");
        let (id, actions) = world.deliver(third, &last, 7);
        let (liar, tile) = (if liar_is_first { first } else { second }, run.tiles[0].number());
        let lies = format!("{liar} lies of {tile}");
        if liar_is_first {
            let both = [run.tiles[0].number(), other.tiles[0].number()];
            assert_eq!(found(&actions), [lies, format!("{both:?} of {liar}")]);
            assert_eq!((shown(&actions).tiles_done, shown(&actions).tally.rays), (0, 0));
            assert!(matches!(actions.last(), Some(Action::Store(stored, ..)) if *stored == id));
            let now = shown(&world.store(&last));
            assert_eq!((now.tiles_done, now.tally.rays), (1, 10), "what came last alone counts");
            assert_eq!(world.lease(second).tiles, run.tiles, "it is the first of the third");
            assert_eq!(world.lease(second).tiles, other.tiles, "it is free again");
        } else {
            assert_eq!(found(&actions), [lies]);
            assert_eq!(verdicts(&actions), [(id, Verdict::Duplicate)]);
        }
        let (id, actions) = world.deliver(liar, &run, 7);
        assert_eq!(verdicts(&actions), [(id, Verdict::Rejected)], "nobody believes it any more");
        let process = Process { nonce: u64::from(liar.0), ..Process::default() };
        assert_eq!(world.farm.on_join(process, world.now).0, Err(KeptOut(liar)));
        let (ask, actions) = world.ask(liar, SECOND);
        assert_eq!(answers(&actions), [(ask, Err(NoMember(liar)))]);
    }
}

#[test]
fn tiles_of_a_liar_that_are_being_stored_are_taken_back_too() {
    let mut world = World::with_audit(1e-9);
    let [liar, second, third] = [world.join(), world.join(), world.join()];
    world.submit(2);
    let run = world.lease(liar);
    world.deliver(liar, &run, 9);
    world.store(&run);
    let late = world.lease(liar);
    let (id, _) = world.deliver(liar, &late, 9);
    for worker in [second, third] {
        let again = world.lease(worker);
        world.deliver(worker, &again, 7);
    }
    let actions = world.store(&late);
    assert_eq!(verdicts(&actions), [(id, Verdict::Accepted)]);
    assert_eq!(found(&actions), [format!("[{}] of {liar}", late.tiles[0].number())]);
    assert_eq!(shown(&actions).tiles_done, 0);
}

#[test]
fn a_copy_of_a_tile_that_is_taken_back_while_it_is_stored_is_rejected() {
    let mut world = World::with_audit(1e-9);
    let [liar, second, third] = [world.join(), world.join(), world.join()];
    world.submit(2);
    let run = world.lease(liar);
    world.deliver(liar, &run, 9);
    world.store(&run);
    let late = world.lease(liar);
    let again = world.lease(second);
    world.deliver(second, &again, 7);
    world.now += SECOND;
    let copy = world.lease(second);
    assert_eq!(copy.tiles, late.tiles, "it is overdue");
    let (id, _) = world.deliver(liar, &late, 9);
    let (copy_id, _) = world.deliver(second, &copy, 7);
    let again = world.lease(third);
    world.deliver(third, &again, 7);
    let actions = world.store(&late);
    assert_eq!(verdicts(&actions), [(id, Verdict::Accepted), (copy_id, Verdict::Rejected)]);
}

#[test]
fn a_tile_of_which_nobody_knows_who_is_right_fails_its_job_at_the_end() {
    for third_says in [None, Some(8)] {
        let mut world = World::with_audit(1e-9);
        let [first, second] = [world.join(), world.join()];
        world.submit(2);
        let run = world.lease(first);
        world.stitch(first, &run);
        let again = world.lease(second);
        world.deliver(second, &again, 9);
        if let Some(hash) = third_says {
            let third = world.join();
            let again = world.lease(third);
            world.deliver(third, &again, hash);
        }
        let last = world.lease(second);
        let actions = world.stitch(second, &last);
        // The other's first tile is to be compared still.
        assert_eq!(shown(&actions).outcome, None);
        let again = world.lease(first);
        let (_, actions) = world.deliver(first, &again, 7);
        let tile = run.tiles[0].number();
        let reason = format!(
            "1 of 2 tiles are right; rendered differently, and nobody knows who is right: {tile}"
        );
        assert_eq!(shown(&actions).outcome, Some(Outcome::Failed(reason)));
        assert_eq!((shown(&actions).tiles_done, shown(&actions).tally.rays), (1, 10));
    }
}

#[test]
fn a_worker_that_is_alone_is_compared_with_nobody_which_is_said_once() {
    let mut world = World::with_audit(1.0);
    let worker = world.join();
    for expected in [vec!["no audit".to_owned()], Vec::new()] {
        world.submit(1);
        let run = world.lease(worker);
        let actions = world.stitch(worker, &run);
        assert_eq!(found(&actions), expected);
        assert!(matches!(shown(&actions).outcome, Some(Outcome::Finished(_))));
    }
}

#[test]
fn a_job_does_not_wait_for_a_comparison_that_does_not_come() {
    for is_stopped in [true, false] {
        let mut world = World::with_audit(1.0);
        let (worker, other) = (world.join(), world.join());
        world.submit(1);
        let run = world.lease(worker);
        assert_eq!(found(&world.stitch(worker, &run)), [""; 0]);
        let start = world.now;
        loop {
            let wake = world.farm.next_wake().unwrap();
            let mut actions = world.pass(wake - world.now);
            if !is_stopped && world.farm.members.contains(other) {
                // It has something else to do.
                world.farm.on_renew(other, &[], world.now).unwrap();
            }
            actions.retain(|action| matches!(action, Action::Publish(..)));
            if !actions.is_empty() {
                break;
            }
        }
        let waited = world.now - start;
        let most = if is_stopped { 3 * TERM } else { LONGEST_SILENCE + TERM };
        assert!((most / 2..=most).contains(&waited), "{waited:?}");
    }
}

#[test]
fn a_tile_of_which_workers_that_compare_it_are_lost_is_not_compared_which_is_said() {
    let mut world = World::with_audit(1.0);
    let worker = world.join();
    let others = [(); 3].map(|()| (world.join(), world.last_number as u32));
    world.submit(1);
    let run = world.lease(worker);
    let mut told = found(&world.stitch(worker, &run));
    for (other, process) in others {
        assert_eq!(world.lease(other).tiles, run.tiles, "it compares");
        told.extend(found(&world.farm.on_process_exit(process, "killed by signal 11", world.now)));
    }
    assert_eq!(told, [format!("{} is not compared", run.tiles[0].number())]);
}

#[test]
fn a_tile_that_kills_its_workers_is_set_aside_and_the_others_are_finished() {
    let mut world = World::new();
    world.submit(3);
    let mut killer = None;
    for lost in 0..3 {
        let worker = world.join();
        let process = world.last_number as u32;
        let run = world.lease(worker);
        let tile = *killer.get_or_insert(run.tiles[0]);
        assert_eq!(run.tiles[0], tile, "it goes first to a worker that has nothing else");
        let (ask, actions) = world.ask(worker, SECOND);
        assert_eq!(actions.is_empty(), lost > 0, "a suspect is alone");
        world.farm.on_hang_up(ask);
        world.farm.on_process_exit(process, "killed by signal 11", world.now);
    }
    let worker = world.join();
    for _ in 0..2 {
        let run = world.lease(worker);
        assert_ne!(Some(run.tiles[0]), killer);
        let actions = world.stitch(worker, &run);
        if shown(&actions).tiles_done == 2 {
            let tile = killer.unwrap().number();
            let reason = format!(
                "2 of 3 tiles are right; set aside, since 3 workers were lost with each or stood \
                 still: {tile}"
            );
            assert_eq!(shown(&actions).outcome, Some(Outcome::Failed(reason)));
        }
    }
    assert!(world.farm.ended.len() == 1);
}

#[test]
fn who_has_a_suspect_gets_no_tiles_that_it_offers() {
    let mut world = World::new();
    let (job, _) = world.submit(2);
    let dead = world.join();
    let process = world.last_number as u32;
    let suspect = world.lease(dead).tiles;
    world.farm.on_process_exit(process, "killed by signal 11", world.now);
    let worker = world.join();
    assert_eq!(world.lease(worker).tiles, suspect);
    assert_eq!(world.farm.on_offer(worker, job, &[0, 1], world.now), None);
    world.farm.check();
}

#[test]
fn an_overdue_tile_is_rendered_again_before_a_later_job() {
    let mut world = World::new();
    let (stuck, idle) = (world.join(), world.join());
    let (job, _) = world.submit(3);
    let first = world.lease(idle);
    let run = world.lease(stuck);
    let last = world.lease(idle);
    // Each takes 0.1 s.
    world.now += SECOND / 10;
    world.stitch(idle, &first);
    world.stitch(idle, &last);
    let (later, _) = world.submit(9);
    world.now += Duration::from_millis(550);
    assert_eq!(world.lease(idle).lease.job, later, "it may still come");
    world.now += Duration::from_millis(60);
    let again = world.lease(idle);
    assert_eq!((again.lease.job, &again.tiles), (job, &run.tiles));
    assert_eq!(world.lease(idle).lease.job, later, "and only once");
}

#[test]
fn a_later_job_starts_when_the_earlier_has_no_free_tile() {
    let mut world = World::new();
    let worker = world.join();
    for job in [world.submit(1).0, world.submit(1).0] {
        assert_eq!(world.lease(worker).lease.job, job);
    }
    let (id, actions) = world.ask(worker, Duration::ZERO);
    assert_eq!(answers(&actions), [(id, Ok(Next::Nothing))]);
}

#[test]
fn those_who_wait_longest_are_served_first() {
    let mut world = World::new();
    let workers = [world.join(), world.join(), world.join()];
    let asks = workers.map(|worker| world.ask(worker, 9 * SECOND).0);
    let (job, actions) = world.submit(2);
    let served: Vec<AskId> = answers(&actions).iter().map(|(ask, _)| *ask).collect();
    assert_eq!(served, asks[..2]);
    assert!(matches!(&answers(&actions)[0].1, Ok(Next::Render(run)) if run.lease.job == job));
}

#[test]
fn a_wait_ends_when_it_is_over() {
    let mut world = World::new();
    let worker = world.join();
    let (ask, actions) = world.ask(worker, 9 * SECOND);
    assert!(actions.is_empty());
    assert_eq!(world.farm.next_wake(), Some(world.now + 9 * SECOND));
    assert!(world.pass(8 * SECOND).is_empty());
    assert_eq!(answers(&world.pass(SECOND)), [(ask, Ok(Next::Nothing))]);
}

#[test]
fn tiles_of_a_lost_lease_go_to_a_worker_that_waits() {
    for is_told in [true, false] {
        let mut world = World::new();
        let (lost, waiting) = (world.join(), world.join());
        world.submit(1);
        let run = world.lease(lost);
        let (ask, actions) = world.ask(waiting, 9 * SECOND);
        assert!(actions.is_empty());
        let (actions, why) = if is_told {
            let why = "killed by signal 9";
            (world.farm.on_process_exit(1, why, world.now), why)
        } else {
            (world.pass(TERM), "no progress for 4.0 s")
        };
        let Action::Log(Notice::LeaseLost(loss, reason)) = &actions[0] else {
            panic!("{actions:?}")
        };
        assert_eq!((loss.lease, &loss.tiles, &reason[..]), (run.lease, &run.tiles, why));
        let [(answered, Ok(Next::Render(again)))] = &answers(&actions)[..] else {
            panic!("{actions:?}")
        };
        assert_eq!((*answered, &again.tiles), (ask, &run.tiles));
    }
}

#[test]
fn a_tile_of_a_quiet_lease_goes_to_another_worker_that_waits() {
    let mut world = World::new();
    let (quiet, idle) = (world.join(), world.join());
    world.submit(1);
    let (run, start) = (world.lease(quiet), world.now);
    world.ask(quiet, 9 * SECOND);
    assert_eq!(world.farm.next_wake(), Some(world.now + TERM), "its own tile is not for it");
    let (ask, _) = world.ask(idle, 9 * SECOND);
    let wake = world.farm.next_wake().unwrap();
    assert!(wake < world.now + TERM);
    let actions = world.pass(wake - world.now);
    let [(answered, Ok(Next::Render(again)))] = &answers(&actions)[..] else {
        panic!("{actions:?}")
    };
    assert_eq!((*answered, &again.tiles), (ask, &run.tiles));
    assert_eq!(world.farm.next_wake(), Some(start + TERM), "and only once");
}

#[test]
fn a_silent_worker_is_forgotten_and_told_so() {
    let mut world = World::new();
    let worker = world.join();
    let actions = world.pass(LONGEST_SILENCE);
    assert!(matches!(actions[..], [Action::Log(Notice::Gone(gone, _))] if gone == worker));
    let (ask, actions) = world.ask(worker, SECOND);
    assert_eq!(answers(&actions), [(ask, Err(NoMember(worker)))]);
    assert_eq!(world.farm.on_renew(worker, &[], world.now), Err(NoMember(worker)));
}

#[test]
fn a_worker_that_leaves_waits_no_longer() {
    let mut world = World::new();
    let worker = world.join();
    let (ask, _) = world.ask(worker, SECOND);
    let actions = world.farm.on_leave(worker, "it was stopped", world.now);
    assert_eq!(answers(&actions), [(ask, Err(NoMember(worker)))]);
    assert!(answers(&world.submit(1).1).is_empty());
}

#[test]
fn a_second_question_of_a_worker_ends_the_first() {
    let mut world = World::new();
    let worker = world.join();
    let (first, _) = world.ask(worker, SECOND);
    let (second, actions) = world.ask(worker, SECOND);
    assert_eq!(answers(&actions), [(first, Ok(Next::Nothing))]);
    assert_eq!(answers(&world.submit(1).1)[0].0, second);
}

#[test]
fn who_hangs_up_gets_no_lease() {
    let mut world = World::new();
    let worker = world.join();
    let (ask, _) = world.ask(worker, SECOND);
    world.farm.on_hang_up(ask);
    let (_, actions) = world.submit(1);
    assert!(answers(&actions).is_empty());
    assert_eq!(world.lease(worker).lease.id, LeaseId(1), "it is the first");
}

#[test]
fn a_cancelled_job_fails_for_those_who_watch_and_is_forgotten() {
    let mut world = World::new();
    let worker = world.join();
    let (job, _) = world.submit(2);
    let run = world.lease(worker);
    let (delivery, _) = world.deliver(worker, &run, 7);
    let actions = world.farm.on_cancel(job, world.now);
    world.farm.check();
    let reason = Outcome::Failed("it was cancelled".to_owned());
    assert_eq!(shown(&actions).outcome, Some(reason));
    assert_eq!(verdicts(&actions), [(delivery, Verdict::Rejected)]);
    assert_eq!(forgotten(&actions), [job]);
    assert!(world.store(&run).is_empty(), "nobody wants it any more");
    let renewal = Renewal { lease: run.lease, work: 1, tiles: Vec::new() };
    assert_eq!(world.farm.on_renew(worker, &[renewal], world.now), Ok(vec![run.lease]));
    assert!(world.farm.on_cancel(job, world.now).is_empty(), "there is no such job");
}

#[test]
fn jobs_that_ended_are_kept_until_they_are_too_old_or_too_large_together() {
    let mut world = World::new();
    world.farm.keep(Keeping { time: SECOND * 100, byte_count: 25 });
    let end = |world: &mut World, byte_count| {
        let job = world.submit_with(1, Terms { byte_count, ..Terms::default() });
        let worker = world.join();
        let run = world.lease(worker);
        (job, forgotten(&world.stitch(worker, &run)))
    };
    let (first, gone) = end(&mut world, 10);
    assert_eq!(gone, []);
    world.pass(SECOND);
    let (second, gone) = end(&mut world, 10);
    assert_eq!(gone, []);
    let left = |world: &World| -> Vec<Duration> {
        let entries = world.farm.job_entries(world.now).into_iter();
        entries.filter_map(|entry| entry.expires_in).collect()
    };
    assert_eq!(left(&world), [SECOND * 99, SECOND * 100]);
    let (third, gone) = end(&mut world, 10);
    assert_eq!(gone, [first], "the first that ended");
    let (large, gone) = end(&mut world, 1000);
    assert_eq!(gone, [second, third], "what is the last to end is kept, whatever it has");
    assert_eq!(forgotten(&world.pass(SECOND * 99)), []);
    assert_eq!(world.farm.next_wake(), Some(world.now + SECOND));
    assert_eq!(forgotten(&world.pass(SECOND)), [large]);
    let (last, _) = end(&mut world, 1);
    assert_eq!(forgotten(&world.farm.on_cancel(last, world.now)), [last], "fetched or not wanted");
    world.farm.check();
}

#[test]
fn a_job_of_higher_priority_goes_first_and_a_paused_one_rests() {
    let mut world = World::new();
    let worker = world.join();
    let [low, high] =
        [0, 1].map(|priority| world.submit_with(20, Terms { priority, ..Terms::default() }));
    assert_eq!(world.lease(worker).lease.job, high);
    let change = |world: &mut World, job, change| {
        let (changed, actions) = world.farm.on_change(job, change, world.now);
        world.farm.check();
        (changed, actions)
    };
    let (changed, actions) = change(&mut world, low, Change::Priority(2));
    assert_eq!(changed, Ok(()));
    assert!(matches!(actions[0], Action::Keep(job, Terms { priority: 2, .. }) if job == low));
    assert_eq!(world.lease(worker).lease.job, low);
    for job in [low, high] {
        assert_eq!(change(&mut world, job, Change::Pause(true)).0, Ok(()));
    }
    let other = world.join();
    let (ask, actions) = world.ask(other, SECOND * 9);
    assert!(answers(&actions).is_empty(), "nor is anything rendered a second time");
    assert!(answers(&world.pass(SECOND)).is_empty());
    let phases = |world: &World| -> Vec<(JobId, JobPhase)> {
        world.farm.job_entries(world.now).iter().map(|entry| (entry.id, entry.phase)).collect()
    };
    assert_eq!(phases(&world), [(low, JobPhase::Paused), (high, JobPhase::Paused)]);
    let (_, actions) = change(&mut world, high, Change::Pause(false));
    let [(answered, Ok(Next::Render(run)))] = &answers(&actions)[..] else { panic!("{actions:?}") };
    assert_eq!((*answered, run.lease.job), (ask, high));
    assert_eq!(phases(&world), [(low, JobPhase::Paused), (high, JobPhase::Rendering)]);
    assert_eq!(change(&mut world, JobId(99), Change::Pause(true)).0, Err(Refused::Unknown));
    world.farm.on_store_failed(high, "the disk is full".to_owned(), world.now);
    assert_eq!(change(&mut world, high, Change::Priority(1)).0, Err(Refused::Ended));
    assert_eq!(change(&mut world, low, Change::Retry).0, Err(Refused::NotFailed));
}

#[test]
fn so_many_workers_render_a_job_and_no_more() {
    let mut world = World::new();
    let [first, second] = [world.join(), world.join()];
    let narrow = world.submit_with(40, Terms { most_workers: Some(1), ..Terms::default() });
    let wide = world.submit(40).0;
    let runs = [first, first, second].map(|worker| world.lease(worker));
    assert_eq!(runs.map(|run| run.lease.job), [narrow, narrow, wide]);
    world.farm.on_leave(first, "it is tired", world.now);
    assert_eq!(world.lease(second).lease.job, narrow, "there is room again");
}

#[test]
fn what_failed_is_tried_again_and_nothing_else() {
    let mut world = World::with_audit(0.0);
    let worker = world.join();
    let (job, _) = world.submit(3);
    let [run, open] = [(); 2].map(|()| world.lease(worker));
    world.stitch(worker, &run);
    world.farm.on_store_failed(job, "the disk is full".to_owned(), world.now);
    world.pass(SECOND);
    let (retried, actions) = world.farm.on_change(job, Change::Retry, world.now);
    world.farm.check();
    assert_eq!(retried, Ok(()));
    assert!(matches!(actions[0], Action::Reopen(reopened) if reopened == job));
    let now = shown(&actions);
    assert_eq!((now.tiles_done, now.retry_count, now.outcome), (1, 1, None));
    let late = world.deliver(worker, &open, 7);
    assert_eq!(verdicts(&late.1), [(late.0, Verdict::Rejected)], "its lease ended with the job");
    let mut rendered = Vec::new();
    let mut last = Vec::new();
    while rendered.len() < 2 {
        let rest = world.lease(worker);
        for &tile in &rest.tiles {
            rendered.push(tile);
            last = world.stitch(worker, &Run { tiles: vec![tile], ..rest.clone() });
        }
    }
    assert!(rendered[0] != rendered[1] && !rendered.contains(&run.tiles[0]), "{rendered:?}");
    assert_eq!(shown(&last).outcome, Some(Outcome::Finished(Duration::ZERO)));
}

#[test]
fn a_job_that_failed_under_an_earlier_start_is_tried_again_when_its_tiles_are_known() {
    let mut world = World::new();
    let failed = Progress {
        outcome: Some(Outcome::Failed("no luck".to_owned())),
        tile_count: 2,
        ..Progress::default()
    };
    let grid = TileGrid::new(Size::new(32, 16).unwrap(), 16).unwrap();
    let foreign = Terms { is_foreign: true, ..Terms::default() };
    for (number, terms) in [(1, Terms::default()), (2, foreign)] {
        let age = (SECOND, world.now);
        world.farm.on_kept(JobId(number), failed.clone(), terms, age);
    }
    let retry = |world: &mut World, job, known| {
        let answer = world.farm.on_retry(JobId(job), known, world.now).0;
        world.farm.check();
        answer
    };
    assert_eq!(retry(&mut world, 2, None), Err(Refused::Foreign));
    assert_eq!(retry(&mut world, 1, None), Err(Refused::TilesUnknown));
    let mut tiles = Tiles::new(grid);
    tiles.set_done(grid.tile(0).unwrap(), [7; 32]);
    let tally = Tally { rays: 5, ..Tally::default() };
    let earlier = Earlier { elapsed: SECOND * 7, tally, worker_count: 3 };
    assert_eq!(retry(&mut world, 1, Some((tiles, earlier))), Ok(()));
    let worker = world.join();
    let run = world.lease(worker);
    assert_eq!(run.tiles, [grid.tile(1).unwrap()]);
    world.pass(SECOND);
    let end = shown(&world.stitch(worker, &run));
    assert_eq!(end.outcome, Some(Outcome::Finished(SECOND * 8)), "all of its time counts");
    assert_eq!((end.tally.rays, end.worker_count), (15, 3));
}

#[test]
fn a_worker_gets_no_scene_for_which_it_has_no_memory_and_who_waits_is_told() {
    let mut world = World::new();
    let process = |nonce, memory| Process {
        nonce,
        number: nonce as u32,
        threads: 1,
        memory: Some(memory),
        ..Process::default()
    };
    let obstacle = |world: &World| world.farm.job_entries(world.now)[0].progress.obstacle.clone();
    let job = world.submit_with(4, Terms { scene_byte_count: 100, ..Terms::default() });
    assert_eq!(obstacle(&world), None, "somebody may join");
    let (small, actions) = world.farm.on_join(process(1, 99), world.now);
    let small = small.unwrap();
    let reason = "no worker can hold its scene of 100 bytes: the largest has room for 99";
    assert_eq!(obstacle(&world).as_deref(), Some(reason));
    assert_eq!(shown(&actions).obstacle.as_deref(), Some(reason));
    let is_told =
        |action: &Action| matches!(action, Action::Log(Notice::NoRoom(of, _)) if *of == job);
    assert!(actions.iter().any(is_told));
    let (waits, actions) = world.ask(small, SECOND * 99);
    assert!(answers(&actions).is_empty());

    let (large, actions) = world.farm.on_join(process(2, 100), world.now);
    assert_eq!(shown(&actions).obstacle, None);
    let run = world.lease(large.unwrap());
    assert_eq!(run.lease.job, job);
    let later = world.submit_with(4, Terms { scene_byte_count: 99, ..Terms::default() });
    world.pass(SECOND * 20);
    let (asked, actions) = world.ask(small, SECOND);
    let [(id, Ok(Next::Render(run)))] = &answers(&actions)[..] else { panic!("{actions:?}") };
    assert_eq!((*id, run.lease.job), (asked, later), "neither free nor overdue tiles of the first");
    assert_ne!(waits, asked);
    world.farm.on_leave(large.unwrap(), "", world.now);
    assert_eq!(obstacle(&world).as_deref(), Some(reason));
}

#[test]
fn a_drained_worker_brings_what_it_has_and_goes_home_and_a_disabled_one_gets_nothing() {
    let mut world = World::new();
    let [drained, disabled] = [world.join(), world.join()];
    world.submit(9);
    let run = world.lease(drained);
    let station = |world: &mut World, worker, standing| {
        let (known, actions) = world.farm.on_station(worker, standing, world.now);
        world.farm.check();
        known.map(|()| actions)
    };
    station(&mut world, disabled, Standing::Disabled).unwrap();
    let (asked, actions) = world.ask(disabled, SECOND * 99);
    assert!(answers(&actions).is_empty());
    station(&mut world, drained, Standing::Draining).unwrap();
    let (last, actions) = world.ask(drained, SECOND * 99);
    assert!(answers(&actions).is_empty(), "it has tiles still");
    let mut sent = Vec::new();
    for &tile in &run.tiles {
        let run = Run { tiles: vec![tile], ..run.clone() };
        let (_, actions) = world.deliver(drained, &run, 7);
        sent.extend(answers(&actions));
        world.store(&run);
    }
    assert_eq!(sent, [(last, Ok(Next::GoHome))]);
    assert_eq!(station(&mut world, drained, Standing::Active).unwrap_err(), NoMember(drained));
    let [(entry, 0)] = &world.farm.worker_entries(world.now)[..] else { panic!("one is left") };
    assert_eq!((entry.worker, entry.standing), (disabled, Standing::Disabled));
    let actions = station(&mut world, disabled, Standing::Active).unwrap();
    assert!(matches!(answers(&actions)[..], [(id, Ok(Next::Render(_)))] if id == asked));
    let kept = |action: &Action| matches!(action, Action::KeepMarks(marks) if marks.is_empty());
    assert!(actions.iter().any(kept), "nobody is drained or disabled any more");
}

#[test]
fn a_job_whose_client_goes_untold_ends_unless_another_was_told() {
    for is_claimed in [false, true] {
        let mut world = World::new();
        let (job, _) = world.submit(1);
        if is_claimed {
            world.farm.on_claim(job);
        }
        let actions = world.farm.on_abandon(job, world.now);
        assert_eq!(forgotten(&actions).is_empty(), is_claimed);
        world.farm.check();
    }
}

#[test]
fn a_farm_that_closes_sends_home_who_asks() {
    let mut world = World::new();
    let (waiting, busy) = (world.join(), world.join());
    let (ask, _) = world.ask(waiting, 9 * SECOND);
    let actions = world.farm.on_close();
    world.farm.check();
    assert_eq!(answers(&actions), [(ask, Ok(Next::GoHome))]);
    let (ask, actions) = world.ask(busy, 9 * SECOND);
    assert_eq!(answers(&actions), [(ask, Ok(Next::GoHome))]);
    assert_eq!(actions.len(), 1, "to close is not to stop: {actions:?}");
}

#[test]
fn a_farm_that_shuts_down_ends_every_job_and_stops_with_the_last_worker() {
    for comes in [true, false] {
        let mut world = World::new();
        let worker = world.join();
        let (job, _) = world.submit(2);
        world.lease(worker);
        let actions = world.farm.on_shut_down(world.now);
        world.farm.check();
        let stopped = Outcome::Failed("the coordinator was stopped".to_owned());
        assert_eq!(shown(&actions).outcome, Some(stopped.clone()));
        assert!(!actions.iter().any(|action| matches!(action, Action::Stop)));
        assert_eq!(world.farm.tile(job, 0), None);
        let actions = if comes {
            let (ask, actions) = world.ask(worker, 9 * SECOND);
            assert_eq!(answers(&actions), [(ask, Ok(Next::GoHome))]);
            actions
        } else {
            assert_eq!(world.farm.next_wake(), Some(world.now + FAREWELL));
            world.pass(FAREWELL)
        };
        assert!(matches!(actions.last(), Some(Action::Stop)), "{actions:?}");
        assert_eq!(shown(&world.submit(1).1).outcome, Some(stopped), "it comes too late");
    }
}

#[test]
fn tiles_that_a_worker_kept_are_leased_to_it_if_they_are_free() {
    let mut world = World::new();
    let (kept, other) = (world.join(), world.join());
    let (job, _) = world.submit(20);
    let taken = world.lease(other);
    let grid = world.farm.leases.tiles(job).unwrap().grid();
    let free = (0..20).find(|&number| !taken.tiles.contains(&grid.tile(number).unwrap())).unwrap();
    let numbers = [taken.tiles[0].number(), free, 99];
    let mut offer = |worker, job| {
        let run = world.farm.on_offer(worker, job, &numbers, world.now);
        world.farm.check();
        run
    };
    assert_eq!(offer(WorkerId(77), job), None, "nobody knows it");
    assert_eq!(offer(kept, JobId(7)), None, "there is no such job");
    let run = offer(kept, job).expect("one of them is free");
    assert_eq!(run.tiles, [grid.tile(free).unwrap()]);
    assert_eq!(offer(kept, job), None, "none is free now");
    let actions = world.stitch(kept, &run);
    assert!(matches!(verdicts(&actions)[..], [(_, Verdict::Accepted)]), "{actions:?}");
}

#[test]
fn a_farm_that_keeps_its_jobs_goes_on_with_them() {
    let mut world = World::new();
    let identity = Identity::from_random([2; 24]);
    world.farm = Farm::keeping_jobs(identity, TERM, Audit::new(0.0, [7; 32]), JobId(5));
    let grid = TileGrid::new(Size::new(64, 16).unwrap(), 16).unwrap();
    let done = |numbers: &[u32]| {
        let mut tiles = Tiles::new(grid);
        for &number in numbers {
            tiles.set_done(grid.tile(number).unwrap(), [7; 32]);
        }
        tiles
    };
    let earlier = Earlier {
        elapsed: 9 * SECOND,
        tally: Tally { rays: 30, ..Tally::default() },
        worker_count: 2,
    };
    let actions = world.farm.on_order(
        JobId(3),
        done(&[0, 1, 3]),
        earlier.clone(),
        Terms::default(),
        world.now,
    );
    world.farm.check();
    assert_eq!((shown(&actions).tiles_done, shown(&actions).tally.rays), (3, 30));
    let worker = world.join();
    let run = world.lease(worker);
    assert_eq!(run.tiles, [grid.tile(2).unwrap()]);
    world.now += SECOND;
    let progress = shown(&world.stitch(worker, &run));
    assert_eq!(progress.outcome, Some(Outcome::Finished(10 * SECOND)));
    assert_eq!((progress.tally.rays, progress.worker_count), (40, 2));

    let whole =
        world.farm.on_order(JobId(4), done(&[0, 1, 2, 3]), earlier, Terms::default(), world.now);
    world.farm.check();
    assert_eq!(shown(&whole).outcome, Some(Outcome::Finished(9 * SECOND)));
    assert_eq!(world.farm.number_job(), JobId(6));
    let actions =
        world.farm.on_kept(JobId(1), progress, Terms::default(), (Duration::ZERO, world.now));
    world.farm.check();
    assert!(shown(&actions).outcome.is_some());
    let (job, _) = world.submit(2);
    let actions = world.farm.on_shut_down(world.now);
    assert!(!actions.iter().any(|action| matches!(action, Action::Publish(..))), "{actions:?}");
    assert!(world.farm.tile(job, 0).is_some(), "it goes on later");
}

#[test]
fn a_worker_on_trial_gets_nothing_besides_though_it_kept_pixels() {
    let mut world = World::new();
    let (job, _) = world.submit(3);
    let dead = world.join();
    let suspect = world.lease(dead).tiles[0];
    world.farm.on_process_exit(world.last_number as u32 - 1, "killed by signal 11", world.now);
    let worker = world.join();
    assert_eq!(world.lease(worker).tiles, [suspect]);
    assert_eq!(world.farm.on_offer(worker, job, &[0, 1, 2], world.now), None);
    world.farm.check();
}
