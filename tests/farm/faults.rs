//! A farm under a plan of faults that a seed makes: processes are killed and stopped, links cut and
//! slowed, the disk is full, descriptors run out. Pictures must come out the same to the byte, an
//! order that fails must say why, and nothing may hang or stay behind.
//!
//!     RTFARM_FAULT_SECONDS=600 RTFARM_SEED=1 cargo test --test farm faults -- --ignored --nocapture
//!
//! Needs root, and `ip`, `tc` and `nft`.

use std::{
    collections::BTreeMap,
    env,
    io::{Read, Write},
    net::{Shutdown, TcpStream},
    os::fd::AsFd,
    sync::mpsc,
};

use fastrand::Rng;
use rustix::thread::{LinkNameSpaceType, move_into_link_name_space};
use tokio::time::Instant;

use super::*;

const WORKERS: usize = 3;

/// The worker whose link has a delay.
const FAR: usize = 3;

const DELAY: Duration = Duration::from_millis(40);

const ADDRESS: &str = "10.83.0.1:7878";

/// Where the far worker finds the coordinator.
const FAR_ADDRESS: &str = "10.83.0.1:7879";

/// A picture of 2 to 4 s for the farm.
const PICTURE: [&str; 6] = ["--size", "320x240", "--samples", "256", "--tile", "16"];

/// How long an order may take after the last fault was mended.
const CALM: Duration = Duration::from_secs(60);

/// Networks of their own: the first for the coordinator and its clients, one for each worker, all
/// joined by a bridge. They end with the processes that hold them.
struct Networks {
    holders: Vec<Child>,
}

impl Networks {
    /// `None` where the user or the machine cannot make them.
    fn new() -> Option<Self> {
        let has_tools = ["ip", "tc", "nft"].iter().all(|tool| run(&[tool, "-V"]));
        if !rustix::process::geteuid().is_root() || !has_tools {
            return None;
        }
        let holder = || Command::new("unshare").args(["--net", "sleep", "1h"]).spawn().unwrap();
        let networks = Self { holders: (0..=WORKERS).map(|_| holder()).collect() };
        let ours = fs::read_link("/proc/self/ns/net").unwrap();
        for holder in &networks.holders {
            let theirs = format!("/proc/{}/ns/net", holder.id());
            poll(|| fs::read_link(&theirs).is_ok_and(|theirs| theirs != ours).then_some(()));
        }
        networks.run(0, "ip link set lo up");
        networks.run(0, "ip link add bridge type bridge");
        networks.run(0, "ip address add 10.83.0.1/24 dev bridge");
        networks.run(0, "ip link set bridge up");
        for worker in 1..=WORKERS {
            let process = networks.holders[worker].id();
            networks.run(
                0,
                &format!("ip link add to{worker} type veth peer name wire netns {process}"),
            );
            networks.run(0, &format!("ip link set to{worker} master bridge up"));
            networks.run(worker, &format!("ip address add 10.83.0.{}/24 dev wire", worker + 1));
            networks.run(worker, "ip link set wire up");
        }
        Some(networks)
    }

    /// The words that start a command in a network.
    fn enter(&self, network: usize) -> [String; 2] {
        ["nsenter".to_owned(), format!("--net=/proc/{}/ns/net", self.holders[network].id())]
    }

    fn run(&self, network: usize, command: &str) {
        let enter = self.enter(network);
        let words: Vec<&str> = enter.iter().map(String::as_str).chain(command.split(' ')).collect();
        assert!(run(&words), "{command}");
    }

    /// Passes on what comes for the far worker's coordinator, and back, `DELAY` later.
    fn delay(&self) {
        let network = File::open(format!("/proc/{}/ns/net", self.holders[0].id())).unwrap();
        let (is_ready, ready) = mpsc::channel();
        thread::spawn(move || {
            // Threads that this one starts are in its network as well.
            move_into_link_name_space(network.as_fd(), Some(LinkNameSpaceType::Network)).unwrap();
            let listener = TcpListener::bind(FAR_ADDRESS).unwrap();
            is_ready.send(()).unwrap();
            for near in listener.incoming().map_while(Result::ok) {
                let Ok(far) = TcpStream::connect(ADDRESS) else { continue };
                for (from, to) in [(&near, &far), (&far, &near)] {
                    pass_on(from.try_clone().unwrap(), to.try_clone().unwrap());
                }
            }
        });
        ready.recv().unwrap();
    }
}

