//! Rays that go alone: each on its own way through the hierarchy, several by turns, so that what
//! one fetches is on its way while others are at work, and each on four triangles of a leaf at
//! once.
//!
//! Source of the turns: Kocberber, Falsafi & Grot, "Asynchronous Memory Access Chaining" (2015).

use super::{
    box_ray::BoxRay,
    boxes::{BoxKernel, KernelWork},
    lanes::FACES,
    meeting::Meeting,
    ray::{Ray, Shear},
    traversal::Traversal,
};
use crate::prepared::{
    layout::View,
    node::{Child, Node},
};

/// Rays on their way at a time.
const FLIGHTS: usize = 16;

/// So many vertices do not fit in the nearer caches.
const MANY_VERTICES: usize = 1 << 17;

/// A ray on its way.
#[derive(Debug, bytemuck::Zeroable)]
struct Flight {
    traversal: Traversal,
    shear: Shear,
    /// Its place among the members.
    place: usize,
    /// Whether the corners of the leaf that comes next have been asked for.
    awaits_corners: bool,
}

/// Room for rays on their way and for a node.
#[derive(Debug, bytemuck::Zeroable)]
pub(super) struct Flights([Flight; FLIGHTS], Node);

impl Flight {
    #[inline(always)]
    fn start(&mut self, ray: &Ray, place: usize, view: &View<'_>) {
        let box_ray = BoxRay::new(ray.origin, ray.direction, ray.reach, &view.header.frame);
        self.traversal.start(box_ray, Child::ROOT);
        self.shear = Shear::new(ray.origin, ray.direction);
        self.place = place;
        self.awaits_corners = false;
    }
}

/// Takes the `members` of `rays` through the hierarchy, each alone.
#[inline(always)]
pub(super) fn visit_alone(
    kernel: impl BoxKernel,
    view: &View<'_>,
    (rays, members): (&[Ray], &[u16]),
    flights: &mut Option<Box<Flights>>,
    meeting: &mut impl Meeting,
) {
    if !members.is_empty() {
        let flights = flights.get_or_insert_with(bytemuck::zeroed_box);
        kernel.run(view, &mut Alone { rays, members, flights, meeting });
    }
}

/// Rays that go alone, in a function of their own: in one with packets either would be slower for
/// the registers that the other takes.
struct Alone<'a, M> {
    rays: &'a [Ray],
    members: &'a [u16],
    flights: &'a mut Flights,
    meeting: &'a mut M,
}

impl<M: Meeting> KernelWork<View<'_>> for Alone<'_, M> {
    #[inline(always)]
    fn run(&mut self, view: &View<'_>, kernel: impl BoxKernel) {
        let Self { rays, members, flights, meeting } = self;
        take_turns(kernel, view, (rays, members), flights, *meeting);
    }
}

#[inline(always)]
fn take_turns(
    kernel: impl BoxKernel,
    view: &View<'_>,
    (rays, members): (&[Ray], &[u16]),
    Flights(flights, room): &mut Flights,
    meeting: &mut impl Meeting,
) {
    let mut flying = [0; FLIGHTS];
    let mut count = 0;
    while count < FLIGHTS.min(members.len()) {
        flights[count].start(&rays[usize::from(members[count])], count, view);
        flying[count] = count;
        count += 1;
    }
    let has_many_vertices = view.vertex_count() >= MANY_VERTICES;
    let mut next = count;
    let mut turn = 0;
    while count > 0 {
        let flight = &mut flights[flying[turn] % FLIGHTS];
        let Flight { traversal, shear, place, awaits_corners } = &mut *flight;
        let current = traversal.current();
        *awaits_corners = has_many_vertices && current.is_leaf() && !*awaits_corners;
        if *awaits_corners {
            prefetch_corners(kernel, view, current);
            turn += 1;
        } else if step::<true>(kernel, view, (traversal, room), (*place, shear), meeting).is_none()
        {
            prefetch(kernel, view, traversal.current());
            turn += 1;
        } else if let Some(&member) = members.get(next) {
            flight.start(&rays[usize::from(member)], next, view);
            next += 1;
            turn += 1;
        } else {
            count -= 1;
            flying.swap(turn, count);
        }
        if turn >= count {
            turn = 0;
        }
    }
}

