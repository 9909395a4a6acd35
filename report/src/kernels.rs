//! Kernels: rays through a closed mesh, how many a second, how far off, and how many get through.

use std::{collections::BTreeSet, time::Instant};

use glam::DVec3;
use rayon::prelude::*;
use rtfarm_core::{
    isa::Isa,
    prepare::prepare,
    prepared::{PreparedBytes, PreparedScene},
    scene::{Material, Scene, Triangle, Viewport},
    testing::{FaceTests, Probe, Probing},
};
use rtfarm_oracle::{Oracle, random::Random};

/// Triangles along an edge of the octahedron that the mesh is made from: 8 · 45² in all.
pub(crate) const ALONG: i32 = 45;

/// Rays in one call of a kernel: few enough that they stay in the cache.
const BATCH: usize = 4096;

/// How far the mesh is moved, in its radius.
const MOVES: [f64; 4] = [0.0, 1e3, 1e5, 1e9];

/// Where the rays, all of which start inside the mesh, go.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Aim {
    Edges,
    Corners,
    Anywhere,
}

impl Aim {
    const ALL: [Self; 3] = [Self::Edges, Self::Corners, Self::Anywhere];

    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Edges => "edges",
            Self::Corners => "corners",
            Self::Anywhere => "anywhere",
        }
    }
}

/// How many rays, and how often.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Amount {
    pub(crate) rays: usize,
    /// The ones among them whose true distance is worked out.
    pub(crate) exact: usize,
    /// The ones among them that the textbook's tests get, which try every face.
    pub(crate) textbook: usize,
    pub(crate) runs: usize,
}

/// A mesh in one place and rays that aim at one thing.
pub(crate) struct Case {
    pub(crate) moved: f64,
    pub(crate) aim: Aim,
    pub(crate) rays: Vec<Probe>,
    /// What our own kernels did for them.
    pub(crate) tests: FaceTests,
    /// No kernel in single precision can hold the mesh otherwise.
    pub(crate) is_single: bool,
    pub(crate) kernels: Vec<Kernel>,
}

/// What one kernel made of the rays of a case.
pub(crate) struct Kernel {
    pub(crate) name: String,
    /// Millions of rays a second on one thread, of each run; none where every face is tried.
    pub(crate) speeds: Vec<f64>,
    pub(crate) rays: usize,
    /// Rays that got out of the closed mesh.
    pub(crate) leaks: usize,
    /// The largest relative error of a distance.
    pub(crate) worst: f64,
}

/// A closed mesh of about 16 000 triangles: a sphere of radius 1.
pub(crate) struct Mesh {
    pub(crate) moved: f64,
    pub(crate) triangles: Vec<[DVec3; 3]>,
    is_single: bool,
}

impl Mesh {
    pub(crate) fn all() -> impl Iterator<Item = Self> {
        MOVES.into_iter().map(|moved| Self::new(ALONG, moved))
    }

    /// The sphere about (moved, moved, moved) of 8 · `along`² triangles. Its corners fit in single
    /// precision where that leaves a sphere.
    pub(crate) fn new(along: i32, moved: f64) -> Self {
        let is_single = moved < 1e6;
        let corner = |signs: [f64; 3], [i, j]: [i32; 2]| {
            let flat = [i, j, along - i - j].map(f64::from);
            let place = DVec3::from_array([0, 1, 2].map(|axis| signs[axis] * flat[axis]));
            in_single(place.normalize() + moved, is_single)
        };
        let mut triangles = Vec::new();
        for octant in 0..8_u32 {
            let signs = [0, 1, 2].map(|axis| if octant >> axis & 1 == 0 { 1.0 } else { -1.0 });
            let mut add = |corners: [[i32; 2]; 3]| {
                let [a, b, c] = corners.map(|place| corner(signs, place));
                // Three corners in a line are no triangle; the numbers are short enough to tell.
                if (b - a).cross(c - a) != DVec3::ZERO {
                    triangles.push(if octant.count_ones() % 2 == 0 {
                        [a, b, c]
                    } else {
                        [a, c, b]
                    });
                }
            };
            for i in 0..along {
                for j in 0..along - i {
                    add([[i, j], [i + 1, j], [i, j + 1]]);
                    if i + j + 2 <= along {
                        add([[i + 1, j], [i + 1, j + 1], [i, j + 1]]);
                    }
                }
            }
        }
        Self { moved, triangles, is_single }
    }

