//! Rays side by side near a solid, and what kernels find of them there.

use glam::DVec3;

use super::{
    lanes::{Beam, LANES, RayGroup, Turn, larger, smaller},
    ray::Ray,
    sphere::{hit_sphere, hit_sphere_again},
};
use crate::prepared::{
    node::Node,
    record::{BoxPlanes, LeafRecord, SolidRecord, Surface},
};

/// The least cosine at which a leaf is met for sure: a crossing's doubt is then so small a part of
/// the solid's margin that all together stay below half of it.
pub(super) const STEEP: f64 = 1.0 / (1 << 16) as f64;

/// The most leaves that are met.
pub(super) const MOST_LEAVES: usize = 32;

/// A leaf that rays pass by is entered and left here.
pub(super) const NOWHERE: [f64; 2] = [f64::INFINITY, f64::NEG_INFINITY];

/// Rays on their courses, as a `Course` has one.
#[derive(Debug, Clone, Copy)]
#[repr(C, align(64))]
pub(super) struct SolidRays {
    /// They start where the courses do, in the order x, y, z, and reach as far from there; boxes
    /// are those of the solid's frame. It has no slopes.
    pub(super) near: RayGroup,
    /// Boxes that they leave before this do not count.
    pub(super) low: [f32; LANES],
    /// The rays themselves start here on their courses.
    pub(super) left_at: [f64; LANES],
    /// The numbers of the surfaces that they leave.
    pub(super) leaving: [f64; LANES],
}

/// What the rays of some groups have near a solid, as a `Beam` has it.
#[derive(Debug, Clone, Copy)]
pub(super) struct SolidBeam {
    pub(super) beam: Beam,
    /// The least.
    pub(super) low: f32,
}

/// Which rays are where, a bit each.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct Met {
    /// They are inside the leaf somewhere.
    pub(super) met: u64,
    /// Doubts might count there.
    pub(super) in_doubt: u64,
}

impl SolidRays {
    pub(super) const EMPTY: Self = Self {
        near: RayGroup::EMPTY,
        low: [0.0; LANES],
        left_at: [0.0; LANES],
        leaving: [0.0; LANES],
    };
}

impl SolidRays {
    /// A ray on its course, for which only its start, its direction and the surface that it leaves
    /// count.
    #[inline(always)]
    pub(super) fn ray(&self, lane: usize) -> Ray {
        let RayGroup { origin: [x, y, z], direction: [dx, dy, dz], leaving, .. } = &self.near;
        Ray {
            origin: DVec3::new(x[lane], y[lane], z[lane]),
            direction: DVec3::new(dx[lane], dy[lane], dz[lane]),
            leaving: Surface(leaving[lane]),
            ..Ray::NOWHERE
        }
    }
}

/// `BoxKernel::approach` in plain Rust.
#[inline(always)]
pub(super) fn approach(
    rays: &mut SolidRays,
    (group, turn): (&RayGroup, &Turn),
    solid: &SolidRecord,
) -> bool {
    let SolidRays { near, low, left_at, leaving } = rays;
    for (axis, starts) in turn.axes.into_iter().zip(&group.origin) {
        near.origin[axis % 3] = *starts;
    }
    (near.direction, near.leaving) = (group.direction, group.leaving);
    (near.inverse, near.far_inverse) = (group.inverse, group.far_inverse);
    let (middle, scale) = (&solid.frame.origin, solid.frame.scale);
    let ([x, y, z], [dx, dy, dz]) = (&near.origin, &near.direction);
    let mut starts = [0.0; LANES];
    for lane in 0..LANES {
        let ahead = (middle[0] - x[lane]) * dx[lane]
            + (middle[1] - y[lane]) * dy[lane]
            + (middle[2] - z[lane]) * dz[lane];
        starts[lane] = if ahead.abs() * scale > 8.0 { ahead } else { 0.0 };
    }
    for (axis, middle) in middle.iter().enumerate() {
        let (origins, directions) = (&mut near.origin[axis], &near.direction[axis]);
        let forward = turn.is_forward[axis];
        for lane in 0..LANES {
            origins[lane] += starts[lane] * directions[lane];
            let place = ((origins[lane] - middle) * scale) as f32;
            let [low, high] = [place - slack(place), place + slack(place)];
            near.near_origin[axis][lane] = if forward { high } else { low };
            near.far_origin[axis][lane] = if forward { low } else { high };
        }
    }
    let mut any_leaves = false;
    for lane in 0..LANES {
        left_at[lane] = -starts[lane];
        near.reach[lane] = group.reach[lane] - starts[lane];
        let first = ((left_at[lane] - 2.0 * solid.margin) * scale) as f32;
        low[lane] = first - slack(first);
        let last = ((near.reach[lane] + 2.0 * solid.margin) * scale) as f32;
        near.high[lane] = last + slack(last);
        leaving[lane] = f64::from(group.leaving[lane]);
        any_leaves |= group.leaving[lane] != Surface::NONE.0;
    }
    any_leaves
}

