//! `rtfarm render`: a picture from this machine alone.

use std::{
    io::{self, Write},
    sync::Arc,
    time::Duration,
};

use anyhow::{Context, anyhow};
use rtfarm_coordinator::{Config, Coordinator, Job, Keeping, Listener};
use rtfarm_core::{
    language::draw_diagnostics,
    render::{DEEPEST, Sampling, Tally},
    tile::Size,
    transfer::Transfer,
};
use rtfarm_job::{Order, Outcome, Progress, Refusal};
use rtfarm_picture::{Canvas, Picture};
use rtfarm_proto::Address;
use tokio::{net::UnixListener, sync::watch, task::spawn_blocking, time::Instant};
use tokio_util::sync::CancellationToken;

use crate::{
    BUILD, VERSION,
    args::{PictureArgs, RenderArgs},
    children::{Children, Setup},
    console::Console,
    coordinator::UPLOAD_SILENCE,
    failure::Failure,
    local,
    output::Output,
    pilot,
    private_folder::PrivateFolder,
    resume::{Begun, Resume},
    scene_files::SceneFiles,
    source::SceneText,
};

/// What there is to say about a finished render.
#[derive(Debug)]
pub(crate) struct Summary {
    pub(crate) size: Size,
    pub(crate) tally: Tally,
    pub(crate) sampling: Sampling,
    pub(crate) transfer: Transfer,
    /// From the first lease to the last tile.
    pub(crate) rendering: Duration,
    pub(crate) workers: usize,
}

impl Summary {
    /// What there is to say of light that lies too deep.
    fn depth_text(&self) -> String {
        let Tally { samples, untraced, most_untraced, .. } = self.tally;
        if untraced == 0.0 {
            return String::new();
        }
        let [mean, most] = [untraced / samples as f64, most_untraced].map(|share| 100.0 * share);
        format!(", {mean:.2} % deeper than {DEEPEST} rays (at most {most:.2} % of a sample)")
    }

    /// How far off the picture may be.
    fn error_text(&self) -> String {
        let Tally { capped, .. } = self.tally;
        let Some(error) = self.tally.error() else {
            return "error not estimated".to_owned();
        };
        let capped = match self.sampling {
            Sampling::Adaptive { most, .. } if capped > 0 => {
                format!(" ({capped} pixels wanted more than {most} samples)")
            }
            _ => String::new(),
        };
        let unit = match self.transfer {
            Transfer::None => "",
            Transfer::Srgb => " in linear light",
        };
        format!("error {error:.2e}{unit}{capped}")
    }

    /// Writes the one line that a render ends with, unless it is quiet.
    pub(crate) fn tell(
        &self,
        started: Instant,
        output: &Output,
        console: &Console,
    ) -> anyhow::Result<()> {
        if console.is_quiet() {
            return Ok(());
        }
        let mrays = self.tally.rays as f64 / 1e6;
        writeln!(
            io::stdout().lock(),
            "{size} in {seconds:.2} s, {mrays:.1} Mrays, {rate:.1} Mrays/s, {workers} {noun}, {samples:.1} samples a pixel, {error}{depth}: {path}",
            size = self.size,
            seconds = started.elapsed().as_secs_f64(),
            rate = mrays / self.rendering.as_secs_f64().max(1e-9),
            workers = self.workers,
            noun = if self.workers == 1 { "worker" } else { "workers" },
            samples = self.tally.samples as f64 / self.size.pixel_count() as f64,
            error = self.error_text(),
            depth = self.depth_text(),
            path = output.name().display()
        )
        .context("cannot write to standard output")
    }
}

pub(crate) async fn run(
    args: RenderArgs,
    console: &Console,
    stop: &CancellationToken,
) -> Result<(), Failure> {
    let started = Instant::now();
    let mut output = args.picture.output().map_err(Failure::Input)?;
    output.check()?;
    let text = SceneText::read(&args.picture.scene, stop).await?;
    let mut order = place(&args.picture, &output, text, console, stop).await?;
    if let Some(time) = args.time {
        order = choose_quality(order, time, &args, stop).await?;
    }
    let (order, begun, resume) = begin(order, &output, args.resume).await?;
    let summary = match args.workers_and_threads() {
        (0, threads) => render_here(order, begun, threads, &args, &output, console, stop).await?,
        workers => {
            render_with_workers(order, begun, workers, &args, &output, console, stop).await?
        }
    };
    if let Some(resume) = resume {
        resume.remove()?;
    }
    summary.tell(started, &output, console)?;
    if let Some(time) = args.time {
        let over = summary.rendering.as_secs_f64() / time.as_secs_f64() - 1.0;
        tracing::info!(
            over_percent = (100.0 * over).round(),
            "rendered in {:.2} s where {:.2} s were allowed",
            summary.rendering.as_secs_f64(),
            time.as_secs_f64()
        );
    }
    Ok(())
}

