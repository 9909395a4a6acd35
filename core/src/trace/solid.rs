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
mod tests {
    use glam::DVec3;
    use rtfarm_oracle::{
        hard_case::{few_rays, random},
        random::Random,
    };

    use super::*;
    use crate::{
        isa::Isa,
        prepare::prepare,
        prepared::{PreparedBytes, PreparedScene, face::Part},
        scene::{Material, Operation, Parallelepiped, Scene, Solid, SolidNode, Sphere, Viewport},
        trace::{
            boxes::KernelWork,
            kernels::run_with_kernel,
            lanes::{CLASSES, GROUPS, LANES, RayGroup, Turn, class_of},
            solid_rays::{MOST_LEAVES, SolidRays},
        },
    };

    /// The plain evaluation of every leaf and every node, whatever the ray touches.
    fn plain(course: &Course<'_>, node: u32) -> Vec<End> {
        let record = &course.nodes[node as usize];
        if record.kind == SolidNodeKind::LEAF {
            return course.meet_leaf(record.first_child).map_or(Vec::new(), Vec::from);
        }
        let children = (0..node).filter(|&child| course.nodes[child as usize].parent == node);
        let mut ends: Vec<(usize, End)> = children
            .enumerate()
            .flat_map(|(k, child)| plain(course, child).into_iter().map(move |end| (k, end)))
            .collect();
        ends.sort_by(|a, b| a.1.low.total_cmp(&b.1.low));
        let is_in = |operands: &[bool]| match record.kind {
            SolidNodeKind::UNION => operands.contains(&true),
            SolidNodeKind::INTERSECTION => !operands.contains(&false),
            _ => operands[0] && !operands[1..].contains(&true),
        };
        let mut operands = vec![false; record.operands as usize];
        let mut found = Vec::new();
        let mut next = 0;
        while next < ends.len() {
            let (from, mut high) = (next, f64::NEG_INFINITY);
            while next < ends.len() && (next == from || ends[next].1.low <= high) {
                high = high.max(ends[next].1.high);
                next += 1;
            }
            let step = &ends[from..next];
            let before = operands.clone();
            for &(k, _) in step {
                operands[k] = !operands[k];
            }
            let enters = is_in(&operands);
            if is_in(&before) == enters {
                continue;
            }
            let is_taken = |k: usize| record.kind == SolidNodeKind::DIFFERENCE && k > 0;
            let operand = (0..operands.len())
                .find(|&k| before[k] != operands[k] && operands[k] == (enters ^ is_taken(k)))
                .unwrap();
            let end = step.iter().find(|(k, _)| *k == operand).unwrap().1;
            let pinned = |pin| step.iter().map(|(_, end)| end).find(|end| end.pin == pin);
            let place = pinned(Pin::Start).or_else(|| pinned(Pin::Goal)).unwrap_or(&end);
            let End { t, low, high, pin, .. } = *place;
            found.push(End { t, low, high, enters, pin, ..end });
        }
        found
    }

    /// All crossings up to `reach` by the plain evaluation.
    fn plain_crossings(course: &Course<'_>, reach: f64) -> Vec<Crossing> {
        let ends = plain(course, course.nodes.len() as u32 - 1);
        ends.iter()
            .filter(|end| end.t <= reach - course.start)
            .map(|end| course.crossing(end))
            .filter(|crossing| crossing.t >= 0.0)
            .collect()
    }

    /// How the numbers of a solid are drawn.
    #[derive(Debug, Clone, Copy, PartialEq)]
    enum Style {
        Plain,
        /// Multiples of 1/4: shared planes and spheres, tangent faces, rays in planes.
        Grid,
        /// Far from the origin.
        Far,
        /// Sizes from 1e-4 to 1e4.
        Extreme,
    }

    fn place(random: &mut Random, style: Style) -> DVec3 {
        let place = random.in_cube();
        if style == Style::Grid { (place * 4.0).round() / 4.0 } else { place }
    }