    fn prepared(&self) -> PreparedScene<PreparedBytes> {
        prepared(&visible(&self.triangles))
    }

    fn rays(&self, aim: Aim, count: usize) -> Vec<Probe> {
        let mut random = Random::new(self.moved.to_bits() ^ aim as u64);
        let mut ray = || {
            let origin = in_single(0.5 * random.in_cube() + self.moved, self.is_single);
            let corners = self.triangles[random.below(self.triangles.len())];
            let k = random.below(3);
            let (a, b) = (corners[k], corners[(k + 1) % 3]);
            let direction = match aim {
                Aim::Edges => a + (b - a) * random.unit() - origin,
                Aim::Corners => a - origin,
                Aim::Anywhere => random.direction(),
            };
            Probe { origin, direction: direction.normalize(), leaving: None }
        };
        (0..count).map(|_| ray()).collect()
    }

    /// The triangles that a ray's line comes near, a few more than it can meet.
    fn near(&self, ray: &Probe) -> Vec<usize> {
        let is_near = |corners: &[DVec3; 3]| {
            let [to_a, to_b, to_c] = corners.map(|corner| corner - ray.origin);
            let reach = 1.01 * (to_b - to_a).length_squared().max((to_c - to_a).length_squared());
            let aside = to_a.cross(ray.direction).length_squared();
            aside <= reach && to_a.dot(ray.direction) > -reach.sqrt()
        };
        (0..self.triangles.len()).filter(|&k| is_near(&self.triangles[k])).collect()
    }
}

/// A mesh, and an eye that sees it.
pub(crate) fn visible(triangles: &[[DVec3; 3]]) -> Scene {
    let viewport = Viewport {
        eye: DVec3::ZERO,
        top_left: DVec3::new(-1.0, 1.0, -1.0),
        bottom_left: DVec3::new(-1.0, -1.0, -1.0),
        top_right: DVec3::new(1.0, 1.0, -1.0),
    };
    Scene { viewport: Some(viewport), ..scene_of((0..).zip(triangles)) }
}

pub(crate) fn prepared(scene: &Scene) -> PreparedScene<PreparedBytes> {
    PreparedScene::open(prepare(scene).expect("a plain mesh")).expect("what was just prepared")
}

/// Numbered triangles alone.
fn scene_of<'a>(triangles: impl Iterator<Item = (u32, &'a [DVec3; 3])>) -> Scene {
    let triangles = triangles
        .map(|(primitive, &vertices)| Triangle { vertices, material: 0, primitive })
        .collect();
    let material = Material {
        name: String::from("white"),
        color: DVec3::ONE,
        alpha: 1.0,
        reflect: 0.0,
        refract: 0.0,
        texture: None,
    };
    Scene { triangles, materials: vec![material], ..Scene::default() }
}

fn in_single(point: DVec3, is_single: bool) -> DVec3 {
    if is_single { point.as_vec3().as_dvec3() } else { point }
}

/// The ray as a kernel in single precision gets it.
pub(crate) fn rounded(ray: &Probe) -> Probe {
    Probe { direction: ray.direction.as_vec3().as_dvec3(), ..*ray }
}

impl Case {
    /// Every mesh with every aim. `others` are kernels of other programs, by what they met: the
    /// distance of each ray, infinite where it met nothing.
    pub(crate) fn measure_all(
        amount: Amount,
        others: &dyn Fn(f64, Aim) -> anyhow::Result<Vec<Other>>,
    ) -> anyhow::Result<Vec<Self>> {
        let mut cases = Vec::new();
        for mesh in Mesh::all() {
            let prepared = mesh.prepared();
            for aim in Aim::ALL {
                let mut case = Self::new(&mesh, aim, amount.rays);
                case.measure(&mesh, &prepared, amount);
                for other in others(mesh.moved, aim)? {
                    case.judge(&mesh, other, amount);
                }
                cases.push(case);
            }
        }
        Ok(cases)
    }

    pub(crate) fn new(mesh: &Mesh, aim: Aim, count: usize) -> Self {
        let (rays, is_single) = (mesh.rays(aim, count), mesh.is_single);
        let tests = FaceTests::default();
        Self { moved: mesh.moved, aim, rays, tests, is_single, kernels: Vec::new() }
    }

