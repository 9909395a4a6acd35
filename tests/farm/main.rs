//! The whole farm as processes: the same bytes whoever renders them and whatever befalls them,
//! logs that count, nothing left behind.

mod faults;
mod frames;
mod liar;
mod page;
mod preview;
mod queue;
mod security;
mod slurm;
mod verify;

use std::{
    collections::BTreeSet,
    fs::{self, File},
    io::{self, BufRead, BufReader},
    net::{TcpListener, TcpStream},
    path::{Path, PathBuf},
    process::{Child, ChildStdout, Command, ExitStatus, Stdio},
    sync::atomic::{AtomicU32, Ordering},
    thread,
    time::Duration,
};

use rustix::process::{Pid, Signal, kill_process, test_kill_process};
use tempfile::TempDir;

/// A picture that takes one thread some seconds, cut into this many tiles.
const SLOW: [&str; 6] = ["--size", "160x120", "--samples", "1024", "--tile", "8"];
const SLOW_TILE_COUNT: usize = 20 * 15;

/// The same picture with so many samples that nothing here waits for its end.
const ENDLESS: [&str; 6] = ["--size", "160x120", "--samples", "16384", "--tile", "8"];

/// How long anything here may take, on a machine that has much else to do.
const PATIENCE: Duration = Duration::from_secs(240);

/// A few spheres, a triangle and a quadrangle in the light of two lamps.
fn scene_text() -> String {
    let head = "\
viewport
    origin 0 1 -6
    topleft -1.6 2.2 -3
    bottomleft -1.6 -0.2 -3
    topright 1.6 2.2 -3
    background 20 30 40
endviewport
materials
    entry
        name red
        color 230 60 40
    endentry
    entry
        name grey
        color 180 180 170
    endentry
endmaterials
lights
    ambient 0.2
    reference
        power 1
        distance 4
    endreference
    point
        coords 3 5 -4
        power 1
    endpoint
    point
        coords -4 3 -2
        power 0.5
    endpoint
endlights
geometry
    triangle
        vertex -2 0 2
        vertex 2 0 2
        vertex 0 3 2
        material red
    endtriangle
    quadrangle
        vertex -6 -1 -6
        vertex 6 -1 -6
        vertex 6 -1 6
        vertex -6 -1 6
        material grey
    endquadrangle
";
    let sphere = |number: u32| {
        let (x, y) = (f64::from(number % 4) - 1.5, f64::from(number / 4) * 0.9 - 0.4);
        let material = if number.is_multiple_of(2) { "red" } else { "grey" };
        format!("sphere\n coords {x} {y} 0.5\n radius 0.4\n material {material}\nendsphere\n")
    };
    let spheres: Vec<String> = (0..12).map(sphere).collect();
    [head, &spheres.concat(), "endgeometry\n"].concat()
}

/// A folder with a scene in it and a folder for temporary files, where nothing may stay.
struct Place {
    folder: TempDir,
}

impl Place {
    fn new() -> Self {
        let place = Self { folder: tempfile::tempdir().unwrap() };
        fs::create_dir(place.path("tmp")).unwrap();
        fs::write(place.path("scene.rt"), scene_text()).unwrap();
        place
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// Starts the program; what it says to standard error goes to the file `log`.
    fn start(&self, log: &str, args: &[&str]) -> Process {
        self.start_by(&[], log, args)
    }

    /// Starts it by a command that becomes it.
    fn start_by(&self, starter: &[String], log: &str, args: &[&str]) -> Process {
        let mut words = starter.iter().map(String::as_str).chain([env!("CARGO_BIN_EXE_rtfarm")]);
        let mut child = Command::new(words.next().expect("the program's own name"))
            .args(words)
            .args(args)
            .current_dir(self.folder.path())
            .env("TMPDIR", self.path("tmp"))
            .env_remove("RUST_LOG")
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(File::create(self.path(log)).unwrap())
            .spawn()
            .unwrap();
        let stdout = child.stdout.take().map(BufReader::new);
        Process { child, stdout, log: self.path(log) }
    }

    /// Runs `render` to its good end; answers with the picture's bytes.
    fn render(&self, output: &str, args: &[&str]) -> Vec<u8> {
        let mut process =
            self.start("log", &[&["render", "scene.rt", "-o", output], args].concat());
        assert!(process.wait().success(), "{args:?}: {}", process.log());
        fs::read(self.path(output)).unwrap()
    }

    /// Everything in the folder, to be compared before and after.
    fn files(&self) -> BTreeSet<PathBuf> {
        let list = |folder: &Path| -> Vec<PathBuf> {
            fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect()
        };
        let mut files: BTreeSet<PathBuf> = list(self.folder.path()).into_iter().collect();
        files.extend(list(&self.path("tmp")));
        files
    }

    fn check_nothing_is_left(&self) {
        assert_eq!(fs::read_dir(self.path("tmp")).unwrap().count(), 0, "{:?}", self.files());
        let hidden = |path: &PathBuf| path.file_name().unwrap().as_encoded_bytes()[0] == b'.';
        assert!(!self.files().iter().any(hidden), "{:?}", self.files());
    }
}

/// The program, running. It is killed if a test fails.
struct Process {
    child: Child,
    stdout: Option<BufReader<ChildStdout>>,
    log: PathBuf,
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

impl Process {
    fn log(&self) -> String {
        fs::read_to_string(&self.log).unwrap()
    }

