//! The way of a ray through the hierarchy.

use super::{box_ray::BoxRay, boxes::BoxKernel, ray::Ray};
use crate::prepared::{
    layout::View,
    node::{Child, MOST_LEVELS, Node},
    record::Item,
};

/// Children that may wait while a ray visits others: seven on each level and the last node's.
pub(super) const STACK: usize = 7 * MOST_LEVELS + 8;

/// A ray on its way, nearer boxes first, and room for what waits; kept from ray to ray, for to fill
/// it anew for each would cost as much as the ray.
#[derive(Debug, bytemuck::Zeroable)]
pub(super) struct Traversal {
    pub(super) box_ray: BoxRay,
    current: Child,
    /// Children that wait, each with where it begins, the nearest one last.
    stack: [(f32, Child); STACK],
    waiting: usize,
}

/// Room for a ray on its way and for a node.
#[derive(Debug)]
pub(super) struct Stack(pub(super) Traversal, pub(super) Node);

impl Default for Traversal {
    fn default() -> Self {
        let stack = [(0.0, Child::NONE); STACK];
        Self { box_ray: BoxRay::NOWHERE, current: Child::ROOT, stack, waiting: 0 }
    }
}

impl Default for Stack {
    fn default() -> Self {
        Self(Traversal::default(), Node::EMPTY)
    }
}

/// What to do after a face.
pub(super) enum Step {
    /// Go on: it meant nothing.
    Past,
    /// Go on with what is nearer than this.
    On(f64),
    /// The answer is known.
    Enough,
}

impl Step {
    /// Takes it in; whether the answer is known.
    #[inline(always)]
    pub(super) fn take(self, box_ray: &mut BoxRay) -> bool {
        match self {
            Self::Past => {}
            Self::On(reach) => box_ray.shorten(reach),
            Self::Enough => return true,
        }
        false
    }
}

impl Traversal {
    /// Sets a ray out below one child alone.
    #[inline(always)]
    pub(super) fn start(&mut self, box_ray: BoxRay, child: Child) {
        (self.box_ray, self.current, self.waiting) = (box_ray, child, 0);
    }

    /// The child that comes next.
    #[inline(always)]
    pub(super) fn current(&self) -> Child {
        self.current
    }

    /// Enters the node that comes next; whether the way ends there. With `IS_ALONE` two children
    /// are put in order without a branch: faster for rays that never were in a packet, but more
    /// code in the loop of packets. The order is the same.
    #[inline(always)]
    pub(super) fn enter<const IS_ALONE: bool>(
        &mut self,
        kernel: impl BoxKernel,
        view: &View<'_>,
        room: &mut Node,
    ) -> bool {
        let node = view.node(self.current.node(), room);
        let (distances, mut mask) = kernel.test(node, &self.box_ray);
        if mask == 0 {
            return self.leave();
        }
        let child = mask.trailing_zeros() as usize & 7;
        let others = mask & (mask - 1);
        if others == 0 {
            self.current = node.children[child];
            return false;
        }
        if IS_ALONE && others.is_power_of_two() {
            // Which one is nearer is new each time: no branch is to guess it.
            let other = others.trailing_zeros() as usize & 7;
            let is_nearer = distances[child] < distances[other];
            let (near, far) = if is_nearer { (child, other) } else { (other, child) };
            self.stack[self.waiting] = (distances[far], node.children[far]);
            self.waiting += 1;
            self.current = node.children[near];
            return false;
        }
        let first = self.waiting;
        while mask != 0 {
            let child = mask.trailing_zeros() as usize & 7;
            mask &= mask - 1;
            // Insert so that the nearest ends on top.
            let mut at = self.waiting;
            while at > first && self.stack[at - 1].0 < distances[child] {
                self.stack[at] = self.stack[at - 1];
                at -= 1;
            }
            self.stack[at] = (distances[child], node.children[child]);
            self.waiting += 1;
        }
        self.leave()
    }

    /// Goes back to what waits; whether the way ends here.
    #[inline(always)]
    pub(super) fn leave(&mut self) -> bool {
        while self.waiting > 0 {
            self.waiting -= 1;
            let (near, child) = self.stack[self.waiting];
            if self.box_ray.reaches(near) {
                self.current = child;
                return false;
            }
        }
        true
    }
}

/// Calls `meet` for the items in the leaves that the ray enters, nearer boxes first, with the ray
/// that meets boxes.
#[inline(always)]
pub(super) fn visit(
    kernel: impl BoxKernel,
    view: &View<'_>,
    ray: &Ray,
    stack: &mut Stack,
    meet: impl FnMut(Item, &BoxRay) -> Step,
) {
    visit_nodes(kernel, view, ray, stack, || (), meet);
}

/// The same, and calls `enter` for each node.
#[inline(always)]
pub(super) fn visit_nodes(
    kernel: impl BoxKernel,
    view: &View<'_>,
    ray: &Ray,
    stack: &mut Stack,
    mut enter: impl FnMut(),
    mut meet: impl FnMut(Item, &BoxRay) -> Step,
) {
    let Stack(traversal, room) = stack;
    let box_ray = BoxRay::new(ray.origin, ray.direction, ray.reach, &view.header.frame);
    traversal.start(box_ray, Child::ROOT);
    loop {
        let current = traversal.current();
        let ends = if current.is_leaf() {
            let box_ray = &mut traversal.box_ray;
            let mut items = view.items(current.items());
            items.any(|item| meet(item, box_ray).take(box_ray)) || traversal.leave()
        } else {
            enter();
            traversal.enter::<false>(kernel, view, room)
        };
        if ends {
            return;
        }
    }
}
