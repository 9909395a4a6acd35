//! A node of the 8-wide hierarchy, and the frame of its boxes.
//!
//! Boxes are f32, relative to the scene's f64 frame and rounded outward.

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
    pub(super) const MOST_ITEMS: usize = 8;
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

/// Boxes are kept in this frame: box coordinate = (scene coordinate - origin) · scale, where
/// scale is a power of two that brings the scene's extent into 0.5..=1.
#[derive(Debug, Clone, Copy, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C)]
pub(crate) struct Frame {
    pub(crate) origin: [f64; 3],
    pub(crate) scale: f64,
}
