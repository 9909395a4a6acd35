//! `render --slurm` with a real Slurm on this machine.
//!
//!     cargo test --test farm slurm -- --ignored --nocapture
//!
//! Needs root, and Slurm's and MUNGE's daemons.

use super::*;

const NODES: usize = 3;

/// A picture of some seconds for four workers.
const PICTURE: [&str; 6] = ["--size", "160x120", "--samples", "512", "--tile", "8"];

/// A cluster, which `tests/slurm-cluster` runs.
struct Cluster {
    _parent: TempDir,
    folder: PathBuf,
}

impl Cluster {
    /// `None` where the user or the machine cannot run one.
    fn start() -> Option<Self> {
        let has = |tool: &str| {
            ["/usr/sbin", "/usr/bin"].iter().any(|folder| Path::new(folder).join(tool).exists())
        };
        let tools = ["munged", "slurmctld", "slurmd", "sbatch", "unshare"];
        if !rustix::process::geteuid().is_root() || !tools.into_iter().all(has) {
            eprintln!("SKIPPED: a cluster needs root, slurm-wlm and munge");
            return None;
        }
        // Its sockets' names must not be long.
        let parent = tempfile::Builder::new().prefix("slurm").tempdir_in("/tmp").unwrap();
        let cluster = Self { folder: parent.path().join("cluster"), _parent: parent };
        cluster.manage("start", Some(&NODES.to_string()));
        Some(cluster)
    }

    fn manage(&self, command: &str, what: Option<&str>) {
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/slurm-cluster");
        let status = Command::new(script).arg(command).arg(&self.folder).args(what).status();
        assert!(status.unwrap().success(), "{command}");
    }

    fn configuration(&self) -> String {
        format!("SLURM_CONF={}", self.folder.join("slurm.conf").display())
    }

    /// Runs a command of Slurm; answers with what it said.
    fn run(&self, words: &[&str]) -> String {
        let mut command = Command::new("env");
        let output = command.arg(self.configuration()).args(words).output().unwrap();
        assert!(output.status.success(), "{words:?}: {output:?}");
        String::from_utf8(output.stdout).unwrap()
    }

    /// The tasks in the queue, as `1_2 RUNNING w1`.
    fn queue(&self) -> Vec<String> {
        let queue = self.run(&["squeue", "--noheader", "--array", "--format=%i %T %N"]);
        queue.lines().map(|line| line.trim().to_owned()).collect()
    }

    /// Renders `PICTURE` with these options of Slurm's and more of `render`.
    fn render(&self, place: &Place, options: &str, more: &[&str]) -> Process {
        self.render_of(place, options, &[&PICTURE[..], more].concat())
    }

    fn render_of(&self, place: &Place, options: &str, picture: &[&str]) -> Process {
        let args = ["render", "scene.rt", "-o", "out.png", "--slurm-host", "127.0.0.1", "--slurm"];
        let args = [&args[..], &[options], picture].concat();
        place.start_by(&["env".to_owned(), self.configuration()], "render.log", &args)
    }
}

impl Drop for Cluster {
    fn drop(&mut self) {
        self.manage("stop", None);
    }
}

/// Waits until so many tiles are done by so many workers.
fn await_work(render: &Process, workers: usize, tiles: usize) {
    poll(|| (render.workers().len() >= workers && render.tiles_done() >= tiles).then_some(()));
}

/// The number of a render's array.
fn array(render: &Process) -> u32 {
    let log = render.log();
    let line = log.lines().find(|line| line.contains("Slurm has the workers in its queue"));
    let (_, number) = line.unwrap_or_else(|| panic!("{log}")).split_once("job=").unwrap();
    number.trim().parse().unwrap()
}

#[test]
#[ignore = "needs root and Slurm; .ci/run runs it"]
fn slurm_renders_the_same_bytes_though_tasks_are_cancelled_queued_again_preempted_and_cut_off() {
    let Some(cluster) = Cluster::start() else { return };
    let place = Place::new();
    let here = place.render("here.png", &[&PICTURE[..], &["--workers", "0"]].concat());
    let before = place.files();

    let mut render = cluster.render(&place, "--array=1-2", &[]);
    assert!(render.wait().success(), "{}", render.log());
    assert!(fs::read(place.path("out.png")).unwrap() == here);
    assert!(render.read_line().contains(", 2 workers, "));
    assert_eq!(cluster.queue(), [""; 0]);

    // The longer line has time for all that happens.
    let slower = ["--lease-seconds", "1"];
    let mut render = cluster.render(&place, "--array=1-5 --cpus-per-task=2", &slower);
    await_work(&render, 4, 8);
    let node_of = |task: &str| {
        let queue = cluster.queue();
        let line = queue.iter().find(|line| line.contains(task)).expect(task).clone();
        line.rsplit_once(' ').unwrap().1.to_owned()
    };
    let cut = node_of("_4 RUNNING");
    cluster.manage("cut", Some(&cut));
    let array = array(&render);
    cluster.run(&["scancel", &format!("{array}_1")]);
    cluster.run(&["scontrol", "requeue", &format!("{array}_2")]);
    let urgent = ["sbatch", "--partition=urgent", "--nodelist", &node_of("_5 RUNNING")];
    let sleep = ["--exclusive", "--output=/dev/null", "--wrap=sleep 1"];
    cluster.run(&[&urgent[..], &sleep].concat());
    cluster.manage("boot", Some(&cut));
    assert!(render.wait().success(), "{}", render.log());
    check_each_tile_once(&render.log(), SLOW_TILE_COUNT);
    assert!(fs::read(place.path("out.png")).unwrap() == here);
    let of_render = |task: &String| task.starts_with(&format!("{array}_"));
    poll(|| (!cluster.queue().iter().any(of_render)).then_some(()));
    fs::remove_file(place.path("out.png")).unwrap();
    fs::remove_file(place.path("render.log")).unwrap();
    assert_eq!(place.files(), before);
    place.check_nothing_is_left();
}

