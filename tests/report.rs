//! `rtfarm report SCENE`, as quickly as it can be run.

use std::{
    fs,
    path::Path,
    process::{Command, Output},
};

fn report(folder: &Path, args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_rtfarm"))
        .arg("report")
        .args(["--effort", "smoke"])
        .args(args)
        .current_dir(folder)
        .output()
        .unwrap()
}

#[test]
fn a_report_on_a_scene_says_what_comes_soonest_to_an_error() {
    let scene = Path::new(env!("CARGO_MANIFEST_DIR")).join("scenes/sphere.rt");
    let folder = tempfile::tempdir().unwrap();
    let output = report(folder.path(), &[scene.to_str().unwrap()]);
    assert!(output.status.success(), "{output:?}");
    let text = String::from_utf8(output.stdout).unwrap();
    assert!(text.contains("Truth is the picture at 512 samples a pixel"), "{text}");
    let soonest = text.split("## Soonest to an error").nth(1).expect("a table");
    assert_eq!(soonest.matches("/255 | ").count(), 5, "{soonest}");
    assert_eq!(text.matches("\n| `--").count(), 6, "{text}");
    assert!(text.contains("## Method") && !text.contains("NaN"), "{text}");

    let args = [scene.to_str().unwrap(), "--wanted", "0.02", "--out", "report"];
    let output = report(folder.path(), &args);
    assert!(output.status.success(), "{output:?}");
    let text = fs::read_to_string(folder.path().join("report/report.md")).unwrap();
    assert!(text.contains("\n| 0.02 | `--"), "{text}");
    let plot = fs::read_to_string(folder.path().join("report/error-against-time.svg")).unwrap();
    assert!(plot.starts_with("<svg") && plot.contains("sphere"), "{plot}");
    assert_eq!(fs::read_dir(folder.path().join("report")).unwrap().count(), 2);
}

#[test]
fn a_report_on_nothing_says_so() {
    let folder = tempfile::tempdir().unwrap();
    let output = report(folder.path(), &[]);
    assert_eq!(output.status.code(), Some(2));
    let output = report(folder.path(), &["missing.rt"]);
    assert_eq!(output.status.code(), Some(2));
    let told = String::from_utf8(output.stderr).unwrap();
    assert!(told.contains("cannot read the scene missing.rt"), "{told}");
}
