//! The builder of the bounding volume hierarchy: binned surface area heuristic, straight into
//! nodes of eight.
//!
//! Source: Wald, "On fast Construction of SAH-based Bounding Volume Hierarchies" (2007); eight
//! wide by opening the largest child until there are eight, Wald, Benthin & Boulos, "Getting Rid
//! of Packets" (2008). The same input gives the same bytes on any number of threads: bins hold
//! minima, maxima and counts, which do not care for order, and every split is made by one thread.

use std::ops::Range;

use glam::Vec4;
use rayon::prelude::*;

use crate::prepared::node::{Child, Node};

/// From this level on, splits are made in the middle, so that a path ends within 28 more.
const MEDIAN_LEVEL: usize = 32;

/// A range of fewer items is built by one thread.
const SERIAL: usize = 4096;

const BINS: usize = 16;

/// Ranges of up to this many items have half as many bins.
const FEW: usize = 32;

/// Two items are joined where the box around them has less than this part of what their own boxes
/// have of surface: half of it where these are the same.
const JOINED: f32 = 0.75;

/// Which ranges are leaves.
#[derive(Debug, Clone, Copy)]
pub(super) struct Leaves {
    /// Those of up to this many items, at most [`Child::MOST_ITEMS`].
    pub(super) most: usize,
    /// Items from this number on, which are costly to meet, have a leaf each.
    pub(super) alone_from: u32,
}

/// An axis-aligned box. The fourth numbers mean nothing: with them a corner is one load.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Bounds {
    min: Vec4,
    max: Vec4,
}

impl Bounds {
    const NONE: Self = Self { min: Vec4::INFINITY, max: Vec4::NEG_INFINITY };

    #[inline(always)]
    fn join(self, other: &Self) -> Self {
        Self { min: self.min.min(other.min), max: self.max.max(other.max) }
    }

    #[inline(always)]
    fn add(&mut self, point: Vec4) {
        *self = Self { min: self.min.min(point), max: self.max.max(point) };
    }

    /// Half the surface.
    #[inline(always)]
    fn half_area(&self) -> f32 {
        let [x, y, z, _] = (self.max - self.min).to_array();
        if x < 0.0 { 0.0 } else { x * y + y * z + z * x }
    }

    /// Twice the centre.
    #[inline(always)]
    fn twice_center(&self) -> Vec4 {
        self.min + self.max
    }
}

/// What the hierarchy is built over: an item, or two that are joined. In the bits of the fourth
/// numbers of its box are the number of the first one and how many they are.
#[derive(Debug, Clone, Copy)]
pub(super) struct BuildPrimitive(Bounds);

impl BuildPrimitive {
    /// An item of a number and its box.
    pub(super) fn new([x, y, z]: [f32; 3], max: [f32; 3], item: u32) -> Self {
        // Of two zeros the smaller one would be a matter of order.
        let [least_x, least_y, least_z] = [x + 0.0, y + 0.0, z + 0.0];
        let [x, y, z] = max.map(|x| x + 0.0);
        let min = Vec4::new(least_x, least_y, least_z, f32::from_bits(item));
        Self(Bounds { min, max: Vec4::new(x, y, z, f32::from_bits(1)) })
    }

    /// Joins an item and the next one, where the box around both is so small that no split between
    /// them would be worth its while: so it is for the two halves of a quadrangle.
    pub(super) fn joined(&self, next: &Self) -> Option<Self> {
        let mut both = self.0.join(&next.0);
        both.min.w = self.0.min.w;
        both.max.w = f32::from_bits(2);
        let apart = self.0.half_area() + next.0.half_area();
        (both.half_area() < JOINED * apart).then_some(Self(both))
    }

    /// The number of the first item.
    pub(super) fn item(&self) -> u32 {
        self.0.min.w.to_bits()
    }

    /// How many items there are.
    #[inline(always)]
    fn count(&self) -> u32 {
        self.0.max.w.to_bits()
    }

