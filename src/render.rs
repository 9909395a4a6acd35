//! `rtfarm render`: a picture by this machine alone, or by a cluster's nodes.

use std::{
    collections::{BTreeSet, VecDeque},
    io::{self, Seek, Write},
    sync::{Arc, Mutex},
    time::Duration,
};

use anyhow::{Context, anyhow};
use rtfarm_coordinator::{Config, Coordinator, Job, Keeping, Listener, OrderLimits};
use rtfarm_core::{
    isa::Isa,
    language::{Style, draw_diagnostics},
    render::{DEEPEST, Sampling, Tally},
    tile::Size,
    transfer::Transfer,
};
use rtfarm_job::{Order, Outcome, Progress, Provenance, Refusal};
use rtfarm_picture::{Canvas, Notes, PictureReader};
use rtfarm_proto::Address;
use rustix::system::uname;
use tokio::{
    net::UnixListener,
    sync::watch,
    task::spawn_blocking,
    time::{Instant, sleep},
};
use tokio_util::sync::CancellationToken;

use crate::{
    BUILD, VERSION,
    args::{PictureArgs, RenderArgs},
    cache::{Cache, NamedFiles},
    children::{Children, Setup},
    console::{Bar, Console},
    coordinator::UPLOAD_SILENCE,
    failure::Failure,
    local,
    output::Output,
    pilot,
    preview::{Preview, Screen},
    private_folder::PrivateFolder,
    resume::{Begun, Resume},
    scene_files::SceneFiles,
    show,
    sidecar::Making,
    slurm,
    source::SceneText,
};

/// So long those who watch a picture on its page see that it is finished.
const LAST_LOOK: Duration = Duration::from_millis(700);

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
    /// Where they ran.
    pub(crate) hosts: Arc<BTreeSet<String>>,
}

impl Summary {
    /// What the file beside the picture is to say.
    pub(crate) fn making(&self) -> Making {
        let Self { tally, rendering, workers, .. } = *self;
        Making { rendering, workers, hosts: self.hosts.as_ref().clone(), tally }
    }

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
        let line = format!(
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
        );
        console.answer(&line).context("cannot write to standard output")
    }
}

/// A picture to be rendered.
struct Frame {
    order: Order,
    begun: Begun,
    output: Output,
    resume: Option<Resume>,
}

/// A picture under way, by those who render it.
struct Started {
    size: Size,
    sampling: Sampling,
    transfer: Transfer,
    output: Output,
    resume: Option<Resume>,
    work: Work,
}

enum Work {
    /// This process renders it when its turn comes.
    Here(Box<(Order, Begun)>),
    /// Workers render it.
    Job(Arc<Job>),
}

/// A picture that is rendered and not written yet.
struct Rendered {
    summary: Summary,
    output: Output,
    resume: Option<Resume>,
    picture: Drawn,
}

enum Drawn {
    Here(Box<(Arc<Canvas>, Provenance)>),
    Job(Arc<Job>),
}

impl Drawn {
    /// Writes the picture's file.
    fn encode(&self, out: impl Write + Seek) -> io::Result<()> {
        match self {
            Self::Here(here) => {
                let (canvas, provenance) = &**here;
                let provenance = provenance.text(&canvas.tally()?);
                let software = format!("rtfarm {}", software());
                canvas.picture().encode(&Notes { software, provenance }, out)
            }
            Self::Job(job) => job.picture().encode(&job.notes(&software())?, out),
        }
    }
}

/// What this program's picture of an order depends on.
fn provenance(order: &Order) -> Provenance {
    Provenance {
        build: software(),
        scene: order.prepared.hash(),
        settings: order.settings,
        grid: order.grid,
        transfer: order.transfer,
        format: order.format,
    }
}