/// Chooses the quality for a picture that may take that long.
async fn choose_quality(
    order: Order,
    time: Duration,
    args: &RenderArgs,
    stop: &CancellationToken,
) -> Result<Order, Failure> {
    let (workers, threads) = args.workers_and_threads();
    let (isa, stop) = (args.isa.0, stop.clone());
    let choosing = spawn_blocking(move || {
        let chosen = pilot::choose(&order, (workers.max(1) * threads, isa), time, &stop);
        chosen.map(|chosen| (order, chosen))
    });
    let (mut order, chosen) = choosing.await??;
    let sampling = chosen.ok_or(Failure::Interrupted)?;
    order.settings.quality.sampling = sampling;
    if let Sampling::Adaptive { error, most } = sampling {
        tracing::info!("the same picture again: --error {error} --max-samples {most}");
    }
    Ok(order)
}

/// Reads and prepares the scene, and tells its diagnostics.
async fn place(
    args: &PictureArgs,
    output: &Output,
    text: SceneText,
    console: &Console,
    stop: &CancellationToken,
) -> Result<Order, Failure> {
    let request = args.request(output.format());
    let files = SceneFiles::new(&args.scene);
    let (name, style) = (args.scene.name(), Console::drawing_style());
    let placing = spawn_blocking(move || {
        let placed = request.place(&text, &|name: &str| files.read(name));
        let mut report = draw_diagnostics(&name, &text, &placed.diagnostics, style);
        report.extend(placed.omitted.summary());
        text.ensure_unchanged().map(|()| (placed.order, report))
    });
    let placed = tokio::select! {
        placed = placing => placed?,
        () = stop.cancelled() => return Err(Failure::Interrupted),
    };
    let (order, report) =
        placed.with_context(|| format!("cannot read the scene {}", args.scene.name()))?;
    console.tell_report(&report);
    order.map_err(|refusal| match refusal {
        Refusal::Scene => Failure::Told,
        Refusal::Other(reason) => {
            Failure::Input(anyhow!("cannot render {}: {reason}", args.scene.name()))
        }
    })
}

/// Begins a picture, or takes it up where an earlier process was interrupted.
async fn begin(
    order: Order,
    output: &Output,
    may_resume: bool,
) -> Result<(Order, Begun, Option<Resume>), Failure> {
    let output = output.clone();
    let beginning = spawn_blocking(move || -> anyhow::Result<_> {
        if may_resume {
            let (resume, begun) = Resume::open(&output, &order)?;
            return Ok((order, begun, Some(resume)));
        }
        let folder = output.folder();
        let canvas = Canvas::new_in(&folder, order.grid, order.format, order.transfer)
            .with_context(|| format!("cannot make the picture's file in {}", folder.display()))?;
        Ok((order, (canvas, Vec::new()), None))
    });
    Ok(beginning.await??)
}

async fn render_here(
    order: Order,
    (canvas, done): Begun,
    threads: usize,
    args: &RenderArgs,
    output: &Output,
    console: &Console,
    stop: &CancellationToken,
) -> Result<Summary, Failure> {
    let (size, sampling) = (order.grid.window().size(), order.settings.quality.sampling);
    let transfer = order.transfer;
    let tile_count = order.grid.count();
    let progress = watch::Sender::new(Progress { tile_count, ..Progress::default() });
    let mut shown = progress.subscribe();
    let bar = console.start_bar(tile_count);
    let rendering = spawn_blocking({
        let (isa, stop) = (args.isa.0, stop.clone());
        move || {
            let rendered = local::render(order, canvas, &done, (threads, isa), &progress, &stop);
            let tally = progress.borrow().tally;
            rendered.map(|rendered| (rendered, tally))
        }
    });
    let show = async {
        while shown.changed().await.is_ok() {
            bar.show(&shown.borrow_and_update());
        }
    };
    let (rendered, ()) = tokio::join!(rendering, show);
    drop(bar);
    let (Some((canvas, rendering)), tally) = rendered?? else {
        return Err(Failure::Interrupted);
    };
    write_picture(output, stop, move |write| write(canvas.picture())).await?;
    Ok(Summary { size, tally, sampling, transfer, rendering, workers: 0 })
}