impl Drop for Networks {
    fn drop(&mut self) {
        for holder in &mut self.holders {
            let _ = holder.kill();
            let _ = holder.wait();
        }
    }
}

/// Passes on every byte `DELAY` after it came.
fn pass_on(mut from: TcpStream, mut to: TcpStream) {
    let (sender, receiver) = mpsc::channel::<(Instant, Vec<u8>)>();
    thread::spawn(move || {
        let mut buffer = vec![0; 1 << 16];
        while let Ok(count @ 1..) = from.read(&mut buffer) {
            if sender.send((Instant::now() + DELAY, buffer[..count].to_vec())).is_err() {
                break;
            }
        }
    });
    thread::spawn(move || {
        for (due, bytes) in receiver {
            thread::sleep(due.saturating_duration_since(Instant::now()));
            if to.write_all(&bytes).is_err() {
                break;
            }
        }
        let _ = to.shutdown(Shutdown::Both);
    });
}

/// Runs a command quietly to its good end.
fn run(words: &[&str]) -> bool {
    let status = Command::new(words[0])
        .args(&words[1..])
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .status();
    status.is_ok_and(|status| status.success())
}

/// What can go wrong.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Fault {
    WorkerKilled(usize),
    WorkerStopped(usize),
    LinkCut(usize),
    LinkSlow(usize),
    CoordinatorKilled,
    CoordinatorStopped,
    ClientInterrupted,
    DiskFull,
    NoDescriptors,
}

impl Fault {
    fn random(random: &mut Rng) -> Self {
        let worker = random.usize(1..=WORKERS);
        match random.u8(0..14) {
            0..3 => Self::WorkerKilled(worker),
            3..6 => Self::WorkerStopped(worker),
            6..8 => Self::LinkCut(worker),
            8 => Self::LinkSlow(worker),
            9 => Self::CoordinatorKilled,
            10 => Self::CoordinatorStopped,
            11 => Self::ClientInterrupted,
            12 => Self::DiskFull,
            _ => Self::NoDescriptors,
        }
    }

    /// How long it lasts.
    fn duration(self, random: &mut Rng) -> Duration {
        let longest = match self {
            Self::WorkerKilled(_) | Self::CoordinatorKilled => 1000,
            Self::CoordinatorStopped => 3000,
            Self::ClientInterrupted => 1,
            _ => 7000,
        };
        Duration::from_millis(random.u64(0..longest))
    }

    /// Whether an order may fail for it: it has to end well for all others.
    fn excuses_a_failure(self) -> bool {
        matches!(self, Self::ClientInterrupted | Self::DiskFull | Self::NoDescriptors)
    }

    fn name(self) -> String {
        let name = format!("{self:?}");
        name.split('(').next().unwrap_or_default().to_owned()
    }
}

/// A farm, the client that always has an order there, and what is wrong at the moment.
struct Farm<'a> {
    place: &'a Place,
    networks: &'a Networks,
    expected: &'a [u8],
    random: Rng,
    started: Instant,
    coordinator: Option<Process>,
    workers: [Option<Process>; WORKERS + 1],
    client: Option<Process>,
    /// What is wrong, and when it is mended.
    faults: BTreeMap<Fault, Instant>,
    /// Whether the order in work may fail.
    is_excused: bool,
    /// How often the client in work was interrupted.
    interruptions: u32,
    /// How many faults of each kind there were.
    fault_counts: BTreeMap<String, u32>,
    pictures: u32,
    failures: u32,
}

