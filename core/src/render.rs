//! A tile of a prepared scene into pixels.
//!
//! Rays travel in batches, class by class: a batch's camera rays are traced together, then the
//! shadow rays towards each light in turn. What a sample receives is added in the order of the
//! lights and a pixel's samples in their own order, so a pixel is a pure function of (scene,
//! settings, pixel): the same to the bit whatever the tile, the batch, the thread or the CPU.

use std::ops::ControlFlow;

use glam::DVec3;

use crate::{
    isa::Isa,
    prepared::{Camera, PreparedScene, View},
    ray::{Hit, Item, Kind, Ray, Surface},
    sample::Samples,
    tile::{Area, Size},
    trace::{self, trace, trace_shadows},
    triangle::triangle_normal,
};

/// What a picture depends on besides the scene.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Settings {
    /// The frame in pixels.
    pub size: Size,
    /// Samples in every pixel, `1..=`[`crate::sample::MOST_SAMPLES`].
    pub samples: u32,
    /// Chooses the random numbers.
    pub seed: u64,
    /// Every surface shows its plain colour, as in a scene without light.
    pub flat: bool,
}

/// A rendered tile.
#[derive(Debug, Clone, PartialEq)]
pub struct RenderedTile {
    /// Linear red, green and blue, 1.0 for 255 in the file, `[y][x]`, row by row.
    pub pixels: Vec<[f32; 3]>,
    /// Rays traced, of all kinds.
    pub rays: u64,
}

/// Camera rays in a batch: enough to fill the queues, few enough to stay in the cache.
const BATCH: usize = 2048;

/// Renders `area` of the frame with the kernels of `isa`, which this machine must support.
/// `on_progress` is called from time to time (some milliseconds of work apart) and may stop the
/// work: then the answer is `None`.
pub fn render_tile<B: AsRef<[u8]>>(
    scene: &PreparedScene<B>,
    settings: &Settings,
    area: Area,
    isa: Isa,
    on_progress: &mut dyn FnMut() -> ControlFlow<()>,
) -> Option<RenderedTile> {
    let view = scene.view();
    let samples = u64::from(settings.samples);
    let sample_count = area.pixel_count() as u64 * samples;
    let mut sums = vec![DVec3::ZERO; area.pixel_count()];
    let mut batch = Batch::default();
    let mut rays = 0;
    let mut first = 0;
    while first < sample_count {
        if on_progress().is_break() {
            return None;
        }
        let last = sample_count.min(first + BATCH as u64);
        batch.start(&view.header.camera, settings, area, first..last);
        rays += batch.run(&view, settings.flat, isa);
        for (sample, color) in (first..last).zip(&batch.colors) {
            sums[(sample / samples) as usize] += *color;
        }
        first = last;
    }
    let count = f64::from(settings.samples);
    let pixels = sums.into_iter().map(|sum| (sum / count).to_array().map(|x| x as f32)).collect();
    Some(RenderedTile { pixels, rays })
}

/// Samples on their way, and the queues that they pass through.
#[derive(Default)]
struct Batch {
    rays: Vec<Ray>,
    hits: Vec<Hit>,
    /// The samples that hit something.
    points: Vec<Point>,
    shadow_rays: Vec<Ray>,
    /// For each shadow ray, its point and what arrives if nothing is in its way.
    arrivals: Vec<(usize, DVec3)>,
    blocked: Vec<bool>,
    /// What each sample sees.
    colors: Vec<DVec3>,
}

/// A place on a surface that a sample sees.
struct Point {
    sample: usize,
    position: DVec3,
    /// Of length 1, towards the side that is seen.
    normal: DVec3,
    surface: Surface,
    color: DVec3,
    /// The light received so far.
    light: DVec3,
}

