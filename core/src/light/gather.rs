//! Light that faces send on: from each place that receives it one ray goes out, where little counts
//! only now and then, and where the ray meets such a face, that place is lit in its turn and gives
//! what it can.

use super::sampling::{self, Aim, Receiver};
use crate::{
    isa::Isa,
    prepared::layout::View,
    sample::Sample,
    shade::{
        point::{Point, surface_color},
        ray_differential::Patch,
    },
    trace::{
        batch::trace,
        ray::{Hit, Ray},
    },
};

/// The most faces that let light through on one ray: far more than any scene has, so that
/// rounding cannot keep a ray between two faces for ever.
const MOST_CROSSINGS: u32 = 1 << 12;

/// A place that counts this much in its sample gathers always; what counts less does so as seldom
/// as it counts less. Light behind mirrors costs as much as any, and its noise is seen less.
const FULL_WEIGHT: f64 = 0.25;

/// The probability with which a place of this weight sends a ray: above 0.
fn sending_chance(weight: f64) -> f64 {
    (weight * (1.0 / FULL_WEIGHT)).clamp(f64::MIN_POSITIVE, 1.0)
}

/// Rays on their way, and what they have met.
#[derive(Debug, Default)]
pub(crate) struct Gatherer {
    rays: Vec<Ray>,
    seekers: Vec<Seeker>,
    next_rays: Vec<Ray>,
    next_seekers: Vec<Seeker>,
    hits: Vec<Hit>,
    /// The places that send light on. What one counts in the receiver is in its `color`, and the
    /// receiver's place among the points in its `sample`.
    pub(crate) sources: Vec<Point>,
}

/// What a ray looks for.
#[derive(Debug, Clone, Copy)]
struct Seeker {
    /// The receiver's place among the points.
    point: usize,
    receiver: Receiver,
    aim: Aim,
    /// What the faces behind it have let through, over the chance that it was sent.
    share: f64,
    /// How far it has come.
    distance: f64,
}

impl Gatherer {
    /// Sends a ray from every point and finds the sources that it meets; how many rays that took.
    pub(crate) fn find_sources(
        &mut self,
        view: &View<'_>,
        isa: Isa,
        points: &[Point],
        samples: &[Sample],
    ) -> u64 {
        self.sources.clear();
        self.rays.clear();
        self.seekers.clear();
        for (k, point) in points.iter().enumerate() {
            let numbers = samples[point.sample].gather_numbers(point.node);
            let chance = sending_chance(point.weight);
            if chance < 1.0 && numbers.sending() >= chance {
                continue;
            }
            let receiver = Receiver { position: point.position, normal: point.normal };
            let Some(aim) = sampling::aim(view, &receiver, &numbers) else { continue };
            self.rays.push(Ray {
                origin: point.position,
                direction: aim.direction,
                reach: f64::INFINITY,
                leaving: point.surface,
                after: Ray::NOTHING_AHEAD,
            });
            self.seekers.push(Seeker {
                point: k,
                receiver,
                aim,
                share: 1.0 / chance,
                distance: 0.0,
            });
        }
        let mut ray_count = 0;
        for _ in 0..=MOST_CROSSINGS {
            if self.rays.is_empty() {
                break;
            }
            ray_count += self.rays.len() as u64;
            trace(view, isa, &self.rays, &mut self.hits);
            self.next_rays.clear();
            self.next_seekers.clear();
            for k in 0..self.rays.len() {
                let (ray, hit, seeker) = (self.rays[k], self.hits[k], self.seekers[k]);
                if hit.is_some() {
                    self.meet(view, &ray, &hit, seeker);
                }
            }
            std::mem::swap(&mut self.rays, &mut self.next_rays);
            std::mem::swap(&mut self.seekers, &mut self.next_seekers);
        }
        ray_count
    }

    fn meet(&mut self, view: &View<'_>, ray: &Ray, hit: &Hit, seeker: Seeker) {
        let position = ray.origin + hit.t * ray.direction;
        let distance = seeker.distance + hit.t;
        let surface = hit.face.surface(view);
        let material = hit.face.material(view);
        if material.emits() {
            let Seeker { receiver, aim, .. } = &seeker;
            let density = match aim.emitter {
                None if aim.sky >= 1.0 => 1.0,
                None => {
                    let index = view.emitter_of(hit.rank);
                    sampling::density(view, receiver, aim.sky, index, ray.direction, distance)
                }
                Some((wanted, density)) if view.emitters[wanted as usize].rank == hit.rank => {
                    density
                }
                Some(_) => f64::INFINITY,
            };
            let weight = seeker.share * (material.reflect * material.alpha) / density;
            if weight > 0.0 {
                let outward = hit.face.normal(view, position);
                let is_front = outward.dot(ray.direction) <= 0.0;
                // A texture's truth: a mean over all samples needs no coarser level.
                let finest = Some(Patch::POINT);
                self.sources.push(Point {
                    sample: seeker.point,
                    node: 0,
                    weight,
                    position,
                    normal: if is_front { outward } else { -outward },
                    surface,
                    color: surface_color(view, material, hit, (position, outward), finest),
                    light: view.header.lighting.ambient(),
                });
            }
        }
        let share = seeker.share * material.transmittance();
        if share > 0.0 {
            self.next_rays.push(Ray {
                origin: position,
                leaving: surface,
                after: hit.rank,
                ..*ray
            });
            self.next_seekers.push(Seeker { share, distance, ..seeker });
        }
    }

    /// Gives the receivers what the sources, which are lit now, send them: each one's in the order
    /// in which its ray met them.
    pub(crate) fn deliver(&self, points: &mut [Point]) {
        for source in &self.sources {
            points[source.sample].light += source.weight * (source.color * source.light);
        }
    }
}
