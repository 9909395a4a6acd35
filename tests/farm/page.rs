//! The page on which a farm is watched, in a real browser: Chromium without a screen, steered by
//! chromedriver. Screenshots go into `target/page`, to be looked at.

use std::io::{self, Read, Write};

use serde_json::{Value, json};

use super::*;

/// Chromium, which chromedriver steers by HTTP (W3C, "`WebDriver`").
struct Browser {
    driver: Child,
    port: u16,
    session: String,
}

impl Drop for Browser {
    fn drop(&mut self) {
        // The browser ends with its session; else it would outlive its driver, and the test.
        let _ = self.try_call("DELETE", "", &Value::Null);
        let _ = kill_process(pid(self.driver.id()), Signal::TERM);
        for _ in 0..100 {
            if !matches!(self.driver.try_wait(), Ok(None)) {
                return;
            }
            thread::sleep(Duration::from_millis(20));
        }
        let _ = self.driver.kill();
        let _ = self.driver.wait();
    }
}

impl Browser {
    /// `None` where there is no chromedriver.
    fn start() -> Option<Self> {
        let mut driver = Command::new("chromedriver")
            .arg("--port=0")
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .ok()?;
        let lines = BufReader::new(driver.stdout.take().unwrap()).lines();
        let mut ports = lines.map_while(Result::ok).filter_map(|line| {
            let port = line.split_once("started successfully on port ")?.1;
            port.trim_end_matches('.').parse().ok()
        });
        let port = ports.next().expect("chromedriver tells its port");
        // What it says further is read, so that it never waits.
        thread::spawn(move || ports.count());
        let mut browser = Self { driver, port, session: String::new() };
        let options = json!({ "args": ["--headless=new", "--no-sandbox", "--disable-gpu"] });
        let wanted = json!({
            "goog:chromeOptions": options, "goog:loggingPrefs": { "browser": "ALL" },
            "acceptInsecureCerts": true,
        });
        let session = json!({ "capabilities": { "alwaysMatch": wanted } });
        let answer = browser.call("POST", "", &session);
        browser.session = format!("/{}", answer["sessionId"].as_str().expect("a session"));
        Some(browser)
    }

    fn call(&self, method: &str, path: &str, body: &Value) -> Value {
        let answer = self.try_call(method, path, body).unwrap();
        assert!(answer["value"]["error"].is_null(), "{method} {path}: {answer}");
        answer["value"].clone()
    }

    fn try_call(&self, method: &str, path: &str, body: &Value) -> io::Result<Value> {
        let mut stream = TcpStream::connect(("127.0.0.1", self.port))?;
        stream.set_read_timeout(Some(PATIENCE))?;
        let body = if body.is_null() { String::new() } else { body.to_string() };
        let (session, length) = (&self.session, body.len());
        write!(
            stream,
            "{method} /session{session}{path} HTTP/1.1\r\nHost: 127.0.0.1\r\n\
             Content-Length: {length}\r\nConnection: close\r\n\r\n{body}"
        )?;
        let (mut answer, mut line) = (BufReader::new(stream), "head".to_owned());
        let mut length = 0;
        while !line.trim().is_empty() {
            line.clear();
            answer.read_line(&mut line)?;
            let (name, value) = line.split_once(':').unwrap_or_default();
            if name.eq_ignore_ascii_case("content-length") {
                length = value.trim().parse().unwrap_or_default();
            }
        }
        let mut body = vec![0; length];
        answer.read_exact(&mut body)?;
        Ok(serde_json::from_slice(&body)?)
    }

    fn go(&self, address: &str) {
        self.call("POST", "/url", &json!({ "url": address }));
    }

    /// What an expression on the page comes to.
    fn ask(&self, expression: &str) -> Value {
        let script = format!("return ({expression});");
        self.call("POST", "/execute/sync", &json!({ "script": script, "args": [] }))
    }

    fn command(&self, command: &str, params: &Value) {
        let body = json!({ "cmd": command, "params": params });
        self.call("POST", "/goog/cdp/execute", &body);
    }

