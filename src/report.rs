//! `rtfarm report`: speed against error, from renders that the report makes itself.
//!
//! Without a scene: pictures with closed forms, so the error is the true one, and rays through a
//! closed mesh. With a scene: its own picture at many samples stands for the truth.

mod figures;
mod flip;
mod kernels;
mod ladder;
mod peers;
mod plot;
mod tables;

use std::{
    collections::BTreeMap,
    fs,
    io::{self, Write},
    os::unix::fs::PermissionsExt,
    path::Path,
};

use anyhow::{Context, anyhow};
use rtfarm_core::{
    isa::Isa,
    prepare::prepare,
    prepared::{PreparedBytes, PreparedScene},
    read::{draw_diagnostics, read_scene},
    render::{Quality, Sampling, render_tile},
    tile::{Area, Size},
};
use rtfarm_oracle::known_pictures::{indirect_pictures, known_pictures, known_size};
use tokio::task::spawn_blocking;
use tokio_util::sync::CancellationToken;

use crate::{
    args::{Effort, ReportArgs, SceneArgs},
    console::Console,
    failure::Failure,
    source::{SceneText, scene_folder},
};
use figures::Truth;
use kernels::{Amount, Case};
use ladder::{Ladder, Reach, Reference, Subject};

/// The width of a user's own picture in the report, in pixels; its height follows.
const OWN_WIDTH: f64 = 160.0;

/// How much work a report is.
#[derive(Debug, Clone, Copy)]
struct Plan {
    /// Pixels across a closed-form picture.
    width: u32,
    reach: Reach,
    /// Samples of what stands for the truth of a user's scene.
    reference: u32,
    kernels: Amount,
    /// Pixels across a picture that other renderers make too: more, for some start slowly.
    peers_width: u32,
    peers_reach: Reach,
}

impl Plan {
    fn new(effort: Effort) -> Self {
        match effort {
            Effort::Smoke => Self {
                width: 24,
                reach: Reach { rungs: 3, seeds: 2 },
                reference: 512,
                kernels: Amount { rays: 500, exact: 5, textbook: 50, runs: 1 },
                peers_width: 24,
                peers_reach: Reach { rungs: 2, seeds: 2 },
            },
            Effort::Quick => Self {
                width: 64,
                reach: Reach { rungs: 6, seeds: 8 },
                reference: 4096,
                kernels: Amount { rays: 20_000, exact: 100, textbook: 2_000, runs: 9 },
                peers_width: 128,
                peers_reach: Reach { rungs: 6, seeds: 9 },
            },
            Effort::Full => Self {
                width: 96,
                reach: Reach { rungs: 8, seeds: 16 },
                reference: 16_384,
                kernels: Amount { rays: 200_000, exact: 2_000, textbook: 20_000, runs: 15 },
                peers_width: 256,
                peers_reach: Reach { rungs: 6, seeds: 9 },
            },
        }
    }
}