    /// The numbers of the items.
    pub(super) fn items(&self) -> Range<u32> {
        self.item()..self.item() + self.count()
    }
}

/// A run of primitives that will be a node or a leaf.
struct BuildRange<'a> {
    primitives: &'a mut [BuildPrimitive],
    /// The place of the first item in the whole order, and how many there are.
    first: usize,
    count: usize,
    bounds: Bounds,
    /// The bounds of twice the centres.
    centers: Bounds,
    leaves: Leaves,
}

/// Builds the hierarchy over `primitives` and brings them into the order in which leaves name their
/// items. The root is node 0; every other node stands after its parent.
pub(super) fn build_bvh(primitives: &mut [BuildPrimitive], leaves: Leaves) -> Vec<Node> {
    if primitives.is_empty() {
        return vec![Node::EMPTY];
    }
    let mut nodes = Vec::new();
    build_node(BuildRange::new(primitives, 0, leaves), 0, &mut nodes);
    nodes
}

impl<'a> BuildRange<'a> {
    fn new(primitives: &'a mut [BuildPrimitive], first: usize, leaves: Leaves) -> Self {
        let nothing = || (Bounds::NONE, Bounds::NONE, 0);
        let measure = |chunk: &[BuildPrimitive]| {
            chunk.iter().fold(nothing(), |(bounds, mut centers, count), primitive| {
                centers.add(primitive.0.twice_center());
                (bounds.join(&primitive.0), centers, count + primitive.count() as usize)
            })
        };
        let (bounds, centers, count) = if primitives.len() > 8 * SERIAL {
            primitives
                .par_chunks(SERIAL)
                .map(measure)
                .reduce(nothing, |a, b| (a.0.join(&b.0), a.1.join(&b.1), a.2 + b.2))
        } else {
            measure(primitives)
        };
        Self { primitives, first, count, bounds, centers, leaves }
    }

    /// Splits in two where it is cheapest.
    fn split(self, level: usize) -> [Self; 2] {
        let split = match level {
            MEDIAN_LEVEL.. => None,
            _ if self.primitives.len() <= FEW => self.cheapest_split::<{ BINS / 2 }>(),
            _ => self.cheapest_split::<BINS>(),
        };
        let Self { primitives, first, count, leaves, .. } = self;
        let Some(split) = split else {
            // Nothing tells them apart.
            let (before, behind) = primitives.split_at_mut(primitives.len() / 2);
            let before = Self::new(before, first, leaves);
            let at = first + before.count;
            return [before, Self::new(behind, at, leaves)];
        };
        let (at, [left_centers, right_centers]) = split.partition(primitives);
        let [left, right] = split.sides;
        let (before, behind) = primitives.split_at_mut(at);
        [
            Self {
                primitives: before,
                first,
                count: split.left_count,
                bounds: left,
                centers: left_centers,
                leaves,
            },
            Self {
                primitives: behind,
                first: first + split.left_count,
                count: count - split.left_count,
                bounds: right,
                centers: right_centers,
                leaves,
            },
        ]
    }

    /// The leaf, where the range is one.
    fn as_leaf(&self) -> Option<Child> {
        self.is_leaf().then(|| Child::leaf(self.first, self.count))
    }

    fn is_leaf(&self) -> bool {
        let is_alone = |primitive: &BuildPrimitive| primitive.item() >= self.leaves.alone_from;
        self.primitives.len() == 1
            || self.count <= self.leaves.most && !self.primitives.iter().any(is_alone)
    }

