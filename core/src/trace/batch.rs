//! Batches of rays through the hierarchy: the nearest face, or what reaches the other end.
//!
//! Boxes are filtered in f32, faces decided in f64. The nearest hit is the smallest (t, rank), so
//! it depends neither on the tree nor on the instruction set.

use glam::DVec3;

use super::{
    boxes::{BoxKernel, BoxRay, Child, ScalarBoxes},
    quadrangle::{hit_plane, hit_quadrangle, is_inside, is_inside_in_doubt},
    ray::{Hit, Item, Kind, Ray, Shear, Surface},
    solid::Scratch,
    sphere::{hit_sphere, hit_sphere_again},
    triangle::{hit_triangle, hit_triangle_in_doubt},
};
use crate::{
    isa::Isa,
    prepared::{LightRecord, PreparedScene, View},
};

/// Children that may wait while a ray visits others: seven on each level and the last node's.
const STACK: usize = 7 * crate::prepare::bvh::MOST_LEVELS + 8;

/// Room for them. A batch's rays share it: to fill it anew for each would cost as much as the ray.
struct Stack([(f32, Child); STACK]);

impl Default for Stack {
    fn default() -> Self {
        Self([(0.0, Child::NONE); STACK])
    }
}

/// Finds what each ray meets first.
pub(crate) fn trace(view: &View<'_>, isa: Isa, rays: &[Ray], hits: &mut Vec<Hit>) {
    hits.clear();
    dispatch(view, isa, &mut Trace { rays, hits });
}

/// Finds which share of its light each ray, running to `light`, lets through: 0..=1.
pub(crate) fn trace_shadows(
    view: &View<'_>,
    isa: Isa,
    light: &LightRecord,
    rays: &[Ray],
    shares: &mut Vec<f64>,
) {
    shares.clear();
    let touches = view.touches(light);
    if view.header.features.has_clear_shadows() {
        dispatch(view, isa, &mut ClearShadows { rays, touches, shares });
    } else {
        dispatch(view, isa, &mut Shadows { rays, touches, shares });
    }
}

/// Work on a batch of rays, the same for every instruction set.
trait Batch {
    fn run<K: BoxKernel>(&mut self, view: &View<'_>);
}

/// Runs a batch compiled for an instruction set, which must be supported.
fn dispatch(view: &View<'_>, isa: Isa, batch: &mut impl Batch) {
    assert!(isa.is_supported());
    match isa {
        Isa::Scalar => batch.run::<ScalarBoxes>(view),
        #[cfg(target_arch = "x86_64")]
        Isa::Sse2 => batch.run::<crate::trace::boxes::x86::Sse2Boxes>(view),
        #[cfg(target_arch = "x86_64")]
        #[expect(unsafe_code, reason = "a function compiled for AVX2")]
        Isa::Avx2 => {
            // SAFETY: this CPU has AVX2, asserted just above.
            unsafe { run_avx2(view, batch) }
        }
        #[cfg(not(target_arch = "x86_64"))]
        Isa::Sse2 | Isa::Avx2 => unreachable!("no other machine supports them"),
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn run_avx2(view: &View<'_>, batch: &mut impl Batch) {
    batch.run::<crate::trace::boxes::x86::Avx2Boxes>(view);
}

struct Trace<'a> {
    rays: &'a [Ray],
    hits: &'a mut Vec<Hit>,
}

impl Batch for Trace<'_> {
    #[inline(always)]
    fn run<K: BoxKernel>(&mut self, view: &View<'_>) {
        let (mut scratch, mut stack) = (Scratch::default(), Stack::default());
        for ray in self.rays {
            let mut nearest = Nearest::new(ray);
            visit::<K>(view, ray, &mut stack, |item| {
                nearest.meet(view, item, &mut scratch);
                Step::On(nearest.hit.t)
            });
            self.hits.push(nearest.hit);
        }
    }
}

/// Nothing lets light through: the first face decides.
struct Shadows<'a> {
    rays: &'a [Ray],
    touches: &'a [Surface],
    shares: &'a mut Vec<f64>,
}

