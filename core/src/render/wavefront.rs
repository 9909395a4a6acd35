//! Rays class by class: the camera rays of a batch of samples are traced together, then the shadow
//! rays towards each light in turn, then all mirrored and transmitted rays of the next depth, and
//! so on.
//!
//! What a sample receives is added in one order of depths and lights, so it is the same to the bit
//! whatever else is in the batch.

use std::ops::ControlFlow;

use glam::DVec3;

use super::{
    camera_rays::{CameraRays, CameraSample},
    settings::Quality,
};
use crate::{
    isa::Isa,
    left_out,
    light::gather::{Gatherer, MOST_CROSSINGS},
    prepared::layout::View,
    sample::{Sample, node_after},
    shade::{
        optics::{mirror, refract},
        point::{FlatFace, Interaction, Point},
        ray_differential::RayDifferential,
    },
    tile::Size,
    trace::{
        batch::{OnProgress, Room, trace, trace_shadows},
        kernels::run_in_lanes,
        ray::{Hit, Ray},
    },
};

/// The depth of the last rays that are traced; camera rays have depth 0.
pub const DEEPEST: u32 = 64;

/// A branch of at least this weight in its sample is always followed. Lighter ones are by chance,
/// and then weigh as much. The noise that this adds to a sample is about half of it.
const FULL_WEIGHT: f64 = 1.0 / 256.0;

/// A queue of more rays than this is worked through in parts, as long as it has several samples.
const MOST_RAYS: usize = 4096;

/// Samples on their way, and the queues that they pass through.
#[derive(Debug, Default)]
pub(super) struct Wavefront {
    camera_samples: Vec<CameraSample>,
    /// From the eye to the screen, for each camera ray; empty in a scene without textures.
    targets: Vec<DVec3>,
    /// The random numbers of each sample; empty where none are needed.
    samples: Vec<Sample>,
    /// The rays of the current depth, and those of the next. A sample's rays stand together.
    queue: RayQueue,
    next_queue: RayQueue,
    /// Samples that wait until those of the queue are done, with their rays.
    put_off: Vec<RayQueue>,
    room: Room,
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
    /// Branches below this weight count as background; `None`: roulette decides about the light
    /// ones.
    cutoff: Option<f64>,
    roulette: Roulette,
    /// For each sample, the weight of its branches that were not traced but count as background.
    untraced: Vec<f64>,
}

// 2048 samples are halved 11 times, and a part that waits has at most two rays for each traced one.
const _: () = assert!(
    12 * 2 * MOST_RAYS * (size_of::<Ray>() + size_of::<Branch>() + size_of::<RayDifferential>())
        <= 20 << 20
);

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

/// Russian roulette among a sample's branches of one depth that are lighter than [`FULL_WEIGHT`]:
/// in a row, each as long as its weight, they are combed with a tooth every [`FULL_WEIGHT`] from a
/// random start on, and those that a tooth meets survive. So each survives with the probability
/// weight / `FULL_WEIGHT`, and all together keep their weight within one tooth. They stand in the
/// order of their [`Way`], so that those of the same way do so too.
///
/// Sources: a range of weights that paths are brought into by roulette, Vorba & Křivánek,
/// "Adjoint-driven Russian roulette and splitting in light transport simulation" (2016); the comb,
/// Booth, "A Weight (Charge) Conserving Importance-Weighted Comb for Monte Carlo" (1996); paths
/// sorted by where they are, L'Ecuyer, Lécot & Tuffin, "A Randomized Quasi-Monte Carlo Simulation
/// Method for Markov Chains" (2008).
#[derive(Debug, Default)]
struct Roulette {
    /// The light branches of one sample at one depth.
    light: RayQueue,
    /// How each of them leaves what, and its place among them.
    ways: Vec<Way>,
}

impl Roulette {
    /// Takes in a light branch.
    fn add(&mut self, way: Way, ray: Ray, branch: Branch, differential: Option<RayDifferential>) {
        self.ways.push(way.at(self.ways.len()));
        self.light.push(ray, branch, differential);
    }

    /// Whether it has branches of another sample.
    #[inline(always)]
    fn has_other(&self, sample: usize) -> bool {
        self.light.branches.first().is_some_and(|branch| branch.sample != sample)
    }

