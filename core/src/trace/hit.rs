//! Which face a ray meets, kind by kind.

use glam::DVec3;

use super::{
    box_ray::BoxRay,
    boxes::{BoxKernel, KernelWork},
    course::Crossing,
    lanes::{GROUPS, RayGroup, Turn},
    quadrangle::{hit_chord, hit_plane, is_inside},
    ray::{Hit, Ray, Shear},
    solid::Scratch,
    sphere::{hit_sphere, hit_sphere_again},
    triangle::hit_triangle,
};
use crate::prepared::{
    face::{Face, Part},
    layout::View,
    record::{Item, Kind, SolidNodeRecord, SolidRecord, Surface},
};

/// The search for the nearest face.
pub(super) struct Nearest<'a> {
    pub(super) ray: &'a Ray,
    pub(super) shear: Shear,
    pub(super) hit: Hit,
}

impl<'a> Nearest<'a> {
    #[inline(always)]
    pub(crate) fn new(ray: &'a Ray) -> Self {
        let shear = Shear::new(ray.origin, ray.direction);
        Self { ray, shear, hit: Hit::none(ray.reach) }
    }

    /// Tries an item; whether it is the nearest until now.
    #[inline(always)]
    pub(super) fn meet(
        &mut self,
        view: &View<'_>,
        kernel: impl BoxKernel,
        box_ray: &BoxRay,
        item: Item,
        scratch: &mut Scratch,
    ) -> bool {
        let met = match item.kind() {
            Some(Kind::Solid) => {
                let rays = (self.ray, box_ray);
                meet_solid(view, kernel, rays, item.index(), self.hit.t, scratch)
            }
            _ => meet(view, self.ray, &self.shear, item),
        };
        met.is_some_and(|met| take(&mut self.hit, item, met))
    }
}

/// Takes in where a ray meets an item; whether that is its nearest hit until now.
#[inline(always)]
pub(super) fn take(hit: &mut Hit, item: Item, (t, rank, part): (f64, u32, Part)) -> bool {
    let is_nearest = t < hit.t || (t == hit.t && rank < hit.rank && hit.is_some());
    if is_nearest {
        *hit = Hit { t, rank, face: Face { item, part } };
    }
    is_nearest
}

/// A ray crosses a triangle at a distance; whether that is its nearest hit until now.
#[inline(always)]
pub(super) fn take_crossing(view: &View<'_>, ray: &Ray, item: Item, t: f64, hit: &mut Hit) -> bool {
    meet_triangle(view, ray, item, t).is_some_and(|met| take(hit, item, met))
}

/// A ray's line crosses a sphere at two distances, other than its start; whether that is its
/// nearest hit until now.
#[inline(always)]
pub(super) fn take_sphere(view: &View<'_>, item: Item, ends: [f64; 2], hit: &mut Hit) -> bool {
    let t = first_end(ends);
    t > 0.0 && take(hit, item, (t, view.spheres[item.index()].rank, Part::WHOLE))
}

/// A ray meets a quadrangle at a distance above 0; whether that is its nearest hit until now.
#[inline(always)]
pub(super) fn take_quadrangle(view: &View<'_>, item: Item, t: f64, hit: &mut Hit) -> bool {
    take(hit, item, (t, view.quadrangles[item.index()].rank, Part::WHOLE))
}

/// The distance at which the ray crosses a face other than the one that it leaves, the face's rank,
/// and its part; `None` for a solid. The distance is above 0, or 0 for a face that coincides with
/// one that the ray went through and comes later.
#[inline(always)]
fn meet(view: &View<'_>, ray: &Ray, shear: &Shear, item: Item) -> Option<(f64, u32, Part)> {
    let index = item.index();
    let (t, rank) = match item.kind()? {
        Kind::Triangle | Kind::Coplanar => {
            let corners = shear.project_all(&view.corners(&view.faces[index].vertices));
            return meet_triangle(view, ray, item, hit_triangle(corners)?);
        }
        Kind::Quadrangle => {
            let face = &view.quadrangles[index];
            if ray.leaving == face.plane.surface() && face.rank <= ray.after {
                return None;
            }
            let corners = shear.project_all(&view.corners(&face.vertices));
            return if is_inside(&corners) { meet_quadrangle(view, ray, item) } else { None };
        }
        Kind::Sphere => {
            let sphere = &view.spheres[index];
            let center = DVec3::from_array(sphere.center);
            let t = if ray.leaving == Surface(sphere.surface) {
                if sphere.rank > ray.after {
                    return Some((0.0, sphere.rank, Part::WHOLE));
                }
                hit_sphere_again(ray, center)
            } else {
                first_end(hit_sphere(ray, center, sphere.radius)?)
            };
            (t, sphere.rank)
        }
        Kind::Solid => return None,
    };
    (t > 0.0).then_some((t, rank, Part::WHOLE))
}