impl Batch for Shadows<'_> {
    #[inline(always)]
    fn run<K: BoxKernel>(&mut self, view: &View<'_>) {
        let (mut scratch, mut stack) = (Scratch::default(), Stack::default());
        for ray in self.rays {
            let shear = Shear::new(ray.origin, ray.direction);
            let mut is_blocked = false;
            visit::<K>(view, ray, &mut stack, |item| {
                between(view, ray, &shear, self.touches, item, &mut scratch, |_, _| {
                    is_blocked = true;
                });
                if is_blocked { Step::Enough } else { Step::On(ray.reach) }
            });
            self.shares.push(if is_blocked { 0.0 } else { 1.0 });
        }
    }
}

/// Every face counts.
struct ClearShadows<'a> {
    rays: &'a [Ray],
    touches: &'a [Surface],
    shares: &'a mut Vec<f64>,
}

impl Batch for ClearShadows<'_> {
    #[inline(always)]
    fn run<K: BoxKernel>(&mut self, view: &View<'_>) {
        let (mut scratch, mut stack) = (Scratch::default(), Stack::default());
        let mut crossed: Vec<(u32, f64)> = Vec::new();
        for ray in self.rays {
            let shear = Shear::new(ray.origin, ray.direction);
            crossed.clear();
            let mut is_blocked = false;
            visit::<K>(view, ray, &mut stack, |item| {
                between(view, ray, &shear, self.touches, item, &mut scratch, |rank, part| {
                    let material = &view.materials[material(view, item, part) as usize];
                    let share = material.clearness();
                    is_blocked |= share == 0.0;
                    crossed.push((rank, share));
                });
                if is_blocked { Step::Enough } else { Step::On(ray.reach) }
            });
            // In an order that does not depend on the tree, for products round.
            crossed.sort_unstable_by_key(|&(rank, _)| rank);
            let share = crossed.iter().fold(1.0, |product, (_, share)| product * share);
            self.shares.push(if is_blocked { 0.0 } else { share });
        }
    }
}

/// What to do after a face.
enum Step {
    /// Go on with what is nearer than this.
    On(f64),
    /// The answer is known.
    Enough,
}

/// Calls `meet` for the faces in the leaves that the ray enters, nearer boxes first.
#[inline(always)]
fn visit<K: BoxKernel>(
    view: &View<'_>,
    ray: &Ray,
    stack: &mut Stack,
    meet: impl FnMut(Item) -> Step,
) {
    visit_nodes::<K>(view, ray, stack, || (), meet);
}

/// The same, and calls `enter` for each node.
#[inline(always)]
fn visit_nodes<K: BoxKernel>(
    view: &View<'_>,
    ray: &Ray,
    Stack(stack): &mut Stack,
    mut enter: impl FnMut(),
    mut meet: impl FnMut(Item) -> Step,
) {
    let mut box_ray = BoxRay::new(ray.origin, ray.direction, ray.reach, &view.header.frame);
    let mut waiting = 0;
    let mut current = Child(0); // The root.
    loop {
        if current.is_leaf() {
            for &item in &view.items[current.items()] {
                match meet(item) {
                    Step::On(reach) => box_ray.shorten(reach),
                    Step::Enough => return,
                }
            }
        } else {
            enter();
            let node = &view.nodes[current.node()];
            let (distances, mut mask) = K::test(node, &box_ray);
            let first = waiting;
            while mask != 0 {
                let child = mask.trailing_zeros() as usize & 7;
                mask &= mask - 1;
                // Insert so that the nearest ends on top.
                let mut at = waiting;
                while at > first && stack[at - 1].0 < distances[child] {
                    stack[at] = stack[at - 1];
                    at -= 1;
                }
                stack[at] = (distances[child], node.children[child]);
                waiting += 1;
            }
        }
        current = loop {
            if waiting == 0 {
                return;
            }
            waiting -= 1;
            let (near, child) = stack[waiting];
            if box_ray.reaches(near) {
                break child;
            }
        };
    }
}

/// The search for the nearest face.
struct Nearest<'a> {
    ray: &'a Ray,
    shear: Shear,
    hit: Hit,
}

impl<'a> Nearest<'a> {
    #[inline(always)]
    fn new(ray: &'a Ray) -> Self {
        let shear = Shear::new(ray.origin, ray.direction);
        Self { ray, shear, hit: Hit::none(ray.reach) }
    }

    #[inline(always)]
    fn meet(&mut self, view: &View<'_>, item: Item, scratch: &mut Scratch) {
        let Some((t, rank, part)) = meet(view, self.ray, &self.shear, item, scratch) else {
            return;
        };
        if t < self.hit.t || (t == self.hit.t && rank < self.hit.rank && self.hit.is_some()) {
            self.hit = Hit { t, rank, item, part };
        }
    }
}

