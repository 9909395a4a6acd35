//! The report's text, in Markdown.

use std::fmt::Write;

use rtfarm_core::isa::Isa;

use super::{
    figures::{Errors, Spread, decimals, mean_and_band, median, slope},
    kernels::{Amount, Case, Kernel, names},
    ladder::{Ladder, Rung},
    plot,
};
use crate::VERSION;

/// The errors that a user may want, in 8-bit steps.
const WANTED: [f64; 5] = [8.0, 4.0, 2.0, 1.0, 0.5];

const LEGEND: &str = "Errors are of a channel, 1 is full light. `ms`: of one thread. `relMSE`: the \
    mean of error² / (truth² + 0.01). `FLIP`: the mean difference to the eye in 8 bits, 0 to 1. \
    `p99.9`: what one channel in a thousand exceeds. `mean`: with its sign; one that does not fall \
    with more samples is bias. `stopped`: the share of channels further off than three times the \
    error asked for. `told`: the error that a render tells over the true one.\n\n";

/// The report on a user's scene.
pub(super) fn on_scene(ladder: &Ladder, wanted: Option<f64>) -> String {
    let samples = ladder.reference.map_or(0, |reference| reference.samples);
    let mut text = format!(
        "# Speed against error\n\nTruth is the picture at {samples} samples a pixel. {LEGEND}",
    );
    text += &soonest(ladder, wanted);
    text += &table(ladder);
    let _ = write!(text, "![error against time]({})\n\n", plot::ERROR_FILE);
    text += &method(std::slice::from_ref(ladder), None);
    text
}

/// The report on pictures and distances that are known; `beside` other renderers.
pub(super) fn on_known(
    ladders: &[Ladder],
    beside: &[Ladder],
    cases: &[Case],
    amount: Amount,
) -> String {
    let mut text = format!(
        "# Speed against error\n\nTruth is a closed form for every pixel. {LEGEND}\
         ![error against time]({})\n\n",
        plot::ERROR_FILE
    );
    text.extend(ladders.iter().map(table));
    text += &summary(ladders);
    if !beside.is_empty() {
        text += &peers(beside);
    }
    text += &kernels(cases, amount);
    text += &method(ladders, Some(amount));
    text
}

/// How the figures came about.
fn method(ladders: &[Ladder], kernels: Option<Amount>) -> String {
    let seeds = ladders.first().map_or(0, |ladder| ladder.fixed()[0].errors.len());
    let profile = if cfg!(debug_assertions) { "a debug build" } else { "a release build" };
    let mut text = format!(
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
    );
    if let Some(Amount { runs, .. }) = kernels {
        let _ = writeln!(
            text,
            "\nKernels run alone on one thread, each in turn, {runs} times; the median and the \
             quartiles of those. The time includes the copy of a ray into the tracer's own form."
        );
    }
    text
}

fn cpu_name() -> String {
    let info = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let name = info.lines().find_map(|line| line.strip_prefix("model name"));
    name.map_or("an unknown CPU", |name| name.trim_start_matches([' ', '\t', ':'])).to_owned()
}

fn table(ladder: &Ladder) -> String {
    let mut text = format!("### {}, {}\n\n", ladder.name, ladder.size);
    text += "| setting | samples | ms | RMSE | relMSE | 8-bit RMSE | FLIP | p99.9 | max | mean | stopped | told |\n\
             |---|---|---|---|---|---|---|---|---|---|---|---|\n";
    for rung in ladder.rungs() {
        text += &row(rung);
    }
    for series in &ladder.series {
        let points = series.rungs.iter().map(|rung| (rung.time(), rung.rmse().0));
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
        ms = Spread::new(&rung.milliseconds),
        rmse = banded(rung.rmse(), 2),
        relative = of(|errors| errors.relative).0,
        rounded = of(|errors| errors.rmse_8_bit).0,
        flip = of(|errors| errors.flip).0,
        high = of(|errors| errors.high).0,
        worst = rung.errors.iter().map(|errors| errors.worst).fold(0.0, f64::max),
        mean = banded(of(|errors| errors.mean), 0),
    )
}

