//! What went wrong, in one line, and the exit code that says so.

use std::{borrow::Cow, fmt, process::ExitCode};

use anyhow::anyhow;
use rtfarm_client::{NoPicture, plain};

use crate::console::Console;

/// What a process ends with that somebody stopped.
pub(crate) const INTERRUPTED: u8 = 130;

/// Why a command did not do what it was asked to.
#[derive(Debug)]
pub(crate) enum Failure {
    /// The command line is wrong, or something that it names to be read.
    Input(anyhow::Error),
    /// The scene is wrong, and its diagnostics have said why.
    Told,
    /// Something failed.
    Other(anyhow::Error),
    /// Somebody stopped it.
    Interrupted,
}

impl<E: Into<anyhow::Error>> From<E> for Failure {
    fn from(error: E) -> Self {
        Self::Other(error.into())
    }
}

impl fmt::Display for Failure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Input(error) | Self::Other(error) => write!(f, "{error:#}"),
            Self::Told => Ok(()),
            Self::Interrupted => f.write_str("interrupted"),
        }
    }
}

impl Failure {
    /// Why a farm gave no picture.
    pub(crate) fn of_client(reason: NoPicture) -> Self {
        match reason {
            NoPicture::Refused(reason) => Self::Input(anyhow!(reason)),
            NoPicture::Told => Self::Told,
            NoPicture::Failed(reason) => Self::Other(anyhow!(reason)),
            NoPicture::Interrupted => Self::Interrupted,
        }
    }

    /// What the process ends with.
    pub(crate) fn exit_code(&self) -> u8 {
        match self {
            Self::Other(_) => 1,
            Self::Input(_) | Self::Told => 2,
            Self::Interrupted => INTERRUPTED,
        }
    }

    /// Tells the user, and chooses the exit code.
    pub(crate) fn tell(&self, console: &Console) -> ExitCode {
        if !matches!(self, Self::Told) {
            // Some of it may come from another machine.
            console.tell(&plain(&format!("error: {self}")));
        }
        ExitCode::from(self.exit_code())
    }
}

/// Shows help and versions as they are, and a usage error as one line.
pub(crate) fn explain_usage(error: &clap::Error) -> ExitCode {
    if !error.use_stderr() {
        let is_shown = error.print().is_ok();
        return if is_shown { ExitCode::SUCCESS } else { ExitCode::from(1) };
    }
    let text = error.to_string();
    // The mistake, and what was meant if it can be guessed.
    let is_guess =
        |part: &str| part.trim_start().starts_with("tip: ") && part.contains(" similar ");
    let told = text.split("\n\n").enumerate().filter(|&(k, part)| k == 0 || is_guess(part));
    let one_line =
        |(_, part): (_, &str)| part.split_whitespace().map(shorten).collect::<Vec<_>>().join(" ");
    Console::plain().tell(&told.map(one_line).collect::<Vec<_>>().join("; "));
    ExitCode::from(2)
}

/// A word as it can be told: the beginning of a long one.
fn shorten(word: &str) -> Cow<'_, str> {
    const LONGEST: usize = 200;
    match word.char_indices().nth(LONGEST) {
        Some((end, _)) => format!("{}...", &word[..end]).into(),
        None => word.into(),
    }
}
