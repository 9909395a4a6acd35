//! The rays of a group side by side through a solid, a lane each.
//!
//! Each leaf is met by all of them at once. Then every ray goes on to its next end at the same
//! time, and what they are inside there is told for all by a bit each: an operation on leaves is
//! one on such bits. Rays in doubt are left to `Scratch::cross`. docs/proof.md says why all others
//! are told what the plain evaluation tells.

use super::{
    boxes::BoxKernel,
    course::Crossing,
    lanes::{GROUPS, LANES, RayGroup, Turn, groups as asking_groups, places},
    solid_rays::{MOST_LEAVES, SolidRays},
};
use crate::prepared::{
    face::Part,
    layout::View,
    record::{SolidNodeKind, SolidNodeRecord, SolidRecord},
};

/// Room for a number for each node, and for one that is above the root.
const NODES: usize = 2 * SolidNodeRecord::BITS;

/// A node whose rays count for the operation above it.
#[derive(Debug, Clone, Copy, Default)]
struct Operand {
    node: u8,
    parent: u8,
    /// All bits where the parent, or the node itself, has the rays that are not inside.
    turns_parent: u8,
    turns: u8,
}

/// Room for the rays of a group in a solid.
#[derive(Debug)]
pub(super) struct SolidLanes {
    rays: [SolidRays; GROUPS],
    /// The groups that meet a node of the hierarchy, a bit each.
    waiting: [u8; SolidNodeRecord::BITS],
    /// The leaves that are met, in file order, and their nodes.
    leaves: [(u8, u8); MOST_LEAVES],
    /// Where rays enter and leave them.
    ends: [[[f64; LANES]; 2]; MOST_LEAVES],
    /// The rays that are inside each of them before a step and after it.
    inside: [[u8; MOST_LEAVES]; 2],
    /// The same for each node.
    inside_nodes: [[u8; NODES]; 2],
    /// The nodes that rays may be inside, from the leaves up.
    operands: [Operand; SolidNodeRecord::BITS],
    /// The operations among them and what each begins with.
    operations: [(u8, u8); SolidNodeRecord::BITS],
}

impl Default for SolidLanes {
    fn default() -> Self {
        let zeros = [0.0; LANES];
        Self {
            rays: [SolidRays::EMPTY; GROUPS],
            waiting: [0; SolidNodeRecord::BITS],
            leaves: [(0, 0); MOST_LEAVES],
            ends: [[zeros; 2]; MOST_LEAVES],
            inside: [[0; MOST_LEAVES]; 2],
            inside_nodes: [[0; NODES]; 2],
            operands: [Operand::default(); SolidNodeRecord::BITS],
            operations: [(0, 0); SolidNodeRecord::BITS],
        }
    }
}

