//! The test of a ray against the eight boxes of a node.
//!
//! Boxes are f32, relative to the scene's f64 frame and rounded outward; a test only ever decides
//! what may be skipped. Source of the rounding: Ize, "Robust BVH Ray Traversal" (2013). Every
//! kernel does the same operations in the same order, so all give the same bits.

use super::{
    box_ray::BoxRay,
    gate::{self, Gate, Way},
    lanes::{
        self, Beam, Crossings, FACES, Focus, GROUPS, LANES, RayGroup, Sieve, Turn, larger, smaller,
    },
    parallelepiped::PlaneCrossings,
    ray::{Ray, Shear},
    solid_rays::{self, MOST_LEAVES, Met, Seen, SolidBeam, SolidRays},
};
use crate::prepared::{
    node::{Frame, Node},
    record::{BoxPlanes, LeafRecord, SolidRecord},
};

/// Tests a ray against a node's eight boxes: the distances at which it enters them, and which of
/// them it meets, a bit each. Distances of boxes that are not met mean nothing.
///
/// A kernel is a value, and only a CPU that runs it has one.
pub(super) trait BoxKernel: Copy {
    /// Does work that is compiled for the kernel's instruction set: all that is inlined into it.
    #[inline(always)]
    fn run<Input>(self, input: &Input, work: &mut impl KernelWork<Input>) {
        work.run(input, self);
    }

    fn test(self, node: &Node, ray: &BoxRay) -> ([f32; 8], u32);

    /// The classes of rays, as [`lanes::class_of`] tells them.
    #[inline(always)]
    fn classify(self, rays: [&Ray; 4], frame: &Frame) -> [u64; 4] {
        let mut classes = [0; 4];
        for (class, ray) in classes.iter_mut().zip(rays) {
            *class = lanes::class_of(ray, frame);
        }
        classes
    }

    /// The class that rays have in common, where that can be told at once.
    #[inline(always)]
    fn common_class(self, _rays: &[Ray], _frame: &Frame) -> Option<u64> {
        None
    }

    /// Makes a group of rays of one class. Every number is that of [`BoxRay::new`] and
    /// `Shear::new`.
    #[inline(always)]
    fn fill(self, group: &mut RayGroup, rays: [&Ray; LANES], turn: &Turn) {
        lanes::fill(group, rays, turn);
    }

    /// Finds anew how far boxes may begin, where some rays of a group reach less far than before.
    #[inline(always)]
    fn shorten(self, group: &mut RayGroup, turn: &Turn) {
        lanes::shorten(group, turn);
    }

    /// The beam of all rays of some groups, which go forward on these axes.
    #[inline(always)]
    fn surround(self, groups: &[RayGroup], is_forward: [bool; 3]) -> Beam {
        lanes::surround(groups, is_forward)
    }

    /// Which rays of a mask meet the box between three near and three far planes, as
    /// [`BoxKernel::test`] tells it for each. Of rays from `ONE` start the planes are seen from
    /// there.
    #[inline(always)]
    fn enter<const ONE: bool>(
        self,
        groups: &[RayGroup; GROUPS],
        planes: [[f32; 3]; 2],
        mask: u64,
    ) -> u64 {
        lanes::enter::<ONE>(groups, planes, mask)
    }

    /// Where the first ray may enter the boxes of a node, those that some ray may meet, a bit each,
    /// and those that as good as all meet. Rounding keeps order: what a ray computes lies between
    /// what the ends of the intervals give.
    #[inline(always)]
    fn meet_beam(self, node: &Node, beam: &Beam) -> ([f32; 8], u32, u32) {
        lanes::meet_beam(node, beam)
    }

    /// How far the lines of some groups' rays pass by a point, in the order of their axes: the
    /// greatest distance along the first or the second axis.
    #[inline(always)]
    fn spread(self, groups: &[RayGroup], point: &[f64; 3]) -> f64 {
        lanes::spread(groups, point)
    }

    /// The sieve of a triangle; its corners are in the order of the rays' axes.
    #[inline(always)]
    fn sieve(self, corners: &[[f64; 3]; 3], focus: &Focus) -> Sieve {
        lanes::sieve(corners, focus)
    }

    /// The rays of a mask that do not certainly pass by the triangle of a sieve, and, if that is
    /// asked, those whose lines certainly cross it.
    #[inline(always)]
    fn sift<const CERTAIN: bool>(
        self,
        groups: &[RayGroup; GROUPS],
        sieve: &Sieve,
        mask: u64,
    ) -> [u64; 2] {
        lanes::sift::<CERTAIN>(groups, sieve, mask)
    }

    /// Finds where rays of one class start and end; `axis` is their depth axis.
    #[inline(always)]
    fn find_ends(self, groups: &mut [RayGroup], focus: &Focus, axis: usize) -> Way {
        gate::find_ends(groups, focus, axis)
    }

    /// The rays of a mask that certainly cross the triangle of a gate between their ends if their
    /// lines cross it, and those that certainly do not.
    #[inline(always)]
    fn pass_gate(self, groups: &[RayGroup; GROUPS], gate: &Gate, mask: u64) -> [u64; 2] {
        gate::pass_gate(groups, gate, mask)
    }

    /// What the rays of a mask are to a triangle; its corners are in the order of the rays' axes.
    /// Writes the distances of those that cross it for certain, the same to the bit as
    /// `hit_triangle`.
    #[inline(always)]
    fn cross(
        self,
        groups: &[RayGroup; GROUPS],
        corners: &[[f64; 3]; 3],
        mask: u64,
        distances: &mut [[f64; LANES]; GROUPS],
    ) -> Crossings {
        lanes::cross(groups, corners, mask, distances)
    }