/// The distance at which the ray first crosses a face other than the one that it leaves, the
/// face's rank, and which part of a solid it is. The distance is above 0, or 0 for a face that
/// coincides with one that the ray went through and comes later.
#[inline(always)]
fn meet(
    view: &View<'_>,
    ray: &Ray,
    shear: &Shear,
    item: Item,
    scratch: &mut Scratch,
) -> Option<(f64, u32, u32)> {
    let index = item.index();
    let (t, rank) = match item.kind()? {
        Kind::Triangle => {
            let face = &view.triangles[index];
            let corners = shear.project_all(view.corners(&face.vertices));
            let t = hit_triangle(corners)?;
            if ray.leaving == Surface(face.rank) {
                return None;
            }
            (t, face.rank)
        }
        Kind::Coplanar => {
            let face = &view.coplanars[index];
            let is_left = ray.leaving == face.plane.surface();
            if is_left && face.rank <= ray.after {
                return None;
            }
            let corners = shear.project_all(view.corners(&face.vertices));
            let t = hit_triangle(corners)?;
            if is_left {
                return Some((0.0, face.rank, 0));
            }
            // The plane's distance, not this triangle's: coincident faces are met at one place.
            let plane = &view.planes[face.plane.index()];
            let [point, normal] = [plane.point, plane.normal].map(DVec3::from_array);
            (hit_plane(ray, point, normal).unwrap_or(t), face.rank)
        }
        Kind::Quadrangle => {
            let face = &view.quadrangles[index];
            let is_left = ray.leaving == face.plane.surface();
            if is_left && face.rank <= ray.after {
                return None;
            }
            let corners = shear.project_all(view.corners(&face.vertices));
            if is_left {
                return is_inside(&corners).then_some((0.0, face.rank, 0));
            }
            let plane = &view.planes[face.plane.index()];
            let [point, normal] = [plane.point, plane.normal].map(DVec3::from_array);
            (hit_quadrangle(ray, &corners, point, normal)?, face.rank)
        }
        Kind::Sphere => {
            let sphere = &view.spheres[index];
            let center = DVec3::from_array(sphere.center);
            let t = if ray.leaving == Surface(sphere.surface) {
                if sphere.rank > ray.after {
                    return Some((0.0, sphere.rank, 0));
                }
                hit_sphere_again(ray, center)
            } else {
                let [near, far] = hit_sphere(ray, center, sphere.radius)?;
                if near > 0.0 { near } else { far }
            };
            (t, sphere.rank)
        }
        Kind::Solid => return meet_solid(view, ray, index, scratch),
    };
    (t > 0.0).then_some((t, rank, 0))
}

#[inline(never)]
fn meet_solid(
    view: &View<'_>,
    ray: &Ray,
    index: usize,
    scratch: &mut Scratch,
) -> Option<(f64, u32, u32)> {
    let solid = &view.solids[index];
    scratch.cross(view, solid, ray, &[]);
    scratch.crossings.iter().find_map(|crossing| {
        let rank = solid.rank + crossing.part;
        let is_met = crossing.t > 0.0 || {
            let leaf = &view.solid_leaves(solid)[crossing.part as usize / 6];
            rank > ray.after && leaf_surface(leaf, crossing.part % 6) == ray.leaving
        };
        is_met.then_some((crossing.t, rank, crossing.part))
    })
}

/// Calls `cross` with the rank and the part of every crossing of a face strictly between the
/// ray's start and its end, which is a light that the surfaces `touches` contain.
#[inline(always)]
fn between(
    view: &View<'_>,
    ray: &Ray,
    shear: &Shear,
    touches: &[Surface],
    item: Item,
    scratch: &mut Scratch,
    mut cross: impl FnMut(u32, u32),
) {
    let index = item.index();
    match item.kind() {
        Some(Kind::Solid) => {
            let solid = &view.solids[index];
            scratch.cross(view, solid, ray, touches);
            for crossing in &scratch.crossings {
                if crossing.t > 0.0 && crossing.t < ray.reach {
                    cross(solid.rank + crossing.part, crossing.part);
                }
            }
        }
        Some(Kind::Sphere) => {
            let sphere = &view.spheres[index];
            let center = DVec3::from_array(sphere.center);
            let surface = Surface(sphere.surface);
            let is_inner = |&t: &f64| t > 0.0 && t < ray.reach;
            let ends = match (ray.leaving == surface, touches.contains(&surface)) {
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
                cross(sphere.rank, 0);
            }
        }
        _ => {
            if !touches.is_empty() && touches.contains(&surface(view, item, 0)) {
                return;
            }
            if let Some((t, rank, _)) = meet(view, ray, shear, item, scratch)
                && t < ray.reach
            {
                cross(rank, 0);
            }
        }
    }
}

