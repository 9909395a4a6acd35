//! `rtfarm report`, as quickly as it can be run.

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
fn a_report_has_a_table_for_each_scene_and_a_plot() {
    let folder = tempfile::tempdir().unwrap();
    let output = report(folder.path(), &["--out", "report"]);
    assert!(output.status.success(), "{output:?}");
    let text = fs::read_to_string(folder.path().join("report/report.md")).unwrap();
    for scene in
        ["spheres", "polygons", "shadow", "lamp", "ball", "mirror", "glass", "checkerboard"]
    {
        let table = text.split(&format!("### {scene}, 24x18\n")).nth(1).expect(scene);
        let rows = table.lines().skip_while(|line| !line.starts_with("| `"));
        assert_eq!(rows.take_while(|line| line.starts_with("| `")).count(), 6, "{scene}: {table}");
    }
    for part in [
        "## How well a render tells its error",
        "## Adaptive against fixed samples",
        "## Kernels",
        "| 1e9 | corners | 500 | ",
        "## Method",
    ] {
        assert!(text.contains(part), "{text}");
    }
    assert!(!text.contains("NaN") && !text.contains("inf"), "{text}");
    let plot = fs::read_to_string(folder.path().join("report/error-against-time.svg")).unwrap();
    assert!(plot.starts_with("<svg") && plot.contains("spheres"), "{plot}");
    let plot = fs::read_to_string(folder.path().join("report/kernels.svg")).unwrap();
    assert!(plot.starts_with("<svg") && plot.contains("rtfarm scalar"), "{plot}");
    assert_eq!(fs::read_dir(folder.path().join("report")).unwrap().count(), 3);
}

#[test]
fn others_stand_beside_it_by_what_they_left() {
    let folder = tempfile::tempdir().unwrap();
    let output = report(folder.path(), &["--for-peers", "peers"]);
    assert!(output.status.success(), "{output:?}");
    let peers = folder.path().join("peers");
    // One that renders as we do, and a kernel that misses all.
    let rendered = Command::new(env!("CARGO_BIN_EXE_rtfarm"))
        .args(["render", "polygons.rt", "-o", "polygons.png", "--workers", "0"])
        .args(["--size", "24x18", "--samples", "1024", "--depth", "16"])
        .current_dir(&peers)
        .output()
        .unwrap();
    assert!(rendered.status.success(), "{rendered:?}");
    fs::write(peers.join("pictures.tsv"), "polygons\tOther 2\t-q\t4,5,6\tpolygons.png\n").unwrap();
    let rays = fs::read(peers.join("rays-1e3-edges")).unwrap().len() / 24;
    fs::write(peers.join("misses"), f32::INFINITY.to_le_bytes().repeat(rays)).unwrap();
    fs::write(peers.join("kernels.tsv"), "Blind\t1e3\tedges\t7,8,9\tmisses\n").unwrap();

    let output = report(folder.path(), &["--peers", "peers", "--out", "report"]);
    assert!(output.status.success(), "{output:?}");
    let text = fs::read_to_string(folder.path().join("report/report.md")).unwrap();
    let row = text.lines().find(|line| line.starts_with("| Other 2 `-q` |")).expect("a row");
    let columns: Vec<&str> = row.split('|').map(str::trim).collect();
    assert_eq!(columns[3], "5.00 (5.00–6.00)", "{row}");
    assert!(columns[4].parse::<f64>().unwrap() < 2e-3, "{row}");
    assert!(text.contains("| polygons | Other 2 | < 5.00 |"), "{text}");
    let misses = text.lines().filter(|line| line.starts_with("| 1e3 | edges |"));
    let ends: Vec<&str> = misses.map(|line| line.rsplit('|').nth(1).unwrap().trim()).collect();
    assert_eq!(ends, ["8.00 (8.00–9.00)", "0.0e0", "1000000"], "{text}");
    assert!(folder.path().join("report/peers.svg").exists());

    fs::write(peers.join("pictures.tsv"), "polygons\tOther 2\t-q\t4\tmissing.png\n").unwrap();
    let output = report(folder.path(), &["--peers", "peers"]);
    assert_eq!(output.status.code(), Some(1));
    let told = String::from_utf8(output.stderr).unwrap();
    assert!(told.contains("cannot use peers/missing.png"), "{told}");
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

    let output = report(folder.path(), &[scene.to_str().unwrap(), "--wanted", "0.02"]);
    let text = String::from_utf8(output.stdout).unwrap();
    assert!(text.contains("\n| 0.02 | `--"), "{text}");
}

#[test]
fn a_report_on_nothing_says_so() {
    let folder = tempfile::tempdir().unwrap();
    let output = report(folder.path(), &["missing.rt"]);
    assert_eq!(output.status.code(), Some(1));
    let told = String::from_utf8(output.stderr).unwrap();
    assert!(told.contains("cannot read the scene missing.rt"), "{told}");
}
