//! The builder of the bounding volume hierarchy: the surface area heuristic, straight into nodes of
//! eight.
//!
//! Source: eight wide by opening the largest child until there are eight, Wald, Benthin & Boulos,
//! "Getting Rid of Packets" (2008). The same input gives the same bytes on any number of threads:
//! bins hold minima, maxima and counts, which do not care for order, and every split is made by one
//! thread.

mod primitive;
mod split;

use rayon::prelude::*;

pub(super) use self::primitive::BuildPrimitive;
use self::split::{SERIAL, Scratch, Side, halve, split};
use crate::prepared::node::{Child, Node};

/// From this level on, ranges are halved as they stand, so that a path ends within 28 more.
const HALVING_LEVEL: usize = 32;

/// Which ranges are leaves.
#[derive(Debug, Clone, Copy)]
pub(super) struct Leaves {
    /// Those of up to this many items, at most [`Child::MOST_ITEMS`].
    pub(super) most: usize,
    /// Items from this number on, which are costly to meet, have a leaf each.
    pub(super) alone_from: u32,
}

/// A run of primitives that will be a node or a leaf.
#[derive(Debug, Clone, Copy)]
struct BuildRange {
    /// The primitives, among those that it is built with.
    begin: usize,
    end: usize,
    /// The place of the first item in the whole order.
    first: usize,
    side: Side,
    /// Half the surface; less than nothing if this is a leaf.
    to_open: f32,
}

impl BuildRange {
    fn new(
        primitives: &[BuildPrimitive],
        (begin, end): (usize, usize),
        (first, side): (usize, Side),
        leaves: Leaves,
    ) -> Self {
        let is_alone = |primitive: &BuildPrimitive| primitive.item() >= leaves.alone_from;
        let is_leaf = end - begin == 1
            || side.count <= leaves.most && !primitives[begin..end].iter().any(is_alone);
        let to_open = if is_leaf { -1.0 } else { side.bounds.half_area() };
        Self { begin, end, first, side, to_open }
    }

    /// The leaf, where the range is one.
    fn as_leaf(&self) -> Option<Child> {
        (self.to_open < 0.0).then(|| Child::leaf(self.first, self.side.count))
    }

    /// The two sides of the cheapest split.
    fn split(
        &self,
        primitives: &mut [BuildPrimitive],
        level: usize,
        leaves: Leaves,
        scratch: &mut Scratch,
    ) -> [Self; 2] {
        let own = &mut primitives[self.begin..self.end];
        let (at, sides) =
            if level < HALVING_LEVEL { split(own, &self.side, scratch) } else { halve(own) };
        let at = self.begin + at;
        let firsts = [self.first, self.first + sides[0].count];
        [
            Self::new(primitives, (self.begin, at), (firsts[0], sides[0]), leaves),
            Self::new(primitives, (at, self.end), (firsts[1], sides[1]), leaves),
        ]
    }
}

/// The ranges of a node's children, in order.
struct Opened {
    ranges: [BuildRange; 8],
    count: usize,
}

impl Opened {
    /// Opens a range to eight, if there are so many in it.
    #[inline(always)]
    fn new(
        range: BuildRange,
        primitives: &mut [BuildPrimitive],
        level: usize,
        leaves: Leaves,
        scratch: &mut Scratch,
    ) -> Self {
        let (mut ranges, mut count) = ([range; 8], 1);
        while count < 8 {
            let mut largest = 0;
            for k in 1..count {
                if ranges[k].to_open > ranges[largest].to_open {
                    largest = k;
                }
            }
            if ranges[largest].to_open < 0.0 {
                break;
            }
            let [before, behind] = ranges[largest].split(primitives, level, leaves, scratch);
            ranges.copy_within(largest + 1..count, largest + 2);
            (ranges[largest], ranges[largest + 1]) = (before, behind);
            count += 1;
        }
        Self { ranges, count }
    }

    fn ranges(&self) -> &[BuildRange] {
        &self.ranges[..self.count]
    }

    /// The node with these boxes, and the leaves among its children.
    #[inline(always)]
    fn node(&self) -> Node {
        let mut node = Node::EMPTY;
        for (k, range) in self.ranges().iter().enumerate() {
            let (min, max) = (range.side.bounds.min.to_array(), range.side.bounds.max.to_array());
            for axis in 0..3 {
                node.planes[axis][k] = min[axis];
                node.planes[axis + 3][k] = max[axis];
            }
            if let Some(leaf) = range.as_leaf() {
                node.children[k] = leaf;
            }
        }
        node
    }
}

/// Where a node is named: its parent's index, and the place among the parent's children. The root
/// has none.
type Place = Option<(usize, usize)>;