/// A ray to try on a prepared scene.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Probe {
    /// Where it starts, in the scene's units.
    pub origin: DVec3,
    /// Where it goes; of length 1 within rounding.
    pub direction: DVec3,
    /// The primitive and its face on which it starts: that crossing is not met, nor any face in
    /// exactly the same plane.
    pub leaving: Option<(u32, u32)>,
}

/// What a [`Probe`] met.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ProbeHit {
    /// The distance in the scene's units.
    pub t: f64,
    /// The place of the primitive in the file, from 0.
    pub primitive: u32,
    /// Which of its faces: of a parallelepiped 0..6, of a mesh the triangle, of a solid
    /// 6 · leaf + the leaf's face.
    pub face: u32,
}

/// Tests of rays against triangles and quadrangles.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct FaceTests {
    /// How many.
    pub all: u64,
    /// Those among them that needed the digits that rounded products lose.
    pub in_doubt: u64,
}

impl FaceTests {
    fn add(&mut self, view: &View<'_>, shear: &Shear, item: Item) {
        let mut is_in_doubt = false;
        let index = item.index();
        let project = |corner| shear.project(corner);
        let mut test_triangle = |vertices| {
            hit_triangle_in_doubt(view.corners(vertices).map(project), &mut is_in_doubt);
        };
        match item.kind() {
            Some(Kind::Triangle) => test_triangle(&view.triangles[index].vertices),
            Some(Kind::Coplanar) => test_triangle(&view.coplanars[index].vertices),
            Some(Kind::Quadrangle) => {
                let corners = view.corners(&view.quadrangles[index].vertices).map(project);
                is_inside_in_doubt(&corners, &mut is_in_doubt);
            }
            _ => return,
        }
        self.all += 1;
        self.in_doubt += u64::from(is_in_doubt);
    }
}

impl<B: AsRef<[u8]>> PreparedScene<B> {
    /// What each probe meets first, found with the kernels of `isa`, which must be supported.
    pub fn probe(&self, probes: &[Probe], isa: Isa) -> Vec<Option<ProbeHit>> {
        let view = self.view();
        let rays: Vec<Ray> = probes.iter().map(|probe| to_ray(&view, probe)).collect();
        let mut hits = Vec::with_capacity(rays.len());
        trace(&view, isa, &rays, &mut hits);
        hits.iter().map(|hit| from_hit(&view, hit)).collect()
    }

    /// The same without the hierarchy: every face is tried.
    pub fn probe_all_faces(&self, probes: &[Probe]) -> Vec<Option<ProbeHit>> {
        let view = self.view();
        let mut scratch = Scratch::default();
        let mut try_all = |probe: &Probe| {
            let ray = to_ray(&view, probe);
            let mut nearest = Nearest::new(&ray);
            view.items.iter().for_each(|&item| nearest.meet(&view, item, &mut scratch));
            from_hit(&view, &nearest.hit)
        };
        probes.iter().map(&mut try_all).collect()
    }

    /// How many nodes of the hierarchy each probe visits on its way to what it meets first.
    pub fn count_visits(&self, probes: &[Probe]) -> Vec<u32> {
        let view = self.view();
        let mut scratch = Scratch::default();
        let mut count = |probe: &Probe| {
            let ray = to_ray(&view, probe);
            let mut nearest = Nearest::new(&ray);
            let mut visits = 0;
            visit_nodes::<ScalarBoxes>(
                &view,
                &ray,
                &mut Stack::default(),
                || visits += 1,
                |item| {
                    nearest.meet(&view, item, &mut scratch);
                    Step::On(nearest.hit.t)
                },
            );
            visits
        };
        probes.iter().map(&mut count).collect()
    }

