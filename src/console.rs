//! Standard error: log lines, the progress bar and a picture above it, which share it.

use std::{
    io::{self, IsTerminal, Write},
    sync::{Arc, Mutex},
    time::Duration,
};

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use rtfarm_client::plain;
use rtfarm_core::language::Style;
use rtfarm_job::Progress;
use serde_json::json;
use tokio::time::Instant;
use tracing_subscriber::{
    filter::{LevelFilter, Targets},
    fmt::MakeWriter,
    layer::SubscriberExt,
    util::SubscriberInitExt,
};

use crate::{
    args::{Args, Command, LogFormat},
    log_queue::LogQueue,
    terminal::Drawing,
};

/// Standard error. Clones are the same one.
#[derive(Debug, Clone, Default)]
pub(crate) struct Console {
    /// Set while a bar is on the screen; lines are then written above it.
    bar: Arc<Mutex<Option<ProgressBar>>>,
    /// The picture that stands above the bar, at the end of all that is on the screen. It is locked while
    /// something is written.
    picture: Arc<Mutex<Option<Shown>>>,
    wants_bar: bool,
    is_quiet: bool,
    /// Where lines wait to be written; without it they are written at once.
    lines: Option<LogQueue>,
}

/// A picture on the screen.
#[derive(Debug)]
struct Shown {
    /// Rows that it takes.
    rows: u16,
    /// Takes it away where clearing its rows does not.
    erase: String,
}

impl Shown {
    /// Moves to its first row and clears it, and all below.
    fn clear(self) -> String {
        let Self { rows, erase } = self;
        format!("\r\x1b[{rows}A{erase}\x1b[J")
    }
}

/// The longest that a process that ends waits for what it said to be read.
const FAREWELL: Duration = Duration::from_secs(1);

impl Console {
    /// Standard error without logs and bars.
    pub(crate) fn plain() -> Self {
        Self::default()
    }

    /// Standard error as a command uses it: with a bar on a terminal, with log lines elsewhere, unless
    /// it is to be quiet or verbose. `RUST_LOG` chooses others.
    pub(crate) fn new(args: &Args) -> Self {
        let Args { command, quiet: is_quiet, verbose: is_verbose } = args;
        let format = command.log_format();
        let has_bar =
            matches!(command, Command::Render(_) | Command::Submit(_) | Command::Watch(_))
                && format == LogFormat::Text
                && !is_quiet
                && !is_verbose
                && io::stderr().is_terminal();
        let is_local_worker = matches!(command, Command::Worker(args) if args.parent.is_some());
        let level = if has_bar || is_local_worker || *is_quiet {
            LevelFilter::WARN
        } else if *is_verbose && !io::stderr().is_terminal() {
            LevelFilter::DEBUG
        } else {
            LevelFilter::INFO
        };
        let bar = Arc::<Mutex<Option<ProgressBar>>>::default();
        let picture = Arc::<Mutex<Option<Shown>>>::default();
        let describe = match format {
            LogFormat::Text => {
                |count| format!(" WARN {count} lines were dropped: nobody read them\n")
            }
            LogFormat::Json => |count| {
                let message = "lines were dropped: nobody read them";
                format!("{}\n", json!({ "level": "WARN", "message": message, "lines": count }))
            },
        };
        let lines = LogQueue::start(describe, {
            let (bar, picture) = (Arc::clone(&bar), Arc::clone(&picture));
            move |line| write_above(&bar, &picture, io::stderr(), line)
        });
        let (wants_bar, is_quiet) = (has_bar, *is_quiet);
        let console = Self { bar, picture, wants_bar, is_quiet, lines: Some(lines) };
        let filter = filter(std::env::var("RUST_LOG").ok().as_deref(), level);
        let lines = tracing_subscriber::fmt()
            .with_max_level(LevelFilter::TRACE)
            .with_target(false)
            .with_writer(console.clone());
        match format {
            LogFormat::Text => lines.finish().with(filter).init(),
            LogFormat::Json => lines.json().flatten_event(true).finish().with(filter).init(),
        }
        console
    }

    /// Whether nothing is said of what went well.
    pub(crate) fn is_quiet(&self) -> bool {
        self.is_quiet
    }

