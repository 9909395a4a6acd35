//! Rays in single precision, as other programs' kernels get them, for benchmarks that time them.

use std::ops::ControlFlow;

use glam::DVec3;

use super::{
    batch::{Room, trace, trace_shadows},
    ray::{Hit, Ray},
};
use crate::{
    isa::Isa,
    prepared::{PreparedScene, layout::View, record::Surface},
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
            for hit in hits {
                let t = if hit.is_some() { hit.t } else { f64::INFINITY };
                distances.push(t * from_units);
            }
        }
    }

    /// The same: 0 where anything is met before the ray's reach.
    pub fn block(&mut self, rays: &[[f32; 8]], distances: &mut Vec<f64>) {
        distances.reserve(rays.len());
        for rays in rays.chunks(BATCH) {
            self.take(rays);
            let (aim, shares) = ((&[][..], &self.rays[..]), &mut self.shares);
            let _ = trace_shadows(&self.view, self.isa, &mut self.room, aim, shares, &mut go_on);
            for &share in &self.shares {
                distances.push(if share == 0.0 { 0.0 } else { f64::INFINITY });
            }
        }
    }

    fn take(&mut self, rays: &[[f32; 8]]) {
        let scale = self.view.header.scale;
        self.rays.clear();
        self.rays.extend(rays.iter().map(|ray| {
            let [x, y, z, dx, dy, dz, reach, _] = ray.map(f64::from);
            Ray {
                origin: scale * DVec3::new(x, y, z),
                direction: DVec3::new(dx, dy, dz),
                reach: scale * reach,
                leaving: Surface::NONE,
                after: Ray::NOTHING_AHEAD,
            }
        }));
    }
}

fn go_on() -> ControlFlow<()> {
    ControlFlow::Continue(())
}