/// What a report holds, and its text and plots.
struct Report {
    text: String,
    /// Files beside it.
    plots: Vec<(&'static str, String)>,
}

pub(crate) async fn run(
    args: ReportArgs,
    console: &Console,
    stop: &CancellationToken,
) -> Result<(), Failure> {
    let plan = Plan::new(args.effort);
    if let Some(folder) = args.for_peers {
        let writing = spawn_blocking(move || {
            peers::write(&folder, known_size(plan.peers_width), plan.kernels.rays)
        });
        return Ok(writing.await??);
    }
    let token = stop.clone();
    let report = if let Some(scene) = args.scene() {
        let subject = own_subject(&scene, &plan, console, stop).await?;
        let wanted = args.wanted;
        spawn_blocking(move || on_scene(subject, &plan, wanted, &token)).await??
    } else {
        spawn_blocking(move || on_known(&plan, args.peers.as_deref(), &token)).await??
    };
    let report = report.ok_or(Failure::Interrupted)?;
    if let Some(folder) = &args.out {
        write(folder, &report)?;
    } else {
        io::stdout()
            .lock()
            .write_all(report.text.as_bytes())
            .context("cannot write to standard output")?;
    }
    Ok(())
}

/// The report on a user's scene. `None` when `stop` came first.
fn on_scene(
    subject: Subject,
    plan: &Plan,
    wanted: Option<f64>,
    stop: &CancellationToken,
) -> anyhow::Result<Option<Report>> {
    let Some(ladder) = Ladder::climb(subject, plan.reach, stop) else { return Ok(None) };
    let text = tables::on_scene(&ladder, wanted);
    let plots = vec![(plot::ERROR_FILE, plot::errors(&[ladder])?)];
    Ok(Some(Report { text, plots }))
}

/// The report on pictures and distances that are known, with what others left in `folder`. `None`
/// when `stop` came first.
fn on_known(
    plan: &Plan,
    folder: Option<&Path>,
    stop: &CancellationToken,
) -> anyhow::Result<Option<Report>> {
    // What others left is read first: what is wrong with it is told before the work.
    let beside: Vec<Subject> = match folder {
        Some(_) => known_pictures(plan.peers_width).into_iter().map(Subject::from).collect(),
        None => Vec::new(),
    };
    let truth_of = |name: &str| {
        beside.iter().find(|subject| subject.name == name).map(|subject| &subject.truth)
    };
    let mut others = match folder {
        Some(folder) => peers::read_pictures(folder, &truth_of)?,
        None => BTreeMap::new(),
    };
    let kernels_of = |moved, aim| match folder {
        Some(folder) => peers::read_kernels(folder, moved, aim),
        None => Ok(Vec::new()),
    };

    let Some(cases) = Case::measure_all(plan.kernels, &kernels_of, stop)? else { return Ok(None) };
    let known = known_pictures(plan.width).into_iter().chain(indirect_pictures(plan.width));
    let climb = |subject| Ladder::climb(subject, plan.reach, stop);
    let Some(ladders) = known.map(Subject::from).map(climb).collect::<Option<Vec<_>>>() else {
        return Ok(None);
    };
    let mut ladders_beside = Vec::new();
    for subject in beside {
        let Some(series) = others.remove(&subject.name) else { continue };
        let climbed = Ladder::climb(subject, plan.peers_reach, stop);
        let Some(mut ladder) = climbed else { return Ok(None) };
        ladder.series.extend(series);
        ladders_beside.push(ladder);
    }

    let text = tables::on_known(&ladders, &ladders_beside, &cases, plan.kernels);
    let mut plots = vec![
        (plot::ERROR_FILE, plot::errors(&ladders)?),
        (plot::KERNEL_FILE, plot::kernels(&cases)?),
    ];
    if !ladders_beside.is_empty() {
        plots.push((plot::PEERS_FILE, plot::errors(&ladders_beside)?));
    }
    Ok(Some(Report { text, plots }))
}

/// Puts the report and its plots into a folder, each file whole or not at all.
fn write(folder: &Path, report: &Report) -> anyhow::Result<()> {
    let in_place = || format!("cannot write into the folder {}", folder.display());
    fs::create_dir_all(folder).with_context(in_place)?;
    let text = [("report.md", &report.text)];
    for (name, content) in
        text.into_iter().chain(report.plots.iter().map(|(name, plot)| (*name, plot)))
    {
        let file = tempfile::Builder::new()
            .permissions(fs::Permissions::from_mode(0o666))
            .tempfile_in(folder)
            .with_context(in_place)?;
        fs::write(file.path(), content).with_context(in_place)?;
        file.persist(folder.join(name)).map_err(|error| error.error).with_context(in_place)?;
    }
    Ok(())
}

/// The user's scene in a small frame, and its picture at many samples.
async fn own_subject(
    scene: &SceneArgs,
    plan: &Plan,
    console: &Console,
    stop: &CancellationToken,
) -> Result<Subject, Failure> {
    let text = SceneText::read(scene, stop).await?;
    let (name, folder) = (scene.name(), scene_folder(scene));
    let style = Console::drawing_style();
    let reading = spawn_blocking({
        let name = name.clone();
        move || {
            let reading = read_scene(&text, &|path: &str| fs::read(folder.join(path)));
            let report = draw_diagnostics(&name, &text, &reading.diagnostics, style);
            text.ensure_unchanged().map(|()| (reading.scene, report))
        }
    });
    let (read, report) = reading.await?.with_context(|| format!("cannot read the scene {name}"))?;
    console.tell_report(&report);
    let read = read.ok_or(Failure::Told)?;
    let cannot = |reason: String| Failure::Input(anyhow!("cannot render {name}: {reason}"));
    let bytes = prepare(&read).map_err(|error| cannot(error.to_string()))?;
    let prepared = PreparedScene::open(bytes).map_err(|error| cannot(error.to_string()))?;
    let viewport = read.viewport.expect("what is prepared has one");
    let wish = read.size_hint.unwrap_or_else(|| viewport.default_size());
    let shrunk = (OWN_WIDTH / f64::from(wish.width())).min(1.0);
    let side = |length: u32| ((f64::from(length) * shrunk).round() as u64).max(1);
    let size = Size::new(side(wish.width()), side(wish.height())).expect("smaller than one");

    let count = plan.reference;
    let stop = stop.clone();
    let rendering = spawn_blocking(move || {
        let truth = render_rows(
            &prepared,
            size,
            Sampling::fixed(count).expect("a plan's number"),
            u64::MAX,
            &stop,
        )?;
        let truth = truth.iter().map(|pixel| pixel.map(f64::from)).collect();
        let truth = Truth::new(truth, size);
        Some(Subject {
            name,
            scene: prepared,
            truth,
            reference: Some(Reference { samples: count, full_size: wish }),
        })
    });
    rendering.await?.ok_or(Failure::Interrupted)
}

/// A whole picture on all cores, row by row. `None` when `stop` came first.
fn render_rows(
    scene: &PreparedScene<PreparedBytes>,
    size: Size,
    sampling: Sampling,
    seed: u64,
    stop: &CancellationToken,
) -> Option<Vec<[f32; 3]>> {
    use rayon::prelude::*;
    let quality = Quality { sampling, seed, ..Quality::default() };
    let rows: Option<Vec<Vec<[f32; 3]>>> = (0..size.height())
        .into_par_iter()
        .map(|y0| {
            let area = Area::new(size, [0, y0], [size.width(), 1]).expect("a row of the frame");
            let go_on = &mut || ladder::go_on(stop);
            Some(render_tile(scene, &quality, area, Isa::fastest(), go_on)?.pixels)
        })
        .collect();
    rows.map(|rows| rows.concat())
}