    /// The split between two bins with the least area x count on its sides; `None` where the
    /// centres do not differ enough for bins.
    fn cheapest_split<const COUNT: usize>(&self) -> Option<Split> {
        let extent = (self.centers.max - self.centers.min).to_array();
        let mut scale = [0.0; 4];
        for axis in 0..3 {
            let fitting = COUNT as f32 * (1.0 - f32::EPSILON) / extent[axis];
            if extent[axis] > 0.0 && fitting.is_finite() {
                scale[axis] = fitting;
            }
        }
        let scales = Vec4::from_array(scale);
        let binning = Binning { low: self.centers.min, scale: scales, last: COUNT - 1 };
        let bins = if self.primitives.len() > 8 * SERIAL {
            self.primitives
                .par_chunks(SERIAL)
                .map(|chunk| binning.fill::<COUNT>(chunk))
                .reduce_with(|a, b| merge_bins(&a, &b))?
        } else {
            binning.fill(self.primitives)
        };
        // The cheapest: cost, axis and bin.
        let mut best: Option<(f32, usize, usize)> = None;
        for axis in (0..3).filter(|&axis| scale[axis] > 0.0) {
            let mut right_cost = [0.0; COUNT];
            let mut side = Bin::EMPTY;
            for bin in (1..COUNT).rev() {
                side = side.join(&bins[axis][bin]);
                right_cost[bin] = side.bounds.half_area() * side.count as f32;
            }
            side = Bin::EMPTY;
            for bin in 1..COUNT {
                side = side.join(&bins[axis][bin - 1]);
                let cost = side.bounds.half_area() * side.count as f32 + right_cost[bin];
                let is_split = side.count > 0 && (side.count as usize) < self.count;
                if is_split && best.is_none_or(|best| cost < best.0) {
                    best = Some((cost, axis, bin));
                }
            }
        }
        let (_, axis, bin) = best?;
        let join =
            |bins: &[Bin]| bins.iter().fold(Bounds::NONE, |bounds, bin| bounds.join(&bin.bounds));
        let (left, right) = bins[axis].split_at(bin);
        let left_count = left.iter().map(|bin| bin.count as usize).sum();
        Some(Split { axis, bin, left_count, sides: [join(left), join(right)], binning })
    }
}

#[derive(Clone, Copy)]
struct Binning {
    low: Vec4,
    scale: Vec4,
    /// The number of the last bin, all ones in binary.
    last: usize,
}

#[derive(Clone, Copy)]
struct Bin {
    bounds: Bounds,
    /// How many items.
    count: u32,
}

struct Split {
    axis: usize,
    bin: usize,
    /// How many items are left of it.
    left_count: usize,
    /// What is on each side.
    sides: [Bounds; 2],
    binning: Binning,
}

impl Bin {
    const EMPTY: Self = Self { bounds: Bounds::NONE, count: 0 };

    fn join(self, other: &Self) -> Self {
        Self { bounds: self.bounds.join(&other.bounds), count: self.count + other.count }
    }
}

fn merge_bins<const COUNT: usize>(
    a: &[[Bin; COUNT]; 3],
    b: &[[Bin; COUNT]; 3],
) -> [[Bin; COUNT]; 3] {
    std::array::from_fn(|axis| std::array::from_fn(|bin| a[axis][bin].join(&b[axis][bin])))
}

impl Binning {
    /// The bin of a box on each axis.
    #[inline(always)]
    fn bins(&self, bounds: &Bounds) -> [usize; 3] {
        // Up to the next power of two the bits of a number from here on count in ones.
        const ONES: f32 = (3 << 22) as f32;
        let at = (bounds.twice_center() - self.low) * self.scale;
        let [x, y, z, _] = (at - 0.5 + ONES).to_array();
        [x, y, z].map(|x| x.to_bits() as usize & self.last)
    }

    fn fill<const COUNT: usize>(&self, primitives: &[BuildPrimitive]) -> [[Bin; COUNT]; 3] {
        let mut bins = [[Bin::EMPTY; COUNT]; 3];
        for primitive in primitives {
            for (bins, bin) in bins.iter_mut().zip(self.bins(&primitive.0)) {
                let bin = &mut bins[bin % COUNT];
                bin.bounds = bin.bounds.join(&primitive.0);
                bin.count += primitive.count();
            }
        }
        bins
    }
}

