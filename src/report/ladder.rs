//! One scene at many settings: what each takes and how far off it is.

use std::ops::ControlFlow;

use rayon::prelude::*;
use rtfarm_core::{
    isa::Isa,
    prepare::prepare,
    prepared::{PreparedBytes, PreparedScene},
    render::{Quality, Sampling, render_tile},
    tile::{Area, Size},
};
use rtfarm_oracle::known_pictures::KnownPicture;
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;

use super::figures::{Errors, Truth, mean_and_band, median};
use crate::pilot;

/// A scene and its true picture.
pub(super) struct Subject {
    pub(super) name: String,
    pub(super) scene: PreparedScene<PreparedBytes>,
    pub(super) truth: Truth,
    /// What stands for the truth; `None` for a closed form.
    pub(super) reference: Option<Reference>,
}

/// A picture that stands for the truth of a user's scene.
#[derive(Debug, Clone, Copy)]
pub(super) struct Reference {
    /// Samples a pixel.
    pub(super) samples: u32,
    /// The size that the scene is rendered at otherwise.
    pub(super) full_size: Size,
}

impl From<KnownPicture> for Subject {
    fn from(known: KnownPicture) -> Self {
        let KnownPicture { name, scene, size, truth, .. } = known;
        let bytes = prepare(&scene).expect("a plain scene");
        let scene = PreparedScene::open(bytes).expect("what was just prepared");
        let truth = Truth::new(truth, size);
        Self { name: name.to_owned(), scene, truth, reference: None }
    }
}

/// What one setting gives, over all seeds.
pub(super) struct Rung {
    /// As the command line has it.
    pub(super) setting: String,
    /// Of one thread, of each run.
    pub(super) milliseconds: Vec<f64>,
    /// Unless only the renderer knows.
    pub(super) samples_a_pixel: Option<f64>,
    /// Of each picture.
    pub(super) errors: Vec<Errors>,
    /// Told over true, of each picture whose error was estimated.
    pub(super) told: Vec<f64>,
}

/// Better and better settings of one kind.
pub(super) struct Series {
    pub(super) name: String,
    pub(super) rungs: Vec<Rung>,
}

/// A scene with every kind of setting.
pub(super) struct Ladder {
    pub(super) name: String,
    pub(super) size: Size,
    pub(super) reference: Option<Reference>,
    /// First fixed numbers of samples, then smaller and smaller errors, then other renderers.
    pub(super) series: Vec<Series>,
}

/// How far ladders go.
#[derive(Debug, Clone, Copy)]
pub(super) struct Reach {
    pub(super) rungs: usize,
    pub(super) seeds: u64,
}

pub(super) fn go_on(stop: &CancellationToken) -> ControlFlow<()> {
    if stop.is_cancelled() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
}

impl Ladder {
    /// Renders every rung with every seed; the kinds take turns seed by seed, so that a busy
    /// moment of the machine meets both. `None` when `stop` came first.
    pub(super) fn climb(subject: Subject, reach: Reach, stop: &CancellationToken) -> Option<Self> {
        let fixed = (0..reach.rungs).map(|rung| Sampling::fixed(8 << rung).expect("few enough"));
        // Over one range however many there are: 16 to 0.5 steps of 8 bits.
        let finest = 10;
        let last = reach.rungs.max(2) - 1;
        let adaptive =
            (0..reach.rungs).filter_map(|rung| pilot::ladder().nth(rung * finest / last));
        let mut series = ["--samples", "--error"]
            .map(|name| Series { name: name.to_owned(), rungs: Vec::new() });
        for (fixed, adaptive) in fixed.zip(adaptive) {
            let pair = measure(&subject, [fixed, adaptive], reach.seeds, stop)?;
            series.iter_mut().zip(pair).for_each(|(series, rung)| series.rungs.push(rung));
        }
        let Subject { name, truth, reference, .. } = subject;
        tracing::info!(scene = name, "measured");
        Some(Self { name, size: truth.size, reference, series: series.into() })
    }

    pub(super) fn fixed(&self) -> &[Rung] {
        &self.series[0].rungs
    }

    pub(super) fn adaptive(&self) -> &[Rung] {
        &self.series[1].rungs
    }

    pub(super) fn rungs(&self) -> impl Iterator<Item = &Rung> {
        self.series.iter().flat_map(|series| &series.rungs)
    }
}

impl Rung {
    /// The root mean square error: the mean over pictures, and its 95 % band.
    pub(super) fn rmse(&self) -> (f64, f64) {
        mean_and_band(self.errors.iter().map(|errors| errors.rmse))
    }

    pub(super) fn time(&self) -> f64 {
        median(&self.milliseconds)
    }
}

/// One run of one seed: its time, its samples, how far off, and told over true.
type Run = (f64, u64, Errors, Option<f64>);

fn measure(
    subject: &Subject,
    samplings: [Sampling; 2],
    seeds: u64,
    stop: &CancellationToken,
) -> Option<[Rung; 2]> {
    let runs: Option<Vec<[Run; 2]>> = (0..seeds)
        .into_par_iter()
        .map(|seed| {
            let [a, b] = samplings;
            Some([run(subject, a, seed, stop)?, run(subject, b, seed, stop)?])
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

fn run(subject: &Subject, sampling: Sampling, seed: u64, stop: &CancellationToken) -> Option<Run> {
    let Subject { scene, truth, .. } = subject;
    let size = truth.size;
    let quality = Quality { sampling, seed, ..Quality::default() };
    let area = Area::whole(size);
    let started = Instant::now();
    let rendered = render_tile(scene, &quality, area, Isa::fastest(), &mut || go_on(stop))?;
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