impl Farm<'_> {
    fn start(&self, network: usize, log: &str, args: &[&str]) -> Process {
        let enter = self.networks.enter(network);
        let log = format!("{log}-{}.log", self.started.elapsed().as_millis());
        self.place.start_by(&enter, &log, args)
    }

    fn start_coordinator(&mut self) {
        let args = ["coordinator", "--insecure", "--listen", ADDRESS, "--state", "disk"];
        let mut coordinator = self.start(0, "coordinator", &args);
        let line = coordinator.read_line();
        assert!(line.starts_with("listening on"), "{line}{}", coordinator.log());
        self.coordinator = Some(coordinator);
    }

    fn start_worker(&mut self, worker: usize) {
        let address = if worker == FAR { FAR_ADDRESS } else { ADDRESS };
        let url = format!("http://{address}");
        let args = ["worker", "--threads", "1", "--coordinator", &url];
        self.workers[worker] = Some(self.start(worker, &format!("worker-{worker}"), &args));
    }

    fn start_client(&mut self) {
        let _ = fs::remove_file(self.place.path("out.png"));
        let url = format!("http://{ADDRESS}");
        let order = ["submit", "scene.rt", "-o", "out.png", "--coordinator", &url];
        self.client = Some(self.start(0, "submit", &[&order[..], &PICTURE].concat()));
        self.interruptions = 0;
        self.is_excused = self.faults.keys().any(|fault| fault.excuses_a_failure());
    }

    fn process(&self, fault: Fault) -> Option<&Process> {
        match fault {
            Fault::WorkerKilled(worker) | Fault::WorkerStopped(worker) => {
                self.workers[worker].as_ref()
            }
            Fault::ClientInterrupted => self.client.as_ref(),
            _ => self.coordinator.as_ref(),
        }
    }

    fn begin(&mut self, fault: Fault) {
        let is_same = |other: &Fault| other.name() == fault.name();
        if self.faults.keys().any(is_same) || self.process(fault).is_none() {
            return;
        }
        let duration = fault.duration(&mut self.random);
        eprintln!("{:6.1} s: {fault:?} for {duration:?}", self.started.elapsed().as_secs_f64());
        *self.fault_counts.entry(fault.name()).or_default() += 1;
        self.faults.insert(fault, Instant::now() + duration);
        self.is_excused |= fault.excuses_a_failure();
        match fault {
            Fault::WorkerKilled(worker) => self.workers[worker] = None,
            Fault::CoordinatorKilled => self.coordinator = None,
            Fault::WorkerStopped(_) | Fault::CoordinatorStopped => {
                self.process(fault).unwrap().signal(Signal::STOP);
            }
            Fault::ClientInterrupted => {
                self.interruptions += 1;
                self.process(fault).unwrap().signal(Signal::INT);
            }
            Fault::LinkCut(worker) => {
                self.networks.run(worker, "nft add table inet cut");
                for hook in ["input", "output"] {
                    let chain = format!(
                        "nft add chain inet cut {hook} {{ type filter hook {hook} priority 0; policy drop; }}"
                    );
                    self.networks.run(worker, &chain);
                }
            }
            Fault::LinkSlow(worker) => self.networks.run(
                worker,
                "tc qdisc add dev wire root tbf rate 400kbit burst 16kb latency 500ms",
            ),
            Fault::DiskFull => {
                let mut rest = File::create(self.place.path("disk/rest")).unwrap();
                while rest.write_all(&[1; 4096]).is_ok() {}
            }
            Fault::NoDescriptors => {
                let process = self.process(fault).unwrap().child.id();
                let open = fs::read_dir(format!("/proc/{process}/fd")).unwrap().count();
                set_descriptor_limit(process, open + 1);
            }
        }
    }

    fn mend(&mut self, fault: Fault) {
        self.faults.remove(&fault);
        match fault {
            // On a full disk no coordinator starts, and it says so.
            // On a full disk no coordinator starts.
            Fault::CoordinatorKilled if self.faults.contains_key(&Fault::DiskFull) => {
                self.faults.insert(fault, self.faults[&Fault::DiskFull]);
            }
            Fault::WorkerKilled(worker) => self.start_worker(worker),
            Fault::CoordinatorKilled => self.start_coordinator(),
            Fault::WorkerStopped(_) | Fault::CoordinatorStopped => {
                if let Some(process) = self.process(fault) {
                    process.signal(Signal::CONT);
                }
            }
            Fault::ClientInterrupted => {}
            Fault::LinkCut(worker) => self.networks.run(worker, "nft delete table inet cut"),
            Fault::LinkSlow(worker) => self.networks.run(worker, "tc qdisc del dev wire root"),
            Fault::DiskFull => fs::remove_file(self.place.path("disk/rest")).unwrap(),
            Fault::NoDescriptors => {
                if let Some(coordinator) = &self.coordinator {
                    set_descriptor_limit(coordinator.child.id(), 1024);
                }
            }
        }
    }

    /// Mends what is due, and looks at who has ended.
    fn look(&mut self) {
        let now = Instant::now();
        let due: Vec<Fault> =
            self.faults.iter().filter(|&(_, &end)| end <= now).map(|(&fault, _)| fault).collect();
        for fault in due {
            self.mend(fault);
        }
        for process in self.workers.iter_mut().chain([&mut self.coordinator]).flatten() {
            let ended = process.child.try_wait().unwrap();
            assert!(ended.is_none(), "{ended:?}: {}", process.log());
        }
        let Some(client) = &mut self.client else { return };
        let Some(status) = client.child.try_wait().unwrap() else { return };
        let log = client.log();
        let picture = fs::read(self.place.path("out.png"));
        if status.success() {
            assert!(picture.unwrap() == self.expected, "a wrong picture");
            self.pictures += 1;
        } else {
            eprintln!("{:6.1} s: {}", self.started.elapsed().as_secs_f64(), log.trim());
            assert!(self.is_excused, "{status}: {log}");
            assert!(picture.is_err(), "a picture of a failed order: {log}");
            let is_told =
                log.lines().any(|line| line.starts_with("error: ") || line == "interrupted");
            // A second interruption ends a client at once, without a word.
            let is_ended = self.interruptions > 1 && status.code() == Some(130);
            assert!(is_told || is_ended, "{status}: {log}");
            self.failures += 1;
        }
        self.client = None;
    }
}