    fn random_leaf(random: &mut Random, style: Style, scale: f64, primitive: u32) -> SolidNode {
        let shift = if style == Style::Far { DVec3::new(1e6, -2e6, 3e5) } else { DVec3::ZERO };
        let scale =
            if style == Style::Extreme { scale * random.log_uniform(1e-4, 1e4) } else { scale };
        let center = shift + place(random, style);
        let size = random.between(0.1, 1.0) * scale;
        let size = if style == Style::Grid { (size * 4.0).ceil() / 4.0 } else { size };
        if random.chance(0.5) {
            return SolidNode::Sphere(Sphere { center, radius: size, material: 0, primitive });
        }
        let mut edges = [DVec3::X, DVec3::Y, DVec3::Z].map(|axis| axis * size);
        if style != Style::Grid && random.chance(0.5) {
            edges = edges.map(|edge| edge + random.in_cube() * 0.3 * size);
        }
        let corner = center - edges.iter().sum::<DVec3>() / 2.0;
        SolidNode::Parallelepiped(Parallelepiped { corner, edges, material: 0, primitive })
    }

    /// A solid of so many leaves; a nested one is as deep as they are many.
    fn random_solid(random: &mut Random, style: Style, leaf_count: u32, is_nested: bool) -> Solid {
        let mut nodes: Vec<SolidNode> = Vec::new();
        let (mut ready, mut leaves) = (0, Vec::new());
        for primitive in 0..leaf_count {
            // The first is large: there is something to take away from. Others return.
            let scale = if primitive == 0 { 2.0 } else { 2.0 / f64::from(leaf_count).cbrt() };
            let leaf = match leaves.get(random.below(4 * leaf_count as usize)) {
                Some(&leaf) => leaf,
                None => random_leaf(random, style, scale, primitive),
            };
            leaves.push(leaf);
            nodes.push(leaf);
            ready += 1;
            // An intersection of many things is empty.
            let operations = [Operation::Union, Operation::Difference, Operation::Intersection];
            let may_intersect = leaf_count < 9 || random.chance(0.02);
            let choice = random.below(if may_intersect { 3 } else { 2 });
            if ready >= 2 && (is_nested || random.chance(0.4)) {
                let most = ready.min(4) as usize;
                let operands = if is_nested { 2 } else { 2 + random.below(most - 1) as u32 };
                nodes.push(SolidNode::Operation { operation: operations[choice], operands });
                ready -= operands - 1;
            }
        }
        if ready > 1 {
            let operation =
                if random.chance(0.5) { Operation::Union } else { Operation::Difference };
            nodes.push(SolidNode::Operation { operation, operands: ready });
        }
        Solid { nodes, primitive: 0 }
    }

    /// A scene of this solid alone.
    fn opened(solid: Solid) -> PreparedScene<PreparedBytes> {
        opened_with(solid, Vec::new())
    }

    /// A scene of this solid and some spheres.
    fn opened_with(solid: Solid, spheres: Vec<Sphere>) -> PreparedScene<PreparedBytes> {
        let viewport = Viewport {
            eye: DVec3::Z * 5.0,
            top_left: DVec3::new(-1.0, 1.0, 0.0),
            bottom_left: DVec3::new(-1.0, -1.0, 0.0),
            top_right: DVec3::new(1.0, 1.0, 0.0),
        };
        let material = Material {
            name: "m".into(),
            color: DVec3::ONE,
            alpha: 1.0,
            reflect: 0.0,
            refract: 0.0,
            texture: None,
        };
        let scene = Scene {
            viewport: Some(viewport),
            materials: vec![material],
            solids: vec![solid],
            spheres,
            ..Scene::default()
        };
        PreparedScene::open(prepare(&scene).unwrap()).unwrap()
    }