/// Says whether a picture is in its place, with what stands beside it, and nothing of it is left to
/// do.
fn is_there(output: &Output, wanted: &Provenance, has_sidecar: bool) -> bool {
    let is_whole = !Resume::folder(output).exists();
    let has_all = !has_sidecar || Making::path(output).exists();
    let reader = PictureReader::open(output.path());
    let found = reader.ok().and_then(|reader| Provenance::read(&reader.notes().provenance).ok());
    is_whole && has_all && found.as_ref() == Some(wanted)
}

/// This program's version and build.
pub(crate) fn software() -> String {
    format!("{VERSION} ({BUILD})")
}

/// The command under way.
struct Render<'a> {
    args: &'a RenderArgs,
    console: &'a Console,
    stop: &'a CancellationToken,
    /// Who has workers render; without it this process does.
    coordinator: Option<Coordinator>,
    /// Shows pictures under way.
    screen: Option<Screen>,
    /// When the last picture was told of, or the command began.
    told: Mutex<Instant>,
}

/// Pictures of which nothing was done yet, and where they go.
type Wanted = VecDeque<(PictureArgs, Output)>;

pub(crate) async fn run(
    args: RenderArgs,
    console: &Console,
    stop: &CancellationToken,
) -> Result<(), Failure> {
    let started = Instant::now();
    if args.show && args.workers_and_threads().0 == 0 && args.slurm.is_none() {
        return Err(Failure::Input(anyhow!(
            "--show is a coordinator's, and with --workers 0 there is none"
        )));
    }
    let pictures = match args.frames {
        Some(frames) => frames.pictures(&args.picture).map_err(Failure::Input)?,
        None => vec![args.picture.clone()],
    };
    let mut wanted = Wanted::with_capacity(pictures.len());
    for picture in pictures {
        let mut output = picture.output().map_err(Failure::Input)?;
        output.check()?;
        wanted.push_back((picture, output));
    }
    let told = started.into();
    let mut render = Render { args: &args, console, stop, coordinator: None, screen: None, told };
    let Some(first) = render.place_next(&mut wanted).await? else { return Ok(()) };
    if args.preview {
        render.screen = Screen::open(console, stop).await?;
    }
    match args.workers_and_threads() {
        (0, _) if args.slurm.is_none() => {
            let (last, end) = render.all_but_the_last(first, wanted).await?;
            render.write(last).await?;
            end
        }
        workers => render.with_workers(workers, first, wanted).await,
    }
}

