//! Rays side by side, a lane each, and the tests that several of them take at once.

use super::{
    box_ray::{BoxRay, FAR, LEAST_SLACK, NEAR_FRAME, SLACK},
    ray::{Projected, Ray, Shear, depth_axis, edge},
};
use crate::prepared::node::{Frame, Node};

/// Rays of one class have the signs of their direction in common, and its largest component.
/// Classes are numbered from 0 up to this, which is the class of a ray that can be in no packet.
pub(super) const CLASSES: usize = 3 * 8;

/// A direction's component of this size lets the ray move along the axis.
pub(super) const LEAST_COMPONENT: f64 = 1e-30;

/// Rays that are tested at once.
pub(super) const LANES: usize = 8;

/// Groups of [`LANES`] rays.
pub(super) const GROUPS: usize = 8;

/// Triangles that one ray is tried on at once.
pub(super) const FACES: usize = 4;

/// The most rays: a bit each in a mask.
pub(super) const MOST_RAYS: usize = LANES * GROUPS;

/// What [`LANES`] rays are to boxes, as a `BoxRay` has it, and to flat faces, as a [`Shear`] has
/// it.
#[derive(Debug, Clone, Copy)]
#[repr(C, align(64))]
pub(super) struct RayGroup {
    /// In the order of the axes of the rays' [`Shear`].
    pub(super) origin: [[f64; LANES]; 3],
    pub(super) slopes: [[f64; LANES]; 3],
    /// The first two, rounded.
    pub(super) rounded_slopes: [[f32; LANES]; 2],
    /// In the order x, y, z.
    pub(super) direction: [[f64; LANES]; 3],
    /// The surface that a ray leaves, and the rank of what it went through.
    pub(super) leaving: [u32; LANES],
    pub(super) after: [u32; LANES],
    /// Only what is met nearer than this counts.
    pub(super) reach: [f64; LANES],
    pub(super) near_origin: [[f32; LANES]; 3],
    pub(super) far_origin: [[f32; LANES]; 3],
    pub(super) inverse: [[f32; LANES]; 3],
    pub(super) far_inverse: [[f32; LANES]; 3],
    pub(super) high: [f32; LANES],
    /// Where a ray starts and where it ends, as depths behind the packet's [`Focus`] on the ray's
    /// way: what gates compare. Only `BoxKernel::find_ends` fills it.
    pub(super) ends: [[f32; LANES]; 2],
}

impl RayGroup {
    pub(super) const EMPTY: Self = Self {
        origin: [[0.0; LANES]; 3],
        slopes: [[0.0; LANES]; 3],
        rounded_slopes: [[0.0; LANES]; 2],
        direction: [[0.0; LANES]; 3],
        leaving: [0; LANES],
        after: [0; LANES],
        reach: [0.0; LANES],
        near_origin: [[0.0; LANES]; 3],
        far_origin: [[0.0; LANES]; 3],
        inverse: [[0.0; LANES]; 3],
        far_inverse: [[0.0; LANES]; 3],
        high: [0.0; LANES],
        ends: [[0.0; LANES]; 2],
    };
}

/// How rays of one class become those of a [`RayGroup`].
#[derive(Debug, Clone, Copy)]
pub(super) struct Turn {
    /// The frame of the boxes.
    pub(super) frame: Frame,
    /// How distances are turned into that frame.
    pub(super) reach: BoxRay,
    /// On which axes the rays go forward.
    pub(super) is_forward: [bool; 3],
    /// The axes of each [`Shear`].
    pub(super) axes: [usize; 3],
}

impl Turn {
    /// The turn of rays of the class of `ray`, which is in a class.
    pub(super) fn new(ray: &Ray, frame: &Frame) -> Self {
        Self {
            frame: *frame,
            reach: BoxRay::near_frame(frame),
            is_forward: ray.direction.to_array().map(|d| d > 0.0),
            axes: Shear::new(ray.origin, ray.direction).axes,
        }
    }
}

/// Intervals that hold what the rays of some groups have.
#[derive(Debug, Clone, Copy)]
pub(super) struct Beam {
    /// Which of a node's planes is met first on each axis, and which last.
    pub(super) near: [usize; 3],
    pub(super) far: [usize; 3],
    /// The start that is nearest to a near plane, and the one that is farthest from a far plane.
    pub(super) near_origin: [f32; 3],
    pub(super) far_origin: [f32; 3],
    /// The least and the greatest.
    pub(super) inverse: [[f32; 2]; 3],
    pub(super) far_inverse: [[f32; 2]; 3],
    /// How far the farthest ray reaches.
    pub(super) high: f32,
}

