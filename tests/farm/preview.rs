//! A picture in the terminal while it is rendered.

use std::{
    io::{Read, Write},
    os::unix::ffi::OsStrExt,
    thread::JoinHandle,
};

use base64::{Engine, prelude::BASE64_STANDARD};
use icy_sixel::SixelImage;
use image::RgbImage;
use rustix::{
    pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt},
    termios::{Action, Winsize, tcflow, tcgetattr, tcsetwinsize},
};

use super::*;

/// Characters of 8 x 16 pixels.
const ROOM: Winsize = Winsize { ws_col: 100, ws_row: 50, ws_xpixel: 800, ws_ypixel: 800 };

/// What a terminal answers when it is asked what it can do.
const QUESTION: &[u8] = b"\x1b[c";

/// Both ends of a terminal.
fn open() -> (File, File) {
    let outside = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY).unwrap();
    grantpt(&outside).unwrap();
    unlockpt(&outside).unwrap();
    tcsetwinsize(&outside, ROOM).unwrap();
    let name = ptsname(&outside, Vec::new()).unwrap();
    let path = Path::new(std::ffi::OsStr::from_bytes(name.as_bytes())).to_owned();
    let inside = File::options().read(true).write(true).open(path).unwrap();
    (outside.into(), inside)
}

/// How a terminal is set.
fn settings(inside: &File) -> String {
    format!("{:?}", tcgetattr(inside).unwrap())
}

/// Renders a scene with a preview in this terminal.
fn render(place: &Place, scene: &str, inside: &File) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_rtfarm"));
    command
        .args(["render", scene, "-o", "out.png", "--size", "640x480", "--samples", "4"])
        .args(["--preview"])
        .current_dir(place.folder.path())
        .env("TMPDIR", place.path("tmp"))
        .env("TERM", "xterm-256color")
        .env("NO_COLOR", "1")
        .env_remove("RUST_LOG")
        .env_remove("TMUX")
        .env_remove("TERM_PROGRAM")
        .env_remove("LC_TERMINAL")
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(inside.try_clone().unwrap());
    command
}

/// A terminal: what is written to it is kept.
struct Terminal {
    /// The end that a program has.
    inside: File,
    reading: JoinHandle<Vec<u8>>,
}

impl Terminal {
    /// Answers so when it is asked.
    fn new(answer: &'static str) -> Self {
        let (outside, inside) = open();
        let reading = thread::spawn(move || {
            let (mut outside, mut said, mut is_asked) = (outside, Vec::new(), false);
            let mut bytes = [0; 4096];
            // Once nobody has the inside any more this fails.
            while let Ok(count @ 1..) = outside.read(&mut bytes) {
                said.extend_from_slice(&bytes[..count]);
                if !is_asked && said.windows(QUESTION.len()).any(|bytes| bytes == QUESTION) {
                    is_asked = true;
                    outside.write_all(answer.as_bytes()).unwrap();
                }
            }
            said
        });
        Self { inside, reading }
    }

    /// Renders in it with these variables and options; answers with what it was told, and the
    /// picture's file.
    fn render(self, variables: &[(&str, &str)], options: &[&str]) -> (String, RgbImage) {
        let Self { inside, reading } = self;
        let place = Place::new();
        let before = settings(&inside);
        let mut command = render(&place, "scene.rt", &inside);
        let status = command.args(options).envs(variables.iter().copied()).status().unwrap();
        assert!(status.success());
        assert_eq!(settings(&inside), before, "the terminal is as it was");
        drop(command);
        drop(inside);
        let said = String::from_utf8(reading.join().unwrap()).unwrap();
        (said, image::open(place.path("out.png")).unwrap().into_rgb8())
    }
}

/// Each second pixel: so many fit into the upper half of the terminal.
fn coarse(picture: &RgbImage) -> RgbImage {
    RgbImage::from_fn(320, 240, |x, y| *picture.get_pixel(2 * x, 2 * y))
}

/// The last of what stands between two marks.
fn last<'a>(said: &'a str, start: &str, end: &str) -> &'a str {
    let (_, rest) = said.rsplit_once(start).unwrap_or_else(|| panic!("no {start:?}: {said:?}"));
    rest.split_once(end).unwrap().0
}