/// A ray enters the child that comes next. When its way ends: whether its answer is known.
/// `IS_ALONE` is that of [`Traversal::enter`].
#[inline(always)]
pub(super) fn step<const IS_ALONE: bool>(
    kernel: impl BoxKernel,
    view: &View<'_>,
    (traversal, room): (&mut Traversal, &mut Node),
    ray: (usize, &Shear),
    meeting: &mut impl Meeting,
) -> Option<bool> {
    let current = traversal.current();
    if current.is_leaf() {
        if meet_leaf(kernel, view, current, ray, &mut traversal.box_ray, meeting) {
            return Some(true);
        }
        traversal.leave().then_some(false)
    } else {
        traversal.enter::<IS_ALONE>(kernel, view, room).then_some(false)
    }
}

/// A ray meets the items of a leaf; whether its answer is known.
#[inline(always)]
fn meet_leaf(
    kernel: impl BoxKernel,
    view: &View<'_>,
    leaf: Child,
    (place, shear): (usize, &Shear),
    box_ray: &mut BoxRay,
    meeting: &mut impl Meeting,
) -> bool {
    let faces = &view.faces[leaf.items()];
    let mut has_others = false;
    for face in faces {
        has_others |= !face.is_triangle();
    }
    if has_others {
        for item in view.items(leaf.items()) {
            if meeting.ask(place, item, shear, box_ray).take(box_ray) {
                return true;
            }
        }
        return false;
    }
    let mut items = view.items(leaf.items());
    for faces in faces.chunks(FACES) {
        let mut room = [[[0.0; 3]; 3]; FACES];
        let mut corners = [[&[0.0; 3]; 3]; FACES];
        for (lane, (corners, room)) in corners.iter_mut().zip(&mut room).enumerate() {
            // Lanes without a triangle have the last one.
            let face = &faces[lane.min(faces.len() - 1)];
            for ((corner, room), &vertex) in corners.iter_mut().zip(room).zip(&face.vertices) {
                *corner = view.vertex_in(vertex, room);
            }
        }
        let mut distances = [0.0; FACES];
        let met = kernel.cross_four(shear, &corners, &mut distances);
        for (lane, item) in items.by_ref().take(faces.len()).enumerate() {
            let step = if met.certain >> lane & 1 == 1 {
                meeting.cross(place, item, distances[lane])
            } else if met.possible >> lane & 1 == 1 {
                meeting.ask(place, item, shear, box_ray)
            } else {
                continue;
            };
            if step.take(box_ray) {
                return true;
            }
        }
    }
    false
}

/// Asks for the corners of the triangles in a leaf. What else is in it has none, and asks for some
/// vertex or nothing.
#[inline(always)]
fn prefetch_corners(kernel: impl BoxKernel, view: &View<'_>, leaf: Child) {
    for face in &view.faces[leaf.items()] {
        for vertex in face.vertices {
            let vertex = vertex as usize;
            if let Some(vertex) = view.vertices.get(vertex) {
                kernel.prefetch(vertex);
            } else if let Some(vertex) = view.single_vertices.get(vertex - view.vertices.len()) {
                kernel.prefetch(vertex);
            }
        }
    }
}

/// Asks for the node or the records of a child.
#[inline(always)]
fn prefetch(kernel: impl BoxKernel, view: &View<'_>, child: Child) {
    if child.is_leaf() {
        let items = child.items();
        kernel.prefetch(&view.faces[items.start]);
        kernel.prefetch(&view.faces[items.end - 1]);
    } else if let Some(node) = view.nodes.get(child.node()) {
        kernel.prefetch(node);
    } else {
        kernel.prefetch(&view.compact_nodes[child.node()]);
    }
}
