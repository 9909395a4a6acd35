//! A client's side of one job: it submits a scene, watches the job, fetches the picture and has
//! the farm forget the job; a detached one ends when it knows its job. Decisions alone: what happens
//! comes in as events with the time, what is to be done goes out as [`Action`]s, and nothing here waits.

use std::{
    collections::VecDeque,
    fmt,
    time::{Duration, Instant},
};

use rtfarm_core::{render::Tally, tile::Size};
use rtfarm_proto::{Address, JobId};

/// What the shell is to do. All but [`Action::TellReport`], [`Action::Show`] and the warnings end what
/// was being done before.
#[derive(Debug)]
pub(crate) enum Action {
    /// Reach the coordinator.
    Connect,
    /// Send the order, the scene and its files.
    Submit,
    /// Tell the user what the coordinator says of the scene.
    TellReport(String),
    /// Follow a job from event to event.
    Watch(JobId),
    /// Show the user how far the job is.
    Show(JobState),
    /// Warn the user that the job waits, for that reason.
    WarnOfObstacle(String),
    /// Warn the user that so many tiles had a second copy that differed from the first.
    WarnOfDifferingTiles(u32),
    /// Bring the picture and write it.
    Fetch(JobId),
    /// Have the farm forget the job.
    Cancel(JobId),
    /// End; nothing comes after this.
    End(Result<Ended, NoPicture>),
}

/// What came of submitting a scene.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Submitted {
    pub(crate) outcome: SubmitOutcome,
    /// What there is to tell the scene's author.
    pub(crate) report: String,
}

#[derive(Debug, Clone, PartialEq)]
pub(crate) enum SubmitOutcome {
    Accepted {
        job: JobId,
        size: Size,
    },
    /// Why not; the report says it if this is empty.
    Refused(String),
}

/// How far a job is.
#[derive(Debug, Clone, PartialEq)]
pub struct JobState {
    /// Tiles in the picture.
    pub tiles_done: u32,
    /// Those and the others.
    pub tile_count: u32,
    /// What the tiles in the picture took, and how good they are.
    pub tally: Tally,
    /// Workers that have delivered something.
    pub worker_count: u32,
    /// Their hosts, once the job has ended.
    pub hosts: Vec<String>,
    /// Tiles with a second copy that differed from the first.
    pub differing_tiles: u32,
    /// Why the job does not get further, unless that may change by itself; otherwise empty.
    pub obstacle: String,
    /// How long it will take yet and one standard deviation of that, if it can be told.
    pub left: Option<[Duration; 2]>,
    /// How it ended, when it has.
    pub end: Option<JobEnd>,
}

/// How a job ended.
#[derive(Debug, Clone, PartialEq)]
pub enum JobEnd {
    /// The time from the job's start to its last tile.
    Finished(Duration),
    /// Why there is no picture.
    Failed(String),
}

/// What there is to say of a picture that was written.
#[derive(Debug, Clone, PartialEq)]
pub struct Finished {
    /// In pixels.
    pub size: Size,
    /// What its tiles took, and how good they are.
    pub tally: Tally,
    /// Workers that brought tiles.
    pub worker_count: u32,
    /// Their hosts.
    pub hosts: Vec<String>,
    /// From the job's start to its last tile.
    pub rendering: Duration,
}

/// What a submission came to.
#[derive(Debug, Clone, PartialEq)]
pub enum Ended {
    /// The job's picture was written.
    Finished(JobId, Finished),
    /// The job goes on by itself.
    Detached(JobId, Size),
}

/// Why there is no picture.
#[derive(Debug, Clone, PartialEq)]
pub enum NoPicture {
    /// The farm does not take the scene, for that reason.
    Refused(String),
    /// The same, and the coordinator's report has told why.
    Told,
    /// Something failed.
    Failed(String),
    /// Somebody stopped it.
    Interrupted,
}

impl fmt::Display for NoPicture {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Refused(reason) | Self::Failed(reason) => f.write_str(reason),
            Self::Told => Ok(()),
            Self::Interrupted => f.write_str("interrupted"),
        }
    }
}

/// What goes wrong on the way.
#[derive(Debug, Clone, PartialEq)]
pub enum Trouble {
    /// Nobody answers at the address.
    Connect(Address, String),
    /// The coordinator says why it does not do what was asked.
    Call(String),
    /// The coordinator says why nothing is done for who has this token.
    Forbidden(String),
    /// The connection has failed.
    Lost(String),
    /// A deadline has passed.
    Late,
    /// A stream has ended before its end.
    Gone,
    /// An answer cannot be understood.
    Nonsense(String),
    /// A file on this machine cannot be read or written.
    File(String),
}