impl Batch {
    /// Queues the camera rays of the samples `range` of `area`: pixel by pixel, row by row.
    fn start(
        &mut self,
        camera: &Camera,
        settings: &Settings,
        area: Area,
        range: std::ops::Range<u64>,
    ) {
        self.rays.clear();
        let size = settings.size;
        let screen = [camera.top_left, camera.right, camera.down].map(DVec3::from_array);
        let mut current = None;
        for index in range {
            let pixel = (index / u64::from(settings.samples)) as u32;
            let sample = (index % u64::from(settings.samples)) as u32;
            let (x, y) = (area.x0 + pixel % area.width, area.y0 + pixel / area.width);
            let samples = match current {
                Some((of, samples)) if of == pixel => samples,
                _ => Samples::new(settings.samples, settings.seed, x, y),
            };
            current = Some((pixel, samples));
            let [across, down] = samples.position(sample);
            let u = (f64::from(x) + across) / f64::from(size.width());
            let v = (f64::from(y) + down) / f64::from(size.height());
            let direction = screen[0] + u * screen[1] + v * screen[2];
            self.rays.push(Ray {
                origin: DVec3::from_array(camera.eye),
                direction: direction / direction.length(),
                reach: f64::INFINITY,
                leaving: Surface::NONE,
            });
        }
    }

    /// Finds what every queued sample sees; how many rays that took.
    fn run(&mut self, view: &View<'_>, flat: bool, isa: Isa) -> u64 {
        trace(view, isa, &self.rays, &mut self.hits);
        let mut ray_count = self.rays.len() as u64;
        self.colors.clear();
        self.colors.resize(self.rays.len(), DVec3::from_array(view.header.background));
        self.points.clear();
        for (sample, (ray, hit)) in self.rays.iter().zip(&self.hits).enumerate() {
            if hit.is_some() {
                self.points.push(point(view, sample, ray, hit));
            }
        }
        if flat || view.header.is_lit == 0 {
            for point in &mut self.points {
                point.light = DVec3::ONE;
            }
        } else {
            for index in 0..view.lights.len() {
                ray_count += self.light(view, index, isa);
            }
        }
        for point in &self.points {
            self.colors[point.sample] = point.color * point.light;
        }
        ray_count
    }

    /// Adds what light `index` gives each point; how many rays that took.
    fn light(&mut self, view: &View<'_>, index: usize, isa: Isa) -> u64 {
        let light = &view.lights[index];
        let [position, intensity] = [light.position, light.intensity].map(DVec3::from_array);
        let touches = view.touches(light);
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
                });
            }
        }
        trace_shadows(view, isa, light, &self.shadow_rays, &mut self.blocked);
        for (&(point, arrival), &is_blocked) in self.arrivals.iter().zip(&self.blocked) {
            if !is_blocked {
                self.points[point].light += arrival;
            }
        }
        self.shadow_rays.len() as u64
    }
}

/// The place that a ray hit.
fn point(view: &View<'_>, sample: usize, ray: &Ray, hit: &Hit) -> Point {
    let position = ray.origin + hit.t * ray.direction;
    let (normal, material) = face(view, hit.item, position);
    let normal = if normal.dot(ray.direction) > 0.0 { -normal } else { normal };
    Point {
        sample,
        position,
        normal,
        surface: trace::surface(view, hit.item),
        color: DVec3::from_array(view.materials[material as usize].color),
        light: DVec3::from_array(view.header.ambient),
    }
}

/// The unit normal of a face at a place on it, towards its front, and its material.
fn face(view: &View<'_>, item: Item, position: DVec3) -> (DVec3, u32) {
    let index = item.index();
    match item.kind().expect("a checked item") {
        Kind::Triangle => {
            let face = &view.triangles[index];
            let corners = view.corners(&face.vertices).map(|&corner| DVec3::from_array(corner));
            (triangle_normal(corners), face.material)
        }
        Kind::Coplanar => {
            let face = &view.coplanars[index];
            let normal = view.planes[face.plane.index()].normal;
            (DVec3::from_array(normal) * face.plane.sign(), face.material)
        }
        Kind::Quadrangle => {
            let face = &view.quadrangles[index];
            let normal = view.planes[face.plane.index()].normal;
            (DVec3::from_array(normal) * face.plane.sign(), face.material)
        }
        Kind::Sphere => {
            let sphere = &view.spheres[index];
            let outward = position - DVec3::from_array(sphere.center);
            (outward / outward.length(), sphere.material)
        }
    }
}