    /// A point on a leaf, on an edge or a corner too, and a direction there along the leaf.
    fn point_on(random: &mut Random, leaf: &SolidNode) -> (DVec3, DVec3) {
        match leaf {
            SolidNode::Sphere(sphere) => {
                let normal = random.direction();
                let (a, b) = normal.any_orthonormal_pair();
                let along = random.between(-1.0, 1.0) * a + random.between(-1.0, 1.0) * b;
                (sphere.center + normal * sphere.radius, along)
            }
            SolidNode::Parallelepiped(solid) => {
                let mut point = solid.corner;
                for edge in solid.edges {
                    point += edge * [0.0, 1.0, random.unit()][random.below(3)];
                }
                let [a, b, _] = solid.edges;
                (point, random.between(-1.0, 1.0) * a + random.between(-1.0, 1.0) * b)
            }
            SolidNode::Operation { .. } => (DVec3::ZERO, DVec3::X),
        }
    }

    /// A ray at a leaf, from near or far: at a point of it, along it, along an axis.
    fn random_ray(random: &mut Random, solid: &Solid, style: Style) -> (DVec3, DVec3) {
        let node = &solid.nodes[random.below(solid.nodes.len())];
        let (target, along) = point_on(random, node);
        let direction = match random.below(4) {
            0 => along,
            1 => DVec3::AXES[random.below(3)] * random.sign(),
            2 if style == Style::Grid => place(random, style) + DVec3::X,
            _ => random.direction(),
        };
        let direction = direction / direction.length();
        let direction = if direction.is_finite() { direction } else { DVec3::Y };
        let back = [0.25, 5.0, random.log_uniform(1e-6, 1e6)][random.below(3)];
        (target - back * direction, direction)
    }