impl Split {
    /// Brings those left of the split to the front; returns how many they are, and the bounds of
    /// twice the centres on each side.
    fn partition(&self, primitives: &mut [BuildPrimitive]) -> (usize, [Bounds; 2]) {
        let is_left =
            |primitive: &BuildPrimitive| self.binning.bins(&primitive.0)[self.axis] < self.bin;
        let [mut before, mut behind] = [Bounds::NONE; 2];
        let (mut left, mut right) = (0, primitives.len());
        loop {
            while left < right && is_left(&primitives[left]) {
                before.add(primitives[left].0.twice_center());
                left += 1;
            }
            while left < right && !is_left(&primitives[right - 1]) {
                behind.add(primitives[right - 1].0.twice_center());
                right -= 1;
            }
            if left >= right {
                return (left, [before, behind]);
            }
            primitives.swap(left, right - 1);
        }
    }
}

/// Adds the nodes of one range, its own first; children's indices count from the first of `nodes`.
fn build_node(range: BuildRange<'_>, level: usize, nodes: &mut Vec<Node>) {
    let mut ranges = vec![range];
    while ranges.len() < 8 {
        let widest = (0..ranges.len())
            .filter(|&k| !ranges[k].is_leaf())
            .max_by(|&a, &b| ranges[a].bounds.half_area().total_cmp(&ranges[b].bounds.half_area()));
        let Some(widest) = widest else { break };
        let halves = ranges.swap_remove(widest).split(level);
        ranges.extend(halves);
    }
    ranges.sort_by_key(|range| range.first);
    let mut node = Node::EMPTY;
    for (k, range) in ranges.iter().enumerate() {
        for axis in 0..3 {
            node.planes[axis][k] = range.bounds.min[axis];
            node.planes[axis + 3][k] = range.bounds.max[axis];
        }
    }
    let own = nodes.len();
    nodes.push(node);
    let total: usize = ranges.iter().map(|range| range.count).sum();
    if total <= SERIAL {
        for (k, range) in ranges.into_iter().enumerate() {
            if let Some(leaf) = range.as_leaf() {
                nodes[own].children[k] = leaf;
            } else {
                nodes[own].children[k] = Child::inner(nodes.len());
                build_node(range, level + 1, nodes);
            }
        }
        return;
    }
    let build = |range: BuildRange<'_>| {
        range.as_leaf().map_or_else(
            || {
                let mut below = Vec::new();
                build_node(range, level + 1, &mut below);
                Ok(below)
            },
            Err,
        )
    };
    let built: Vec<Result<Vec<Node>, Child>> = ranges.into_par_iter().map(build).collect();
    nodes.reserve_exact(built.iter().flatten().map(Vec::len).sum());
    for (k, child) in built.into_iter().enumerate() {
        match child {
            Err(leaf) => nodes[own].children[k] = leaf,
            Ok(subtree) => {
                let offset = nodes.len();
                nodes[own].children[k] = Child::inner(offset);
                nodes.par_extend(subtree.into_par_iter().with_min_len(SERIAL).map(|mut node| {
                    node.children = node.children.map(|child| child.moved_by(offset));
                    node
                }));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use glam::Vec3;
    use rtfarm_oracle::hard_case::HardCase;

    use super::*;
    use crate::prepared::node::MOST_LEVELS;

    const LEAVES: Leaves = Leaves { most: 4, alone_from: u32::MAX };

    fn check(boxes: &[([f32; 3], [f32; 3])]) -> Vec<Node> {
        let mut primitives: Vec<BuildPrimitive> = boxes
            .iter()
            .enumerate()
            .map(|(item, &(min, max))| BuildPrimitive::new(min, max, item as u32))
            .collect();
        let nodes = build_bvh(&mut primitives, LEAVES);
        let mut seen = vec![0; boxes.len()];
        let mut levels = vec![1; nodes.len()];
        for (index, node) in nodes.iter().enumerate() {
            for k in 0..8 {
                let child = node.children[k];
                if child == Child::NONE {
                    continue;
                }
                if !child.is_leaf() {
                    assert!(child.node() > index, "child before parent");
                    levels[child.node()] = levels[index] + 1;
                    continue;
                }
                for primitive in &primitives[child.items()] {
                    seen[primitive.item() as usize] += 1;
                    for axis in 0..3 {
                        assert!(node.planes[axis][k] <= primitive.0.min[axis]);
                        assert!(node.planes[axis + 3][k] >= primitive.0.max[axis]);
                    }
                }
            }
        }
        assert!(seen.iter().all(|&count| count == 1), "every face in one leaf");
        assert!(levels.into_iter().max().unwrap() <= MOST_LEVELS);
        nodes
    }

    fn scattered(count: usize) -> Vec<([f32; 3], [f32; 3])> {
        (0..count as u32)
            .map(|k| {
                let at = [1, 2, 3].map(|salt: u32| {
                    let hash = (k + 1).wrapping_mul(0x9E37_79B9).wrapping_mul(2 * salt + 1);
                    (hash >> 8) as f32 / 16_777_216.0
                });
                (at, at.map(|x| x + 0.01))
            })
            .collect()
    }

    #[test]
    fn every_face_is_in_one_leaf_and_inside_its_boxes() {
        for count in [1, 2, 7, 8, 9, 100, 50_000] {
            check(&scattered(count));
        }
    }

    #[test]
    fn items_are_joined_that_fill_one_box() {
        let item = |k: u32, min, max| BuildPrimitive::new(min, max, k);
        let (low, high) = ([0.0; 3], [1.0, 1.0, 0.1]);
        let half = item(6, low, high);
        let both = half.joined(&item(7, [0.1, 0.0, 0.0], [1.0, 1.1, 0.1])).expect("nearly one box");
        assert!(both.items().eq([6, 7]));
        assert!(
            both.0.min.truncate() == Vec3::ZERO
                && both.0.max.truncate() == Vec3::new(1.0, 1.1, 0.1)
        );
        assert!(half.joined(&item(7, [1.0, 0.0, 0.0], [2.0, 1.0, 0.1])).is_none());
        // Points have no surface, however far apart they are.
        assert!(item(6, [0.0; 3], [0.0; 3]).joined(&item(7, [0.0; 3], [0.0; 3])).is_none());
    }

    #[test]
    fn leaves_name_all_items_of_what_is_joined() {
        let boxes = scattered(50_000);
        let (mut primitives, mut next) = (Vec::new(), 0);
        for (k, (min, max)) in boxes.into_iter().enumerate() {
            let item = BuildPrimitive::new(min, max, next);
            next += 1;
            let both = || item.joined(&BuildPrimitive::new(min, max, next)).expect("one box");
            primitives.push(if k % 3 == 0 { item } else { both() });
            next += u32::from(k % 3 != 0);
        }
        let nodes = build_bvh(&mut primitives, LEAVES);
        let order: Vec<u32> = primitives.iter().flat_map(BuildPrimitive::items).collect();
        let mut is_seen = vec![false; order.len()];
        for node in &nodes {
            for child in node.children.into_iter().filter(|child| child.is_leaf()) {
                for place in child.items() {
                    assert!(!std::mem::replace(&mut is_seen[order[place] as usize], true));
                }
            }
        }
        assert!(is_seen.into_iter().all(|is_seen| is_seen));
    }

    #[test]
    fn coincident_faces_are_halved_not_split_for_ever() {
        let nodes = check(&vec![([0.5; 3], [0.5; 3]); 100_000]);
        HardCase::EqualCentroids.tell(
            "boxes with one middle end in leaves",
            format!("{} nodes for 100 000", nodes.len()),
        );
    }

    #[test]
    fn middles_one_ulp_apart_end_in_leaves() {
        let a: f32 = 0.5;
        let boxes: Vec<_> = (0..1000)
            .map(|k| if k % 2 == 0 { a } else { a.next_up() })
            .map(|x| ([x; 3], [x; 3]))
            .collect();
        let nodes = check(&boxes);
        let measured = format!("{} nodes for 1000", nodes.len());
        HardCase::CentroidsOneUlpApart.tell("middles one ulp apart end in leaves", measured);
    }

    type Splitter = fn(&BuildRange<'_>) -> Option<(usize, usize, f32)>;

    /// The cheapest of all splits between neighbours in the order of their centres: axis, place,
    /// cost.
    fn swept_split(range: &BuildRange<'_>) -> Option<(usize, usize, f32)> {
        let mut best: Option<(usize, usize, f32)> = None;
        for axis in 0..3 {
            let mut sorted = range.primitives.to_vec();
            sorted.sort_by(|a, b| a.0.twice_center()[axis].total_cmp(&b.0.twice_center()[axis]));
            let mut right_cost = vec![0.0; sorted.len()];
            let mut side = Bounds::NONE;
            for k in (1..sorted.len()).rev() {
                side = side.join(&sorted[k].0);
                right_cost[k] = side.half_area() * (sorted.len() - k) as f32;
            }
            side = Bounds::NONE;
            for k in 1..sorted.len() {
                side = side.join(&sorted[k - 1].0);
                let cost = side.half_area() * k as f32 + right_cost[k];
                if best.is_none_or(|best| cost < best.2) {
                    best = Some((axis, k, cost));
                }
            }
        }
        best
    }

    /// The cost of a binary tree by the surface area heuristic, split by split, in areas of the
    /// root: with the builder's splits, or where `splitter` says.
    fn cost(range: BuildRange<'_>, splitter: Option<Splitter>, root_area: f64) -> f64 {
        let area = f64::from(range.bounds.half_area()) / root_area;
        if range.is_leaf() {
            return area * range.primitives.len() as f64;
        }
        let halves = match splitter.and_then(|splitter| splitter(&range)) {
            None => range.split(0),
            Some((axis, at, _)) => {
                let middle = |primitive: &BuildPrimitive| primitive.0.twice_center()[axis];
                range.primitives.sort_by(|a, b| middle(a).total_cmp(&middle(b)));
                let (left, right) = range.primitives.split_at_mut(at);
                [left, right].map(|half| BuildRange::new(half, 0, LEAVES))
            }
        };
        area + halves.into_iter().map(|half| cost(half, splitter, root_area)).sum::<f64>()
    }

    #[test]
    fn bins_cut_a_teapot_in_a_stadium_as_well_as_a_full_sweep() {
        // A stadium of 1, and in it a teapot of a millionth.
        let mut boxes = scattered(2000);
        let shrunk = |point: [f32; 3]| point.map(|x| x * 1e-6);
        let teapot = scattered(2000).into_iter().map(|(min, max)| (shrunk(min), shrunk(max)));
        boxes.extend(teapot);
        let primitives: Vec<BuildPrimitive> = (0..)
            .zip(boxes)
            .map(|(item, (min, max))| BuildPrimitive::new(min, max, item))
            .collect();
        let cost_of = |splitter| {
            let mut primitives = primitives.clone();
            let range = BuildRange::new(&mut primitives, 0, LEAVES);
            let area = f64::from(range.bounds.half_area());
            cost(range, splitter, area)
        };
        let (binned, swept) = (cost_of(None), cost_of(Some(swept_split as Splitter)));
        HardCase::TeapotInStadium.tell(
            "a teapot in a stadium a million times its size costs as with a full sweep",
            format!("{:.3} times {swept:.1}", binned / swept),
        );
        assert!(binned <= 1.1 * swept);
    }

    #[test]
    fn any_number_of_threads_gives_the_same_nodes() {
        let boxes = scattered(200_000);
        let build = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| check(&boxes))
        };
        let one = build(1);
        assert!(one == build(2) && one == build(5));
    }
}
