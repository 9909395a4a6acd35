//! The workers that wait for tiles. Decisions alone: time is an argument; a worker that waits is
//! an entry here, not a task.

use std::{
    collections::{BTreeMap, BTreeSet},
    time::Instant,
};

use rtfarm_proto::WorkerId;

/// A worker's question for tiles. The shell numbers them; later ones have higher numbers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(crate) struct AskId(pub(crate) u64);

/// What a worker asks for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Ask {
    pub(crate) worker: WorkerId,
    /// The most tiles that it takes.
    pub(crate) most: usize,
    /// Until when it waits for them.
    pub(crate) until: Instant,
}

/// The questions that have no answer yet, in the order in which they came. Invariant: each has
/// one entry in each index, and a worker has one question at most.
#[derive(Debug, Default)]
pub(crate) struct Waiting {
    asks: BTreeMap<AskId, Ask>,
    by_worker: BTreeMap<WorkerId, AskId>,
    deadlines: BTreeSet<(Instant, AskId)>,
}

impl Waiting {
    /// Adds a question. Answers with an older one of the same worker, which it replaces.
    pub(crate) fn add(&mut self, id: AskId, ask: Ask) -> Option<AskId> {
        let replaced = self.by_worker.get(&ask.worker).copied();
        if let Some(older) = replaced {
            self.remove(older);
        }
        self.by_worker.insert(ask.worker, id);
        self.deadlines.insert((ask.until, id));
        self.asks.insert(id, ask);
        replaced
    }

    /// Takes a question out.
    pub(crate) fn remove(&mut self, id: AskId) -> Option<Ask> {
        let ask = self.asks.remove(&id)?;
        self.by_worker.remove(&ask.worker);
        self.deadlines.remove(&(ask.until, id));
        Some(ask)
    }

    /// The oldest question.
    pub(crate) fn first(&self) -> Option<(AskId, Ask)> {
        self.asks.first_key_value().map(|(&id, &ask)| (id, ask))
    }

    /// All questions, the oldest first.
    pub(crate) fn iter(&self) -> impl Iterator<Item = (AskId, Ask)> {
        self.asks.iter().map(|(&id, &ask)| (id, ask))
    }

    /// The question of a worker.
    pub(crate) fn of(&self, worker: WorkerId) -> Option<AskId> {
        self.by_worker.get(&worker).copied()
    }

    /// The question that waits no longer than any other, and until when.
    pub(crate) fn next_deadline(&self) -> Option<(Instant, AskId)> {
        self.deadlines.first().copied()
    }
}

#[cfg(test)]
impl Waiting {
    /// Checks every invariant, at the price of a scan.
    pub(crate) fn check(&self, is_member: impl Fn(WorkerId) -> bool) {
        assert!(self.asks.values().all(|ask| is_member(ask.worker)));
        let asks = || self.asks.iter();
        assert_eq!(self.by_worker.len(), self.asks.len());
        assert!(self.by_worker == asks().map(|(&id, ask)| (ask.worker, id)).collect());
        assert!(self.deadlines == asks().map(|(&id, ask)| (ask.until, id)).collect());
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn a_worker_has_one_question_at_most() {
        #[expect(clippy::disallowed_methods, reason = "any instant will do")]
        let start = Instant::now();
        let ask = |worker, seconds| Ask {
            worker: WorkerId(worker),
            most: 1,
            until: start + Duration::from_secs(seconds),
        };
        let mut waiting = Waiting::default();
        assert_eq!(waiting.add(AskId(1), ask(1, 9)), None);
        assert_eq!(waiting.add(AskId(2), ask(2, 5)), None);
        assert_eq!(waiting.add(AskId(3), ask(1, 7)), Some(AskId(1)));
        waiting.check(|_| true);
        assert_eq!(waiting.first(), Some((AskId(2), ask(2, 5))));
        let ids: Vec<AskId> = waiting.iter().map(|(id, _)| id).collect();
        assert_eq!(ids, [AskId(2), AskId(3)]);
        assert_eq!(waiting.next_deadline(), Some((start + Duration::from_secs(5), AskId(2))));
        assert_eq!(waiting.remove(AskId(2)), Some(ask(2, 5)));
        assert_eq!((waiting.of(WorkerId(1)), waiting.of(WorkerId(2))), (Some(AskId(3)), None));
        waiting.check(|_| true);
    }
}