/// Of the two distances at which a line crosses a sphere, the one at which a ray that starts at 0
/// first does; not above 0 if both are behind it.
#[inline(always)]
fn first_end([near, far]: [f64; 2]) -> f64 {
    if near > 0.0 { near } else { far }
}

/// The same for a quadrangle inside which the ray passes, before or behind its start.
#[inline(always)]
fn meet_quadrangle(view: &View<'_>, ray: &Ray, item: Item) -> Option<(f64, u32, Part)> {
    let face = &view.quadrangles[item.index()];
    if ray.leaving == face.plane.surface() {
        return (face.rank > ray.after).then_some((0.0, face.rank, Part::WHOLE));
    }
    // The plane's distance, whichever its corners are: coincident faces are met at one place.
    let plane = &view.planes[face.plane.index()];
    let [point, normal] = [plane.point, plane.normal].map(DVec3::from_array);
    let t = hit_plane(ray, point, normal).unwrap_or_else(|| {
        let shear = Shear::new(ray.origin, ray.direction);
        hit_chord(&shear.project_all(&view.corners(&face.vertices)))
    });
    (t > 0.0).then_some((t, face.rank, Part::WHOLE))
}

/// The same for a triangle that the ray crosses at a distance `t`, before or behind its start.
#[inline(always)]
fn meet_triangle(view: &View<'_>, ray: &Ray, item: Item, t: f64) -> Option<(f64, u32, Part)> {
    let face = &view.faces[item.index()];
    let rank = face.rank();
    let t = if item.kind() == Some(Kind::Triangle) {
        if ray.leaving == Surface(rank) {
            return None;
        }
        t
    } else {
        let plane = view.coat(face).plane;
        if ray.leaving == plane.surface() {
            return (rank > ray.after).then_some((0.0, rank, Part::WHOLE));
        }
        // The plane's distance, not this triangle's: coincident faces are met at one place.
        let plane = &view.planes[plane.index()];
        let [point, normal] = [plane.point, plane.normal].map(DVec3::from_array);
        hit_plane(ray, point, normal).unwrap_or(t)
    };
    (t > 0.0).then_some((t, rank, Part::WHOLE))
}

/// Whether a triangle that the ray crosses at a distance `t` is between the ray's start and its
/// end, which is a light that the surfaces `ending_on` contain.
#[inline(always)]
pub(super) fn is_between(
    view: &View<'_>,
    ray: &Ray,
    ending_on: &[Surface],
    item: Item,
    t: f64,
) -> bool {
    (ending_on.is_empty() || !ending_on.contains(&Face::whole(item).surface(view)))
        && meet_triangle(view, ray, item, t).is_some_and(|(t, ..)| t < ray.reach)
}

/// The crossings of a solid up to `reach`, which `take` is told of.
struct CrossSolid<'a, F> {
    solid: &'a SolidRecord,
    ray: &'a Ray,
    box_ray: &'a BoxRay,
    ending_on: &'a [Surface],
    reach: f64,
    scratch: &'a mut Scratch,
    take: F,
}

impl<F: FnMut(Crossing) -> bool> KernelWork<View<'_>> for CrossSolid<'_, F> {
    #[inline(always)]
    fn run(&mut self, view: &View<'_>, kernel: impl BoxKernel) {
        let Self { solid, ray, box_ray, ending_on, reach, scratch, take } = self;
        scratch.cross((view, solid), kernel, (ray, box_ray), ending_on, *reach, take);
    }
}

/// Crosses a solid: in a function of its own, for it is long, with all that it calls compiled for
/// the kernel.
#[inline(never)]
fn cross_solid<F: FnMut(Crossing) -> bool>(
    kernel: impl BoxKernel,
    mut work: CrossSolid<'_, F>,
    view: &View<'_>,
) {
    kernel.run(view, &mut work);
}

/// Rays of a packet in a solid, the crossings of which `take` is told of.
struct CrossSolidTogether<'a, F> {
    solid: &'a SolidRecord,
    rays: (&'a [RayGroup; GROUPS], &'a Turn),
    asking: (u64, bool),
    scratch: &'a mut Scratch,
    take: F,
    in_doubt: u64,
}