impl Beam {
    pub(super) const EMPTY: Self = Self {
        near: [0; 3],
        far: [0; 3],
        near_origin: [0.0; 3],
        far_origin: [0.0; 3],
        inverse: [[0.0; 2]; 3],
        far_inverse: [[0.0; 2]; 3],
        high: 0.0,
    };

    /// No ray starts farther from the frame's origin along an axis.
    #[inline(always)]
    pub(super) fn farthest_start(&self) -> f32 {
        let sizes = self.near_origin.iter().chain(&self.far_origin).map(|place| place.abs());
        sizes.fold(0.0, f32::max)
    }

    /// Takes in what its rays have on an axis, on which they go forward or not.
    #[inline(always)]
    pub(super) fn set_axis(
        &mut self,
        (axis, forward): (usize, bool),
        [near_origin, far_origin]: [f32; 2],
        inverse: [f32; 2],
    ) {
        (self.near[axis], self.far[axis]) =
            if forward { (axis, axis + 3) } else { (axis + 3, axis) };
        (self.near_origin[axis], self.far_origin[axis]) = (near_origin, far_origin);
        // Rounding keeps order.
        let [least, greatest] = inverse;
        (self.inverse[axis], self.far_inverse[axis]) = (inverse, [least * FAR, greatest * FAR]);
    }
}

/// A point that the lines of all rays of a packet pass, near enough to tell from it which of them
/// certainly pass by a triangle: where camera rays start, or where shadow rays end.
#[derive(Debug, Clone, Copy)]
pub(super) struct Focus {
    /// In the order of the axes of the rays' [`Shear`].
    pub(super) point: [f64; 3],
    /// How far lines pass by it, at its depth, along the first or the second axis.
    pub(super) spread: f64,
    /// Differences of coordinates, as seen from starts and from the point, are at most this.
    pub(super) most: f64,
    /// What f64 rounding may take from twice an area.
    pub(super) blur: f64,
}

impl Focus {
    /// A point for rays that start within `farthest` of the frame's origin on each axis, in its
    /// units, with the axes of their [`Shear`]; `spread` is as `BoxKernel::spread` finds it.
    pub(super) fn new(
        point: [f64; 3],
        spread: f64,
        (frame, farthest): (&Frame, f32),
        axes: [usize; 3],
    ) -> Self {
        let mut most = (f64::from(farthest) + 2.0) / frame.scale;
        for (at, axis) in point.into_iter().zip(axes) {
            most += (at - frame.origin[axis]).abs();
        }
        Self { point, spread, most, blur: most * most * BLUR }
    }
}

/// See `docs/proof.md`, boxes.
const BLUR: f64 = 1.0 / (1_u64 << 44) as f64;

/// What decides in f32 whether rays certainly pass by a triangle: twice the areas of (ray, a, b),
/// (ray, b, c) and (ray, c, a) as a ray through the focus sees them are linear in its slopes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Sieve {
    /// The factors of the first slope, of the second one and of 1, for each edge; the last edge is
    /// the first once more.
    pub(super) factors: [[f32; 4]; 3],
    /// An area that is further than this from 0 has the sign that `edge` finds.
    pub(super) bound: f32,
}

/// What f32 rounding takes from twice an area, as a part of its factors: see `docs/proof.md`,
/// boxes.
pub(super) const SIEVED: f64 = 8.0 / (1_u64 << 24) as f64;

/// What rays are to a triangle, a bit each.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct Crossings {
    /// They may cross it: of the others two edge functions have opposite signs.
    pub(super) possible: u64,
    /// They cross it for certain, and their distances are known.
    pub(super) certain: u64,
    /// They do so in front of their starts and within their reach. Of one ray before several
    /// triangles this is not asked.
    pub(super) within: u64,
}

/// The bits of a mask.
#[inline(always)]
pub(super) fn places(mut mask: u64) -> impl Iterator<Item = usize> {
    std::iter::from_fn(move || {
        let place = mask.trailing_zeros() as usize;
        (mask != 0).then(|| {
            mask &= mask - 1;
            place % MOST_RAYS
        })
    })
}

/// The groups in which a mask has rays, each with its part of the mask.
#[inline(always)]
pub(super) fn groups(mut mask: u64) -> impl Iterator<Item = (usize, u64)> {
    std::iter::from_fn(move || {
        let k = mask.trailing_zeros() as usize / LANES % GROUPS;
        let asking = mask >> (LANES * k) & 0xFF;
        mask &= !(0xFF << (LANES * k));
        (asking != 0).then_some((k, asking))
    })
}

