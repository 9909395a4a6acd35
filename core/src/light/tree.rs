//! A binary tree over all emitters, to choose one of many by what it promises a receiver.
//!
//! Source: Conty & Kulla, "Importance Sampling of Many Lights with Adaptive Tree Splitting"
//! (2018). Here the nearest few nodes are opened at every receiver, which also tells how far
//! emitters fill its sky; below them one path is walked at random.

use super::importance::{FULL_SHARE, Promise, Receiver, node_promise, promise};
use crate::prepared::{
    layout::View,
    record::{EmitterNode, NO_NODE},
};

/// Nodes that are compared at a receiver before the walk.
const OPENED: usize = 8;

/// The most promising nodes for a receiver: together they hold every emitter that promises
/// anything.
pub(crate) struct Survey {
    nodes: [u32; OPENED],
    /// The light of each.
    lights: [f64; OPENED],
    count: usize,
    total: Promise,
}

impl Survey {
    pub(crate) fn new(view: &View<'_>, receiver: &Receiver) -> Self {
        let mut survey =
            Self { nodes: [0; OPENED], lights: [0.0; OPENED], count: 0, total: Promise::default() };
        if view.emitters.len() <= OPENED {
            for record in view.emitters {
                let emitter = &view.emitters[record.by_size as usize];
                survey.take(emitter.node, &promise(view, emitter, receiver));
                // Where emitters are all around, the largest tell so soon.
                if survey.total.share >= FULL_SHARE {
                    break; // Nothing will be aimed at.
                }
            }
            return survey;
        }
        // Nodes whose children may take their place, and what they promise.
        let mut open = [(0, Promise::default()); OPENED];
        let mut count = 1;
        open[0] = (0, node_promise(view, receiver, 0));
        while count < OPENED {
            let is_inner = |&k: &usize| !view.emitter_nodes[open[k].0 as usize].is_leaf();
            let light = |k: usize| open[k].1.light;
            let inner = (0..count).filter(is_inner);
            let Some(widest) = inner.reduce(|a, b| if light(b) > light(a) { b } else { a }) else {
                break;
            };
            let first = view.emitter_nodes[open[widest].0 as usize].child;
            open[widest] = (first, node_promise(view, receiver, first));
            open[count] = (first + 1, node_promise(view, receiver, first + 1));
            count += 1;
        }
        for (node, promise) in &open[..count] {
            survey.take(*node, promise);
        }
        survey
    }

    fn take(&mut self, node: u32, promise: &Promise) {
        self.total.share += promise.share;
        self.total.square += promise.square;
        if promise.light > 0.0 {
            self.nodes[self.count] = node;
            self.lights[self.count] = promise.light;
            self.count += 1;
            self.total.light += promise.light;
        }
    }

    /// What all together promise; the share may be above 1.
    pub(crate) fn total(&self) -> &Promise {
        &self.total
    }

    /// Chooses an emitter by a number in 0..1; with which probability. `None` where the walk ends
    /// at a node whose children promise nothing.
    pub(crate) fn choose(
        &self,
        view: &View<'_>,
        receiver: &Receiver,
        number: f64,
    ) -> Option<(u32, f64)> {
        let total = self.total.light;
        let mut left = number * total;
        let mut chosen = 0;
        while chosen + 1 < self.count && left >= self.lights[chosen] {
            left -= self.lights[chosen];
            chosen += 1;
        }
        let light = *self.lights[..self.count].get(chosen)?;
        let mut probability = light / total;
        let mut number = (left / light).min(1.0);
        let mut node = &view.emitter_nodes[self.nodes[chosen] as usize];
        while !node.is_leaf() {
            let [a, b] = children_light(view, receiver, node);
            let share = a / (a + b);
            // Also where both are 0.
            if share.is_nan() {
                return None;
            }
            let child = if number < share {
                number /= share;
                probability *= share;
                node.child
            } else {
                number = ((number - share) / (1.0 - share)).min(1.0);
                probability *= 1.0 - share;
                node.child + 1
            };
            node = &view.emitter_nodes[child as usize];
        }
        (probability > 0.0).then_some((node.emitter, probability))
    }

    /// The probability with which [`Survey::choose`] chooses an emitter.
    pub(crate) fn probability(&self, view: &View<'_>, receiver: &Receiver, emitter: u32) -> f64 {
        let mut at = view.emitters[emitter as usize].node;
        let mut probability = 1.0;
        loop {
            if let Some(k) = self.nodes[..self.count].iter().position(|&node| node == at) {
                return probability * (self.lights[k] / self.total.light);
            }
            let parent = view.emitter_nodes[at as usize].parent;
            if parent == NO_NODE {
                return 0.0; // It promises nothing.
            }
            let node = &view.emitter_nodes[parent as usize];
            let [a, b] = children_light(view, receiver, node);
            let share = a / (a + b);
            let share = if at == node.child { share } else { 1.0 - share };
            if share.is_nan() || share <= 0.0 {
                return 0.0;
            }
            probability *= share;
            at = parent;
        }
    }
}

fn children_light(view: &View<'_>, receiver: &Receiver, node: &EmitterNode) -> [f64; 2] {
    [node.child, node.child + 1].map(|child| node_promise(view, receiver, child).light)
}