/// How many descriptors a process may have.
fn set_descriptor_limit(process: u32, limit: usize) {
    let (process, limit) = (format!("--pid={process}"), format!("--nofile={limit}:4096"));
    assert!(run(&["prlimit", &process, &limit]), "{process} {limit}");
}

#[test]
#[ignore = "takes 30 s, or the seconds of RTFARM_FAULT_SECONDS, and root"]
fn pictures_come_out_the_same_under_faults() {
    let number = |name: &str, default| env::var(name).map_or(default, |text| text.parse().unwrap());
    let length = Duration::from_secs(number("RTFARM_FAULT_SECONDS", 30));
    let seed = number("RTFARM_SEED", 0);
    let Some(networks) = Networks::new() else {
        eprintln!("SKIPPED: only root can make networks, with ip, tc and nft");
        return;
    };
    networks.delay();
    let place = Place::new();
    let expected = place.render("here.png", &[&PICTURE[..], &["--workers", "0"]].concat());
    with_small_disk(&place, "16m", || {
        let mut farm = Farm {
            place: &place,
            networks: &networks,
            expected: &expected,
            random: Rng::with_seed(seed),
            started: Instant::now(),
            coordinator: None,
            workers: Default::default(),
            client: None,
            faults: BTreeMap::new(),
            is_excused: false,
            interruptions: 0,
            fault_counts: BTreeMap::new(),
            pictures: 0,
            failures: 0,
        };
        eprintln!("seed {seed}");
        farm.start_coordinator();
        (1..=WORKERS).for_each(|worker| farm.start_worker(worker));
        let mut next_fault = Instant::now();
        while farm.started.elapsed() < length {
            if Instant::now() >= next_fault {
                let fault = Fault::random(&mut farm.random);
                farm.begin(fault);
                next_fault += Duration::from_millis(farm.random.u64(200..1500));
            }
            farm.look();
            if farm.client.is_none() && farm.coordinator.is_some() {
                farm.start_client();
            }
            thread::sleep(Duration::from_millis(20));
        }
        // The disk before the coordinator.
        for fault in farm.faults.clone().into_keys().rev() {
            farm.mend(fault);
        }
        // The order in work ends, and one more ends well.
        for is_last in [false, true] {
            if is_last {
                farm.start_client();
            }
            let (begun, pictures) = (Instant::now(), farm.pictures);
            while farm.client.is_some() {
                assert!(begun.elapsed() < CALM, "{}", farm.client.as_ref().unwrap().log());
                farm.look();
                thread::sleep(Duration::from_millis(20));
            }
            assert!(!is_last || farm.pictures > pictures);
        }
        let mut coordinator = farm.coordinator.take().unwrap();
        coordinator.signal(Signal::TERM);
        assert_eq!(coordinator.wait().code(), Some(0), "{}", coordinator.log());
        for worker in farm.workers.iter_mut().flatten() {
            assert!(worker.wait().success(), "sent home: {}", worker.log());
        }
        let Farm { pictures, failures, fault_counts, .. } = &farm;
        eprintln!("{pictures} pictures, all the same; {failures} orders failed and said why");
        eprintln!("{fault_counts:?}");
    });
    place.check_nothing_is_left();
}
