//! Rays class by class: the camera rays of a batch of samples are traced together, then the shadow
//! rays towards each light in turn, then all mirrored and transmitted rays of the next depth, and
//! so on.
//!
//! What a sample receives is added in one order of depths and lights, so it is the same to the bit
//! whatever else is in the batch.

use std::ops::ControlFlow;

use glam::DVec3;

use super::settings::Quality;
use crate::{
    isa::Isa,
    left_out,
    light::gather::Gatherer,
    prepared::{layout::View, record::Surface},
    sample::{Sample, node_after},
    shade::{
        optics::{mirror, refract},
        point::{Interaction, Point},
        ray_differential::RayDifferential,
    },
    tile::Size,
    trace::{
        batch::{trace, trace_shadows},
        ray::{Hit, Ray},
    },
};

/// The depth of the last rays that are traced; camera rays have depth 0.
const DEEPEST: u32 = 64;

/// A camera ray that is wanted.
#[derive(Debug, Clone, Copy)]
pub(super) struct CameraSample {
    /// The pixel's column.
    pub(super) x: u32,
    /// The pixel's row.
    pub(super) y: u32,
    /// Its random numbers.
    pub(super) sample: Sample,
    /// The side of the square that it stands for, in pixels.
    pub(super) width: f64,
}

/// Samples on their way, and the queues that they pass through.
#[derive(Debug, Default)]
pub(super) struct Wavefront {
    /// The random numbers of each sample; empty where no light is gathered.
    samples: Vec<Sample>,
    /// The rays of the current depth, and those of the next.
    queue: RayQueue,
    next_queue: RayQueue,
    hits: Vec<Hit>,
    points: Vec<Point>,
    shadow_rays: Vec<Ray>,
    /// For each shadow ray, its point and what arrives if nothing is in its way.
    arrivals: Vec<(usize, DVec3)>,
    /// For each shadow ray, the share of its light that arrives.
    shares: Vec<f64>,
    gatherer: Gatherer,
    /// What each camera ray met.
    first_hits: Vec<Hit>,
    /// What each sample sees.
    colors: Vec<DVec3>,
    /// For each sample, the weight of its branches that were not traced.
    untraced: Vec<f64>,
}

/// Rays that wait to be traced, and what travels with each.
#[derive(Debug, Default)]
struct RayQueue {
    rays: Vec<Ray>,
    branches: Vec<Branch>,
    /// Empty in a scene without textures.
    differentials: Vec<RayDifferential>,
}

/// A ray of the tree that a camera ray grows into.
#[derive(Debug, Clone, Copy)]
struct Branch {
    sample: usize,
    /// The product of the factors on the way from the sample.
    weight: f64,
    /// Tells the sample's branches apart; 0 for the camera ray.
    node: u64,
    /// How many mirrors and faces lie behind it.
    depth: u32,
}

impl Branch {
    /// The branch of a number that leaves the place that this one has met, and that counts
    /// `factor` times as much.
    #[inline(always)]
    fn next(self, factor: f64, number: u64) -> Self {
        Self {
            sample: self.sample,
            weight: self.weight * factor,
            node: node_after(self.node, number),
            depth: self.depth + 1,
        }
    }
}

impl RayQueue {
    fn clear(&mut self) {
        self.rays.clear();
        self.branches.clear();
        self.differentials.clear();
    }

    #[inline(always)]
    fn push(&mut self, ray: Ray, branch: Branch, differential: Option<RayDifferential>) {
        self.rays.push(ray);
        self.branches.push(branch);
        if let Some(differential) = differential {
            self.differentials.push(differential);
        }
    }
}

impl Wavefront {
    /// What each camera ray met, in the order of the samples.
    pub(super) fn first_hits(&self) -> &[Hit] {
        &self.first_hits
    }

    /// What each sample sees.
    pub(super) fn colors(&self) -> &[DVec3] {
        &self.colors
    }

    /// The largest weight of branches that were not traced, in any sample: 0..=1.
    pub(super) fn most_untraced(&self) -> f64 {
        self.untraced.iter().copied().fold(0.0, f64::max)
    }

