//! Texts that nobody means well by: every one is answered soon, and with little memory.

use rtfarm_core::language::{Reading, Style, draw_diagnostics, read_scene};

fn read(text: &[u8]) -> Reading {
    let reading = read_scene(text, &|_| Err(std::io::ErrorKind::NotFound.into()));
    let drawing = draw_diagnostics("hostile.rt", text, &reading.diagnostics, Style::Plain);
    assert!(drawing.len() < 1_000_000, "{}", drawing.len());
    assert!(reading.diagnostics.len() <= 200);
    reading
}

fn check_refused(text: &[u8], place: &str, message: &str) {
    let reading = read(text);
    assert!(reading.scene.is_none());
    let first = &reading.diagnostics[0];
    assert_eq!((first.at.to_string().as_str(), first.message.as_str()), (place, message));
}

const LONG: usize = 5_000_000;

#[test]
fn garbage_is_refused() {
    let mut state = 7_u64;
    let noise: Vec<u8> = std::iter::repeat_with(|| {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
        (state >> 40) as u8
    })
    .take(LONG)
    .collect();
    assert!(read(&noise).scene.is_none());
    assert!(read(&vec![0; LONG]).scene.is_none());
    assert!(read(&vec![0xff; LONG]).scene.is_none());
    assert!(read(&vec![b'\n'; LONG]).scene.is_some(), "an empty scene of many lines");
    for unit in [
        "a ",
        "a\n",
        "end ",
        "endsphere\n",
        "1 ",
        "\"\n",
        "…\n",
        "\u{fffd}",
        "geometry ",
        "#",
        "sphere ",
        "viewport\n",
    ] {
        read(unit.repeat(LONG / unit.len()).as_bytes());
    }
}

#[test]
fn unknown_words_do_not_each_search_the_whole_file() {
    let words = (0..200_000).map(|k| format!("w{k}\n")).collect::<Vec<_>>().concat();
    assert!(read(words.as_bytes()).scene.is_none());
    assert!(
        read(format!("geometry\n{words}endgeometry").as_bytes()).scene.is_some(),
        "all are skipped"
    );
    let blocks = (0..200_000).map(|k| format!("w{k} endw{k}\n")).collect::<Vec<_>>().concat();
    let reading = read(format!("geometry\n{blocks}endgeometry").as_bytes());
    assert_eq!(reading.omitted.warnings, 199_900);
}

#[test]
fn long_lines_are_not_searched_for_every_word() {
    for unit in [
        "fog 1 sphere coords 0 0 0 radius 1 material a endsphere ",
        "triangle vertex \"x\" 0 endtriangle ",
        "mesh file my bottle.stl endmesh ",
        "\"a\" ",
        "sphere endspere ",
    ] {
        let text = format!("geometry {} endgeometry", unit.repeat(LONG / unit.len()));
        assert!(read(text.as_bytes()).scene.is_none() || unit == "\"a\" ");
    }
}

#[test]
fn depth_takes_no_stack() {
    for unit in ["geometry union ", "union ", "sphere ", "materials entry "] {
        let text = format!("geometry {}", unit.repeat(LONG / 10));
        assert!(read(text.as_bytes()).scene.is_none());
    }
    let text = format!(
        "geometry {} {}",
        "union ".repeat(LONG / 20),
        "endsphere enddifference endunion ".repeat(LONG / 20)
    );
    assert!(read(text.as_bytes()).scene.is_none());
}

#[test]
fn texts_in_other_encodings_are_named() {
    check_refused(b"\xff\xfeg\0e\0", "1:1", "this file is in UTF-16; save it as UTF-8");
    check_refused(b"\x1f\x8b\x08", "1:1", "this file is compressed with gzip; unpack it first");
    check_refused(
        b"geometry\n# \xd8\xe0\xf0\nendgeometry",
        "2:3",
        "the byte 0xd8 is not valid UTF-8; save the file as UTF-8",
    );
}

#[test]
fn binary_files_are_named_and_not_read() {
    let mut binary = b"solid\n".to_vec();
    binary.resize(LONG, 0);
    check_refused(&binary, "2:1", "this file is not a text: it contains a NUL byte");
    assert_eq!(read(&binary).diagnostics.len(), 1);
}

#[test]
fn a_text_that_is_cut_off_lacks_its_ends_and_nothing_else() {
    let reading = read(b"geometry\nunion\nsphere coords 0 0 0");
    let told: Vec<_> = reading.diagnostics.iter().map(|d| d.message.as_str()).collect();
    assert_eq!(
        told,
        [
            "this `geometry` is never closed: `endgeometry` is missing",
            "this `union` is never closed: `endunion` is missing",
            "this `sphere` is never closed: `endsphere` is missing",
        ]
    );
}

#[test]
fn unclosed_quotes_end_with_their_line() {
    check_refused(
        b"materials entry name a texture \"x.png\nendentry endmaterials",
        "1:32",
        "this name has no closing quote on its line",
    );
}

#[test]
fn absurd_numbers_are_refused() {
    let sphere = |radius: &str| {
        format!("geometry sphere coords 0 0 0\nradius {radius} endsphere endgeometry").into_bytes()
    };
    let digits = "9".repeat(LONG);
    check_refused(&sphere(&digits), "1:10", "this `sphere` has no `material`");
    for (radius, message) in [
        ("1e400", "`1e400` is too large; the largest number is about 1.8e308"),
        ("-1e400", "`-1e400` is too large; the largest number is about 1.8e308"),
        ("nan", "expected a finite number, found `nan`"),
        ("-Infinity", "expected a finite number, found `-Infinity`"),
        ("1e-400", "`radius` must be above 0, but is 0"),
        (
            "1e99999999999999999999",
            "`1e99999999999999999999` is too large; the largest number is about 1.8e308",
        ),
    ] {
        let reading = read(&sphere(radius));
        assert_eq!(reading.diagnostics[1].message, message);
    }
}

#[test]
fn light_beyond_all_numbers_is_refused() {
    check_refused(
        b"lights reference power 1e-200 distance 1 endreference\npoint coords 0 0 0 power 1e200 endpoint endlights",
        "2:1",
        "this light is too bright: its power divided by the reference's, times the square of the \
         reference's distance, exceeds 1.8e308",
    );
}
