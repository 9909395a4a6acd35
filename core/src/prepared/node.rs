//! A node of the 8-wide hierarchy, and the frame of its boxes.
//!
//! Boxes are f32, relative to the scene's f64 frame and rounded outward; in a compact scene they
//! are steps of 8 bits within their node.

/// Levels that a hierarchy may have: a path from the root visits at most this many nodes.
pub(crate) const MOST_LEVELS: usize = 64;

/// Eight boxes and what is in them.
#[derive(Debug, Clone, Copy, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C, align(32))]
pub(crate) struct Node {
    /// min x, min y, min z, max x, max y, max z of the eight children; an unused child has
    /// min = ∞, max = -∞ and is never met.
    pub(crate) planes: [[f32; 8]; 6],
    /// These are in the boxes, in the same order.
    pub(crate) children: [Child; 8],
}

const _: () = assert!(size_of::<Node>() == 224);

/// An inner node (bit 31 clear: its index, larger than its parent's), or a leaf (bit 31 set: how
/// many items less one in 3 bits, then the first one's index).
///
/// The root has no parent, so its index never names a child: there it marks an unused place.
#[derive(Debug, Clone, Copy, PartialEq, Eq, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(transparent)]
pub(crate) struct Child(u32);

impl Child {
    /// A traversal starts with the root, which is nobody's child.
    pub(crate) const ROOT: Self = Self::inner(Node::ROOT);
    /// An unused place among the children of a node: the root's index, which no child has.
    pub(crate) const NONE: Self = Self::inner(Node::ROOT);
    /// The most items in a leaf.
    pub(crate) const MOST_ITEMS: usize = 8;
    /// The limit of items in a hierarchy.
    pub(crate) const ITEM_LIMIT: usize = 1 << 28;

    /// The node at this index, which is below 2^31.
    pub(crate) const fn inner(index: usize) -> Self {
        Self(index as u32)
    }

    /// A leaf of `count` items, at most [`Child::MOST_ITEMS`], from `first` on.
    pub(crate) fn leaf(first: usize, count: usize) -> Self {
        debug_assert!(first < Self::ITEM_LIMIT && (1..=Self::MOST_ITEMS).contains(&count));
        Self(1 << 31 | (count as u32 - 1) << 28 | first as u32)
    }

    #[inline(always)]
    pub(crate) fn is_leaf(self) -> bool {
        self.0 >> 31 == 1
    }

    /// The items of a leaf.
    #[inline(always)]
    pub(crate) fn items(self) -> std::ops::Range<usize> {
        let first = (self.0 & (Self::ITEM_LIMIT as u32 - 1)) as usize;
        first..first + (self.0 >> 28 & 7) as usize + 1
    }

    /// The index of an inner node.
    #[inline(always)]
    pub(crate) fn node(self) -> usize {
        self.0 as usize
    }

    /// The same child where its node's subtree begins `offset` nodes further on. Leaves and unused
    /// places stay as they are.
    pub(crate) fn moved_by(self, offset: usize) -> Self {
        if self == Self::NONE || self.is_leaf() { self } else { Self(self.0 + offset as u32) }
    }
}

impl Node {
    /// The index of the node that all others descend from.
    pub(super) const ROOT: usize = 0;

    /// A node without children.
    pub(crate) const EMPTY: Self = {
        let (low, high) = ([f32::INFINITY; 8], [f32::NEG_INFINITY; 8]);
        Self { planes: [low, low, low, high, high, high], children: [Child::NONE; 8] }
    };
}

/// A [`Node`] in fewer bytes. Its boxes are rounded outward to steps, 255 at most, from the least
/// corner of all of them.
///
/// Source: Ylitie, Karras & Laine, "Efficient Incoherent Ray Traversal on GPUs Through Compressed
/// Wide BVHs" (2017).
#[derive(Debug, Clone, Copy, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C, align(32))]
pub(crate) struct CompactNode {
    /// The least corner.
    origin: [f32; 3],
    /// A step on each axis: the exponent of a power of two as an f32 has it in its bits, 0 for no
    /// step.
    exponents: [u8; 3],
    padding: u8,
    /// As [`Node::planes`]. Those of an unused child mean nothing.
    planes: [[u8; 8]; 6],
    children: [Child; 8],
}

const _: () = assert!(size_of::<CompactNode>() == 96);