fn decode(text: &str) -> RgbImage {
    let png = BASE64_STANDARD.decode(text).unwrap();
    image::load_from_memory(&png).unwrap().into_rgb8()
}

/// The last picture that Kitty was told.
fn kitty(said: &str) -> RgbImage {
    let (_, drawn) = said.rsplit_once("\x1b_Ga=T,f=100,").unwrap();
    let drawn = drawn.split("\x1b8").next().unwrap();
    let pieces = drawn.split_terminator("\x1b\\");
    decode(&pieces.map(|piece| piece.split_once(';').unwrap().1).collect::<String>())
}

/// What must be at the end of all that is drawn: the cursor is below the picture.
fn check_cursor(said: &str, rows: u32) {
    let end = format!("\x1b8\x1b[{rows}B\r");
    assert!(said.contains(&end), "{rows} rows: {:?}", &said[said.len().saturating_sub(200)..]);
}

#[test]
fn a_terminal_that_shows_pictures_shows_the_whole_one_at_the_end() {
    const KITTY: &str = "\x1b_Gi=31;OK\x1b\\\x1b[?62;c";
    for (answer, variables, options) in [
        ("", &[("TERM", "xterm-kitty")][..], &["--workers", "0"][..]),
        (KITTY, &[], &["--workers", "2", "--quiet"]),
        (KITTY, &[], &["--workers", "1", "--verbose"]),
    ] {
        let (said, picture) = Terminal::new(answer).render(variables, options);
        assert!(kitty(&said) == coarse(&picture), "{variables:?} {options:?}");
        check_cursor(&said, 25);
    }
    let iterm2 = [("TERM_PROGRAM", "iTerm.app")];
    let (said, picture) = Terminal::new("").render(&iterm2, &["--workers", "2"]);
    let (keys, text) = last(&said, "\x1b]1337;File=", "\x07").split_once(':').unwrap();
    assert!(keys.contains("inline=1;") && decode(text) == coarse(&picture), "{keys}");
    check_cursor(&said, 25);
}

#[test]
fn a_terminal_that_shows_sixels_shows_the_whole_picture_in_its_colours() {
    let (said, picture) = Terminal::new("\x1b[?62;4;22c").render(&[], &["--workers", "2"]);
    let sixels = format!("\x1bP{}\x1b\\", last(&said, "\x1bP", "\x1b\\"));
    let shown = SixelImage::decode(sixels.as_bytes()).unwrap();
    let expected = coarse(&picture);
    assert_eq!((shown.width as u32, shown.height as u32), expected.dimensions());
    // There are 256 colours, and dots of several stand for one that is between them.
    let opaque = shown.pixels.chunks_exact(4).flat_map(|pixel| &pixel[..3]);
    let differences = opaque.zip(expected.as_raw()).map(|(a, b)| u64::from(a.abs_diff(*b)));
    let mean = differences.sum::<u64>() as f64 / expected.len() as f64;
    assert!(mean < 4.0, "{mean}");
    check_cursor(&said, 15);
}

#[test]
fn who_shows_no_pictures_is_told_of_in_one_line_and_gets_the_file() {
    let unknown = "there is no preview: this terminal shows no pictures";
    let silent = "there is no preview: this terminal did not say that it shows pictures";
    for (answer, reason) in [("\x1b[?1;2c", unknown), ("", silent)] {
        let (said, _) = Terminal::new(answer).render(&[], &["--workers", "0"]);
        assert_eq!(said.matches(reason).count(), 1, "{said:?}");
        assert!(!said.contains("\x1b7"), "nothing is drawn: {said:?}");
    }
    let (said, _) = Terminal::new("").render(&[("TERM", "dumb")], &["--quiet"]);
    assert!(said.contains(unknown) && !said.contains("\x1b[c"), "{said:?}");
    let place = Place::new();
    let args = ["render", "scene.rt", "-o", "out.png", "--size", "8x6", "--preview"];
    let mut process = place.start("log", &args);
    assert!(process.wait().success());
    let log = process.log();
    assert!(log.contains("there is no preview: standard error is not a terminal"), "{log}");
    place.check_nothing_is_left();
}

