//! Rays in batches, class by class: a batch's camera rays are traced together, then the shadow rays
//! towards each light in turn, then all mirrored and transmitted rays of the next depth, and so on.
//!
//! What a sample receives is added in one order of depths and lights, so it is the same to the bit
//! whatever else is in the batch.

use std::ops::ControlFlow;

use glam::DVec3;

use super::settings::{Quality, Settings};
use crate::{
    isa::Isa,
    left_out,
    light::gather::Gatherer,
    prepared::{layout::View, record::Surface},
    sample::{Sample, node_after},
    shade::{
        optics::{mirror, refract},
        point::{Point, surface_color},
        ray_differential::Spread,
    },
    trace::{
        batch::{trace, trace_shadows},
        ray::{Hit, Ray},
    },
};

/// The depth of the last rays that are traced; camera rays have depth 0.
pub(crate) const DEEPEST: u32 = 64;

/// A camera ray that is wanted.
#[derive(Debug, Clone, Copy)]
pub(crate) struct CameraSample {
    /// The pixel's column.
    pub(crate) x: u32,
    /// The pixel's row.
    pub(crate) y: u32,
    /// Its random numbers.
    pub(crate) sample: Sample,
    /// The width of the square that it stands for, in pixels.
    pub(crate) spread: f64,
}

/// Samples on their way, and the queues that they pass through.
#[derive(Debug, Default)]
pub(crate) struct Batch {
    /// The random numbers of each sample; empty where nothing gathers.
    samples: Vec<Sample>,
    /// The rays of the current depth, and what each adds to.
    rays: Vec<Ray>,
    branches: Vec<Branch>,
    /// What each ray's sample is wide; empty in a scene without textures.
    spreads: Vec<Spread>,
    hits: Vec<Hit>,
    points: Vec<Point>,
    shadow_rays: Vec<Ray>,
    /// For each shadow ray, its point and what arrives if nothing is in its way.
    arrivals: Vec<(usize, DVec3)>,
    shares: Vec<f64>,
    next_rays: Vec<Ray>,
    next_branches: Vec<Branch>,
    gatherer: Gatherer,
    next_spreads: Vec<Spread>,
    /// What each camera ray met.
    pub(crate) first_hits: Vec<Hit>,
    /// What each sample sees.
    pub(crate) colors: Vec<DVec3>,
    /// Of each sample, the weights of the branches that were not traced.
    pub(crate) cut: Vec<f64>,
}

/// A ray of the tree that a camera ray grows into.
#[derive(Debug, Clone, Copy)]
struct Branch {
    sample: usize,
    /// The product of the factors on the way from the sample.
    weight: f64,
    /// Tells the sample's branches apart; 0 for the camera ray.
    node: u64,
}

impl Batch {
    /// Queues the camera rays of `samples`.
    pub(crate) fn start(
        &mut self,
        view: &View<'_>,
        settings: &Settings,
        samples: impl Iterator<Item = CameraSample>,
    ) {
        let (size, camera) = (settings.size, &view.header.camera);
        let gathers = gathers(view, &settings.quality);
        let has_textures = view.header.features.has_textures();
        let screen = [camera.top_left, camera.right, camera.down].map(DVec3::from_array);
        self.rays.clear();
        self.samples.clear();
        self.spreads.clear();
        self.rays.extend(samples.map(|CameraSample { x, y, sample, spread }| {
            if gathers {
                self.samples.push(sample);
            }
            let [across, down] = sample.position();
            let u = (f64::from(x) + across) / f64::from(size.width());
            let v = (f64::from(y) + down) / f64::from(size.height());
            let direction = screen[0] + u * screen[1] + v * screen[2];
            if has_textures {
                let steps = [(1, size.width()), (2, size.height())]
                    .map(|(side, count)| screen[side] * (spread / f64::from(count)));
                self.spreads.push(Spread::of_camera(direction, steps));
            }
            Ray {
                origin: DVec3::from_array(camera.eye),
                direction: direction / direction.length(),
                reach: f64::INFINITY,
                leaving: Surface::NONE,
                after: Ray::NOTHING_AHEAD,
            }
        }));
        self.branches.clear();
        self.branches.extend((0..self.rays.len()).map(|sample| Branch {
            sample,
            weight: 1.0,
            node: 0,
        }));
        self.colors.clear();
        self.colors.resize(self.rays.len(), DVec3::ZERO);
        self.cut.clear();
        self.cut.resize(self.rays.len(), 0.0);
    }