/// A range that will be a node, with its primitives alone.
struct Waiting<'a> {
    primitives: &'a mut [BuildPrimitive],
    range: BuildRange,
    place: Place,
    level: usize,
}

/// Builds the hierarchy over `primitives` and brings them into the order in which leaves name their
/// items. The root is node 0; every other node stands after its parent.
pub(super) fn build_bvh(primitives: &mut [BuildPrimitive], leaves: Leaves) -> Vec<Node> {
    if primitives.is_empty() {
        return vec![Node::EMPTY];
    }
    let all = (0, primitives.len());
    let range = BuildRange::new(primitives, all, (0, Side::of(primitives)), leaves);
    let root = Waiting { primitives, range, place: None, level: 0 };
    let mut nodes = Vec::new();
    let small = build_top(root, leaves, &mut nodes);
    let places: Vec<Place> = small.iter().map(|it| it.place).collect();
    let built: Vec<Vec<Node>> = small
        .into_par_iter()
        .map_init(Vec::new, |scratch, Waiting { primitives, range, level, .. }| {
            let mut below = Vec::with_capacity(primitives.len() / 4);
            Builder { primitives, leaves, scratch }.add(range, level, &mut below);
            below
        })
        .collect();
    nodes.reserve_exact(built.iter().map(Vec::len).sum());
    for (below, place) in built.into_iter().zip(places) {
        let offset = nodes.len();
        name_child(&mut nodes, place, offset);
        nodes.extend(below.into_iter().map(|mut node| {
            node.children = node.children.map(|child| child.moved_by(offset));
            node
        }));
    }
    nodes
}

/// Adds the nodes of large ranges, level by level; returns the small ones below.
fn build_top<'a>(root: Waiting<'a>, leaves: Leaves, nodes: &mut Vec<Node>) -> Vec<Waiting<'a>> {
    let (mut large, mut small) = (vec![root], Vec::new());
    loop {
        small.extend(large.extract_if(.., |it| it.primitives.len() <= SERIAL));
        if large.is_empty() {
            return small;
        }
        let open = |Waiting { primitives, range, place, level }: Waiting<'a>| {
            let opened = Opened::new(range, primitives, level, leaves, &mut Vec::new());
            (opened, primitives, place, level)
        };
        let opened: Vec<_> = large.into_par_iter().map(open).collect();
        large = Vec::new();
        for (opened, mut primitives, place, level) in opened {
            let own = nodes.len();
            name_child(nodes, place, own);
            nodes.push(opened.node());
            for (k, range) in opened.ranges().iter().enumerate() {
                let count = range.end - range.begin;
                let (these, others) = primitives.split_at_mut(count);
                primitives = others;
                if range.as_leaf().is_none() {
                    let range = BuildRange { begin: 0, end: count, ..*range };
                    let (place, level) = (Some((own, k)), level + 1);
                    large.push(Waiting { primitives: these, range, place, level });
                }
            }
        }
    }
}

fn name_child(nodes: &mut [Node], place: Place, child: usize) {
    if let Some((parent, k)) = place {
        nodes[parent].children[k] = Child::inner(child);
    }
}

/// What one thread builds.
struct Builder<'a> {
    primitives: &'a mut [BuildPrimitive],
    leaves: Leaves,
    scratch: &'a mut Scratch,
}