    /// Queues the camera rays of `samples`.
    pub(super) fn start(
        &mut self,
        view: &View<'_>,
        quality: &Quality,
        frame: Size,
        samples: impl Iterator<Item = CameraSample>,
    ) {
        let camera = &view.header.camera;
        let gathers = gathers(view, quality);
        let has_textures = view.header.features.has_textures();
        let screen = [camera.top_left, camera.right, camera.down].map(DVec3::from_array);
        self.queue.clear();
        self.samples.clear();
        samples.for_each(|CameraSample { x, y, sample, width }| {
            if gathers {
                self.samples.push(sample);
            }
            let [across, down] = sample.position();
            let u = (f64::from(x) + across) / f64::from(frame.width());
            let v = (f64::from(y) + down) / f64::from(frame.height());
            let direction = screen[0] + u * screen[1] + v * screen[2];
            if has_textures {
                let steps = [(1, frame.width()), (2, frame.height())]
                    .map(|(side, count)| screen[side] * (width / f64::from(count)));
                self.queue.differentials.push(RayDifferential::of_camera(direction, steps));
            }
            self.queue.rays.push(Ray {
                origin: DVec3::from_array(camera.eye),
                direction: direction / direction.length(),
                reach: f64::INFINITY,
                leaving: Surface::NONE,
                after: Ray::NOTHING_AHEAD,
            });
        });
        let count = self.queue.rays.len();
        let branch = |sample| Branch { sample, weight: 1.0, node: 0, depth: 0 };
        self.queue.branches.extend((0..count).map(branch));
        self.colors.clear();
        self.colors.resize(count, DVec3::ZERO);
        self.untraced.clear();
        self.untraced.resize(count, 0.0);
    }

    /// Finds what every queued sample sees; how many rays that took. What is seen at one depth is
    /// added before what is seen at the next, and there a mirror's before the light behind it, so
    /// a sample's sum has one order whatever else is in the batch.
    pub(super) fn run(
        &mut self,
        view: &View<'_>,
        quality: &Quality,
        isa: Isa,
        on_progress: &mut dyn FnMut() -> ControlFlow<()>,
    ) -> ControlFlow<(), u64> {
        let background = DVec3::from_array(view.header.lighting.background);
        let mut ray_count = 0;
        let mut is_first = true;
        while !self.queue.rays.is_empty() {
            on_progress()?;
            trace(view, isa, &self.queue.rays, &mut self.hits);
            if std::mem::take(&mut is_first) {
                self.first_hits.clone_from(&self.hits);
            }
            ray_count += self.queue.rays.len() as u64;
            self.meet_all(view, quality.cutoff.get());
            ray_count += self.light_points(view, quality.flat, isa);
            if gathers(view, quality) {
                ray_count += self.gather(view, isa);
            }
            for point in &self.points {
                self.colors[point.sample] += point.weight * (point.color * point.light);
            }
            std::mem::swap(&mut self.queue, &mut self.next_queue);
        }
        for (color, untraced) in self.colors.iter_mut().zip(&self.untraced) {
            *color += *untraced * background;
        }
        ControlFlow::Continue(ray_count)
    }

    /// Takes in what the queue's rays have met: fills the points and the next queue.
    fn meet_all(&mut self, view: &View<'_>, cutoff: f64) {
        let background = DVec3::from_array(view.header.lighting.background);
        let has_textures = view.header.features.has_textures();
        self.points.clear();
        self.next_queue.clear();
        for index in 0..self.queue.rays.len() {
            if !self.hits[index].is_some() {
                let branch = &self.queue.branches[index];
                self.colors[branch.sample] += branch.weight * background;
            } else if has_textures {
                self.meet::<true>(view, index, cutoff);
            } else {
                self.meet::<false>(view, index, cutoff);
            }
        }
    }

