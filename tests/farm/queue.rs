//! A farm's queue, as people use it.

use serde_json::Value;

use super::*;

/// A farm that keeps its state, started; and its address.
fn start_farm(place: &Place, listen: &str) -> (Process, String) {
    start_farm_with(place, listen, &[])
}

fn start_farm_with(place: &Place, listen: &str, more: &[&str]) -> (Process, String) {
    let args = [
        "coordinator",
        "--insecure",
        "--listen",
        listen,
        "--state",
        "state",
        "--lease-seconds",
        "2",
    ];
    let mut coordinator = place.start("coordinator.log", &[&args[..], more].concat());
    let line = coordinator.read_line();
    let url = line.trim().strip_prefix("listening on ").expect(&line).to_owned();
    (coordinator, url)
}

/// Runs a command to its end; answers with its exit code, what it printed and what it logged.
fn ask(place: &Place, url: &str, words: &[&str]) -> (Option<i32>, String, String) {
    let mut process = place.start("ask.log", &[words, &["--coordinator", url]].concat());
    let mut lines = String::new();
    loop {
        let line = process.read_line();
        if line.is_empty() {
            break;
        }
        lines.push_str(&line);
    }
    (process.wait().code(), lines, process.log())
}

/// Runs a command that answers in JSON to its good end.
fn json(place: &Place, url: &str, words: &[&str]) -> Value {
    let (code, answer, log) = ask(place, url, &[words, &["--json"]].concat());
    assert_eq!(code, Some(0), "{words:?}: {log}");
    serde_json::from_str(&answer).expect(&answer)
}

/// Submits a picture that goes on by itself; answers with its job's number.
fn detach(place: &Place, url: &str, words: &[&str]) -> String {
    let submit = ["submit", "scene.rt", "-o", "out.png", "--detach"];
    let (code, number, log) = ask(place, url, &[&submit, words].concat());
    assert_eq!(code, Some(0), "{log}");
    number.trim().to_owned()
}

/// What the list says of a job.
fn entry(place: &Place, url: &str, job: &str) -> Value {
    let jobs = json(place, url, &["jobs"]);
    let found = jobs.as_array().unwrap().iter().find(|entry| entry["job"] == *job);
    found.unwrap_or_else(|| panic!("{job} in {jobs}")).clone()
}

/// The numbers of the jobs in the order of the list.
fn order(place: &Place, url: &str) -> Vec<String> {
    let jobs = json(place, url, &["jobs"]);
    let numbers = jobs.as_array().unwrap().iter();
    numbers.map(|entry| entry["job"].as_str().unwrap().to_owned()).collect()
}