/// Which setting comes first to an error.
fn soonest(ladder: &Ladder, wanted: Option<f64>) -> String {
    let full_size = ladder.reference.map_or(ladder.size, |reference| reference.full_size);
    let larger = full_size.pixel_count() as f64 / ladder.size.pixel_count() as f64;
    let mut text = format!(
        "## Soonest to an error\n\nAt {full_size} a picture is estimated to take {larger:.1} times \
         as long as here, where it has {}; more threads share that.\n\n\
         | RMSE | setting | ms here | s at {full_size} |\n|---|---|---|---|\n",
        ladder.size
    );
    let steps = WANTED.map(|steps| (format!("{steps}/255"), steps / 255.0));
    let wanted = wanted.map_or(steps.to_vec(), |error| vec![(format!("{error}"), error)]);
    for (name, wanted) in wanted {
        let good = ladder.rungs().filter(|rung| rung.rmse().0 <= wanted);
        let found = good.min_by(|a, b| a.time().total_cmp(&b.time()));
        let (setting, time, large) =
            found.map_or(("none of these".to_owned(), String::new(), String::new()), |rung| {
                let spread = Spread::new(&rung.milliseconds).to_string();
                (rung.setting.clone(), spread, format!("{:.2}", rung.time() * larger / 1e3))
            });
        let _ = writeln!(text, "| {name} | {setting} | {time} | {large} |");
    }
    text.push('\n');
    text
}

/// What holds over all scenes.
fn summary(ladders: &[Ladder]) -> String {
    let mut text = String::from(
        "## How well a render tells its error\n\nTold over true: the median, and the least and the \
         most of all settings and seeds. Of an image seen from afar the filter is part of the \
         error, and no sample shows it.\n\n| scene | fixed | adaptive |\n|---|---|---|\n",
    );
    let cell = |ladders: &[Ladder], of: fn(&Ladder) -> &[Rung]| {
        let rungs = ladders.iter().flat_map(of);
        let mut told: Vec<f64> = rungs.flat_map(|rung| rung.told.iter().copied()).collect();
        told.sort_by(f64::total_cmp);
        let ends = told.first().zip(told.last());
        ends.map_or(String::new(), |(low, high)| {
            format!("{:.2} ({low:.2}–{high:.2}), {} pictures", median(&told), told.len())
        })
    };
    let names = ladders.iter().map(|ladder| ladder.name.as_str()).chain(["all"]);
    let parts = ladders.chunks(1).chain([ladders]);
    for (name, part) in names.zip(parts) {
        let (fixed, adaptive) = (cell(part, Ladder::fixed), cell(part, Ladder::adaptive));
        let _ = writeln!(text, "| {name} | {fixed} | {adaptive} |");
    }
    text += "\n## Adaptive against fixed samples\n\nAt the RMSE of an adaptive setting, how many \
             times its time and its samples a fixed number takes.\n\n| scene | setting | time | samples |\n|---|---|---|---|\n";
    for ladder in ladders {
        for rung in ladder.adaptive() {
            let at = |cost: &dyn Fn(&Rung) -> f64| at_rmse(ladder.fixed(), rung.rmse().0, cost);
            let samples_of = |rung: &Rung| rung.samples_a_pixel.unwrap_or(0.0);
            if let (Some(time), Some(samples)) = (at(&Rung::time), at(&samples_of)) {
                let _ = writeln!(
                    text,
                    "| {} | {} | {:.1} | {:.1} |",
                    ladder.name,
                    rung.setting,
                    time / rung.time(),
                    samples / samples_of(rung)
                );
            }
        }
    }
    text.push('\n');
    text
}

/// rtfarm beside other renderers.
fn peers(ladders: &[Ladder]) -> String {
    let mut text = format!(
        "## Beside other renderers\n\nThe same scenes, sizes and truths, one thread each. Times are \
         those that a renderer tells of its tracing, without reading the scene or writing the \
         picture; pictures are of 16 bits a channel and one each, for most have no seeds. What a \
         renderer cannot express is left out.\n\n![peers]({})\n\n\
         Milliseconds to an RMSE, between the two settings beside it by the slope of their \
         logarithms; `-` where no setting measured comes to it, `<` where the first is better \
         already. `stays` is the RMSE that the last settings do not get below: the slope of the last \
         four is above -0.25, which is bias of the renderer or of the way it was asked.\n\n",
        plot::PEERS_FILE
    );
    text += "| scene | renderer |";
    text.extend(WANTED.map(|steps| format!(" {steps}/255 |")));
    text += " stays |\n|---|---|---|---|---|---|---|---|\n";
    for ladder in ladders {
        for (k, series) in ladder.series.iter().enumerate() {
            let ours = if k < 2 { "rtfarm " } else { "" };
            let _ = write!(text, "| {} | {ours}{} |", ladder.name, series.name);
            for steps in WANTED {
                let _ = write!(text, " {} |", time_to(&series.rungs, steps / 255.0));
            }
            let last = &series.rungs[series.rungs.len().saturating_sub(4)..];
            let points = last.iter().map(|rung| (rung.time(), rung.rmse().0));
            let lowest = last.iter().map(|rung| rung.rmse().0).fold(f64::INFINITY, f64::min);
            let stays =
                slope(points).is_some_and(|slope| slope > -0.25) && lowest > WANTED[4] / 255.0;
            let stays = if stays { format!("{lowest:.0e}") } else { String::new() };
            let _ = writeln!(text, " {stays} |");
        }
    }
    text.push('\n');
    text.extend(ladders.iter().map(table));
    text
}

