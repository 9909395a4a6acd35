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

    // Settings that are given are those of the picture, or what differs is said.
    for (words, difference) in [
        (&["--size", "96x64", "--samples", "3", "--transfer", "srgb", "--tile", "16"][..], ""),
        (&["--seed", "0", "--secondary", "on", "--depth", "8"], ""),
        (&["--size", "96x65"], "--size makes frame 96x65, the picture says frame 96x64"),
        (&["--samples", "4"], "--samples makes samples 4, the picture says samples 3"),
        (&["--error", "0.5"], "--error makes error 0.5, the picture does not say it"),
        (&["--depth", "16"], "--depth makes format png16, the picture says format png8"),
        (&["--secondary", "off"], "--secondary makes secondary false, the picture says"),
        (&["--crop", "0,0,9,9"], "--crop makes window 0,0,9,9, the picture says window 0,0,96,64"),
        (&["--flat"], "--flat makes flat true, the picture says flat false"),
    ] {
        let (code, said) = verify(&place, &[&["a.png", "scene.rt"], words].concat());
        let expected = if difference.is_empty() { "are the same to the bit" } else { difference };
        assert!(said.contains(expected), "{words:?}: {said}");
        assert_eq!(code, Some(i32::from(!difference.is_empty())), "{words:?}: {said}");
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

/// What stands beside a picture says the same as its file, and on how many workers of this host it
/// was rendered.
pub(super) fn check_sidecar(place: &Place, picture: &str, workers: u64) {
    let text = fs::read_to_string(place.path(&format!("{picture}.json"))).unwrap();
    let told: serde_json::Value = serde_json::from_str(&text).unwrap();
    assert_eq!((&told["picture"], &told["workers"]), (&picture.into(), &workers.into()), "{text}");
    let host = rustix::system::uname().nodename().to_string_lossy().into_owned();
    assert_eq!(told["hosts"], serde_json::json!([host]), "{text}");
    assert!(told["time"].as_u64().unwrap() > 1_700_000_000, "{text}");
    assert!(told["seconds"].as_f64().unwrap() > 0.0, "{text}");
    let reader = rtfarm_picture::PictureReader::open(&place.path(picture)).unwrap();
    let said = told["provenance"].as_object().unwrap();
    let lines = said.iter().map(|(word, value)| format!("{word} {}", value.as_str().unwrap()));
    let expected: BTreeSet<_> = reader.notes().provenance.lines().map(str::to_owned).collect();
    assert_eq!(lines.collect::<BTreeSet<_>>(), expected);
    assert_eq!(said["rays"], told["rays"].to_string());
    assert_eq!(said["sampled"], told["samples"].to_string());
}

#[test]
fn what_a_picture_must_not_say_of_itself_stands_beside_it_on_request() {
    let place = Place::new();
    let picture = ["--size", "64x48", "--samples", "2"];
    let plain = place.render("out.png", &[&picture[..], &["--workers", "0"]].concat());
    assert!(!place.path("out.png.json").exists());
    for workers in [0, 2] {
        let args = ["--sidecar", "--workers", &workers.to_string()];
        let found = place.render("out.png", &[&picture[..], &args].concat());
        assert!(found == plain, "the picture's file is the same");
        check_sidecar(&place, "out.png", workers);
        fs::remove_file(place.path("out.png.json")).unwrap();
    }
    for frame in ["1", "2"] {
        fs::write(place.path(&format!("shot.{frame}.rt")), scene_text()).unwrap();
    }
    let frames = ["render", "shot.%d.rt", "-o", "out.%d.exr", "--frames", "1-2", "--sidecar"];
    let mut render = place.start("log", &[&frames[..], &picture].concat());
    assert!(render.wait().success(), "{}", render.log());
    check_sidecar(&place, "out.1.exr", 2);
    check_sidecar(&place, "out.2.exr", 2);

    let mut coordinator =
        place.start("coordinator.log", &["coordinator", "--insecure", "--listen", "127.0.0.1:0"]);
    let line = coordinator.read_line();
    let url = line.trim().strip_prefix("listening on ").expect(&line);
    let _worker = place.start("worker.log", &["worker", "--threads", "1", "--coordinator", url]);
    let submit = ["submit", "scene.rt", "-o", "out.png", "--sidecar", "--coordinator", url];
    let mut submit = place.start("submit.log", &[&submit[..], &picture].concat());
    assert!(submit.wait().success(), "{}", submit.log());
    check_sidecar(&place, "out.png", 1);
    coordinator.signal(Signal::TERM);
    assert_eq!(coordinator.wait().code(), Some(0));
    place.check_nothing_is_left();
}