impl fmt::Display for Trouble {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Connect(address, reason) => {
                write!(f, "no coordinator answers at {address}: {reason}")
            }
            Self::Call(reason) | Self::Forbidden(reason) => {
                write!(f, "the coordinator says: {reason}")
            }
            Self::Lost(reason) => write!(f, "the connection to the coordinator is lost: {reason}"),
            Self::Late => f.write_str("the coordinator does not answer"),
            Self::Gone => f.write_str("the coordinator is gone"),
            Self::Nonsense(reason) => {
                write!(f, "the coordinator's answer makes no sense: {reason}")
            }
            Self::File(reason) => f.write_str(reason),
        }
    }
}

/// The longest that a short question may wait for its answer.
const DEADLINE: Duration = Duration::from_secs(15);

/// A coordinator that listens forgets a job at once.
const CANCEL_DEADLINE: Duration = Duration::from_secs(3);

/// A scene may be large and take long to prepare.
const SUBMIT_DEADLINE: Duration = Duration::from_secs(1800);

/// Encoding a large picture takes a while.
const IMAGE_DEADLINE: Duration = Duration::from_secs(600);

/// The longest that a piece of the picture may be on its way.
const CHUNK_DEADLINE: Duration = Duration::from_secs(30);

/// The pause before a coordinator that is gone is looked for. It doubles each time, up to
/// [`LONGEST_PAUSE`].
pub const FIRST_PAUSE: Duration = Duration::from_millis(100);

/// The longest pause.
pub const LONGEST_PAUSE: Duration = Duration::from_secs(2);

/// A client's side of one job.
#[derive(Debug)]
pub(crate) struct Submission {
    /// What the scene is called in messages.
    scene: String,
    coordinator: Address,
    /// How long a coordinator that was reached may be gone.
    patience: Duration,
    /// The job outlives this client.
    is_detached: bool,
    /// What the user was told last of the job's obstacle.
    obstacle: String,
    /// When it was last heard of, if it is gone.
    gone_since: Option<Instant>,
    pause: Duration,
    stage: Stage,
    /// When what is being done must have come further.
    deadline: Option<Instant>,
    actions: VecDeque<Action>,
}

#[derive(Debug)]
enum Stage {
    Connecting,
    Submitting,
    Watching {
        job: JobId,
        size: Size,
    },
    Fetching {
        job: JobId,
        finished: Finished,
    },
    /// The coordinator was gone and is looked for, after a pause. It may have the job.
    Reconnecting {
        job: Option<(JobId, Size)>,
        is_pausing: bool,
    },
    /// The job is being forgotten; then the submission ends so.
    Cancelling {
        end: Result<Ended, NoPicture>,
    },
    Ended,
}

impl Submission {
    /// A submission that begins to look for the coordinator.
    pub(crate) fn new(
        scene: String,
        coordinator: Address,
        patience: Duration,
        is_detached: bool,
        now: Instant,
    ) -> Self {
        let mut submission = Self {
            scene,
            coordinator,
            patience,
            is_detached,
            obstacle: String::new(),
            gone_since: None,
            pause: FIRST_PAUSE,
            stage: Stage::Ended,
            deadline: None,
            actions: VecDeque::new(),
        };
        submission.enter(Stage::Connecting, Action::Connect, now + DEADLINE);
        submission
    }

    /// What is to be done next, if there is anything. Ask after every event until there is not.
    pub(crate) fn next_action(&mut self) -> Option<Action> {
        self.actions.pop_front()
    }

    /// When to call [`Submission::on_tick`] if nothing happens before.
    pub(crate) fn wake_at(&self) -> Option<Instant> {
        self.deadline
    }

    /// Event: the coordinator was reached.
    pub(crate) fn on_connected(&mut self, now: Instant) {
        match self.stage {
            // The order has a key: a coordinator that has the job already answers with it.
            Stage::Connecting | Stage::Reconnecting { job: None, .. } => {
                self.enter(Stage::Submitting, Action::Submit, now + SUBMIT_DEADLINE);
            }
            Stage::Reconnecting { job: Some((job, size)), .. } => {
                self.enter(Stage::Watching { job, size }, Action::Watch(job), now + DEADLINE);
            }
            _ => {}
        }
    }