    /// Finds what every queued sample sees; how many rays that took. What is seen at one depth is
    /// added before what is seen at the next, and there a mirror's before the light behind it, so
    /// a sample's sum has one order whatever else is in the batch.
    pub(crate) fn run(
        &mut self,
        view: &View<'_>,
        quality: &Quality,
        isa: Isa,
        on_progress: &mut dyn FnMut() -> ControlFlow<()>,
    ) -> ControlFlow<(), u64> {
        let background = DVec3::from_array(view.header.lighting.background);
        let mut ray_count = 0;
        let has_textures = view.header.features.has_textures();
        let mut depth = 0;
        while !self.rays.is_empty() {
            on_progress()?;
            trace(view, isa, &self.rays, &mut self.hits);
            if depth == 0 {
                self.first_hits.clone_from(&self.hits);
            }
            ray_count += self.rays.len() as u64;
            self.points.clear();
            self.next_rays.clear();
            self.next_branches.clear();
            self.next_spreads.clear();
            for index in 0..self.rays.len() {
                let branch = self.branches[index];
                if self.hits[index].is_some() {
                    if has_textures {
                        self.meet::<true>(view, index, quality.cutoff, depth);
                    } else {
                        self.meet::<false>(view, index, quality.cutoff, depth);
                    }
                } else {
                    self.colors[branch.sample] += branch.weight * background;
                }
            }
            ray_count += self.light_points(view, quality.flat, isa);
            if gathers(view, quality) {
                ray_count += self.gather(view, isa);
            }
            for point in &self.points {
                self.colors[point.sample] += point.weight * (point.color * point.light);
            }
            std::mem::swap(&mut self.rays, &mut self.next_rays);
            std::mem::swap(&mut self.branches, &mut self.next_branches);
            std::mem::swap(&mut self.spreads, &mut self.next_spreads);
            depth += 1;
        }
        for (color, cut) in self.colors.iter_mut().zip(&self.cut) {
            *color += *cut * background;
        }
        ControlFlow::Continue(ray_count)
    }

