//! The way of a ray through the hierarchy.

use super::{box_ray::BoxRay, boxes::BoxKernel, ray::Ray};
use crate::prepared::{
    layout::View,
    node::{Child, MOST_LEVELS, Node},
    record::Item,
};

/// Children that may wait while a ray visits others: seven on each level and the last node's.
pub(super) const STACK: usize = 7 * MOST_LEVELS + 8;

/// Room for them and for a node, kept from ray to ray: to fill it anew for each would cost as much as
/// the ray.
#[derive(Debug)]
pub(super) struct Stack([(f32, Child); STACK], Node);

impl Default for Stack {
    fn default() -> Self {
        Self([(0.0, Child::NONE); STACK], Node::EMPTY)
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
    enter: impl FnMut(),
    meet: impl FnMut(Item, &BoxRay) -> Step,
) {
    let mut box_ray = BoxRay::new(ray.origin, ray.direction, ray.reach, &view.header.frame);
    visit_from(kernel, view, (&mut box_ray, Child::ROOT), stack, enter, meet);
}

/// The same below one child alone; whether the answer is known.
#[inline(always)]
pub(super) fn visit_from(
    kernel: impl BoxKernel,
    view: &View<'_>,
    (box_ray, mut current): (&mut BoxRay, Child),
    Stack(stack, room): &mut Stack,
    mut enter: impl FnMut(),
    mut meet: impl FnMut(Item, &BoxRay) -> Step,
) -> bool {
    let mut waiting = 0;
    loop {
        if current.is_leaf() {
            for item in view.items(current.items()) {
                match meet(item, box_ray) {
                    Step::Past => {}
                    Step::On(reach) => box_ray.shorten(reach),
                    Step::Enough => return true,
                }
            }
        } else {
            enter();
            let node = view.node(current.node(), room);
            let (distances, mut mask) = kernel.test(node, box_ray);
            let first = waiting;
            while mask != 0 {
                let child = mask.trailing_zeros() as usize & 7;
                mask &= mask - 1;
                // Insert so that the nearest ends on top.
                let mut at = waiting;
                while at > first && stack[at - 1].0 < distances[child] {
                    stack[at] = stack[at - 1];
                    at -= 1;
                }
                stack[at] = (distances[child], node.children[child]);
                waiting += 1;
            }
        }
        current = loop {
            if waiting == 0 {
                return false;
            }
            waiting -= 1;
            let (near, child) = stack[waiting];
            if box_ray.reaches(near) {
                break child;
            }
        };
    }
}