    /// Queues the branches that survive, and has none then.
    fn decide(&mut self, samples: &[Sample], queue: &mut RayQueue) {
        let Some(first) = self.light.branches.first() else { return };
        // How far the row has come since the last tooth, in units of `FULL_WEIGHT`: 0..1.
        let mut sum = samples[first.sample].roulette(first.depth);
        self.ways.sort_unstable();
        for way in self.ways.drain(..) {
            let place = way.place();
            let branch = self.light.branches[place];
            sum += branch.weight * (1.0 / FULL_WEIGHT);
            if sum >= 1.0 {
                sum -= 1.0;
                let differential = self.light.differentials.get(place).copied();
                let branch = Branch { weight: FULL_WEIGHT, ..branch };
                queue.push(self.light.rays[place], branch, differential);
            }
        }
        self.light.clear();
    }
}

/// How a branch leaves a face, in its high bits; the low ones are for a place in a row. Branches
/// that leave the same face in the same way see much the same, and those of neighbours in this
/// order similar things: first come those that leave backs, from the last face of the file to the
/// first, then those that leave fronts, from the first to the last.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct Way(u64);

impl Way {
    /// A sample has far fewer branches at one depth.
    const PLACES: u64 = 1 << 30;

    #[inline(always)]
    fn new(at: &Interaction<'_>, is_transmitted: bool) -> Self {
        let is_before = at.is_front != is_transmitted;
        let rank = if is_before { at.rank } else { !at.rank };
        let number = u64::from(is_before) << 33 | u64::from(rank) << 1 | u64::from(is_transmitted);
        Self(number * Self::PLACES)
    }

    /// With a place in a row.
    fn at(self, place: usize) -> Self {
        Self(self.0 | place as u64)
    }

    fn place(self) -> usize {
        (self.0 % Self::PLACES) as usize
    }
}

impl RayQueue {
    fn clear(&mut self) {
        self.rays.clear();
        self.branches.clear();
        self.differentials.clear();
    }