    /// Ray `index` has met a face: queues what its own light and its branches need.
    fn meet<const HAS_TEXTURES: bool>(
        &mut self,
        view: &View<'_>,
        index: usize,
        cutoff: f64,
        depth: u32,
    ) {
        let (ray, hit) = (&self.rays[index], &self.hits[index]);
        let Branch { sample, weight, node } = self.branches[index];
        let position = ray.origin + hit.t * ray.direction;
        let outward = hit.face.normal(view, position);
        let is_front = outward.dot(ray.direction) <= 0.0;
        let normal = if is_front { outward } else { -outward };
        let surface = hit.face.surface(view);
        let material = hit.face.material(view);
        let (reflect, alpha) = (material.reflect, material.alpha);
        let spread =
            HAS_TEXTURES.then(|| self.spreads[index].transfer(ray.direction, hit.t, normal));
        if reflect < 1.0 && alpha > 0.0 {
            let patch = spread.map(|spread| spread.patch(ray.direction, normal));
            self.points.push(Point {
                sample,
                node,
                weight: weight * ((1.0 - reflect) * alpha),
                position,
                normal,
                surface,
                color: surface_color(view, material, hit, (position, outward), patch),
                light: view.header.lighting.ambient(),
            });
        }
        if !view.header.features.has_branches() {
            return;
        }
        let mut follow =
            |direction: DVec3, after: u32, weight: f64, branch: u64, spread: Option<Spread>| {
                if weight < cutoff || depth == DEEPEST {
                    self.cut[sample] += weight;
                    return;
                }
                self.next_rays.push(Ray {
                    origin: position,
                    direction,
                    reach: f64::INFINITY,
                    leaving: surface,
                    after,
                });
                self.next_branches.push(Branch { sample, weight, node: node_after(node, branch) });
                self.next_spreads.extend(spread);
            };
        let cosine = -normal.dot(ray.direction);
        let mirrored = mirror(ray.direction, normal, cosine);
        let curvature =
            if spread.is_some() { hit.face.curvature(view, position, normal) } else { 0.0 };
        let mirrored_spread = spread.map(|spread| spread.mirror(ray.direction, normal, curvature));
        if reflect > 0.0 && !left_out::MIRROR {
            follow(mirrored, Ray::NOTHING_AHEAD, weight * reflect, 1, mirrored_spread);
        }
        if reflect < 1.0 && alpha < 1.0 && !left_out::TRANSPARENCY {
            let weight = weight * ((1.0 - reflect) * (1.0 - alpha));
            let ratio = if is_front { material.refract } else { 1.0 / material.refract };
            let is_straight =
                left_out::REFRACTION || material.refract == 0.0 || material.refract == 1.0;
            let bent = if is_straight {
                Some(ray.direction)
            } else {
                refract(ray.direction, normal, cosine, ratio)
            };
            match bent {
                Some(direction) => {
                    let refract =
                        |spread: Spread| spread.refract(ray.direction, normal, curvature, ratio);
                    let bent = if is_straight { spread } else { spread.map(refract) };
                    follow(direction, hit.rank, weight, 2, bent);
                }
                // Total reflection.
                None => follow(mirrored, Ray::NOTHING_AHEAD, weight, 2, mirrored_spread),
            }
        }
    }

    /// Finds the light that the points receive; how many rays that took.
    fn light_points(&mut self, view: &View<'_>, flat: bool, isa: Isa) -> u64 {
        if flat || view.header.features.is_lit == 0 {
            self.points.iter_mut().for_each(|point| point.light = DVec3::ONE);
            return 0;
        }
        (0..view.lights.len()).map(|index| self.light(view, index, isa)).sum()
    }

    /// Adds the light that other faces send on to the points; how many rays that took.
    fn gather(&mut self, view: &View<'_>, isa: Isa) -> u64 {
        let mut ray_count = self.gatherer.find_sources(view, isa, &self.points, &self.samples);
        std::mem::swap(&mut self.points, &mut self.gatherer.sources);
        ray_count += self.light_points(view, false, isa);
        std::mem::swap(&mut self.points, &mut self.gatherer.sources);
        self.gatherer.deliver(&mut self.points);
        ray_count
    }

    /// Adds what light `index` gives each point; how many rays that took.
    fn light(&mut self, view: &View<'_>, index: usize, isa: Isa) -> u64 {
        let light = &view.lights[index];
        let [position, intensity] = [light.position, light.intensity].map(DVec3::from_array);
        let touches = view.coincident_surfaces(light);
        self.shadow_rays.clear();
        self.arrivals.clear();
        for (k, point) in self.points.iter().enumerate() {
            let to_light = position - point.position;
            let height = point.normal.dot(to_light);
            // Where the light is on the surface the height is rounding, but the distance may be
            // as small.
            if height > 0.0 && !touches.contains(&point.surface) {
                let distance = to_light.length();
                self.arrivals.push((k, intensity * (height / (distance * distance * distance))));
                self.shadow_rays.push(Ray {
                    origin: point.position,
                    direction: to_light / distance,
                    reach: distance,
                    leaving: point.surface,
                    after: Ray::NOTHING_AHEAD,
                });
            }
        }
        trace_shadows(view, isa, light, &self.shadow_rays, &mut self.shares);
        for (&(point, arrival), &share) in self.arrivals.iter().zip(&self.shares) {
            self.points[point].light += share * arrival;
        }
        self.shadow_rays.len() as u64
    }
}

/// Whether places look for light that other faces send on.
fn gathers(view: &View<'_>, quality: &Quality) -> bool {
    quality.secondary && !quality.flat && view.header.features.has_emitters()
}