/// The smaller number as the SIMD instructions have it: of a NaN and a number, the second operand.
#[inline(always)]
pub(super) fn smaller(a: f32, b: f32) -> f32 {
    if a < b { a } else { b }
}

/// The larger number in the same way.
#[inline(always)]
pub(super) fn larger(a: f32, b: f32) -> f32 {
    if a > b { a } else { b }
}

/// The rays of a mask for which `test` of their group says so.
#[inline(always)]
pub(super) fn by_groups(mask: u64, mut test: impl FnMut(usize) -> u64) -> u64 {
    let mut met = 0;
    for group in 0..GROUPS {
        let asking = mask >> (LANES * group) & 0xFF;
        if asking != 0 {
            met |= (test(group) & asking) << (LANES * group);
        }
    }
    met
}

/// The class of a ray: [`CLASSES`] for one that along some axis as good as stands still, or starts
/// nowhere or far from the frame.
#[inline(always)]
pub(super) fn class_of(ray: &Ray, frame: &Frame) -> u64 {
    let [o, d] = [ray.origin.to_array(), ray.direction.to_array()];
    let mut class = 8 * depth_axis(d) as u64;
    let mut distance = 0.0;
    let mut is_plain = true;
    for axis in 0..3 {
        let relative = (o[axis] - frame.origin[axis]) * frame.scale;
        distance += relative * relative;
        is_plain &= d[axis].abs() >= LEAST_COMPONENT;
        class |= u64::from(d[axis] > 0.0) << axis;
    }
    if is_plain && distance <= NEAR_FRAME * NEAR_FRAME { class } else { CLASSES as u64 }
}

/// `BoxKernel::fill` in plain Rust.
#[inline(always)]
pub(super) fn fill(group: &mut RayGroup, rays: [&Ray; LANES], turn: &Turn) {
    for (lane, ray) in rays.into_iter().enumerate() {
        for axis in 0..3 {
            let relative = (ray.origin[axis] - turn.frame.origin[axis]) * turn.frame.scale;
            let place = relative as f32;
            let slack = SLACK * place.abs() + LEAST_SLACK;
            let (low, high) = (place - slack, place + slack);
            let (near, far) = if turn.is_forward[axis] { (high, low) } else { (low, high) };
            group.near_origin[axis][lane] = near;
            group.far_origin[axis][lane] = far;
            let inverse = (1.0 / ray.direction[axis]) as f32;
            group.inverse[axis][lane] = inverse;
            group.far_inverse[axis][lane] = inverse * FAR;
            group.origin[axis][lane] = ray.origin[turn.axes[axis]];
            group.direction[axis][lane] = ray.direction[axis];
        }
        group.leaving[lane] = ray.leaving.0;
        group.after[lane] = ray.after;
        let [x, y, z] = turn.axes.map(|axis| ray.direction[axis]);
        group.slopes[0][lane] = x / z;
        group.slopes[1][lane] = y / z;
        group.slopes[2][lane] = 1.0 / z;
        for (rounded, slope) in group.rounded_slopes.iter_mut().zip([x / z, y / z]) {
            rounded[lane] = slope as f32;
        }
        group.reach[lane] = ray.reach;
        group.high[lane] = turn.reach.reach(ray.reach);
    }
}

/// `BoxKernel::shorten` in plain Rust.
#[inline(always)]
pub(super) fn shorten(group: &mut RayGroup, turn: &Turn) {
    for (high, &reach) in group.high.iter_mut().zip(&group.reach) {
        *high = smaller(turn.reach.reach(reach), *high);
    }
}

/// Which end of an interval is wanted: the least or the greatest number.
#[inline(always)]
fn end_of<'a>(rows: impl Iterator<Item = &'a [f32; LANES]>, is_greatest: bool) -> f32 {
    let (start, keep): (_, fn(f32, f32) -> f32) =
        if is_greatest { (f32::NEG_INFINITY, larger) } else { (f32::INFINITY, smaller) };
    let mut ends = [start; LANES];
    for row in rows {
        for (end, &x) in ends.iter_mut().zip(row) {
            *end = keep(x, *end);
        }
    }
    // As instructions that halve a vector have it.
    let [a, b, c, d, e, f, g, h] = ends;
    keep(keep(keep(a, e), keep(c, g)), keep(keep(b, f), keep(d, h)))
}

