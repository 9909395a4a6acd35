//! A submission with a coordinator that the test plays.

use super::*;

const JOB: JobId = JobId(7);
const SECOND: Duration = Duration::from_secs(1);
const PATIENCE: Duration = Duration::from_secs(20);

#[expect(clippy::disallowed_methods, reason = "any instant will do")]
fn start() -> Instant {
    Instant::now()
}

fn coordinator() -> Address {
    Address::Tcp("host:1".to_owned())
}

fn size() -> Size {
    Size::new(4, 3).unwrap()
}

fn accepted() -> Submitted {
    let outcome = SubmitOutcome::Accepted { job: JOB, size: size() };
    Submitted { outcome, report: "a warning".to_owned() }
}

fn state(end: Option<JobEnd>) -> JobState {
    let (tiles_done, tile_count) = if end.is_some() { (9, 9) } else { (4, 9) };
    let tally = Tally { rays: 5, ..Tally::default() };
    let obstacle = String::new();
    JobState {
        tiles_done,
        tile_count,
        tally,
        worker_count: 2,
        hosts: vec!["host".to_owned()],
        differing_tiles: 0,
        obstacle,
        left: None,
        end,
    }
}

fn finished() -> JobEnd {
    JobEnd::Finished(SECOND)
}

/// A submission on a clock that only the test moves.
struct Bench {
    submission: Submission,
    now: Instant,
}

impl Bench {
    fn connecting() -> Self {
        Self::with(false)
    }

    fn with(is_detached: bool) -> Self {
        let (now, scene) = (start(), "scene.rt".to_owned());
        let submission = Submission::new(scene, coordinator(), PATIENCE, is_detached, now);
        Self { submission, now }
    }

    fn submitting() -> Self {
        let mut bench = Self::connecting();
        bench.submission.on_connected(bench.now);
        bench
    }

    fn watching() -> Self {
        let mut bench = Self::submitting();
        bench.submission.on_submitted(accepted(), bench.now);
        bench.submission.on_watching();
        bench
    }

    fn fetching() -> Self {
        let mut bench = Self::watching();
        bench.submission.on_job_state(state(Some(finished())), bench.now);
        bench
    }

    /// The names of the actions since the last time, and how the submission ended.
    fn actions(&mut self) -> (Vec<String>, Option<Result<Ended, NoPicture>>) {
        let mut names = Vec::new();
        let mut end = None;
        while let Some(action) = self.submission.next_action() {
            assert!(end.is_none(), "nothing comes after the end, but {action:?}");
            match action {
                Action::End(as_told) => end = Some(as_told),
                Action::Show(state) => names.push(format!("Show({})", state.tiles_done)),
                action => names.push(format!("{action:?}")),
            }
        }
        assert!(end.is_none() || self.submission.wake_at().is_none(), "an end is no wait");
        (names, end)
    }

    fn check_actions(&mut self, expected: &[&str]) {
        let (names, end) = self.actions();
        assert_eq!(names, expected);
        assert!(end.is_none(), "{end:?}");
    }

    /// Checks that the last actions are these and a failure with that code and message.
    fn check_failed(&mut self, expected: &[&str], code: u8, message: &str) {
        let (names, end) = self.actions();
        assert!(names.ends_with(&expected.iter().map(ToString::to_string).collect::<Vec<_>>()));
        let failure = end.expect("an end").expect_err("a failure");
        let of_kind = match failure {
            NoPicture::Failed(_) => 1,
            NoPicture::Refused(_) | NoPicture::Told => 2,
            NoPicture::Interrupted => 130,
        };
        assert_eq!((of_kind, failure.to_string().as_str()), (code, message));
    }

    /// Lets time pass until the submission wants to be woken; answers with how long it slept.
    fn sleep(&mut self) -> Duration {
        let wake = self.submission.wake_at().expect("something to wait for");
        let slept = wake - self.now;
        self.submission.on_tick(self.now + slept.mul_f64(0.999));
        assert_eq!(self.submission.wake_at(), Some(wake), "nothing happens before");
        self.now = wake;
        self.submission.on_tick(self.now);
        slept
    }
}

