//! What options say, read and checked.

use std::{fmt, ops::RangeInclusive, str::FromStr, time::Duration};

use clap::ValueEnum;
use rtfarm_core::{
    isa::{Isa, IsaError},
    render::{SampleCount, SampleLimit, StandardError},
    tile::{Crop, Size, SizeError},
    transfer::Transfer,
};

/// How many tiles are rendered again.
#[derive(Debug, Clone, Copy)]
pub(crate) enum TileShare {
    All,
    Some(u32),
    /// A few percent.
    Few,
}

impl FromStr for TileShare {
    type Err = &'static str;

    fn from_str(text: &str) -> Result<Self, &'static str> {
        match text {
            "all" => Ok(Self::All),
            "few" => Ok(Self::Few),
            _ => match text.parse() {
                Ok(count @ 1..) => Ok(Self::Some(count)),
                _ => Err("a number of tiles is wanted, or `all`"),
            },
        }
    }
}

/// How log lines are written.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum LogFormat {
    /// For people and `grep`.
    Text,
    /// One object a line.
    Json,
}

impl fmt::Display for LogFormat {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Text => "text",
            Self::Json => "json",
        })
    }
}

/// An instruction set, chosen by name or as the fastest there is.
#[derive(Debug, Clone, Copy)]
pub(crate) struct IsaChoice(pub(crate) Isa);

impl FromStr for IsaChoice {
    type Err = IsaError;

    fn from_str(name: &str) -> Result<Self, IsaError> {
        if name == "auto" { Ok(Self(Isa::fastest())) } else { name.parse().map(Self) }
    }
}

/// What a prepared scene is to be good at.
/// Reads a number; `wanted` says what it must be.
pub(super) fn number<T: FromStr>(
    wanted: &'static str,
) -> impl Fn(&str) -> Result<T, String> + Clone {
    move |text| text.parse().map_err(|_| format!("it must be {wanted}"))
}

pub(super) fn whole_number<T>(
    range: RangeInclusive<T>,
) -> impl Fn(&str) -> Result<T, String> + Clone
where
    T: FromStr + PartialOrd + fmt::Display + Clone,
{
    move |text| {
        let number = text.parse().ok().filter(|number| range.contains(number));
        number.ok_or_else(|| out_of_range("it", &range))
    }
}

pub(super) fn parse_size(text: &str) -> Result<Size, String> {
    let sides = text.split_once('x').and_then(|(w, h)| Some((w.parse().ok()?, h.parse().ok()?)));
    let (width, height) = sides.ok_or("a size looks like 1280x720")?;
    Size::new(width, height).map_err(|error: SizeError| error.to_string())
}

pub(super) fn parse_crop(text: &str) -> Result<Crop, &'static str> {
    let numbers: Option<Vec<u32>> = text.split(',').map(|number| number.parse().ok()).collect();
    match numbers.as_deref() {
        Some(&[x, y, width, height]) => Ok(Crop { corner: [x, y], sides: [width, height] }),
        _ => Err("a crop window looks like 320,180,640,360: x, y, width and height in pixels"),
    }
}

pub(super) fn parse_samples(text: &str) -> Result<SampleCount, String> {
    let count = text.parse().ok().and_then(SampleCount::new);
    count.ok_or_else(|| out_of_range("the number of samples", &SampleCount::RANGE))
}

pub(super) fn parse_max_samples(text: &str) -> Result<SampleLimit, String> {
    let limit = text.parse().ok().and_then(SampleLimit::new);
    limit.ok_or_else(|| out_of_range("the most samples", &SampleLimit::RANGE))
}

fn out_of_range<T: fmt::Display>(what: &str, range: &RangeInclusive<T>) -> String {
    format!("{what} must be a whole number from {} to {}", range.start(), range.end())
}

pub(super) fn parse_error(text: &str) -> Result<StandardError, &'static str> {
    let error = text.parse().ok().and_then(StandardError::new);
    error.ok_or("an error must be a number above 0 and at most 1")
}

pub(super) fn parse_transfer(text: &str) -> Result<Transfer, String> {
    match text {
        "none" => Ok(Transfer::None),
        "srgb" => Ok(Transfer::Srgb),
        _ => Err("a transfer is none or srgb".to_owned()),
    }
}

pub(super) fn parse_seconds(text: &str) -> Result<Duration, String> {
    let seconds: f64 = text.parse().map_err(|_| "a number of seconds is wanted")?;
    if (0.1..=86_400.0).contains(&seconds) {
        Ok(Duration::from_secs_f64(seconds))
    } else {
        Err("a time is from 0.1 to 86400 seconds".to_owned())
    }
}

/// Answers with bytes.
pub(super) fn parse_gigabytes(text: &str) -> Result<u64, &'static str> {
    let bytes = text.parse().ok().map(|gigabytes: f64| gigabytes * 1e9);
    let bytes = bytes.filter(|bytes| (1.0..=1e18).contains(bytes));
    bytes.map(|bytes| bytes as u64).ok_or("a number of GB above 0 is wanted")
}

/// Answers with ones.
pub(super) fn parse_millions(text: &str) -> Result<u64, &'static str> {
    let ones = text.parse().ok().map(|millions: f64| millions * 1e6);
    let ones = ones.filter(|ones| (1.0..=1e18).contains(ones));
    ones.map(|ones| ones as u64).ok_or("a number of millions above 0 is wanted")
}

pub(super) fn parse_fraction(text: &str) -> Result<f64, &'static str> {
    let fraction = text.parse().ok().filter(|fraction| (0.0..=1.0).contains(fraction));
    fraction.ok_or("a fraction is a number from 0 to 1")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_are_read_and_checked() {
        assert_eq!(parse_size("1280x720"), Ok(Size::new(1280, 720).unwrap()));
        for bad in ["", "x", "1280", "0x0", "100000x100000", "-1x5", "1x1x1", "1.5x2"] {
            parse_size(bad).expect_err(bad);
        }
    }
}