/// More than rounding to f32 takes from a number.
fn slack(number: f32) -> f32 {
    SLACK * number.abs() + LEAST_SLACK
}

pub(super) const SLACK: f32 = 2.0 * f32::EPSILON;
pub(super) const LEAST_SLACK: f32 = 1e-25;

/// The part of the squared radius by which rounding may move a ray that touches a sphere, and more.
pub(super) const TOUCHED: f64 = 1.0 + 1e-12;

/// `BoxKernel::meet_ball` in plain Rust.
#[inline(always)]
pub(super) fn meet_ball(
    rays: &SolidRays,
    leaf: &LeafRecord,
    (any_leaves, apart): (bool, f64),
    [enters, exits]: &mut [[f64; LANES]; 2],
) -> Met {
    let mut met = Met::default();
    let least = least_chord(leaf, apart);
    for lane in 0..LANES {
        let ray = rays.ray(lane);
        let center = DVec3::from_array(leaf.center);
        let [enter, exit] = if any_leaves && ray.leaving == Surface(leaf.surface) {
            // What starts far off is left to who knows where that is.
            met.in_doubt |= u64::from(rays.left_at[lane] != 0.0) << lane;
            let again = hit_sphere_again(&ray, center);
            [if again < 0.0 { again } else { 0.0 }, if again > 0.0 { again } else { 0.0 }]
        } else {
            hit_sphere(&ray, center, leaf.radius).unwrap_or(NOWHERE)
        };
        let is_met = enter < exit;
        met.met |= u64::from(is_met) << lane;
        met.in_doubt |= u64::from(is_met && exit - enter <= least) << lane;
        [enters[lane], exits[lane]] = if is_met { [enter, exit] } else { NOWHERE };
    }
    met
}

/// Rays that are inside a sphere no longer than this are in doubt.
#[inline(always)]
pub(super) fn least_chord(leaf: &LeafRecord, apart: f64) -> f64 {
    let grazing = STEEP * 2.0 * leaf.radius;
    if grazing > apart { grazing } else { apart }
}

/// `BoxKernel::surround_near` in plain Rust.
#[inline(always)]
pub(super) fn surround_near(rays: &[SolidRays], is_forward: [bool; 3]) -> SolidBeam {
    let mut low = f32::INFINITY;
    for lows in rays.iter().map(|rays| &rays.low) {
        for &of_lane in lows {
            low = smaller(of_lane, low);
        }
    }
    let mut beam = Beam::EMPTY;
    beam.high = f32::NEG_INFINITY;
    for (axis, forward) in is_forward.into_iter().enumerate() {
        let mut starts = if forward {
            [f32::NEG_INFINITY, f32::INFINITY]
        } else {
            [f32::INFINITY, f32::NEG_INFINITY]
        };
        let mut inverses = [f32::INFINITY, f32::NEG_INFINITY];
        for group in rays.iter().map(|rays| &rays.near) {
            for lane in 0..LANES {
                let [near, far] = [group.near_origin[axis][lane], group.far_origin[axis][lane]];
                starts = if forward {
                    [larger(near, starts[0]), smaller(far, starts[1])]
                } else {
                    [smaller(near, starts[0]), larger(far, starts[1])]
                };
                let inverse = group.inverse[axis][lane];
                inverses = [smaller(inverse, inverses[0]), larger(inverse, inverses[1])];
                beam.high = larger(group.high[lane], beam.high);
            }
        }
        beam.set_axis((axis, forward), starts, inverses);
    }
    SolidBeam { beam, low }
}

/// `BoxKernel::touch_beam` in plain Rust.
#[inline(always)]
pub(super) fn touch_beam(node: &Node, SolidBeam { beam, low }: &SolidBeam) -> u32 {
    let mut mask = 0;
    for child in 0..node.children.len() {
        let (mut enter, mut leave) = (*low, beam.high);
        for axis in 0..3 {
            let near = node.planes[beam.near[axis]][child] - beam.near_origin[axis];
            let far = node.planes[beam.far[axis]][child] - beam.far_origin[axis];
            let [a, b] = beam.inverse[axis];
            enter = larger(smaller(near * a, near * b), enter);
            let [a, b] = beam.far_inverse[axis];
            leave = smaller(larger(far * a, far * b), leave);
        }
        mask |= u32::from(enter <= leave) << child;
    }
    mask
}

