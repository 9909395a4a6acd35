//! Points gather the light that other faces send on: each sends a ray, where little counts only now
//! and then, among many such faces some, and where the ray meets such a face, that place is lit in
//! its turn and gives what it can.

use std::ops::ControlFlow;

use super::{
    importance::Receiver,
    sampling::{self, LightPlan, LightSample},
};
use crate::{
    isa::Isa,
    prepared::layout::View,
    sample::Sample,
    shade::{
        point::{Interaction, Point},
        ray_differential::SurfaceFootprint,
    },
    trace::{
        batch::{OnProgress, Room, trace},
        ray::{Hit, Ray},
    },
};

/// The most faces that let light through on one ray: far more than any scene has, so that
/// rounding cannot keep a ray between two faces for ever.
pub(crate) const MOST_CROSSINGS: u32 = 1 << 12;

/// A point of at least this weight in its sample always gathers; the survival probability of others
/// falls in proportion to their weight. Light behind mirrors costs as much as any, and its noise is
/// seen less.
const FULL_WEIGHT: f64 = 0.25;

/// The probability, above 0 and up to 1, with which a point of this weight survives Russian
/// roulette and sends a ray.
///
/// Source: Arvo & Kirk, "Particle Transport and Image Synthesis" (1990).
fn survival_probability(weight: f64) -> f64 {
    (weight * (1.0 / FULL_WEIGHT)).clamp(f64::MIN_POSITIVE, 1.0)
}

/// Gathers for a batch of points.
#[derive(Debug, Default)]
pub(crate) struct Gatherer {
    queue: Queue,
    next: Queue,
    hits: Vec<Hit>,
    /// The places that send light on. The `sample` of one is its receiver's index among the
    /// points, and its `weight` is what its light counts there.
    pub(crate) sources: Vec<Point>,
}

/// Rays that gather, and what belongs to each.
#[derive(Debug, Default)]
struct Queue {
    rays: Vec<Ray>,
    paths: Vec<Path>,
}

/// The way from a receiver to where its ray now starts.
#[derive(Debug, Clone, Copy)]
struct Path {
    /// The receiver's index among the points.
    point: usize,
    receiver: Receiver,
    sample: LightSample,
    /// The product of the transmittances on the way, over the probability that the ray was sent.
    throughput: f64,
    /// The length of the way, in the block's units.
    distance: f64,
}

impl Queue {
    fn clear(&mut self) {
        self.rays.clear();
        self.paths.clear();
    }

    fn push(&mut self, ray: Ray, path: Path) {
        self.rays.push(ray);
        self.paths.push(path);
    }
}

impl Gatherer {
    /// Makes the rays of every point that survives.
    pub(crate) fn start(&mut self, view: &View<'_>, points: &[Point], samples: &[Sample]) {
        self.queue.clear();
        for (k, point) in points.iter().enumerate() {
            let numbers = samples[point.sample].gather_numbers(point.node);
            let survival = survival_probability(point.weight);
            if survival < 1.0 && numbers.roulette() >= survival {
                continue;
            }
            let receiver = Receiver { position: point.position, normal: point.normal };
            let plan = LightPlan::new(view, &receiver);
            let ray_count = if survival < 1.0 { 1 } else { plan.ray_count() };
            let throughput = 1.0 / (survival * f64::from(ray_count));
            for ray in 0..ray_count {
                let Some(sample) = plan.sample(&numbers.of_ray(ray, ray_count)) else { continue };
                let ray = Ray {
                    origin: point.position,
                    direction: sample.direction,
                    reach: f64::INFINITY,
                    leaving: point.surface,
                    after: Ray::NOTHING_AHEAD,
                };
                self.queue
                    .push(ray, Path { point: k, receiver, sample, throughput, distance: 0.0 });
            }
        }
    }

    /// Follows the rays to the next face, where sources may lie: one at most for each ray. Gives
    /// how many rays are followed; 0 when all have ended.
    pub(crate) fn find_sources(
        &mut self,
        view: &View<'_>,
        isa: Isa,
        room: &mut Room,
        on_progress: OnProgress<'_>,
    ) -> ControlFlow<(), u64> {
        self.sources.clear();
        trace(view, isa, room, &self.queue.rays, &mut self.hits, on_progress)?;
        self.next.clear();
        for k in 0..self.queue.rays.len() {
            let (ray, hit, path) = (self.queue.rays[k], self.hits[k], self.queue.paths[k]);
            if hit.is_some() {
                self.meet(view, &ray, &hit, path);
            }
        }
        let ray_count = self.queue.rays.len() as u64;
        std::mem::swap(&mut self.queue, &mut self.next);
        ControlFlow::Continue(ray_count)
    }

    /// Takes in that a ray has met a face: it may be a source, and may let the ray through.
    fn meet(&mut self, view: &View<'_>, ray: &Ray, hit: &Hit, path: Path) {
        let position = ray.origin + hit.t * ray.direction;
        let distance = path.distance + hit.t;
        let surface = hit.face.surface(view);
        let material = hit.face.material(view);
        if material.emits() {
            let Path { receiver, sample, .. } = &path;
            let density = match sample.emitter {
                None if sample.hemisphere_probability >= 1.0 => 1.0,
                None => {
                    let (index, hemisphere) =
                        (view.emitter_of(hit.rank), sample.hemisphere_probability);
                    sampling::density(view, receiver, hemisphere, index, ray.direction, distance)
                }
                Some((wanted, density)) if view.emitters[wanted as usize].rank == hit.rank => {
                    density
                }
                Some(_) => f64::INFINITY,
            };
            let weight = path.throughput * (material.reflect * material.alpha) / density;
            if weight > 0.0 {
                let at = Interaction::new(view, ray, hit);
                // The finest level is the truth: a mean over all samples needs no coarser one.
                let finest = Some(SurfaceFootprint::POINT);
                self.sources.push(Point {
                    sample: path.point,
                    node: 0,
                    weight,
                    position,
                    normal: at.normal,
                    surface,
                    color: at.color(view, finest),
                    light: view.header.lighting.ambient(),
                });
            }
        }
        let throughput = path.throughput * material.transmittance();
        if throughput > 0.0 {
            let ray = Ray { origin: position, leaving: surface, after: hit.rank, ..*ray };
            self.next.push(ray, Path { throughput, distance, ..path });
        }
    }

    /// Gives the receivers what the latest sources, which are lit now, send them.
    pub(crate) fn deliver(&self, points: &mut [Point]) {
        for source in &self.sources {
            points[source.sample].light += source.weight * (source.color * source.light);
        }
    }
}
