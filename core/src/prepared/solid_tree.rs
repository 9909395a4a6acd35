//! The links between the nodes of a solid's tree, which follow from its shape.

use super::record::{NO_NODE, SolidNodeKind, SolidNodeRecord};

/// Links nodes, given in postfix order by their kind and their number of operands; `None` if they
/// are no tree.
///
/// The jumps are those of Myers, "An applicative random-access stack" (1983): any ancestor is
/// reached in steps logarithmic in the depth.
pub(crate) fn link_solid(
    nodes: impl IntoIterator<Item = (SolidNodeKind, u32)>,
) -> Option<Vec<SolidNodeRecord>> {
    let mut records: Vec<SolidNodeRecord> = Vec::new();
    let mut waiting: Vec<u32> = Vec::new();
    let mut leaf_count = 0;
    for (index, (kind, operands)) in (0..).zip(nodes) {
        let first_child = if kind == SolidNodeKind::LEAF {
            leaf_count += 1;
            (operands == 0).then_some(leaf_count - 1)?
        } else {
            let is_whole = kind.is_operation() && operands >= 2;
            let first = waiting.len().checked_sub(operands as usize).filter(|_| is_whole)?;
            let first_child = waiting[first];
            for child in waiting.drain(first..) {
                records[child as usize].parent = index;
            }
            first_child
        };
        waiting.push(index);
        records.push(SolidNodeRecord {
            kind,
            operands,
            first_child,
            parent: NO_NODE,
            jump: index,
            dies_at: NO_NODE,
            rest: leaf_count,
            padding: 0,
            siblings: 0,
            needed: u64::MAX,
        });
    }
    if waiting.len() != 1 {
        return None;
    }
    if records.len() <= SolidNodeRecord::BITS {
        link_siblings(&mut records);
    }
    let mut depths = vec![0; records.len()];
    for index in (0..records.len() - 1).rev() {
        let parent = records[index].parent;
        let above = records[parent as usize];
        let far = records[above.jump as usize];
        let depth = |node: u32| depths[node as usize];
        let is_even = depth(parent) - depth(above.jump) == depth(above.jump) - depth(far.jump);
        let is_first = above.first_child as usize == index;
        let (dies_alone, takes_all) = match above.kind {
            SolidNodeKind::UNION => (false, false),
            SolidNodeKind::INTERSECTION => (true, true),
            _ => (!is_first, is_first),
        };
        depths[index] = depth(parent) + 1;
        let record = &mut records[index];
        record.jump = if is_even { far.jump } else { parent };
        record.dies_at = if dies_alone { parent } else { above.dies_at };
        if takes_all {
            record.rest = above.rest;
        }
    }
    Some(records)
}

/// Finds what decides whether the ray enters and leaves the parents of nodes with them.
fn link_siblings(records: &mut [SolidNodeRecord]) {
    let mut operands = [0_u64; SolidNodeRecord::BITS];
    let root = records.len() - 1;
    for (index, record) in records[..root].iter().enumerate() {
        operands[record.parent as usize] |= 1 << index;
    }
    for index in 0..root {
        let parent = records[records[index].parent as usize];
        let first = 1 << parent.first_child;
        let siblings = operands[records[index].parent as usize] & !(1 << index);
        records[index].siblings = siblings;
        records[index].needed = match parent.kind {
            SolidNodeKind::UNION => 0,
            SolidNodeKind::INTERSECTION => siblings,
            _ => siblings & first,
        };
    }
}
