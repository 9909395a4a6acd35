//! Standard error: log lines, the progress bar and a picture above it, which share it. Nobody here
//! waits for who reads it.

use std::{
    io::{self, IsTerminal, Write},
    time::Duration,
};

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
    console_queue::ConsoleQueue,
    footer::Footer,
    terminal,
};

/// Standard error. Clones are the same one.
#[derive(Debug, Clone, Default)]
pub(crate) struct Console {
    wants_bar: bool,
    is_quiet: bool,
    /// Where what is said waits to be written; without it it is written at once.
    queue: Option<ConsoleQueue>,
}

/// The longest that a process that ends waits for what it said to be read.
const FAREWELL: Duration = Duration::from_secs(1);

/// Characters of the bar itself.
const BAR_WIDTH: usize = 40;

impl Console {
    /// Standard error without logs and bars.
    pub(crate) fn plain() -> Self {
        Self::default()
    }

    /// Standard error as a command uses it: with a bar on a terminal, with log lines elsewhere,
    /// unless it is to be quiet or verbose. `RUST_LOG` chooses others.
    pub(crate) fn new(args: &Args) -> Self {
        let Args { command, quiet: is_quiet, verbose: is_verbose } = args;
        let format = command.log_format();
        let has_bar =
            matches!(command, Command::Render(_) | Command::Submit(_) | Command::Watch(_))
                && format == LogFormat::Text
                && !is_quiet
                && !is_verbose
                && io::stderr().is_terminal()
                && std::env::var_os("TERM").is_none_or(|term| term != "dumb");
        let is_local_worker = matches!(command, Command::Worker(args) if args.parent.is_some());
        let level = if has_bar || is_local_worker || *is_quiet {
            LevelFilter::WARN
        } else if *is_verbose && !io::stderr().is_terminal() {
            LevelFilter::DEBUG
        } else {
            LevelFilter::INFO
        };
        let describe = match format {
            LogFormat::Text => {
                |count| format!(" WARN {count} lines were dropped: nobody read them\n")
            }
            LogFormat::Json => |count| {
                let message = "lines were dropped: nobody read them";
                format!("{}\n", json!({ "level": "WARN", "message": message, "lines": count }))
            },
        };
        let mut footer = Footer::default();
        let queue = ConsoleQueue::start(describe, move |batch| {
            // There is nobody to tell when standard error fails.
            let _ = footer.write(batch, terminal::columns() - 1, io::stderr(), io::stdout());
        });
        let (wants_bar, is_quiet) = (has_bar, *is_quiet);
        let console = Self { wants_bar, is_quiet, queue: Some(queue) };
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

    /// Writes a line to standard output; where that is a terminal, which may be the same one, in
    /// its turn.
    pub(crate) fn answer(&self, line: &str) -> io::Result<()> {
        let mut out = io::stdout();
        match &self.queue {
            Some(queue) if out.is_terminal() => queue.answer(format!("{line}\n").into_bytes()),
            _ => writeln!(out, "{line}")?,
        }
        Ok(())
    }

    /// Where pictures and bars go; there are none on a plain console.
    pub(crate) fn queue(&self) -> Option<&ConsoleQueue> {
        self.queue.as_ref()
    }

    /// Waits until all that was said is written, but not for ever.
    pub(crate) fn close(&self) {
        if let Some(queue) = &self.queue {
            queue.flush(FAREWELL);
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
        let queue = self.queue.clone().filter(|_| self.wants_bar);
        let bar = Bar { queue, start: Instant::now() };
        bar.show(&Progress { tile_count, ..Progress::default() });
        bar
    }
}

/// A progress bar; it goes when this does.
#[derive(Debug)]
pub(crate) struct Bar {
    /// Where it is shown, if it is.
    queue: Option<ConsoleQueue>,
    start: Instant,
}

impl Bar {
    /// Draws how far a job is.
    pub(crate) fn show(&self, progress: &Progress) {
        let Some(queue) = &self.queue else { return };
        let Progress { tiles_done, tile_count, .. } = *progress;
        let filled = BAR_WIDTH * tiles_done as usize / tile_count.max(1) as usize;
        let (filled, empty) = ("█".repeat(filled), "░".repeat(BAR_WIDTH - filled));
        let mut speed = String::new();
        if tiles_done > 0 {
            let seconds = self.start.elapsed().as_secs_f64();
            let tiles_left = f64::from(tile_count - tiles_done);
            let left = match progress.left {
                Some(left) => {
                    let [mean, error] = [left.mean, left.error].map(|time| time.as_secs_f64());
                    format!("{mean:.0} ± {error:.0}")
                }
                None => format!("{:.0}", seconds / f64::from(tiles_done) * tiles_left),
            };
            let mrays = progress.tally.rays as f64 / 1e6 / seconds;
            speed = format!("  {mrays:.1} Mrays/s  {left} s left");
        }
        let bar = format!("{filled}{empty} {tiles_done}/{tile_count} tiles{speed}");
        queue.show_bar(Some(bar));
    }
}

impl Drop for Bar {
    fn drop(&mut self) {
        self.queue.iter().for_each(|queue| queue.show_bar(None));
    }
}

impl<'a> MakeWriter<'a> for Console {
    type Writer = LineWriter;

    fn make_writer(&'a self) -> LineWriter {
        LineWriter { console: self.clone(), line: Vec::new(), is_drawn: false }
    }
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
        match &self.console.queue {
            Some(queue) => queue.push(line),
            // There is nobody to tell when it fails.
            None => drop(io::stderr().write_all(&line)),
        }
    }
}

/// The levels and targets of log lines: those that `RUST_LOG` names, like `info` or
/// `rtfarm_worker=debug,warn`; lines up to `level` when it names none.
fn filter(rust_log: Option<&str>, level: LevelFilter) -> Targets {
    let chosen = rust_log.and_then(|directives| directives.parse().ok());
    // What libraries do in detail is for who asks for it by name.
    let own =
        Targets::new().with_default(level.min(LevelFilter::INFO)).with_target("rtfarm", level);
    chosen.unwrap_or(own)
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

    #[test]
    fn a_verbose_command_tells_what_it_does_and_not_what_its_libraries_do() {
        let filter = filter(None, LevelFilter::DEBUG);
        assert!(filter.would_enable("rtfarm_worker::run", &Level::DEBUG));
        assert!(filter.would_enable("h2::codec", &Level::INFO));
        assert!(!filter.would_enable("h2::codec", &Level::DEBUG));
    }
}
