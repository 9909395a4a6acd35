//! A farm that others can reach: who may come, and what becomes of those who may not.

use std::{
    io::{ErrorKind, Read, Write},
    os::unix::fs::PermissionsExt,
};

use rtfarm_proto::{
    Access, CHUNK_BYTES, MESSAGE_BYTES,
    wire::{self, farm_client::FarmClient, jobs_client::JobsClient},
};

use super::*;

/// A farm with certificates and tokens, started; and its address.
fn start_farm(place: &Place) -> (Process, String) {
    let args = ["coordinator", "--listen", "127.0.0.1:0", "--state", "farm"];
    let limits = ["--strangers", "4", "--greeting-seconds", "3", "--handshake-seconds", "3"];
    let mut coordinator = place.start("coordinator.log", &[&args[..], &limits].concat());
    let line = coordinator.read_line();
    let url = line.trim().strip_prefix("listening on ").expect(&line).to_owned();
    assert!(url.starts_with("https://127.0.0.1:"), "{url}");
    (coordinator, url)
}

/// Runs a command to its end; answers with its exit code and what it said.
fn ask(place: &Place, words: &[&str]) -> (Option<i32>, String) {
    let mut process = place.start("ask.log", words);
    let code = process.wait().code();
    let mut said = process.log();
    process.stdout.as_mut().unwrap().read_to_string(&mut said).unwrap();
    (code, said)
}

/// Has those who have tokens send messages that are too long.
fn flood(place: &Place) -> thread::JoinHandle<()> {
    let [work, submit] = ["work", "submit"].map(|role| {
        let access = place.path("farm/access").join(role);
        Access::read(&fs::read_to_string(access).unwrap()).unwrap()
    });
    thread::spawn(move || {
        let runtime = tokio::runtime::Runtime::new().unwrap();
        runtime.block_on(async {
            let mut client = JobsClient::new(submit.connect().await.unwrap());
            for length in [CHUNK_BYTES + (1 << 16), MESSAGE_BYTES] {
                let part = Some(wire::submit_request::Part::Text(vec![0; length].into()));
                let stream = tokio_stream::iter([wire::SubmitRequest { part }]);
                let status = client.submit(stream).await.unwrap_err();
                assert!(status.message().contains("message length too large"), "{status}");
            }
            let mut client = FarmClient::new(work.connect().await.unwrap());
            for length in [MESSAGE_BYTES, 2 * MESSAGE_BYTES, 8 * MESSAGE_BYTES] {
                let pixels = vec![0; length].into();
                let tiles = vec![wire::FinishedTile { pixels, ..Default::default() }];
                let request = wire::DeliverRequest { tiles, ..Default::default() };
                let status = client.deliver(request).await.unwrap_err();
                assert!(status.message().contains("message length too large"), "{status}");
            }
        });
    })
}

#[test]
fn orders_have_a_budget_which_the_token_of_those_who_look_after_the_farm_exceeds() {
    let place = Place::new();
    let args = ["coordinator", "--listen", "127.0.0.1:0", "--state", "farm"];
    let limits = ["--most-jobs", "1", "--most-megapixels", "0.01", "--most-gb", "0.001"];
    let mut coordinator = place.start("coordinator.log", &[&args[..], &limits].concat());
    coordinator.read_line();
    let order = |role: &str, size: &str| {
        let access = format!("farm/access/{role}");
        let words = ["submit", "scene.rt", "-o", "out.exr", "--detach", "--size", size];
        ask(&place, &[&words[..], &["--access", &access]].concat())
    };
    for (size, reason) in [("200x100", "it has 20000 pixels, and may have 10000"), ("64x64", "")] {
        let (code, said) = order("submit", size);
        assert_eq!((code == Some(0), said.contains(reason)), (reason.is_empty(), true), "{said}");
    }
    let (code, said) = order("submit", "8x8");
    assert!(code == Some(2) && said.contains("there is 1 job already"), "{said}");
    for (owner, shown) in [("", "''"), (&*"o".repeat(5000), "'oooo"), ("a b", "'a b'")] {
        let words = ["submit", "scene.rt", "-o", "out.exr", "--access", "farm/access/submit"];
        let (code, said) = ask(&place, &[&words[..], &["--owner", owner]].concat());
        let is_told = said.contains(shown) && said.contains("no owner's name");
        assert!(code == Some(2) && is_told && said.len() < 500, "{said}");
    }
    assert_eq!(order("admin", "400x300").0, Some(0));
}

