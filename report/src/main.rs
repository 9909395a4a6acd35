//! The report on speed and accuracy: pictures with closed forms, so that the error is the true one,
//! and rays through a closed mesh, beside what other programs made of the same.
//!
//! `cargo run --release -p rtfarm-report -- --out DIR`; on a user's own scene, `rtfarm report
//! SCENE`.

mod branches;
mod kernels;
mod peers;
mod race;
mod tables;

use std::{
    collections::BTreeMap,
    io::{self, Write},
    ops::ControlFlow,
    path::{Path, PathBuf},
    process::ExitCode,
};

use anyhow::Context;
use clap::Parser;
use rtfarm_core::{isa::Isa, prepare::prepare, prepared::PreparedScene};
use rtfarm_ladder::{ERROR_PLOT, Effort, Ladder, Reach, Report, Subject, figures::Truth, plot};
use rtfarm_oracle::known_pictures::{KnownPicture, indirect_pictures, known_pictures, known_size};

use crate::kernels::{Amount, Case};

/// Measures speed against error on pictures with closed forms, and the kernels.
#[derive(Debug, Parser)]
#[command(version)]
struct Args {
    /// The folder that report.md and its plots go into; without it the report goes to standard
    /// output.
    #[arg(long, value_name = "DIR", conflicts_with = "for_peers")]
    out: Option<PathBuf>,

    /// How much work goes into it.
    #[arg(long, value_name = "EFFORT", default_value = "quick")]
    effort: Effort,

    /// A folder with what other programs made of the scenes and rays of `--for-peers`, to stand
    /// beside rtfarm's.
    #[arg(long, value_name = "DIR", conflicts_with = "for_peers")]
    peers: Option<PathBuf>,

    /// Only write these scenes and rays into a folder, for the same effort.
    #[arg(long, value_name = "DIR")]
    for_peers: Option<PathBuf>,

    /// Only trace the rays in a folder as standard input orders, as other programs' kernels do.
    #[arg(long, value_name = "DIR", conflicts_with_all = ["for_peers", "peers", "out"])]
    race: Option<PathBuf>,

    /// The instruction set of `--race`.
    #[arg(long, value_name = "ISA", requires = "race", default_value_t = Isa::fastest())]
    isa: Isa,
}

/// How much work a report is.
#[derive(Debug, Clone, Copy)]
struct Plan {
    /// Pixels across a closed-form picture.
    width: u32,
    reach: Reach,
    kernels: Amount,
    /// Pixels across a picture that other renderers make too: more, for some start slowly.
    peers_width: u32,
    peers_reach: Reach,
}

impl Plan {
    fn new(effort: Effort) -> Self {
        let reach = effort.reach();
        match effort {
            Effort::Smoke => Self {
                width: 24,
                reach,
                kernels: Amount { rays: 500, exact: 5, textbook: 50, runs: 1 },
                peers_width: 24,
                peers_reach: Reach { rungs: 2, seeds: 2 },
            },
            Effort::Quick => Self {
                width: 64,
                reach,
                kernels: Amount { rays: 20_000, exact: 100, textbook: 2_000, runs: 9 },
                peers_width: 128,
                peers_reach: Reach { rungs: 9, seeds: 9 },
            },
            Effort::Full => Self {
                width: 96,
                reach,
                kernels: Amount { rays: 200_000, exact: 2_000, textbook: 20_000, runs: 15 },
                peers_width: 256,
                peers_reach: Reach { rungs: 9, seeds: 9 },
            },
        }
    }
}

fn main() -> ExitCode {
    match run(&Args::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::FAILURE
        }
    }
}

fn run(args: &Args) -> anyhow::Result<()> {
    let plan = Plan::new(args.effort);
    if let Some(folder) = &args.for_peers {
        peers::write(folder, known_size(plan.peers_width), plan.kernels.rays)?;
        return race::write(folder, plan.kernels);
    }
    if let Some(folder) = &args.race {
        return race::serve(folder, args.isa);
    }
    let report = measure(&plan, args.peers.as_deref())?;
    match &args.out {
        Some(folder) => report
            .write(folder)
            .with_context(|| format!("cannot write into the folder {}", folder.display())),
        None => io::stdout()
            .lock()
            .write_all(report.text.as_bytes())
            .context("cannot write to standard output"),
    }
}

/// Measures pictures and distances that are known, and puts what other programs left in `peers`
/// beside them.
fn measure(plan: &Plan, peers: Option<&Path>) -> anyhow::Result<Report> {
    // What others left is read first: what is wrong with it is told before the work.
    let beside: Vec<Subject> = match peers {
        Some(_) => known_pictures(plan.peers_width).into_iter().map(subject_of).collect(),
        None => Vec::new(),
    };
    let truth_of = |name: &str| {
        beside.iter().find(|subject| subject.name == name).map(|subject| &subject.truth)
    };
    let mut others = match peers {
        Some(folder) => peers::read_pictures(folder, &truth_of)?,
        None => BTreeMap::new(),
    };
    let kernels_of = |moved, aim| match peers {
        Some(folder) => peers::read_kernels(folder, moved, aim),
        None => Ok(Vec::new()),
    };

    let race = peers.map(race::read).transpose()?.unwrap_or_default();
    let cases = Case::measure_all(plan.kernels, &kernels_of)?;
    let known = known_pictures(plan.width).into_iter().chain(indirect_pictures(plan.width));
    let ladders: Vec<Ladder> =
        known.map(|picture| climb(subject_of(picture), plan.reach)).collect();
    let mut ladders_beside = Vec::new();
    for subject in beside {
        let Some(series) = others.remove(&subject.name) else { continue };
        let mut ladder = climb(subject, plan.peers_reach);
        ladder.series.extend(series);
        ladders_beside.push(ladder);
    }

    let branches = branches::table(plan.width / 2, plan.reach.seeds);
    let kernels = (&cases[..], &race[..], plan.kernels);
    let text = tables::on_known(&ladders, &ladders_beside, &branches, kernels);
    let mut plots = vec![
        (ERROR_PLOT, plot::draw_errors(&ladders)?),
        (tables::KERNEL_PLOT, tables::draw_kernels(&cases)?),
    ];
    if !race.is_empty() {
        plots.push((tables::RACE_PLOT, race::draw(&race)?));
    }
    if !ladders_beside.is_empty() {
        plots.push((tables::PEERS_PLOT, plot::draw_errors(&ladders_beside)?));
    }
    Ok(Report { text, plots })
}

fn subject_of(known: KnownPicture) -> Subject {
    let KnownPicture { name, scene, size, truth, .. } = known;
    let bytes = prepare(&scene).expect("a plain scene");
    let scene = PreparedScene::open(bytes).expect("what was just prepared");
    let truth = Truth::new(truth, size);
    Subject { name: name.to_owned(), scene, truth, reference: None }
}

fn climb(subject: Subject, reach: Reach) -> Ladder {
    let ladder = Ladder::climb(subject, reach, &|| ControlFlow::Continue(()));
    let ladder = ladder.expect("nothing breaks it off");
    eprintln!("measured {}", ladder.name);
    ladder
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    use super::*;

    #[test]
    fn the_words_fit_together() {
        Args::command().debug_assert();
    }
}