    /// Event: the coordinator has looked at the scene.
    pub(crate) fn on_submitted(&mut self, submitted: Submitted, now: Instant) {
        let Stage::Submitting = self.stage else { return };
        self.actions.push_back(Action::TellReport(submitted.report));
        (self.gone_since, self.pause) = (None, FIRST_PAUSE);
        match submitted.outcome {
            SubmitOutcome::Accepted { job, size } if self.is_detached => {
                self.end(Ok(Ended::Detached(job, size)));
            }
            SubmitOutcome::Accepted { job, size } => {
                self.enter(Stage::Watching { job, size }, Action::Watch(job), now + DEADLINE);
            }
            SubmitOutcome::Refused(reason) if reason.is_empty() => self.end(Err(NoPicture::Told)),
            SubmitOutcome::Refused(reason) => {
                let scene = &self.scene;
                let reason = format!("the farm cannot render {scene}: {reason}");
                self.end(Err(NoPicture::Refused(reason)));
            }
        }
    }

    /// Event: the coordinator will tell of the job from now on.
    pub(crate) fn on_watching(&mut self) {
        if let Stage::Watching { .. } = self.stage {
            // A tile may take any time, and a dead connection is noticed by its keep-alive.
            self.deadline = None;
        }
    }

    /// Event: the job has come further.
    pub(crate) fn on_job_state(&mut self, state: JobState, now: Instant) {
        let Stage::Watching { job, size } = self.stage else { return };
        (self.gone_since, self.pause) = (None, FIRST_PAUSE);
        self.actions.push_back(Action::Show(state.clone()));
        if state.obstacle != self.obstacle {
            self.obstacle.clone_from(&state.obstacle);
            let warning = (!state.obstacle.is_empty()).then_some(state.obstacle.clone());
            self.actions.extend(warning.map(Action::WarnOfObstacle));
        }
        match state.end {
            None => {}
            Some(JobEnd::Finished(rendering)) => {
                if state.differing_tiles > 0 {
                    self.actions.push_back(Action::WarnOfDifferingTiles(state.differing_tiles));
                }
                let JobState { tally, worker_count, hosts, .. } = state;
                let finished = Finished { size, tally, worker_count, hosts, rendering };
                let fetching = Stage::Fetching { job, finished };
                self.enter(fetching, Action::Fetch(job), now + IMAGE_DEADLINE);
            }
            Some(JobEnd::Failed(reason)) => {
                self.cancel(job, Err(NoPicture::Failed(format!("the job failed: {reason}"))), now);
            }
        }
    }

    /// Event: a piece of the picture is here.
    pub(crate) fn on_chunk(&mut self) {
        if let Stage::Fetching { .. } = self.stage {
            // Writing it is not the coordinator's affair.
            self.deadline = None;
        }
    }

    /// Event: the next piece of the picture is waited for.
    pub(crate) fn on_chunk_awaited(&mut self, now: Instant) {
        if let Stage::Fetching { .. } = self.stage {
            self.deadline = Some(now + CHUNK_DEADLINE);
        }
    }

    /// Event: the whole picture was written.
    pub(crate) fn on_fetched(&mut self, now: Instant) {
        if let Stage::Fetching { job, finished } = &self.stage {
            self.cancel(*job, Ok(Ended::Finished(*job, finished.clone())), now);
        }
    }

    /// Event: the farm has forgotten the job.
    pub(crate) fn on_cancelled(&mut self) {
        if let Stage::Cancelling { .. } = self.stage {
            self.end_as_cancelled();
        }
    }