    /// What one ray is to four triangles, a bit each. Writes the distances of those that it crosses
    /// for certain, the same to the bit as `hit_triangle`.
    #[inline(always)]
    fn cross_four(
        self,
        shear: &Shear,
        corners: &[[&[f64; 3]; 3]; FACES],
        distances: &mut [f64; FACES],
    ) -> Crossings {
        lanes::cross_four(shear, corners, distances)
    }

    /// Asks for what is at an address to be brought near, if there is anything.
    #[inline(always)]
    fn prefetch<T>(self, _place: &T) {}

    /// Where the line of a ray enters the last plane of a parallelepiped and leaves the first one:
    /// before it enters, if it passes by. With it comes the least cosine between the line and a
    /// normal. A plane that the ray leaves is `left_at` a distance that is known.
    #[inline(always)]
    fn cross_box(self, ray: &Ray, left_at: f64, planes: &BoxPlanes) -> ([f64; 2], f64) {
        PlaneCrossings::new(ray, left_at, planes).cross()
    }

    /// The first of these faces that is entered or left at `t`.
    #[inline(always)]
    fn face_at(self, (ray, left_at): (&Ray, f64), planes: &BoxPlanes, t: f64, enters: bool) -> u32 {
        PlaneCrossings::new(ray, left_at, planes).face(t, enters)
    }

    /// Brings the rays of a group near a solid, as `Course::new` does with each; whether some ray
    /// leaves a surface.
    #[inline(always)]
    fn approach(
        self,
        rays: &mut SolidRays,
        group: (&RayGroup, &Turn),
        solid: &SolidRecord,
    ) -> bool {
        solid_rays::approach(rays, group, solid)
    }

    /// The beam of rays near a solid, which go forward on these axes.
    #[inline(always)]
    fn surround_near(self, rays: &[SolidRays], is_forward: [bool; 3]) -> SolidBeam {
        solid_rays::surround_near(rays, is_forward)
    }

    /// The boxes of a node that some ray may touch, a bit each.
    #[inline(always)]
    fn touch_beam(self, node: &Node, beam: &SolidBeam) -> u32 {
        solid_rays::touch_beam(node, beam)
    }

    /// The groups `asking` of which some ray that asks touches the box between three near and three
    /// far planes, a bit each.
    #[inline(always)]
    fn touch(self, rays: &[SolidRays], asking: (&[(usize, u8)], u8), planes: [[f32; 3]; 2]) -> u8 {
        solid_rays::touch(rays, asking, planes)
    }

    /// Where rays enter and leave a sphere, as `Course::sure_stretch` finds it for those that are
    /// inside it and not in doubt. `any_leaves` where some ray leaves some surface.
    #[inline(always)]
    fn meet_ball(
        self,
        rays: &SolidRays,
        leaf: &LeafRecord,
        (any_leaves, apart): (bool, f64),
        ends: &mut [[f64; LANES]; 2],
    ) -> Met {
        solid_rays::meet_ball(rays, leaf, (any_leaves, apart), ends)
    }

    /// Where rays enter and leave a parallelepiped; as [`BoxKernel::cross_box`] finds it for those
    /// that are inside it and not in doubt. `any_leaves` where some ray leaves some surface.
    #[inline(always)]
    fn meet_box(
        self,
        rays: &SolidRays,
        planes: &BoxPlanes,
        (any_leaves, apart): (bool, f64),
        ends: &mut [[f64; LANES]; 2],
    ) -> Met {
        solid_rays::meet_box(rays, planes, (any_leaves, apart), ends)
    }

    /// Finds what rays are inside of just behind the places where they are `at`, and their `next`
    /// ends.
    #[inline(always)]
    fn look(
        self,
        ends: &[[[f64; LANES]; 2]],
        places: (&[f64; LANES], &[f64; LANES], f64),
        inside: &mut [u8; MOST_LEAVES],
        next: &mut [f64; LANES],
    ) -> Seen {
        solid_rays::look(ends, places, inside, next)
    }

    /// Takes the numbers that are `t` out of four, so that they become infinite: a bit for each.
    /// `least` takes in the others.
    #[inline(always)]
    fn take_out(self, four: &mut [f64; 4], t: f64, least: &mut [f64; 4]) -> u32 {
        let mut taken = 0;
        for (lane, (number, least)) in four.iter_mut().zip(least).enumerate() {
            if *number == t {
                *number = f64::INFINITY;
                taken |= 1 << lane;
            }
            *least = least.min(*number);
        }
        taken
    }
}

/// The kernel in plain Rust, for every CPU.
#[derive(Debug, Clone, Copy)]
pub(super) struct ScalarBoxes;

impl BoxKernel for ScalarBoxes {
    #[inline(always)]
    fn test(self, node: &Node, ray: &BoxRay) -> ([f32; 8], u32) {
        // NaN: an origin on the plane of a box that the ray runs along.
        let mut distances = [ray.low; 8];
        let mut mask = 0;
        for (child, enter) in distances.iter_mut().enumerate() {
            let mut leave = ray.high;
            for axis in 0..3 {
                let near = node.planes[ray.near[axis]][child] - ray.near_origin[axis];
                let far = node.planes[ray.far[axis]][child] - ray.far_origin[axis];
                *enter = larger(near * ray.inverse[axis], *enter);
                leave = smaller(far * ray.far_inverse[axis], leave);
            }
            mask |= u32::from(*enter <= leave) << child;
        }
        (distances, mask)
    }
}

/// Work that is compiled once for each instruction set.
///
/// What it reads all the time is an argument of its own: the compiler knows of an argument that
/// nothing else changes it, and keeps what it has loaded.
pub(super) trait KernelWork<Input> {
    fn run(&mut self, input: &Input, kernel: impl BoxKernel);
}
