//! Constructive solids: where a ray enters and leaves one.
//!
//! Source: Roth, "Ray Casting for Modeling Solids" (1982). The ends of the stretches that a ray has
//! inside the operands of an operation are sorted; walking along them, the operation knows whether
//! the ray is inside its result, and where that changes are the ends of the result's stretches.
//!
//! Only leaves whose boxes the ray touches are met, nearer ones first and no more than the answer
//! needs. Of the tree only the operations that join two such leaves are looked at, found by jumps,
//! so neither the number of leaves nor the depth of nesting costs time, and nothing recurses.
//! docs/proof.md says why what is passed over changes no bit.

use super::{
    box_ray::BoxRay,
    boxes::BoxKernel,
    course::{Course, Crossing, End, Pin},
    ray::Ray,
    solid_lanes::SolidLanes,
    walk::{Walk, Walked},
};
use crate::prepared::{
    layout::View,
    node::Child,
    record::{NO_NODE, SolidNodeKind, SolidNodeRecord, SolidRecord, Surface},
};

/// The leaves of a solid that has no more than these are all met.
const FEW_LEAVES: usize = 3;

/// Leaves that are collected before the first look at what they make.
const FIRST_LOOK: usize = 12;

/// The stretches inside a part of the tree, in order: a run of [`Scratch::ends`].
#[derive(Debug, Clone, Copy)]
struct Stretches {
    /// Their node.
    node: u32,
    /// The nearest operation above it and above the stretches that stand before it, or [`NO_NODE`].
    join: u32,
    /// The run begins here and goes on to the next one's.
    first: usize,
}

/// Room to work in, kept from ray to ray.
#[derive(Debug, Default)]
pub(super) struct Scratch {
    /// Nodes of the hierarchy that wait, and how far away they begin.
    waiting: Vec<(f32, Child)>,
    /// The leaves that the ray touches, in file order.
    touched: Vec<u32>,
    /// What waits to be joined, and its ends.
    parts: Vec<Stretches>,
    ends: Vec<End>,
    /// How much of the ray was in doubt, all in all.
    doubted: f64,
    walk: Walk,
    /// Made when first a group comes to a solid.
    lanes: Option<Box<SolidLanes>>,
}

impl Scratch {
    /// Room for the rays of a group.
    pub(super) fn lanes(&mut self) -> &mut SolidLanes {
        self.lanes.get_or_insert_default()
    }

