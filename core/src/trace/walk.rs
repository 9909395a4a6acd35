//! The walk along a ray through a solid of few nodes, from end to end of the leaves' stretches.
//!
//! Source: the classification of Roth, "Ray Casting for Modeling Solids" (1982), with a bit for each
//! node of the tree that the ray is inside. Doubts do not count here: where they might, the walk is
//! not sure and says so. docs/proof.md says why all others tell what the plain evaluation does.

use std::ops::Range;

use super::course::{Course, Crossing};
use crate::prepared::record::{NO_NODE, SolidNodeKind, SolidNodeRecord};

/// What became of a walk.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Walked {
    /// Who was told has enough.
    Enough,
    /// All crossings of the stretch were told.
    Through,
    /// No doubt may count in what was told, but one might in what comes next.
    Unsure,
}

/// Where the ray enters or leaves a leaf.
#[derive(Debug, Clone, Copy)]
struct Event {
    t: f64,
    leaf: u32,
    enters: bool,
}

/// A node that changes in a step, and the event whose face is there.
#[derive(Debug, Clone, Copy)]
struct Change {
    node: u32,
    event: Event,
}

impl Change {
    fn new(course: &Course<'_>, event: Event) -> Self {
        Self { node: course.leaves[event.leaf as usize].node, event }
    }
}

/// The most leaves of a solid that is walked through, with two ends each.
const MOST_EVENTS: usize = SolidNodeRecord::BITS + 2;

/// Room for a walk.
#[derive(Debug)]
pub(super) struct Walk {
    /// In the order in which they come.
    events: [Event; MOST_EVENTS],
    /// The nodes that the ray is inside.
    inside: u64,
    changes: Vec<Change>,
}

impl Default for Walk {
    fn default() -> Self {
        let events = [Event { t: 0.0, leaf: 0, enters: false }; MOST_EVENTS];
        Self { events, inside: 0, changes: Vec::new() }
    }
}

impl Walk {
    /// Calls `take` for the crossings after `told` and up to `known`, in order, until it says that it
    /// has enough; `told` follows. `touched` are the leaves that may count there, in file order, of a
    /// solid of at most [`SolidNodeRecord::BITS`] nodes.
    #[inline(always)]
    pub(super) fn tell(
        &mut self,
        course: &Course<'_>,
        touched: &[u32],
        (told, known): (&mut f64, f64),
        mut take: impl FnMut(Crossing) -> bool,
    ) -> Walked {
        let Some(count) = self.collect(course, touched, [*told, known]) else {
            return Walked::Unsure;
        };
        let apart = course.apart();
        let mut next = 0;
        while next < count && self.events[next].t <= known {
            let event = self.events[next];
            let mut end = next + 1;
            while end < count && self.events[end].t == event.t {
                end += 1;
            }
            if end < count && self.events[end].t - event.t <= apart {
                return Walked::Unsure;
            }
            let crossed = match end - next {
                1 => self.turn_for(course, Change::new(course, event)),
                2 => self.turn_for_both(course, event, self.events[next + 1]),
                _ => self.turn_for_all(course, next..end),
            };
            if let Some(event) = crossed
                && event.t > *told
            {
                let crossing = course.sure_crossing(event.leaf, event.t, event.enters);
                if crossing.t >= 0.0 && take(crossing) {
                    return Walked::Enough;
                }
            }
            *told = told.max(event.t);
            next = end;
        }
        Walked::Through
    }

    /// Meets the leaves, finds what the ray is inside at the beginning, and sorts the events; how many
    /// there are. `None` if a leaf's stretch is not sure.
    #[inline(always)]
    fn collect(
        &mut self,
        course: &Course<'_>,
        touched: &[u32],
        [told, known]: [f64; 2],
    ) -> Option<usize> {
        let (from, to) = (told - course.solid.margin, known + course.solid.margin);
        self.inside = 0;
        let (mut count, mut rest) = (0, 0);
        for &number in touched {
            if number < rest {
                continue;
            }
            let leaf = &course.leaves[number as usize];
            let [enter, leave] = course.sure_stretch(leaf)?;
            if enter > to || leave < from {
                rest = course.nodes[leaf.node as usize].rest;
                continue;
            }
            if enter < from {
                self.turn(course.nodes, leaf.node);
            } else {
                self.insert(&mut count, Event { t: enter, leaf: number, enters: true });
            }
            if leave <= to {
                self.insert(&mut count, Event { t: leave, leaf: number, enters: false });
            }
        }
        Some(count)
    }

    #[inline(always)]
    fn insert(&mut self, count: &mut usize, event: Event) {
        let mut at = *count;
        while at > 0 && self.events[at - 1].t > event.t {
            self.events[at] = self.events[at - 1];
            at -= 1;
        }
        self.events[at] = event;
        *count += 1;
    }