    /// What a ray is told of, with the kernel of an instruction set.
    struct Told<'a> {
        solid: &'a SolidRecord,
        scratch: &'a mut Scratch,
        ray: &'a Ray,
        ending_on: &'a [Surface],
        most: usize,
        found: Vec<Crossing>,
    }

    impl KernelWork<View<'_>> for Told<'_> {
        fn run(&mut self, view: &View<'_>, kernel: impl BoxKernel) {
            let Self { solid, ray, most, .. } = *self;
            let box_ray = BoxRay::new(ray.origin, ray.direction, ray.reach, &view.header.frame);
            let rays = (ray, &box_ray);
            self.scratch.cross(
                (view, solid),
                kernel,
                rays,
                self.ending_on,
                ray.reach,
                |crossing| {
                    self.found.push(crossing);
                    self.found.len() == most
                },
            );
        }
    }

    /// The crossings of the plain evaluation, which are those that a ray is told of.
    fn check(
        view: &View<'_>,
        (isa, scratch): (Isa, &mut Scratch),
        ray: &Ray,
        ending_on: &[Surface],
        what: &str,
    ) -> Vec<Crossing> {
        let solid = &view.solids[0];
        let truth = plain_crossings(&Course::new(view, solid, ray, ending_on), ray.reach);
        let bits = |crossings: &[Crossing]| {
            crossings.iter().map(|it| (it.t.to_bits(), it.part)).collect::<Vec<_>>()
        };
        // Told to stop at one of them, it tells of no other; told of all, it has told of all.
        for most in [1, truth.len() / 2 + 1, truth.len() + 1] {
            let mut told = Told { solid, scratch, ray, ending_on, most, found: Vec::new() };
            run_with_kernel(isa, view, &mut told);
            let found = told.found;
            let expected = &truth[..most.min(truth.len())];
            assert_eq!(bits(&found), bits(expected), "{what}: {ray:?}: {found:?}, {truth:?}");
        }
        truth
    }

    /// Rays at a solid: from anywhere, on from every crossing, and towards a surface. How many
    /// crossings there were.
    fn check_solid(
        random: &mut Random,
        solid: &Solid,
        style: Style,
        count: usize,
        what: &str,
    ) -> usize {
        let prepared = opened(solid.clone());
        let view = prepared.view();
        let mut scratch = Scratch::default();
        let isas: Vec<Isa> = Isa::ALL.into_iter().filter(|isa| isa.is_supported()).collect();
        let mut crossed = 0;
        for k in 0..count {
            let mut check = |ray: &Ray, ending_on: &[Surface]| {
                let truth =
                    check(&view, (isas[k % isas.len()], &mut scratch), ray, ending_on, what);
                crossed += truth.len();
                truth
            };
            let (origin, direction) = random_ray(random, solid, style);
            let ray = Ray {
                origin: origin * view.header.scale,
                direction,
                reach: f64::INFINITY,
                leaving: Surface::NONE,
                after: Ray::NOTHING_AHEAD,
            };
            let truth = check(&ray, &[]);
            let Some(&Crossing { t, part }) = truth.get(random.below(truth.len().max(1))) else {
                continue;
            };
            let surface = part.leaf_of(&view, &view.solids[0]).surface(part.face());
            // Up to there, and up to there as to a light on the surface.
            let short = Ray { reach: t.max(f64::MIN_POSITIVE), ..ray };
            check(&short, &[]);
            check(&short, &[surface]);
            // From there, on and elsewhere, and along a leaf.
            let origin = ray.origin + t * ray.direction;
            let along = random_ray(random, solid, style).1;
            for direction in [direction, random.direction(), along] {
                check(&Ray { origin, direction, leaving: surface, ..ray }, &[]);
            }
        }
        crossed
    }

    const STYLES: [Style; 4] = [Style::Plain, Style::Grid, Style::Far, Style::Extreme];

    #[test]
    fn what_is_passed_over_changes_no_bit() {
        let mut crossed = 0;
        for seed in 0..few_rays(8_000) as u64 {
            let random = &mut random(seed);
            let style = STYLES[seed as usize % 4];
            let leaf_count = 2 + random.below(7) as u32;
            let solid = random_solid(random, style, leaf_count, seed % 5 == 0);
            crossed += check_solid(random, &solid, style, 15, &format!("{style:?} solid {seed}"));
        }
        eprintln!("{crossed} crossings of small solids");
        assert!(crossed > 100_000);
    }

    #[test]
    fn what_is_passed_over_in_large_and_deep_solids_changes_no_bit() {
        let mut crossed = 0;
        for seed in 0..few_rays(400) as u64 {
            let random = &mut random(seed);
            let style = STYLES[seed as usize % 4];
            let leaf_count = random.log_uniform(9.0, 300.0) as u32;
            let solid = random_solid(random, style, leaf_count, seed % 3 == 0);
            let what = format!("{style:?} solid of {leaf_count}, {seed}");
            crossed += check_solid(random, &solid, style, 20, &what);
        }
        eprintln!("{crossed} crossings of large solids");
        assert!(crossed > 10_000);
    }

    /// What rays of a group are told of, with the kernel of an instruction set.
    struct ToldTogether<'a> {
        solid: &'a SolidRecord,
        lanes: &'a mut SolidLanes,
        rays: &'a [Ray],
        skips_start: bool,
        most: usize,
        found: Vec<Vec<(u64, Part)>>,
        in_doubt: u64,
    }

    impl KernelWork<View<'_>> for ToldTogether<'_> {
        fn run(&mut self, view: &View<'_>, kernel: impl BoxKernel) {
            let Self { solid, rays, most, found, .. } = self;
            let turn = Turn::new(&rays[0], &view.header.frame);
            let of_lanes = std::array::from_fn(|lane| &rays[lane.min(rays.len() - 1)]);
            let mut groups = [RayGroup::EMPTY; GROUPS];
            kernel.fill(&mut groups[0], of_lanes, &turn);
            let asking = (u64::MAX >> (64 - rays.len()), self.skips_start);
            let take = |lane: usize, Crossing { t, part }| {
                found[lane].push((t.to_bits(), part));
                found[lane].len() == *most
            };
            self.in_doubt = self.lanes.cross((view, solid), kernel, (&groups, &turn), asking, take);
        }
    }

    /// All that a kernel finds of a group's rays at a solid.
    impl KernelWork<View<'_>> for (&[Ray], Vec<String>) {
        fn run(&mut self, view: &View<'_>, kernel: impl BoxKernel) {
            let (rays, found) = self;
            let solid = &view.solids[0];
            let turn = Turn::new(&rays[0], &view.header.frame);
            let mut group = RayGroup::EMPTY;
            let of_lanes = std::array::from_fn(|lane| &rays[lane.min(rays.len() - 1)]);
            kernel.fill(&mut group, of_lanes, &turn);
            let mut near = [SolidRays::EMPTY];
            let any_leaves = kernel.approach(&mut near[0], (&group, &turn), solid);
            let beam = kernel.surround_near(&near, turn.is_forward);
            found.push(format!("{near:?} {any_leaves} {beam:?}"));
            for node in view.solid_boxes {
                found.push(format!("{:b}", kernel.touch_beam(node, &beam)));
                for child in 0..8 {
                    let planes = |sides: [usize; 3]| sides.map(|side| node.planes[side][child]);
                    let planes = [planes(beam.beam.near), planes(beam.beam.far)];
                    found.push(format!("{}", kernel.touch(&near, (&[(0, u8::MAX)], 1), planes)));
                }
            }
            let mut all_ends = Vec::new();
            let apart = solid.margin / 1024.0;
            for leaf in view.solid_leaves(solid).iter().take(MOST_LEAVES) {
                let mut ends = [[0.0; LANES]; 2];
                let met = if leaf.is_sphere() {
                    kernel.meet_ball(&near[0], leaf, (any_leaves, apart), &mut ends)
                } else {
                    let planes = &view.box_planes[leaf.surface as usize];
                    kernel.meet_box(&near[0], planes, (any_leaves, apart), &mut ends)
                };
                found.push(format!("{met:?}"));
                all_ends.push(ends);
            }
            let (mut at, mut next) = (near[0].left_at, [0.0; LANES]);
            for _ in 0..3 {
                let mut inside = [0; MOST_LEAVES];
                let places = (&at, &near[0].near.reach, apart);
                let seen = kernel.look(&all_ends, places, &mut inside, &mut next);
                found.push(format!("{seen:?} {inside:?} {next:?}"));
                at = next;
            }
            found.push(format!("{all_ends:?}"));
        }
    }

    /// Rays of a class, which are told of what each is told of by the plain evaluation, if they are
    /// not in doubt: how many crossings they were told of, and how many are in doubt.
    fn check_group(
        view: &View<'_>,
        lanes: &mut SolidLanes,
        (rays, skips_start): (&[Ray], bool),
        what: &str,
    ) -> [usize; 2] {
        let solid = &view.solids[0];
        let counts = |crossing: &Crossing| !skips_start || crossing.t > 0.0;
        let truths: Vec<Vec<_>> = rays
            .iter()
            .map(|ray| {
                let truth = plain_crossings(&Course::new(view, solid, ray, &[]), ray.reach);
                truth.into_iter().filter(counts).map(|it| (it.t.to_bits(), it.part)).collect()
            })
            .collect();
        let mut told = 0;
        let mut in_doubt = 0;
        for most in [1, 2, usize::MAX] {
            let mut first = None;
            for isa in Isa::ALL.into_iter().filter(|isa| isa.is_supported()) {
                let lanes = &mut *lanes;
                let found = vec![Vec::new(); rays.len()];
                let mut work =
                    ToldTogether { solid, lanes, rays, skips_start, most, found, in_doubt: 0 };
                run_with_kernel(isa, view, &mut work);
                for (lane, (found, truth)) in work.found.iter().zip(&truths).enumerate() {
                    let truth = &truth[..most.min(truth.len())];
                    let is_in_doubt = work.in_doubt >> lane & 1 == 1;
                    assert!(
                        is_in_doubt || found == truth,
                        "{what}, {isa}: {:?}: {found:?}, {truth:?}",
                        rays[lane]
                    );
                }
                told += work.found.iter().map(Vec::len).sum::<usize>();
                in_doubt += work.in_doubt.count_ones() as usize;
                let this = (work.found, work.in_doubt);
                assert_eq!(first.get_or_insert(this.clone()), &this, "{what}, {isa}");
            }
        }
        [told, in_doubt]
    }

    #[test]
    fn rays_of_a_group_are_told_what_each_is_told_alone() {
        let [mut told, mut in_doubt, mut groups] = [0; 3];
        let mut lanes = SolidLanes::default();
        for seed in 0..few_rays(6_000) as u64 {
            let random = &mut random(seed);
            let style = STYLES[seed as usize % 4];
            let most_leaves = if seed % 8 == 0 { 40.0 } else { 9.0 };
            let leaf_count = random.log_uniform(2.0, most_leaves) as u32;
            let solid = random_solid(random, style, leaf_count, seed % 5 == 0);
            // Some solids are small in their scene: rays come from far off.
            let (place, _) = random_ray(random, &solid, style);
            let center = place + 100.0 * random.direction();
            let far = Sphere { center, radius: 1.0, material: 0, primitive: 99 };
            let spheres = if random.chance(0.3) { vec![far] } else { Vec::new() };
            let prepared = opened_with(solid.clone(), spheres);
            let view = prepared.view();
            let record = &view.solids[0];
            if view.solid_nodes(record).len() > SolidNodeRecord::BITS {
                continue;
            }
            let mut classes = vec![Vec::new(); CLASSES];
            let mut class = |ray: Ray| {
                let class = class_of(&ray, &view.header.frame) as usize;
                if let Some(rays) = classes.get_mut(class) {
                    rays.push(ray);
                }
            };
            for _ in 0..40 {
                let (origin, direction) = random_ray(random, &solid, style);
                let ray = Ray {
                    origin: origin * view.header.scale,
                    direction,
                    reach: f64::INFINITY,
                    leaving: Surface::NONE,
                    after: Ray::NOTHING_AHEAD,
                };
                class(ray);
                let truth = plain_crossings(&Course::new(&view, record, &ray, &[]), f64::INFINITY);
                let Some(&Crossing { t, part }) = truth.get(random.below(truth.len().max(1)))
                else {
                    continue;
                };
                class(Ray { reach: t.max(f64::MIN_POSITIVE), ..ray });
                let leaving = part.leaf_of(&view, record).surface(part.face());
                let origin = ray.origin + t * ray.direction;
                let along = random_ray(random, &solid, style).1;
                for direction in [direction, random.direction(), along] {
                    class(Ray { origin, direction, leaving, ..ray });
                }
            }
            for (k, rays) in classes.iter().flat_map(|rays| rays.chunks(LANES)).enumerate() {
                let what = format!("{style:?} solid {seed}");
                let found = check_group(&view, &mut lanes, (rays, k % 2 == 0), &what);
                told += found[0];
                in_doubt += found[1];
                if groups % 16 == 0 {
                    let isas = Isa::ALL.into_iter().filter(|isa| isa.is_supported());
                    let found = isas.map(|isa| {
                        let mut found = (rays, Vec::new());
                        run_with_kernel(isa, &view, &mut found);
                        found.1
                    });
                    let found: Vec<Vec<String>> = found.collect();
                    assert!(found.iter().all(|it| *it == found[0]), "{what}: {found:#?}");
                }
                groups += 1;
            }
        }
        eprintln!("{groups} groups, {told} told, {in_doubt} in doubt");
        assert!(told > 100_000 && in_doubt > 1_000 && in_doubt < told, "{told}, {in_doubt}");
    }

    #[test]
    fn a_ray_through_all_leaves_of_a_solid_with_a_bit_for_each_changes_no_bit() {
        let mut crossed = 0;
        for operands in [31, 32, 33, 63] {
            let sphere = |primitive: u32| {
                let radius = 1.0 + f64::from(primitive) / 64.0;
                SolidNode::Sphere(Sphere { center: DVec3::ZERO, radius, material: 0, primitive })
            };
            let operation = Operation::Union;
            let mut nodes: Vec<SolidNode> = (0..operands).map(sphere).collect();
            nodes.push(SolidNode::Operation { operation, operands });
            let solid = Solid { nodes, primitive: 0 };
            let what = format!("{operands} nested spheres");
            crossed += check_solid(&mut random(9), &solid, Style::Plain, 50, &what);
        }
        assert!(crossed > 100, "{crossed}");
    }
}
