//! Figures of a farm for Prometheus, in its text format (0.0.4).

use std::{collections::BTreeMap, fmt::Write};

use crate::{
    farm::{JobEntry, JobPhase},
    members::Standing,
    shell::Shell,
};

/// All figures of now.
pub(crate) fn text(shell: &Shell) -> String {
    let (mut jobs, mut workers) = (BTreeMap::new(), BTreeMap::new());
    let (mut threads, mut leased, mut open) = (0, 0, Vec::new());
    for state in ["waiting", "rendering", "paused", "finished", "failed"] {
        jobs.insert(state, 0);
    }
    for (entry, _) in shell.jobs() {
        let state = match entry.phase {
            JobPhase::Waiting => "waiting",
            JobPhase::Rendering => "rendering",
            JobPhase::Paused => "paused",
            JobPhase::Finished => "finished",
            JobPhase::Failed => "failed",
        };
        *jobs.entry(state).or_default() += 1;
        if entry.progress.outcome.is_none() {
            open.push(entry);
        }
    }
    for standing in ["active", "draining", "disabled"] {
        workers.insert(standing, 0);
    }
    for (worker, tiles) in shell.workers() {
        let standing = match worker.standing {
            Standing::Active => "active",
            Standing::Draining => "draining",
            Standing::Disabled => "disabled",
        };
        *workers.entry(standing).or_default() += 1;
        threads += worker.process.threads;
        leased += tiles;
    }
    let counts = shell.events.counts();

    let mut text = String::new();
    let mut family = |name: &str, kind: &str, help: &str, samples: Vec<(String, f64)>| {
        let _ = writeln!(text, "# HELP rtfarm_{name} {help}\n# TYPE rtfarm_{name} {kind}");
        for (labels, value) in samples {
            let _ = writeln!(text, "rtfarm_{name}{labels} {value}");
        }
    };
    let one = |value: f64| vec![(String::new(), value)];
    let by = |label: &str, counts: BTreeMap<&str, u64>| -> Vec<(String, f64)> {
        let sample = |(name, count)| (format!("{{{label}=\"{name}\"}}"), count as f64);
        counts.into_iter().map(sample).collect()
    };
    let build = format!(
        "{{version=\"{}\",build=\"{}\"}}",
        escaped(&shell.config.version),
        escaped(&shell.config.build)
    );
    family("build_info", "gauge", "The coordinator's version and build.", vec![(build, 1.0)]);
    family("jobs", "gauge", "Jobs that the farm has, by state.", by("state", jobs));
    family("workers", "gauge", "Workers that are there, by standing.", by("standing", workers));
    family("worker_threads", "gauge", "Threads of all workers.", one(threads as f64));
    family("leased_tiles", "gauge", "Tiles that workers have in hand.", one(leased as f64));
    family("tiles_total", "counter", "Tiles that came into pictures.", one(counts.tiles as f64));
    family("rays_total", "counter", "Rays traced for them.", one(counts.rays as f64));
    let seconds = "Seconds of one thread that they took.";
    family("render_seconds_total", "counter", seconds, one(counts.seconds));
    let events = counts.by_name.iter().map(|(&name, &count)| (name, count)).collect();
    family("events_total", "counter", "Events besides, by what happened.", by("event", events));
    let of_jobs = |value: &dyn Fn(&JobEntry) -> Option<f64>| {
        let sample =
            |entry: &JobEntry| Some((format!("{{job=\"{}\"}}", entry.id.0), value(entry)?));
        open.iter().filter_map(sample).collect::<Vec<(String, f64)>>()
    };
    let done = of_jobs(&|entry| {
        Some(f64::from(entry.progress.tiles_done) / f64::from(entry.progress.tile_count))
    });
    family("job_done_ratio", "gauge", "How much of a job that has not ended is done.", done);
    let left = of_jobs(&|entry| Some(entry.progress.left?.mean.as_secs_f64()));
    family("job_left_seconds", "gauge", "How long it will take yet.", left);
    text
}

/// A text as a label's value.
fn escaped(text: &str) -> String {
    text.replace('\\', "\\\\").replace('"', "\\\"").replace('\n', "\\n")
}