    /// Splits the later half of the samples off, with all their rays.
    fn split_samples(&mut self) -> Option<Self> {
        let [first, .., last] = &self.branches[..] else { return None };
        let middle = first.sample.midpoint(last.sample);
        let kept = self.branches.partition_point(|branch| branch.sample <= middle);
        (kept < self.branches.len()).then(|| Self {
            rays: self.rays.split_off(kept),
            branches: self.branches.split_off(kept),
            differentials: self.differentials.split_off(kept.min(self.differentials.len())),
        })
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
    /// One with roulette, unless branches below a weight count as background.
    pub(super) fn new(cutoff: Option<f64>) -> Self {
        Self { cutoff, ..Self::default() }
    }

    /// What each camera ray met, in the order of the samples.
    pub(super) fn first_hits(&self) -> &[Hit] {
        &self.first_hits
    }

    /// What each sample sees.
    pub(super) fn colors(&self) -> &[DVec3] {
        &self.colors
    }

    /// For each sample, the weight of its branches that were not traced but count as background.
    pub(super) fn untraced(&self) -> &[f64] {
        &self.untraced
    }

    /// Queues the camera rays of `samples`.
    pub(super) fn start(
        &mut self,
        view: &View<'_>,
        quality: &Quality,
        isa: Isa,
        frame: Size,
        samples: impl Iterator<Item = CameraSample>,
    ) {
        let camera = &view.header.camera;
        let needs_numbers = gathers(view, quality) || view.header.features.has_branches();
        let has_textures = view.header.features.has_textures();
        self.queue.clear();
        self.samples.clear();
        self.camera_samples.clear();
        self.camera_samples.extend(samples);
        if needs_numbers {
            self.samples.extend(self.camera_samples.iter().map(|camera| camera.sample));
        }
        self.targets.clear();
        let mut camera_rays = CameraRays {
            camera,
            frame,
            samples: &self.camera_samples,
            rays: &mut self.queue.rays,
            targets: has_textures.then_some(&mut self.targets),
        };
        run_in_lanes(isa, &mut camera_rays);
        let differential = |(sample, &target): (&CameraSample, &DVec3)| {
            let step = |side: [f64; 3], count: u32| {
                DVec3::from_array(side) * (sample.width / f64::from(count))
            };
            let steps = [step(camera.right, frame.width()), step(camera.down, frame.height())];
            RayDifferential::of_camera(target, steps)
        };
        let seen = self.camera_samples.iter().zip(&self.targets);
        self.queue.differentials.extend(seen.map(differential));
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
        on_progress: OnProgress<'_>,
    ) -> ControlFlow<(), u64> {
        let background = DVec3::from_array(view.header.lighting.background);
        let mut ray_count = 0;
        let mut is_first = true;
        loop {
            if self.queue.rays.is_empty() {
                let Some(queue) = self.put_off.pop() else { break };
                self.queue = queue;
            }
            while self.queue.rays.len() > MOST_RAYS {
                let Some(later) = self.queue.split_samples() else { break };
                self.put_off.push(later);
            }
            trace(view, isa, &mut self.room, &self.queue.rays, &mut self.hits, on_progress)?;
            ray_count += self.queue.rays.len() as u64;
            self.meet_all(view);
            if std::mem::take(&mut is_first) {
                std::mem::swap(&mut self.first_hits, &mut self.hits);
            }
            ray_count += self.light_points(view, quality.flat, isa, on_progress)?;
            if gathers(view, quality) {
                ray_count += self.gather(view, isa, on_progress)?;
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
    fn meet_all(&mut self, view: &View<'_>) {
        let background = DVec3::from_array(view.header.lighting.background);
        let has_textures = view.header.features.has_textures();
        self.points.clear();
        self.next_queue.clear();
        let mut last = None;
        for index in 0..self.queue.rays.len() {
            if !self.hits[index].is_some() {
                let branch = &self.queue.branches[index];
                self.colors[branch.sample] += branch.weight * background;
            } else if has_textures {
                self.meet::<true>(view, index, &mut last);
            } else {
                self.meet::<false>(view, index, &mut last);
            }
        }
        self.roulette.decide(&self.samples, &mut self.next_queue);
    }

    /// Ray `index` has met a face: finds the surface, shades it, and branches. `last` is the last
    /// flat face that was met.
    #[inline(always)]
    fn meet<'a, const HAS_TEXTURES: bool>(
        &mut self,
        view: &View<'a>,
        index: usize,
        last: &mut Option<FlatFace<'a>>,
    ) {
        let (ray, branch) = (self.queue.rays[index], self.queue.branches[index]);
        let at = Interaction::with_last(view, &ray, &self.hits[index], last);
        let differential = HAS_TEXTURES
            .then(|| self.queue.differentials[index].transfer(ray.direction, at.t, at.normal));
        self.shade(view, &ray, branch, &at, differential);
        if view.header.features.has_branches() {
            self.branch(view, &ray, branch, &at, differential);
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
    ) {
        if self.roulette.has_other(branch.sample) {
            self.roulette.decide(&self.samples, &mut self.next_queue);
        }
        let (reflect, alpha, index) = (at.material.reflect, at.material.alpha, at.material.refract);
        let cosine = -at.normal.dot(ray.direction);
        let curvature = if differential.is_some() { at.curvature(view) } else { 0.0 };
        let mut mirrored_share = if left_out::MIRROR { 0.0 } else { reflect };
        let mut transmitted = None;
        if reflect < 1.0 && alpha < 1.0 && !left_out::TRANSPARENCY {
            let share = (1.0 - reflect) * (1.0 - alpha);
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
                    transmitted = Some((at.leave(direction, at.rank), branch.next(share, 2), bent));
                }
                // Total reflection.
                None => mirrored_share += share,
            }
        }
        if mirrored_share > 0.0 {
            let mirrored = at.leave(mirror(ray.direction, at.normal, cosine), Ray::NOTHING_AHEAD);
            let differential =
                differential.map(|it| it.mirror(ray.direction, at.normal, curvature));
            let way = Way::new(at, false);
            self.follow(way, mirrored, branch.next(mirrored_share, 1), differential);
        }
        if let Some((ray, branch, differential)) = transmitted {
            self.follow(Way::new(at, true), ray, branch, differential);
        }
    }

    /// Queues a ray, or has roulette decide about it where its branch counts little, unless that
    /// lies too deep.
    #[inline(always)]
    fn follow(
        &mut self,
        way: Way,
        ray: Ray,
        branch: Branch,
        differential: Option<RayDifferential>,
    ) {
        if branch.depth > DEEPEST || self.cutoff.is_some_and(|cutoff| branch.weight < cutoff) {
            self.untraced[branch.sample] += branch.weight;
            return;
        }
        if branch.weight < FULL_WEIGHT && self.cutoff.is_none() {
            self.roulette.add(way, ray, branch, differential);
        } else {
            self.next_queue.push(ray, branch, differential);
        }
    }

    /// Finds the light that the points receive; how many rays that took.
    fn light_points(
        &mut self,
        view: &View<'_>,
        flat: bool,
        isa: Isa,
        on_progress: OnProgress<'_>,
    ) -> ControlFlow<(), u64> {
        if flat || view.header.features.is_lit == 0 {
            self.points.iter_mut().for_each(|point| point.light = DVec3::ONE);
            return ControlFlow::Continue(0);
        }
        let mut ray_count = 0;
        for index in 0..view.lights.len() {
            ray_count += self.light(view, index, isa, on_progress)?;
        }
        ControlFlow::Continue(ray_count)
    }

    /// Adds the light that other faces send on to the points; how many rays that took.
    fn gather(
        &mut self,
        view: &View<'_>,
        isa: Isa,
        on_progress: OnProgress<'_>,
    ) -> ControlFlow<(), u64> {
        let mut ray_count = 0;
        self.gatherer.start(view, &self.points, &self.samples);
        for _ in 0..=MOST_CROSSINGS {
            match self.gatherer.find_sources(view, isa, &mut self.room, on_progress)? {
                0 => break,
                count => ray_count += count,
            }
            if !self.gatherer.sources.is_empty() {
                std::mem::swap(&mut self.points, &mut self.gatherer.sources);
                ray_count += self.light_points(view, false, isa, on_progress)?;
                std::mem::swap(&mut self.points, &mut self.gatherer.sources);
                self.gatherer.deliver(&mut self.points);
            }
        }
        ControlFlow::Continue(ray_count)
    }

    /// Adds what light `index` gives each point; how many rays that took.
    fn light(
        &mut self,
        view: &View<'_>,
        index: usize,
        isa: Isa,
        on_progress: OnProgress<'_>,
    ) -> ControlFlow<(), u64> {
        on_progress()?;
        let light = &view.lights[index];
        let [position, intensity] = [light.position, light.intensity].map(DVec3::from_array);
        let on_light = view.coincident_surfaces(light);
        // Every point writes a ray, and the next one writes over it unless light may arrive.
        let most = self.points.len();
        if self.shadow_rays.len() < most {
            self.shadow_rays.resize(most, Ray::NOWHERE);
            self.arrivals.resize(most, (0, DVec3::ZERO));
        }
        let (shadow_rays, arrivals) = (&mut self.shadow_rays[..most], &mut self.arrivals[..most]);
        let mut count = 0;
        for (k, point) in self.points.iter().enumerate() {
            let to_light = position - point.position;
            let height = point.normal.dot(to_light);
            let distance = to_light.length();
            arrivals[count] = (k, intensity * (height / (distance * distance * distance)));
            shadow_rays[count] = Ray {
                origin: point.position,
                direction: to_light / distance,
                reach: distance,
                leaving: point.surface,
                after: Ray::NOTHING_AHEAD,
            };
            // Where the light is on the surface the height is rounding, but the distance may be
            // as small.
            count += usize::from(height > 0.0 && !on_light.contains(&point.surface));
        }
        let (shadow_rays, arrivals) = (&shadow_rays[..count], &arrivals[..count]);
        let aim = (on_light, shadow_rays);
        trace_shadows(view, isa, &mut self.room, aim, &mut self.shares, on_progress)?;
        for (&(point, arrival), &share) in arrivals.iter().zip(&self.shares) {
            self.points[point].light += share * arrival;
        }
        ControlFlow::Continue(count as u64)
    }
}

/// Whether places look for light that other faces send on.
fn gathers(view: &View<'_>, quality: &Quality) -> bool {
    quality.secondary && !quality.flat && view.header.features.has_emitters()
}
