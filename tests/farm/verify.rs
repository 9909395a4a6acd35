//! What a picture's file says of it, and whether it is true.

use super::*;

/// Runs `verify`; answers with its exit code and what it said.
fn verify(place: &Place, words: &[&str]) -> (Option<i32>, String) {
    let mut process = place.start("verify.log", &[&["verify"], words].concat());
    let code = process.wait().code();
    let mut said = String::new();
    std::io::Read::read_to_string(process.stdout.as_mut().unwrap(), &mut said).unwrap();
    (code, said + &process.log())
}

#[test]
fn a_picture_is_verified_with_another_instruction_set_and_what_was_changed_is_found() {
    let place = Place::new();
    for (output, settings) in [
        ("a.png", &["--samples", "3", "--transfer", "srgb"][..]),
        ("b.png", &["--depth", "16", "--error", "0.05", "--max-samples", "32"]),
        ("c.exr", &["--samples", "2", "--crop", "11,7,53,41", "--seed", "5", "--flat"]),
    ] {
        let size = ["--size", "96x64", "--tile", "16", "--workers", "0"];
        place.render(output, &[&size[..], settings].concat());
        let (code, said) =
            verify(&place, &[output, "scene.rt", "--tiles", "all", "--isa", "scalar"]);
        assert_eq!(code, Some(0), "{output}: {said}");
        let (code, said) = verify(&place, &[output, "scene.rt", "--tiles", "2", "--json"]);
        assert!(code == Some(0) && said.contains("\"checked\": 2"), "{output}: {said}");
    }

    // One step of one pixel.
    let whole = fs::read(place.path("a.png")).unwrap();
    let mut reader = png::Decoder::new(std::io::Cursor::new(&whole)).read_info().unwrap();
    let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
    reader.next_frame(&mut pixels).unwrap();
    let info = reader.info().clone();
    pixels[3 * (96 * 40 + 50)] ^= 1;
    let write = |name: &str, notes: bool| {
        let mut encoder =
            png::Encoder::new(File::create(place.path(name)).unwrap(), info.width, info.height);
        encoder.set_color(info.color_type);
        for text in info.uncompressed_latin1_text.iter().filter(|_| notes) {
            encoder.add_text_chunk(text.keyword.clone(), text.text.clone()).unwrap();
        }
        encoder.write_header().unwrap().write_image_data(&pixels).unwrap();
    };
    write("changed.png", true);
    write("silent.png", false);
    let (code, said) = verify(&place, &["changed.png", "scene.rt", "--tiles", "all"]);
    assert!(
        code == Some(1) && said.contains("24 of 24 tiles were rendered again: 23 are the same"),
        "{said}"
    );
    assert!(said.contains("but not [15]"), "{said}");
    let (code, said) = verify(&place, &["silent.png", "scene.rt"]);
    assert!(code == Some(2) && said.contains("does not say what it shows"), "{said}");
    let (code, said) = verify(&place, &["scene.rt", "scene.rt"]);
    assert!(code == Some(2) && said.contains("cannot read the picture scene.rt"), "{said}");

    fs::write(place.path("other.rt"), scene_text().replace("230 60 40", "230 60 41")).unwrap();
    let (code, said) = verify(&place, &["a.png", "other.rt"]);
    assert!(code == Some(1) && said.contains("the scene differs"), "{said}");
}
