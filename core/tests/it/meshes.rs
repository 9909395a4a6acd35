//! Mesh files of all formats against the shapes that they give.

use std::fmt::Write;

use rtfarm_core::{
    assets::mesh::{MeshFault, read_mesh},
    scene::{DroppedFaces, MeshShape, MeshVertices},
};

fn read(path: &str, bytes: impl AsRef<[u8]>) -> MeshShape {
    let file = read_mesh(path, bytes.as_ref()).unwrap_or_else(|error| panic!("{path}: {error}"));
    assert_eq!(file.dropped, DroppedFaces::default());
    file.shape
}

fn check_error(path: &str, bytes: impl AsRef<[u8]>, message: &str) {
    let error = read_mesh(path, bytes.as_ref()).expect_err("this file is broken");
    assert_eq!(error.to_string(), message);
}

/// A tetrahedron in single precision.
fn tetrahedron() -> MeshShape {
    MeshShape {
        vertices: MeshVertices::Single(vec![
            [0.0; 3],
            [0.0, 1.0, 0.0],
            [1.0, 0.0, 0.0],
            [0.0, 0.0, 0.5],
        ]),
        triangles: vec![[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]],
    }
}

/// The corners of its triangles.
fn facets() -> Vec<[[f32; 3]; 3]> {
    let MeshVertices::Single(vertices) = tetrahedron().vertices else { unreachable!() };
    tetrahedron().triangles.iter().map(|triangle| triangle.map(|k| vertices[k as usize])).collect()
}

fn binary_stl(header: &str, facets: &[[[f32; 3]; 3]]) -> Vec<u8> {
    let mut bytes = header.as_bytes().to_vec();
    bytes.resize(80, b' ');
    bytes.extend((facets.len() as u32).to_le_bytes());
    for facet in facets {
        bytes.extend([0; 12]);
        bytes.extend(facet.iter().flatten().flat_map(|number| number.to_le_bytes()));
        bytes.extend([0; 2]);
    }
    bytes
}

fn ascii_stl(facets: &[[[f32; 3]; 3]]) -> String {
    let mut text = "solid vertex of a name\n".to_owned();
    for facet in facets {
        text += " facet normal 0 0 0\n  outer loop\n";
        for [x, y, z] in facet {
            writeln!(text, "   vertex {x:e} {y} {z:e}").unwrap();
        }
        text += "  endloop\n endfacet\n";
    }
    text + "endsolid vertex of a name"
}

#[test]
fn stl_vertices_are_shared() {
    for header in ["made by hand", "solid", "solid facet"] {
        assert_eq!(read("a.stl", binary_stl(header, &facets())), tetrahedron(), "{header}");
    }
    let text = ascii_stl(&facets());
    assert_eq!(read("a.stl", &text), tetrahedron());
    assert_eq!(read("a.stl", text.to_uppercase().replace('\n', "\r\n")), tetrahedron());
    assert_eq!(read("no extension", &text), tetrahedron());
}

#[test]
fn notes_after_a_binary_stl_are_skipped() {
    let mut bytes = binary_stl("made by hand", &facets());
    bytes.extend(b"colours of my own");
    assert_eq!(read("a.stl", bytes), tetrahedron());
}

#[test]
fn broken_stl_is_refused_at_its_place() {
    let binary = binary_stl("", &facets());
    check_error(
        "a.stl",
        &binary[..200],
        "it ends early: its header announces 284 bytes, but it has 200",
    );
    check_error("a.stl", "", "it ends early: its header announces 84 bytes, but it has 0");
    check_error("a.stl", binary_stl("", &[]), "it has no triangles");
    check_error("a.stl", "solid\nendsolid", "it has no triangles");
    let mut infinite = facets();
    infinite[2][1][0] = f32::INFINITY;
    check_error("a.stl", binary_stl("", &infinite), "triangle 2: expected a finite number");
    check_error("a.stl", ascii_stl(&infinite), "line 19: expected a finite number");
    let text = ascii_stl(&facets());
    check_error(
        "a.stl",
        text.replacen("endloop", "vertex 1 2 3 endloop", 1),
        "line 7: a facet must have 3 vertices, but this one has 4",
    );
    check_error("a.stl", &text[..120], "line 7: the file ends early");
}

