//! How many random rays tests take, which, and how they tell what they measured.

#![allow(dead_code, reason = "each test takes what it needs")]

use std::{env, fmt::Display};

use rtfarm_oracle::random::Random;

fn number(variable: &str) -> Option<u64> {
    env::var(variable).ok().map(|value| value.parse().expect("a number"))
}

/// `RTFARM_RAYS=100` makes the tests that count rays take a hundred times as many.
pub(crate) fn rays(count: usize) -> usize {
    count * number("RTFARM_RAYS").unwrap_or(1) as usize
}

/// For rays whose truth takes long: a tenth of the more that was asked for.
pub(crate) fn few_rays(count: usize) -> usize {
    count * (number("RTFARM_RAYS").unwrap_or(1) as usize).div_ceil(10)
}

/// Random numbers of a test; `RTFARM_SEED=1` makes them others.
pub(crate) fn random(stream: u64) -> Random {
    Random::new(stream + (number("RTFARM_SEED").unwrap_or(0) << 32))
}

/// Tells what was measured of a hard case; `tests/long-run` makes a table of these lines.
pub(crate) fn tell(case: u32, what: &str, measured: impl Display) {
    eprintln!("case {case:02}: {what}: {measured}");
}
