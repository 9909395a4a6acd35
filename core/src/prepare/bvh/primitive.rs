//! What the hierarchy is built over: boxes of items.

use std::ops::Range;

use glam::{Vec4, Vec4Swizzles};

use crate::prepared::node::Child;

// Bit 29 stays clear: with all bits of the exponent set a float would be infinite or no number.
const _: () = assert!(Child::ITEM_LIMIT <= NORMAL as usize / 2);

/// Two items are joined where the box around them has less than this part of what their own boxes
/// have of surface. It is half of it where these are the same, and 5/6 where two cubes touch.
const JOINED: f32 = 0.95;

/// Set in a number, below [`Child::ITEM_LIMIT`], that is kept in a float's bits: the float is a
/// normal one then, and arithmetic on subnormal ones is slow.
const NORMAL: u32 = 1 << 30;

/// An axis-aligned box. The fourth numbers mean nothing: with them a corner is one load.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Bounds {
    pub(super) min: Vec4,
    pub(super) max: Vec4,
}

impl Bounds {
    pub(super) const NONE: Self = Self { min: Vec4::INFINITY, max: Vec4::NEG_INFINITY };

    #[inline(always)]
    pub(super) fn join(self, other: &Self) -> Self {
        Self { min: self.min.min(other.min), max: self.max.max(other.max) }
    }

    #[inline(always)]
    pub(super) fn add(&mut self, point: Vec4) {
        *self = Self { min: self.min.min(point), max: self.max.max(point) };
    }

    /// Half the surface of a box that holds something.
    #[inline(always)]
    pub(super) fn half_area(&self) -> f32 {
        let size = self.max - self.min;
        let [xy, yz, zx, _] = (size * size.yzxw()).to_array();
        xy + yz + zx
    }

    /// Twice the centre.
    #[inline(always)]
    pub(super) fn twice_center(&self) -> Vec4 {
        self.min + self.max
    }
}

/// An item, or two that are joined. In the bits of the fourth numbers of its box are the number of
/// the first one and how many they are.
#[derive(Debug, Clone, Copy)]
pub(in crate::prepare) struct BuildPrimitive(pub(super) Bounds);

impl BuildPrimitive {
    /// An item of a number and its box.
    pub(in crate::prepare) fn new([x, y, z]: [f32; 3], max: [f32; 3], item: u32) -> Self {
        // Of two zeros the smaller one would be a matter of order.
        let [least_x, least_y, least_z] = [x + 0.0, y + 0.0, z + 0.0];
        let [x, y, z] = max.map(|x| x + 0.0);
        let min = Vec4::new(least_x, least_y, least_z, f32::from_bits(NORMAL | item));
        Self(Bounds { min, max: Vec4::new(x, y, z, f32::from_bits(NORMAL | 1)) })
    }

    /// Joins an item and the next one, where the box around both is so small that no split between
    /// them would be worth its while: so it is for the two halves of a quadrangle.
    pub(in crate::prepare) fn joined(&self, next: &Self) -> Option<Self> {
        let mut both = self.0.join(&next.0);
        both.min.w = self.0.min.w;
        both.max.w = f32::from_bits(NORMAL | 2);
        let apart = self.0.half_area() + next.0.half_area();
        (both.half_area() < JOINED * apart).then_some(Self(both))
    }

    /// The number of the first item.
    pub(in crate::prepare) fn item(&self) -> u32 {
        self.0.min.w.to_bits() & !NORMAL
    }

    /// How many items there are.
    #[inline(always)]
    pub(super) fn count(&self) -> u32 {
        self.0.max.w.to_bits() & !NORMAL
    }

    /// The numbers of the items.
    pub(in crate::prepare) fn items(&self) -> Range<u32> {
        self.item()..self.item() + self.count()
    }
}