#[test]
fn negative_zeros_are_zeros() {
    let mut negative = facets();
    negative
        .iter_mut()
        .flatten()
        .flatten()
        .filter(|number| **number == 0.0)
        .for_each(|number| *number = -0.0);
    assert_eq!(read("a.stl", binary_stl("", &negative)), tetrahedron());
    assert_eq!(read("a.stl", ascii_stl(&negative)), tetrahedron());
}

const OBJ: &str = "# a tetrahedron\r\nmtllib x.mtl\no name\nv 0 0 0\nv 0 1 0 1.0\nv 1 0 0 1 0.5 0\n\
                   vt 0 0\nvn 0 0 1\nv 0 0 .5\ng a b\nusemtl m\ns 1\n";

#[test]
fn obj_corners_take_all_forms() {
    let faces = "f 1 2 3\nf 1/1 3/1 4/1\nf 1//1 4//1 2//1\nf 2/1/1 4/1/1 3/1/1";
    assert_eq!(read("a.OBJ", format!("{OBJ}{faces}")), tetrahedron());
    let backwards = "f -4 -3 -2\nf -4 \\\n -2 -1\nf -4// -1//-1 \\\r\n-3//-1#glued\n  f\t-3 4 3  ";
    assert_eq!(read("a.obj", format!("{OBJ}{backwards}")), tetrahedron());
}

#[test]
fn obj_faces_may_come_before_their_vertices() {
    let text = format!("v 0 0 0\nf 1 2 3\nf -1 3 4\n{}", &OBJ.replace("v 0 0 0\n", ""));
    assert_eq!(read("a.obj", text).triangles, [[0, 1, 2], [0, 2, 3]]);
}

#[test]
fn obj_polygons_are_cut_into_triangles() {
    let square = "v 0 0 0\nv 2 0 0\nv 2 2 0\nv 0 2 0\n";
    assert_eq!(read("a.obj", format!("{square}f 1 2 3 4")).triangles, [[0, 1, 2], [0, 2, 3]]);
    // An arrow head: cut from its tip to its dent.
    let arrow = "v 0 0 0\nv 2 -1 0\nv 0 2 0\nv -2 -1 0\nf 1 2 3 4";
    assert_eq!(read("a.obj", arrow).triangles, [[0, 1, 2], [2, 3, 0]]);
    let turned = "v 2 -1 0\nv 0 2 0\nv -2 -1 0\nv 0 0 0\nf 1 2 3 4";
    assert_eq!(read("a.obj", turned).triangles, [[3, 0, 1], [1, 2, 3]]);
}

