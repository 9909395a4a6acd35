//! `rtfarm report`: speed against error, from renders that the report makes itself.
//!
//! Without a scene: pictures with closed forms, so the error is the true one. With a scene: its own
//! picture at many samples stands for the truth.

mod figures;
mod ladder;
mod plot;
mod tables;

use std::{
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
    render::{Quality, Sampling, Settings, render_tile},
    tile::{Area, Size},
};
use rtfarm_oracle::known_pictures::known_pictures;
use tokio::task::spawn_blocking;
use tokio_util::sync::CancellationToken;

use crate::{
    args::{Effort, ReportArgs, SceneArgs},
    console::Console,
    failure::Failure,
    source::{SceneText, scene_folder},
};
use ladder::{Ladder, Subject};

/// The width of a user's own picture in the report, in pixels; its height follows.
const OWN_WIDTH: f64 = 160.0;

/// How much work a report is.
struct Plan {
    /// Pixels across a closed-form picture.
    width: u32,
    seeds: u64,
    /// Rungs of each ladder.
    rungs: usize,
    /// Samples of what stands for the truth of a user's scene.
    reference: u32,
}

impl Plan {
    fn new(effort: Effort) -> Self {
        match effort {
            Effort::Smoke => Self { width: 24, seeds: 2, rungs: 3, reference: 512 },
            Effort::Quick => Self { width: 64, seeds: 8, rungs: 6, reference: 4096 },
            Effort::Full => Self { width: 128, seeds: 16, rungs: 8, reference: 16_384 },
        }
    }
}

pub(crate) async fn run(
    args: ReportArgs,
    console: &Console,
    stop: &CancellationToken,
) -> Result<(), Failure> {
    let plan = Plan::new(args.effort);
    let token = stop.clone();
    let subjects = if let Some(scene) = args.scene() {
        vec![own_subject(&scene, &plan, console, stop).await?]
    } else {
        let width = plan.width;
        let known = spawn_blocking(move || known_pictures(width)).await?;
        known.into_iter().map(Subject::from).collect()
    };
    let measured = spawn_blocking(move || {
        let ladders = subjects.into_iter().map(|subject| Ladder::climb(subject, &plan, &token));
        ladders.collect::<Option<Vec<Ladder>>>()
    });
    let ladders = measured.await?.ok_or(Failure::Interrupted)?;
    let is_own = args.scene.is_some();
    let text = tables::report(&ladders, is_own);
    if let Some(folder) = &args.out {
        write(folder, &text, &ladders)?;
    } else {
        io::stdout()
            .lock()
            .write_all(text.as_bytes())
            .context("cannot write to standard output")?;
    }
    Ok(())
}

/// Puts the report and its plot into a folder, each file whole or not at all.
fn write(folder: &Path, text: &str, ladders: &[Ladder]) -> anyhow::Result<()> {
    let in_place = || format!("cannot write into the folder {}", folder.display());
    fs::create_dir_all(folder).with_context(in_place)?;
    let text = format!("{text}\n![error against time]({})\n", plot::FILE);
    for (name, content) in [("report.md", text), (plot::FILE, plot::draw(ladders)?)] {
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
        let truth = render_rows(&prepared, size, Sampling::Fixed(count), u64::MAX, &stop)?;
        let truth = truth.iter().map(|pixel| pixel.map(f64::from)).collect();
        Some(Subject { name, scene: prepared, size, truth, reference: Some(count) })
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
    let settings = Settings { size, quality: Quality { sampling, seed, ..Quality::default() } };
    let rows: Option<Vec<Vec<[f32; 3]>>> = (0..size.height())
        .into_par_iter()
        .map(|y0| {
            let area = Area { x0: 0, y0, width: size.width(), height: 1 };
            let go_on = &mut || ladder::go_on(stop);
            Some(render_tile(scene, &settings, area, Isa::fastest(), go_on)?.pixels)
        })
        .collect();
    rows.map(|rows| rows.concat())
}
