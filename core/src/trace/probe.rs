//! Single rays, for tests and benchmarks.

use std::ops::ControlFlow;

use glam::DVec3;

use super::{
    batch::{Room, trace},
    box_ray::BoxRay,
    boxes::ScalarBoxes,
    hit::{Nearest, between},
    quadrangle::is_inside_in_doubt,
    ray::{Hit, Ray, Shear},
    solid::Scratch,
    traversal::{Stack, Step, visit, visit_nodes},
    triangle::hit_triangle_in_doubt,
};
use crate::{
    isa::Isa,
    prepared::{
        PreparedScene,
        face::{Face, Part},
        layout::View,
        record::{Item, Kind, Surface},
    },
};

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
        let project = |corner: [f64; 3]| shear.project(&corner);
        let mut test_triangle = |vertices| {
            hit_triangle_in_doubt(view.corners(vertices).map(project), &mut is_in_doubt);
        };
        match item.kind() {
            Some(Kind::Triangle | Kind::Coplanar) => test_triangle(&view.faces[index].vertices),
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

/// What a prepared scene answers to single rays.
pub trait Probing {
    /// What each probe meets first, found with the kernels of `isa`, which must be supported.
    fn probe(&self, probes: &[Probe], isa: Isa) -> Vec<Option<ProbeHit>>;

    /// The same without the hierarchy: every face is tried.
    fn probe_all_faces(&self, probes: &[Probe]) -> Vec<Option<ProbeHit>>;

    /// How many nodes of the hierarchy each probe visits on its way to what it meets first.
    fn count_visits(&self, probes: &[Probe]) -> Vec<u32>;

    /// How many triangles and quadrangles the probes are tested against on their way to what
    /// they meet first, and of how many tests rounded products did not suffice.
    fn count_face_tests(&self, probes: &[Probe]) -> FaceTests;

    /// How many faces each probe crosses.
    fn count_crossings(&self, probes: &[Probe]) -> Vec<u32>;
}

impl<B: AsRef<[u8]>> Probing for PreparedScene<B> {
    fn probe(&self, probes: &[Probe], isa: Isa) -> Vec<Option<ProbeHit>> {
        let view = self.view();
        let rays: Vec<Ray> = probes.iter().map(|probe| to_ray(&view, probe)).collect();
        let mut hits = Vec::with_capacity(rays.len());
        let go_on = &mut || ControlFlow::Continue(());
        let _ = trace(&view, isa, &mut Room::default(), &rays, &mut hits, go_on);
        hits.iter().map(|hit| from_hit(&view, hit)).collect()
    }

    fn probe_all_faces(&self, probes: &[Probe]) -> Vec<Option<ProbeHit>> {
        let view = self.view();
        let mut scratch = Scratch::default();
        let mut try_all = |probe: &Probe| {
            let ray = to_ray(&view, probe);
            let mut nearest = Nearest::new(&ray);
            let box_ray = BoxRay::new(ray.origin, ray.direction, ray.reach, &view.header.frame);
            for item in view.all_items() {
                nearest.meet(&view, ScalarBoxes, &box_ray, item, &mut scratch);
            }
            from_hit(&view, &nearest.hit)
        };
        probes.iter().map(&mut try_all).collect()
    }

    fn count_visits(&self, probes: &[Probe]) -> Vec<u32> {
        let view = self.view();
        let mut scratch = Scratch::default();
        let mut count = |probe: &Probe| {
            let ray = to_ray(&view, probe);
            let mut nearest = Nearest::new(&ray);
            let mut visits = 0;
            visit_nodes(
                ScalarBoxes,
                &view,
                &ray,
                &mut Stack::default(),
                || visits += 1,
                |item, box_ray| {
                    nearest.meet(&view, ScalarBoxes, box_ray, item, &mut scratch);
                    Step::On(nearest.hit.t)
                },
            );
            visits
        };
        probes.iter().map(&mut count).collect()
    }

    fn count_face_tests(&self, probes: &[Probe]) -> FaceTests {
        let view = self.view();
        let (mut scratch, mut stack) = (Scratch::default(), Stack::default());
        let mut tests = FaceTests::default();
        for probe in probes {
            let ray = to_ray(&view, probe);
            let mut nearest = Nearest::new(&ray);
            let shear = nearest.shear;
            visit(ScalarBoxes, &view, &ray, &mut stack, |item, box_ray| {
                tests.add(&view, &shear, item);
                nearest.meet(&view, ScalarBoxes, box_ray, item, &mut scratch);
                Step::On(nearest.hit.t)
            });
        }
        tests
    }

    fn count_crossings(&self, probes: &[Probe]) -> Vec<u32> {
        let view = self.view();
        let mut scratch = Scratch::default();
        let mut count = |probe: &Probe| {
            let ray = to_ray(&view, probe);
            let shear = Shear::new(ray.origin, ray.direction);
            let mut crossings = 0;
            visit(ScalarBoxes, &view, &ray, &mut Stack::default(), |item, box_ray| {
                let aim = (&ray, &shear, box_ray, &[][..]);
                between(&view, ScalarBoxes, aim, item, &mut scratch, |_, _| {
                    crossings += 1;
                    false
                });
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
        view.all_items().find_map(|item| {
            let face = match item.kind() {
                Some(Kind::Solid) => {
                    Face { item, part: Part::with_rank(&view.solids[item.index()], rank)? }
                }
                _ => Face::whole(item),
            };
            (face.rank(view) == Some(rank)).then(|| face.surface(view))
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
