//! What a worker has begun and waits for: when each task is overdue, and when a call that failed
//! is made again. Time is an argument.

use std::{
    collections::{BTreeMap, BTreeSet, VecDeque},
    sync::Arc,
    time::{Duration, Instant},
};

use backon::{BackoffBuilder, ExponentialBuilder};
use rtfarm_core::{prepared::SceneHash, tile::TileId};
use rtfarm_proto::{LONGEST_WAIT, LeaseName};

use crate::{
    call::{Call, CallError, CallErrorKind, Delivery},
    error::WorkerError,
    job::Job,
};

/// Something that was begun and will report back once. Numbers are never given twice, so that a
/// report that comes too late is known.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(crate) struct TaskId(u64);

/// A rendering that has ended; it has no pixels if it was stopped.
pub(crate) type Rendered = (TaskId, Option<Delivery>);

/// Finished tiles are heard of no more often than this while the threads have others to render.
pub(crate) const TURN: Duration = Duration::from_millis(10);

/// What the shell is to do.
#[derive(Debug)]
pub(crate) enum Action {
    /// Make a call.
    Call(TaskId, Call),
    /// Bring the scene of a job into memory, of which tiles are leased. No piece of it may take
    /// longer than `silence`.
    Fetch { task: TaskId, job: Arc<Job>, lease: LeaseName, silence: Duration },
    /// Render a tile of a job whose scene is in memory; those that came earlier go first.
    Render { task: TaskId, lease: LeaseName, tile: TileId, job: Arc<Job> },
    /// Stop a task. A call or a fetch does not report any more; a rendering does so soon.
    Stop(TaskId),
    /// Forget a scene: no tile of it will be begun.
    ForgetScene(SceneHash),
    /// Listen for signs of progress from now on, no more than one a period.
    HearBeats { period: Duration },
    /// End; nothing comes after this.
    Exit(Result<(), WorkerError>),
}

/// The delays between the attempts of one call.
type Backoff = <ExponentialBuilder as BackoffBuilder>::Backoff;

/// A call, and what is left to try.
#[derive(Debug)]
struct Attempts {
    call: Call,
    /// When it was last made.
    asked_at: Instant,
    backoff: Backoff,
}

#[derive(Debug)]
enum Task {
    /// Waits for its answer until `deadline`.
    Asked {
        attempts: Attempts,
        deadline: Instant,
    },
    /// Failed, and waits for its timer to be asked again.
    Failed(Attempts),
    Fetch,
    Render(LeaseName),
}

/// All that is under way, and what is still to be told to the shell.
/// Invariant: each call has one timer, for its deadline or its next attempt; nothing else has.
#[derive(Debug)]
pub(crate) struct Tasks {
    patience: Duration,
    /// When the first call was made that failed for want of an answer, if none was answered since.
    silent_since: Option<Instant>,
    /// When a call was last answered.
    answered_at: Option<Instant>,
    seed: u64,
    begun: BTreeMap<TaskId, Task>,
    begun_count: u64,
    timers: BTreeSet<(Instant, TaskId)>,
    actions: VecDeque<Action>,
}

/// A call that will not be repeated.
#[derive(Debug)]
pub(crate) struct GivenUp {
    pub(crate) call: Call,
    pub(crate) error: CallError,
}

impl Tasks {
    /// Nothing is under way. Calls that fail for want of an answer are repeated with growing
    /// delays, which `seed` shuffles, until these would add up to more than `patience`, or the
    /// first of them that has had no answer since the last to any call was made so long ago.
    pub(crate) fn new(patience: Duration, seed: u64) -> Self {
        Self {
            patience,
            silent_since: None,
            answered_at: None,
            seed,
            begun: BTreeMap::new(),
            begun_count: 0,
            timers: BTreeSet::new(),
            actions: VecDeque::new(),
        }
    }

    pub(crate) fn next_action(&mut self) -> Option<Action> {
        self.actions.pop_front()
    }

    pub(crate) fn push(&mut self, action: Action) {
        self.actions.push_back(action);
    }

    /// When the first call is overdue or is to be repeated.
    pub(crate) fn wake_at(&self) -> Option<Instant> {
        self.timers.first().map(|&(at, _)| at)
    }

    /// Begins a call.
    pub(crate) fn call(&mut self, call: Call, now: Instant) {
        let backoff = ExponentialBuilder::new()
            .with_jitter()
            .with_jitter_seed(self.seed ^ self.begun_count)
            .with_min_delay(Duration::from_millis(50))
            .with_max_delay(Duration::from_secs(2))
            .with_total_delay(Some(self.patience))
            .without_max_times()
            .build();
        self.ask(Attempts { call, asked_at: now, backoff }, now);
    }

    fn ask(&mut self, mut attempts: Attempts, now: Instant) {
        attempts.asked_at = now;
        let end = self.give_up_at().unwrap_or(now + self.patience);
        let deadline = end.min(now + attempts.call.deadline());
        self.actions.push_back(Action::Call(TaskId(self.begun_count), attempts.call.clone()));
        let task = self.begin(Task::Asked { attempts, deadline });
        self.timers.insert((deadline, task));
    }

