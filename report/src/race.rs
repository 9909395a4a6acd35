//! Kernels beside those of another program, by turns: the same meshes and rays in single precision.
//!
//! `tests/peers/run.py` gives the orders, to this program and to the other one, and leaves
//! `race.tsv`.

use std::{
    fmt::Write as _,
    fs,
    io::{self, BufRead, Write},
    path::Path,
};

use anyhow::{Context, bail};
use glam::DVec3;
use rtfarm_core::{
    isa::Isa,
    prepare::prepare,
    prepared::PreparedScene,
    scene::Scene,
    testing::{Probe, Probing, TimedKernels, hierarchy_of},
};
use rtfarm_ladder::{
    figures::{Quartiles, median},
    plot::{Bars, PlotError, draw_bars},
};
use rtfarm_oracle::random::Random;

use crate::{
    kernels::{ALONG, Amount, Mesh, now, prepared, visible},
    peers::{lines, numbers},
};

/// What was measured, a line each, in columns that tabs part: triangles, class, instruction set,
/// program, what each run had (millions of rays a second; of the class `build` seconds) parted by
/// commas, leaks (of `build` bytes), rays (of `build` triangles).
const RACE: &str = "race.tsv";

/// The class of what is no ray, and our own program.
const BUILD: &str = "build";
const OURS: &str = "rtfarm";

/// A ray as it stands in a file: start, direction, reach, and how far its hit is at most if it does
/// not leak.
type RaceRay = [f32; 8];

/// Triangles along an edge of the octahedron, and pixels across and down, of each race.
fn races(amount: Amount) -> Vec<(i32, [u32; 2])> {
    let is_small = amount.rays < 1_000;
    if is_small { vec![(ALONG, [32, 24])] } else { vec![(112, [1280, 720]), (354, [1280, 720])] }
}

/// Writes the meshes and the rays: `race-TRIANGLES` with nine little-endian f32 a triangle and
/// `race-TRIANGLES-CLASS` with eight a ray.
pub(crate) fn write(folder: &Path, amount: Amount) -> anyhow::Result<()> {
    for (along, size) in races(amount) {
        let mesh = Mesh::new(along, 0.0);
        let name = format!("race-{}", mesh.triangles.len());
        let corners = mesh.triangles.as_flattened().iter().flat_map(DVec3::to_array);
        let numbers: Vec<f32> = corners.map(|number| number as f32).collect();
        let put = |name: &str, numbers: &[f32]| {
            let bytes: Vec<u8> = numbers.iter().flat_map(|number| number.to_le_bytes()).collect();
            let path = folder.join(name);
            fs::write(&path, bytes).with_context(|| format!("cannot write {}", path.display()))
        };
        put(&name, &numbers)?;
        for (class, rays) in rays(&mesh, size) {
            put(&format!("{name}-{class}"), rays.as_flattened())?;
        }
    }
    Ok(())
}