    /// Calls `take` for the crossings of the solid's surface from the ray's start up to `reach`, in
    /// order, until it says that it has enough. A surface that the ray leaves is crossed at 0, and
    /// one that it ends on (`ending_on`) at the ray's own reach.
    #[inline(always)]
    pub(super) fn cross(
        &mut self,
        (view, solid): (&View<'_>, &SolidRecord),
        kernel: impl BoxKernel,
        (ray, box_ray): (&Ray, &BoxRay),
        ending_on: &[Surface],
        reach: f64,
        mut take: impl FnMut(Crossing) -> bool,
    ) {
        let course = Course::new(view, solid, ray, ending_on);
        let reach = reach - course.start;
        let margin = solid.margin;
        let leaf_count = course.leaves.len();
        let has_few = leaf_count <= FEW_LEAVES;
        let box_ray = if has_few {
            BoxRay::NOWHERE
        } else {
            let stretch = [-course.start - 2.0 * margin, reach + 2.0 * margin];
            box_ray.in_frame(course.near.origin, stretch, &solid.frame)
        };
        // What comes up to here was told, or does not count.
        let mut told = -course.start - margin;
        if course.nodes.len() > SolidNodeRecord::BITS || !ending_on.is_empty() {
            self.waiting.clear();
            self.touched.clear();
            if has_few {
                self.touched.extend(0..leaf_count as u32);
            } else {
                self.waiting.push((f32::NEG_INFINITY, Child::inner(solid.first_box as usize)));
            }
            return self.join_in_looks(&course, kernel, &box_ray, (told, reach), &mut take);
        }
        let touched = if has_few {
            (1 << leaf_count) - 1
        } else {
            touch_few_leaves(&course, kernel, &box_ray)
        };
        if touched == 0 {
            return;
        }
        let walked = self.walk.tell(kernel, &course, touched, (&mut told, reach), &mut take);
        if walked == Walked::Unsure {
            self.touched.clear();
            self.touched.extend((0..leaf_count as u32).filter(|leaf| touched >> leaf & 1 == 1));
            self.join_and_tell(&course, told, (&mut { reach }, reach), &mut take);
        }
    }

    /// Tells of the crossings after `told` and up to `reach` in looks that each take in more
    /// leaves.
    #[inline(always)]
    fn join_in_looks(
        &mut self,
        course: &Course<'_>,
        kernel: impl BoxKernel,
        box_ray: &BoxRay,
        (mut told, reach): (f64, f64),
        take: &mut dyn FnMut(Crossing) -> bool,
    ) {
        let mut enough = FIRST_LOOK;
        loop {
            let mut known = reach;
            if let Some(near) = self.touch_leaves(course.view, kernel, box_ray, enough) {
                known = (box_ray.distance(near) - 3.0 * course.solid.margin).min(reach);
            }
            if self.touched.is_empty() {
                return;
            }
            if !self.touched.is_sorted() {
                self.touched.sort_unstable();
            }
            let has_enough = self.join_and_tell(course, told, (&mut known, reach), take);
            if has_enough || self.waiting.is_empty() {
                return;
            }
            told = told.max(known);
            enough *= 2;
        }
    }

    /// Joins the stretches inside the leaves that are touched, or inside all leaves where a doubt
    /// might reach those that were passed over, and tells of the crossings after `told` and up to
    /// `known`, which then is the reach; whether that is enough.
    #[inline(never)]
    fn join_and_tell(
        &mut self,
        course: &Course<'_>,
        told: f64,
        (known, reach): (&mut f64, f64),
        take: &mut dyn FnMut(Crossing) -> bool,
    ) -> bool {
        self.join_touched(course);
        if self.doubted > course.solid.margin / 2.0 {
            self.touched.clear();
            self.touched.extend(0..course.leaves.len() as u32);
            self.waiting.clear();
            self.join_touched(course);
            *known = reach;
        }
        let ends = self.ends.iter().filter(|end| told < end.t && end.t <= *known);
        let mut crossings = ends.map(|end| course.crossing(end)).filter(|it| it.t >= 0.0);
        crossings.any(take)
    }

    /// Adds leaves that the ray touches, until there are `enough`; where the first of the others
    /// may begin, if there are more.
    #[inline(always)]
    fn touch_leaves(
        &mut self,
        view: &View<'_>,
        kernel: impl BoxKernel,
        box_ray: &BoxRay,
        enough: usize,
    ) -> Option<f32> {
        while self.touched.len() < enough
            && let Some((_, child)) = self.waiting.pop()
        {
            let node = &view.solid_boxes[child.node()];
            let (distances, mut mask) = kernel.test(node, box_ray);
            let first = self.waiting.len();
            while mask != 0 {
                let child = mask.trailing_zeros() as usize & 7;
                mask &= mask - 1;
                let (near, child) = (distances[child], node.children[child]);
                if child.is_leaf() {
                    self.touched.push(child.items().start as u32);
                } else {
                    // The nearest comes to stand on top.
                    let is_farther = |&(other, _): &(f32, Child)| other >= near;
                    let at = first + self.waiting[first..].partition_point(is_farther);
                    self.waiting.insert(at, (near, child));
                }
            }
        }
        self.waiting.iter().map(|&(near, _)| near).reduce(f32::min)
    }

    /// Joins the stretches inside the leaves that are touched as the tree says; `ends` has the
    /// result.
    fn join_touched(&mut self, course: &Course<'_>) {
        self.parts.clear();
        self.ends.clear();
        self.doubted = 0.0;
        let node_of = |leaf: u32| course.leaves[leaf as usize].node;
        // The leaves before this one make no difference any more.
        let mut rest = 0;
        // Where the next leaf meets the last part, if that is known.
        let mut next_join: Option<u32> = None;
        for at in 0..self.touched.len() {
            let number = self.touched[at];
            if number < rest {
                continue;
            }
            let node = node_of(number);
            let record = &course.nodes[node as usize];
            // What is whole before the leaf is joined; where the leaf meets what is left.
            let mut join = NO_NODE;
            while let Some(last) = self.parts.last() {
                join = next_join.take().unwrap_or_else(|| course.join(last.node, node));
                if last.join >= join {
                    break;
                }
                self.join_last(course, &mut rest);
                join = NO_NODE;
            }
            if number < rest {
                continue;
            }
            // It is alone up to there, or to where it meets what comes next.
            let next = self.touched.get(at + 1).map(|&next| course.join(node, node_of(next)));
            let is_lost = record.dies_at < join.min(next.unwrap_or(NO_NODE));
            let ends = if is_lost { None } else { course.meet_leaf(number) };
            if let Some(ends) = ends {
                self.parts.push(Stretches { node, join, first: self.ends.len() });
                self.ends.extend_from_slice(&ends);
                next_join = next;
            } else {
                rest = record.rest;
            }
        }
        while self.parts.len() > 1 {
            self.join_last(course, &mut rest);
        }
        let is_lost = |last: &Stretches| course.nodes[last.node as usize].dies_at != NO_NODE;
        if self.parts.first().is_some_and(is_lost) {
            self.ends.clear();
        }
    }

    /// Joins the last parts at the operation that they have in common. If nothing is left of it,
    /// leaves before `rest` make no difference any more.
    fn join_last(&mut self, course: &Course<'_>, rest: &mut u32) {
        let node = self.parts.last().expect("parts to join").join;
        let first = self.parts.iter().rposition(|part| part.join != node).expect("a first operand");
        let Stretches { join, first: first_end, .. } = self.parts[first];
        let record = &course.nodes[node as usize];
        if let Some(count) = self.join_two(course, record, first) {
            self.parts.truncate(first);
            self.keep(Stretches { node, join, first: first_end }, count, record, rest);
            return;
        }
        let (mut operands, mut end_count) = (0, first_end);
        let mut has_first = false;
        for at in first..self.parts.len() {
            let part = self.parts[at];
            if course.nodes[part.node as usize].dies_at < node {
                continue;
            }
            // Up to it stand the nodes of the first operand.
            has_first |= part.node <= record.first_child;
            let end = self.parts.get(at + 1).map_or(self.ends.len(), |next| next.first);
            if part.first > end_count {
                self.ends.copy_within(part.first..end, end_count);
            }
            let moved = end_count..end_count + (end - part.first);
            end_count = moved.end;
            for end in &mut self.ends[moved] {
                end.operand = operands;
            }
            operands += 1;
        }
        self.parts.truncate(first);
        self.ends.truncate(end_count);
        let is_left = match record.kind {
            SolidNodeKind::UNION => true,
            SolidNodeKind::INTERSECTION => operands == record.operands,
            _ => has_first,
        };
        let count = if is_left { self.join_ends(record, first_end) } else { 0 };
        self.keep(Stretches { node, join, first: first_end }, count, record, rest);
    }

    /// Keeps so many ends as the stretches of an operation, the last part; if there are none,
    /// leaves before `rest` make no difference any more.
    #[inline(always)]
    fn keep(&mut self, part: Stretches, count: usize, record: &SolidNodeRecord, rest: &mut u32) {
        self.ends.truncate(part.first + count);
        if count > 0 {
            self.parts.push(part);
        } else {
            *rest = (*rest).max(record.rest);
        }
    }

    /// The same as [`Self::join_ends`] in closed form, for an operation on two operands, the parts
    /// from `first` on, that have one stretch each. `None` if it is not that, or if rounding cannot
    /// tell ends apart.
    #[inline(always)]
    fn join_two(
        &mut self,
        course: &Course<'_>,
        operation: &SolidNodeRecord,
        first: usize,
    ) -> Option<usize> {
        let [a, b] = self.parts[first..] else { return None };
        let ends: &mut [End; 4] = (&mut self.ends[a.first..]).try_into().ok()?;
        let lives = |part: Stretches| course.nodes[part.node as usize].dies_at >= b.join;
        if b.first != a.first + 2 || !lives(a) || !lives(b) {
            return None;
        }
        let before = |j: usize, k: usize| ends[j].high < ends[k].low;
        let (a_begins, a_goes_on) = (before(0, 2), before(3, 1));
        let (a_is_past, b_is_past) = (before(1, 2), before(3, 0));
        let are_apart = (a_begins || before(2, 0))
            && (a_goes_on || before(1, 3))
            && (a_is_past || before(2, 1))
            && (b_is_past || before(0, 3));
        if !are_apart {
            return None;
        }
        let doubted: f64 = ends.iter().map(|end| end.high - end.low).sum();
        let meet = !(a_is_past || b_is_past);
        let count = match operation.kind {
            SolidNodeKind::UNION => {
                if b_is_past {
                    ends.rotate_left(2);
                } else if meet {
                    if !a_begins {
                        ends[0] = ends[2];
                    }
                    if !a_goes_on {
                        ends[1] = ends[3];
                    }
                }
                if meet { 2 } else { 4 }
            }
            SolidNodeKind::INTERSECTION => {
                if operation.operands > 2 {
                    return None;
                }
                if a_begins {
                    ends[0] = ends[2];
                }
                if a_goes_on {
                    ends[1] = ends[3];
                }
                if meet { 2 } else { 0 }
            }
            _ => {
                if a.node > operation.first_child {
                    return None;
                }
                ends[2].enters = false;
                ends[3].enters = true;
                match (meet, a_begins, a_goes_on) {
                    (false, ..) => 2,
                    (true, true, true) => {
                        ends[1..].rotate_left(1);
                        4
                    }
                    (true, true, false) => {
                        ends[1] = ends[2];
                        2
                    }
                    (true, false, true) => {
                        ends[0] = ends[3];
                        2
                    }
                    (true, false, false) => 0,
                }
            }
        };
        self.doubted += doubted;
        Some(count)
    }

    /// Puts the ends of an operation's stretches in the place of its operands' ends, which are the
    /// last ones; how many there are. Ends that rounding cannot tell apart are one step: where the
    /// ray is inside before and after it the operation has no surface.
    fn join_ends(&mut self, operation: &SolidNodeRecord, first: usize) -> usize {
        let ends = &mut self.ends[first..];
        sort(ends);
        let takes_away = operation.kind == SolidNodeKind::DIFFERENCE;
        let is_intersection = operation.kind == SolidNodeKind::INTERSECTION;
        let needed = if is_intersection { operation.operands.cast_signed() } else { 1 };
        // The ray is inside where it is in so many operands; one that is taken away counts against.
        let mut depth = 0;
        let (mut next, mut count) = (0, 0);
        while next < ends.len() {
            let (from, before) = (next, depth >= needed);
            let mut high = ends[from].high;
            loop {
                let end = &ends[next];
                let adds = end.enters ^ (takes_away && end.operand > 0);
                depth += if adds { 1 } else { -1 };
                high = high.max(end.high);
                next += 1;
                if ends.get(next).is_none_or(|end| end.low > high) {
                    break;
                }
            }
            self.doubted += high - ends[from].low;
            let enters = depth >= needed;
            if before != enters {
                let wanted = |end: &End| enters ^ (takes_away && end.operand > 0);
                ends[count] = step(&mut ends[from..next], enters, wanted);
                count += 1;
            }
        }
        count
    }
}

/// The leaves whose boxes the ray touches, a bit each, of a solid of at most
/// [`SolidNodeRecord::BITS`] nodes. Its hierarchy has fewer than that, too.
#[inline(always)]
fn touch_few_leaves(course: &Course<'_>, kernel: impl BoxKernel, box_ray: &BoxRay) -> u64 {
    let bit = |index: usize| 1_u64.checked_shl(index as u32).unwrap_or(0);
    let first = course.solid.first_box as usize;
    let (mut touched, mut waiting) = (0, 1_u64);
    while waiting != 0 {
        let node = &course.view.solid_boxes[first + waiting.trailing_zeros() as usize];
        waiting &= waiting - 1;
        let (_, mut mask) = kernel.test(node, box_ray);
        while mask != 0 {
            let child = node.children[mask.trailing_zeros() as usize & 7];
            mask &= mask - 1;
            if child.is_leaf() {
                touched |= bit(child.items().start);
            } else {
                waiting |= bit(child.node() - first);
            }
        }
    }
    touched
}

/// Sorts ends by where they begin. Few are many times faster sorted so; many are rare.
fn sort(ends: &mut [End]) {
    if ends.len() > 32 {
        return ends.sort_by(|a, b| a.low.total_cmp(&b.low));
    }
    for k in 1..ends.len() {
        let end = ends[k];
        let mut at = k;
        while at > 0 && ends[at - 1].low > end.low {
            ends[at] = ends[at - 1];
            at -= 1;
        }
        ends[at] = end;
    }
}

/// The end of an operation's stretch at a step of its operands: the face is that of the first
/// operand in file order that made it change, by entering or leaving as is `wanted` of it.
#[inline(always)]
fn step(step: &mut [End], enters: bool, wanted: impl Fn(&End) -> bool) -> End {
    if let [end] = step { End { enters, ..*end } } else { long_step(step, enters, wanted) }
}

/// The same for more than one end.
#[inline(never)]
fn long_step(step: &mut [End], enters: bool, wanted: impl Fn(&End) -> bool) -> End {
    let pinned = (step.iter().find(|end| end.pin == Pin::Start))
        .or_else(|| step.iter().find(|end| end.pin == Pin::Goal))
        .copied();
    step.sort_by_key(|end| end.operand);
    // An operand that the ray enters and leaves within the step does not change in it.
    let mut operands = step.chunk_by(|a, b| a.operand == b.operand);
    let changed = operands.find(|ends| ends.len() % 2 == 1 && ends[0].enters == wanted(&ends[0]));
    let end = changed.expect("an operation changes only if an operand does")[0];
    // What cannot be told from the ray's start or its end is there.
    let End { t, low, high, pin, .. } = pinned.unwrap_or(end);
    End { t, low, high, enters, pin, ..end }
}

#[cfg(test)]
mod tests;