    /// The longest that a coordinator may be asked to think about an answer, so that one is not
    /// taken for gone.
    pub(crate) fn longest_wait(&self) -> Duration {
        LONGEST_WAIT.min(self.patience / 2)
    }

    /// When nothing is waited for any more unless there is an answer.
    fn give_up_at(&self) -> Option<Instant> {
        self.silent_since.map(|since| since + self.patience)
    }

    /// Begins to bring a scene into memory.
    pub(crate) fn fetch(&mut self, job: Arc<Job>, lease: LeaseName, silence: Duration) {
        let task = self.begin(Task::Fetch);
        self.actions.push_back(Action::Fetch { task, job, lease, silence });
    }

    /// Begins to render a tile.
    pub(crate) fn render(&mut self, lease: LeaseName, tile: TileId, job: Arc<Job>) {
        let task = self.begin(Task::Render(lease));
        self.actions.push_back(Action::Render { task, lease, tile, job });
    }

    fn begin(&mut self, begun: Task) -> TaskId {
        let task = TaskId(self.begun_count);
        self.begun_count += 1;
        self.begun.insert(task, begun);
        task
    }

    /// Event: a call was answered. `None` when nobody waits for it.
    pub(crate) fn on_answer(&mut self, task: TaskId, now: Instant) -> Option<Call> {
        let attempts = self.take_asked(task)?;
        (self.silent_since, self.answered_at) = (None, Some(now));
        Some(attempts.call)
    }

    fn take_asked(&mut self, task: TaskId) -> Option<Attempts> {
        match self.begun.remove(&task)? {
            Task::Asked { attempts, deadline } => {
                self.timers.remove(&(deadline, task));
                Some(attempts)
            }
            other => {
                self.begun.insert(task, other);
                None
            }
        }
    }

    /// Event: a fetch or a rendering has ended. Whether anybody waits for it.
    pub(crate) fn on_end(&mut self, task: TaskId) -> bool {
        let is_awaited = matches!(self.begun.get(&task), Some(Task::Fetch | Task::Render(_)));
        is_awaited && self.begun.remove(&task).is_some()
    }

    /// Event: a call has failed. Answers with it when it will not be repeated.
    pub(crate) fn on_call_failed(
        &mut self,
        task: TaskId,
        error: CallError,
        now: Instant,
    ) -> Option<GivenUp> {
        let mut attempts = self.take_asked(task)?;
        if error.kind == CallErrorKind::NoAnswer {
            let since = self.answered_at.map_or(attempts.asked_at, |at| at.max(attempts.asked_at));
            self.silent_since.get_or_insert(since);
        }
        let give_up_at = self.give_up_at();
        let is_farewell = matches!(attempts.call, Call::Leave { .. });
        let may_repeat = !is_farewell && error.kind == CallErrorKind::NoAnswer;
        let delay =
            attempts.backoff.next().filter(|&delay| give_up_at.is_none_or(|end| now + delay < end));
        match delay.filter(|_| may_repeat) {
            Some(delay) => {
                tracing::debug!(reason = error.message, ?delay, "asking again");
                let task = self.begin(Task::Failed(attempts));
                self.timers.insert((now + delay, task));
                None
            }
            None => Some(GivenUp { call: attempts.call, error }),
        }
    }

    /// Event: time passes. Answers with a call that will not be repeated, if there is one; ask
    /// until there is none.
    pub(crate) fn on_tick(&mut self, now: Instant) -> Option<GivenUp> {
        while let Some(&(at, task)) = self.timers.first()
            && at <= now
        {
            if matches!(self.begun.get(&task), Some(Task::Asked { .. })) {
                self.actions.push_back(Action::Stop(task));
                let message = "it did not answer in time".to_owned();
                let error = CallError { kind: CallErrorKind::NoAnswer, message };
                if let Some(given_up) = self.on_call_failed(task, error, now) {
                    return Some(given_up);
                }
            } else {
                self.timers.remove(&(at, task));
                if let Some(Task::Failed(attempts)) = self.begun.remove(&task) {
                    self.ask(attempts, now);
                }
            }
        }
        None
    }

    /// Stops the renderings under a lease; they still report.
    pub(crate) fn stop_renderings(&mut self, of: LeaseName) {
        let is_of_lease = |task: &Task| matches!(task, Task::Render(lease) if *lease == of);
        let stopped = self.begun.iter().filter(|(_, task)| is_of_lease(task));
        self.actions.extend(stopped.map(|(&task, _)| Action::Stop(task)));
    }

    /// Stops everything; nobody waits for any report any more. Answers with the calls that were not
    /// answered.
    pub(crate) fn stop_all(&mut self) -> Vec<Call> {
        self.timers.clear();
        self.silent_since = None;
        let mut unanswered = Vec::new();
        for (task, stopped) in std::mem::take(&mut self.begun) {
            if !matches!(stopped, Task::Failed(_)) {
                self.actions.push_back(Action::Stop(task));
            }
            if let Task::Asked { attempts, .. } | Task::Failed(attempts) = stopped {
                unanswered.push(attempts.call);
            }
        }
        unanswered
    }
}
