//! The report's text, in Markdown.

use std::fmt::Write;

use rtfarm_core::{isa::Isa, render::StandardError};

use crate::{
    Ladder, Rung,
    figures::{Errors, Quartiles, mean_and_band, median, slope},
};

/// The version that the figures are of.
const VERSION: &str = env!("CARGO_PKG_VERSION");

/// The errors that a user may want, in 8-bit steps.
pub const WANTED: [f64; 5] = [8.0, 4.0, 2.0, 1.0, 0.5];

/// What the columns of [`table`] hold.
pub const LEGEND: &str = "Errors are of a channel, 1 is full light. `ms`: of one thread. `relMSE`: the \
    mean of error² / (truth² + 0.01). `FLIP`: the mean difference to the eye in 8 bits, 0 to 1. \
    `p99.9`: what one channel in a thousand exceeds. `mean`: with its sign; one that does not fall \
    with more samples is bias. `stopped`: the share of channels further off than three times the \
    error asked for. `told`: the error that a render tells over the true one.\n\n";

/// The section that says how the figures of some ladders came about.
pub fn method(ladders: &[Ladder]) -> String {
    let seeds = ladders.first().map_or(0, |ladder| ladder.fixed()[0].errors.len());
    let profile = if cfg!(debug_assertions) { "a debug build" } else { "a release build" };
    format!(
        "## Method\n\nrtfarm {VERSION}, {profile} for {arch} without flags for the CPU, on {cpu}, \
         {threads} hardware threads; kernel {isa}. One thread a picture, as many pictures at a \
         time as there are hardware threads; seeds 0 to {last}, and for each seed all kinds of a \
         rung in turn. A time is the median and, in brackets, the quartiles of {seeds} runs; ± is \
         the 95 % band of the mean by the normal law; a slope is fitted to logarithms.\n",
        arch = std::env::consts::ARCH,
        cpu = cpu_name(),
        threads = std::thread::available_parallelism().map_or(0, usize::from),
        isa = Isa::fastest(),
        last = seeds.saturating_sub(1),
    )
}

fn cpu_name() -> String {
    let info = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let name = info.lines().find_map(|line| line.strip_prefix("model name"));
    name.map_or("an unknown CPU", |name| name.trim_start_matches([' ', '\t', ':'])).to_owned()
}

/// The section of one ladder: a row a rung.
pub fn table(ladder: &Ladder) -> String {
    let mut text = format!("### {}, {}\n\n", ladder.name, ladder.size);
    text += "| setting | samples | ms | RMSE | relMSE | 8-bit RMSE | FLIP | p99.9 | max | mean | stopped | told |\n\
             |---|---|---|---|---|---|---|---|---|---|---|---|\n";
    for rung in ladder.rungs() {
        text += &row(rung);
    }
    for series in &ladder.series {
        // One sample lies in the pixel's middle, two or more anywhere in it: another law.
        let rungs = series.rungs.iter().filter(|rung| rung.samples_a_pixel != Some(1.0));
        let points = rungs.map(|rung| (rung.time(), rung.rmse().0));
        if let Some(slope) = slope(points) {
            let _ = writeln!(text, "\nRMSE falls as time^{slope:.2} ({}).", series.name);
        }
    }
    text.push('\n');
    text
}

fn row(rung: &Rung) -> String {
    let of = |value: fn(&Errors) -> f64| mean_and_band(rung.errors.iter().map(value));
    // A band needs more than one picture.
    let banded = |(value, band): (f64, f64), digits: usize| {
        if rung.errors.len() > 1 {
            format!("{value:.digits$e} ± {band:.0e}")
        } else {
            format!("{value:.digits$e}")
        }
    };
    let stopped = rung.errors[0].wrongly_stopped.map_or(String::new(), |_| {
        let (share, _) = of(|errors| errors.wrongly_stopped.unwrap_or(0.0));
        format!("{:.3} %", 100.0 * share)
    });
    let told =
        if rung.told.is_empty() { String::new() } else { format!("{:.2}", median(&rung.told)) };
    format!(
        "| {setting} | {samples} | {ms} | {rmse} | {relative:.1e} | {rounded:.1e} | {flip:.1e} | \
         {high:.1e} | {worst:.1e} | {mean} | {stopped} | {told} |\n",
        setting = rung.setting,
        samples = rung.samples_a_pixel.map_or(String::new(), |samples| format!("{samples:.1}")),
        ms = Quartiles::new(&rung.milliseconds),
        rmse = banded(rung.rmse(), 2),
        relative = of(|errors| errors.relative).0,
        rounded = of(|errors| errors.rmse_8_bit).0,
        flip = of(|errors| errors.flip).0,
        high = of(|errors| errors.high).0,
        worst = rung.errors.iter().map(|errors| errors.worst).fold(0.0, f64::max),
        mean = banded(of(|errors| errors.mean), 0),
    )
}

/// The section that says which setting comes first to `wanted`, or to each of [`WANTED`].
pub fn soonest(ladder: &Ladder, wanted: Option<StandardError>) -> String {
    let full_size = ladder.reference.map_or(ladder.size, |reference| reference.full_size);
    let larger = full_size.pixel_count() as f64 / ladder.size.pixel_count() as f64;
    let mut text = format!(
        "## Soonest to an error\n\nAt {full_size} a picture is estimated to take {larger:.1} times \
         as long as here, where it has {}; more threads share that.\n\n\
         | RMSE | setting | ms here | s at {full_size} |\n|---|---|---|---|\n",
        ladder.size
    );
    let steps = WANTED.map(|steps| (format!("{steps}/255"), steps / 255.0));
    let wanted = wanted.map_or(steps.to_vec(), |error| vec![(error.to_string(), error.get())]);
    for (name, wanted) in wanted {
        let good = ladder.rungs().filter(|rung| rung.rmse().0 <= wanted);
        let found = good.min_by(|a, b| a.time().total_cmp(&b.time()));
        let (setting, time, large) =
            found.map_or(("none of these".to_owned(), String::new(), String::new()), |rung| {
                let spread = Quartiles::new(&rung.milliseconds).to_string();
                (rung.setting.clone(), spread, format!("{:.2}", rung.time() * larger / 1e3))
            });
        let _ = writeln!(text, "| {name} | {setting} | {time} | {large} |");
    }
    text.push('\n');
    text
}