async fn render_with_workers(
    order: Order,
    (canvas, done): Begun,
    (workers, threads): (usize, usize),
    args: &RenderArgs,
    output: &Output,
    console: &Console,
    stop: &CancellationToken,
) -> Result<Summary, Failure> {
    let (sampling, transfer) = (order.settings.quality.sampling, order.transfer);
    let folder = PrivateFolder::new(&std::env::temp_dir())?;
    let socket = folder.path().join("socket");
    let listener = UnixListener::bind(&socket)
        .with_context(|| format!("cannot listen on {}", socket.display()))?;
    let coordinator = Coordinator::new(Config {
        version: VERSION.to_owned(),
        build: BUILD.to_owned(),
        // The workers are this very program on this machine: nobody here has a reason to lie.
        reference: None,
        term: args.lease_seconds,
        audit: 0.0,
        keeping: Keeping::default(),
        upload_silence: UPLOAD_SILENCE,
        scene_folder: folder.path().to_owned(),
        picture_folder: output.folder(),
    })?;
    let job = spawn_blocking({
        let coordinator = coordinator.clone();
        move || coordinator.submit_on(order, canvas, &done)
    });
    let job = job.await??;
    let stop_serving = CancellationToken::new();
    let serving = tokio::spawn({
        let (coordinator, stop) = (coordinator.clone(), stop_serving.clone());
        async move { coordinator.run(Listener::Unix(listener), stop.cancelled()).await }
    });
    let setup = Setup {
        coordinator: Address::Unix(socket),
        threads,
        isa: args.isa.0,
        log_format: args.log_format,
    };
    let mut children = Children::start(workers, setup, console).context("cannot start workers")?;

    let rendered = tokio::select! {
        rendered = wait(&job, console) => rendered,
        reason = children.keep_up(&coordinator, args.patience) => {
            Err(Failure::Other(anyhow!(reason)))
        }
        () = stop.cancelled() => Err(Failure::Interrupted),
    };
    coordinator.close();
    let written = match rendered {
        Ok(rendering) => {
            let picture = Arc::clone(&job);
            let writing = write_picture(output, stop, move |write| write(picture.picture()));
            let (written, ()) = tokio::join!(writing, children.go_home(&coordinator));
            written.map(|()| rendering)
        }
        Err(failure) => {
            coordinator.cancel(job.id());
            children.end(&coordinator).await;
            Err(failure)
        }
    };
    stop_serving.cancel();
    serving.await??;
    let progress = job.progress();
    let (size, tally) = (job.picture().size(), progress.borrow().tally);
    Ok(Summary { size, tally, sampling, transfer, rendering: written?, workers })
}

/// Shows how far a job is until it ends.
async fn wait(job: &Job, console: &Console) -> Result<Duration, Failure> {
    let mut progress = job.progress();
    let bar = console.start_bar(progress.borrow().tile_count);
    loop {
        {
            let progress = progress.borrow_and_update();
            bar.show(&progress);
            match &progress.outcome {
                Some(Outcome::Finished(time)) => return Ok(*time),
                Some(Outcome::Failed(reason)) => return Err(Failure::Other(anyhow!("{reason}"))),
                None => {}
            }
        }
        progress.changed().await?;
    }
}

/// Encodes a picture into its file. `with` hands the picture over.
async fn write_picture(
    output: &Output,
    stop: &CancellationToken,
    with: impl FnOnce(&mut dyn FnMut(&Picture) -> anyhow::Result<()>) -> anyhow::Result<()>
    + Send
    + 'static,
) -> Result<(), Failure> {
    let (output, token) = (output.clone(), stop.clone());
    let written = spawn_blocking(move || {
        with(&mut |picture| output.write(&token, |file| picture.encode(file)))
    });
    match written.await? {
        Err(_) if stop.is_cancelled() => Err(Failure::Interrupted),
        written => Ok(written?),
    }
}