#[test]
fn obj_numbers_beyond_single_precision_stay_double() {
    let shape = read("a.obj", "v 0.1 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3");
    assert_eq!(
        shape.vertices,
        MeshVertices::Double(vec![[0.1, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    );
}

#[test]
fn equal_vertices_and_copies_become_one() {
    let text = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 -0\nv 1 0 0\nf 1 2 3\nf 2 3 4\nf 3 2 1\nf 1 2 5\nf 1 2 3 3";
    let file = read_mesh("a.obj", text.as_bytes()).unwrap();
    assert_eq!(file.shape.triangles, [[0, 1, 2], [2, 1, 0]]);
    assert_eq!(file.dropped, DroppedFaces { zero_area: 2, duplicates: 2 });
}

#[test]
fn broken_obj_is_refused_at_its_line() {
    let square = "v 0 0 0\nv 2 0 0\nv 2 2 0\nv 0 2 0\n";
    check_error(
        "a.obj",
        format!("{square}f 1 2 5"),
        "line 5: there is no vertex 5; vertices are numbered from 1, and the file has 4",
    );
    check_error(
        "a.obj",
        format!("{square}f 1 2 -5"),
        "line 5: there is no vertex -5; vertices are numbered from 1, and the file has 4",
    );
    check_error(
        "a.obj",
        format!("{square}f 0 1 2"),
        "line 5: there is no vertex 0; vertices are numbered from 1, and the file has 4",
    );
    check_error(
        "a.obj",
        format!("{square}f 1 2"),
        "line 5: a face must have 3 or more corners, but this one has 2",
    );
    check_error("a.obj", format!("{square}f 1 2 x"), "line 5: expected the number of a vertex");
    check_error(
        "a.obj",
        format!("{square}f 1 2 99999999999999999999"),
        "line 5: expected the number of a vertex",
    );
    check_error("a.obj", "v 1 2\nv 0 0 0", "line 1: expected a finite number");
    check_error("a.obj", "v 1 2 nan", "line 1: expected a finite number");
    check_error("a.obj", square, "it has no triangles");
    check_error("a.txt", square, "it is not an STL, OBJ or PLY file");
}

const PLY_ELEMENTS: &str = "comment by hand\nobj_info x\nelement vertex 4\nproperty float x\nproperty float y\n\
     property uchar red\nproperty float32 z\nelement face 4\nproperty uchar flags\n\
     property list uchar int vertex_indices\nproperty list int8 short more\nend_header\n";

fn ascii_ply() -> String {
    let body = "0 0 9 0\n-0 1 9 0\n1 0 9 0\n0 0 9 0.5\n7 3 0 1 2 0\n7 3 0 2 3 1 -5\n7 3 0 3 1 0\n7 3 1 3 2 2 1 2";
    format!("ply\nformat ascii 1.0\n{PLY_ELEMENTS}{body}")
}

fn binary_ply(order: &str, number: fn(f32) -> [u8; 4], index: fn(u32) -> [u8; 4]) -> Vec<u8> {
    let mut bytes =
        format!("ply\r\nformat binary_{order}_endian 1.0\r\n{PLY_ELEMENTS}").into_bytes();
    let MeshVertices::Single(vertices) = tetrahedron().vertices else { unreachable!() };
    for [x, y, z] in vertices {
        bytes.extend([number(x), number(y)].concat());
        bytes.push(9);
        bytes.extend(number(z));
    }
    for triangle in tetrahedron().triangles {
        bytes.extend([7, 3]);
        bytes.extend(triangle.map(index).concat());
        bytes.extend([1, 0, 0]);
    }
    bytes
}

fn all_plys() -> [Vec<u8>; 3] {
    [
        ascii_ply().into_bytes(),
        binary_ply("little", f32::to_le_bytes, u32::to_le_bytes),
        binary_ply("big", f32::to_be_bytes, u32::to_be_bytes),
    ]
}

#[test]
fn ply_is_read_in_all_three_formats() {
    for bytes in all_plys() {
        assert_eq!(read("a.ply", &bytes), tetrahedron());
        assert_eq!(read("misnamed.stl", &bytes), tetrahedron());
    }
}

#[test]
fn ply_floats_are_single_and_doubles_are_double() {
    let text = |kind: &str| {
        format!(
            "ply\nformat ascii 1.0\nelement vertex 3\nproperty {kind} x\nproperty {kind} y\nproperty {kind} z\n\
             element face 1\nproperty list uchar int vertex_index\nend_header\n0.1 0 0 1 0 0 0 1 0 3 0 1 2"
        )
    };
    let vertices = [[0.1, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]];
    assert_eq!(
        read("a.ply", text("float")).vertices,
        MeshVertices::Single(vertices.map(|v| v.map(|x: f64| x as f32)).to_vec())
    );
    assert_eq!(read("a.ply", text("double")).vertices, MeshVertices::Double(vertices.to_vec()));
}

#[test]
fn ply_faces_may_come_before_the_vertices() {
    let text = "ply\nformat ascii 1.0\nelement face 2\nproperty list uchar int vertex_index\nelement vertex 4\n\
                property int x\nproperty int y\nproperty int z\nend_header\n4 0 1 2 3\n3 0 1 3\n0 0 0 1 0 0 1 1 0 0 1 0\n";
    assert_eq!(read("a.ply", text).triangles, [[0, 1, 2], [0, 2, 3], [0, 1, 3]]);
}

#[test]
fn broken_ply_is_refused_at_its_place() {
    let text = ascii_ply();
    check_error(
        "a.ply",
        text.replace("7 3 0 1 2", "7 3 0 1 4"),
        "line 19: there is no vertex 4; vertices are numbered from 0, and the file has 4",
    );
    check_error(
        "a.ply",
        text.replace("7 3 0 1 2", "7 3 0 1 -1"),
        "line 19: expected a whole number of 0 or more",
    );
    check_error(
        "a.ply",
        text.replace("7 3 0 1 2", "7 2 0 1"),
        "line 19: a face must have 3 or more corners, but this one has 2",
    );
    check_error(
        "a.ply",
        text.replace("float y", "float q"),
        "it has no x, y and z for its vertices",
    );
    check_error(
        "a.ply",
        text.replace("float y", "quad y"),
        "line 7: this line is not one of a PLY header",
    );
    check_error("a.ply", text.replace("element vertex", "element point"), "it has no vertices");
    check_error(
        "a.ply",
        text.replace("end_header", "end"),
        "line 14: this line is not one of a PLY header",
    );
    check_error("a.ply", "ply\nformat ascii 1.0", "it has no `end_header`");
    check_error("a.ply", &text[..text.len() - 1], "line 22: the file ends early");
    for bytes in &all_plys()[1..] {
        check_error("a.ply", &bytes[..bytes.len() - 1], "face 3: the file ends early");
        assert!(read_mesh("a.ply", &bytes[..200]).is_err());
    }
}

#[test]
fn a_comment_mark_in_a_number_is_refused_where_the_format_has_no_comments() {
    let message = "expected a finite number";
    let body = |from: &str, to: &str| ascii_ply().replacen(from, to, 1);
    check_error("a.ply", body("0 1 9 0", "0 1.0# 9 0"), &format!("line 16: {message}"));
    check_error("a.ply", body("0 1 9 0", "0 1 9# 0"), &format!("line 16: {message}"));
    check_error("a.ply", body("7 3 0 1 2", "7 3# 0 1 2"), &format!("line 19: {message}"));
    check_error("a.ply", ascii_ply() + "#", &format!("line 22: {message}"));
    check_error(
        "a.stl",
        ascii_stl(&facets()).replacen("5e-1", "5e-1#", 1),
        "line 13: expected a finite number",
    );
    // The manual of OBJ says that comments may stand anywhere.
    let obj = "v 0 0 0# glued\nv 1 0 0 # apart\nv 0 1 0\n#f 1 2 9\nf 1 2 3#4";
    assert_eq!(read("a.obj", obj).triangles, [[0, 1, 2]]);
}

#[test]
fn counts_take_no_memory_before_they_are_checked() {
    let header = "ply\nformat binary_little_endian 1.0\nelement vertex 4000000000\nproperty double x\nproperty double y\nproperty double z\nend_header\n";
    check_error(
        "a.ply",
        header,
        "it ends early: its header announces 96000000126 bytes, but it has 127",
    );
    let mut stl = binary_stl("", &facets());
    stl[80..84].copy_from_slice(&u32::MAX.to_le_bytes());
    check_error(
        "a.stl",
        stl,
        "it ends early: its header announces 214748364834 bytes, but it has 284",
    );
}

#[test]
fn a_face_of_too_many_corners_is_refused() {
    let (mut zigzag, mut face) = (String::new(), String::new());
    for k in 0..2000 {
        writeln!(zigzag, "v {k} {} 0", k % 2).unwrap();
        write!(face, " {}", k + 1).unwrap();
    }
    check_error(
        "a.obj",
        format!("{zigzag}v 3000 -3000 0\nf{face} 2001"),
        "line 2002: a face that is not convex may have at most 1024 corners",
    );
    assert_eq!(MeshFault::Empty.to_string(), "it has no triangles");
}