    /// Event: what is being done has failed.
    pub(crate) fn on_trouble(&mut self, trouble: Trouble, now: Instant) {
        match (&self.stage, trouble) {
            (Stage::Cancelling { .. }, _) => self.end_as_cancelled(),
            // It cannot be forgotten either.
            (
                Stage::Watching { job, .. }
                | Stage::Fetching { job, .. }
                | Stage::Reconnecting { job: Some((job, _)), .. },
                trouble @ Trouble::Forbidden(_),
            ) => {
                let (job, coordinator) = (*job, &self.coordinator);
                self.end(Err(NoPicture::Failed(format!(
                    "{trouble}; job {job} goes on: with a token, rtfarm image {job} --coordinator \
                     {coordinator} -o FILE fetches its picture"
                ))));
            }
            // The picture is not at fault: it stays where it is.
            (Stage::Fetching { job, .. }, Trouble::File(reason)) => {
                let (job, coordinator) = (*job, &self.coordinator);
                self.end(Err(NoPicture::Failed(format!(
                    "{reason}; the farm keeps the picture for a while: rtfarm image {job} \
                     --coordinator {coordinator} -o FILE fetches it"
                ))));
            }
            // The writer of a picture that was cut short; why is known.
            (Stage::Reconnecting { .. }, Trouble::File(_)) => {}
            (&Stage::Watching { job, size }, trouble) => {
                self.find_again(Some((job, size)), &trouble, now);
            }
            (&Stage::Reconnecting { job, .. }, trouble) => self.find_again(job, &trouble, now),
            (Stage::Fetching { job, finished }, trouble) => {
                self.find_again(Some((*job, finished.size)), &trouble, now);
            }
            (Stage::Submitting, trouble @ (Trouble::Lost(_) | Trouble::Gone)) => {
                self.find_again(None, &trouble, now);
            }
            (_, trouble) => self.give_up(NoPicture::Failed(trouble.to_string()), now),
        }
    }

    /// Looks for a coordinator that is gone and may have the job, unless it was gone for too long. One
    /// that keeps its jobs will have it.
    fn find_again(&mut self, job: Option<(JobId, Size)>, trouble: &Trouble, now: Instant) {
        let may_be_gone = matches!(
            trouble,
            Trouble::Connect(..) | Trouble::Lost(_) | Trouble::Late | Trouble::Gone
        );
        let until = *self.gone_since.get_or_insert(now) + self.patience;
        let again_at = now + self.pause;
        if !may_be_gone || until <= again_at {
            return self.give_up(NoPicture::Failed(trouble.to_string()), now);
        }
        self.pause = LONGEST_PAUSE.min(self.pause * 2);
        self.stage = Stage::Reconnecting { job, is_pausing: true };
        self.deadline = Some(again_at);
    }

    /// Event: time passes.
    pub(crate) fn on_tick(&mut self, now: Instant) {
        if self.deadline.is_none_or(|deadline| now < deadline) {
            return;
        }
        if let Stage::Reconnecting { job, is_pausing: true } = self.stage {
            let reconnecting = Stage::Reconnecting { job, is_pausing: false };
            let patient_until = self.gone_since.map_or(now, |since| since + self.patience);
            self.enter(reconnecting, Action::Connect, patient_until.min(now + DEADLINE));
        } else {
            self.on_trouble(Trouble::Late, now);
        }
    }

    /// Event: somebody wants this client to end.
    pub(crate) fn on_stop(&mut self, now: Instant) {
        self.give_up(NoPicture::Interrupted, now);
    }

    fn enter(&mut self, stage: Stage, action: Action, deadline: Instant) {
        self.stage = stage;
        self.deadline = Some(deadline);
        self.actions.push_back(action);
    }

    fn give_up(&mut self, failure: NoPicture, now: Instant) {
        match self.stage {
            Stage::Connecting | Stage::Submitting | Stage::Reconnecting { job: None, .. } => {
                self.end(Err(failure));
            }
            Stage::Watching { job, .. }
            | Stage::Fetching { job, .. }
            | Stage::Reconnecting { job: Some((job, _)), .. } => {
                self.cancel(job, Err(failure), now);
            }
            // What was reached is told, and the farm is already being told to forget the job.
            Stage::Cancelling { .. } | Stage::Ended => {}
        }
    }

    fn cancel(&mut self, job: JobId, end: Result<Ended, NoPicture>, now: Instant) {
        self.enter(Stage::Cancelling { end }, Action::Cancel(job), now + CANCEL_DEADLINE);
    }

    fn end_as_cancelled(&mut self) {
        if let Stage::Cancelling { end } = std::mem::replace(&mut self.stage, Stage::Ended) {
            self.end(end);
        }
    }

    fn end(&mut self, end: Result<Ended, NoPicture>) {
        self.stage = Stage::Ended;
        self.deadline = None;
        self.actions.push_back(Action::End(end));
    }
}

#[cfg(test)]
mod tests {
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
        for (mut bench, last) in [(Bench::connecting(), "Connect"), (Bench::submitting(), "Submit")]
        {
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
}
