//! The report's text, in Markdown.

use std::fmt::Write;

use rtfarm_core::{isa::Isa, render::Sampling};

use super::{
    figures::{Errors, mean_and_band, median, slope},
    ladder::{Ladder, Rung},
};
use crate::VERSION;

/// The errors that a user may want, in 8-bit steps.
const WANTED: [f64; 5] = [8.0, 4.0, 2.0, 1.0, 0.5];

/// The whole report.
pub(super) fn report(ladders: &[Ladder], is_own: bool) -> String {
    let mut text = String::from("# Speed against error\n\n");
    text += &method(ladders);
    for ladder in ladders {
        text += &table(ladder);
    }
    if is_own {
        text.extend(ladders.iter().map(soonest));
    } else {
        text += &summary(ladders);
    }
    text
}

fn method(ladders: &[Ladder]) -> String {
    let seeds = ladders.first().map_or(0, |ladder| ladder.fixed[0].errors.len());
    let truth = match ladders.first().and_then(|ladder| ladder.reference) {
        Some(count) => format!("the picture at {count} samples a pixel"),
        None => "a closed form for every pixel".to_owned(),
    };
    format!(
        "rtfarm {VERSION} on {cpu}, kernel {isa}, one thread a picture, {seeds} seeds. Truth is \
         {truth}. Errors are of a channel, 1 is full light; time is the median of the seeds; ± is \
         the 95 % band of the mean. `p99.9` is what one channel in a thousand exceeds; `stopped` is \
         the share of channels further off than three times the error asked for; `told` is the \
         error that a render tells over the true one.\n\n",
        cpu = cpu_name(),
        isa = Isa::fastest(),
    )
}

fn cpu_name() -> String {
    let info = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let name = info.lines().find_map(|line| line.strip_prefix("model name"));
    name.map_or("an unknown CPU", |name| name.trim_start_matches([' ', '\t', ':'])).to_owned()
}

fn table(ladder: &Ladder) -> String {
    let mut text = format!("## {}, {}\n\n", ladder.name, ladder.size);
    text += "| setting | samples | ms | RMSE | relMSE | 8-bit RMSE | p99.9 | max | mean | stopped | told |\n\
             |---|---|---|---|---|---|---|---|---|---|---|\n";
    for rung in ladder.rungs() {
        let of = |value: fn(&Errors) -> f64| mean_and_band(rung.errors.iter().map(value));
        let (rmse, band) = of(|errors| errors.rmse);
        let (mean, mean_band) = of(|errors| errors.mean);
        let stopped = rung.errors[0].wrongly_stopped.map_or(String::new(), |_| {
            let (share, _) = of(|errors| errors.wrongly_stopped.unwrap_or(0.0));
            format!("{:.3} %", 100.0 * share)
        });
        let told = if rung.told.is_empty() {
            "-".to_owned()
        } else {
            format!("{:.2}", median(rung.told.iter().copied()))
        };
        let _ = writeln!(
            text,
            "| {setting} | {samples:.1} | {ms:.1} | {rmse:.2e} ± {band:.0e} | {relative:.1e} | \
             {rounded:.1e} | {high:.1e} | {worst:.1e} | {mean:.0e} ± {mean_band:.0e} | {stopped} | {told} |",
            setting = setting(rung.sampling),
            samples = rung.samples_a_pixel,
            ms = rung.milliseconds,
            relative = of(|errors| errors.relative).0,
            rounded = of(|errors| errors.rmse_8_bit).0,
            high = of(|errors| errors.high).0,
            worst = rung.errors.iter().map(|errors| errors.worst).fold(0.0, f64::max),
        );
    }
    for (kind, rungs) in [("fixed", &ladder.fixed), ("adaptive", &ladder.adaptive)] {
        let points = rungs.iter().map(|rung| (rung.milliseconds, rmse(rung)));
        if let Some(slope) = slope(points) {
            let _ = writeln!(text, "\nRMSE falls as time^{slope:.2} ({kind}).");
        }
    }
    text.push('\n');
    text
}