#[test]
#[ignore = "needs root and Slurm; .ci/run runs it"]
fn a_worker_that_slurm_asks_to_end_delivers_what_it_has() {
    let Some(cluster) = Cluster::start() else { return };
    let place = Place::new();
    // Asked for by hand, and by the signal that Slurm sends before a task's time is over: that is a
    // minute at least, and it comes 55 s before its end, be the worker there yet or not.
    for (job, options, by_hand) in
        [("1", "--array=1-1", true), ("2", "--array=1-1 --time=1 --signal=B:TERM@55", false)]
    {
        // One that no machine renders in seconds.
        let picture = ["--size", "2048x2048", "--samples", "512", "--tile", "8"];
        let mut render = cluster.render_of(&place, options, &picture);
        if by_hand {
            await_work(&render, 1, 4);
            cluster.run(&["scancel", "--batch", "--signal=TERM", &format!("{job}_1")]);
        }
        assert_eq!(render.wait().code(), Some(1), "{options}: {}", render.log());
        // It says so itself, and gives back what it has not begun.
        let log = render.log();
        let lost: Vec<&str> = log.lines().filter(|line| line.contains("lease lost")).collect();
        assert!(lost.iter().all(|line| line.contains("the worker was stopped")), "{lost:?}");
        assert!(log.contains(&format!("no worker of Slurm's job {job} is left")), "{log}");
    }
}

#[test]
#[ignore = "needs root and Slurm; .ci/run runs it"]
fn a_coordinator_that_slurm_queues_again_on_another_node_is_found_there() {
    let Some(cluster) = Cluster::start() else { return };
    let place = Place::new();
    let submit_job = |script: &str, options: &[&str], args: &[&str]| {
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("deploy/slurm").join(script);
        let folder = format!("--chdir={}", place.folder.path().display());
        // Each start listens on another port.
        let words = ["RTFARM_LISTEN=0.0.0.0:0", "sbatch", "--parsable", &folder];
        let program = [script.to_str().unwrap(), env!("CARGO_BIN_EXE_rtfarm")];
        cluster.run(&[&words[..], options, &program, args].concat()).trim().to_owned()
    };
    let coordinator = submit_job("coordinator.sh", &["--output=coordinator.log"], &["farm"]);
    let running = format!("{coordinator} RUNNING ");
    let node = || {
        poll(|| {
            cluster.queue().iter().find_map(|job| job.strip_prefix(&running).map(str::to_owned))
        })
    };
    let first = node();
    let elsewhere = format!("--exclude={first}");
    let options = ["--array=1-2", "--cpus-per-task=2", "--output=worker.%a.log", &elsewhere];
    submit_job("worker.sh", &options, &["farm/access/work"]);
    poll(|| place.path("farm/access/submit").exists().then_some(()));
    // Nodes alone know each other by their names.
    let srun = ["env".to_owned(), cluster.configuration(), "srun".to_owned(), elsewhere];
    let order = ["submit", "scene.rt", "-o", "out.png", "--access", "farm/access/submit"];
    let mut submit = place.start_by(&srun, "submit.log", &[&order[..], &PICTURE].concat());
    let log = || fs::read_to_string(place.path("coordinator.log")).unwrap_or_default();
    poll(|| (finished_tiles(&log()).len() >= 8).then_some(()));
    let before = finished_tiles(&log()).len();
    cluster.manage("cut", Some(&first));
    assert!(submit.wait().success(), "{}", submit.log());
    let second = node();
    assert_ne!(first, second);
    for node in [&first, &second] {
        assert!(log().contains(&format!("listening on https://{node}:")), "{node}: {}", log());
    }
    assert!(before < SLOW_TILE_COUNT && finished_tiles(&log()).len() >= SLOW_TILE_COUNT - 8);
    let here = place.render("here.png", &[&PICTURE[..], &["--workers", "0"]].concat());
    assert!(fs::read(place.path("out.png")).unwrap() == here);
    cluster.run(&["scancel", "--batch", "--signal=TERM", &coordinator]);
    poll(|| cluster.queue().is_empty().then_some(()));
}

#[test]
#[ignore = "needs root and Slurm; .ci/run runs it"]
fn nothing_stays_in_the_queue_whatever_ends_a_render() {
    let Some(cluster) = Cluster::start() else { return };
    let place = Place::new();
    for (signal, code) in [(Signal::INT, Some(130)), (Signal::TERM, Some(130))] {
        let mut render = cluster.render(&place, "--array=1-20 --cpus-per-task=4", &[]);
        await_work(&render, 2, 1);
        render.signal(signal);
        assert_eq!(render.wait().code(), code, "{}", render.log());
        assert_eq!(cluster.queue(), [""; 0]);
        place.check_nothing_is_left();
    }

    // Killed, it can cancel nothing: the workers leave by themselves, and those that come later.
    let mut render = cluster.render(&place, "--array=1-4 --cpus-per-task=4", &["--patience", "1"]);
    await_work(&render, 2, 1);
    render.signal(Signal::KILL);
    render.wait();
    poll(|| cluster.queue().is_empty().then_some(()));
    // What is left on the disk goes with the next.
    let left = || place.files().into_iter().filter(|path| path.to_string_lossy().contains('@'));
    assert_eq!(left().count(), 1);
    let mut render = cluster.render(&place, "--no-such-option", &[]);
    assert_eq!(render.wait().code(), Some(1));
    assert!(render.log().contains("sbatch failed"), "{}", render.log());
    assert_eq!(left().count(), 0);
}