/// `BoxKernel::surround` in plain Rust.
#[inline(always)]
pub(super) fn surround(groups: &[RayGroup], is_forward: [bool; 3]) -> Beam {
    let mut beam = Beam::EMPTY;
    beam.high = end_of(groups.iter().map(|group| &group.high), true);
    for (axis, forward) in is_forward.into_iter().enumerate() {
        let inverses = || groups.iter().map(|group| &group.inverse[axis]);
        let near_origins = groups.iter().map(|group| &group.near_origin[axis]);
        let far_origins = groups.iter().map(|group| &group.far_origin[axis]);
        beam.set_axis(
            (axis, forward),
            [end_of(near_origins, forward), end_of(far_origins, !forward)],
            [end_of(inverses(), false), end_of(inverses(), true)],
        );
    }
    beam
}

/// `BoxKernel::enter` in plain Rust.
#[inline(always)]
pub(super) fn enter<const ONE: bool>(
    groups: &[RayGroup; GROUPS],
    [near, far]: [[f32; 3]; 2],
    mask: u64,
) -> u64 {
    by_groups(mask, |group| {
        let group = &groups[group];
        let mut met = 0;
        for lane in 0..LANES {
            let (mut enter, mut leave) = (-0.0, group.high[lane]);
            for axis in 0..3 {
                let (mut to_near, mut to_far) = (near[axis], far[axis]);
                if !ONE {
                    to_near -= group.near_origin[axis][lane];
                    to_far -= group.far_origin[axis][lane];
                }
                enter = larger(to_near * group.inverse[axis][lane], enter);
                leave = smaller(to_far * group.far_inverse[axis][lane], leave);
            }
            met |= u64::from(enter <= leave) << lane;
        }
        met
    })
}

/// `BoxKernel::spread` in plain Rust.
#[inline(always)]
pub(super) fn spread(groups: &[RayGroup], point: &[f64; 3]) -> f64 {
    let mut spread: f64 = 0.0;
    for group in groups {
        for lane in 0..LANES {
            let seen = shear_at(group, lane, [0, 1, 2]).project(point);
            spread = spread.max(seen.x.abs()).max(seen.y.abs());
        }
    }
    spread
}

/// `BoxKernel::sieve` in plain Rust.
#[inline(always)]
pub(super) fn sieve(corners: &[[f64; 3]; 3], focus: &Focus) -> Sieve {
    let mut seen = [[0.0; 3]; 3];
    for (seen, corner) in seen.iter_mut().zip(corners) {
        for axis in 0..3 {
            seen[axis] = corner[axis] - focus.point[axis];
        }
    }
    let mut sieve = Sieve { factors: [[0.0; 4]; 3], bound: 0.0 };
    let mut bound: f64 = 0.0;
    for edge in 0..4 {
        let ([ax, ay, az], [bx, by, bz]) = (seen[edge % 3], seen[(edge + 1) % 3]);
        let factors = [ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx];
        for (factors, factor) in sieve.factors.iter_mut().zip(factors) {
            factors[edge] = factor as f32;
        }
        let [x, y, z] = sieve.factors.map(|factors| factors[edge].abs());
        let length = (bx - ax).abs() + (by - ay).abs() + (bz - az).abs();
        bound = bound.max(f64::from(x + y + z) * SIEVED + length * (2.0 * focus.spread));
    }
    sieve.bound = bounded(bound, focus);
    sieve
}

/// The bound of a [`Sieve`] from what its edges have.
#[inline(always)]
pub(super) fn bounded(of_edges: f64, focus: &Focus) -> f32 {
    ((of_edges + focus.blur) * 1.001) as f32 + f32::MIN_POSITIVE
}

/// `BoxKernel::sift` in plain Rust.
#[inline(always)]
pub(super) fn sift<const CERTAIN: bool>(
    groups: &[RayGroup; GROUPS],
    sieve: &Sieve,
    mask: u64,
) -> [u64; 2] {
    let Sieve { factors: [first, second, last], bound } = sieve;
    let mut certain = 0;
    let possible = by_groups(mask, |k| {
        let [right, up] = &groups[k].rounded_slopes;
        let mut possible = 0;
        for lane in 0..LANES {
            let area =
                |edge: usize| (last[edge] + right[lane] * first[edge]) + up[lane] * second[edge];
            let areas = [area(0), area(1), area(2)];
            let is_past =
                areas.iter().any(|area| *area < -bound) && areas.iter().any(|area| area > bound);
            possible |= u64::from(!is_past) << lane;
            let is_certain =
                areas.iter().all(|area| *area < -bound) || areas.iter().all(|area| area > bound);
            certain |= u64::from(CERTAIN && is_certain) << (LANES * k + lane);
        }
        possible
    });
    [possible, certain & mask]
}

