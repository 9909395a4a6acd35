//! The camera rays of samples, eight at a time.

use glam::DVec3;

use crate::{
    prepared::record::{Camera, Surface},
    sample::{AT_ONCE, FEWEST_FOR_ERROR, Sample, Samples, positions},
    tile::{Area, Size},
    trace::{kernels::LaneWork, ray::Ray},
};

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

/// Makes the camera rays of samples.
pub(super) struct CameraRays<'a> {
    pub(super) camera: &'a Camera,
    pub(super) frame: Size,
    pub(super) samples: &'a [CameraSample],
    pub(super) rays: &'a mut Vec<Ray>,
    /// From the eye to where each ray meets the screen.
    pub(super) targets: Option<&'a mut Vec<DVec3>>,
}

impl LaneWork for CameraRays<'_> {
    #[inline(always)]
    fn run(&mut self) {
        let [width, height] = [self.frame.width(), self.frame.height()].map(f64::from);
        let (top_left, right, down) = (self.camera.top_left, self.camera.right, self.camera.down);
        for samples in self.samples.chunks(AT_ONCE) {
            let (mut x, mut y) = ([0.0; AT_ONCE], [0.0; AT_ONCE]);
            let mut of_lanes = [samples[0].sample; AT_ONCE];
            for (lane, sample) in samples.iter().enumerate() {
                x[lane] = f64::from(sample.x);
                y[lane] = f64::from(sample.y);
                of_lanes[lane] = sample.sample;
            }
            let [across, along] = positions(&of_lanes);
            let (mut target, mut direction) = ([[0.0; AT_ONCE]; 3], [[0.0; AT_ONCE]; 3]);
            for lane in 0..AT_ONCE {
                let u = (x[lane] + across[lane]) / width;
                let v = (y[lane] + along[lane]) / height;
                for axis in 0..3 {
                    target[axis][lane] = top_left[axis] + u * right[axis] + v * down[axis];
                }
                let [x, y, z] = [target[0][lane], target[1][lane], target[2][lane]];
                let length = (x * x + y * y + z * z).sqrt();
                direction[0][lane] = x / length;
                direction[1][lane] = y / length;
                direction[2][lane] = z / length;
            }
            for lane in 0..samples.len() {
                let vector = |lanes: &[[f64; AT_ONCE]; 3]| {
                    DVec3::new(lanes[0][lane], lanes[1][lane], lanes[2][lane])
                };
                self.rays.push(Ray {
                    origin: DVec3::from_array(self.camera.eye),
                    direction: vector(&direction),
                    reach: f64::INFINITY,
                    leaving: Surface::NONE,
                    after: Ray::NOTHING_AHEAD,
                });
                if let Some(targets) = &mut self.targets {
                    targets.push(vector(&target));
                }
            }
        }
    }
}

/// Finds where the first samples of pixels lie in the frame, in pixels.
pub(super) struct FirstPlaces<'a> {
    pub(super) area: Area,
    pub(super) seed: u64,
    /// The places, `[x, y]`, pixel by pixel.
    pub(super) places: &'a mut Vec<[f64; 2]>,
}

impl LaneWork for FirstPlaces<'_> {
    #[inline(always)]
    fn run(&mut self) {
        let first = |(x, y)| Samples::new(FEWEST_FOR_ERROR, self.seed, x, y).sample(0);
        let mut pixels = self.area.pixels();
        let mut left = self.area.pixel_count();
        while left > 0 {
            let mut of_lanes = [(0, 0); AT_ONCE];
            let count = left.min(AT_ONCE);
            for lane in &mut of_lanes[..count] {
                *lane = pixels.next().expect("as many as the area has");
            }
            let [across, down] = positions(&of_lanes.map(first));
            for (lane, (x, y)) in of_lanes.into_iter().enumerate().take(count) {
                self.places.push([f64::from(x) + across[lane], f64::from(y) + down[lane]]);
            }
            left -= count;
        }
    }
}
