//! `rtfarm check`: what is wrong with a scene, and what it needs.

use std::io::{self, Write};

use anyhow::{Context, anyhow};
use rtfarm_core::{
    isa::Isa,
    language::{Diagnostic, Reading, Severity, draw_diagnostics, read_scene},
    prepare::{Form, prepare_as},
    prepared::PreparedScene,
    scene::Scene,
};
use serde_json::{Value, json};
use tokio::task::spawn_blocking;
use tokio_util::sync::CancellationToken;

use crate::{
    args::{CheckArgs, form},
    console::Console,
    failure::Failure,
    scene_files::SceneFiles,
    source::SceneText,
};

pub(crate) async fn run(
    args: CheckArgs,
    console: &Console,
    stop: &CancellationToken,
) -> Result<(), Failure> {
    let text = SceneText::read(&args.scene, stop).await?;
    let name = args.scene.name();
    let style = Console::drawing_style();
    let checking = spawn_blocking(move || {
        let files = SceneFiles::new(&args.scene);
        let mut reading = read_scene(&text, &|name: &str| files.read(name));
        if args.scene.strict {
            reading = reading.into_strict();
        }
        let report = draw_diagnostics(&args.scene.name(), &text, &reading.diagnostics, style);
        let findings = reading.scene.as_ref().map(|scene| Findings::new(scene, form(args.compact)));
        text.ensure_unchanged().map(|()| (args.json, report, reading, findings))
    });
    let checked = tokio::select! {
        checked = checking => checked?,
        () = stop.cancelled() => return Err(Failure::Interrupted),
    };
    let (is_json, report, reading, findings) =
        checked.with_context(|| format!("cannot read the scene {name}"))?;
    let is_rendered = findings.as_ref().map(|findings| findings.prepared.clone().map(drop));
    let mut output = io::stdout().lock();
    let told = if is_json {
        let answer = answer(&name, &reading, findings.as_ref());
        writeln!(output, "{answer:#}")
    } else {
        console.tell_report(&report);
        if let Some(more) = reading.omitted.summary() {
            console.tell(&more);
        }
        findings.map_or(Ok(()), |findings| findings.tell(&name, &mut output))
    };
    told.context("cannot write to standard output")?;
    match is_rendered {
        Some(Ok(())) => Ok(()),
        Some(Err(reason)) => Err(Failure::Input(anyhow!("cannot render {name}: {reason}"))),
        None => Err(Failure::Told),
    }
}

/// What a valid scene holds and needs.
struct Findings {
    counts: Vec<(&'static str, usize)>,
    dropped: Vec<(&'static str, u64)>,
    needed: Vec<&'static str>,
    absent: Vec<&'static str>,
    /// The size of the prepared scene, or why there is none.
    prepared: Result<usize, String>,
}

impl Findings {
    fn new(scene: &Scene, form: Form) -> Self {
        let counts = [
            ("triangles", scene.triangles.len()),
            ("quadrangles", scene.quadrangles.len()),
            ("spheres", scene.spheres.len()),
            ("parallelepipeds", scene.parallelepipeds.len()),
            ("solids", scene.solids.len()),
            ("meshes", scene.meshes.len()),
            ("mesh triangles", scene.meshes.iter().map(|mesh| mesh.shape.triangles.len()).sum()),
            ("materials", scene.materials.len()),
            ("lights", scene.lights.len()),
        ];
        let dropped = [
            ("triangles of zero area", scene.dropped.zero_area),
            ("copies of triangles", scene.dropped.duplicates),
        ];
        let (needed, absent): (Vec<_>, Vec<_>) = scene.needs().into_iter().partition(|need| need.1);
        let prepared =
            prepare_as(scene, form).map_err(|error| error.to_string()).and_then(|bytes| {
                let opened = PreparedScene::open(bytes).map_err(|error| error.to_string())?;
                Ok(opened.byte_count())
            });
        Self {
            counts: counts.into_iter().filter(|(_, count)| *count > 0).collect(),
            dropped: dropped.into_iter().filter(|(_, count)| *count > 0).collect(),
            needed: needed.into_iter().map(|need| need.0).collect(),
            absent: absent.into_iter().map(|need| need.0).collect(),
            prepared,
        }
    }

    fn tell(&self, name: &str, output: &mut impl Write) -> io::Result<()> {
        let list = |words: &[&str]| {
            if words.is_empty() { "nothing".to_owned() } else { words.join(", ") }
        };
        let counts: Vec<String> =
            self.counts.iter().map(|&(nouns, count)| counted(count, nouns)).collect();
        writeln!(
            output,
            "{name}: {}",
            if counts.is_empty() { "empty".into() } else { counts.join(", ") }
        )?;
        for (noun, count) in &self.dropped {
            writeln!(output, "left out: {count} {noun}")?;
        }
        writeln!(output, "needs: {}", list(&self.needed))?;
        writeln!(output, "absent: {}", list(&self.absent))?;
        match &self.prepared {
            Ok(bytes) => writeln!(output, "prepared: {bytes} bytes, for kernel {}", Isa::fastest()),
            Err(_) => Ok(()),
        }
    }
}

/// So many of something, whose name in the plural is given.
fn counted(count: usize, nouns: &str) -> String {
    let noun = match count {
        1 if nouns == "meshes" => "mesh",
        1 => nouns.trim_end_matches('s'),
        _ => nouns,
    };
    format!("{count} {noun}")
}

/// The answer for machines.
fn answer(name: &str, reading: &Reading, findings: Option<&Findings>) -> Value {
    let diagnostics: Vec<Value> = reading.diagnostics.iter().map(diagnostic).collect();
    let mut answer = json!({
        "scene": name,
        "valid": reading.scene.is_some(),
        "diagnostics": diagnostics,
        "omitted": { "errors": reading.omitted.errors, "warnings": reading.omitted.warnings },
    });
    if let Some(findings) = findings {
        let counts: serde_json::Map<String, Value> = findings
            .counts
            .iter()
            .map(|(noun, count)| (noun.replace(' ', "_"), json!(count)))
            .collect();
        let dropped: serde_json::Map<String, Value> = findings
            .dropped
            .iter()
            .map(|(noun, count)| (noun.replace(' ', "_"), json!(count)))
            .collect();
        answer["counts"] = counts.into();
        answer["left_out"] = dropped.into();
        answer["needs"] = json!(findings.needed);
        answer["absent"] = json!(findings.absent);
        answer["kernel"] = json!(Isa::fastest().to_string());
        match &findings.prepared {
            Ok(bytes) => answer["prepared_bytes"] = json!(bytes),
            Err(reason) => answer["cannot_render"] = json!(reason),
        }
    }
    answer
}

fn diagnostic(diagnostic: &Diagnostic) -> Value {
    let Diagnostic { severity, at, span, message, related } = diagnostic;
    json!({
        "severity": if *severity == Severity::Error { "error" } else { "warning" },
        "line": at.line,
        "column": at.column,
        "bytes": [span.start, span.end],
        "message": message,
        "related": related.as_ref().map(|related| json!({
            "line": related.at.line,
            "column": related.at.column,
            "message": related.label,
        })),
    })
}