/// The rays of each class: from the eye through the middles of pixels in blocks of 8 x 8, none of
/// which misses the mesh; from what they meet to a light that half of it sees; from inside the mesh
/// anywhere.
fn rays(mesh: &Mesh, [width, height]: [u32; 2]) -> [(&'static str, Vec<RaceRay>); 3] {
    let scene = prepared(&visible(&mesh.triangles));
    let single = |v: DVec3| v.as_vec3().as_dvec3();
    let eye = single(DVec3::new(0.9, 1.2, 2.6));
    let forward = (-eye).normalize();
    let right = forward.cross(DVec3::Y).normalize();
    let up = right.cross(forward);
    let mut camera = Vec::new();
    for block in 0..(width / 8) * (height / 8) {
        let corner = [block % (width / 8) * 8, block / (width / 8) * 8];
        for k in 0..64 {
            let u = (f64::from(corner[0] + k % 8) + 0.5) / f64::from(width) - 0.5;
            let v = 0.5 - (f64::from(corner[1] + k / 8) + 0.5) / f64::from(height);
            let direction = forward + 0.46 * u * right + 0.46 * 9.0 / 16.0 * v * up;
            camera.push(Probe {
                origin: eye,
                direction: single(direction.normalize()),
                leaving: None,
            });
        }
    }
    let light = single(DVec3::new(3.0, 1.0, 1.0));
    let hits = scene.probe(&camera, Isa::fastest());
    let mut shadow = Vec::new();
    for (ray, hit) in camera.iter().zip(hits) {
        let place = ray.origin + hit.expect("a mesh that fills the view").t * ray.direction;
        let start = single(place * 1.000_1);
        let way = light - start;
        let most = if start.dot(way) < -0.1 { 0.0 } else { f64::INFINITY };
        shadow.push(race_ray(start, way.normalize(), way.length(), most));
    }
    let random = &mut Random::new(7);
    let mut anywhere = Vec::new();
    for _ in 0..camera.len() {
        let (origin, direction) = (0.5 * random.in_cube(), random.direction());
        anywhere.push(race_ray(origin, direction, f64::INFINITY, 2.0));
    }
    let most = eye.length();
    let camera = camera.iter().map(|ray| race_ray(ray.origin, ray.direction, f64::INFINITY, most));
    [("camera", camera.collect()), ("shadow", shadow), ("anywhere", anywhere)]
}

fn race_ray(origin: DVec3, direction: DVec3, reach: f64, most: f64) -> RaceRay {
    let [[x, y, z], [dx, dy, dz]] = [origin, direction].map(|v| v.as_vec3().to_array());
    [x, y, z, dx, dy, dz, reach as f32, most as f32]
}

/// Follows the orders on standard input, which `tests/peers/embree.c` tells. The build is that of
/// the hierarchy alone; a third number is the time of all that preparing a scene is.
pub(crate) fn serve(folder: &Path, isa: Isa) -> anyhow::Result<()> {
    let mut lines = io::stdin().lock().lines();
    let mut next = || lines.next().transpose();
    let mut order = next()?;
    while let Some(line) = order.take() {
        let words: Vec<&str> = line.split_whitespace().collect();
        let ["build", mesh] = words[..] else { bail!("`{line}` is no order for a start") };
        let triangles = read_numbers::<9>(&folder.join(mesh))?;
        let corner = |c: &[f32]| DVec3::new(c[0].into(), c[1].into(), c[2].into());
        let triangles: Vec<[DVec3; 3]> =
            triangles.iter().map(|t| [corner(t), corner(&t[3..]), corner(&t[6..])]).collect();
        let scene = visible(&triangles);
        let scene = build(&scene)?;
        order = follow(folder, &mut TimedKernels::new(&scene, isa), &mut next)?;
    }
    Ok(())
}

/// Builds the hierarchy, then all; tells the times and the bytes.
fn build(scene: &Scene) -> anyhow::Result<PreparedScene<rtfarm_core::prepared::PreparedBytes>> {
    let hierarchy = hierarchy_of(scene)?;
    let start = now();
    std::hint::black_box(hierarchy());
    let alone = start.elapsed().as_secs_f64();
    drop(hierarchy);
    let start = now();
    let bytes = prepare(scene)?;
    let all = start.elapsed().as_secs_f64();
    let scene = PreparedScene::open(bytes).expect("what was just prepared");
    println_flushed(&format!("{alone} {} {all}", scene.byte_count()))?;
    Ok(scene)
}

/// Follows the orders for one mesh; the first that is for another.
fn follow(
    folder: &Path,
    kernels: &mut TimedKernels<'_>,
    next: &mut impl FnMut() -> io::Result<Option<String>>,
) -> anyhow::Result<Option<String>> {
    let (mut rays, mut name, mut distances) = (Vec::new(), String::new(), Vec::new());
    while let Some(line) = next()? {
        let words: Vec<&str> = line.split_whitespace().collect();
        match words[..] {
            ["trace", way @ ("meet" | "block"), _, file] => {
                if name != file {
                    rays = read_numbers::<8>(&folder.join(file))?;
                    file.clone_into(&mut name);
                }
                distances.clear();
                let start = now();
                if way == "meet" {
                    kernels.meet(&rays, &mut distances);
                } else {
                    kernels.block(&rays, &mut distances);
                }
                println_flushed(&start.elapsed().as_secs_f64().to_string())?;
            }
            ["tell", file] => {
                let bytes: Vec<u8> =
                    distances.iter().flat_map(|&t| (t as f32).to_le_bytes()).collect();
                fs::write(folder.join(file), bytes)?;
                println_flushed(&distances.len().to_string())?;
            }
            _ => return Ok(Some(line)),
        }
    }
    Ok(None)
}

fn println_flushed(line: &str) -> io::Result<()> {
    let mut out = io::stdout().lock();
    writeln!(out, "{line}")?;
    out.flush()
}

fn read_numbers<const N: usize>(path: &Path) -> anyhow::Result<Vec<[f32; N]>> {
    let bytes = fs::read(path).with_context(|| format!("cannot read {}", path.display()))?;
    let numbers: Vec<f32> = bytes.as_chunks().0.iter().map(|b| f32::from_le_bytes(*b)).collect();
    Ok(numbers.as_chunks().0.to_vec())
}

/// What one program made of one class of rays, or how it built.
pub(crate) struct Row {
    triangles: u32,
    class: String,
    isa: String,
    program: String,
    figures: Vec<f64>,
    /// Rays that leak; of a build bytes.
    count: f64,
    of: f64,
}

/// What `tests/peers/run.py` left, if anything.
pub(crate) fn read(folder: &Path) -> anyhow::Result<Vec<Row>> {
    let row = |[triangles, class, isa, program, figures, count, of]: [String; 7]| {
        let figures = numbers(&figures)?;
        let triangles = triangles.parse()?;
        let [count, of] = [count.parse()?, of.parse()?];
        Ok(Row { triangles, class, isa, program, figures, count, of })
    };
    lines(&folder.join(RACE))?.into_iter().map(row).collect()
}

/// The tables of what was read.
pub(crate) fn tables(rows: &[Row], plot: &str) -> String {
    let mut text = format!(
        "## Kernels beside Embree\n\nA closed sphere, rays in single precision, one thread, every \
         program by turns in each run; medians and quartiles. Camera rays come in blocks of 8 x 8 \
         pixels of 1280 x 720, shadow rays start where these end, rays to anywhere start inside. \
         rtfarm gets all rays of a class at once, Embree one a call or streams of 64 that are said to \
         be coherent. A leak is a ray that passes a wall.\n\n![kernels beside Embree]({plot})\n\n\
         | triangles | rays | instructions | program | million rays a second | rtfarm / it | leaks |\n\
         |---|---|---|---|---|---|---|\n"
    );
    let traced = rows.iter().filter(|row| row.class != BUILD);
    for row in traced {
        let ratio = median(&ours(rows, row).figures) / median(&row.figures);
        let Row { triangles, class, isa, program, count, .. } = row;
        let speed = Quartiles::new(&row.figures);
        let _ = writeln!(
            text,
            "| {triangles} | {class} | {isa} | {program} | {speed} | {ratio:.2} | {count} |"
        );
    }
    text += "\nSeconds for the hierarchy, and for all that preparing a scene is:\n\n\
             | triangles | instructions | program | seconds | rtfarm / it | bytes a triangle |\n\
             |---|---|---|---|---|---|\n";
    for row in rows.iter().filter(|row| row.class == BUILD) {
        let ratio = median(&ours(rows, row).figures) / median(&row.figures);
        let Row { triangles, isa, program, .. } = row;
        let (time, bytes) = (Quartiles::new(&row.figures), row.count / row.of);
        let _ = writeln!(
            text,
            "| {triangles} | {isa} | {program} | {time} | {ratio:.2} | {bytes:.1} |"
        );
    }
    text.push('\n');
    text
}

/// Our own row beside this one.
fn ours<'a>(rows: &'a [Row], beside: &'a Row) -> &'a Row {
    let is_same = |row: &&Row| {
        row.program == OURS
            && (row.triangles, &row.class, &row.isa)
                == (beside.triangles, &beside.class, &beside.isa)
    };
    rows.iter().find(is_same).unwrap_or(beside)
}

/// Draws how many rays a second, a panel a mesh and class, with the leaks on each bar.
pub(crate) fn draw(rows: &[Row]) -> Result<String, PlotError> {
    let panels = rows.chunk_by(|a, b| (a.triangles, &a.class) == (b.triangles, &b.class));
    let panels = panels.filter(|rows| rows[0].class != BUILD).map(|rows| Bars {
        caption: format!("{}, {} triangles", rows[0].class, rows[0].triangles),
        x: "million rays a second",
        bars: (rows.iter())
            .map(|row| {
                let words = format!("{} {}: {} leaks", row.program, row.isa, row.count);
                (median(&row.figures), words, usize::from(row.program == OURS))
            })
            .collect(),
    });
    draw_bars(&panels.collect::<Vec<Bars>>())
}