    /// Takes pictures of the page: light and dark, wide and narrow.
    fn take_pictures(&self, name: &str) {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("target/page");
        fs::create_dir_all(&folder).unwrap();
        for theme in ["light", "dark"] {
            let feature = json!([{ "name": "prefers-color-scheme", "value": theme }]);
            self.command("Emulation.setEmulatedMedia", &json!({ "features": feature }));
            for (form, width, height) in [("wide", 1280, 800), ("narrow", 390, 844)] {
                let size = json!({
                    "width": width, "height": height, "deviceScaleFactor": 1,
                    "mobile": form == "narrow",
                });
                self.command("Emulation.setDeviceMetricsOverride", &size);
                assert!(
                    self.ask("document.documentElement.scrollWidth <= innerWidth") == true,
                    "{form}: nothing stands beside the screen"
                );
                let shot = json!({ "cmd": "Page.captureScreenshot", "params": {} });
                let shot = self.call("POST", "/goog/cdp/execute", &shot);
                let path = folder.join(format!("{name}-{theme}-{form}.png"));
                fs::write(path, from_base64(shot["data"].as_str().unwrap())).unwrap();
            }
        }
    }

    /// The canvas's pixels: red, green, blue and how opaque they are.
    fn pixels(&self) -> Vec<u8> {
        let pixels = self.ask(
            "(() => { const canvas = document.getElementById('picture');
                const data = canvas.getContext('2d')
                    .getImageData(0, 0, canvas.width, canvas.height).data;
                let text = '';
                for (const byte of data) text += String.fromCharCode(byte);
                return btoa(text); })()",
        );
        from_base64(pixels.as_str().unwrap())
    }

    fn text_of(&self, id: &str) -> String {
        self.ask(&format!("document.getElementById('{id}').textContent")).as_str().unwrap().into()
    }

    /// The page broke none of the rules that it came with, and nothing else went wrong.
    fn check_no_complaint(&self) {
        let log = self.call("POST", "/se/log", &json!({ "type": "browser" }));
        let complaints = log.as_array().unwrap().iter().filter(|line| {
            let text = line["message"].as_str().unwrap();
            // It asks for a picture of the farm that nobody has, and comes again when all is over.
            line["level"] == "SEVERE"
                && !text.contains("favicon")
                && !text.contains("ERR_CONNECTION_REFUSED")
                && !text.contains("ERR_INCOMPLETE_CHUNKED")
                && !text.contains("401")
        });
        assert_eq!(complaints.collect::<Vec<_>>(), Vec::<&Value>::new());
    }

    /// Each pixel of the canvas is that of the picture, and none is missing.
    fn check_pixels(&self, picture: &Path) {
        let expected = image::open(picture).unwrap().into_rgb8();
        let found = self.pixels();
        assert_eq!(found.len(), 4 * expected.len() / 3);
        let found = found.as_chunks::<4>().0.iter();
        let wrong = std::iter::zip(found, expected.pixels()).filter(|(found, expected)| {
            let [red, green, blue] = expected.0;
            **found != [red, green, blue, 255]
        });
        assert_eq!(wrong.count(), 0, "pixels differ");
    }
}

fn from_base64(text: &str) -> Vec<u8> {
    let value = |byte: u8| match byte {
        b'A'..=b'Z' => byte - b'A',
        b'a'..=b'z' => byte - b'a' + 26,
        b'0'..=b'9' => byte - b'0' + 52,
        b'+' => 62,
        _ => 63,
    };
    let digits: Vec<u8> = text.trim_end_matches('=').bytes().map(value).collect();
    let group = |digits: &[u8]| {
        let number = digits.iter().fold(0, |sum, &digit| sum << 6 | u32::from(digit));
        let bytes = (number << (6 * (4 - digits.len()) + 8)).to_be_bytes();
        bytes[..digits.len() - 1].to_vec()
    };
    digits.chunks(4).flat_map(group).collect()
}

/// Waits for a line of a log that tells an address.
fn shown_at(process: &Process) -> String {
    poll(|| {
        let log = process.log();
        let address = log.lines().find_map(|line| line.split_once("is shown at "))?.1;
        Some(address.trim().to_owned())
    })
}

