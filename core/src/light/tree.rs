//! A receiver chooses one of many emitters through a binary tree over all of them, by importance.
//!
//! Source: Conty & Kulla, "Importance Sampling of Many Lights with Adaptive Tree Splitting"
//! (2018). Here the tree's most important few nodes are opened at every receiver, which also tells
//! how far emitters fill its hemisphere; below them one path is walked at random.

use super::importance::{Importance, Receiver, emitter_importance, node_importance};
use crate::prepared::{
    layout::View,
    record::{EmitterNode, NO_NODE},
};

/// The most nodes of a cut.
const MOST_NODES: usize = 8;

/// A cut through the tree for one receiver: its nodes hold every emitter of importance exactly
/// once. The name is from Walter et al., "Lightcuts" (2005).
pub(super) struct LightCut {
    nodes: [u32; MOST_NODES],
    /// The irradiance from each node, above 0.
    irradiances: [f64; MOST_NODES],
    count: usize,
    total: Importance,
}

impl LightCut {
    /// Cuts the tree for a receiver: from the root on, the most important node is opened until
    /// there are [`MOST_NODES`]. Where there are no more emitters than that, each is a node.
    pub(crate) fn new(view: &View<'_>, receiver: &Receiver) -> Self {
        let mut cut = Self {
            nodes: [0; MOST_NODES],
            irradiances: [0.0; MOST_NODES],
            count: 0,
            total: Importance::default(),
        };
        if view.emitters.len() <= MOST_NODES {
            for record in view.emitters {
                let emitter = &view.emitters[record.by_size as usize];
                cut.add(emitter.node, &emitter_importance(view, emitter, receiver));
                // Where emitters are all around, the largest tell so soon.
                if cut.total.fills_hemisphere() {
                    break; // No emitter will be sampled.
                }
            }
            return cut;
        }
        // Nodes whose children may take their place, and their importance.
        let mut open = [(0, Importance::default()); MOST_NODES];
        let mut count = 1;
        open[0] = (0, node_importance(view, receiver, 0));
        while count < MOST_NODES {
            let is_inner = |&k: &usize| !view.emitter_nodes[open[k].0 as usize].is_leaf();
            let irradiance = |k: usize| open[k].1.irradiance;
            let inner = (0..count).filter(is_inner);
            let Some(brightest) =
                inner.reduce(|a, b| if irradiance(b) > irradiance(a) { b } else { a })
            else {
                break;
            };
            let first = view.emitter_nodes[open[brightest].0 as usize].child;
            open[brightest] = (first, node_importance(view, receiver, first));
            open[count] = (first + 1, node_importance(view, receiver, first + 1));
            count += 1;
        }
        for (node, importance) in &open[..count] {
            cut.add(*node, importance);
        }
        cut
    }

    fn add(&mut self, node: u32, importance: &Importance) {
        self.total.form_factor += importance.form_factor;
        self.total.mean_square += importance.mean_square;
        if importance.irradiance > 0.0 {
            self.nodes[self.count] = node;
            self.irradiances[self.count] = importance.irradiance;
            self.count += 1;
            self.total.irradiance += importance.irradiance;
        }
    }

    /// The importance of all emitters together; their form factor may be above 1.
    pub(super) fn total(&self) -> &Importance {
        &self.total
    }

    /// Chooses an emitter by a number in 0..1 and tells with which probability, above 0 and up to
    /// 1, it does so. It is `None` where the walk ends at a node whose children have no importance.
    pub(super) fn choose(
        &self,
        view: &View<'_>,
        receiver: &Receiver,
        number: f64,
    ) -> Option<(u32, f64)> {
        let total = self.total.irradiance;
        let mut left = number * total;
        let mut chosen = 0;
        while chosen + 1 < self.count && left >= self.irradiances[chosen] {
            left -= self.irradiances[chosen];
            chosen += 1;
        }
        let irradiance = *self.irradiances[..self.count].get(chosen)?;
        let mut probability = irradiance / total;
        let mut number = (left / irradiance).min(1.0);
        let mut node = &view.emitter_nodes[self.nodes[chosen] as usize];
        while !node.is_leaf() {
            let [a, b] = child_irradiances(view, receiver, node);
            let share = a / (a + b);
            // This is so also where both are 0.
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

    /// The probability, 0..=1, with which [`LightCut::choose`] chooses an emitter.
    pub(super) fn probability(&self, view: &View<'_>, receiver: &Receiver, emitter: u32) -> f64 {
        let mut at = view.emitters[emitter as usize].node;
        let mut probability = 1.0;
        loop {
            if let Some(k) = self.nodes[..self.count].iter().position(|&node| node == at) {
                return probability * (self.irradiances[k] / self.total.irradiance);
            }
            let parent = view.emitter_nodes[at as usize].parent;
            if parent == NO_NODE {
                return 0.0; // It has no importance.
            }
            let node = &view.emitter_nodes[parent as usize];
            let [a, b] = child_irradiances(view, receiver, node);
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

/// The irradiance from each of an inner node's two children.
fn child_irradiances(view: &View<'_>, receiver: &Receiver, node: &EmitterNode) -> [f64; 2] {
    [node.child, node.child + 1].map(|child| node_importance(view, receiver, child).irradiance)
}
