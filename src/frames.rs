//! Frames of a sequence: `--frames 1-48` and the pattern in the names of scenes and pictures.

use std::{
    fs,
    path::{Path, PathBuf},
    str::FromStr,
};

use anyhow::{bail, ensure};

use crate::args::PictureArgs;

/// The most frames of one command.
const MOST_FRAMES: u32 = 100_000;

/// Numbers of frames: `7`, `1-48` or, each second one, `1-48x2`. Invariant: there is one at least.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct FrameRange {
    first: u32,
    last: u32,
    step: u32,
}

impl FromStr for FrameRange {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (numbers, step) = text.split_once('x').unwrap_or((text, "1"));
        let (first, last) = numbers.split_once('-').unwrap_or((numbers, numbers));
        let (Ok(first), Ok(last), Ok(step)) = (first.parse(), last.parse(), step.parse()) else {
            return Err("frames look like 1-48, or 1-48x2 for each second one".to_owned());
        };
        if step == 0 {
            return Err("the step between frames is at least 1".to_owned());
        }
        if first > last {
            return Err(format!("{first}-{last} has no frames; {last}-{first} has"));
        }
        let range = Self { first, last, step };
        match range.count() {
            ..=MOST_FRAMES => Ok(range),
            count => Err(format!("{count} frames are more than {MOST_FRAMES}")),
        }
    }
}

impl FrameRange {
    fn count(self) -> u32 {
        ((self.last - self.first) / self.step).saturating_add(1)
    }

    fn numbers(self) -> impl Iterator<Item = u32> {
        (self.first..=self.last).step_by(self.step as usize)
    }

    /// The pictures that are wanted when `of_all` says what is wanted of each. All scenes are
    /// there.
    pub(crate) fn pictures(self, of_all: &PictureArgs) -> anyhow::Result<Vec<PictureArgs>> {
        let (scenes, outputs) = (&of_all.scene.path, &of_all.output);
        ensure!(!of_all.scene.is_from_stdin(), "--frames needs files, not standard input");
        let picture = |number| {
            let mut picture = of_all.clone();
            picture.scene.path = name_of(scenes, number, "SCENE")?;
            picture.output = name_of(outputs, number, "the output")?;
            Ok(picture)
        };
        let pictures = self.numbers().map(picture).collect::<anyhow::Result<Vec<_>>>()?;
        let missing = pictures.iter().map(|picture| &picture.scene.path);
        let missing = missing.filter(|path| fs::metadata(path).is_err());
        let missing: Vec<String> = missing.map(|path| path.display().to_string()).collect();
        ensure!(missing.is_empty(), "these scenes are not there: {}", missing.join(", "));
        Ok(pictures)
    }
}

/// Puts a frame's number where the pattern is: `%d`, or `%04d` for four digits at least.
fn name_of(pattern: &Path, number: u32, what: &str) -> anyhow::Result<PathBuf> {
    let text = pattern.to_string_lossy();
    let wrong = || {
        format!(
            "with --frames {what} has one place for the number, like shot.%04d.rt; {text} has not"
        )
    };
    let Some((before, rest)) = text.split_once('%') else { bail!(wrong()) };
    let Some((digits, after)) = rest.split_once('d') else { bail!(wrong()) };
    let width = if digits.is_empty() { Some(0) } else { digits.parse().ok() };
    let Some(width @ 0..=10) = width.filter(|_| !after.contains('%')) else { bail!(wrong()) };
    Ok(format!("{before}{number:0width$}{after}").into())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ranges_are_read_and_checked() {
        let numbers = |text: &str| text.parse().map(|range: FrameRange| range.numbers().collect());
        assert_eq!(numbers("3-6"), Ok(vec![3, 4, 5, 6]));
        assert_eq!(numbers("1-8x3"), Ok(vec![1, 4, 7]));
        assert_eq!(numbers("7"), Ok(vec![7]));
        for bad in ["", "-", "1-", "a-b", "6-3", "1-4x0", "1-4x", "0-4294967295", "1..4"] {
            numbers(bad).expect_err(bad);
        }
    }

    #[test]
    fn a_number_stands_where_the_pattern_is() {
        let name = |pattern: &str| {
            name_of(Path::new(pattern), 7, "SCENE").map(|path| path.display().to_string())
        };
        assert_eq!(name("a/shot.%04d.rt").unwrap(), "a/shot.0007.rt");
        assert_eq!(name("%d.png").unwrap(), "7.png");
        assert_eq!(name("%3d").unwrap(), "007");
        for bad in ["shot.rt", "shot.%s.rt", "%", "%04", "%d-%d.rt", "%99d.rt", "%-3d"] {
            let error = name(bad).unwrap_err().to_string();
            assert!(error.contains("like shot.%04d.rt"), "{error}");
        }
    }
}
