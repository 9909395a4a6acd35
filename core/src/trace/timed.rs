//! Rays in single precision, as other programs' kernels get them, for benchmarks that time them.

use std::ops::ControlFlow;

use glam::DVec3;

use super::{
    batch::{Room, trace, trace_shadows},
    kernels::{LaneWork, run_in_lanes},
    ray::{Hit, Ray},
};
use crate::{
    isa::Isa,
    prepared::{PreparedScene, layout::View},
};

/// Rays that are copied and traced at once: few enough that they stay in the cache.
const BATCH: usize = 4096;

/// The kernels of an instruction set for a prepared scene.
#[derive(Debug)]
pub struct TimedKernels<'a> {
    view: View<'a>,
    isa: Isa,
    room: Room,
    rays: Vec<Ray>,
    hits: Vec<Hit>,
    shares: Vec<f64>,
}

impl<'a> TimedKernels<'a> {
    /// The kernels of `isa`, which this machine must have.
    pub fn new<B: AsRef<[u8]>>(scene: &'a PreparedScene<B>, isa: Isa) -> Self {
        let (room, rays, hits) = (Room::default(), Vec::new(), Vec::new());
        Self { view: scene.view(), isa, room, rays, hits, shares: Vec::new() }
    }

    /// Finds the distance at which each ray first meets something, infinite where nothing is met. A
    /// ray is its start, its direction of length 1, its reach and a number that counts nothing; in
    /// the scene's units.
    pub fn meet(&mut self, rays: &[[f32; 8]], distances: &mut Vec<f64>) {
        // A power of two, whose inverse is exact.
        let from_units = 1.0 / self.view.header.scale;
        distances.reserve(rays.len());
        for rays in rays.chunks(BATCH) {
            self.take(rays);
            let (view, hits) = (&self.view, &mut self.hits);
            let _ = trace(view, self.isa, &mut self.room, &self.rays, hits, &mut go_on);
            let told = |hit: &Hit| if hit.is_some() { hit.t } else { f64::INFINITY };
            distances.extend(hits.iter().map(|hit| told(hit) * from_units));
        }
    }

    /// The same: 0 where anything is met before the ray's reach.
    pub fn block(&mut self, rays: &[[f32; 8]], distances: &mut Vec<f64>) {
        distances.reserve(rays.len());
        for rays in rays.chunks(BATCH) {
            self.take(rays);
            let (aim, shares) = ((&[][..], &self.rays[..]), &mut self.shares);
            let _ = trace_shadows(&self.view, self.isa, &mut self.room, aim, shares, &mut go_on);
            let told = |&share| if share == 0.0 { 0.0 } else { f64::INFINITY };
            distances.extend(self.shares.iter().map(told));
        }
    }

    fn take(&mut self, rays: &[[f32; 8]]) {
        self.rays.resize(rays.len(), Ray::NOWHERE);
        let scale = self.view.header.scale;
        run_in_lanes(self.isa, &mut Widen { from: rays, scale, to: &mut self.rays });
    }
}

/// Makes rays of those in single precision.
struct Widen<'a> {
    from: &'a [[f32; 8]],
    scale: f64,
    to: &'a mut [Ray],
}

impl LaneWork for Widen<'_> {
    #[inline(always)]
    fn run(&mut self) {
        for (ray, from) in self.to.iter_mut().zip(self.from) {
            let mut wide = [0.0; 8];
            for (wide, &number) in wide.iter_mut().zip(from) {
                *wide = f64::from(number);
            }
            let [x, y, z, dx, dy, dz, reach, _] = wide;
            ray.origin = DVec3::new(self.scale * x, self.scale * y, self.scale * z);
            ray.direction = DVec3::new(dx, dy, dz);
            ray.reach = self.scale * reach;
        }
    }
}

fn go_on() -> ControlFlow<()> {
    ControlFlow::Continue(())
}
