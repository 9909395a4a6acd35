//! How fast scene texts and mesh files are read, and how much memory that takes:
//! `cargo bench -p rtfarm-core --bench read`.
//!
//! The files are made here: a sphere of a million triangles with bumps, the same bytes every time.

#![expect(
    clippy::disallowed_methods,
    clippy::print_stdout,
    reason = "a benchmark measures time and prints it"
)]

use std::{env, fmt::Write, fs, io, process::Command, time::Instant};

use rtfarm_core::{assets::mesh::read_mesh, language::read_scene};

/// Rows of the sphere's grid; a row has twice as many cells, a cell two triangles.
const ROWS: usize = 500;

/// What is measured: a name, the bytes, the triangles that they give, and the reader.
type Case = (&'static str, Vec<u8>, usize, fn(&[u8]) -> usize);

fn main() {
    // With a name as its argument the program reads that case once and tells what memory it took.
    if let Some(name) = env::args().nth(1).filter(|name| !name.starts_with('-')) {
        let case = cases().into_iter().find(|case| case.0 == name).expect("the name is a case's");
        println!("{:.0}", peak_memory(&case).unwrap_or(0.0));
        return;
    }
    for case in cases() {
        measure(&case);
    }
}

fn cases() -> Vec<Case> {
    let (vertices, triangles) = sphere();
    let copies: Vec<_> =
        triangles.iter().take(1000).cycle().take(triangles.len()).copied().collect();
    let count = triangles.len();
    vec![
        ("scene text", scene_text(&vertices, &triangles), count, count_triangles),
        ("copies of 1000", scene_text(&vertices, &copies), 1000, count_triangles),
        ("OBJ", obj(&vertices, &triangles), count, |bytes| count_faces("a.obj", bytes)),
        ("binary STL", binary_stl(&vertices, &triangles), count, |bytes| {
            count_faces("a.stl", bytes)
        }),
        ("ASCII STL", ascii_stl(&vertices, &triangles), count, |bytes| count_faces("a.stl", bytes)),
        ("ASCII PLY", ascii_ply(&vertices, &triangles), count, |bytes| count_faces("a.ply", bytes)),
        ("binary PLY", binary_ply(&vertices, &triangles), count, |bytes| {
            count_faces("a.ply", bytes)
        }),
    ]
}

fn count_triangles(text: &[u8]) -> usize {
    let nothing = |_: &str| Err(io::ErrorKind::NotFound.into());
    read_scene(text, &nothing).scene.map_or(0, |scene| scene.triangles.len())
}

fn count_faces(path: &str, bytes: &[u8]) -> usize {
    read_mesh(path, bytes).map_or(0, |mesh| mesh.shape.triangles.len())
}

/// Prints the median of nine runs on one and on two threads, and the memory that is taken.
fn measure((name, bytes, expected, read): &Case) {
    let megabytes = bytes.len() as f64 / 1e6;
    let mut line = format!("{name:<15} {megabytes:>4.0} MB");
    for threads in [1, 2] {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .expect("threads can be started");
        let mut seconds: Vec<f64> = (0..9)
            .map(|_| {
                let start = Instant::now();
                assert_eq!(pool.install(|| read(bytes)), *expected);
                start.elapsed().as_secs_f64()
            })
            .collect();
        seconds.sort_by(f64::total_cmp);
        write!(line, "   {threads} thread(s) {:>4.0} MB/s", megabytes / seconds[4])
            .expect("strings take all");
    }
    let program = env::current_exe().expect("the program has a path");
    let output = Command::new(program).arg(name).output().expect("the program can be started");
    println!("{line}   takes {} MB", String::from_utf8_lossy(&output.stdout).trim());
}

/// The most megabytes that reading holds at once, the file not counted, where the system can tell.
fn peak_memory((_, bytes, _, read): &Case) -> Option<f64> {
    let kilobytes = |key: &str| -> Option<f64> {
        let status = fs::read_to_string("/proc/self/status").ok()?;
        let line = status.lines().find(|line| line.starts_with(key))?;
        line.split_whitespace().nth(1)?.parse().ok()
    };
    fs::write("/proc/self/clear_refs", "5").ok()?;
    let before = kilobytes("VmRSS")?;
    read(bytes);
    Some((kilobytes("VmHWM")? - before) / 1000.0)
}

/// Vertices and triangles.
fn sphere() -> (Vec<[f32; 3]>, Vec<[usize; 3]>) {
    let columns = 2 * ROWS;
    // Rational points of a circle: no sine is needed.
    let circle = |t: f64| [(1.0 - t * t) / (1.0 + t * t), 2.0 * t / (1.0 + t * t)];
    let mut vertices = Vec::new();
    for row in 0..=ROWS {
        let [x, z] = circle(2.0 * (row as f64 + 0.5) / (ROWS as f64 + 1.0) - 1.0);
        for column in 0..columns {
            let quarter = column * 4 / columns;
            let [c, s] = circle((column * 4 % columns) as f64 / columns as f64 * 0.4142);
            let [c, s] = [[c, s], [-s, c], [-c, -s], [s, -c]][quarter];
            let bump = 1.0 + 0.01 * ((row * column) % 7) as f64;
            vertices.push([bump * x * c, bump * x * s, bump * z].map(|number| number as f32));
        }
    }
    let mut triangles = Vec::new();
    for row in 0..ROWS {
        for column in 0..columns {
            let at = |row: usize, column: usize| row * columns + column % columns;
            let [a, b] = [at(row, column), at(row, column + 1)];
            let [c, d] = [at(row + 1, column), at(row + 1, column + 1)];
            triangles.extend([[a, b, d], [a, d, c]]);
        }
    }
    (vertices, triangles)
}

fn scene_text(vertices: &[[f32; 3]], triangles: &[[usize; 3]]) -> Vec<u8> {
    let mut text =
        "materials\n\tentry\n\t\tname glass\n\tendentry\nendmaterials\ngeometry\n".to_owned();
    for triangle in triangles {
        text += "\ttriangle\n";
        for [x, y, z] in triangle.map(|k| vertices[k]) {
            writeln!(text, "\t\tvertex {x} {y} {z}").expect("strings take all");
        }
        text += "\t\tmaterial glass\n\tendtriangle\n";
    }
    (text + "endgeometry\n").into_bytes()
}

fn obj(vertices: &[[f32; 3]], triangles: &[[usize; 3]]) -> Vec<u8> {
    let mut text = String::new();
    for [x, y, z] in vertices {
        writeln!(text, "v {x} {y} {z}").expect("strings take all");
    }
    for [a, b, c] in triangles.iter().map(|triangle| triangle.map(|k| k + 1)) {
        writeln!(text, "f {a} {b} {c}").expect("strings take all");
    }
    text.into_bytes()
}

fn binary_stl(vertices: &[[f32; 3]], triangles: &[[usize; 3]]) -> Vec<u8> {
    let mut bytes = vec![b' '; 80];
    bytes.extend((triangles.len() as u32).to_le_bytes());
    for triangle in triangles {
        bytes.extend([0; 12]);
        bytes.extend(triangle.iter().flat_map(|&k| vertices[k]).flat_map(f32::to_le_bytes));
        bytes.extend([0; 2]);
    }
    bytes
}

fn ascii_stl(vertices: &[[f32; 3]], triangles: &[[usize; 3]]) -> Vec<u8> {
    let mut text = "solid sphere\n".to_owned();
    for triangle in triangles {
        text += "facet normal 0 0 0\n outer loop\n";
        for [x, y, z] in triangle.map(|k| vertices[k]) {
            writeln!(text, "  vertex {x:e} {y:e} {z:e}").expect("strings take all");
        }
        text += " endloop\nendfacet\n";
    }
    (text + "endsolid sphere\n").into_bytes()
}

fn ply_header(format: &str, vertices: &[[f32; 3]], triangles: &[[usize; 3]]) -> String {
    format!(
        "ply\nformat {format} 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\n\
         element face {}\nproperty list uchar int vertex_indices\nend_header\n",
        vertices.len(),
        triangles.len()
    )
}

fn ascii_ply(vertices: &[[f32; 3]], triangles: &[[usize; 3]]) -> Vec<u8> {
    let mut text = ply_header("ascii", vertices, triangles);
    for [x, y, z] in vertices {
        writeln!(text, "{x} {y} {z}").expect("strings take all");
    }
    for [a, b, c] in triangles {
        writeln!(text, "3 {a} {b} {c}").expect("strings take all");
    }
    text.into_bytes()
}

fn binary_ply(vertices: &[[f32; 3]], triangles: &[[usize; 3]]) -> Vec<u8> {
    let mut bytes = ply_header("binary_little_endian", vertices, triangles).into_bytes();
    bytes.extend(vertices.iter().flatten().flat_map(|number| number.to_le_bytes()));
    for triangle in triangles {
        bytes.push(3);
        bytes.extend(triangle.iter().flat_map(|&k| (k as u32).to_le_bytes()));
    }
    bytes
}