    /// Writes a line.
    pub(crate) fn tell(&self, line: &str) {
        let _ = writeln!(self.make_writer(), "{line}");
    }

    /// Writes a line to standard output, which may be the same terminal.
    pub(crate) fn answer(&self, line: &str) -> io::Result<()> {
        let mut out = io::stdout();
        if out.is_terminal() {
            write_above(&self.bar, &self.picture, out, format!("{line}\n").as_bytes());
            return Ok(());
        }
        writeln!(out, "{line}")
    }

    /// Draws a picture above the bar, in place of the one that is there.
    pub(crate) fn draw(&self, drawing: Drawing) {
        let Drawing { bytes, rows, erase } = drawing;
        above(&self.bar, || {
            let mut picture = self.picture.lock().expect("drawing never panics");
            let mut drawn = match picture.take() {
                // The new one covers it.
                Some(old) if old.rows == rows => format!("\r\x1b[{rows}A"),
                old => old.map(Shown::clear).unwrap_or_default(),
            };
            // Its rows come into view first, so that nothing is moved while it is drawn.
            drawn += &"\n".repeat(rows.into());
            let start = format!("\x1b[{rows}A\x1b7");
            let end = format!("\x1b8\x1b[{rows}B\r");
            let drawn = [drawn.as_bytes(), start.as_bytes(), &bytes, end.as_bytes()].concat();
            // There is nobody to tell when standard error fails.
            let _ = io::stderr().write_all(&drawn);
            *picture = Some(Shown { rows, erase });
        });
    }

    /// Whether a picture stands above the bar.
    pub(crate) fn has_picture(&self) -> bool {
        self.picture.lock().expect("drawing never panics").is_some()
    }

    /// Lets the picture stand where it is: what comes next is written below it.
    pub(crate) fn leave_picture(&self) {
        *self.picture.lock().expect("drawing never panics") = None;
    }

    /// Waits until all that was said is written, but not for ever.
    pub(crate) fn close(&self) {
        if let Some(lines) = &self.lines {
            lines.flush(FAREWELL);
        }
    }

    /// Writes what there is to say about a scene, unless that is nothing.
    pub(crate) fn tell_report(&self, report: &str) {
        if !report.is_empty() {
            let mut writer = self.make_writer();
            writer.is_drawn = true;
            let _ = writeln!(writer, "{}", report.trim_end());
        }
    }

    /// How diagnostics are drawn: in colours on a terminal, unless `NO_COLOR` is set.
    pub(crate) fn drawing_style() -> Style {
        let is_plain = std::env::var_os("NO_COLOR").is_some_and(|value| !value.is_empty());
        if io::stderr().is_terminal() && !is_plain { Style::Colored } else { Style::Plain }
    }

    /// Shows a bar for a picture of so many tiles, if bars are shown at all.
    pub(crate) fn start_bar(&self, tile_count: u32) -> Bar {
        let bar = self.wants_bar.then(|| {
            let style = ProgressStyle::with_template("{bar:40} {pos}/{len} tiles  {msg}");
            let bar = ProgressBar::with_draw_target(
                Some(tile_count.into()),
                ProgressDrawTarget::stderr_with_hz(10),
            )
            .with_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()));
            bar.enable_steady_tick(Duration::from_millis(200));
            *self.lock() = Some(bar.clone());
            bar
        });
        Bar { drawn: bar, console: self.clone(), start: Instant::now() }
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, Option<ProgressBar>> {
        self.bar.lock().expect("drawing never panics")
    }
}

/// A progress bar; it goes when this does.
#[derive(Debug)]
pub(crate) struct Bar {
    drawn: Option<ProgressBar>,
    console: Console,
    start: Instant,
}