#[test]
fn an_owner_at_the_limit_stops_no_other_and_jobs_are_those_of_the_tokens_owner() {
    let place = Place::new();
    let args = ["coordinator", "--listen", "127.0.0.1:0", "--state", "farm", "--most-jobs", "1"];
    let mut coordinator = place.start("coordinator.log", &args);
    let line = coordinator.read_line();
    let tokens = |words: &[&str]| ask(&place, &[&["tokens"], words, &["--state", "farm"]].concat());
    for owner in ["ada", "bo"] {
        let (code, said) = tokens(&["renew", "submit", "--owner", owner]);
        assert_eq!((code, said), (Some(0), format!("farm/access/submit.{owner}\n")));
    }
    for (owner, role, reason) in
        [("a/b", "submit", "no owner's name"), ("ada", "work", "not to work")]
    {
        let (code, said) = tokens(&["renew", role, "--owner", owner]);
        assert!(code == Some(2) && said.contains(reason), "{said}");
    }
    // A token that is new is known within a second.
    poll(|| {
        ask(&place, &["jobs", "--access", "farm/access/submit.bo"]).0.filter(|code| *code == 0)
    });
    let order = |holder: &str, owner: &[&str]| {
        let access = format!("farm/access/{holder}");
        let words = ["submit", "scene.rt", "-o", "out.png", "--size", "8x6", "--detach"];
        ask(&place, &[&words[..], &["--access", &access], owner].concat())
    };
    assert_eq!(order("submit.ada", &["--owner", "bo"]).0, Some(0));
    let (code, said) = order("submit.ada", &[]);
    let reason = "the farm takes no more of ada for now: there is 1 job already, and may be 1";
    assert!(code == Some(2) && said.contains(reason), "{said}");
    for holder in ["submit.bo", "submit"] {
        let (code, said) = order(holder, &["--owner", "ada"]);
        assert_eq!(code, Some(0), "{said}");
        assert_eq!(order(holder, &[]).0, Some(2), "{holder}: that is one job of theirs");
    }
    // Whose it is outlives the coordinator.
    coordinator.child.kill().unwrap();
    coordinator.wait();
    let port = line.trim().rsplit(':').next().unwrap().to_owned();
    let listen = format!("127.0.0.1:{port}");
    let again = ["coordinator", "--listen", &listen, "--state", "farm", "--most-jobs", "1"];
    let mut coordinator = place.start("again.log", &again);
    coordinator.read_line();
    assert_eq!(order("submit.ada", &[]).0, Some(2));
    let (_, listed) = ask(&place, &["jobs", "--json", "--access", "farm/access/read"]);
    let jobs: serde_json::Value = serde_json::from_str(&listed).unwrap();
    let mut owners: Vec<&str> =
        jobs.as_array().unwrap().iter().map(|job| job["owner"].as_str().unwrap()).collect();
    owners.sort_unstable();
    // Who has no token of their own may call themselves anything, at nobody's expense.
    assert_eq!(owners, ["ada", "ada", "bo"]);
    fs::copy(place.path("farm/access/submit.ada"), place.path("farm/access/copy")).unwrap();
    let (code, said) = tokens(&["revoke", "submit", "--owner", "adda"]);
    assert!(code == Some(2) && said.contains("adda has no token; ada and bo have"), "{said}");
    assert_eq!(tokens(&["revoke", "submit", "--owner", "ada"]).0, Some(0));
    assert!(!place.path("farm/access/submit.ada").exists());
    poll(|| order("copy", &[]).1.contains("the token is not known").then_some(()));
}

#[test]
fn a_job_is_changed_by_its_owners_token_and_by_who_looks_after_the_farm() {
    let place = Place::new();
    let (_coordinator, _) = start_farm(&place);
    for owner in ["ada", "bo"] {
        let words = ["tokens", "renew", "submit", "--owner", owner, "--state", "farm"];
        assert_eq!(ask(&place, &words).0, Some(0));
    }
    let by = |holder: &str, words: &[&str]| {
        let access = format!("farm/access/{holder}");
        ask(&place, &[words, &["--access", &access]].concat())
    };
    poll(|| by("submit.bo", &["jobs"]).0.filter(|code| *code == 0));
    let order = ["submit", "scene.rt", "-o", "out.png", "--size", "8x6", "--detach"];
    for (holder, others, whose) in [
        ("submit.ada", ["submit.bo", "submit"], "the token of ada"),
        ("submit", ["submit.bo", "submit.ada"], "a token without an owner"),
    ] {
        let order = || {
            let (code, job) = by(holder, &order);
            assert_eq!(code, Some(0), "{job}");
            job.trim().to_owned()
        };
        let job = &*order();
        let changes = [
            vec!["pause", job],
            vec!["priority", job, "5"],
            vec!["resume", job],
            vec!["retry", job],
            vec!["cancel", job],
        ];
        for change in &changes {
            for other in others {
                let (code, said) = by(other, change);
                let reason = format!("job {job} was ordered by {whose}; only such a token and one");
                assert!(code == Some(1) && said.contains(&reason), "{other} {change:?}: {said}");
                assert!(by(other, &["jobs"]).1.contains(job), "others see it");
            }
        }
        for holder in [holder, "admin"] {
            let job = &*order();
            for change in [vec!["pause", job], vec!["priority", job, "5"], vec!["cancel", job]] {
                let (code, said) = by(holder, &change);
                assert_eq!(code, Some(0), "{holder} {change:?}: {said}");
            }
        }
    }
}