/// `BoxKernel::meet_beam` in plain Rust.
#[inline(always)]
pub(super) fn meet_beam(node: &Node, beam: &Beam) -> ([f32; 8], u32, u32) {
    let mut distances = [-0.0; 8];
    let (mut mask, mut within) = (0, 0);
    for (child, enter) in distances.iter_mut().enumerate() {
        let mut leave = beam.high;
        let (mut all_enter, mut first_leaves) = (-0.0, leave);
        for axis in 0..3 {
            let near = node.planes[beam.near[axis]][child] - beam.near_origin[axis];
            let far = node.planes[beam.far[axis]][child] - beam.far_origin[axis];
            let [a, b] = beam.inverse[axis];
            *enter = larger(smaller(near * a, near * b), *enter);
            // The start that is nearest to a far plane is farthest from a near one.
            let last = node.planes[beam.near[axis]][child] - beam.far_origin[axis];
            all_enter = larger(larger(last * a, last * b), all_enter);
            let [a, b] = beam.far_inverse[axis];
            leave = smaller(larger(far * a, far * b), leave);
            let first = node.planes[beam.far[axis]][child] - beam.near_origin[axis];
            first_leaves = smaller(smaller(first * a, first * b), first_leaves);
        }
        mask |= u32::from(*enter <= leave) << child;
        within |= u32::from(all_enter <= first_leaves) << child;
    }
    (distances, mask, within)
}

/// `BoxKernel::cross` in plain Rust.
#[inline(always)]
pub(super) fn cross(
    groups: &[RayGroup; GROUPS],
    corners: &[[f64; 3]; 3],
    mask: u64,
    distances: &mut [[f64; LANES]; GROUPS],
) -> Crossings {
    let (mut certain, mut within) = (0, 0);
    let possible = by_groups(mask, |k| {
        let group = &groups[k];
        let mut possible = 0;
        for (lane, distance) in distances[k].iter_mut().enumerate() {
            let shear = shear_at(group, lane, [0, 1, 2]);
            let crossing = cross_seen(&shear.project_all(corners), distance);
            possible |= crossing.possible << lane;
            certain |= crossing.certain << (LANES * k + lane);
            let is_within = *distance > 0.0 && *distance <= group.reach[lane];
            within |= (crossing.certain & u64::from(is_within)) << (LANES * k + lane);
        }
        possible
    });
    Crossings { possible, certain: certain & mask, within: within & mask }
}

/// `BoxKernel::cross_four` in plain Rust.
#[inline(always)]
pub(super) fn cross_four(
    shear: &Shear,
    corners: &[[&[f64; 3]; 3]; FACES],
    distances: &mut [f64; FACES],
) -> Crossings {
    let mut crossings = Crossings::default();
    for (lane, (corners, distance)) in corners.iter().zip(distances).enumerate() {
        let crossing = cross_seen(&shear.project_all(&corners.map(|corner| *corner)), distance);
        crossings.possible |= crossing.possible << lane;
        crossings.certain |= crossing.certain << lane;
    }
    crossings
}

/// What one ray is to a triangle that it sees so: a bit each. Writes the distance if it crosses it
/// for certain.
#[inline(always)]
fn cross_seen([a, b, c]: &[Projected; 3], distance: &mut f64) -> Crossings {
    let over = [edge(b, c), edge(c, a), edge(a, b)];
    let is_any = |is: fn(f64) -> bool| over.into_iter().any(is);
    if is_any(|w| w < 0.0) && is_any(|w| w > 0.0) {
        return Crossings::default();
    }
    let extent = [a, b, c].iter().map(|p| p.x.abs().max(p.y.abs())).fold(0.0, f64::max);
    let area = over[0] + over[1] + over[2];
    if over.contains(&0.0) || area.abs() <= extent * extent / 8.0 {
        return Crossings { possible: 1, ..Crossings::default() };
    }
    let t = (over[0] * a.z + over[1] * b.z + over[2] * c.z) / area;
    let (least, most) = (a.z.min(b.z).min(c.z), a.z.max(b.z).max(c.z));
    *distance = t.max(least).min(most);
    Crossings { possible: 1, certain: 1, within: 0 }
}

/// What a lane holds, as a [`Shear`] with these axes.
#[inline(always)]
pub(super) fn shear_at(group: &RayGroup, lane: usize, axes: [usize; 3]) -> Shear {
    let mut shear = Shear { axes, origin: [0.0; 3], slopes: [0.0; 3] };
    for axis in 0..3 {
        shear.origin[axis] = group.origin[axis][lane];
        shear.slopes[axis] = group.slopes[axis][lane];
    }
    shear
}
