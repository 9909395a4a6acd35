//! Sequences of pictures.

use super::*;

/// Three scenes that differ in their colours.
fn place_with_shots() -> Place {
    let place = Place::new();
    for (frame, color) in [(1, "color 10 20 230"), (2, "color 20 230 10"), (3, "color 90 90 90")] {
        let text = scene_text().replace("color 230 60 40", color);
        fs::write(place.path(&format!("shot.{frame:03}.rt")), text).unwrap();
    }
    place
}

#[test]
fn frames_are_those_of_single_renders_and_the_next_fills_the_tail_of_the_last() {
    let place = place_with_shots();
    let picture = ["--size", "128x96", "--tile", "16", "--samples", "64"];
    for workers in ["0", "2"] {
        let frames = ["render", "shot.%03d.rt", "-o", "out.%d.png", "--frames", "1-3"];
        let args = [&frames[..], &picture, &["--workers", workers, "--threads", "1"]].concat();
        let debug = ["env".to_owned(), "RUST_LOG=rtfarm_coordinator=debug,info".to_owned()];
        let mut render = place.start_by(&debug, "frames.log", &args);
        let told = [1, 2, 3].map(|_| render.read_line());
        assert!(render.wait().success(), "{}", render.log());
        for (line, output) in told.iter().zip(["out.1.png", "out.2.png", "out.3.png"]) {
            assert!(line.contains("128x96 in ") && line.contains(output), "{line}");
        }
        let log = render.log();
        let lines: Vec<&str> = log.lines().collect();
        let end = lines.iter().position(|line| line.contains(" tile 48/48 done ")).unwrap();
        if workers != "0" {
            let jobs: Vec<&str> =
                lines.iter().filter_map(|line| Some(line.split_once("JobId(")?.1)).collect();
            let leased = |line: &&str| line.contains(" leased ") && !line.contains(jobs[0]);
            let first = lines.iter().position(leased).unwrap();
            assert!(first < end, "a tile of the second frame is leased before the first one's end");
        }
    }
    for frame in 1..=3 {
        let (scene, output) = (format!("shot.{frame:03}.rt"), format!("out.{frame}.png"));
        let args = ["render", &scene, "-o", "single.png", "--workers", "0"];
        let mut single = place.start("single.log", &[&args[..], &picture].concat());
        assert!(single.wait().success(), "{}", single.log());
        assert_eq!(
            fs::read(place.path(&output)).unwrap(),
            fs::read(place.path("single.png")).unwrap()
        );
    }
    place.check_nothing_is_left();
}

#[test]
fn frames_that_are_there_are_passed_over_and_others_are_rendered() {
    use std::os::unix::fs::MetadataExt;
    let place = place_with_shots();
    let files = || -> Vec<u64> {
        let names = (1..=3).map(|frame| place.path(&format!("out.{frame}.png")));
        names.map(|path| fs::metadata(path).unwrap().ino()).collect()
    };
    let frames = ["render", "shot.%03d.rt", "-o", "out.%d.png", "--frames", "1-3", "--resume"];
    let render = |more: &[&str]| {
        let common = ["--size", "64x48", "--samples", "2", "--workers", "0"];
        let mut render = place.start("log", &[&frames[..], &common, more].concat());
        assert!(render.wait().success(), "{}", render.log());
        render.log().matches("is there already").count()
    };
    assert_eq!(render(&[]), 0);
    let first = files();
    assert_eq!((render(&[]), files()), (3, first.clone()));
    // Another scene, a picture that is not whole, a file beside it that is wanted, other settings.
    fs::write(place.path("shot.002.rt"), scene_text()).unwrap();
    let whole = fs::read(place.path("out.3.png")).unwrap();
    fs::write(place.path("out.3.png"), &whole[..40]).unwrap();
    assert_eq!(render(&[]), 1);
    let second = files();
    assert_eq!(second[0], first[0]);
    assert!(second[1] != first[1] && fs::read(place.path("out.3.png")).unwrap() == whole);
    assert_eq!(
        (render(&["--sidecar"]), render(&["--sidecar"]), render(&["--seed", "1"])),
        (0, 3, 0)
    );
    place.check_nothing_is_left();
}

#[test]
fn frames_that_cannot_all_be_rendered_are_told_before_any_is() {
    let place = place_with_shots();
    for (scene, output, frames, code, reason) in [
        ("shot.%03d.rt", "out.%d.png", "1-5", 2, "are not there: shot.004.rt, shot.005.rt"),
        ("shot.%03d.rt", "out.png", "1-3", 2, "the output has one place for the number"),
        (
            "shot.rt",
            "out.%d.png",
            "1-3",
            2,
            "SCENE has one place for the number, like shot.%04d.rt",
        ),
        ("-", "out.%d.png", "1-3", 2, "needs files"),
        ("shot.%03d.rt", "out.%d.png", "3-1", 2, "3-1 has no frames; 1-3 has"),
        ("shot.%03d.rt", "out.%d.png", "all", 2, "frames look like 1-48"),
        ("shot.%03d.rt", "nowhere/%d.png", "1-3", 1, "cannot write into the folder nowhere"),
    ] {
        check_refused(&place, &["render", scene, "-o", output, "--frames", frames], code, reason);
    }
}

#[test]
fn a_frame_that_cannot_be_begun_ends_a_sequence_and_those_before_it_are_there() {
    let place = place_with_shots();
    fs::write(place.path("shot.002.rt"), "no scene").unwrap();
    for workers in ["0", "2"] {
        let frames = ["render", "shot.%03d.rt", "-o", "out.%d.png", "--frames", "1-3"];
        let picture = ["--size", "64x48", "--samples", "2", "--workers", workers];
        let mut render = place.start("frames.log", &[&frames[..], &picture].concat());
        assert_eq!(render.wait().code(), Some(2), "{}", render.log());
        assert!(render.log().contains("shot.002.rt"), "{}", render.log());
        assert!(place.path("out.1.png").exists() && !place.path("out.3.png").exists());
        fs::remove_file(place.path("out.1.png")).unwrap();
    }
    place.check_nothing_is_left();
}