#[test]
fn a_key_is_its_accounts_own_and_stands_for_one_order() {
    let place = Place::new();
    let (_coordinator, _) = start_farm(&place);
    for owner in ["ada", "bo"] {
        let words = ["tokens", "renew", "submit", "--owner", owner, "--state", "farm"];
        assert_eq!(ask(&place, &words).0, Some(0));
    }
    poll(|| {
        ask(&place, &["jobs", "--access", "farm/access/submit.bo"]).0.filter(|code| *code == 0)
    });
    let order = |holder: &str, more: &[&str]| {
        let access = format!("farm/access/{holder}");
        let words = ["submit", "-o", "out.png", "--detach", "--key", "k1", "--access", &access];
        ask(&place, &[&words[..], more].concat())
    };
    let scene = ["scene.rt", "--size", "8x6"];
    let of_ada = order("submit.ada", &scene);
    assert_eq!(of_ada.0, Some(0), "{}", of_ada.1);
    assert_eq!(
        order("submit.ada", &[&scene[..], &["--name", "b", "--priority", "1"]].concat()),
        of_ada
    );
    for holder in ["submit.bo", "submit"] {
        let of_other = order(holder, &scene);
        assert!(of_other.0 == Some(0) && of_other.1 != of_ada.1, "{holder}: {}", of_other.1);
    }
    fs::write(place.path("other.rt"), scene_text().replace("20 30 40", "30 30 40")).unwrap();
    for other in [
        vec!["scene.rt", "--size", "8x8"],
        vec!["other.rt", "--size", "8x6"],
        [&scene[..], &["--samples", "2"]].concat(),
    ] {
        let (code, said) = order("submit.ada", &other);
        let reason = format!("job {} has the key `k1` and is another order", of_ada.1.trim());
        assert!(code == Some(1) && said.contains(&reason), "{other:?}: {code:?} {said}");
    }
}