#[test]
#[ignore = "needs chromium and chromedriver, and looks at pictures for a while"]
fn the_page_shows_each_pixel_as_it_comes() {
    let Some(browser) = Browser::start() else {
        eprintln!("SKIPPED: there is no chromedriver");
        return;
    };
    // A picture of one machine.
    let place = Place::new();
    let args = ["render", "scene.rt", "-o", "out.png", "--show", "--threads", "1"];
    let mut render = place.start("render.log", &[&args[..], &SLOW].concat());
    browser.go(&shown_at(&render));
    poll(|| (render.tiles_done() > SLOW_TILE_COUNT / 3).then_some(()));
    assert_eq!(browser.text_of("link"), "live");
    assert!(browser.ask("location.hash") == "", "the token is gone from the address bar");
    let in_work = "state.work.length > 0 && state.workers.size === 2";
    poll(|| (browser.ask(in_work) == true).then_some(()));
    browser.take_pictures("under-way");
    assert!(render.wait().success(), "{}", render.log());
    let count = format!("{SLOW_TILE_COUNT} of {SLOW_TILE_COUNT}");
    assert_eq!(browser.text_of("tiles"), count);
    browser.check_pixels(&place.path("out.png"));
    browser.check_no_complaint();

    // A farm, by TLS, for those who have a token.
    let listen = ["coordinator", "--listen", "127.0.0.1:0", "--state", "farm"];
    let mut coordinator = place.start("coordinator.log", &listen);
    let line = coordinator.read_line();
    let address = line.trim().strip_prefix("listening on ").unwrap().to_owned();
    let hostile = "<b>me</b><img src=x onerror=alert(1)>\u{1b}[2J";
    let submit = ["submit", "scene.rt", "-o", "farm.png", "--detach", "--access"];
    let submit = [&submit[..], &["farm/access/submit"]].concat();
    let more = ["--name", hostile, "--size", "200x150", "--samples", "64"];
    let mut submit = place.start("submit.log", &[&submit[..], &more].concat());
    assert!(submit.wait().success(), "{}", submit.log());
    let job = submit.read_line().trim().to_owned();
    let access = fs::read_to_string(place.path("farm/access/read")).unwrap();
    let token = access.lines().find_map(|line| line.strip_prefix("token ")).unwrap();
    browser.ask("sessionStorage.clear()");
    browser.go(&address);
    poll(|| (browser.ask("document.getElementById('ask').hidden") == false).then_some(()));
    browser.go("about:blank");
    browser.go(&format!("{address}/#token={token}"));
    poll(|| (browser.text_of("tiles") != "–").then_some(()));
    let nobody = browser.ask("document.getElementById('nobody').hidden");
    assert_eq!(nobody, false, "that nobody renders is told");
    browser.take_pictures("waiting");
    let worker = ["worker", "--threads", "2", "--access", "farm/access/work"];
    let _worker = place.start("worker.log", &worker);
    let is_done = "document.getElementById('bar').value === 1";
    poll(|| (browser.ask(is_done) == true).then_some(()));
    assert!(browser.ask("document.querySelector('img, b')").is_null(), "text stays text");
    assert!(browser.text_of("jobs").contains("<b>me</b>"));
    browser.take_pictures("finished");
    // Its farm forgets a picture that is fetched.
    let fetch = ["image", &job, "-o", "farm.png", "--keep", "--access", "farm/access/read"];
    let mut fetch = place.start("image.log", &fetch);
    assert!(fetch.wait().success(), "{}", fetch.log());
    browser.check_pixels(&place.path("farm.png"));
    // The keyboard reads a pixel and zooms.
    browser.ask("document.getElementById('stage').dispatchEvent(new KeyboardEvent('keydown', { key: 'ArrowLeft' }))");
    let pixel = browser.text_of("pixel");
    assert!(pixel.starts_with("(99, 75) in tile ") && pixel.matches(", ").count() == 3, "{pixel}");
    browser.ask("[0, 0, 0, 0].forEach(() => zoomBy(2, cursorPlace()))");
    browser.take_pictures("zoomed");
    browser.check_no_complaint();
}
