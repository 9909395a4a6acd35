//! `rtfarm report`: speed against error of a user's scene, from renders that the report makes
//! itself. Its picture at many samples stands for the truth.

use std::{
    fs,
    io::{self, Write},
    ops::ControlFlow,
    path::Path,
};

use anyhow::{Context, anyhow};
use rtfarm_core::{
    language::{draw_diagnostics, read_scene},
    prepare::prepare,
    prepared::{PreparedBytes, PreparedScene},
    tile::Size,
};
use rtfarm_ladder::{Ladder, Report, Subject};
use tokio::task::spawn_blocking;
use tokio_util::sync::CancellationToken;

use crate::{
    args::{ReportArgs, SceneArgs},
    console::Console,
    failure::Failure,
    scene_files::SceneFiles,
    source::SceneText,
};

pub(crate) async fn run(
    args: ReportArgs,
    console: &Console,
    stop: &CancellationToken,
) -> Result<(), Failure> {
    let (scene, effort) = (args.scene(), args.effort);
    let in_place = |folder: &Path| format!("cannot write into the folder {}", folder.display());
    if let Some(folder) = &args.out {
        // Nobody waits for a report that has no place.
        fs::create_dir_all(folder).with_context(|| in_place(folder))?;
        tempfile::tempfile_in(folder).with_context(|| in_place(folder))?;
    }
    let (prepared, full_size) = read(&scene, console, stop).await?;
    let (name, token) = (scene.name(), stop.clone());
    let measuring = spawn_blocking(move || {
        let go_on = &|| {
            if token.is_cancelled() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
        };
        let reference = (full_size, effort.reference_samples());
        let subject = Subject::with_reference(name, prepared, reference, go_on)?;
        Ladder::climb(subject, effort.reach(), go_on)
    });
    let ladder = measuring.await?.ok_or(Failure::Interrupted)?;
    let report = Report::on_scene(&ladder, args.wanted)?;
    match args.out {
        Some(folder) => report.write(&folder).with_context(|| in_place(&folder))?,
        None => io::stdout()
            .lock()
            .write_all(report.text.as_bytes())
            .context("cannot write to standard output")?,
    }
    Ok(())
}

/// Reads and prepares the scene, and tells its diagnostics. Answers with the size that it is
/// rendered at otherwise, too.
async fn read(
    scene: &SceneArgs,
    console: &Console,
    stop: &CancellationToken,
) -> Result<(PreparedScene<PreparedBytes>, Size), Failure> {
    let text = SceneText::read(scene, stop).await?;
    let (name, files) = (scene.name(), SceneFiles::new(scene));
    let style = Console::drawing_style();
    let reading = spawn_blocking({
        let name = name.clone();
        move || {
            let reading = read_scene(&text, &|name: &str| files.read(name));
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
    Ok((prepared, read.size_hint.unwrap_or_else(|| viewport.default_size())))
}