impl SolidLanes {
    /// Calls `take` with the place for the crossings of the solid's surface by the rays `asking` of
    /// a packet, in order for each, until it says that this ray has enough; it is not told of
    /// crossings at the start if `skips_start`. The solid has at most [`SolidNodeRecord::BITS`]
    /// nodes. The rays that are in doubt, a bit each: what `take` was told of them does not count.
    #[inline(always)]
    pub(super) fn cross(
        &mut self,
        solid: (&View<'_>, &SolidRecord),
        kernel: impl BoxKernel,
        (groups, turn): (&[RayGroup; GROUPS], &Turn),
        (asking, skips_start): (u64, bool),
        mut take: impl FnMut(usize, Crossing) -> bool,
    ) -> u64 {
        // The groups that ask, each with the place of its first ray.
        let (mut count, mut any_leaves) = (0, 0_u64);
        let mut of_groups = [(0, 0_u8); GROUPS];
        for (k, asking) in asking_groups(asking) {
            let any = kernel.approach(&mut self.rays[count], (&groups[k], turn), solid.1);
            any_leaves |= u64::from(any) << count;
            of_groups[count] = (LANES * k, asking as u8);
            count += 1;
        }
        let of_groups = &of_groups[..count.min(GROUPS)];
        let touched = self.touch(solid, kernel, of_groups, turn.is_forward);
        let mut in_doubt = 0;
        for (at, &(first, asking)) in of_groups.iter().enumerate() {
            if touched[at] != 0 {
                let any_leaves = any_leaves >> at & 1 == 1;
                let asking = (u64::from(asking), skips_start);
                let of_group = (at, touched[at], any_leaves);
                let take = |lane: usize, crossing: Crossing| take(first + lane, crossing);
                in_doubt |= self.cross_group(solid, kernel, of_group, asking, take) << first;
            }
        }
        in_doubt
    }

    /// The same for one group, which touches some leaves.
    #[inline(always)]
    fn cross_group(
        &mut self,
        (view, solid): (&View<'_>, &SolidRecord),
        kernel: impl BoxKernel,
        (group, touched, any_leaves): (usize, u64, bool),
        (asking, skips_start): (u64, bool),
        mut take: impl FnMut(usize, Crossing) -> bool,
    ) -> u64 {
        if touched.count_ones() as usize > MOST_LEAVES {
            return asking;
        }
        let apart = solid.margin / 1024.0;
        let met = (group, asking, any_leaves);
        let (count, mut in_doubt) = self.meet((view, solid), kernel, met, (touched, apart));
        let mut alive = asking & !in_doubt;
        if count == 0 || alive == 0 {
            return in_doubt;
        }
        let nodes = view.solid_nodes(solid);
        let root = nodes.len() - 1;
        let (operand_count, operation_count) = self.link(nodes, count);
        let Self { rays, leaves, ends, inside, inside_nodes, operands, operations, .. } = self;
        let (rays, leaves, ends) = (&rays[group], &leaves[..count], &ends[..count]);
        let (operands, operations) = (&operands[..operand_count], &operations[..operation_count]);
        // Before the first end that counts; none may be so near to the start that it is in one
        // doubt with what lies behind.
        let (mut first, mut bound) = (rays.left_at, rays.left_at);
        for lane in 0..LANES {
            if skips_start {
                bound[lane] += apart;
            } else {
                first[lane] -= apart;
            }
        }
        let (mut at, mut next) = ([0.0; LANES], [0.0; LANES]);
        let reach = &rays.near.reach;
        let [mut before, mut after] = [0, 1];
        let seen = kernel.look(ends, (&first, reach, 0.0), &mut inside[before], &mut at);
        alive &= seen.ahead;
        for lane in 0..LANES {
            in_doubt |= u64::from(at[lane] < bound[lane]) << lane & alive;
        }
        alive &= !in_doubt;
        if alive == 0 {
            return in_doubt;
        }
        combine(leaves, operands, operations, &inside[before], &mut inside_nodes[before]);
        while alive != 0 {
            let seen = kernel.look(ends, (&at, reach, apart), &mut inside[after], &mut next);
            in_doubt |= seen.near & alive;
            alive &= !seen.near;
            combine(leaves, operands, operations, &inside[after], &mut inside_nodes[after]);
            let [was, is] = [&inside_nodes[before], &inside_nodes[after]];
            let crossing = u64::from(was[root] ^ is[root]) & alive;
            let mut enough = 0;
            if crossing != 0 {
                // The leaf at the crossing of each; the rays that come to any leaf, and to several.
                let mut rows = [0_u8; LANES];
                let [mut any, mut several] = [0; 2];
                let changes = inside[before].iter().zip(&inside[after]).take(count);
                for (row, (was, is)) in (0..).zip(changes) {
                    let changed = was ^ is;
                    several |= any & changed;
                    any |= changed;
                    for lane in places(u64::from(changed) & crossing) {
                        rows[lane % LANES] = row;
                    }
                }
                // One place that tells: it is compiled for the kernel.
                for lane in places(crossing) {
                    let lane = lane % LANES;
                    let mut row = usize::from(rows[lane]) % MOST_LEAVES;
                    if several >> lane & 1 == 1 {
                        let node = changed_leaf(nodes, operands, [was, is], lane);
                        row = leaves.iter().position(|&(_, of_row)| of_row == node).unwrap_or(row);
                    }
                    let number = u32::from(leaves[row].0);
                    let leaf = &view.solid_leaves(solid)[number as usize];
                    let face = if leaf.is_sphere() {
                        0
                    } else {
                        let planes = &view.box_planes[leaf.surface as usize];
                        let enters = inside[after][row] >> lane & 1 == 1;
                        let ray = (&rays.ray(lane), rays.left_at[lane]);
                        kernel.face_at(ray, planes, at[lane], enters)
                    };
                    let t = -rays.left_at[lane] + at[lane];
                    let crossing = Crossing { t, part: Part::new(number, face) };
                    enough |= u64::from(take(lane, crossing)) << lane;
                }
            }
            alive &= seen.ahead & !enough;
            std::mem::swap(&mut at, &mut next);
            std::mem::swap(&mut before, &mut after);
        }
        in_doubt
    }

    /// The leaves whose boxes some ray of each group touches, a bit each.
    #[inline(always)]
    fn touch(
        &mut self,
        (view, solid): (&View<'_>, &SolidRecord),
        kernel: impl BoxKernel,
        groups: &[(usize, u8)],
        is_forward: [bool; 3],
    ) -> [u64; GROUPS] {
        let mut touched = [0; GROUPS];
        let rays = &self.rays[..groups.len()];
        let beam = kernel.surround_near(rays, is_forward);
        let first = solid.first_box as usize;
        self.waiting[0] = u8::MAX >> (GROUPS - groups.len());
        let mut waiting = 1_u64;
        while waiting != 0 {
            let index = waiting.trailing_zeros() as usize % SolidNodeRecord::BITS;
            waiting &= waiting - 1;
            let node = &view.solid_boxes[first + index];
            let of_node = self.waiting[index];
            let mut met = kernel.touch_beam(node, &beam);
            while met != 0 {
                let place = met.trailing_zeros() as usize & 7;
                met &= met - 1;
                let child = node.children[place];
                let planes = |sides: [usize; 3]| sides.map(|side| node.planes[side][place]);
                let planes = [planes(beam.beam.near), planes(beam.beam.far)];
                let of_child = kernel.touch(rays, (groups, of_node), planes);
                if of_child == 0 {
                    continue;
                }
                if child.is_leaf() {
                    let bit = 1_u64.checked_shl(child.items().start as u32).unwrap_or(0);
                    for k in places(of_child.into()) {
                        touched[k % GROUPS] |= bit;
                    }
                } else {
                    let index = (child.node() - first) % SolidNodeRecord::BITS;
                    self.waiting[index] = of_child;
                    waiting |= 1 << index;
                }
            }
        }
        touched
    }

    /// The rays meet the leaves that are touched; how many count, and the rays in doubt.
    #[inline(always)]
    fn meet(
        &mut self,
        (view, solid): (&View<'_>, &SolidRecord),
        kernel: impl BoxKernel,
        (group, asking, any_leaves): (usize, u64, bool),
        (mut touched, apart): (u64, f64),
    ) -> (usize, u64) {
        let rays = &self.rays[group];
        let (mut count, mut in_doubt) = (0, 0);
        while touched != 0 {
            let number = touched.trailing_zeros();
            touched &= touched - 1;
            let leaf = &view.solid_leaves(solid)[number as usize];
            let ends = &mut self.ends[count % MOST_LEAVES];
            let met = if leaf.is_sphere() {
                kernel.meet_ball(rays, leaf, (any_leaves, apart), ends)
            } else {
                let planes = &view.box_planes[leaf.surface as usize];
                kernel.meet_box(rays, planes, (any_leaves, apart), ends)
            };
            in_doubt |= met.in_doubt & asking;
            if met.met & asking == 0 {
                // The leaves before the rest make no difference any more.
                let rest = view.solid_nodes(solid)[leaf.node as usize].rest;
                touched &= u64::MAX.checked_shl(rest).unwrap_or(0);
                continue;
            }
            self.leaves[count % MOST_LEAVES] = (number as u8, leaf.node as u8);
            count += 1;
        }
        (count, in_doubt)
    }

    /// Finds the nodes that rays may be inside, which are above the first `count` leaves; how many
    /// of them are no root, and how many operations.
    #[inline(always)]
    fn link(&mut self, nodes: &[SolidNodeRecord], count: usize) -> (usize, usize) {
        let mut active = 0_u64;
        for &(_, leaf) in &self.leaves[..count] {
            let mut node = u32::from(leaf);
            while node < SolidNodeRecord::BITS as u32 && active >> node & 1 == 0 {
                active |= 1 << node;
                node = nodes[node as usize].parent;
            }
        }
        let (mut operand_count, mut operation_count) = (0, 0);
        let mut left = active;
        // What an operation begins with: all rays are outside what is missing.
        let mut begins = [0_u8; SolidNodeRecord::BITS];
        while left != 0 {
            let node = left.trailing_zeros() as usize;
            left &= left - 1;
            let record = &nodes[node];
            let turns = if record.kind == SolidNodeKind::LEAF {
                0
            } else {
                self.operations[operation_count] = (node as u8, begins[node]);
                operation_count += 1;
                if record.kind == SolidNodeKind::UNION { 0 } else { 0xFF }
            };
            let mut operand =
                Operand { node: node as u8, parent: NODES as u8 - 1, turns_parent: 0, turns };
            if let Some(parent) = nodes.get(record.parent as usize) {
                let operands = record.siblings | 1 << node;
                let (turns_parent, is_missing) = match parent.kind {
                    SolidNodeKind::UNION => (0, false),
                    SolidNodeKind::INTERSECTION => (0xFF, operands & !active != 0),
                    _ if parent.first_child as usize == node => (0xFF, false),
                    _ => (0, active >> parent.first_child & 1 == 0),
                };
                operand.parent = record.parent as u8;
                operand.turns_parent = turns_parent;
                if is_missing {
                    begins[record.parent as usize % SolidNodeRecord::BITS] = 0xFF;
                }
            }
            self.operands[operand_count % SolidNodeRecord::BITS] = operand;
            operand_count += 1;
        }
        (operand_count, operation_count)
    }
}

/// Finds which rays are inside each node from those that are inside the leaves.
#[inline(always)]
fn combine(
    leaves: &[(u8, u8)],
    operands: &[Operand],
    operations: &[(u8, u8)],
    inside: &[u8; MOST_LEAVES],
    nodes: &mut [u8; NODES],
) {
    for &(node, begins) in operations {
        nodes[usize::from(node) % NODES] = begins;
    }
    for (&(_, node), &inside) in leaves.iter().zip(inside) {
        nodes[usize::from(node) % NODES] = inside;
    }
    for &Operand { node, parent, turns_parent, turns } in operands {
        let inside = nodes[usize::from(node) % NODES] ^ turns;
        nodes[usize::from(node) % NODES] = inside;
        nodes[usize::from(parent) % NODES] |= inside ^ turns_parent;
    }
}

/// The node of the leaf whose face is there where a ray enters or leaves the root in a step with
/// several leaves: at each operation the first operand that made it change.
#[cold]
fn changed_leaf(
    nodes: &[SolidNodeRecord],
    operands: &[Operand],
    [was, is]: [&[u8; NODES]; 2],
    lane: usize,
) -> u8 {
    let is_inside = |inside: &[u8; NODES], node: u8| inside[usize::from(node)] >> lane & 1 == 1;
    let mut node = nodes.len() as u8 - 1;
    loop {
        let record = &nodes[usize::from(node)];
        if record.kind == SolidNodeKind::LEAF {
            return node;
        }
        let enters = is_inside(is, node);
        let is_it = |operand: &&Operand| {
            let is_taken = record.kind == SolidNodeKind::DIFFERENCE
                && u32::from(operand.node) != record.first_child;
            operand.parent == node
                && is_inside(was, operand.node) != is_inside(is, operand.node)
                && is_inside(is, operand.node) == (enters ^ is_taken)
        };
        let operand = operands.iter().find(is_it);
        node = operand.expect("an operation changes only if an operand does").node;
    }
}
