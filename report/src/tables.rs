//! The report's text, in Markdown, and the plot of its kernels.

use std::fmt::Write;

use rtfarm_ladder::{
    ERROR_PLOT, Ladder, Rung,
    figures::{Quartiles, decimals, median, slope},
    plot::{Legend, Panel, PlotError, draw},
    tables::{LEGEND, WANTED, method, table},
};

use crate::{
    kernels::{Amount, Case, Kernel, names},
    race::{self, Row},
};

/// The plots beside that of error against time.
pub(crate) const PEERS_PLOT: &str = "peers.svg";
pub(crate) const KERNEL_PLOT: &str = "kernels.svg";
pub(crate) const RACE_PLOT: &str = "race.svg";

/// The report on pictures and distances that are known; `beside` other renderers, `branches` the
/// section on what is followed by chance.
pub(crate) fn on_known(
    ladders: &[Ladder],
    beside: &[Ladder],
    branches: &str,
    (cases, race, amount): (&[Case], &[Row], Amount),
) -> String {
    let mut text = format!(
        "# Speed against error\n\nTruth is a closed form for every pixel. {LEGEND}\
         ![error against time]({ERROR_PLOT})\n\n"
    );
    text.extend(ladders.iter().map(table));
    text += &summary(ladders);
    if !beside.is_empty() {
        text += &peers(beside);
    }
    text += branches;
    text += &kernels(cases, amount);
    if !race.is_empty() {
        text += &race::tables(race, RACE_PLOT);
    }
    text += &method(ladders);
    let _ = writeln!(
        text,
        "\nKernels run alone on one thread, each in turn, {} times; the median and the quartiles of \
         those. The time includes the copy of a ray into the tracer's own form.",
        amount.runs
    );
    text
}

/// What holds over all scenes.
fn summary(ladders: &[Ladder]) -> String {
    let mut text = String::from(
        "## How well a render tells its error\n\nTold over true: the median, and the least and the \
         most of all settings and seeds. Of an image seen from afar the filter is part of the \
         error, and samples hardly show it.\n\n| scene | fixed | adaptive |\n|---|---|---|\n",
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
             times its time and its samples a fixed number takes; `<` where one sample in the \
             pixel's middle is better already.\n\n| scene | setting | time | samples |\n|---|---|---|---|\n";
    for ladder in ladders {
        for rung in ladder.adaptive() {
            let samples_of = |rung: &Rung| rung.samples_a_pixel.unwrap_or(0.0);
            let ratio = |cost: &dyn Fn(&Rung) -> f64| {
                let least = at_rmse(ladder.fixed(), rung.rmse().0, cost)?;
                Some(least.told(|of_fixed| format!("{:.1}", of_fixed / cost(rung))))
            };
            if let (Some(time), Some(samples)) = (ratio(&Rung::time), ratio(&samples_of)) {
                let _ =
                    writeln!(text, "| {} | {} | {time} | {samples} |", ladder.name, rung.setting);
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
         renderer cannot express is left out.\n\n![peers]({PEERS_PLOT})\n\n\
         Milliseconds to an RMSE, between the two settings beside it by the slope of their \
         logarithms; `-` where no setting measured comes to it, `<` where the first is better \
         already. `stays` is the RMSE that the last settings do not get below: the slope of the last \
         four is above -0.25, which is bias of the renderer or of the way it was asked.\n\n",
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
    at_rmse(rungs, wanted, &Rung::time).map_or("-".to_owned(), |least| {
        least.told(|time| format!("{time:.digits$}", digits = decimals(time)))
    })
}

/// What it costs to come to an error.
enum Cost {
    /// Of the first rung, which comes to less.
    Below(f64),
    Of(f64),
}

impl Cost {
    fn told(&self, tell: impl Fn(f64) -> String) -> String {
        match *self {
            Self::Below(cost) => format!("< {}", tell(cost)),
            Self::Of(cost) => tell(cost),
        }
    }
}

/// What rungs cost at an error between theirs, along the line through the first two that have it
/// between them, in logarithms; `None` where none comes to it.
#[expect(clippy::disallowed_methods, reason = "a table's figure reaches no pixel")]
fn at_rmse(rungs: &[Rung], wanted: f64, cost: &dyn Fn(&Rung) -> f64) -> Option<Cost> {
    let rmse = |rung: &Rung| rung.rmse().0;
    if let Some(first) = rungs.first().filter(|first| rmse(first) <= wanted) {
        return Some(Cost::Below(cost(first)));
    }
    rungs.windows(2).find(|pair| rmse(&pair[0]) >= wanted && rmse(&pair[1]) <= wanted).map(|pair| {
        let [before, after] = [rmse(&pair[0]), rmse(&pair[1])];
        let part = (before / wanted).ln() / (before / after).ln().max(f64::MIN_POSITIVE);
        Cost::Of(cost(&pair[0]) * (cost(&pair[1]) / cost(&pair[0])).powf(part))
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
        amount.exact, KERNEL_PLOT
    );
    let speed = |kernel: &Kernel| {
        let speeds = &kernel.speeds;
        if speeds.is_empty() { String::new() } else { Quartiles::new(speeds).to_string() }
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

/// Draws error against rays a second, one panel a place of the mesh: a point a kernel and aim.
pub(crate) fn draw_kernels(cases: &[Case]) -> Result<String, PlotError> {
    let panels: Vec<Panel> = cases
        .chunk_by(|a, b| a.moved == b.moved)
        .map(|cases| Panel {
            caption: format!("the mesh moved by {:e}", cases[0].moved),
            x: "million rays a second",
            y: "largest relative error",
            // From double precision to worse than single.
            y_limits: Some(3e-17..1e-5),
            is_joined: false,
            legend: Legend::UpperLeft,
            series: (names(cases).into_iter())
                .map(|name| {
                    let kernels = cases.iter().flat_map(|case| &case.kernels);
                    let is_drawn =
                        |kernel: &&Kernel| kernel.name == name && !kernel.speeds.is_empty();
                    let point = |kernel: &Kernel| [median(&kernel.speeds), kernel.worst, 0.0];
                    (name.to_owned(), kernels.filter(is_drawn).map(point).collect())
                })
                .filter(|(_, points): &(String, Vec<_>)| !points.is_empty())
                .collect(),
        })
        .collect();
    draw(&panels)
}