impl Render<'_> {
    /// Reads the next scene and begins its picture, if there is one. Frames that an earlier render with
    /// --resume has finished are passed over.
    async fn place_next(&self, wanted: &mut Wanted) -> Result<Option<Frame>, Failure> {
        let (console, stop) = (self.console, self.stop);
        while let Some((picture, output)) = wanted.pop_front() {
            let text = SceneText::read(&picture.scene, stop).await?;
            let has_cache = !self.args.no_cache;
            let mut order = place(&picture, &output, text, has_cache, console, stop).await?;
            if let Some(time) = self.args.time {
                order = choose_quality(order, time, self.args, stop).await?;
            }
            let may_be_there = self.args.resume && self.args.frames.is_some();
            if may_be_there && is_there(&output, &provenance(&order), picture.sidecar) {
                tracing::info!("{} is there already", output.name().display());
                continue;
            }
            let (order, begun, resume) = begin(order, &output, self.args.resume).await?;
            return Ok(Some(Frame { order, begun, output, resume }));
        }
        Ok(None)
    }

    /// Renders pictures one after the other: while one is rendered the last is written, and the
    /// next is prepared and handed to the workers, who turn to it when nothing else of this one is
    /// left to do. The last picture is not written yet. The second result says what a picture
    /// failed of that could not be begun; those before it are rendered all the same.
    async fn all_but_the_last(
        &self,
        first: Frame,
        mut wanted: Wanted,
    ) -> Result<(Rendered, Result<(), Failure>), Failure> {
        let mut current = self.start(first).await?;
        let mut unwritten = None;
        loop {
            let next = async {
                match self.place_next(&mut wanted).await? {
                    Some(next) => self.start(next).await.map(Some),
                    None => Ok(None),
                }
            };
            let write = async {
                match unwritten.take() {
                    Some(rendered) => self.write(rendered).await,
                    None => Ok(()),
                }
            };
            let render = async { tokio::try_join!(self.render(current), write) };
            let (rendered, next) = tokio::join!(render, next);
            let (rendered, ()) = rendered?;
            current = match next {
                Ok(Some(next)) => next,
                Ok(None) => return Ok((rendered, Ok(()))),
                Err(failure) => return Ok((rendered, Err(failure))),
            };
            unwritten = Some(rendered);
        }
    }

    /// Hands a picture to those who render it.
    async fn start(&self, frame: Frame) -> Result<Started, Failure> {
        let Frame { order, begun, output, resume } = frame;
        let (size, sampling) = (order.grid.window().size(), order.settings.quality.sampling);
        let transfer = order.transfer;
        let work = match self.coordinator.clone() {
            None => Work::Here(Box::new((order, begun))),
            Some(coordinator) => {
                let (canvas, done) = begun;
                let job = spawn_blocking(move || coordinator.submit_on(order, canvas, &done));
                Work::Job(job.await??)
            }
        };
        Ok(Started { size, sampling, transfer, output, resume, work })
    }

    /// Waits until a picture is rendered.
    async fn render(&self, started: Started) -> Result<Rendered, Failure> {
        let Started { size, sampling, transfer, output, resume, work } = started;
        let mut workers = self.args.workers_and_threads().0;
        let (picture, tally, rendering, hosts) = match work {
            Work::Here(ordered) => {
                let (order, begun) = *ordered;
                let provenance = provenance(&order);
                let (canvas, tally, rendering) = self.render_here(order, begun).await?;
                let host = uname().nodename().to_string_lossy().into_owned();
                let hosts = Arc::new(BTreeSet::from([host]));
                (Drawn::Here(Box::new((canvas, provenance))), tally, rendering, hosts)
            }
            Work::Job(job) => {
                let rendering = self.wait(&job).await?;
                let Progress { tally, worker_count, hosts, .. } = job.progress().borrow().clone();
                if self.args.slurm.is_some() {
                    workers = worker_count as usize;
                }
                (Drawn::Job(job), tally, rendering, hosts)
            }
        };
        let summary = Summary { size, tally, sampling, transfer, rendering, workers, hosts };
        Ok(Rendered { summary, output, resume, picture })
    }

    /// Writes a picture and tells of it.
    async fn write(&self, rendered: Rendered) -> Result<(), Failure> {
        let Rendered { summary, output, resume, picture } = rendered;
        let job = match &picture {
            Drawn::Here(..) => None,
            Drawn::Job(job) => Some(job.id()),
        };
        let making = self.args.picture.sidecar.then(|| summary.making());
        write_picture(&output, self.stop, picture, making).await?;
        if let (Some(coordinator), Some(job)) = (&self.coordinator, job) {
            if self.args.show {
                // Who watches sees the end.
                sleep(LAST_LOOK).await;
            }
            coordinator.cancel(job);
        }
        if let Some(resume) = resume {
            resume.remove()?;
        }
        let told =
            std::mem::replace(&mut *self.told.lock().expect("nothing here panics"), Instant::now());
        summary.tell(told, &output, self.console)?;
        if let Some(time) = self.args.time {
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

    /// Shows how far a job is until it ends.
    async fn wait(&self, job: &Arc<Job>) -> Result<Duration, Failure> {
        let mut progress = job.progress();
        let bar = self.console.start_bar(progress.borrow().tile_count);
        let preview = self.screen.as_ref().zip(self.coordinator.clone());
        let preview = preview.map(|(screen, coordinator)| {
            let shown = Arc::clone(job);
            screen.begin(job.window(), move |view| coordinator.snapshot(&shown, view))
        });
        let rendering = loop {
            {
                let progress = progress.borrow_and_update();
                bar.show(&progress);
                match &progress.outcome {
                    Some(Outcome::Finished(time)) => break *time,
                    Some(Outcome::Failed(reason)) => {
                        return Err(Failure::Other(anyhow!("{reason}")));
                    }
                    None => {}
                }
            }
            progress.changed().await?;
        };
        end(bar, preview).await;
        Ok(rendering)
    }

    async fn render_here(
        &self,
        order: Order,
        (canvas, done): Begun,
    ) -> Result<(Arc<Canvas>, Tally, Duration), Failure> {
        let (_, threads) = self.args.workers_and_threads();
        let tile_count = order.grid.count();
        let progress = watch::Sender::new(Progress { tile_count, ..Progress::default() });
        let mut shown = progress.subscribe();
        let bar = self.console.start_bar(tile_count);
        let (window, canvas) = (order.grid.window(), Arc::new(canvas));
        let preview = self.screen.as_ref().map(|screen| {
            let canvas = Arc::clone(&canvas);
            screen.begin(window, move |view| view.pixels(canvas.picture()))
        });
        let rendering = spawn_blocking({
            let (isa, stop, canvas) = (self.args.isa.0, self.stop.clone(), Arc::clone(&canvas));
            move || {
                let rendered =
                    local::render(order, &canvas, &done, (threads, isa), &progress, &stop);
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
        let (rendering, tally) = rendered??;
        let rendering = rendering.ok_or(Failure::Interrupted)?;
        end(bar, preview).await;
        Ok((canvas, tally, rendering))
    }

    /// Renders all pictures by workers.
    async fn with_workers(
        &mut self,
        (workers, threads): (usize, usize),
        first: Frame,
        wanted: Wanted,
    ) -> Result<(), Failure> {
        let args = self.args;
        let folder = PrivateFolder::new(&std::env::temp_dir())?;
        let socket = folder.path().join("socket");
        let (listener, slurm) = if let Some(options) = args.slurm.clone() {
            let (host, patience) = (args.slurm_host(), args.patience);
            let shared = first.output.folder();
            let ordering =
                spawn_blocking(move || slurm::Order::new(&shared, options, host, patience));
            let (order, listener) = ordering.await??;
            (listener, Some(order))
        } else {
            let listener = UnixListener::bind(&socket)
                .with_context(|| format!("cannot listen on {}", socket.display()))?;
            (Listener::Unix(listener), None)
        };
        let is_here = slurm.is_none();
        let coordinator = Coordinator::new(Config {
            version: VERSION.to_owned(),
            build: BUILD.to_owned(),
            // Local workers are this very program on this machine: nobody here has a reason to lie.
            reference: (!is_here).then(|| rtfarm_worker::reference(Isa::fastest())),
            term: args.lease_seconds,
            audit: if is_here { 0.0 } else { AUDIT },
            keeping: Keeping::default(),
            upload_silence: UPLOAD_SILENCE,
            events: None,
            begins_coarsely: self.args.show || self.screen.is_some(),
            host: None,
            orders: OrderLimits::default(),
            scene_folder: folder.path().to_owned(),
            picture_folder: first.output.folder(),
        })?;
        self.coordinator = Some(coordinator.clone());
        if self.args.show {
            show::show(&coordinator, folder.path(), self.console).await?;
        }
        let stop_serving = CancellationToken::new();
        let serving = tokio::spawn({
            let (coordinator, stop) = (coordinator.clone(), stop_serving.clone());
            async move { coordinator.run(listener, stop.cancelled()).await }
        });
        let mut crew = if let Some(order) = slurm {
            Crew::Slurm(order.submit().await?)
        } else {
            let setup = Setup {
                coordinator: Address::Unix(socket),
                threads,
                isa: args.isa.0,
                log_format: args.log.format,
            };
            let children = Children::start(workers, setup, self.console);
            Crew::Local(children.context("cannot start workers")?)
        };

        let rendered = tokio::select! {
            rendered = self.all_but_the_last(first, wanted) => rendered,
            reason = crew.keep_up(&coordinator, args.patience) => {
                Err(Failure::Other(anyhow!(reason)))
            }
            () = self.stop.cancelled() => Err(Failure::Interrupted),
        };
        coordinator.close();
        let end = match rendered {
            Ok((last, end)) => {
                let (written, ()) = tokio::join!(self.write(last), crew.go_home(&coordinator));
                written.and(end)
            }
            Err(failure) => {
                coordinator.cancel_all();
                crew.end(&coordinator).await;
                Err(failure)
            }
        };
        stop_serving.cancel();
        serving.await??;
        end
    }
}

/// Takes the bar away and leaves the picture as it is.
async fn end(bar: Bar, preview: Option<Preview>) {
    drop(bar);
    if let Some(preview) = preview {
        preview.end().await;
    }
}

/// How much of what workers on other machines render is rendered again; see `coordinator --audit`.
const AUDIT: f64 = 0.01;

/// Those who render.
enum Crew {
    Local(Children),
    Slurm(slurm::Array),
}

impl Crew {
    /// Returns when nobody is left to render, with what to say of it.
    async fn keep_up(&mut self, coordinator: &Coordinator, patience: Duration) -> String {
        match self {
            Self::Local(children) => children.keep_up(coordinator, patience).await,
            Self::Slurm(array) => array.keep_up().await,
        }
    }

    /// Waits for them to go home, then ends those that do not.
    async fn go_home(&mut self, coordinator: &Coordinator) {
        match self {
            Self::Local(children) => children.go_home(coordinator).await,
            Self::Slurm(array) => array.end().await,
        }
    }

    /// Ends them now.
    async fn end(&mut self, coordinator: &Coordinator) {
        match self {
            Self::Local(children) => children.end(coordinator).await,
            Self::Slurm(array) => array.end().await,
        }
    }
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
    has_cache: bool,
    console: &Console,
    stop: &CancellationToken,
) -> Result<Order, Failure> {
    let request = args.request(output.format());
    let (scene, cache) = (args.scene.clone(), if has_cache { Cache::of_user() } else { None });
    let (name, style) = (args.scene.name(), Console::drawing_style());
    let placing = spawn_blocking(move || -> io::Result<_> {
        let key = cache.as_ref().map(|_| Cache::key(&name, &text, request.transfer, request.form));
        if let (Some(cache), Some(key)) = (&cache, &key) {
            let files = SceneFiles::new(&scene);
            let found = cache.find(key, |name| files.read(name));
            // What is strict wants an error where another render was told something.
            if let Some(found) = found.filter(|found| !request.strict || found.report.is_empty()) {
                tracing::debug!("the scene was prepared by an earlier render");
                return Ok((request.place_ready(found.scene), found.report));
            }
        }
        let (files, named) = (SceneFiles::new(&scene), NamedFiles::default());
        let placed = request.place(&text, &|name: &str| {
            let data = files.read(name)?;
            if cache.is_some() {
                named.saw(name, &data);
            }
            Ok(data)
        });
        text.ensure_unchanged()?;
        let report = |style| {
            let mut report = draw_diagnostics(&name, &text, &placed.diagnostics, style);
            report.extend(placed.omitted.summary());
            report
        };
        let told = report(style);
        if let (Some(cache), Some(key)) = (&cache, &key)
            && let (Ok(order), Some(size)) = (&placed.order, placed.size)
        {
            cache.keep(key, &order.prepared, size, &report(Style::Plain), named);
        }
        Ok((placed.order, told))
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

/// Encodes a picture into its file, and writes the one beside it.
async fn write_picture(
    output: &Output,
    stop: &CancellationToken,
    drawn: Drawn,
    making: Option<Making>,
) -> Result<(), Failure> {
    let (output, token) = (output.clone(), stop.clone());
    let written = spawn_blocking(move || {
        output.write(&token, |file| drawn.encode(file))?;
        making.map_or(Ok(()), |making| making.write(&output, &token))
    });
    match written.await? {
        Err(_) if stop.is_cancelled() => Err(Failure::Interrupted),
        written => Ok(written?),
    }
}
