//! The walk along a ray through a solid of few nodes, from end to end of the leaves' stretches.
//!
//! Source: the classification of Roth, "Ray Casting for Modeling Solids" (1982), with a bit for
//! each node of the tree that the ray is inside. Doubts do not count here: where they might, the
//! walk is not sure and says so. docs/proof.md says why all others tell what the plain evaluation
//! does.

use super::{
    boxes::BoxKernel,
    course::{Course, Crossing},
};
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

/// The most leaves that are walked through: an end of each has a bit in 64.
const MOST_LEAVES: usize = 32;

/// Room for a walk.
#[derive(Debug)]
pub(super) struct Walk {
    /// The leaves that are met, in file order.
    leaves: [u8; MOST_LEAVES],
    /// Where the ray enters and where it leaves each of them, two leaves a row: infinite where that
    /// does not count, and once it is behind. They are not sorted: most walks end after a few
    /// steps.
    ends: [[f64; 4]; MOST_LEAVES / 2],
    /// The nodes that the ray is inside.
    inside: u64,
    changes: Vec<Change>,
}

impl Default for Walk {
    fn default() -> Self {
        let ends = [[f64::INFINITY; 4]; MOST_LEAVES / 2];
        Self { leaves: [0; MOST_LEAVES], ends, inside: 0, changes: Vec::new() }
    }
}

impl Walk {
    /// Calls `take` for the crossings after `told` and up to `reach`, in order, until it says that
    /// it has enough; `told` follows. `touched` are the leaves that may count, a bit each, of a
    /// solid of at most [`SolidNodeRecord::BITS`] nodes; it is not sure of more than
    /// [`MOST_LEAVES`].
    #[inline(always)]
    pub(super) fn tell(
        &mut self,
        kernel: impl BoxKernel,
        course: &Course<'_>,
        touched: u64,
        (told, reach): (&mut f64, f64),
        mut take: impl FnMut(Crossing) -> bool,
    ) -> Walked {
        let Some(count) = self.collect(kernel, course, touched, [*told, reach]) else {
            return Walked::Unsure;
        };
        let rows = count.div_ceil(2);
        let apart = course.apart();
        let (_, mut t) = self.take_out(kernel, rows, f64::NAN);
        while t <= reach && t < f64::INFINITY {
            let (ends, next) = self.take_out(kernel, rows, t);
            if next - t <= apart {
                return Walked::Unsure;
            }
            let first = self.event(ends.trailing_zeros());
            let others = ends & (ends - 1);
            let crossed = if others == 0 {
                self.turn_for(course, Change::new(course, first))
            } else if others.is_power_of_two() {
                let second = self.event(others.trailing_zeros());
                self.turn_for_both(course, first, second)
            } else {
                self.turn_for_all(course, ends)
            };
            if let Some(event) = crossed
                && t > *told
            {
                let crossing = course.sure_crossing(kernel, event.leaf, (t, event.enters));
                if crossing.t >= 0.0 && take(crossing) {
                    return Walked::Enough;
                }
            }
            *told = told.max(t);
            t = next;
        }
        Walked::Through
    }

    /// Takes the ends at `t` out: a bit for each of them, and the first of the others.
    #[inline(always)]
    fn take_out(&mut self, kernel: impl BoxKernel, rows: usize, t: f64) -> (u64, f64) {
        let mut least = [f64::INFINITY; 4];
        let mut taken = 0;
        for (row, ends) in self.ends[..rows].iter_mut().enumerate() {
            let ends = kernel.take_out(ends, t, &mut least);
            taken |= u64::from(ends) << (4 * row);
        }
        let less = |a: f64, b: f64| if a < b { a } else { b };
        let [a, b, c, d] = least;
        (taken, less(less(a, b), less(c, d)))
    }

    /// An end, by its bit.
    #[inline(always)]
    fn event(&self, end: u32) -> Event {
        let leaf = self.leaves[end as usize / 2].into();
        Event { leaf, enters: end.is_multiple_of(2) }
    }

    /// Meets the leaves and finds what the ray is inside at the beginning; how many there are.
    /// `None` if a leaf's stretch is not sure.
    #[inline(always)]
    fn collect(
        &mut self,
        kernel: impl BoxKernel,
        course: &Course<'_>,
        mut touched: u64,
        [told, reach]: [f64; 2],
    ) -> Option<usize> {
        if touched.count_ones() as usize > MOST_LEAVES {
            return None;
        }
        let (from, to) = (told - course.solid.margin, reach + course.solid.margin);
        self.inside = 0;
        let mut count = 0;
        while touched != 0 {
            let number = touched.trailing_zeros();
            touched &= touched - 1;
            let leaf = &course.leaves[number as usize];
            let [enter, leave] = course.sure_stretch(kernel, leaf)?;
            if enter > to || leave < from {
                // The leaves before the rest make no difference any more.
                let rest = course.nodes[leaf.node as usize].rest;
                touched &= u64::MAX.checked_shl(rest).unwrap_or(0);
                continue;
            }
            let mut ends = [f64::INFINITY; 2];
            if enter < from {
                self.turn(course.nodes, leaf.node);
            } else {
                ends[0] = enter;
            }
            if leave <= to {
                ends[1] = leave;
            }
            self.leaves[count] = number as u8;
            let (row, side) = (&mut self.ends[count / 2], count % 2 * 2);
            row[side..side + 2].copy_from_slice(&ends);
            count += 1;
        }
        if count % 2 == 1 {
            self.ends[count / 2][2..].fill(f64::INFINITY);
        }
        Some(count)
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

    /// Enters or leaves a node because of an event; that event if the ray crosses the solid's
    /// surface with it.
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
    fn turn_for_all(&mut self, course: &Course<'_>, mut ends: u64) -> Option<Event> {
        let mut changes = std::mem::take(&mut self.changes);
        changes.clear();
        while ends != 0 {
            changes.push(Change::new(course, self.event(ends.trailing_zeros())));
            ends &= ends - 1;
        }
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

    /// The event whose face is there if an operation changes because some of its operands did,
    /// which were turned already, in file order: that of the first that made it change. `siblings`
    /// are the other operands of the first one.
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