    /// All that are there to be measured, in a folder for other programs.
    pub(crate) fn all_of(mesh: &Mesh, count: usize) -> impl Iterator<Item = Self> {
        Aim::ALL.into_iter().map(move |aim| Self::new(mesh, aim, count))
    }

    /// Our own kernels, which take turns, and the textbook's.
    fn measure(&mut self, mesh: &Mesh, prepared: &PreparedScene<PreparedBytes>, amount: Amount) {
        let isas: Vec<Isa> = Isa::ALL.into_iter().filter(|isa| isa.is_supported()).collect();
        let truth = truth(mesh, &self.rays, amount.exact);
        self.tests = prepared.count_face_tests(&self.rays);
        let mut speeds = vec![Vec::new(); isas.len()];
        for _ in 0..amount.runs {
            for (isa, speeds) in isas.iter().zip(&mut speeds) {
                let started = now();
                for batch in self.rays.chunks(BATCH) {
                    std::hint::black_box(prepared.probe(batch, *isa));
                }
                speeds.push(self.rays.len() as f64 / 1e6 / started.elapsed().as_secs_f64());
            }
        }
        for (isa, speeds) in isas.iter().zip(speeds) {
            let met = prepared.probe(&self.rays, *isa);
            let distances: Vec<f64> =
                met.iter().map(|hit| hit.map_or(f64::INFINITY, |hit| hit.t)).collect();
            self.kernels.push(Kernel::new(format!("rtfarm {isa}"), speeds, &distances, &truth));
        }
        let rays = &self.rays[..amount.textbook];
        let near: Vec<Vec<usize>> = rays.par_iter().map(|ray| mesh.near(ray)).collect();
        let nearest = |test: &dyn Fn(&Probe, &[DVec3; 3]) -> Option<f64>| {
            let distances = rays.iter().zip(&near).map(|(ray, near)| {
                let met = near.iter().filter_map(|&k| test(ray, &mesh.triangles[k]));
                met.fold(f64::INFINITY, f64::min)
            });
            distances.collect::<Vec<f64>>()
        };
        let double = nearest(&|ray, corners| textbook_double(ray, *corners));
        self.kernels.push(Kernel::new("textbook f64".to_owned(), Vec::new(), &double, &truth));
        if self.is_single {
            let single = nearest(&|ray, corners| textbook_single(&rounded(ray), *corners));
            let rounded: Vec<Probe> = rays.iter().map(rounded).collect();
            let truth = self::truth(mesh, &rounded, amount.exact.min(rays.len()));
            self.kernels.push(Kernel::new("textbook f32".to_owned(), Vec::new(), &single, &truth));
        }
    }

    /// A kernel of another program, in single precision.
    fn judge(&mut self, mesh: &Mesh, other: Other, amount: Amount) {
        let rays: Vec<Probe> = self.rays.iter().take(amount.exact).map(rounded).collect();
        let truth = truth(mesh, &rays, amount.exact);
        self.kernels.push(Kernel::new(other.name, other.speeds, &other.distances, &truth));
    }
}

/// What another program's kernel made of a case's rays.
pub(crate) struct Other {
    pub(crate) name: String,
    pub(crate) speeds: Vec<f64>,
    pub(crate) distances: Vec<f64>,
}

impl Kernel {
    fn new(name: String, speeds: Vec<f64>, distances: &[f64], truth: &[f64]) -> Self {
        let errors = distances.iter().zip(truth).filter(|(found, _)| found.is_finite());
        Self {
            name,
            speeds,
            rays: distances.len(),
            leaks: distances.iter().filter(|distance| distance.is_infinite()).count(),
            worst: errors.map(|(found, truth)| (found / truth - 1.0).abs()).fold(0.0, f64::max),
        }
    }
}

/// The distances at which the first rays leave the mesh, correctly rounded.
fn truth(mesh: &Mesh, rays: &[Probe], count: usize) -> Vec<f64> {
    let distance = |ray: &Probe| {
        let near = mesh.near(ray);
        let triangles = near.iter().map(|&k| (k as u32, &mesh.triangles[k]));
        let hit = Oracle::new(&scene_of(triangles)).first_hit(ray.origin, ray.direction, None);
        hit.expect("the mesh is closed").t
    };
    rays[..count.min(rays.len())].par_iter().map(distance).collect()
}

