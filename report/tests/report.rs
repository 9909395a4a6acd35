//! The report on closed forms and kernels, as quickly as it can be made.

use std::{
    fs::{self, File},
    ops::ControlFlow,
    path::Path,
    process::{Command, Output},
};

use rtfarm_core::{
    isa::Isa,
    language::read_scene,
    prepare::prepare,
    prepared::PreparedScene,
    render::{Quality, Sampling, render_tile},
    tile::{Area, Size},
    transfer::Transfer,
};
use rtfarm_picture::{Notes, Picture, PictureFormat};

fn report(folder: &Path, args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_rtfarm-report"))
        .args(["--effort", "smoke"])
        .args(args)
        .current_dir(folder)
        .output()
        .unwrap()
}

/// Renders a scene as small as the report's pictures, with many samples, into a PNG of 16 bits.
fn render(scene: &Path, png: &Path) {
    let reading = read_scene(&fs::read(scene).unwrap(), &|path: &str| panic!("`{path}` is named"));
    let scene = PreparedScene::open(prepare(&reading.scene.unwrap()).unwrap()).unwrap();
    let size = Size::new(24, 18).unwrap();
    let quality = Quality { sampling: Sampling::fixed(1024).unwrap(), ..Quality::default() };
    let area = Area::whole(size);
    let go_on = &mut || ControlFlow::Continue(());
    let tile = render_tile(&scene, &quality, area, Isa::fastest(), go_on).unwrap();
    let file = tempfile::tempfile().unwrap();
    let picture = Picture::new(file, size, PictureFormat::Png16, Transfer::None).unwrap();
    picture.put(area, &tile.pixels).unwrap();
    picture.encode(&Notes::default(), File::create(png).unwrap()).unwrap();
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
        "## Branches by chance, and whole trees",
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
    render(&peers.join("polygons.rt"), &peers.join("polygons.png"));
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