/// The setting as the command line has it.
fn setting(sampling: Sampling) -> String {
    match sampling {
        Sampling::Fixed(count) => format!("`--samples {count}`"),
        Sampling::Adaptive { error, most } => {
            format!("`--error {error:.3e} --max-samples {most}`")
        }
    }
}

fn rmse(rung: &Rung) -> f64 {
    mean_and_band(rung.errors.iter().map(|errors| errors.rmse)).0
}

/// Which setting comes first to an error.
fn soonest(ladder: &Ladder) -> String {
    let mut text =
        String::from("## Soonest to an error\n\n| RMSE | setting | ms |\n|---|---|---|\n");
    for steps in WANTED {
        let wanted = steps / 255.0;
        let good = ladder.rungs().filter(|rung| rmse(rung) <= wanted);
        let found = good.min_by(|a, b| a.milliseconds.total_cmp(&b.milliseconds));
        let (setting, time) = found.map_or(("none of these".to_owned(), String::new()), |rung| {
            (setting(rung.sampling), format!("{:.1}", rung.milliseconds))
        });
        let _ = writeln!(text, "| {steps}/255 | {setting} | {time} |");
    }
    text.push('\n');
    text
}

/// What holds over all scenes.
fn summary(ladders: &[Ladder]) -> String {
    let mut text = String::from("## How well a render tells its error\n\n");
    for (kind, of) in [
        ("fixed", Ladder::fixed_rungs as fn(&Ladder) -> &[Rung]),
        ("adaptive", Ladder::adaptive_rungs),
    ] {
        let rungs = ladders.iter().flat_map(of);
        let mut told: Vec<f64> = rungs.flat_map(|rung| rung.told.iter().copied()).collect();
        told.sort_by(f64::total_cmp);
        if let (Some(low), Some(high)) = (told.first(), told.last()) {
            let _ = writeln!(
                text,
                "- {kind} samples: told over true {low:.2} to {high:.2}, median {:.2}, over {} pictures.",
                median(told.iter().copied()),
                told.len()
            );
        }
    }
    text += "\n## Adaptive against fixed samples\n\nAt the RMSE of an adaptive setting, how many \
             times its time and its samples a fixed number takes.\n\n| scene | setting | time | samples |\n|---|---|---|---|\n";
    for ladder in ladders {
        for rung in &ladder.adaptive {
            let time = at_rmse(&ladder.fixed, rmse(rung), |rung| rung.milliseconds);
            let samples = at_rmse(&ladder.fixed, rmse(rung), |rung| rung.samples_a_pixel);
            if let (Some(time), Some(samples)) = (time, samples) {
                let _ = writeln!(
                    text,
                    "| {} | {} | {:.1} | {:.1} |",
                    ladder.name,
                    setting(rung.sampling),
                    time / rung.milliseconds,
                    samples / rung.samples_a_pixel
                );
            }
        }
    }
    text.push('\n');
    text
}

/// What rungs that get better and better cost at an error between theirs, along the line through
/// the two beside it in logarithms; `None` outside them.
#[expect(clippy::disallowed_methods, reason = "a table's figure reaches no pixel")]
fn at_rmse(rungs: &[Rung], wanted: f64, cost: fn(&Rung) -> f64) -> Option<f64> {
    rungs.windows(2).find(|pair| rmse(&pair[0]) >= wanted && rmse(&pair[1]) <= wanted).map(|pair| {
        let [before, after] = [rmse(&pair[0]), rmse(&pair[1])];
        let part = (before / wanted).ln() / (before / after).ln().max(f64::MIN_POSITIVE);
        cost(&pair[0]) * (cost(&pair[1]) / cost(&pair[0])).powf(part)
    })
}

impl Ladder {
    fn fixed_rungs(&self) -> &[Rung] {
        &self.fixed
    }

    fn adaptive_rungs(&self) -> &[Rung] {
        &self.adaptive
    }
}