/// As every textbook has it, borders included; only a determinant of zero is no hit.
///
/// Source: Möller & Trumbore, "Fast, Minimum Storage Ray/Triangle Intersection" (1997).
fn textbook_double(ray: &Probe, [a, b, c]: [DVec3; 3]) -> Option<f64> {
    let (along, up) = (b - a, c - a);
    let p = ray.direction.cross(up);
    let determinant = along.dot(p);
    let from_a = ray.origin - a;
    let u = from_a.dot(p) / determinant;
    let q = from_a.cross(along);
    let v = ray.direction.dot(q) / determinant;
    let t = up.dot(q) / determinant;
    (determinant != 0.0 && u >= 0.0 && v >= 0.0 && u + v <= 1.0 && t > 0.0).then_some(t)
}

/// The same in single precision.
fn textbook_single(ray: &Probe, corners: [DVec3; 3]) -> Option<f64> {
    let [a, b, c] = corners.map(|corner: DVec3| corner.as_vec3());
    let (origin, direction) = (ray.origin.as_vec3(), ray.direction.as_vec3());
    let (along, up) = (b - a, c - a);
    let p = direction.cross(up);
    let determinant = along.dot(p);
    let from_a = origin - a;
    let u = from_a.dot(p) / determinant;
    let q = from_a.cross(along);
    let v = direction.dot(q) / determinant;
    let t = up.dot(q) / determinant;
    let is_hit = determinant != 0.0 && u >= 0.0 && v >= 0.0 && u + v <= 1.0 && t > 0.0;
    is_hit.then_some(t.into())
}

#[expect(clippy::disallowed_methods, reason = "times are what is measured")]
pub(crate) fn now() -> Instant {
    Instant::now()
}

/// The kernels of some cases, each once, ours first.
pub(crate) fn names(cases: &[Case]) -> Vec<&str> {
    let mut seen = BTreeSet::new();
    let kernels = cases.iter().flat_map(|case| &case.kernels);
    kernels.map(|kernel| kernel.name.as_str()).filter(|name| seen.insert(*name)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_mesh_is_closed_and_faces_outwards() {
        for mesh in Mesh::all() {
            assert!((15_000..=16_200).contains(&mesh.triangles.len()), "{}", mesh.triangles.len());
            let mut edges = std::collections::HashMap::new();
            for corners in &mesh.triangles {
                let bits = corners.map(|corner| corner.to_array().map(f64::to_bits));
                for k in 0..3 {
                    *edges.entry((bits[k], bits[(k + 1) % 3])).or_insert(0) += 1;
                }
                let [a, b, c] = corners.map(|corner| corner - mesh.moved);
                assert!(mesh.moved > 0.0 || (b - a).cross(c - a).dot(a) > 0.0);
            }
            // Far away some triangles round to lines, and their edges lie on others'.
            let open = edges.keys().filter(|(a, b)| !edges.contains_key(&(*b, *a))).count();
            assert!(open == 0 || mesh.moved == 1e5, "{}: {open}", mesh.moved);
        }
    }

    #[test]
    fn our_kernels_are_exact_and_the_textbooks_leak() {
        let amount = Amount { rays: 600, exact: 20, textbook: 600, runs: 1 };
        let cases = Case::measure_all(amount, &|_, _| Ok(Vec::new())).unwrap();
        assert_eq!(cases.len(), 12);
        for case in &cases {
            // Rounded to a coarse grid many faces lie in one plane; their distance is the plane's,
            // as exact as the origin's coordinates are.
            let most = if case.moved == 1e5 { 1e-10 } else { 1e-14 };
            let ours = case.kernels.iter().filter(|kernel| kernel.name.starts_with("rtfarm"));
            for Kernel { name, leaks, worst, .. } in ours {
                assert!(*leaks == 0 && *worst < most, "{name} {}: {leaks} {worst}", case.moved);
            }
        }
        let leaks_of = |name: &str| -> usize {
            let kernels = cases.iter().flat_map(|case| &case.kernels);
            kernels.filter(|kernel| kernel.name == name).map(|kernel| kernel.leaks).sum()
        };
        assert!(leaks_of("textbook f32") > 0);
    }
}