#[test]
fn people_can_live_with_the_queue() {
    let place = Place::new();
    let (mut coordinator, mut url) = start_farm(&place, &own_address());

    // Two jobs that nobody renders yet, one of them ordered twice under a key.
    let named = ["--name", "my picture", "--owner", "anna", "--max-workers", "2"];
    let first = detach(&place, &url, &[&ENDLESS[..], &named].concat());
    let second = detach(&place, &url, &[&ENDLESS[..], &["--key", "a key"]].concat());
    assert_eq!(detach(&place, &url, &[&ENDLESS[..], &["--key", "a key"]].concat()), second);
    assert_eq!(order(&place, &url), [&first[..], &second]);
    let of_first = entry(&place, &url, &first);
    assert_eq!(of_first["name"], "my picture");
    assert_eq!(of_first["owner"], "anna");
    assert_eq!(of_first["max_workers"], 2);
    assert_eq!(of_first["state"], "waiting");
    let table = ask(&place, &url, &["jobs"]).1;
    assert_eq!(table.lines().count(), 5, "{table}");
    assert!(table.ends_with(&format!("job {second} waits: the farm has no worker\n")), "{table}");

    assert_eq!(json(&place, &url, &["priority", &second, "5"])["priority"], 5);
    assert_eq!(order(&place, &url), [&second[..], &first]);
    assert_eq!(json(&place, &url, &["pause", &second])["paused"], true);
    let mut watch = place.start("watch.log", &["watch", &second, "--coordinator", &url]);
    let impatient = ["watch", &second, "--patience", "0.1", "--coordinator", &url];
    let mut impatient = place.start("impatient.log", &impatient);
    // Both hear of the job before its coordinator goes.
    for watch in [&watch, &impatient] {
        poll(|| watch.log().contains("the farm has no worker").then_some(()));
    }

    // All of it outlives the coordinator.
    coordinator.signal(Signal::KILL);
    coordinator.wait();
    assert_eq!(impatient.wait().code(), Some(1));
    assert!(impatient.log().contains("error: "), "{}", impatient.log());
    (coordinator, url) = start_farm(&place, url.strip_prefix("http://").unwrap());
    assert_eq!(order(&place, &url), [&second[..], &first]);
    let of_second = entry(&place, &url, &second);
    assert_eq!((&of_second["state"], &of_second["priority"]), (&"paused".into(), &5.into()));
    assert_eq!(entry(&place, &url, &first)["name"], "my picture");
    assert_eq!(detach(&place, &url, &[&ENDLESS[..], &["--key", "a key"]].concat()), second);

    // The paused one rests though it comes first; what there is of the other can be seen.
    let start = |log: &str| place.start(log, &["worker", "--threads", "1", "--coordinator", &url]);
    let mut worker = start("worker.log");
    poll(|| (entry(&place, &url, &first)["tiles_done"].as_u64() >= Some(3)).then_some(()));
    assert_eq!(entry(&place, &url, &second)["tiles_done"], 0);
    let (code, _, log) = ask(&place, &url, &["image", &first, "-o", "early.png"]);
    assert_eq!(code, Some(1));
    assert!(log.contains("the job has not finished"), "{log}");
    json(&place, &url, &["image", &first, "-o", "early.png", "--partial"]);
    let early = image::open(place.path("early.png")).unwrap();
    assert_eq!((early.width(), early.height()), (160, 120));
    json(&place, &url, &["cancel", &first]);
    assert_eq!(order(&place, &url), [&second[..]]);
    for unknown in [&["cancel", &first[..]][..], &["pause", &first], &["watch", &first]] {
        let (code, _, log) = ask(&place, &url, unknown);
        assert_eq!(code, Some(1), "{unknown:?}");
        assert!(log.contains("there is no such job"), "{log}");
    }

    json(&place, &url, &["resume", &second]);
    poll(|| (entry(&place, &url, &second)["tiles_done"].as_u64() > Some(0)).then_some(()));
    let workers = json(&place, &url, &["workers"]);
    let number = workers[0]["worker"].to_string();
    assert_eq!(json(&place, &url, &["drain", &number])["standing"], "draining");
    assert!(worker.wait().success(), "{}", worker.log());
    assert_eq!(json(&place, &url, &["workers"]), Value::Array(Vec::new()));
    assert!(watch.child.try_wait().unwrap().is_none(), "it is watched still");
    json(&place, &url, &["cancel", &second]);
    assert_eq!(watch.wait().code(), Some(1));
    assert!(watch.log().contains("the job failed: it was cancelled"), "{}", watch.log());

    // A worker that is disabled gets nothing, until it is enabled.
    let small = ["--size", "64x48", "--samples", "2"];
    let mut worker = start("worker.log");
    let number = poll(|| {
        let workers = json(&place, &url, &["workers"]);
        workers.get(0).map(|worker| worker["worker"].to_string())
    });
    json(&place, &url, &["disable", &number]);
    let third = detach(&place, &url, &small);
    thread::sleep(Duration::from_millis(300));
    assert_eq!(entry(&place, &url, &third)["state"], "waiting");
    json(&place, &url, &["enable", &number]);
    assert_eq!(json(&place, &url, &["watch", &third])["state"], "finished");
    let here = place.render("here.png", &[&small[..], &["--workers", "0"]].concat());
    json(&place, &url, &["image", &third, "-o", "kept.png", "--keep"]);
    json(&place, &url, &["image", &third, "-o", "out.png", "--sidecar"]);
    assert!(fs::read(place.path("out.png")).unwrap() == here);
    assert!(fs::read(place.path("kept.png")).unwrap() == here);
    verify::check_sidecar(&place, "out.png", 1);
    assert!(order(&place, &url).is_empty(), "it was fetched");
    worker.signal(Signal::TERM);
    worker.wait();
    coordinator.signal(Signal::TERM);
    coordinator.wait();
}

#[test]
fn a_scene_that_no_worker_can_hold_waits_and_its_owner_is_told() {
    let place = Place::new();
    let (_coordinator, url) = start_farm(&place, "127.0.0.1:0");
    let tiny = ["worker", "--threads", "1", "--memory", "0.0000001", "--coordinator", &url];
    let _tiny = place.start("tiny.log", &tiny);
    let submit = ["submit", "scene.rt", "-o", "out.png", "--coordinator", &url];
    let small = ["--size", "64x48", "--samples", "2"];
    let mut submit = place.start("submit.log", &[&submit[..], &small].concat());
    poll(|| submit.log().contains("no worker can hold its scene of ").then_some(()));
    let told = ask(&place, &url, &["jobs"]).1;
    assert!(told.contains(" waits: no worker can hold its scene of "), "{told}");
    let worker = ["worker", "--threads", "1", "--coordinator", &url];
    let _worker = place.start("worker.log", &worker);
    assert!(submit.wait().success(), "{}", submit.log());
}