#[test]
fn a_picture_is_submitted_watched_fetched_and_its_job_forgotten() {
    let mut bench = Bench::connecting();
    bench.check_actions(&["Connect"]);
    bench.submission.on_connected(bench.now);
    bench.check_actions(&["Submit"]);
    bench.submission.on_submitted(accepted(), bench.now);
    bench.check_actions(&[r#"TellReport("a warning")"#, "Watch(JobId(7))"]);
    bench.submission.on_watching();
    bench.submission.on_job_state(state(None), bench.now);
    bench.check_actions(&["Show(4)"]);
    bench.submission.on_job_state(state(Some(finished())), bench.now);
    bench.check_actions(&["Show(9)", "Fetch(JobId(7))"]);
    bench.submission.on_chunk_awaited(bench.now);
    bench.submission.on_chunk();
    bench.submission.on_fetched(bench.now);
    bench.check_actions(&["Cancel(JobId(7))"]);
    bench.submission.on_cancelled();
    let (names, end) = bench.actions();
    assert_eq!(names, [""; 0]);
    let tally = Tally { rays: 5, ..Tally::default() };
    let expected = Finished {
        size: size(),
        tally,
        worker_count: 2,
        hosts: vec!["host".to_owned()],
        rendering: SECOND,
    };
    let end = end.expect("an end").expect("a picture");
    assert_eq!(end, Ended::Finished(JOB, expected));
}

#[test]
fn a_detached_job_goes_on_when_its_number_is_known() {
    let mut bench = Bench::with(true);
    bench.submission.on_connected(bench.now);
    bench.submission.on_submitted(accepted(), bench.now);
    let (names, end) = bench.actions();
    assert_eq!(names, ["Connect", "Submit", r#"TellReport("a warning")"#]);
    assert_eq!(end.expect("an end").expect("a job"), Ended::Detached(JOB, size()));
}

#[test]
fn an_order_whose_answer_is_lost_is_submitted_again() {
    let mut bench = Bench::submitting();
    bench.actions();
    bench.submission.on_trouble(Trouble::Lost("broken pipe".to_owned()), bench.now);
    bench.check_actions(&[]);
    assert_eq!(bench.sleep(), FIRST_PAUSE);
    bench.check_actions(&["Connect"]);
    bench.submission.on_connected(bench.now);
    bench.check_actions(&["Submit"]);
    bench.submission.on_submitted(accepted(), bench.now);
    bench.check_actions(&[r#"TellReport("a warning")"#, "Watch(JobId(7))"]);
    let mut bench = Bench::submitting();
    bench.submission.on_trouble(Trouble::Gone, bench.now);
    bench.submission.on_stop(bench.now);
    bench.check_failed(&["Submit"], 130, "interrupted");
}

#[test]
fn a_refused_scene_is_bad_input() {
    let refused = |reason: &str| Submitted {
        outcome: SubmitOutcome::Refused(reason.to_owned()),
        report: "3:1: an error".to_owned(),
    };
    let mut bench = Bench::submitting();
    bench.submission.on_submitted(refused("it has no viewport"), bench.now);
    let told = r#"TellReport("3:1: an error")"#;
    bench.check_failed(&[told], 2, "the farm cannot render scene.rt: it has no viewport");
    let mut bench = Bench::submitting();
    bench.submission.on_submitted(refused(""), bench.now);
    bench.check_failed(&[told], 2, "");
}

#[test]
fn a_failed_job_is_forgotten_and_its_reason_told() {
    let mut bench = Bench::watching();
    let failed = JobEnd::Failed("the coordinator was stopped".to_owned());
    bench.submission.on_job_state(state(Some(failed)), bench.now);
    bench.submission.on_cancelled();
    let message = "the job failed: the coordinator was stopped";
    bench.check_failed(&["Cancel(JobId(7))"], 1, message);
}

#[test]
fn a_coordinator_that_is_gone_is_found_again() {
    let lost = || Trouble::Lost("broken pipe".to_owned());
    for mut bench in [Bench::watching(), Bench::fetching()] {
        bench.actions();
        bench.submission.on_trouble(Trouble::Gone, bench.now);
        bench.check_actions(&[]);
        assert_eq!(bench.sleep(), FIRST_PAUSE);
        bench.check_actions(&["Connect"]);
        bench
            .submission
            .on_trouble(Trouble::Connect(coordinator(), "refused".to_owned()), bench.now);
        assert_eq!(bench.sleep(), FIRST_PAUSE * 2);
        bench.check_actions(&["Connect"]);
        bench.submission.on_connected(bench.now);
        bench.check_actions(&["Watch(JobId(7))"]);
        assert_eq!(bench.submission.deadline, Some(bench.now + DEADLINE));
        bench.submission.on_trouble(lost(), bench.now);
        assert_eq!(bench.sleep(), FIRST_PAUSE * 4);
        bench.submission.on_connected(bench.now);
        bench.check_actions(&["Connect", "Watch(JobId(7))"]);
        bench.submission.on_watching();
        bench.submission.on_job_state(state(None), bench.now);
        bench.submission.on_trouble(lost(), bench.now);
        assert_eq!(bench.sleep(), FIRST_PAUSE, "it was there again");
    }
}

#[test]
fn a_picture_that_is_cut_short_is_fetched_again() {
    let mut bench = Bench::fetching();
    bench.actions();
    bench.submission.on_chunk();
    bench.submission.on_trouble(Trouble::Lost("broken pipe".to_owned()), bench.now);
    bench.submission.on_trouble(Trouble::File("it was cut short".to_owned()), bench.now);
    bench.check_actions(&[]);
    assert_eq!(bench.sleep(), FIRST_PAUSE);
    bench.check_actions(&["Connect"]);
}

#[test]
fn a_coordinator_that_stays_away_is_given_up() {
    let mut bench = Bench::watching();
    bench.submission.on_trouble(Trouble::Gone, bench.now);
    let gone_at = bench.now;
    loop {
        bench.sleep();
        if bench.actions().0.iter().any(|name| name.starts_with("Cancel")) {
            break;
        }
    }
    let waited = bench.now - gone_at;
    assert!(PATIENCE < waited + LONGEST_PAUSE && waited <= PATIENCE, "{waited:?}");
    bench.submission.on_trouble(Trouble::Gone, bench.now);
    bench.check_failed(&[], 1, "the coordinator does not answer");
}

#[test]
fn what_a_coordinator_says_is_not_asked_again() {
    let mut bench = Bench::watching();
    bench.submission.on_job_state(state(None), bench.now);
    bench.submission.on_trouble(Trouble::Call("there is no such job".to_owned()), bench.now);
    bench.submission.on_trouble(Trouble::Gone, bench.now);
    let message = "the coordinator says: there is no such job";
    bench.check_failed(&["Show(4)", "Cancel(JobId(7))"], 1, message);
    let mut bench = Bench::watching();
    bench.submission.on_trouble(Trouble::Gone, bench.now);
    bench.submission.on_stop(bench.now);
    bench.submission.on_cancelled();
    bench.check_failed(&["Cancel(JobId(7))"], 130, "interrupted");
}

#[test]
fn who_has_no_token_any_more_is_told_of_the_job_that_goes_on() {
    let forbidden = || Trouble::Forbidden("the token is not known".to_owned());
    let mut reconnecting = Bench::watching();
    reconnecting.submission.on_trouble(Trouble::Gone, reconnecting.now);
    for mut bench in [Bench::watching(), Bench::fetching(), reconnecting] {
        bench.submission.on_trouble(forbidden(), bench.now);
        let message = "the coordinator says: the token is not known; job 7 goes on: with a token, \
                       rtfarm image 7 --coordinator http://host:1 -o FILE fetches its picture";
        bench.check_failed(&[], 1, message);
    }
    let mut bench = Bench::submitting();
    bench.submission.on_trouble(forbidden(), bench.now);
    bench.check_failed(&[], 1, "the coordinator says: the token is not known");
}

#[test]
fn differing_tiles_are_warned_of_once_the_picture_is_finished() {
    let mut bench = Bench::watching();
    bench.actions();
    bench.submission.on_job_state(JobState { differing_tiles: 3, ..state(None) }, bench.now);
    bench.check_actions(&["Show(4)"]);
    let last = JobState { differing_tiles: 3, ..state(Some(finished())) };
    bench.submission.on_job_state(last, bench.now);
    bench.check_actions(&["Show(9)", "WarnOfDifferingTiles(3)", "Fetch(JobId(7))"]);
}

#[test]
fn before_there_is_a_job_an_interruption_ends_at_once() {
    for (mut bench, last) in [(Bench::connecting(), "Connect"), (Bench::submitting(), "Submit")] {
        bench.submission.on_stop(bench.now);
        bench.check_failed(&[last], 130, "interrupted");
    }
}

#[test]
fn an_interrupted_job_is_forgotten() {
    for mut bench in [Bench::watching(), Bench::fetching()] {
        bench.submission.on_stop(bench.now);
        bench.submission.on_stop(bench.now);
        bench.submission.on_cancelled();
        bench.check_failed(&["Cancel(JobId(7))"], 130, "interrupted");
    }
}

#[test]
fn a_picture_that_was_written_is_a_success_whatever_comes_after() {
    let mut bench = Bench::fetching();
    bench.submission.on_fetched(bench.now);
    bench.submission.on_stop(bench.now);
    assert_eq!(bench.sleep(), CANCEL_DEADLINE);
    let (_, end) = bench.actions();
    end.expect("an end").expect("a picture");
}

#[test]
fn a_silent_coordinator_is_waited_for_so_long_and_no_longer() {
    let message = "the coordinator does not answer";
    for (mut bench, deadline) in
        [(Bench::connecting(), DEADLINE), (Bench::submitting(), SUBMIT_DEADLINE)]
    {
        assert_eq!(bench.sleep(), deadline);
        bench.check_failed(&[], 1, message);
    }
    let mut opening = Bench::submitting();
    opening.submission.on_submitted(accepted(), opening.now);
    let mut reading = Bench::fetching();
    reading.submission.on_chunk_awaited(reading.now);
    for (mut bench, deadline) in
        [(opening, DEADLINE), (Bench::fetching(), IMAGE_DEADLINE), (reading, CHUNK_DEADLINE)]
    {
        assert_eq!(bench.sleep(), deadline);
        assert_eq!(bench.sleep(), FIRST_PAUSE, "it has the job");
        bench.submission.on_stop(bench.now);
        assert_eq!(bench.sleep(), CANCEL_DEADLINE, "nor for its farewell");
        bench.check_failed(&["Connect", "Cancel(JobId(7))"], 130, "interrupted");
    }
}

#[test]
fn neither_rendering_nor_writing_has_a_deadline() {
    let mut bench = Bench::watching();
    assert_eq!(bench.submission.wake_at(), None);
    bench = Bench::fetching();
    bench.submission.on_chunk_awaited(bench.now);
    bench.submission.on_chunk();
    assert_eq!(bench.submission.wake_at(), None);
}

#[test]
fn a_picture_that_cannot_be_written_stays_with_the_farm() {
    let mut bench = Bench::fetching();
    let reason = "cannot write out.png: No space left on device".to_owned();
    bench.actions();
    bench.submission.on_trouble(Trouble::File(reason.clone()), bench.now);
    let message = format!(
        "{reason}; the farm keeps the picture for a while: rtfarm image 7 --coordinator \
         http://host:1 -o FILE fetches it"
    );
    bench.check_failed(&[], 1, &message);
}

#[test]
fn what_comes_after_its_time_changes_nothing() {
    let mut bench = Bench::watching();
    bench.submission.on_stop(bench.now);
    bench.actions();
    bench.submission.on_connected(bench.now);
    bench.submission.on_submitted(accepted(), bench.now);
    bench.submission.on_job_state(state(Some(finished())), bench.now);
    bench.submission.on_fetched(bench.now);
    bench.check_actions(&[]);
    bench.submission.on_cancelled();
    bench.actions();
    bench.submission.on_cancelled();
    bench.submission.on_stop(bench.now);
    bench.submission.on_trouble(Trouble::Gone, bench.now);
    bench.submission.on_tick(bench.now + SUBMIT_DEADLINE);
    bench.check_actions(&[]);
}

#[test]
fn what_a_job_waits_for_is_told_when_it_changes() {
    let mut bench = Bench::watching();
    bench.actions();
    let told = |bench: &mut Bench, obstacle: &str| {
        let obstacle = obstacle.to_owned();
        bench.submission.on_job_state(JobState { obstacle, ..state(None) }, bench.now);
        bench.actions().0.split_off(1)
    };
    assert_eq!(told(&mut bench, "too large"), ["WarnOfObstacle(\"too large\")"]);
    assert!(told(&mut bench, "too large").is_empty());
    assert!(told(&mut bench, "").is_empty());
    assert_eq!(told(&mut bench, "too large").len(), 1);
}