    /// How many triangles and quadrangles the probes are tested against on their way to what
    /// they meet first, and of how many tests rounded products did not suffice.
    pub fn count_face_tests(&self, probes: &[Probe]) -> FaceTests {
        let view = self.view();
        let (mut scratch, mut stack) = (Scratch::default(), Stack::default());
        let mut tests = FaceTests::default();
        for probe in probes {
            let ray = to_ray(&view, probe);
            let mut nearest = Nearest::new(&ray);
            let shear = nearest.shear;
            visit::<ScalarBoxes>(&view, &ray, &mut stack, |item| {
                tests.add(&view, &shear, item);
                nearest.meet(&view, item, &mut scratch);
                Step::On(nearest.hit.t)
            });
        }
        tests
    }

    /// How many faces each probe crosses.
    pub fn count_crossings(&self, probes: &[Probe]) -> Vec<u32> {
        let view = self.view();
        let mut scratch = Scratch::default();
        let mut count = |probe: &Probe| {
            let ray = to_ray(&view, probe);
            let shear = Shear::new(ray.origin, ray.direction);
            let mut crossings = 0;
            visit::<ScalarBoxes>(&view, &ray, &mut Stack::default(), |item| {
                between(&view, &ray, &shear, &[], item, &mut scratch, |_, _| crossings += 1);
                Step::On(ray.reach)
            });
            crossings
        };
        probes.iter().map(&mut count).collect()
    }
}

fn to_ray(view: &View<'_>, probe: &Probe) -> Ray {
    let leaving = probe.leaving.and_then(|(primitive, face)| {
        let first = view.first_ranks.get(primitive as usize).copied().unwrap_or(primitive);
        let rank = first + face;
        view.items.iter().find_map(|&item| match item.kind() {
            Some(Kind::Solid) => {
                let solid = &view.solids[item.index()];
                let part = rank.checked_sub(solid.rank)?;
                let is_its = (part as usize) < 6 * view.solid_leaves(solid).len();
                is_its.then(|| surface(view, item, part))
            }
            _ => (flat_rank(view, item) == rank).then(|| surface(view, item, 0)),
        })
    });
    Ray {
        origin: probe.origin * view.header.scale,
        direction: probe.direction,
        reach: f64::INFINITY,
        leaving: leaving.unwrap_or(Surface::NONE),
        after: Ray::NOTHING_AHEAD,
    }
}

fn from_hit(view: &View<'_>, hit: &Hit) -> Option<ProbeHit> {
    hit.is_some().then(|| {
        let (primitive, face) = view.primitive_and_face(hit.rank);
        ProbeHit { t: hit.t / view.header.scale, primitive, face }
    })
}

/// The rank of a face that is no solid's.
fn flat_rank(view: &View<'_>, item: Item) -> u32 {
    let index = item.index();
    match item.kind() {
        Some(Kind::Triangle) => view.triangles[index].rank,
        Some(Kind::Coplanar) => view.coplanars[index].rank,
        Some(Kind::Quadrangle) => view.quadrangles[index].rank,
        Some(Kind::Sphere) => view.spheres[index].rank,
        Some(Kind::Solid) | None => u32::MAX,
    }
}

/// The surface that a face, or a part of a solid, belongs to.
pub(crate) fn surface(view: &View<'_>, item: Item, part: u32) -> Surface {
    let index = item.index();
    match item.kind() {
        Some(Kind::Triangle) => Surface(view.triangles[index].rank),
        Some(Kind::Coplanar) => view.coplanars[index].plane.surface(),
        Some(Kind::Quadrangle) => view.quadrangles[index].plane.surface(),
        Some(Kind::Sphere) => Surface(view.spheres[index].surface),
        Some(Kind::Solid) => {
            let leaf = &view.solid_leaves(&view.solids[index])[part as usize / 6];
            leaf_surface(leaf, part % 6)
        }
        None => Surface::NONE,
    }
}

fn leaf_surface(leaf: &crate::prepared::LeafRecord, face: u32) -> Surface {
    if leaf.is_sphere() { Surface(leaf.surface) } else { leaf.planes[face as usize].surface() }
}

/// The material of a face, or of a part of a solid.
pub(crate) fn material(view: &View<'_>, item: Item, part: u32) -> u32 {
    let index = item.index();
    match item.kind() {
        Some(Kind::Triangle) => view.triangles[index].material,
        Some(Kind::Coplanar) => view.coplanars[index].material,
        Some(Kind::Quadrangle) => view.quadrangles[index].material,
        Some(Kind::Sphere) => view.spheres[index].material,
        Some(Kind::Solid) => view.solid_leaves(&view.solids[index])[part as usize / 6].material,
        None => 0,
    }
}
