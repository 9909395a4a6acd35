//! One scene at many settings: what each takes and how far off it is.

use std::ops::ControlFlow;

use rayon::prelude::*;
use rtfarm_core::{
    isa::Isa,
    prepare::prepare,
    prepared::{PreparedBytes, PreparedScene},
    render::{Quality, Sampling, Settings, render_tile},
    tile::{Area, Size},
};
use rtfarm_oracle::known_pictures::KnownPicture;
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;

use super::{
    Plan,
    figures::{Errors, median},
};
use crate::pilot;

/// A scene and its true picture.
pub(super) struct Subject {
    pub(super) name: String,
    pub(super) scene: PreparedScene<PreparedBytes>,
    pub(super) size: Size,
    pub(super) truth: Vec<[f64; 3]>,
    /// The samples of what stands for the truth; `None` for a closed form.
    pub(super) reference: Option<u32>,
}

impl From<KnownPicture> for Subject {
    fn from(known: KnownPicture) -> Self {
        let KnownPicture { name, scene, size, truth } = known;
        let bytes = prepare(&scene).expect("a plain scene");
        let scene = PreparedScene::open(bytes).expect("what was just prepared");
        Self { name: name.to_owned(), scene, size, truth, reference: None }
    }
}

/// What one setting gives, over all seeds.
pub(super) struct Rung {
    pub(super) sampling: Sampling,
    /// Of one thread, in milliseconds: the median.
    pub(super) milliseconds: f64,
    pub(super) samples_a_pixel: f64,
    /// Of each seed.
    pub(super) errors: Vec<Errors>,
    /// Told over true, of each seed whose error was estimated.
    pub(super) told: Vec<f64>,
}

/// A scene at fixed numbers of samples, then at smaller and smaller errors.
pub(super) struct Ladder {
    pub(super) name: String,
    pub(super) size: Size,
    pub(super) reference: Option<u32>,
    pub(super) fixed: Vec<Rung>,
    pub(super) adaptive: Vec<Rung>,
}

pub(super) fn go_on(stop: &CancellationToken) -> ControlFlow<()> {
    if stop.is_cancelled() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
}

impl Ladder {
    /// Renders every rung with every seed; the kinds take turns, so that a busy moment of the
    /// machine meets both. `None` when `stop` came first.
    pub(super) fn climb(subject: Subject, plan: &Plan, stop: &CancellationToken) -> Option<Self> {
        let fixed = (0..plan.rungs).map(|rung| Sampling::Fixed(8 << rung));
        let adaptive = pilot::ladder().step_by(2).take(plan.rungs);
        let mut rungs = [Vec::new(), Vec::new()];
        for pair in fixed.zip(adaptive) {
            for (rungs, sampling) in rungs.iter_mut().zip([pair.0, pair.1]) {
                rungs.push(measure(&subject, sampling, plan.seeds, stop)?);
            }
        }
        let [fixed, adaptive] = rungs;
        let Subject { name, size, reference, .. } = subject;
        tracing::info!(scene = name, "measured");
        Some(Self { name, size, reference, fixed, adaptive })
    }

    /// All rungs, fixed ones first.
    pub(super) fn rungs(&self) -> impl Iterator<Item = &Rung> {
        self.fixed.iter().chain(&self.adaptive)
    }
}

fn measure(
    subject: &Subject,
    sampling: Sampling,
    seeds: u64,
    stop: &CancellationToken,
) -> Option<Rung> {
    let Subject { scene, size, truth, .. } = subject;
    let area = Area { x0: 0, y0: 0, width: size.width(), height: size.height() };
    let runs: Option<Vec<_>> = (0..seeds)
        .into_par_iter()
        .map(|seed| {
            let quality = Quality { sampling, seed, ..Quality::default() };
            let settings = Settings { size: *size, quality };
            let started = Instant::now();
            let go_on = &mut || go_on(stop);
            let rendered = render_tile(scene, &settings, area, Isa::fastest(), go_on)?;
            let milliseconds = started.elapsed().as_secs_f64() * 1e3;
            let errors = Errors::new(&rendered.pixels, truth, sampling);
            let told = rendered.tally.error().map(|told| told / errors.rmse);
            Some((milliseconds, rendered.tally.samples, errors, told))
        })
        .collect();
    let runs = runs?;
    let samples: u64 = runs.iter().map(|run| run.1).sum();
    Some(Rung {
        sampling,
        milliseconds: median(runs.iter().map(|run| run.0)),
        samples_a_pixel: samples as f64 / (seeds * size.pixel_count()) as f64,
        told: runs.iter().filter_map(|run| run.3).filter(|ratio| ratio.is_finite()).collect(),
        errors: runs.into_iter().map(|run| run.2).collect(),
    })
}