impl Bar {
    /// Draws how far a job is.
    pub(crate) fn show(&self, progress: &Progress) {
        let Some(bar) = &self.drawn else { return };
        bar.set_position(progress.tiles_done.into());
        if progress.tiles_done > 0 {
            let seconds = self.start.elapsed().as_secs_f64();
            let tiles_left = f64::from(progress.tile_count - progress.tiles_done);
            let left = match progress.left {
                Some(left) => {
                    let [mean, error] = [left.mean, left.error].map(|time| time.as_secs_f64());
                    format!("{mean:.0} ± {error:.0}")
                }
                None => format!("{:.0}", seconds / f64::from(progress.tiles_done) * tiles_left),
            };
            let mrays = progress.tally.rays as f64 / 1e6 / seconds;
            bar.set_message(format!("{mrays:.1} Mrays/s  {left} s left"));
        }
    }
}

impl Drop for Bar {
    fn drop(&mut self) {
        if let Some(bar) = &self.drawn {
            bar.finish_and_clear();
            *self.console.lock() = None;
        }
    }
}

impl<'a> MakeWriter<'a> for Console {
    type Writer = LineWriter;

    fn make_writer(&'a self) -> LineWriter {
        LineWriter { console: self.clone(), line: Vec::new(), is_drawn: false }
    }
}

/// Does something while the bar, if there is one, is not on the screen.
fn above(bar: &Mutex<Option<ProgressBar>>, act: impl FnOnce()) {
    // Its clone, so that nobody waits for the bar while something is written.
    let bar = bar.lock().expect("drawing never panics").clone();
    match bar {
        Some(bar) => bar.suspend(act),
        None => act(),
    }
}

/// Writes a line above the bar and in place of the picture, which is drawn again later.
fn write_above(
    bar: &Mutex<Option<ProgressBar>>,
    picture: &Mutex<Option<Shown>>,
    mut out: impl Write,
    line: &[u8],
) {
    above(bar, || {
        let mut picture = picture.lock().expect("drawing never panics");
        let mut bytes = picture.take().map(Shown::clear).unwrap_or_default().into_bytes();
        bytes.extend_from_slice(line);
        // There is nobody to tell when it fails.
        let _ = out.write_all(&bytes);
    });
}

/// Collects a line and hands it on in one piece, so that lines of several processes do not mix.
#[derive(Debug)]
pub(crate) struct LineWriter {
    console: Console,
    line: Vec<u8>,
    /// Whether it has colours in it, which are this program's own.
    is_drawn: bool,
}

impl Write for LineWriter {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.line.extend_from_slice(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl Drop for LineWriter {
    fn drop(&mut self) {
        let mut line = std::mem::take(&mut self.line);
        let is_plain = |&byte: &u8| matches!(byte, b' '..=b'~' | b'\n' | b'\t');
        if !self.is_drawn && !line.iter().all(is_plain) {
            line = plain(&String::from_utf8_lossy(&line)).into_bytes();
        }
        match &self.console.lines {
            Some(lines) => lines.push(&line),
            None => write_above(&self.console.bar, &self.console.picture, io::stderr(), &line),
        }
    }
}

/// The levels and targets of log lines: those that `RUST_LOG` names, like `info` or
/// `rtfarm_worker=debug,warn`; lines up to `level` when it names none.
fn filter(rust_log: Option<&str>, level: LevelFilter) -> Targets {
    let chosen = rust_log.and_then(|directives| directives.parse().ok());
    chosen.unwrap_or_else(|| Targets::new().with_default(level))
}

#[cfg(test)]
mod tests {
    use tracing::Level;

    use super::*;

    fn check_levels(rust_log: Option<&str>, worker: Level, others: Level) {
        let filter = filter(rust_log, LevelFilter::WARN);
        for (target, most) in [("rtfarm_worker::run", worker), ("rtfarm", others)] {
            for level in [Level::ERROR, Level::WARN, Level::INFO, Level::DEBUG, Level::TRACE] {
                let shown = filter.would_enable(target, &level);
                assert_eq!(shown, level <= most, "{rust_log:?}: {target} {level}");
            }
        }
    }

    #[test]
    fn rust_log_chooses_the_lines() {
        check_levels(None, Level::WARN, Level::WARN);
        check_levels(Some("info"), Level::INFO, Level::INFO);
        check_levels(Some("rtfarm_worker=debug,error"), Level::DEBUG, Level::ERROR);
        check_levels(Some("rtfarm_worker=loudly"), Level::WARN, Level::WARN);
    }
}
