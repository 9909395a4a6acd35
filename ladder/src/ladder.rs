//! One scene at many settings: what each takes and how far off it is.

use std::{ops::ControlFlow, time::Instant};

use rayon::prelude::*;
use rtfarm_core::{
    isa::Isa,
    prepared::{PreparedBytes, PreparedScene},
    render::{Quality, SampleCount, Sampling, render_tile},
    tile::{Area, Size},
};

use crate::{
    adaptive_settings,
    figures::{Errors, Truth, mean_and_band, median},
};

/// The width of a user's own picture in pixels where it is larger; its height follows.
const OWN_WIDTH: f64 = 160.0;

/// A scene and its true picture.
#[derive(Debug)]
pub struct Subject {
    /// What it is called in the report.
    pub name: String,
    /// It, ready to be rendered.
    pub scene: PreparedScene<PreparedBytes>,
    /// How it should look.
    pub truth: Truth,
    /// What stands for the truth; `None` for a closed form.
    pub reference: Option<Reference>,
}

/// A picture that stands for the truth of a user's scene.
#[derive(Debug, Clone, Copy)]
pub struct Reference {
    /// Samples a pixel.
    pub samples: SampleCount,
    /// The size that the scene is rendered at otherwise.
    pub full_size: Size,
}

impl Subject {
    /// Makes the subject of a scene whose true picture nobody knows: it is rendered small, and its
    /// picture with `samples` samples a pixel stands for the truth. `None` when `go_on` broke off.
    pub fn with_reference(
        name: String,
        scene: PreparedScene<PreparedBytes>,
        (full_size, samples): (Size, SampleCount),
        go_on: &(impl Fn() -> ControlFlow<()> + Sync),
    ) -> Option<Self> {
        let size = small(full_size);
        let pixels = render_rows(&scene, size, Sampling::Fixed(samples), go_on)?;
        let pixels = pixels.iter().map(|pixel| pixel.map(f64::from)).collect();
        let truth = Truth::new(pixels, size);
        Some(Self { name, scene, truth, reference: Some(Reference { samples, full_size }) })
    }
}

/// A frame of the same shape, no wider than [`OWN_WIDTH`].
fn small(full_size: Size) -> Size {
    let shrunk = (OWN_WIDTH / f64::from(full_size.width())).min(1.0);
    let side = |length: u32| ((f64::from(length) * shrunk).round() as u64).max(1);
    Size::new(side(full_size.width()), side(full_size.height())).expect("it is no larger")
}

/// A whole picture on all cores, row by row. `None` when `go_on` broke off.
fn render_rows(
    scene: &PreparedScene<PreparedBytes>,
    size: Size,
    sampling: Sampling,
    go_on: &(impl Fn() -> ControlFlow<()> + Sync),
) -> Option<Vec<[f32; 3]>> {
    // The last seed: no ladder comes to it.
    let seed = u64::MAX;
    let quality = Quality { sampling, seed, ..Quality::default() };
    let rows: Option<Vec<Vec<[f32; 3]>>> = (0..size.height())
        .into_par_iter()
        .map(|y0| {
            let area = Area::new(size, [0, y0], [size.width(), 1]).expect("a row of the frame");
            Some(render_tile(scene, &quality, area, Isa::fastest(), &mut || go_on())?.pixels)
        })
        .collect();
    rows.map(|rows| rows.concat())
}

/// What one setting gives, over all seeds.
#[derive(Debug)]
pub struct Rung {
    /// The setting as the command line has it.
    pub setting: String,
    /// The time that each run took on one thread.
    pub milliseconds: Vec<f64>,
    /// The mean number of samples; `None` where only the renderer knows.
    pub samples_a_pixel: Option<f64>,
    /// How far each picture is off.
    pub errors: Vec<Errors>,
    /// The error that was told over the true one, for each picture whose error was estimated.
    pub told: Vec<f64>,
}

/// Better and better settings of one kind.
#[derive(Debug)]
pub struct Series {
    /// The kind of setting, or the renderer.
    pub name: String,
    /// From coarse to fine; there is one at least.
    pub rungs: Vec<Rung>,
}

/// A scene with every kind of setting.
#[derive(Debug)]
pub struct Ladder {
    /// What the scene is called in the report.
    pub name: String,
    /// The size of its pictures.
    pub size: Size,
    /// What stands for the truth; `None` for a closed form.
    pub reference: Option<Reference>,
    /// First fixed numbers of samples, then smaller and smaller errors, then other renderers.
    pub series: Vec<Series>,
}

/// How far ladders go.
#[derive(Debug, Clone, Copy)]
pub struct Reach {
    /// Settings of each kind.
    pub rungs: usize,
    /// Pictures with each setting.
    pub seeds: u64,
}