impl<F: FnMut(usize, Crossing) -> bool> KernelWork<View<'_>> for CrossSolidTogether<'_, F> {
    #[inline(always)]
    fn run(&mut self, view: &View<'_>, kernel: impl BoxKernel) {
        let Self { solid, rays, asking, scratch, take, in_doubt } = self;
        *in_doubt = scratch.lanes().cross((view, solid), kernel, *rays, *asking, take);
    }
}

/// Crosses a solid with the rays `asking` of a packet, where none ends on a light, as
/// `SolidLanes::cross` has it; the rays in doubt.
#[inline(never)]
pub(super) fn cross_solid_together<F: FnMut(usize, Crossing) -> bool>(
    kernel: impl BoxKernel,
    (view, item): (&View<'_>, Item),
    rays: (&[RayGroup; GROUPS], &Turn),
    asking: (u64, bool),
    scratch: &mut Scratch,
    take: F,
) -> u64 {
    let solid = &view.solids[item.index()];
    if solid_is_large(view, solid) {
        return asking.0;
    }
    let mut work = CrossSolidTogether { solid, rays, asking, scratch, take, in_doubt: 0 };
    kernel.run(view, &mut work);
    work.in_doubt
}

fn solid_is_large(view: &View<'_>, solid: &SolidRecord) -> bool {
    view.solid_nodes(solid).len() > SolidNodeRecord::BITS
}

/// Whether a ray meets a solid in a crossing.
#[inline(always)]
pub(super) fn counts(view: &View<'_>, solid: &SolidRecord, ray: &Ray, crossing: Crossing) -> bool {
    let Crossing { t, part } = crossing;
    t > 0.0
        || (part.rank(solid) > ray.after
            && part.leaf_of(view, solid).surface(part.face()) == ray.leaving)
}

/// What [`meet`] tells, for a solid, up to `reach`.
#[inline(always)]
fn meet_solid(
    view: &View<'_>,
    kernel: impl BoxKernel,
    (ray, box_ray): (&Ray, &BoxRay),
    index: usize,
    reach: f64,
    scratch: &mut Scratch,
) -> Option<(f64, u32, Part)> {
    let solid = &view.solids[index];
    let mut met = None;
    let take = |crossing: Crossing| {
        let is_met = counts(view, solid, ray, crossing);
        let Crossing { t, part } = crossing;
        met = is_met.then_some((t, part.rank(solid), part));
        is_met
    };
    let work = CrossSolid { solid, ray, box_ray, ending_on: &[], reach, scratch, take };
    cross_solid(kernel, work, view);
    met
}

/// Calls `cross` with the rank and the part of the crossings of a face strictly between the ray's
/// start and its end, which is a light that the surfaces `ending_on` contain, until it says that it
/// has enough.
#[inline(always)]
pub(super) fn between(
    view: &View<'_>,
    kernel: impl BoxKernel,
    (ray, shear, box_ray, ending_on): (&Ray, &Shear, &BoxRay, &[Surface]),
    item: Item,
    scratch: &mut Scratch,
    mut cross: impl FnMut(u32, Part) -> bool,
) {
    let index = item.index();
    match item.kind() {
        Some(Kind::Solid) => {
            let solid = &view.solids[index];
            let take = |Crossing { t, part }: Crossing| {
                t > 0.0 && t < ray.reach && cross(part.rank(solid), part)
            };
            cross_solid(
                kernel,
                CrossSolid { solid, ray, box_ray, ending_on, reach: ray.reach, scratch, take },
                view,
            );
        }
        Some(Kind::Sphere) => {
            let sphere = &view.spheres[index];
            let center = DVec3::from_array(sphere.center);
            let surface = Surface(sphere.surface);
            let is_inner = |&t: &f64| t > 0.0 && t < ray.reach;
            let ends = match (ray.leaving == surface, ending_on.contains(&surface)) {
                (true, true) => return, // A chord: nothing between its ends.
                (true, false) => [hit_sphere_again(ray, center), f64::INFINITY],
                (false, true) => {
                    let back = Ray { origin: ray.origin + ray.reach * ray.direction, ..*ray };
                    [ray.reach + hit_sphere_again(&back, center), f64::INFINITY]
                }
                (false, false) => {
                    hit_sphere(ray, center, sphere.radius).unwrap_or([f64::INFINITY; 2])
                }
            };
            for _ in ends.iter().filter(|t| is_inner(t)) {
                cross(sphere.rank, Part::WHOLE);
            }
        }
        _ => {
            if !ending_on.is_empty() && ending_on.contains(&Face::whole(item).surface(view)) {
                return;
            }
            if let Some((t, rank, _)) = meet(view, ray, shear, item)
                && t < ray.reach
            {
                cross(rank, Part::WHOLE);
            }
        }
    }
}