#[test]
fn a_farm_serves_those_who_have_a_token_while_others_storm_it() {
    let place = Place::new();
    let (mut coordinator, url) = start_farm(&place);
    let address = url.strip_prefix("https://").unwrap().to_owned();
    let picture = ["--size", "96x64", "--samples", "128", "--tile", "8"];
    let here = place.render("here.png", &[&picture[..], &["--workers", "0"]].concat());
    let worker = ["worker", "--threads", "1", "--access", "farm/access/work"];
    let mut workers = [place.start("a.log", &worker), place.start("b.log", &worker)];
    let submit = ["submit", "scene.rt", "-o", "out.png", "--access", "farm/access/submit"];
    let mut submit = place.start("submit.log", &[&submit[..], &picture].concat());

    // Some say nothing, some dribble, some talk nonsense, some more than anybody wants to hear.
    let storm: Vec<_> = (0..12)
        .map(|number| {
            let address = address.clone();
            thread::spawn(move || {
                let Ok(mut stream) = TcpStream::connect(&address) else { return };
                stream.set_read_timeout(Some(PATIENCE)).unwrap();
                for byte in 0..8 {
                    let said = match number % 4 {
                        0 => Ok(()),
                        1 => stream.write_all(&[0x16]),
                        2 => stream.write_all(b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n"),
                        _ => stream.write_all(&vec![byte; 1 << 20]),
                    };
                    if said.is_err() {
                        return;
                    }
                    thread::sleep(Duration::from_millis(50));
                }
                // It is sent away: this ends before its patience does.
                let end = stream.read_to_end(&mut Vec::new()).map_err(|error| error.kind());
                assert_ne!(end, Err(ErrorKind::WouldBlock), "{number} is still there");
            })
        })
        .collect();
    let flood = flood(&place);
    assert!(submit.wait().success(), "{}", submit.log());
    assert!(fs::read(place.path("out.png")).unwrap() == here);
    flood.join().unwrap();
    for stranger in storm {
        stranger.join().unwrap();
    }

    let secrets: Vec<String> = ["work", "submit", "read", "admin"]
        .map(|role| fs::read_to_string(place.path(&format!("farm/access/{role}"))).unwrap())
        .iter()
        .map(|text| text.lines().find_map(|line| line.strip_prefix("token ")).unwrap().to_owned())
        .collect();
    coordinator.signal(Signal::TERM);
    assert_eq!(coordinator.wait().code(), Some(0), "{}", coordinator.log());
    for worker in &mut workers {
        assert!(worker.wait().success(), "sent home: {}", worker.log());
        assert!(!secrets.iter().any(|secret| worker.log().contains(secret)));
    }
    assert!(!secrets.iter().any(|secret| coordinator.log().contains(secret)));
    place.check_nothing_is_left();
}

#[test]
fn who_has_no_token_or_that_of_another_role_or_farm_is_refused_and_told_why() {
    let place = Place::new();
    let (_coordinator, url) = start_farm(&place);
    let other = Place::new();
    let (_other, _) = start_farm(&other);
    let foreign = fs::read(other.path("farm/access/admin")).unwrap();
    let keep = |name: &str, text: &[u8], mode: u32| {
        fs::write(place.path(name), text).unwrap();
        fs::set_permissions(place.path(name), fs::Permissions::from_mode(mode)).unwrap();
    };
    let submit = fs::read_to_string(place.path("farm/access/submit")).unwrap();
    keep("foreign", &foreign, 0o600);
    keep("open", submit.as_bytes(), 0o644);
    keep("guess", submit.replace("token ", "token 0").as_bytes(), 0o600);
    keep("nonsense", b"hello", 0o600);
    let of = |name: &str| format!("farm/access/{name}");
    let order = ["submit", "scene.rt", "-o", "out.png", "--size", "32x32", "--access"];
    for (words, code, reason) in [
        (vec!["jobs", "--access", &of("work")], 1, "the token is one to work"),
        (vec!["drain", "1", "--access", &of("submit")], 1, "the token is one to submit"),
        (vec!["cancel", "1", "--access", &of("read")], 1, "the token is one to read"),
        (vec!["jobs", "--access", "guess"], 1, "the token is not known"),
        (vec!["jobs", "--access", "open"], 2, "others may read it; chmod 600"),
        (vec!["jobs", "--access", "nonsense"], 2, "it is no access file of a farm"),
        (vec!["jobs", "--access", "nowhere"], 2, "No such file"),
        (vec!["jobs"], 2, "--access FILE"),
        (vec!["jobs", "--coordinator", &url], 1, "needs an access file"),
        ([&order[..], &[&of("read")]].concat(), 1, "the token is one to read"),
        (vec!["worker", "--access", &of("submit")], 1, "the token is one to submit"),
        // Another farm's coordinator, and one that shows no certificate.
        (
            vec!["jobs", "--access", "foreign", "--coordinator", &url],
            1,
            "no coordinator answers at",
        ),
        (vec!["jobs", "--coordinator", &url.replace("https", "http")], 1, "error: "),
    ] {
        let (found, said) = ask(&place, &words);
        assert_eq!(found, Some(code), "{words:?}: {said}");
        assert!(said.contains(reason), "{words:?}: {said}");
    }
    for role in ["submit", "read", "admin"] {
        let (code, said) = ask(&place, &["jobs", "--access", &of(role)]);
        assert_eq!(code, Some(0), "{role}: {said}");
    }

    // A token that is renewed is another at once, and its successor is good.
    let (code, said) = ask(&place, &["tokens", "renew", "submit", "--state", "farm"]);
    assert_eq!((code, said.trim()), (Some(0), "farm/access/submit"));
    keep("old", submit.as_bytes(), 0o600);
    thread::sleep(Duration::from_millis(1100));
    let (code, said) = ask(&place, &["jobs", "--access", "old"]);
    assert!(code == Some(1) && said.contains("not any more"), "{said}");
    assert_eq!(ask(&place, &["jobs", "--access", &of("submit")]).0, Some(0));
    assert_eq!(ask(&place, &["tokens", "revoke", "read", "--state", "farm"]).0, Some(0));
    check_refused(
        &place,
        &["tokens", "renew", "read", "--state", "tmp"],
        2,
        "there are no tokens in",
    );
}

#[test]
fn a_coordinator_that_comes_back_elsewhere_is_found_again_by_those_who_have_its_access_files() {
    let place = Place::new();
    let start = |log: &str| {
        let listen = own_address();
        let args = ["coordinator", "--listen", &listen, "--state", "farm"];
        let mut coordinator = place.start(log, &args);
        assert!(coordinator.read_line().ends_with(&format!("{listen}\n")));
        coordinator
    };
    let mut first = start("first.log");
    let worker = ["worker", "--threads", "1", "--access", "farm/access/work"];
    let mut worker = place.start("worker.log", &worker);
    let submit = ["submit", "scene.rt", "-o", "out.png", "--access", "farm/access/submit"];
    let mut submit = place.start("submit.log", &[&submit[..], &SLOW].concat());
    poll(|| (first.tiles_done() >= 10).then_some(()));
    first.signal(Signal::KILL);
    first.wait();
    let mut second = start("second.log");
    assert!(submit.wait().success(), "{}", submit.log());
    assert!(second.tiles_done() > 0);
    second.signal(Signal::TERM);
    assert_eq!(second.wait().code(), Some(0), "{}", second.log());
    assert!(worker.wait().success(), "sent home: {}", worker.log());
    let here = place.render("here.png", &[&SLOW[..], &["--workers", "0"]].concat());
    assert!(fs::read(place.path("out.png")).unwrap() == here);
}

#[test]
fn certificates_made_before_are_those_of_the_coordinator() {
    let place = Place::new();
    let certs = ["certs", "--state", "farm", "--name", "renderhost", "--port", "7"];
    assert_eq!(ask(&place, &certs), (Some(0), "farm/access\n".to_owned()));
    let made = fs::read_to_string(place.path("farm/access/read")).unwrap();
    assert!(made.contains("address https://renderhost:7\n"), "{made}");
    check_refused(&place, &["certs", "--state", "farm", "--name", "a b"], 2, "");
    let (_coordinator, url) = start_farm(&place);
    fs::write(place.path("read"), made).unwrap();
    fs::set_permissions(place.path("read"), fs::Permissions::from_mode(0o600)).unwrap();
    let (code, said) = ask(&place, &["jobs", "--access", "read", "--coordinator", &url]);
    assert_eq!(code, Some(0), "{said}");
}

#[test]
fn a_socket_in_a_folder_of_ones_own_needs_no_token_and_another_is_refused() {
    let place = Place::new();
    fs::create_dir(place.path("own")).unwrap();
    fs::set_permissions(place.path("own"), fs::Permissions::from_mode(0o755)).unwrap();
    let listen = ["coordinator", "--listen", "unix:own/socket"];
    check_refused(&place, &listen, 2, "others may enter own");
    for open in ["127.0.0.1:0", "[::1]:0", "0.0.0.0:0"] {
        check_refused(
            &place,
            &["coordinator", "--listen", open],
            2,
            "--state DIR keeps certificates",
        );
    }
    fs::set_permissions(place.path("own"), fs::Permissions::from_mode(0o700)).unwrap();
    let mut coordinator = place.start("coordinator.log", &listen);
    assert_eq!(coordinator.read_line().trim(), "listening on unix:own/socket");
    let (code, said) = ask(&place, &["jobs", "--coordinator", "unix:own/socket"]);
    assert_eq!(code, Some(0), "{said}");
    coordinator.signal(Signal::TERM);
    assert_eq!(coordinator.wait().code(), Some(0));
}

#[test]
fn a_page_from_elsewhere_cannot_have_a_browser_call_a_farm_that_asks_for_nothing() {
    let place = Place::new();
    let listen = ["coordinator", "--listen", "127.0.0.1:0", "--insecure"];
    let mut coordinator = place.start("coordinator.log", &listen);
    let line = coordinator.read_line();
    let address = line.trim().strip_prefix("listening on http://").unwrap().to_owned();
    let ask = |head: &str| {
        let mut stream = TcpStream::connect(&address).unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        write!(stream, "{head}\r\nConnection: close\r\n\r\n").unwrap();
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer).unwrap();
        String::from_utf8_lossy(&answer).to_lowercase()
    };
    let page = ask("GET / HTTP/1.1\r\nHost: 127.0.0.1:1");
    assert!(page.starts_with("http/1.1 200 ") && page.contains("<!doctype html>"), "{page}");
    let foreign = ask("GET / HTTP/1.1\r\nHost: evil.example");
    assert!(foreign.starts_with("http/1.1 421 "), "{foreign}");
    // A browser sends this for a page of anybody's, without asking first.
    let call = "POST /rtfarm.v1.Jobs/List HTTP/1.1\r\nHost: 127.0.0.1\r\n\
                Origin: http://evil.example\r\nContent-Type: text/plain\r\nContent-Length: 0";
    let called = ask(call);
    assert!(called.contains("grpc-status: 9") && called.contains("http/2"), "{called}");
    assert!(!called.contains("access-control"), "{called}");
}