impl Ladder {
    /// Renders every rung with every seed; the kinds take turns seed by seed, so that a busy
    /// moment of the machine meets both. `None` when `go_on` broke off.
    pub fn climb(
        subject: Subject,
        reach: Reach,
        go_on: &(impl Fn() -> ControlFlow<()> + Sync),
    ) -> Option<Self> {
        let fixed = (0..reach.rungs).map(|rung| Sampling::fixed(1 << rung).expect("few enough"));
        // Over one range however many there are: 32 to 0.5 steps of 8 bits.
        let finest = 12;
        let last = reach.rungs.max(2) - 1;
        let adaptive =
            (0..reach.rungs).filter_map(|rung| adaptive_settings().nth(rung * finest / last));
        let mut series = ["--samples", "--error"]
            .map(|name| Series { name: name.to_owned(), rungs: Vec::new() });
        for (fixed, adaptive) in fixed.zip(adaptive) {
            let pair = measure(&subject, [fixed, adaptive], reach.seeds, go_on)?;
            series.iter_mut().zip(pair).for_each(|(series, rung)| series.rungs.push(rung));
        }
        let Subject { name, truth, reference, .. } = subject;
        Some(Self { name, size: truth.size, reference, series: series.into() })
    }

    /// The fixed numbers of samples.
    pub fn fixed(&self) -> &[Rung] {
        &self.series[0].rungs
    }

    /// The errors that were asked for.
    pub fn adaptive(&self) -> &[Rung] {
        &self.series[1].rungs
    }

    /// Every rung of every series.
    pub fn rungs(&self) -> impl Iterator<Item = &Rung> {
        self.series.iter().flat_map(|series| &series.rungs)
    }
}

impl Rung {
    /// The root mean square error: the mean over pictures, and its 95 % band.
    pub fn rmse(&self) -> (f64, f64) {
        mean_and_band(self.errors.iter().map(|errors| errors.rmse))
    }

    /// The median time in milliseconds.
    pub fn time(&self) -> f64 {
        median(&self.milliseconds)
    }
}

/// One run of one seed: its time, its samples, how far off, and told over true.
type Run = (f64, u64, Errors, Option<f64>);

fn measure(
    subject: &Subject,
    samplings: [Sampling; 2],
    seeds: u64,
    go_on: &(impl Fn() -> ControlFlow<()> + Sync),
) -> Option<[Rung; 2]> {
    let runs: Option<Vec<[Run; 2]>> = (0..seeds)
        .into_par_iter()
        .map(|seed| {
            let [a, b] = samplings;
            Some([run(subject, a, seed, go_on)?, run(subject, b, seed, go_on)?])
        })
        .collect();
    let runs = runs?;
    let samples_of_one = 1.0 / (seeds * subject.truth.size.pixel_count()) as f64;
    Some([0, 1].map(|kind| {
        let runs = || runs.iter().map(|pair| &pair[kind]);
        let samples: u64 = runs().map(|run| run.1).sum();
        Rung {
            setting: setting(samplings[kind]),
            milliseconds: runs().map(|run| run.0).collect(),
            samples_a_pixel: Some(samples as f64 * samples_of_one),
            told: runs().filter_map(|run| run.3).filter(|ratio| ratio.is_finite()).collect(),
            errors: runs().map(|run| run.2.clone()).collect(),
        }
    }))
}

fn run(
    subject: &Subject,
    sampling: Sampling,
    seed: u64,
    go_on: &(impl Fn() -> ControlFlow<()> + Sync),
) -> Option<Run> {
    let Subject { scene, truth, .. } = subject;
    let size = truth.size;
    let quality = Quality { sampling, seed, ..Quality::default() };
    let area = Area::whole(size);
    let started = now();
    let rendered = render_tile(scene, &quality, area, Isa::fastest(), &mut || go_on())?;
    let milliseconds = started.elapsed().as_secs_f64() * 1e3;
    let asked = match sampling {
        Sampling::Adaptive { error, .. } => Some(error.get()),
        Sampling::Fixed(_) => None,
    };
    let errors = Errors::new(&rendered.pixels, truth, asked);
    let told = rendered.tally.error().map(|told| told / errors.rmse);
    Some((milliseconds, rendered.tally.samples, errors, told))
}

/// The setting as the command line has it.
fn setting(sampling: Sampling) -> String {
    match sampling {
        Sampling::Fixed(count) => format!("`--samples {count}`"),
        Sampling::Adaptive { error, most } => {
            format!("`--error {error:.3e} --max-samples {most}`")
        }
    }
}

#[expect(clippy::disallowed_methods, reason = "the time that a render takes is what is measured")]
fn now() -> Instant {
    Instant::now()
}