fn time_to(rungs: &[Rung], wanted: f64) -> String {
    if rungs[0].rmse().0 <= wanted {
        let (time, digits) = (rungs[0].time(), decimals(rungs[0].time()));
        return format!("< {time:.digits$}");
    }
    at_rmse(rungs, wanted, &Rung::time).map_or("-".to_owned(), |time| {
        let digits = decimals(time);
        format!("{time:.digits$}")
    })
}

/// What rungs that get better and better cost at an error between theirs, along the line through
/// the two beside it in logarithms; `None` outside them.
#[expect(clippy::disallowed_methods, reason = "a table's figure reaches no pixel")]
fn at_rmse(rungs: &[Rung], wanted: f64, cost: &dyn Fn(&Rung) -> f64) -> Option<f64> {
    let rmse = |rung: &Rung| rung.rmse().0;
    rungs.windows(2).find(|pair| rmse(&pair[0]) >= wanted && rmse(&pair[1]) <= wanted).map(|pair| {
        let [before, after] = [rmse(&pair[0]), rmse(&pair[1])];
        let part = (before / wanted).ln() / (before / after).ln().max(f64::MIN_POSITIVE);
        cost(&pair[0]) * (cost(&pair[1]) / cost(&pair[0])).powf(part)
    })
}

/// Speed, error and leaks of kernels.
fn kernels(cases: &[Case], amount: Amount) -> String {
    let mut text = format!(
        "## Kernels\n\nRays from inside a closed mesh of 16 200 triangles, a sphere of radius 1, so \
         each that meets nothing is a leak. Up to 1e5 the mesh's corners and the rays' origins are \
         rounded to f32 first, so that every kernel gets the same; kernels in f32 get directions \
         rounded to it, and their truth is that of the rounded ray. Truth is exact arithmetic, for \
         {} rays of each row. Of rtfarm's tests of a ray against a \
         face those are in doubt for which it asks for the digits that f64 products lose. The \
         textbook's tests, in the form that leaves no margin, try every \
         face, so they have no speed.\n\n![kernels]({})\n\n",
        amount.exact,
        plot::KERNEL_FILE
    );
    let speed = |kernel: &Kernel| {
        let speeds = &kernel.speeds;
        if speeds.is_empty() { String::new() } else { Spread::new(speeds).to_string() }
    };
    let is_timed = |name: &str| {
        let mut kernels = cases.iter().flat_map(|case| &case.kernels);
        kernels.any(|kernel| kernel.name == name && !kernel.speeds.is_empty())
    };
    let all = names(cases);
    let timed: Vec<&str> = all.iter().copied().filter(|name| is_timed(name)).collect();
    text += "Million rays a second:\n\n";
    text += &kernel_table(cases, &timed, &[], &speed);
    text += "Largest relative error of a distance:\n\n";
    text += &kernel_table(cases, &all, &[], &|kernel| format!("{:.1e}", kernel.worst));
    text += "Leaks among a million rays:\n\n";
    let in_doubt = |case: &Case| {
        format!("{:.2} %", 100.0 * case.tests.in_doubt as f64 / case.tests.all as f64)
    };
    let own: [Column<'_>; 2] =
        [("rays", &|case: &Case| case.rays.len().to_string()), ("tests in doubt", &in_doubt)];
    text += &kernel_table(cases, &all, &own, &|kernel| {
        format!("{:.0}", 1e6 * kernel.leaks as f64 / kernel.rays as f64)
    });
    text
}

/// A column of a case that is not a kernel's.
type Column<'a> = (&'a str, &'a dyn Fn(&Case) -> String);

/// A row a case and a column a kernel.
fn kernel_table(
    cases: &[Case],
    kernels: &[&str],
    own: &[Column<'_>],
    cell: &dyn Fn(&Kernel) -> String,
) -> String {
    let mut text = String::from("| moved by | rays at |");
    text.extend(own.iter().map(|(name, _)| format!(" {name} |")));
    text.extend(kernels.iter().map(|name| format!(" {name} |")));
    text += "\n|---|---|";
    text += &"---|".repeat(own.len() + kernels.len());
    text.push('\n');
    for case in cases {
        let _ = write!(text, "| {:e} | {} |", case.moved, case.aim.name());
        text.extend(own.iter().map(|(_, column)| format!(" {} |", column(case))));
        for name in kernels {
            let kernel = case.kernels.iter().find(|kernel| kernel.name == *name);
            let _ = write!(text, " {} |", kernel.map_or(String::new(), cell));
        }
        text.push('\n');
    }
    text.push('\n');
    text
}
