//! A client's side of one job: it submits a scene, watches the job, fetches the picture and has the
//! farm forget the job; a detached one ends when it knows its job. Decisions alone: what happens
//! comes in as events with the time, what is to be done goes out as [`Action`]s, and nothing here
//! waits.

use std::{
    collections::VecDeque,
    fmt,
    time::{Duration, Instant},
};

use rtfarm_core::{render::Tally, tile::Size};
use rtfarm_proto::{Address, JobId};

/// What the shell is to do. All but [`Action::TellReport`], [`Action::Show`] and the warnings end
/// what was being done before.
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

    /// Looks for a coordinator that is gone and may have the job, unless it was gone for too long.
    /// One that keeps its jobs will have it.
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
mod tests;