impl CompactNode {
    /// The smallest boxes that hold those of a node, whose planes are finite where a child is.
    pub(crate) fn new(node: &Node) -> Self {
        let mut compact =
            Self { children: node.children, ..<Self as bytemuck::Zeroable>::zeroed() };
        let used = (0..8).filter(|&child| node.children[child] != Child::NONE);
        for axis in 0..3 {
            let (lows, highs) = (&node.planes[axis], &node.planes[axis + 3]);
            let low = used.clone().map(|child| lows[child]).fold(f32::INFINITY, f32::min);
            let high = used.clone().map(|child| highs[child]).fold(f32::NEG_INFINITY, f32::max);
            if low > high {
                break; // There are no children.
            }
            let mut exponent = (((high - low) / 255.0).to_bits() >> 23) as u8;
            while plane_at(low, exponent, 255) < high {
                exponent += 1;
            }
            (compact.origin[axis], compact.exponents[axis]) = (low, exponent);
            let step = plane_at(0.0, exponent, 1);
            for child in used.clone() {
                // A division by no step gives a number that is as good as any to begin with.
                let mut below = ((lows[child] - low) / step) as u8;
                while below > 0 && plane_at(low, exponent, below) > lows[child] {
                    below -= 1;
                }
                let mut above = ((highs[child] - low) / step) as u8;
                while plane_at(low, exponent, above) < highs[child] {
                    above += 1;
                }
                (compact.planes[axis][child], compact.planes[axis + 3][child]) = (below, above);
            }
        }
        compact
    }

    /// Makes `node` the one with these boxes, in place: to move it would cost as much again.
    #[inline(always)]
    pub(super) fn expand_into(&self, node: &mut Node) {
        node.children = self.children;
        for side in 0..6 {
            let (origin, exponent) = (self.origin[side % 3], self.exponents[side % 3]);
            for child in 0..8 {
                let plane = plane_at(origin, exponent, self.planes[side][child]);
                let is_used = self.children[child] != Child::NONE;
                let unused = Node::EMPTY.planes[side][child];
                node.planes[side][child] = if is_used { plane } else { unused };
            }
        }
    }

    /// The node with these boxes.
    pub(super) fn expand(&self) -> Node {
        let mut node = Node::EMPTY;
        self.expand_into(&mut node);
        node
    }
}

/// The place of a plane: so many steps from the origin, rounded once, so that it keeps the order of
/// the steps.
#[inline(always)]
fn plane_at(origin: f32, exponent: u8, steps: u8) -> f32 {
    origin + f32::from_bits(u32::from(exponent) << 23) * f32::from(steps)
}

/// Boxes are kept in this frame: box coordinate = (scene coordinate - origin) · scale, where
/// scale is a power of two that brings the scene's extent into 0.5..=1.
#[derive(Debug, Clone, Copy, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C)]
pub(crate) struct Frame {
    pub(crate) origin: [f64; 3],
    pub(crate) scale: f64,
}

#[cfg(test)]
mod tests {
    use rtfarm_oracle::random::Random;

    use super::*;

    #[test]
    fn compact_boxes_hold_those_of_the_node_and_are_little_larger() {
        let seed = 23;
        let random = &mut Random::new(seed);
        for case in 0..20_000 {
            let mut node = Node::EMPTY;
            let size = random.log_uniform(1e-12, 1.0);
            for child in 0..random.below(9) {
                for axis in 0..3 {
                    let low = size * random.between(-1.0, 1.0);
                    let thickness = [0.0, 1e-7, 1.0][random.below(3)] * random.between(0.0, size);
                    let from = [0.0, 0.7, -0.3][axis];
                    node.planes[axis][child] = (from + low) as f32;
                    node.planes[axis + 3][child] = (from + low + thickness) as f32;
                }
                node.children[child] = Child::leaf(child, 1);
            }
            let expanded = CompactNode::new(&node).expand();
            assert_eq!(expanded.children, node.children);
            for side in 0..6 {
                let of_used = |planes: &[f32; 8], start: f32, choose: fn(f32, f32) -> f32| {
                    planes.iter().copied().filter(|x| x.is_finite()).fold(start, choose)
                };
                let low = of_used(&node.planes[side % 3], f32::INFINITY, f32::min);
                let high = of_used(&node.planes[side % 3 + 3], f32::NEG_INFINITY, f32::max);
                // A step is at most twice what it has to be, and rounding takes an ulp or two.
                let most = (high - low) / 127.0 + 4.0 * f32::EPSILON * low.abs().max(high.abs());
                for child in 0..8 {
                    let (plane, was) = (expanded.planes[side][child], node.planes[side][child]);
                    let outward = if side < 3 { was - plane } else { plane - was };
                    let is_unused = node.children[child] == Child::NONE && plane == was;
                    let what = format!("seed {seed}, case {case}: {was} became {plane}");
                    assert!(is_unused || (0.0..=most).contains(&outward), "{what}");
                }
            }
        }
    }
}