/// What the rays are to what comes next.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct Seen {
    /// Their next end is within reach.
    pub(super) ahead: u64,
    /// It may be in one doubt with where they are.
    pub(super) near: u64,
}

/// `BoxKernel::touch` in plain Rust.
#[inline(always)]
pub(super) fn touch(
    rays: &[SolidRays],
    (groups, asking): (&[(usize, u8)], u8),
    [near, far]: [[f32; 3]; 2],
) -> u8 {
    let mut touching = 0;
    for (k, (rays, (_, of_group))) in rays.iter().zip(groups).enumerate() {
        let group = &rays.near;
        let mut met = 0;
        for lane in 0..LANES {
            let (mut enter, mut leave) = (rays.low[lane], group.high[lane]);
            for axis in 0..3 {
                let to_near = near[axis] - group.near_origin[axis][lane];
                let to_far = far[axis] - group.far_origin[axis][lane];
                enter = larger(to_near * group.inverse[axis][lane], enter);
                leave = smaller(to_far * group.far_inverse[axis][lane], leave);
            }
            met |= u8::from(enter <= leave) << lane;
        }
        touching |= u8::from(met & of_group != 0) << k;
    }
    touching & asking
}

/// `BoxKernel::meet_box` in plain Rust.
#[inline(always)]
pub(super) fn meet_box(
    rays: &SolidRays,
    planes: &BoxPlanes,
    (any_leaves, apart): (bool, f64),
    [enters, exits]: &mut [[f64; LANES]; 2],
) -> Met {
    let ([x, y, z], [dx, dy, dz]) = (&rays.near.origin, &rays.near.direction);
    let ([px, py, pz], [nx, ny, nz]) = (&planes.points, &planes.normals);
    let mut met = Met::default();
    for lane in 0..LANES {
        let (mut enter, mut leave, mut least) = (f64::NEG_INFINITY, f64::INFINITY, f64::INFINITY);
        for face in 0..6 {
            let to = [px[face] - x[lane], py[face] - y[lane], pz[face] - z[lane]];
            let distance = nx[face] * to[0] + ny[face] * to[1] + nz[face] * to[2];
            let along = nx[face] * dx[lane] + ny[face] * dy[lane] + nz[face] * dz[lane];
            let is_left = any_leaves && planes.surfaces[face] == rays.leaving[lane];
            let t = if is_left { rays.left_at[lane] } else { distance / along };
            if along.is_sign_negative() {
                enter = if t > enter { t } else { enter };
            } else {
                leave = if t < leave { t } else { leave };
            }
            let cosine = along.abs();
            least = if cosine < least { cosine } else { least };
        }
        let is_met = enter < leave;
        let is_sure = least >= STEEP && leave - enter > apart;
        met.met |= u64::from(is_met) << lane;
        met.in_doubt |= u64::from((is_met && !is_sure) || least == 0.0) << lane;
        [enters[lane], exits[lane]] = if is_met { [enter, leave] } else { NOWHERE };
    }
    met
}

/// `BoxKernel::look` in plain Rust.
#[inline(always)]
pub(super) fn look(
    ends: &[[[f64; LANES]; 2]],
    (at, reach, apart): (&[f64; LANES], &[f64; LANES], f64),
    inside: &mut [u8; MOST_LEAVES],
    next: &mut [f64; LANES],
) -> Seen {
    *next = [f64::INFINITY; LANES];
    for ([enters, exits], inside) in ends.iter().zip(inside) {
        *inside = 0;
        for lane in 0..LANES {
            let is_before = enters[lane] > at[lane];
            let is_behind = exits[lane] <= at[lane];
            let end = if is_behind { f64::INFINITY } else { exits[lane] };
            let end = if is_before { enters[lane] } else { end };
            next[lane] = if end < next[lane] { end } else { next[lane] };
            *inside |= u8::from(!is_before && !is_behind) << lane;
        }
    }
    let mut seen = Seen::default();
    for lane in 0..LANES {
        let is_ahead = next[lane] <= reach[lane] && next[lane] < f64::INFINITY;
        seen.ahead |= u64::from(is_ahead) << lane;
        seen.near |= u64::from(next[lane] - at[lane] <= apart) << lane;
    }
    seen
}