    /// Enters or leaves a node, and those above that change with it: the last of them.
    #[inline(always)]
    fn turn(&mut self, nodes: &[SolidNodeRecord], mut node: u32) -> u32 {
        loop {
            self.inside ^= 1 << node;
            let SolidNodeRecord { siblings, needed, parent, .. } = nodes[node as usize];
            if self.inside & siblings != needed {
                return node;
            }
            node = parent;
        }
    }

    /// Enters or leaves a node because of an event; that event if the ray crosses the solid's surface
    /// with it.
    #[inline(always)]
    fn turn_for(&mut self, course: &Course<'_>, change: Change) -> Option<Event> {
        let root = course.nodes.len() as u32 - 1;
        (self.turn(course.nodes, change.node) == root).then_some(change.event)
    }

    /// The same for two events in one place, of which one or the other is at the crossing: they are
    /// one step of the operation that they both come to.
    #[inline(always)]
    fn turn_for_both(&mut self, course: &Course<'_>, a: Event, b: Event) -> Option<Event> {
        let nodes = course.nodes;
        let (mut a, mut b) = (Change::new(course, a), Change::new(course, b));
        loop {
            // `a` is the one of which all is known that may change the operation above it.
            if nodes[a.node as usize].parent > nodes[b.node as usize].parent {
                (a, b) = (b, a);
            }
            let SolidNodeRecord { siblings, needed, parent, .. } = nodes[a.node as usize];
            self.inside ^= 1 << a.node;
            if nodes[b.node as usize].parent == parent {
                self.inside ^= 1 << b.node;
                let operation = &nodes[parent as usize];
                let (changes, siblings) = if a.node < b.node {
                    ([a, b], siblings)
                } else {
                    ([b, a], nodes[b.node as usize].siblings)
                };
                let event = self.joint_change(operation, parent, siblings, &changes)?;
                return self.turn_for(course, Change { node: parent, event });
            }
            if self.inside & siblings != needed {
                return self.turn_for(course, b);
            }
            a.node = parent;
        }
    }

    /// The same for any number of events in one place.
    #[inline(never)]
    fn turn_for_all(&mut self, course: &Course<'_>, events: Range<usize>) -> Option<Event> {
        let mut changes = std::mem::take(&mut self.changes);
        changes.clear();
        changes.extend(self.events[events].iter().map(|&event| Change::new(course, event)));
        changes.sort_unstable_by_key(|change| change.node);
        let event = self.turn_changes(course, &mut changes);
        self.changes = changes;
        event
    }

    fn turn_changes(&mut self, course: &Course<'_>, changes: &mut Vec<Change>) -> Option<Event> {
        let nodes = course.nodes;
        loop {
            // Nothing below the first of their parents is going to change any more.
            let parent_of = |change: &Change| nodes[change.node as usize].parent;
            let parent = changes.iter().map(parent_of).min()?;
            let first = changes.iter().position(|change| parent_of(change) == parent)?;
            let operands = changes[first..].iter().take_while(|it| parent_of(it) == parent);
            let group = first..first + operands.count();
            for change in &changes[group.clone()] {
                self.inside ^= 1 << change.node;
            }
            if parent == NO_NODE {
                return Some(changes[first].event);
            }
            let siblings = nodes[changes[first].node as usize].siblings;
            let event = self.joint_change(
                &nodes[parent as usize],
                parent,
                siblings,
                &changes[group.clone()],
            );
            changes.splice(group, event.map(|event| Change { node: parent, event }));
        }
    }

    /// The event whose face is there if an operation changes because some of its operands did, which
    /// were turned already, in file order: that of the first that made it change. `siblings` are the
    /// other operands of the first one.
    #[inline(always)]
    fn joint_change(
        &self,
        operation: &SolidNodeRecord,
        node: u32,
        siblings: u64,
        changes: &[Change],
    ) -> Option<Event> {
        let is_inside = |node: u32| self.inside >> node & 1 == 1;
        let operands = siblings | 1 << changes[0].node;
        let enters = match operation.kind {
            SolidNodeKind::UNION => self.inside & operands != 0,
            SolidNodeKind::INTERSECTION => self.inside & operands == operands,
            _ => self.inside & operands == 1 << operation.first_child,
        };
        if enters == is_inside(node) {
            return None;
        }
        let is_wanted = |change: &&Change| {
            let is_taken =
                operation.kind == SolidNodeKind::DIFFERENCE && change.node != operation.first_child;
            is_inside(change.node) == (enters ^ is_taken)
        };
        changes.iter().find(is_wanted).map(|change| change.event)
    }
}