impl Builder<'_> {
    /// Adds the nodes of a range, its own first.
    fn add(&mut self, range: BuildRange, level: usize, nodes: &mut Vec<Node>) {
        let Self { primitives, leaves, scratch } = self;
        let opened = Opened::new(range, primitives, level, *leaves, scratch);
        let own = nodes.len();
        nodes.push(opened.node());
        for (k, &range) in opened.ranges().iter().enumerate() {
            if range.as_leaf().is_none() {
                nodes[own].children[k] = Child::inner(nodes.len());
                self.add(range, level + 1, nodes);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use glam::Vec3;
    use rtfarm_oracle::hard_case::HardCase;

    use super::{primitive::Bounds, *};
    use crate::prepared::node::MOST_LEVELS;

    const LEAVES: Leaves = Leaves { most: 4, alone_from: u32::MAX };

    fn primitives_of(boxes: &[([f32; 3], [f32; 3])]) -> Vec<BuildPrimitive> {
        let primitive = |(item, &(min, max))| BuildPrimitive::new(min, max, item);
        (0..).zip(boxes).map(primitive).collect()
    }

    fn check(boxes: &[([f32; 3], [f32; 3])]) -> Vec<Node> {
        let mut primitives = primitives_of(boxes);
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
    fn leaves_are_as_small_as_asked_and_costly_items_alone() {
        let mut primitives = primitives_of(&scattered(5000));
        let nodes = build_bvh(&mut primitives, Leaves { most: 4, alone_from: 4000 });
        for leaf in nodes.iter().flat_map(|node| node.children).filter(|child| child.is_leaf()) {
            let leaf = &primitives[leaf.items()];
            let is_costly = leaf.iter().any(|primitive| primitive.item() >= 4000);
            assert!(leaf.len() <= if is_costly { 1 } else { 4 });
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

    type Splitter = fn(&[BuildPrimitive]) -> (usize, usize);

    /// The cheapest of all splits between neighbours in the order of their centres: axis and place.
    fn swept_split(primitives: &[BuildPrimitive]) -> (usize, usize) {
        let mut best = (f32::INFINITY, 0, 0);
        for axis in 0..3 {
            let mut sorted = primitives.to_vec();
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
                if cost < best.0 {
                    best = (cost, axis, k);
                }
            }
        }
        (best.1, best.2)
    }

    /// The cost of a binary tree by the surface area heuristic, split by split, in areas of the
    /// root: with the builder's splits, or where `splitter` says.
    fn cost(
        primitives: &mut [BuildPrimitive],
        side: Side,
        splitter: Option<Splitter>,
        root_area: f64,
    ) -> f64 {
        let area = f64::from(side.bounds.half_area()) / root_area;
        if primitives.len() <= LEAVES.most {
            return area * primitives.len() as f64;
        }
        let (at, sides) = if let Some(splitter) = splitter {
            let (axis, at) = splitter(primitives);
            let middle = |primitive: &BuildPrimitive| primitive.0.twice_center()[axis];
            primitives.sort_by(|a, b| middle(a).total_cmp(&middle(b)));
            (at, [Side::of(&primitives[..at]), Side::of(&primitives[at..])])
        } else {
            split(primitives, &side, &mut Vec::new())
        };
        let (before, behind) = primitives.split_at_mut(at);
        area + cost(before, sides[0], splitter, root_area)
            + cost(behind, sides[1], splitter, root_area)
    }

    #[test]
    fn what_a_split_tells_of_its_sides_is_so() {
        let boxes = scattered(3000);
        let primitives = primitives_of(&boxes);
        for count in [2, 3, 5, 8, 9, 32, 33, 1000, 3000] {
            let mut primitives = primitives[..count].to_vec();
            let whole = Side::of(&primitives);
            let (at, sides) = split(&mut primitives, &whole, &mut Vec::new());
            let truth = [Side::of(&primitives[..at]), Side::of(&primitives[at..])];
            let corners = |bounds: &Bounds| [bounds.min.truncate(), bounds.max.truncate()];
            for (side, truth) in sides.iter().zip(&truth) {
                assert_eq!(side.count, truth.count);
                assert_eq!(corners(&side.bounds), corners(&truth.bounds));
                assert!(side.count <= 8 || corners(&side.centers) == corners(&truth.centers));
            }
            if count <= 8 {
                let best = swept_split(&primitives);
                let mut swept = primitives.clone();
                let middle = |primitive: &BuildPrimitive| primitive.0.twice_center()[best.0];
                swept.sort_by(|a, b| middle(a).total_cmp(&middle(b)));
                let cost = |primitives: &[BuildPrimitive]| {
                    Side::of(primitives).bounds.half_area() * primitives.len() as f32
                };
                let (found, least) = (
                    cost(&primitives[..at]) + cost(&primitives[at..]),
                    cost(&swept[..best.1]) + cost(&swept[best.1..]),
                );
                assert!(found <= least * (1.0 + 1e-5), "{count}: {found} {least}");
            }
            primitives.sort_by_key(BuildPrimitive::item);
            assert!(primitives.iter().map(BuildPrimitive::item).eq(0..count as u32));
        }
    }

    #[test]
    fn bins_cut_a_teapot_in_a_stadium_as_well_as_a_full_sweep() {
        // A stadium of 1, and in it a teapot of a millionth.
        let mut boxes = scattered(2000);
        let shrunk = |point: [f32; 3]| point.map(|x| x * 1e-6);
        let teapot = scattered(2000).into_iter().map(|(min, max)| (shrunk(min), shrunk(max)));
        boxes.extend(teapot);
        let primitives = primitives_of(&boxes);
        let cost_of = |splitter| {
            let mut primitives = primitives.clone();
            let side = Side::of(&primitives);
            cost(&mut primitives, side, splitter, f64::from(side.bounds.half_area()))
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
            let mut primitives = primitives_of(&boxes);
            let nodes = pool.install(|| build_bvh(&mut primitives, LEAVES));
            let order: Vec<u32> = primitives.iter().map(BuildPrimitive::item).collect();
            (nodes, order)
        };
        let one = build(1);
        assert!(one == build(2) && one == build(5));
    }
}