#[test]
fn a_tile_that_ends_three_workers_is_set_aside_the_others_finished_and_it_is_tried_again() {
    let place = Place::new();
    // Workers that compare its other tile would die of that one.
    let no_audit = ["--audit", "0"];
    let (mut coordinator, mut url) = start_farm_with(&place, &own_address(), &no_audit);
    let start = || place.start("worker.log", &["worker", "--threads", "1", "--coordinator", &url]);
    let two_tiles = ["--size", "96x48", "--tile", "48", "--samples", "1024"];
    let job = detach(&place, &url, &two_tiles);
    for _ in 0..3 {
        let worker = start();
        let is_in_work = |entry: Value| entry["workers_now"] == 1 && entry["tiles_done"] == 1;
        poll(|| is_in_work(entry(&place, &url, &job)).then_some(()));
        worker.signal(Signal::KILL);
        poll(|| (entry(&place, &url, &job)["workers_now"] == 0).then_some(()));
    }
    let (code, _, log) = ask(&place, &url, &["watch", &job]);
    assert_eq!(code, Some(1));
    assert!(log.contains("the job failed: 1 of 2 tiles are right; set aside"), "{log}");
    coordinator.signal(Signal::TERM);
    assert!(coordinator.wait().success());
    (coordinator, url) = start_farm_with(&place, url.strip_prefix("http://").unwrap(), &no_audit);
    assert_eq!(entry(&place, &url, &job)["state"], "failed");
    json(&place, &url, &["retry", &job]);
    let _worker = place.start("worker.log", &["worker", "--threads", "1", "--coordinator", &url]);
    assert_eq!(json(&place, &url, &["watch", &job])["state"], "finished");
    json(&place, &url, &["image", &job, "-o", "out.png"]);
    let here = place.render("here.png", &[&two_tiles[..], &["--workers", "0"]].concat());
    assert!(fs::read(place.path("out.png")).unwrap() == here);
    coordinator.signal(Signal::TERM);
    coordinator.wait();
}

#[test]
fn what_became_of_a_tile_is_explained_and_what_happened_is_told_in_lines_of_json() {
    let place = Place::new();
    let (mut coordinator, url) =
        start_farm_with(&place, &own_address(), &["--events", "events.jsonl", "--audit", "0"]);
    let job = detach(&place, &url, &["--size", "64x48", "--samples", "4096", "--tile", "16"]);
    // Nobody is there, and who waits is told.
    let entry = entry(&place, &url, &job);
    assert_eq!(entry["obstacle"], "the farm has no worker");
    let (_, _, log) = ask(&place, &url, &["explain", &job, "12"]);
    assert!(log.contains("the job has the tiles 0 to 11"), "{log}");
    let open = json(&place, &url, &["explain", &job, "5"]);
    assert_eq!((&open["state"], &open["attempts"]), (&"open".into(), &Value::Array(vec![])));
    let mut watch = place.start("watch.log", &["watch", &job, "--coordinator", &url]);
    poll(|| watch.log().contains("the farm has no worker").then_some(()));

    let worker = ["worker", "--threads", "1", "--coordinator", &url];
    let mut first = place.start("first.log", &worker);
    poll(|| (coordinator.workers().len() == 1).then_some(()));
    // A tile in work when its worker is killed.
    let lost = poll(|| {
        let tiles =
            (0..12).map(|tile: u32| json(&place, &url, &["explain", &job, &tile.to_string()]));
        tiles.into_iter().find(|tile| tile["state"] == "in work")
    });
    first.signal(Signal::KILL);
    first.wait();
    let tile = lost["tile"].to_string();
    poll(|| {
        let told = json(&place, &url, &["explain", &job, &tile]);
        (told["attempts"][0]["lost"] == "no progress for 2.0 s" || told["state"] == "done")
            .then_some(())
    });
    let _second = place.start("second.log", &worker);
    assert!(watch.wait().success(), "{}", watch.log());

    let events = poll(|| {
        let events = fs::read_to_string(place.path("events.jsonl")).unwrap();
        events.contains("job finished").then_some(events)
    });
    let events: Vec<Value> =
        events.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    let of = |name: &str| events.iter().filter(|event| event["event"] == name).collect::<Vec<_>>();
    assert_eq!(of("job started")[0]["job"], job.as_str());
    assert_eq!((of("worker joined").len(), of("tile done").len()), (2, 12));
    assert!(events.iter().all(|event| event["time"].as_f64().unwrap() > 1.7e9));
    for done in of("tile done") {
        let told = json(&place, &url, &["explain", &job, &done["tile"].to_string()]);
        for field in ["worker", "hash", "seconds", "rays", "samples"] {
            assert_eq!(told[field], done[field], "{field}: {told}");
        }
        let attempts = told["attempts"].as_array().unwrap();
        let won: Vec<&Value> =
            attempts.iter().filter(|attempt| attempt["in_picture"] == true).collect();
        assert_eq!((won.len(), &won[0]["worker"]), (1, &done["worker"]), "{told}");
    }
    let (_, text, _) = ask(&place, &url, &["explain", &job, &tile]);
    assert!(text.contains("rendered by worker ") && text.contains("\nhash "), "{text}");

    // Another start of the coordinator knows what is in the picture.
    let before = json(&place, &url, &["explain", &job, "3"]);
    coordinator.signal(Signal::TERM);
    coordinator.wait();
    let (_coordinator, url) = start_farm(&place, url.strip_prefix("http://").unwrap());
    let after = json(&place, &url, &["explain", &job, "3"]);
    assert_eq!((&after["hash"], &after["state"]), (&before["hash"], &"done".into()));
    assert_eq!((&after["worker"], &after["attempts"]), (&Value::Null, &Value::Array(vec![])));
}
