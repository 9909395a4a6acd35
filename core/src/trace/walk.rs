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
        let root = course.nodes.len() as u32 - 1;
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
            let crossed = if end == next + 1 {
                let node = course.leaves[event.leaf as usize].node;
                (self.turn(course.nodes, node) == root).then_some(event)
            } else {
                self.step(course, next..end)
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
        let (from, to) = (told - 2.0 * course.apart(), known + 2.0 * course.apart());
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

    /// The same for events in one place: they are one step of each operation that they come to. The
    /// face is that of the first operand that made the operation change.
    #[inline(never)]
    fn step(&mut self, course: &Course<'_>, events: Range<usize>) -> Option<Event> {
        let Self { events: all, inside, changes } = self;
        changes.clear();
        for &event in &all[events] {
            let node = course.leaves[event.leaf as usize].node;
            let at = changes.partition_point(|change| change.node < node);
            changes.insert(at, Change { node, event });
        }
        loop {
            // Nothing below the first of their parents is going to change any more.
            let parent_of = |change: &Change| course.nodes[change.node as usize].parent;
            let parent = changes.iter().map(parent_of).min()?;
            let first = changes.iter().position(|change| parent_of(change) == parent)?;
            let Change { node, event } = changes[first];
            let SolidNodeRecord { siblings, needed, .. } = course.nodes[node as usize];
            *inside ^= 1 << node;
            if parent == NO_NODE {
                return Some(event);
            }
            let operands = changes[first..].iter().take_while(|it| parent_of(it) == parent);
            let end = first + operands.count();
            let (event, changes_parent) = if end == first + 1 {
                (event, *inside & siblings == needed)
            } else {
                let operation = &course.nodes[parent as usize];
                let others = changes[first + 1..end].iter();
                *inside = others.fold(*inside, |inside, change| inside ^ 1 << change.node);
                let is_inside = |node: u32| *inside >> node & 1 == 1;
                let operands = siblings | 1 << node;
                let enters = match operation.kind {
                    SolidNodeKind::UNION => *inside & operands != 0,
                    SolidNodeKind::INTERSECTION => *inside & operands == operands,
                    _ => *inside & operands == 1 << operation.first_child,
                };
                let is_wanted = |change: &&Change| {
                    let is_taken = operation.kind == SolidNodeKind::DIFFERENCE
                        && change.node != operation.first_child;
                    is_inside(change.node) == (enters ^ is_taken)
                };
                let chosen = changes[first..end].iter().find(is_wanted);
                (chosen.map_or(event, |it| it.event), enters != is_inside(parent))
            };
            if changes_parent {
                changes[first] = Change { node: parent, event };
                changes.drain(first + 1..end);
            } else {
                changes.drain(first..end);
            }
        }
    }
}
