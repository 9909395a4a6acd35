//! Batches of rays through the hierarchy: the nearest face, or whether anything is in the way.
//!
//! Boxes are filtered in f32, faces decided in f64. The nearest hit is the smallest (t, rank), so
//! it depends neither on the tree nor on the instruction set.

use glam::DVec3;

use crate::{
    isa::Isa,
    node::{BoxKernel, BoxRay, Child, ScalarBoxes},
    prepared::{LightRecord, PreparedScene, View},
    quadrangle::{hit_plane, hit_quadrangle},
    ray::{Hit, Item, Kind, Ray, Shear, Surface},
    sphere::{hit_sphere, hit_sphere_again},
    triangle::hit_triangle,
};

/// Children that may wait while a ray visits others: seven on each level and the last node's.
const STACK: usize = 7 * crate::bvh::MOST_LEVELS + 8;

/// Finds what each ray meets first.
pub(crate) fn trace(view: &View<'_>, isa: Isa, rays: &[Ray], hits: &mut Vec<Hit>) {
    hits.clear();
    let mut push = |hit| hits.push(hit);
    match isa {
        Isa::Scalar => trace_all::<ScalarBoxes>(view, rays, &mut push),
        #[cfg(target_arch = "x86_64")]
        Isa::Sse2 => trace_all::<crate::node::x86::Sse2Boxes>(view, rays, &mut push),
        #[cfg(target_arch = "x86_64")]
        #[expect(unsafe_code, reason = "a function compiled for AVX2")]
        Isa::Avx2 => {
            assert!(isa.is_supported());
            // SAFETY: this CPU has AVX2, asserted just above.
            unsafe { trace_avx2(view, rays, &mut push) }
        }
        #[cfg(not(target_arch = "x86_64"))]
        Isa::Sse2 | Isa::Avx2 => trace_all::<ScalarBoxes>(view, rays, &mut push),
    }
}