#[test]
fn an_interruption_while_the_terminal_is_asked_leaves_it_as_it_was() {
    for signals in [[Signal::INT, Signal::INT], [Signal::INT, Signal::QUIT], [Signal::QUIT; 2]] {
        let ((_outside, inside), place) = (open(), Place::new());
        let before = settings(&inside);
        let mut child = render(&place, "scene.rt", &inside).spawn().unwrap();
        poll(|| (settings(&inside) != before).then_some(()));
        for signal in signals {
            kill_process(pid(child.id()), signal).unwrap();
            thread::sleep(Duration::from_millis(50));
        }
        let status = child.wait().unwrap();
        assert_eq!(settings(&inside), before, "{signals:?}: the terminal is as it was");
        assert_eq!(status.code(), Some(130), "{signals:?}");
    }
}

#[test]
fn a_terminal_is_asked_once_the_scene_is_found_good() {
    let (place, terminal) = (Place::new(), Terminal::new(""));
    let mut command = render(&place, "missing.rt", &terminal.inside);
    assert_eq!(command.status().unwrap().code(), Some(2));
    drop((command, terminal.inside));
    let said = String::from_utf8(terminal.reading.join().unwrap()).unwrap();
    assert!(said.contains("missing.rt") && !said.contains("\x1b[c"), "{said:?}");
}

#[test]
fn a_terminal_that_is_stopped_or_that_nobody_reads_holds_nothing_up() {
    for (options, is_stopped) in [
        (&["--preview", "--workers", "2"][..], true),
        (&["--preview", "--workers", "0"], false),
        (&["--preview", "--workers", "1", "--verbose"], false),
        (&["--tile", "8", "--workers", "2"], true),
        (&["--tile", "8", "--workers", "0"], false),
        (&["--tile", "8", "--verbose", "--workers", "1"], false),
    ] {
        let (place, (_outside, inside)) = (Place::new(), open());
        if is_stopped {
            tcflow(&inside, Action::OOff).unwrap();
        }
        let mut command = Command::new(env!("CARGO_BIN_EXE_rtfarm"));
        let child = command
            .args(["render", "scene.rt", "-o", "out.png", "--size", "640x480", "--samples", "1"])
            .args(options)
            .current_dir(place.folder.path())
            .env("TMPDIR", place.path("tmp"))
            .env("TERM", "xterm-kitty")
            .env_remove("RUST_LOG")
            .env_remove("TMUX")
            .stdin(Stdio::null())
            .stdout(inside.try_clone().unwrap())
            .stderr(inside.try_clone().unwrap())
            .spawn()
            .unwrap();
        let mut process = Process { child, stdout: None, log: PathBuf::new() };
        assert!(process.wait().success(), "{options:?}");
        assert!(place.path("out.png").exists(), "{options:?}");
        place.check_nothing_is_left();
    }
}

#[test]
fn the_bar_is_gone_where_watch_says_that_its_job_has_ended() {
    let place = Place::new();
    let listen = ["coordinator", "--listen", "127.0.0.1:0", "--insecure"];
    let mut coordinator = place.start("coordinator.log", &listen);
    let line = coordinator.read_line();
    let farm = ["--coordinator", line.trim().strip_prefix("listening on ").unwrap()];
    let order = ["submit", "scene.rt", "-o", "out.png", "--size", "160x120", "--detach"];
    let mut submit = place.start("submit.log", &[&order[..], &farm].concat());
    let job = submit.read_line();
    let Terminal { inside, reading } = Terminal::new("");
    // Nobody else keeps the inside once it has ended.
    let mut watch = Command::new(env!("CARGO_BIN_EXE_rtfarm"));
    watch
        .args(["watch", job.trim()])
        .args(farm)
        .env("TERM", "xterm")
        .env_remove("RUST_LOG")
        .stdin(Stdio::null())
        .stdout(inside.try_clone().unwrap())
        .stderr(inside);
    let mut watching = watch.spawn().unwrap();
    drop(watch);
    let _worker = place.start("worker.log", &[&["worker"], &farm[..]].concat());
    assert!(watching.wait().unwrap().success());
    let said = String::from_utf8(reading.join().unwrap()).unwrap();
    let (before, after) = said.split_once(&format!("job {} finished", job.trim())).expect(&said);
    let line = before.rsplit('\n').next().unwrap();
    assert!(line.is_empty() || line.ends_with("\r\x1b[K"), "{said:?}");
    assert!(after.ends_with(" s\r\n"), "nothing follows: {said:?}");
}
