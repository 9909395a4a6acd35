//! Where a ray's line is inside a parallelepiped, by its six planes.

use super::ray::Ray;
use crate::prepared::record::BoxPlanes;

/// Where the line of a ray crosses the six planes, and how fast it goes outward there.
pub(super) struct PlaneCrossings {
    t: [f64; 6],
    along: [f64; 6],
}

impl PlaneCrossings {
    #[inline(always)]
    pub(super) fn new(ray: &Ray, left_at: f64, planes: &BoxPlanes) -> Self {
        let leaving = f64::from(ray.leaving.0);
        let (o, d) = (ray.origin.to_array(), ray.direction.to_array());
        let [px, py, pz] = &planes.points;
        let [nx, ny, nz] = &planes.normals;
        let (mut t, mut along) = ([0.0; 6], [0.0; 6]);
        for face in 0..6 {
            let to = [px[face] - o[0], py[face] - o[1], pz[face] - o[2]];
            let distance = nx[face] * to[0] + ny[face] * to[1] + nz[face] * to[2];
            along[face] = nx[face] * d[0] + ny[face] * d[1] + nz[face] * d[2];
            let is_left = planes.surfaces[face] == leaving;
            t[face] = if is_left { left_at } else { distance / along[face] };
        }
        Self { t, along }
    }

    /// What `BoxKernel::cross_box` finds.
    #[inline(always)]
    pub(super) fn cross(&self) -> ([f64; 2], f64) {
        let (mut stretch, mut least) = ([f64::NEG_INFINITY, f64::INFINITY], f64::INFINITY);
        for (&t, &along) in self.t.iter().zip(&self.along) {
            if along < 0.0 && t > stretch[0] {
                stretch[0] = t;
            } else if along > 0.0 && t < stretch[1] {
                stretch[1] = t;
            }
            least = least.min(along.abs());
        }
        (stretch, least)
    }

    /// The first face that is entered or left at `t`.
    pub(super) fn face(&self, t: f64, enters: bool) -> u32 {
        let is_it = |&face: &usize| self.t[face] == t && (self.along[face] < 0.0) == enters;
        (0..6).find(is_it).unwrap_or(0) as u32
    }
}

#[cfg(test)]
mod tests {
    use glam::DVec3;
    use rtfarm_oracle::random::Random;

    use super::*;
    use crate::{
        isa::Isa,
        prepared::record::{PlaneIndex, PlaneRecord},
        trace::{
            boxes::{BoxKernel, KernelWork},
            kernels::run_with_kernel,
        },
    };

    /// What a kernel finds: the stretch, the least cosine, and the faces at both ends.
    type Found = ([f64; 2], f64, [u32; 2]);

    impl KernelWork<(Ray, f64, BoxPlanes)> for Option<Found> {
        fn run(&mut self, (ray, left_at, planes): &(Ray, f64, BoxPlanes), kernel: impl BoxKernel) {
            let (stretch, least) = kernel.cross_box(ray, *left_at, planes);
            let face = |end: usize| kernel.face_at((ray, *left_at), planes, stretch[end], end == 0);
            *self = Some((stretch, least, [face(0), face(1)]));
        }
    }

    #[test]
    fn every_kernel_finds_the_same_stretch_and_faces() {
        let random = &mut Random::new(5);
        let (mut crossed, mut along_faces) = (0, 0);
        for _ in 0..20_000 {
            // Coordinates and directions repeat, so that rays run along planes and meet edges.
            let point = |random: &mut Random| match random.below(3) {
                0 => random.in_cube(),
                _ => (random.in_cube() * 2.0).round() / 2.0,
            };
            let edges = [DVec3::X, DVec3::Y, DVec3::Z];
            let planes: [PlaneRecord; 6] = std::array::from_fn(|face| {
                let normal = if random.chance(0.5) { edges[face / 2] } else { random.direction() };
                PlaneRecord { point: point(random).to_array(), normal: normal.to_array() }
            });
            let faces: [PlaneIndex; 6] =
                std::array::from_fn(|face| PlaneIndex::new(face, face % 2 == 0));
            let planes = BoxPlanes::new(faces, &planes);
            let toward = point(random) * [1.0, 0.0][random.below(2)] + edges[random.below(3)];
            let toward = if toward == DVec3::ZERO { DVec3::X } else { toward };
            let ray = Ray {
                origin: point(random),
                direction: toward / toward.length(),
                reach: f64::INFINITY,
                leaving: faces[random.below(6)].surface(),
                after: Ray::NOTHING_AHEAD,
            };
            let left_at = random.between(-1.0, 1.0);
            let input = (ray, left_at, planes);
            let find = |isa| {
                let mut found = None;
                run_with_kernel(isa, &input, &mut found);
                found.expect("the kernel ran")
            };
            let (stretch, least, faces) = find(Isa::Scalar);
            for isa in Isa::ALL.into_iter().filter(|isa| isa.is_supported()) {
                assert_eq!(find(isa), (stretch, least, faces), "{isa}: {ray:?}");
            }
            crossed += u32::from(stretch[0] < stretch[1]);
            along_faces += u32::from(least == 0.0);
        }
        assert!(crossed > 1_000 && along_faces > 1_000, "{crossed}, {along_faces}");
    }
}