    fn wait(&mut self) -> ExitStatus {
        poll(|| self.child.try_wait().unwrap())
    }

    fn signal(&self, signal: Signal) {
        kill_process(pid(self.child.id()), signal).unwrap();
    }

    fn read_line(&mut self) -> String {
        let mut line = String::new();
        self.stdout.as_mut().unwrap().read_line(&mut line).unwrap();
        line
    }

    /// The workers that have joined so far: number and process.
    fn workers(&self) -> Vec<(u32, u32)> {
        let log = self.log();
        let joined = log.lines().filter(|line| line.contains("worker joined"));
        joined.map(|line| (field(line, "worker"), field(line, "process"))).collect()
    }

    fn tiles_done(&self) -> usize {
        finished_tiles(&self.log()).len()
    }
}

/// An address that a coordinator may come back to: the system gives its port to nobody who asks for
/// any.
fn own_address() -> String {
    static NEXT: AtomicU32 = AtomicU32::new(0);
    let range = fs::read_to_string("/proc/sys/net/ipv4/ip_local_port_range").unwrap();
    let end: u32 = range.split_whitespace().next().unwrap().parse().unwrap();
    poll(|| {
        let number = std::process::id() * 64 + NEXT.fetch_add(1, Ordering::Relaxed);
        let address = format!("127.0.0.1:{}", 1024 + number % (end - 1024));
        TcpListener::bind(&address).is_ok().then_some(address)
    })
}

/// Asks until there is an answer.
fn poll<T>(mut ask: impl FnMut() -> Option<T>) -> T {
    const PERIOD: Duration = Duration::from_millis(5);
    for _ in 0..PATIENCE.as_millis() / PERIOD.as_millis() {
        if let Some(answer) = ask() {
            return answer;
        }
        thread::sleep(PERIOD);
    }
    panic!("nothing happened for {PATIENCE:?}");
}

fn pid(process: u32) -> Pid {
    Pid::from_raw(i32::try_from(process).unwrap()).unwrap()
}

/// Stops a process, and waits until all its threads stand still: the signal is taken by one of
/// them, and the others may go on until that one gets a processor.
fn hold(process: u32) {
    kill_process(pid(process), Signal::STOP).unwrap();
    poll(|| {
        let mut threads = fs::read_dir(format!("/proc/{process}/task")).unwrap();
        let stands = |thread: io::Result<fs::DirEntry>| {
            // A thread that is gone meanwhile does nothing, either.
            let status = fs::read_to_string(thread.unwrap().path().join("stat"));
            status
                .unwrap_or_default()
                .rsplit_once(") ")
                .is_none_or(|(_, rest)| rest.starts_with('T'))
        };
        threads.all(stands).then_some(())
    });
}

/// Waits until a process is gone or waits only to be reaped.
fn wait_for_end_of(process: u32) {
    poll(|| {
        let is_gone = test_kill_process(pid(process)).is_err();
        let status = fs::read_to_string(format!("/proc/{process}/stat")).unwrap_or_default();
        (is_gone || status.is_empty() || status.contains(") Z ")).then_some(())
    });
}

/// The number in a field of a log line.
fn field(line: &str, name: &str) -> u32 {
    let (_, value) = line.split_once(&format!(" {name}=")).unwrap_or_else(|| panic!("{line}"));
    let digits: String = value.chars().take_while(char::is_ascii_digit).collect();
    digits.parse().unwrap_or_else(|_| panic!("{name} in {line}"))
}

/// The numbers of the tiles that a log calls finished.
fn finished_tiles(log: &str) -> Vec<u32> {
    let done = log.lines().filter(|line| line.contains(" tile ") && line.contains(" done "));
    done.map(|line| field(line, "tile")).collect()
}

fn check_each_tile_once(log: &str, tile_count: usize) {
    let tiles = finished_tiles(log);
    assert_eq!(tiles.len(), tile_count);
    assert_eq!(tiles.iter().collect::<BTreeSet<_>>().len(), tile_count);
}

#[test]
fn pictures_do_not_depend_on_workers_threads_and_tiles() {
    let place = Place::new();
    let pixels = |file: &[u8]| image::load_from_memory(file).unwrap().into_rgb32f();
    for size in ["96x64", "101x67", "31x131"] {
        for (output, quality) in
            [("out.png", "--samples=3"), ("out.exr", "--error=0.02 --max-samples=32")]
        {
            let quality: Vec<&str> = quality.split(' ').collect();
            let common = [&["--size", size], &quality[..]].concat();
            let expected = place
                .render(output, &[&common[..], &["--workers", "0", "--threads", "2"]].concat());
            let expected_pixels = pixels(&expected);
            for (workers, threads) in [("1", ["1", "3"]), ("2", ["1", "2"]), ("5", ["1", "2"])] {
                for (tile, threads) in [("8", threads[0]), ("17", threads[1]), ("64", threads[0])] {
                    let farm = ["--workers", workers, "--threads", threads, "--tile", tile];
                    let found = place.render(output, &[&common[..], &farm].concat());
                    // The file says how many rays its tiles took, which depends on them.
                    assert!(pixels(&found) == expected_pixels, "{size} {output} {farm:?}");
                }
                let farm = ["--workers", workers, "--threads", threads[0]];
                let found = place.render(output, &[&common[..], &farm].concat());
                assert!(found == expected, "{size} {output} {farm:?}");
            }
        }
    }
    place.check_nothing_is_left();
}

#[test]
fn a_crop_window_shows_those_pixels_of_the_whole_picture() {
    let place = Place::new();
    let decode = |bytes: &[u8]| image::load_from_memory(bytes).unwrap().into_rgb16();
    let common = ["--size", "101x67", "--depth", "16", "--error", "0.02", "--workers"];
    let whole = decode(&place.render("out.png", &[&common[..], &["2"]].concat()));
    for (crop, [x, y, width, height]) in
        [("17,5,40,33", [17, 5, 40, 33]), ("100,66,1,1", [100, 66, 1, 1])]
    {
        let expected = image::imageops::crop_imm(&whole, x, y, width, height).to_image();
        for workers in ["0", "2"] {
            let args = [&common[..], &[workers, "--tile", "16", "--crop", crop]].concat();
            let found = decode(&place.render("out.png", &args));
            assert!(found == expected, "{crop} with {workers} workers");
        }
    }
    place.check_nothing_is_left();
}

#[test]
fn a_picture_in_a_given_time_can_be_had_again() {
    let place = Place::new();
    let common = ["--size", "64x48", "--workers", "0", "--threads", "1"];
    let timed = place.render("out.png", &[&common[..], &["--time", "0.5"]].concat());
    let log = fs::read_to_string(place.path("log")).unwrap();
    let told = log.lines().find_map(|line| line.split_once("the same picture again: "));
    let quality: Vec<&str> = told.unwrap_or_else(|| panic!("{log}")).1.split(' ').collect();
    assert!(log.contains("where 0.50 s were allowed"), "{log}");
    assert!(place.render("out.png", &[&common[..], &quality].concat()) == timed, "{quality:?}");
}

/// Whether a log says that this worker lost tiles for this reason.
fn tells_of_lost_lease(log: &str, worker: u32, reason: &str) -> bool {
    log.lines().any(|line| {
        line.contains("lease lost")
            && line.contains(&format!(" worker={worker} tiles="))
            && line.contains(&format!("reason=\"{reason}\""))
    })
}

#[test]
fn a_killed_and_a_stopped_worker_change_nothing() {
    const STOPPED: &str = "no progress for 2.0 s";
    let place = Place::new();
    let farm = ["--workers", "3", "--threads", "1", "--lease-seconds", "2"];
    let args = [&["render", "scene.rt", "-o", "out.png"], &SLOW[..], &farm].concat();
    let mut render = place.start("render.log", &args);
    poll(|| (render.tiles_done() >= 10 && render.workers().len() == 3).then_some(()));
    let workers = render.workers();
    kill_process(pid(workers[0].1), Signal::KILL).unwrap();
    hold(workers[1].1);
    // The others stand still as well until that one is found out, or they might have done all by
    // then.
    let mut resting = BTreeSet::from([workers[0].1, workers[1].1]);
    poll(|| {
        for (_, process) in render.workers() {
            if resting.insert(process) {
                let _ = kill_process(pid(process), Signal::STOP);
            }
        }
        tells_of_lost_lease(&render.log(), workers[1].0, STOPPED).then_some(())
    });
    for &process in &resting {
        if process != workers[1].1 {
            let _ = kill_process(pid(process), Signal::CONT);
        }
    }
    let status = render.wait();
    let log = render.log();
    assert!(status.success(), "{log}");

    check_each_tile_once(&log, SLOW_TILE_COUNT);
    for (worker, reason) in [(workers[0].0, "killed by signal 9"), (workers[1].0, STOPPED)] {
        assert!(tells_of_lost_lease(&log, worker, reason), "{worker} {reason}: {log}");
    }
    for (_, process) in workers {
        wait_for_end_of(process);
    }
    let here = place.render("here.png", &[&SLOW[..], &["--workers", "0"]].concat());
    assert!(fs::read(place.path("out.png")).unwrap() == here);
    place.check_nothing_is_left();
}

#[test]
fn workers_that_die_are_replaced_and_without_any_a_render_fails_and_says_why() {
    let place = Place::new();
    let args = [&["render", "scene.rt", "-o", "out.png", "--workers", "1"], &ENDLESS[..]].concat();
    let mut render = place.start("render.log", &args);
    poll(|| (render.tiles_done() >= 1).then_some(()));
    for count in 0..4 {
        let worker = poll(|| render.workers().get(count).copied());
        kill_process(pid(worker.1), Signal::KILL).unwrap();
    }
    assert_eq!(render.wait().code(), Some(1));
    let log = render.log();
    let last = log.lines().last().unwrap();
    assert_eq!(last, "error: all workers are dead; the last one: killed by signal 9");
    assert!(!place.path("out.png").exists());
    place.check_nothing_is_left();
}

#[test]
fn logs_count_every_tile_as_text_and_as_json() {
    let place = Place::new();
    let common = ["--size", "101x67", "--samples", "1", "--tile", "8", "--workers", "2"];
    let tile_count = 13 * 9;
    place.render("out.png", &common);
    check_each_tile_once(&fs::read_to_string(place.path("log")).unwrap(), tile_count);

    place.render("out.png", &[&common[..], &["--log-format", "json"]].concat());
    let log = fs::read_to_string(place.path("log")).unwrap();
    let mut tiles = BTreeSet::new();
    for line in log.lines() {
        let line: serde_json::Value = serde_json::from_str(line).expect(line);
        if line["message"].as_str().unwrap().ends_with(" done") {
            assert!(line["worker"].is_u64() && line["ms"].is_u64() && line["mrays"].is_f64());
            assert!(tiles.insert(line["tile"].as_u64().unwrap()), "{line}");
        }
    }
    assert_eq!(tiles.len(), tile_count);
}

#[test]
fn a_farm_over_tcp_gives_the_same_bytes() {
    let place = Place::new();
    let mut coordinator =
        place.start("coordinator.log", &["coordinator", "--insecure", "--listen", "127.0.0.1:0"]);
    let line = coordinator.read_line();
    let url = line.trim().strip_prefix("listening on ").expect(&line);
    let worker = ["worker", "--threads", "1", "--coordinator", url];
    let mut workers = [place.start("worker-a.log", &worker), place.start("worker-b.log", &worker)];
    for output in ["farm.png", "farm.exr"] {
        let pictures = ["none", "srgb"].map(|transfer| {
            let picture = [
                "--size",
                "103x59",
                "--crop",
                "3,5,99,50",
                "--samples",
                "2",
                "--transfer",
                transfer,
            ];
            let args = [&["submit", "scene.rt", "-o", output, "--coordinator", url], &picture[..]];
            let mut submit = place.start("submit.log", &args.concat());
            assert!(submit.wait().success(), "{}", submit.log());
            for workers in ["0", "2"] {
                let args = [&picture[..], &["--workers", workers]].concat();
                let here = place.render(&format!("here-{output}"), &args);
                assert!(fs::read(place.path(output)).unwrap() == here, "{output} {args:?}");
            }
            fs::read(place.path(output)).unwrap()
        });
        assert!(pictures[0] != pictures[1], "{output}");
    }

    let other = ["worker", "--coordinator", url, "--claim-version", "0.0.0"];
    check_refused(&place, &other, 1, "this worker is rtfarm 0.0.0");

    coordinator.signal(Signal::TERM);
    assert_eq!(coordinator.wait().code(), Some(0), "{}", coordinator.log());
    for worker in &mut workers {
        assert!(worker.wait().success(), "sent home: {}", worker.log());
    }
    place.check_nothing_is_left();
}

#[test]
fn a_coordinator_killed_and_started_again_gives_the_next_picture_no_pixel_of_the_last() {
    let place = Place::new();
    // The same grid of tiles, other pixels.
    let other = scene_text().replace("color 230 60 40", "color 40 60 230");
    fs::write(place.path("other.rt"), other).unwrap();
    let quick = ["--samples", "64", SLOW[0], SLOW[1], SLOW[4], SLOW[5]];
    let render = [&["render", "other.rt", "-o", "here.png", "--workers", "0"], &quick[..]].concat();
    let mut here = place.start("here.log", &render);
    assert!(here.wait().success(), "{}", here.log());
    let listen = ["coordinator", "--insecure", "--listen"];
    let mut first = place.start("first.log", &[&listen[..], &[&own_address()]].concat());
    let line = first.read_line();
    let url = line.trim().strip_prefix("listening on ").expect(&line);
    let worker = ["worker", "--threads", "2", "--patience", "60", "--coordinator", url];
    let workers = ["a.log", "b.log", "c.log"].map(|log| place.start(log, &worker));
    let args =
        [&["submit", "scene.rt", "-o", "out.png", "--coordinator", url], &ENDLESS[..]].concat();
    let _lost = place.start("lost.log", &args);
    poll(|| (first.tiles_done() >= 20 && first.workers().len() == 3).then_some(()));
    // Each has tiles in hand that it brings once it goes on.
    for worker in &workers {
        hold(worker.child.id());
    }
    first.signal(Signal::KILL);
    first.wait();

    let address = url.strip_prefix("http://").unwrap();
    let mut second = place.start("second.log", &[&listen[..], &[address]].concat());
    second.read_line();
    let args = ["submit", "other.rt", "-o", "next.png", "--coordinator", url];
    let mut submit = place.start("next.log", &[&args[..], &quick[..]].concat());
    poll(|| second.log().contains("job started").then_some(()));
    for worker in &workers {
        worker.signal(Signal::CONT);
    }
    assert!(submit.wait().success(), "{}", submit.log());
    let expected = fs::read(place.path("here.png")).unwrap();
    assert!(fs::read(place.path("next.png")).unwrap() == expected, "{}", second.log());
    // One may have been in a long tile of the lost job until now.
    poll(|| (second.workers().len() == 3).then_some(()));
    second.signal(Signal::TERM);
    second.wait();
    for mut worker in workers {
        assert!(worker.wait().success(), "sent home: {}", worker.log());
    }
}

#[test]
fn a_killed_coordinator_with_a_state_goes_on_and_loses_no_finished_tile() {
    let place = Place::new();
    let here = place.render("here.png", &[&SLOW[..], &["--workers", "0"]].concat());
    let coordinator = ["coordinator", "--insecure", "--state", "state", "--listen"];
    let mut first = place.start("first.log", &[&coordinator[..], &[&own_address()]].concat());
    let line = first.read_line();
    let url = line.trim().strip_prefix("listening on ").expect(&line).to_owned();
    let address = url.strip_prefix("http://").unwrap();
    let worker = ["worker", "--threads", "1", "--coordinator", &url];
    let workers = ["a.log", "b.log"].map(|log| place.start(log, &worker));
    let args = [&["submit", "scene.rt", "-o", "out.png", "--coordinator", &url], &SLOW[..]];
    let mut submit = place.start("submit.log", &args.concat());

    let mut killed = first;
    let mut done = BTreeSet::new();
    for (log, tile_count) in [("second.log", 30), ("third.log", 60)] {
        poll(|| (killed.tiles_done() >= tile_count).then_some(()));
        check_refused(
            &place,
            &[&coordinator[..], &["127.0.0.1:0"]].concat(),
            1,
            "another coordinator",
        );
        killed.signal(Signal::KILL);
        killed.wait();
        let finished = finished_tiles(&killed.log());
        assert!(finished.iter().all(|&tile| done.insert(tile)), "a tile was finished twice");
        let mut next = place.start(log, &[&coordinator[..], &[address]].concat());
        next.read_line();
        killed = next;
    }
    assert!(submit.wait().success(), "{}", submit.log());
    assert!(fs::read(place.path("out.png")).unwrap() == here, "{}", killed.log());
    let finished = finished_tiles(&killed.log());
    assert!(finished.iter().all(|&tile| done.insert(tile)), "a tile was finished twice");
    poll(|| (fs::read_dir(place.path("state/jobs")).unwrap().count() == 0).then_some(()));
    killed.signal(Signal::TERM);
    assert_eq!(killed.wait().code(), Some(0), "{}", killed.log());
    for mut worker in workers {
        assert!(worker.wait().success(), "sent home: {}", worker.log());
    }
    fs::write(place.path("state/farm"), "another thing").unwrap();
    check_refused(&place, &[&coordinator[..], &[address]].concat(), 1, "it is no record of a farm");
    let foreign = ["coordinator", "--insecure", "--listen", address, "--state", "."];
    check_refused(&place, &foreign, 2, ". is not empty and holds no state of a farm");
    place.check_nothing_is_left();
}

#[test]
fn a_state_on_a_full_disk_refuses_a_job_and_goes_on() {
    let place = Place::new();
    with_small_disk(&place, "64k", || {
        let coordinator =
            ["coordinator", "--insecure", "--listen", "127.0.0.1:0", "--state", "disk/state"];
        let mut coordinator = place.start("coordinator.log", &coordinator);
        let line = coordinator.read_line();
        let url = line.trim().strip_prefix("listening on ").expect(&line).to_owned();
        let submit = ["submit", "scene.rt", "--coordinator", &url, "--samples", "1", "-o"];
        let large = [&submit[..], &["large.png", "--size", "512x512"]].concat();
        check_refused(&place, &large, 2, "No space left on device");
        let worker = ["worker", "--threads", "1", "--coordinator", &url];
        let _worker = place.start("worker.log", &worker);
        let mut small =
            place.start("small.log", &[&submit[..], &["small.png", "--size", "64x48"]].concat());
        assert!(small.wait().success(), "{}", small.log());
        assert_eq!(fs::read_dir(place.path("disk/state/jobs")).unwrap().count(), 0);
        coordinator.signal(Signal::TERM);
        coordinator.wait();
    });
}

#[test]
fn an_interrupted_render_goes_on_where_it_was() {
    let place = Place::new();
    let here = place.render("here.png", &[&SLOW[..], &["--workers", "0"]].concat());
    let args = [&["render", "scene.rt", "-o", "out.png", "--resume", "--workers"], &SLOW[..]];
    for workers in ["0", "2"] {
        let args = [args[0], &[workers], args[1]].concat();
        let mut first = place.start("first.log", &args);
        poll(|| (first.tiles_done() >= 30).then_some(()));
        check_refused(&place, &args, 1, "another rtfarm is rendering there");
        first.signal(Signal::KILL);
        first.wait();
        let done = finished_tiles(&first.log());
        let mut second = place.start("second.log", &args);
        assert!(second.wait().success(), "{}", second.log());
        let log = second.log();
        assert!(log.contains("going on with "), "{log}");
        assert!(finished_tiles(&log).iter().all(|tile| !done.contains(tile)), "{log}");
        assert!(fs::read(place.path("out.png")).unwrap() == here);
        assert!(!place.path("out.png.rtfarm").exists());

        let mut first = place.start("first.log", &args);
        poll(|| (first.tiles_done() >= 1).then_some(()));
        first.signal(Signal::INT);
        assert_eq!(first.wait().code(), Some(130), "{}", first.log());
        let other = [
            &["render", "scene.rt", "-o", "out.png", "--resume", "--seed", "3"][..],
            &["--size", "32x32", "--workers", workers],
        ];
        let mut other = place.start("other.log", &other.concat());
        assert!(other.wait().success(), "{}", other.log());
        assert!(other.log().contains("beginning anew, since "), "{}", other.log());
        assert!(!place.path("out.png.rtfarm").exists());
    }
    fs::create_dir(place.path("out.png.rtfarm")).unwrap();
    fs::write(place.path("out.png.rtfarm/letter"), "dear").unwrap();
    let args = ["render", "scene.rt", "-o", "out.png", "--resume", "--size", "32x32"];
    check_refused(&place, &args, 1, "it holds something else: letter");
    poll(|| (fs::read_dir(place.path("tmp")).unwrap().count() <= 1).then_some(()));
}

#[test]
fn an_interrupted_submit_ends_its_job() {
    let place = Place::new();
    let mut coordinator =
        place.start("coordinator.log", &["coordinator", "--insecure", "--listen", "127.0.0.1:0"]);
    let line = coordinator.read_line();
    let url = line.trim().strip_prefix("listening on ").expect(&line);
    let _worker = place.start("worker.log", &["worker", "--threads", "1", "--coordinator", url]);
    let args =
        [&["submit", "scene.rt", "-o", "out.png", "--coordinator", url], &ENDLESS[..]].concat();
    let mut submit = place.start("submit.log", &args);
    poll(|| (coordinator.tiles_done() >= 3).then_some(()));
    submit.signal(Signal::INT);
    assert_eq!(submit.wait().code(), Some(130), "{}", submit.log());
    poll(|| coordinator.log().contains("job cancelled").then_some(()));
    assert!(!place.path("out.png").exists());

    let quick = ["--size", "32x32", "--samples", "1", "--coordinator", url];
    let args = [&["submit", "scene.rt", "-o", "next.png"], &quick[..]].concat();
    let mut next = place.start("next.log", &args);
    assert!(next.wait().success(), "the worker is free again: {}", next.log());
    coordinator.signal(Signal::INT);
    coordinator.wait();
    place.check_nothing_is_left();
}

#[test]
fn an_interrupted_render_leaves_nothing() {
    let place = Place::new();
    for (signal, here) in [(Signal::INT, "2"), (Signal::TERM, "2"), (Signal::INT, "0")] {
        let args =
            [&["render", "scene.rt", "-o", "out.png", "--workers", here], &ENDLESS[..]].concat();
        let mut render = place.start("render.log", &args);
        poll(|| (render.tiles_done() >= 3).then_some(()));
        let workers = render.workers();
        if let Some(&(_, stopped)) = workers.first() {
            hold(stopped);
        }
        render.signal(signal);
        assert_eq!(render.wait().code(), Some(130), "{}", render.log());
        let log = render.log();
        assert!(log.ends_with("error: interrupted\n") && !log.contains("lease lost"), "{log}");
        for (_, process) in workers {
            wait_for_end_of(process);
        }
        assert!(!place.path("out.png").exists());
        place.check_nothing_is_left();
    }
}

#[test]
fn workers_die_with_a_killed_coordinator() {
    let place = Place::new();
    let args = [&["render", "scene.rt", "-o", "out.png", "--workers", "2"], &ENDLESS[..]].concat();
    let mut render = place.start("render.log", &args);
    poll(|| (render.tiles_done() >= 1 && render.workers().len() == 2).then_some(()));
    let workers = render.workers();
    hold(workers[0].1);
    render.signal(Signal::KILL);
    render.wait();
    for (_, process) in workers {
        wait_for_end_of(process);
    }
    assert!(fs::read_dir(place.path("tmp")).unwrap().count() > 0, "a folder is left");
    place.render("next.png", &["--size", "16x16", "--workers", "1"]);
    place.check_nothing_is_left();
}

#[test]
fn a_worker_that_stays_stopped_is_replaced() {
    let place = Place::new();
    let args = [&["render", "scene.rt", "-o", "out.png", "--workers", "1"], &ENDLESS[..]].concat();
    let mut render = place.start("render.log", &args);
    poll(|| (render.tiles_done() >= 1).then_some(()));
    hold(render.workers()[0].1);
    poll(|| (render.workers().len() == 2).then_some(()));
    render.signal(Signal::INT);
    assert_eq!(render.wait().code(), Some(130));
    place.check_nothing_is_left();
}

/// Checks that a command fails with one line that says `reason`, and changes nothing.
fn check_refused(place: &Place, args: &[&str], code: i32, reason: &str) {
    fs::write(place.path("refused.log"), "").unwrap();
    let before = place.files();
    let mut process = place.start("refused.log", args);
    let status = process.wait();
    let log = process.log();
    let lines: Vec<&str> = log.lines().collect();
    assert_eq!(lines.len(), 1, "{args:?}: {log}");
    assert!(lines[0].starts_with("error: ") && lines[0].contains(reason), "{args:?}: {log}");
    assert_eq!(status.code(), Some(code), "{args:?}: {log}");
    assert_eq!(place.files(), before, "{args:?}");
}

#[test]
fn bad_input_gives_one_clear_line_and_an_exit_code() {
    let place = Place::new();
    fs::create_dir(place.path("folder.png")).unwrap();
    for (scene, output, rest, code, reason) in [
        ("nowhere.rt", "o.png", "", 2, "cannot read the scene nowhere.rt: No such file"),
        ("tmp", "o.png", "", 2, "cannot read the scene tmp: it is a folder"),
        ("scene.rt", "o.gif", "", 2, "must end in .png or .exr"),
        ("scene.rt", "png", "", 2, "must end in .png or .exr"),
        ("scene.rt", "o.exr", "--depth=16", 2, "--depth is for PNG"),
        ("scene.rt", "folder.png", "", 1, "is a folder"),
        ("scene.rt", "nowhere/o.png", "", 1, "cannot write into the folder nowhere: No such"),
        ("scene.rt", "/proc/o.png", "", 1, "cannot write into the folder /proc"),
        ("scene.rt", "o.png", "--size=0x0", 2, "not 0x0"),
        ("scene.rt", "o.png", "--size=100000x100000", 2, "not 100000x100000"),
        ("scene.rt", "o.png", "--size=1e3x5", 2, "a size looks like 1280x720"),
        ("scene.rt", "o.png", "--crop=1,2,3", 2, "a crop window looks like 320,180,640,360"),
        ("scene.rt", "o.png", "--crop=0,0,9999,1", 2, "does not have all of the crop window"),
        ("scene.rt", "o.png", "--tile=2", 2, "must be a whole number from 4 to 1024"),
        ("scene.rt", "o.png", "--samples=0", 2, "must be a whole number from 1 to 65536"),
        ("scene.rt", "o.png", "--error=0", 2, "must be a number above 0 and at most 1"),
        ("scene.rt", "o.png", "--max-samples=7", 2, "must be a whole number from 8 to 65536"),
        ("scene.rt", "o.png", "--isa=mmx", 2, "`mmx` is not an instruction set"),
        ("scene.rt", "o.png", "--wokers=2", 2, "tip: a similar argument exists: '--workers'"),
    ] {
        let args = ["render", scene, "-o", output, rest];
        let given = if rest.is_empty() { 4 } else { 5 };
        check_refused(&place, &args[..given], code, reason);
    }
    check_refused(
        &place,
        &["rendr", "scene.rt"],
        2,
        "'rendr'; tip: some similar subcommands exist: 'report', 'retry', 'render'",
    );
    for (option, reason) in [
        ("--error", "must be a number above 0 and at most 1"),
        ("--samples", "must be a whole number from 1 to 65536"),
        ("--time", "a time is from 0.1 to 86400 seconds"),
        ("--workers", "must be a whole number from 0 to 256"),
        ("--seed", "must be a whole number from 0 to 18446744073709551615"),
        ("--tile", "must be a whole number from 4 to 1024"),
    ] {
        let args = ["render", "scene.rt", "-o", "o.png", option, "-1"];
        check_refused(&place, &args, 2, reason);
    }
    check_refused(&place, &["render", "scene.rt"], 2, "--output <FILE>");
    let huge = ["render", "scene.rt", "-o", "o.png", "--size", "65535x65535", "--tile", "4"];
    check_refused(&place, &huge, 2, "at most 1048576 tiles");
    let open = ["coordinator", "--listen", "0.0.0.0:0"];
    check_refused(&place, &open, 2, "--insecure");
    check_refused(&place, &["worker", "--coordinator", "host"], 2, "is no coordinator's address");
    place.check_nothing_is_left();
}

#[test]
fn a_port_in_use_and_a_missing_coordinator_are_told() {
    let place = Place::new();
    let address = own_address();
    let taken = TcpListener::bind(&address).unwrap();
    let reason = format!("cannot listen on {address}: Address already in use");
    check_refused(&place, &["coordinator", "--insecure", "--listen", &address], 1, &reason);

    drop(taken);
    let url = format!("http://{address}");
    let reason = format!("no coordinator answers at {url}: ");
    let worker = ["worker", "--coordinator", &url, "--patience", "0.2"];
    check_refused(&place, &worker, 1, &reason);
    let submit = ["submit", "scene.rt", "-o", "out.png", "--coordinator", &url];
    check_refused(&place, &submit, 1, &reason);
    place.check_nothing_is_left();
}

/// A farm's coordinator, started, and its address.
fn start_coordinator(place: &Place) -> (Process, String) {
    let mut coordinator =
        place.start("coordinator.log", &["coordinator", "--insecure", "--listen", "127.0.0.1:0"]);
    let line = coordinator.read_line();
    let url = line.trim().strip_prefix("listening on ").expect(&line).to_owned();
    (coordinator, url)
}

/// Does `check` with a disk of that size at `disk` in the place; the disk is unmounted by the end.
fn with_small_disk(place: &Place, size: &str, check: impl FnOnce()) {
    let disk = place.path("disk");
    fs::create_dir(&disk).unwrap();
    let mounted = Command::new("mount")
        .args(["-t", "tmpfs", "-o", &format!("size={size}"), "none"])
        .arg(&disk)
        .output()
        .is_ok_and(|output| output.status.success());
    if !mounted {
        eprintln!("SKIPPED: only root can mount the small disk that this test fills");
        return;
    }
    let checked = std::panic::catch_unwind(std::panic::AssertUnwindSafe(check));
    assert!(Command::new("umount").arg(&disk).status().unwrap().success());
    checked.unwrap();
}

#[test]
fn a_full_disk_is_told_at_once() {
    let place = Place::new();
    with_small_disk(&place, "64k", || {
        for workers in ["0", "2"] {
            let size = ["--size", "512x512", "--samples", "1", "--workers", workers];
            let args = [&["render", "scene.rt", "-o", "disk/out.png"], &size[..]].concat();
            check_refused(&place, &args, 1, "No space left on device");
        }
        assert_eq!(fs::read_dir(place.path("disk")).unwrap().count(), 0);
        place.check_nothing_is_left();
    });
}

#[test]
fn a_picture_for_which_there_is_no_room_is_fetched_again() {
    let place = Place::new();
    let (_coordinator, url) = start_coordinator(&place);
    let _worker = place.start("worker.log", &["worker", "--threads", "1", "--coordinator", &url]);
    let picture = ["--size", "256x256", "--samples", "1"];
    with_small_disk(&place, "64k", || {
        let args = ["submit", "scene.rt", "-o", "disk/out.exr", "--coordinator", &url];
        let mut submit = place.start("submit.log", &[&args[..], &picture].concat());
        assert_eq!(submit.wait().code(), Some(1));
        let log = submit.log();
        assert!(log.contains("No space left on device"), "{log}");
        let told = log.split_once("rtfarm ").expect(&log).1.split_once(" -o").expect(&log).0;
        let told: Vec<&str> = told.split(' ').collect();
        let mut image = place.start("image.log", &[&told[..], &["-o", "out.exr"]].concat());
        assert!(image.wait().success(), "{told:?}: {}", image.log());
        let here = place.render("here.exr", &[&picture[..], &["--workers", "0"]].concat());
        assert!(fs::read(place.path("out.exr")).unwrap() == here);
    });
}

#[test]
fn check_does_not_wait_for_a_pipe_that_a_scene_names() {
    let place = Place::new();
    let entry = "entry\n name m\n color 1 1 1\n texture pipe.png\nendentry\n";
    fs::write(place.path("pipe.rt"), format!("materials\n{entry}endmaterials\n")).unwrap();
    let made = Command::new("mkfifo").arg(place.path("pipe.png")).status().unwrap();
    assert!(made.success());
    let mut check = place.start("check.log", &["check", "pipe.rt"]);
    assert_eq!(check.wait().code(), Some(2));
    assert!(check.log().contains("it is no regular file"), "{}", check.log());
}

#[test]
fn a_file_outside_of_the_scenes_folder_is_sent_only_if_it_is_allowed() {
    let place = Place::new();
    let (_coordinator, url) = start_coordinator(&place);
    let _worker = place.start("worker.log", &["worker", "--threads", "1", "--coordinator", &url]);
    fs::create_dir(place.path("deep")).unwrap();
    let mesh = "geometry\nmesh\n file ../tetra.obj\n material red\nendmesh\nendgeometry\n";
    fs::write(place.path("deep/scene.rt"), scene_text() + mesh).unwrap();
    let obj = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n";
    fs::write(place.path("tetra.obj"), obj).unwrap();
    let args = ["deep/scene.rt", "-o", "out.png", "--size", "32x32", "--samples", "1"];
    let allow = ["--allow-files", "."];
    for command in [&["submit", "--coordinator", &url][..], &["render"]] {
        let mut refused = place.start("refused.log", &[command, &args].concat());
        assert_eq!(refused.wait().code(), Some(2), "{}", refused.log());
        assert!(refused.log().contains("outside of the scene's folder"), "{}", refused.log());
        let mut allowed = place.start("allowed.log", &[command, &args, &allow].concat());
        assert!(allowed.wait().success(), "{}", allowed.log());
        let is_told = |line: &str| line.contains("sending a file") && line.contains("tetra.obj");
        assert_eq!(allowed.log().lines().any(is_told), command[0] == "submit");
    }
}

#[test]
fn a_reader_of_the_log_that_stands_still_stops_nothing() {
    let place = Place::new();
    let mut coordinator = Command::new(env!("CARGO_BIN_EXE_rtfarm"))
        .args(["coordinator", "--insecure", "--listen", "127.0.0.1:0"])
        .env("TMPDIR", place.path("tmp"))
        // Every request is told, more than a pipe holds.
        .env("RUST_LOG", "debug")
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let stdout = coordinator.stdout.take().map(BufReader::new);
    let mut coordinator = Process { child: coordinator, stdout, log: place.path("none") };
    let line = coordinator.read_line();
    let url = line.trim().strip_prefix("listening on ").expect(&line);
    let mut worker = place.start("worker.log", &["worker", "--threads", "1", "--coordinator", url]);
    let picture = ["--size", "160x160", "--samples", "1", "--tile", "4"];
    let args = ["submit", "scene.rt", "-o", "out.png", "--coordinator", url];
    let mut submit = place.start("submit.log", &[&args[..], &picture].concat());
    assert!(submit.wait().success(), "{}", submit.log());
    coordinator.signal(Signal::TERM);
    assert_eq!(coordinator.wait().code(), Some(0));
    assert!(worker.wait().success(), "{}", worker.log());
    place.check_nothing_is_left();
}

#[test]
fn a_second_interruption_ends_a_submit_at_once() {
    let place = Place::new();
    let (coordinator, url) = start_coordinator(&place);
    let args = ["submit", "scene.rt", "-o", "out.png", "--coordinator", &url];
    let debug = ["env".to_owned(), "RUST_LOG=rtfarm=debug".to_owned()];
    let mut submit = place.start_by(&debug, "submit.log", &args);
    // It has its job and watches it.
    poll(|| submit.log().contains("progress").then_some(()));
    hold(coordinator.child.id());
    submit.signal(Signal::INT);
    thread::sleep(Duration::from_millis(300));
    assert!(submit.child.try_wait().unwrap().is_none(), "it tells the farm, which does not listen");
    submit.signal(Signal::INT);
    assert_eq!(submit.wait().code(), Some(130));
    assert!(!submit.log().contains("error: "), "who waits for the farm to answer says so");
    coordinator.signal(Signal::CONT);
}

#[test]
fn the_scene_may_come_from_standard_input() {
    let place = Place::new();
    let common = ["--size", "40x30", "--samples", "1"];
    let expected = place.render("file.png", &common);
    let status = Command::new(env!("CARGO_BIN_EXE_rtfarm"))
        .args([&["render", "-", "-o", "stdin.png"], &common[..]].concat())
        .current_dir(place.folder.path())
        .env("TMPDIR", place.path("tmp"))
        .stdin(File::open(place.path("scene.rt")).unwrap())
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .status()
        .unwrap();
    assert!(status.success());
    assert!(fs::read(place.path("stdin.png")).unwrap() == expected);
}
