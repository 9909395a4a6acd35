//! A binary tree over all emitters, to choose one of many by what it promises a receiver.
//!
//! Source: Conty & Kulla, "Importance Sampling of Many Lights with Adaptive Tree Splitting"
//! (2018). Here the nearest few nodes are opened at every receiver, which also tells how far
//! emitters fill its sky; below them one path is walked at random.

use glam::DVec3;

use super::sampling::{FULL_SHARE, Promise, Receiver, promise, sphere_share};
use crate::prepared::{EmitterNode, EmitterRecord, View};

/// No such node.
pub(crate) const NO_NODE: u32 = u32::MAX;

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

/// What all emitters of a node promise: that of a ball around them that they fill in part.
fn node_promise(view: &View<'_>, receiver: &Receiver, index: u32) -> Promise {
    let node = &view.emitter_nodes[index as usize];
    if node.is_leaf() {
        return promise(view, &view.emitters[node.emitter as usize], receiver);
    }
    let to_center = DVec3::from_array(node.center) - receiver.position;
    let distance = to_center.length();
    let whole = if distance > node.radius {
        sphere_share(receiver.normal.dot(to_center) / distance, node.radius / distance)
    } else {
        1.0
    };
    let share = whole * node.fill;
    Promise { share, light: share * node.radiosity, square: 0.0 }
}

/// What the tree is made of: an emitter's bounding ball, its area and what it sends on.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Twig {
    pub(crate) center: DVec3,
    pub(crate) radius: f64,
    pub(crate) area: f64,
}

/// Builds the tree over `emitters`, of which `twigs` tells more, and enters their nodes in them.
/// The root is node 0, two children stand side by side after their parent.
pub(crate) fn build_tree(emitters: &mut [EmitterRecord], twigs: &[Twig]) -> Vec<EmitterNode> {
    if emitters.is_empty() {
        return Vec::new();
    }
    let mut order: Vec<u32> = (0..emitters.len() as u32).collect();
    let mut nodes = vec![EmitterNode::leaf(NO_NODE, 0)];
    // Nodes to make, of runs of the order.
    let mut waiting = vec![(0_usize, 0..emitters.len())];
    while let Some((index, run)) = waiting.pop() {
        let parent = nodes[index].parent;
        let part = &mut order[run.clone()];
        if let [emitter] = *part {
            nodes[index] = EmitterNode::leaf(parent, emitter);
            emitters[emitter as usize].node = index as u32;
            continue;
        }
        let (mut low, mut high) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
        let (mut min, mut max) = (low, high);
        let (mut area, mut power) = (0.0, 0.0);
        for &emitter in part.iter() {
            let Twig { center, radius, area: own } = twigs[emitter as usize];
            (low, high) = (low.min(center), high.max(center));
            (min, max) = (min.min(center - radius), max.max(center + radius));
            area += own;
            let [front, back] = emitters[emitter as usize].radiosity;
            power += own * front.max(back);
        }
        let extent = high - low;
        let axis = if extent.x >= extent.max_element() {
            0
        } else if extent.y >= extent.z {
            1
        } else {
            2
        };
        let center = min + (max - min) / 2.0;
        let reach = |&emitter: &u32| {
            let Twig { center: of_emitter, radius, .. } = twigs[emitter as usize];
            (of_emitter - center).length() + radius
        };
        let radius = part.iter().map(reach).fold(0.0, f64::max);
        let middle = part.len() / 2;
        part.select_nth_unstable_by(middle, |&a, &b| {
            let place = |emitter: u32| twigs[emitter as usize].center[axis];
            place(a).total_cmp(&place(b)).then(a.cmp(&b))
        });
        let child = nodes.len();
        // Half of the area is turned away.
        let fill = (area / (std::f64::consts::TAU * (radius * radius))).min(1.0);
        nodes[index] = EmitterNode {
            center: center.to_array(),
            radius,
            fill,
            radiosity: power / area,
            parent,
            child: child as u32,
            emitter: u32::MAX,
            padding: 0,
        };
        nodes.extend([EmitterNode::leaf(index as u32, 0); 2]);
        waiting.push((child, run.start..run.start + middle));
        waiting.push((child + 1, run.start + middle..run.end));
    }
    nodes
}

/// Whether nodes are such a tree over the emitters: every walk up or down ends.
pub(crate) fn check_tree(nodes: &[EmitterNode], emitters: &[EmitterRecord]) -> Result<(), ()> {
    let ensure = |holds: bool| if holds { Ok(()) } else { Err(()) };
    ensure(nodes.len() == (2 * emitters.len()).saturating_sub(1))?;
    let mut parents = vec![NO_NODE; nodes.len()];
    for (index, node) in (0..).zip(nodes) {
        ensure(node.parent == parents[index as usize])?;
        ensure((node.parent == NO_NODE) == (index == 0))?;
        if node.is_leaf() {
            let emitter = emitters.get(node.emitter as usize).ok_or(())?;
            ensure(emitter.node == index)?;
            continue;
        }
        ensure(node.child > index && (node.child as usize) < nodes.len() - 1)?;
        for child in [node.child, node.child + 1] {
            let parent = &mut parents[child as usize];
            ensure(*parent == NO_NODE)?;
            *parent = index;
        }
    }
    // As many leaves as emitters, each its own emitter's.
    ensure(emitters.iter().all(|emitter| (emitter.node as usize) < nodes.len()))
}