/// Finds which rays, each running to `light`, have a face in their way.
pub(crate) fn trace_shadows(
    view: &View<'_>,
    isa: Isa,
    light: &LightRecord,
    rays: &[Ray],
    blocked: &mut Vec<bool>,
) {
    blocked.clear();
    let touches = view.touches(light);
    let mut push = |is_blocked| blocked.push(is_blocked);
    match isa {
        Isa::Scalar => shadow_all::<ScalarBoxes>(view, touches, rays, &mut push),
        #[cfg(target_arch = "x86_64")]
        Isa::Sse2 => {
            shadow_all::<crate::node::x86::Sse2Boxes>(view, touches, rays, &mut push);
        }
        #[cfg(target_arch = "x86_64")]
        #[expect(unsafe_code, reason = "a function compiled for AVX2")]
        Isa::Avx2 => {
            assert!(isa.is_supported());
            // SAFETY: this CPU has AVX2, asserted just above.
            unsafe { shadow_avx2(view, touches, rays, &mut push) }
        }
        #[cfg(not(target_arch = "x86_64"))]
        Isa::Sse2 | Isa::Avx2 => shadow_all::<ScalarBoxes>(view, touches, rays, &mut push),
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn trace_avx2(view: &View<'_>, rays: &[Ray], push: &mut impl FnMut(Hit)) {
    trace_all::<crate::node::x86::Avx2Boxes>(view, rays, push);
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn shadow_avx2(view: &View<'_>, touches: &[Surface], rays: &[Ray], push: &mut impl FnMut(bool)) {
    shadow_all::<crate::node::x86::Avx2Boxes>(view, touches, rays, push);
}

#[inline(always)]
fn trace_all<K: BoxKernel>(view: &View<'_>, rays: &[Ray], push: &mut impl FnMut(Hit)) {
    for ray in rays {
        let mut nearest = Nearest::new(ray);
        visit::<K>(view, ray, |item| {
            nearest.meet(view, item);
            Step::On(nearest.hit.t)
        });
        push(nearest.hit);
    }
}

#[inline(always)]
fn shadow_all<K: BoxKernel>(
    view: &View<'_>,
    touches: &[Surface],
    rays: &[Ray],
    push: &mut impl FnMut(bool),
) {
    for ray in rays {
        let shear = Shear::new(ray.origin, ray.direction);
        let mut is_blocked = false;
        visit::<K>(view, ray, |item| {
            is_blocked = blocks(view, ray, &shear, touches, item);
            if is_blocked { Step::Enough } else { Step::On(ray.reach) }
        });
        push(is_blocked);
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
fn visit<K: BoxKernel>(view: &View<'_>, ray: &Ray, mut meet: impl FnMut(Item) -> Step) {
    let mut box_ray = BoxRay::new(ray.origin, ray.direction, ray.reach, &view.header.frame);
    let mut stack = [(0.0_f32, Child::NONE); STACK];
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
    fn meet(&mut self, view: &View<'_>, item: Item) {
        let Some((t, rank)) = meet(view, self.ray, &self.shear, item) else { return };
        if t < self.hit.t || (t == self.hit.t && rank < self.hit.rank && self.hit.is_some()) {
            self.hit = Hit { t, rank, item };
        }
    }
}

/// The distance, above 0, at which the ray first crosses a face other than the one that it
/// leaves, and the face's rank.
#[inline(always)]
fn meet(view: &View<'_>, ray: &Ray, shear: &Shear, item: Item) -> Option<(f64, u32)> {
    let index = item.index();
    let (t, rank) = match item.kind()? {
        Kind::Triangle => {
            let face = &view.triangles[index];
            let corners = view.corners(&face.vertices).map(|corner| shear.project(corner));
            let t = hit_triangle(corners)?;
            if ray.leaving == Surface(face.rank) {
                return None;
            }
            (t, face.rank)
        }
        Kind::Coplanar => {
            let face = &view.coplanars[index];
            if ray.leaving == face.plane.surface() {
                return None;
            }
            let corners = view.corners(&face.vertices).map(|corner| shear.project(corner));
            let t = hit_triangle(corners)?;
            // The plane's distance, not this triangle's: coincident faces are met at one place.
            let plane = &view.planes[face.plane.index()];
            let [point, normal] = [plane.point, plane.normal].map(DVec3::from_array);
            (hit_plane(ray, point, normal).unwrap_or(t), face.rank)
        }
        Kind::Quadrangle => {
            let face = &view.quadrangles[index];
            if ray.leaving == face.plane.surface() {
                return None;
            }
            let corners = view.corners(&face.vertices).map(|corner| shear.project(corner));
            let plane = &view.planes[face.plane.index()];
            let [point, normal] = [plane.point, plane.normal].map(DVec3::from_array);
            (hit_quadrangle(ray, &corners, point, normal)?, face.rank)
        }
        Kind::Sphere => {
            let sphere = &view.spheres[index];
            let center = DVec3::from_array(sphere.center);
            let t = if ray.leaving == Surface(sphere.surface) {
                hit_sphere_again(ray, center)
            } else {
                let [near, far] = hit_sphere(ray, center, sphere.radius)?;
                if near > 0.0 { near } else { far }
            };
            (t, sphere.rank)
        }
    };
    (t > 0.0).then_some((t, rank))
}

/// Whether a face crosses the ray strictly between its start and its end, which is a light that
/// the surfaces `touches` contain.
#[inline(always)]
fn blocks(view: &View<'_>, ray: &Ray, shear: &Shear, touches: &[Surface], item: Item) -> bool {
    if !touches.is_empty() {
        let index = item.index();
        let surface = match item.kind() {
            Some(Kind::Triangle) => Surface(view.triangles[index].rank),
            Some(Kind::Coplanar) => view.coplanars[index].plane.surface(),
            Some(Kind::Quadrangle) => view.quadrangles[index].plane.surface(),
            Some(Kind::Sphere) => Surface(view.spheres[index].surface),
            None => return false,
        };
        if touches.contains(&surface) {
            if item.kind() != Some(Kind::Sphere) || ray.leaving == surface {
                return false;
            }
            // The sphere is crossed where the light is, and perhaps once more on the way.
            let center = DVec3::from_array(view.spheres[index].center);
            let light = Ray {
                origin: ray.origin + ray.reach * ray.direction,
                direction: -ray.direction,
                reach: ray.reach,
                leaving: surface,
            };
            let t = hit_sphere_again(&light, center);
            return t > 0.0 && t < ray.reach;
        }
    }
    meet(view, ray, shear, item).is_some_and(|(t, _)| t < ray.reach)
}

/// A ray to try on a prepared scene.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Probe {
    /// Where it starts, in the scene's units.
    pub origin: DVec3,
    /// Where it goes; of length 1 within rounding.
    pub direction: DVec3,
    /// The primitive on whose surface it starts: that crossing is not met, nor any face in
    /// exactly the same plane.
    pub leaving: Option<u32>,
}

/// What a [`Probe`] met.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ProbeHit {
    /// The distance in the scene's units.
    pub t: f64,
    /// The place of the primitive in the file, from 0.
    pub primitive: u32,
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
        let try_all = |probe: &Probe| {
            let ray = to_ray(&view, probe);
            let mut nearest = Nearest::new(&ray);
            view.items.iter().for_each(|&item| nearest.meet(&view, item));
            from_hit(&view, &nearest.hit)
        };
        probes.iter().map(try_all).collect()
    }

    /// How many faces each probe crosses.
    pub fn count_crossings(&self, probes: &[Probe]) -> Vec<u32> {
        let view = self.view();
        let count = |probe: &Probe| {
            let ray = to_ray(&view, probe);
            let shear = Shear::new(ray.origin, ray.direction);
            let mut crossings = 0;
            visit::<ScalarBoxes>(&view, &ray, |item| {
                crossings += u32::from(meet(&view, &ray, &shear, item).is_some());
                Step::On(ray.reach)
            });
            crossings
        };
        probes.iter().map(count).collect()
    }
}

fn to_ray(view: &View<'_>, probe: &Probe) -> Ray {
    let leaving = probe.leaving.map_or(Surface::NONE, |primitive| {
        let item = view.items.iter().find(|&&item| rank(view, item) == primitive);
        item.map_or(Surface::NONE, |&item| surface(view, item))
    });
    Ray {
        origin: probe.origin * view.header.scale,
        direction: probe.direction,
        reach: f64::INFINITY,
        leaving,
    }
}

fn from_hit(view: &View<'_>, hit: &Hit) -> Option<ProbeHit> {
    hit.is_some().then(|| ProbeHit { t: hit.t / view.header.scale, primitive: hit.rank })
}

fn rank(view: &View<'_>, item: Item) -> u32 {
    let index = item.index();
    match item.kind() {
        Some(Kind::Triangle) => view.triangles[index].rank,
        Some(Kind::Coplanar) => view.coplanars[index].rank,
        Some(Kind::Quadrangle) => view.quadrangles[index].rank,
        Some(Kind::Sphere) => view.spheres[index].rank,
        None => u32::MAX,
    }
}

/// The surface that a face belongs to.
pub(crate) fn surface(view: &View<'_>, item: Item) -> Surface {
    let index = item.index();
    match item.kind() {
        Some(Kind::Triangle) => Surface(view.triangles[index].rank),
        Some(Kind::Coplanar) => view.coplanars[index].plane.surface(),
        Some(Kind::Quadrangle) => view.quadrangles[index].plane.surface(),
        Some(Kind::Sphere) => Surface(view.spheres[index].surface),
        None => Surface::NONE,
    }
}