    /// Ray `index` has met a face: finds the surface, shades it, and branches.
    #[inline(always)]
    fn meet<const HAS_TEXTURES: bool>(&mut self, view: &View<'_>, index: usize, cutoff: f64) {
        let (ray, branch) = (self.queue.rays[index], self.queue.branches[index]);
        let at = Interaction::new(view, &ray, &self.hits[index]);
        let differential = HAS_TEXTURES
            .then(|| self.queue.differentials[index].transfer(ray.direction, at.t, at.normal));
        self.shade(view, &ray, branch, &at, differential);
        if view.header.features.has_branches() {
            self.branch(view, &ray, branch, &at, differential, cutoff);
        }
    }

    /// Queues what the surface's own light needs.
    #[inline(always)]
    fn shade(
        &mut self,
        view: &View<'_>,
        ray: &Ray,
        branch: Branch,
        at: &Interaction<'_>,
        differential: Option<RayDifferential>,
    ) {
        let (reflect, alpha) = (at.material.reflect, at.material.alpha);
        if reflect < 1.0 && alpha > 0.0 {
            let footprint =
                differential.map(|differential| differential.footprint(ray.direction, at.normal));
            self.points.push(Point {
                sample: branch.sample,
                node: branch.node,
                weight: branch.weight * ((1.0 - reflect) * alpha),
                position: at.position,
                normal: at.normal,
                surface: at.surface,
                color: at.color(view, footprint),
                light: view.header.lighting.ambient(),
            });
        }
    }

    /// Queues the mirrored and the transmitted ray.
    #[inline(always)]
    fn branch(
        &mut self,
        view: &View<'_>,
        ray: &Ray,
        branch: Branch,
        at: &Interaction<'_>,
        differential: Option<RayDifferential>,
        cutoff: f64,
    ) {
        let (reflect, alpha, index) = (at.material.reflect, at.material.alpha, at.material.refract);
        let cosine = -at.normal.dot(ray.direction);
        let mirrored = mirror(ray.direction, at.normal, cosine);
        let curvature = if differential.is_some() { at.curvature(view) } else { 0.0 };
        let mirrored_differential =
            differential.map(|it| it.mirror(ray.direction, at.normal, curvature));
        let reflected = at.leave(mirrored, Ray::NOTHING_AHEAD);
        if reflect > 0.0 && !left_out::MIRROR {
            self.follow(reflected, branch.next(reflect, 1), mirrored_differential, cutoff);
        }
        if reflect < 1.0 && alpha < 1.0 && !left_out::TRANSPARENCY {
            let transmitted = branch.next((1.0 - reflect) * (1.0 - alpha), 2);
            let ratio = if at.is_front { index } else { 1.0 / index };
            let is_straight = left_out::REFRACTION || index == 0.0 || index == 1.0;
            let bent = if is_straight {
                Some(ray.direction)
            } else {
                refract(ray.direction, at.normal, cosine, ratio)
            };
            match bent {
                Some(direction) => {
                    let refract = |it: RayDifferential| {
                        it.refract(ray.direction, at.normal, curvature, ratio)
                    };
                    let bent = if is_straight { differential } else { differential.map(refract) };
                    self.follow(at.leave(direction, at.rank), transmitted, bent, cutoff);
                }
                // Total reflection.
                None => self.follow(reflected, transmitted, mirrored_differential, cutoff),
            }
        }
    }

    /// Queues a ray, unless its branch counts too little or lies too deep.
    #[inline(always)]
    fn follow(
        &mut self,
        ray: Ray,
        branch: Branch,
        differential: Option<RayDifferential>,
        cutoff: f64,
    ) {
        if branch.weight < cutoff || branch.depth > DEEPEST {
            self.untraced[branch.sample] += branch.weight;
        } else {
            self.next_queue.push(ray, branch, differential);
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
        let on_light = view.coincident_surfaces(light);
        self.shadow_rays.clear();
        self.arrivals.clear();
        for (k, point) in self.points.iter().enumerate() {
            let to_light = position - point.position;
            let height = point.normal.dot(to_light);
            // Where the light is on the surface the height is rounding, but the distance may be
            // as small.
            if height > 0.0 && !on_light.contains(&point.surface) {
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
