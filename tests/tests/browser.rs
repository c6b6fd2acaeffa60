//! Web page of a rig in headless Chromium: its canvas shows the image that the rig's own renderer draws. Ignored by default, since
//! the tests need Chromium: `make test-browser`.
#![allow(clippy::unwrap_used, clippy::panic)] // a test may fail by panicking, in its helpers too

mod support;

use std::{
    collections::BTreeMap,
    io::{Read as _, Write as _},
    net::TcpStream,
    path::Path,
    process::Command,
    time::{Duration, Instant},
};

use base64::Engine as _;
use flyrig_gpu::{AdapterChoice, GpuContext};
use flyrig_renderer::composite_over;
use flyrig_stream::{Motion, Posed, PosedAxes};
use flyrig_tests::{Dataset, run, write_dataset};
use flyrig_transport::TransportConfig;
use flyrig_viewer::{PeopleScene, Receiver, ShownPerson, clock_secs};
use flyrig_viewing::Navigation;
use serde_json::{Value, json};
use support::{Process, small_rig, wait_until};
use tokio_tungstenite::tungstenite::{self, Message, WebSocket, client::IntoClientRequest as _};

const PROGRAM: &str = env!("CARGO_BIN_EXE_flyrig-under-test");
const SIDE: u32 = 512;
const BACKGROUND: [u8; 3] = [27, 29, 32];
/// JavaScript expression for the rig's frame number of the image on the canvas.
const SHOWN_FRAME: &str = "Number(document.documentElement.dataset.frame)";

/// Browser page, controlled through the debugging protocol.
struct Browser {
    socket: WebSocket<TcpStream>,
    calls: u64,
    _process: Process,
}

impl Browser {
    fn open(url: &str, folder: &Path, port: u16, drawing: &[&str]) -> Self {
        let (port_text, profile) =
            (format!("--remote-debugging-port={port}"), format!("--user-data-dir={}/profile", folder.display()));
        let mut args = vec!["--headless=new", "--no-sandbox", "--enable-unsafe-swiftshader", "--hide-scrollbars"];
        args.extend(drawing);
        args.extend(["--force-color-profile=srgb", "--remote-allow-origins=*", &port_text, &profile, url]);
        let process = Process::start("chromium", &args, folder, "chromium");
        let mut address = None;
        wait_until("the browser", || {
            address = page_address(port);
            address.is_some()
        });
        let stream = TcpStream::connect(("127.0.0.1", port)).unwrap();
        let (socket, _) = tungstenite::client(address.unwrap().into_client_request().unwrap(), stream).unwrap();
        Self { socket, calls: 0, _process: process }
    }

    fn call(&mut self, method: &str, parameters: &Value) -> Value {
        self.calls += 1;
        let text = json!({ "id": self.calls, "method": method, "params": parameters }).to_string();
        self.socket.send(Message::text(text)).unwrap();
        loop {
            if let Message::Text(text) = self.socket.read().unwrap() {
                let answer: Value = serde_json::from_str(&text).unwrap();
                if answer["id"] == self.calls {
                    return answer["result"].clone();
                }
            }
        }
    }

    fn evaluate(&mut self, expression: &str) -> Value {
        let answer = self.call("Runtime.evaluate", &json!({ "expression": expression, "returnByValue": true }));
        answer["result"]["value"].clone()
    }
}

/// Returns the WebSocket address of the browser's first page.
fn page_address(port: u16) -> Option<String> {
    let mut stream = TcpStream::connect(("127.0.0.1", port)).ok()?;
    write!(stream, "GET /json HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n\r\n").ok()?;
    stream.set_read_timeout(Some(Duration::from_secs(2))).ok()?;
    let mut answer = Vec::new();
    let _ = stream.read_to_end(&mut answer);
    let text = String::from_utf8_lossy(&answer).into_owned();
    let pages: Value = serde_json::from_str(text.split_once("\r\n\r\n")?.1.trim()).ok()?;
    let page = pages.as_array()?.iter().find(|page| page["type"] == "page")?;
    page["webSocketDebuggerUrl"].as_str().map(str::to_owned)
}

/// Chromium options for WebGL2 on the processor.
const WEBGL2: &[&str] = &["--use-angle=swiftshader"];
/// Chromium options for WebGPU on the processor.
const WEBGPU: &[&str] = &[
    "--enable-unsafe-webgpu",
    "--enable-features=Vulkan",
    "--use-webgpu-adapter=swiftshader",
    "--use-angle=swiftshader",
    "--use-vulkan=swiftshader",
];

#[test]
#[ignore = "needs Chromium; make test-browser"]
fn a_browser_shows_the_person_as_the_rig_draws_it() {
    let psnr = psnr_of_browser(Shown::Person, "webgl2", WEBGL2);
    assert!(psnr > 35.0, "{psnr} dB");
}

#[test]
#[ignore = "needs Chromium; make test-browser"]
fn a_browser_with_webgpu_shows_the_person_as_the_rig_draws_it() {
    let psnr = psnr_of_browser(Shown::Person, "webgpu", WEBGPU);
    assert!(psnr > 40.0, "{psnr} dB");
}

#[test]
#[ignore = "needs Chromium; make test-browser"]
fn a_browser_shows_an_avatar_as_the_rig_draws_it() {
    let psnr = psnr_of_browser(Shown::Avatar, "webgl2", WEBGL2);
    assert!(psnr > 35.0, "{psnr} dB");
}

#[test]
#[ignore = "needs Chromium; make test-browser"]
fn a_browser_shows_a_person_made_of_an_avatar_as_the_rig_draws_it() {
    let psnr = psnr_of_browser(Shown::Tracked, "webgl2", WEBGL2);
    assert!(psnr > 35.0, "{psnr} dB");
}

#[test]
#[ignore = "needs Chromium; make test-browser"]
fn a_browser_with_webgpu_shows_an_avatar_as_the_rig_draws_it() {
    let psnr = psnr_of_browser(Shown::Avatar, "webgpu", WEBGPU);
    assert!(psnr > 40.0, "{psnr} dB");
}

/// Subject that the page shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Shown {
    /// Simulated person, with new colours in every frame.
    Person,
    /// Avatar of the person of a data set, sent once and then driven by poses.
    Avatar,
    /// Person of a data set who is made of an avatar: its motion and colours come with every frame.
    Tracked,
}

impl Shown {
    fn name(self) -> &'static str {
        match self {
            Self::Person => "person",
            Self::Avatar => "avatar",
            Self::Tracked => "tracked avatar",
        }
    }

    /// Writes `rig.toml`; returns its endpoint and, for an avatar, its data set.
    fn configure(self, folder: &Path, web: u16) -> (String, Option<Dataset>) {
        let file = folder.join("rig.toml");
        if self == Self::Person {
            let more = format!("[web]\nlisten = \"127.0.0.1:{web}\"\n");
            let endpoint = small_rig("browser", folder, &more);
            let sim = "width = 384\nheight = 384\nfps = 1\nmotion.kind = \"still\"\n";
            std::fs::write(folder.join("sim.toml"), sim).unwrap();
            let text = std::fs::read_to_string(&file).unwrap();
            std::fs::write(&file, text.replace("gaussians = 3000", "gaussians = 40000")).unwrap();
            return (endpoint, None);
        }
        let data = write_dataset().unwrap();
        let take = data.root.to_string_lossy().into_owned();
        let args = ["avatar", "build", &take, "--inputs", "00,02,04,05", "--frames", "0..4", "--out", "a.flyavatar"];
        let more = ["--gaussians", "12000", "--nodes", "100", "--steps", "60", "--pose", "given", "--masks", "given"];
        let built = run(PROGRAM, &[&args[..], &more].concat(), folder).unwrap();
        assert_eq!(built.code, Some(0), "{built:?}");
        let endpoint = small_rig("browser", folder, "");
        let text = std::fs::read_to_string(&file).unwrap();
        // Six frames at a low rate: the rig must still run when the browser has drawn one.
        let source = format!("[source]\nkind = \"folder\"\npath = {take:?}\nfps = 0.2\n");
        let text = text.replace("[source]\npath = \"sim.toml\"\n", &source);
        let body = format!("[body]\ntemplate = {:?}\navatar = \"a.flyavatar\"\n", format!("{take}/subject.glb"));
        let output = format!("[output]\navatar = {}\n", self == Self::Avatar);
        let text = text.replace("[body]\n", &body).replace("[output]\n", &output);
        std::fs::write(&file, text).unwrap();
        (endpoint, Some(data))
    }
}

/// Returns the PSNR of the page against the rig's renderer, for the same motion and colours and on the pixels of the person, dB.
/// The page draws with `drawing`, "webgl2" or "webgpu".
fn psnr_of_browser(who: Shown, drawing: &str, options: &[&str]) -> f64 {
    assert!(
        Command::new("chromium").arg("--version").output().is_ok(),
        "chromium is missing: make test-browser installs it"
    );
    let folder = tempfile::tempdir().unwrap();
    let port = || std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    let (web, debugging) = (port(), port());
    let (endpoint, _data) = who.configure(folder.path(), web);
    let start_rig = || Process::start(PROGRAM, &["run", "rig.toml"], folder.path(), "run");
    let listen = format!("127.0.0.1:{web}");
    // The data set is short: start its rig once the browser is open.
    let _server = match who {
        Shown::Person => start_rig(),
        Shown::Avatar | Shown::Tracked => {
            let args = ["serve", "--connect", &endpoint, "--rig", "browser", "--listen", &listen];
            Process::start(PROGRAM, &args, folder.path(), "serve")
        }
    };
    wait_until("the page", || TcpStream::connect(("127.0.0.1", web)).is_ok());

    let gpu = GpuContext::new(&AdapterChoice::Best).unwrap();
    let subscriber = TransportConfig { connect: vec![endpoint], ..TransportConfig::subscriber("browser") };
    let receiver = Receiver::start(&subscriber, || {}).unwrap();
    let started = Instant::now();
    let url = format!("http://{listen}/?bare&fixed&lowest-latency&camera=00&draw={drawing}");
    let mut browser = Browser::open(&url, folder.path(), debugging, options);
    let size = json!({ "width": SIDE, "height": SIDE, "deviceScaleFactor": 1, "mobile": false });
    browser.call("Emulation.setDeviceMetricsOverride", &size);
    let _rig = (who != Shown::Person).then(start_rig);

    // Motions and colours by frame, as this test received them.
    let mut known: BTreeMap<u64, (Motion, Vec<[f32; 4]>)> = BTreeMap::new();
    let mut note = |receiver: &Receiver| {
        let mut state = receiver.state();
        let Some(person) = state.people.get_mut(0).filter(|person| person.is_complete()) else { return };
        let Some(motion) = person.motion_at(clock_secs(), false) else { return };
        let colors = person.pose(&motion, &mut Posed::default()).to_vec();
        known.insert(motion.stamp.frame, (motion, colors));
    };
    wait_until("the person in the browser", || {
        note(&receiver);
        browser.evaluate("document.documentElement.dataset.ready") == "yes"
    });
    let seconds = started.elapsed().as_secs_f64();
    let first = browser.evaluate(SHOWN_FRAME).as_u64().unwrap_or_default();
    // All colours come at once, before the rig has refined them: those of a later frame differ less from those of the frame before it.
    wait_until("refined colours", || {
        note(&receiver);
        let shown = browser.evaluate(SHOWN_FRAME).as_u64().unwrap_or_default();
        who != Shown::Person || shown > first + 20
    });
    // Wait a few seconds more, until the last of them have arrived.
    let until = Instant::now() + Duration::from_secs(6);
    while Instant::now() < until {
        note(&receiver);
        std::thread::sleep(Duration::from_millis(20));
    }
    // Accept a screenshot only if the frame number is the same before and after it.
    let (mut frame, mut encoded) = (0, String::new());
    wait_until("a screenshot between two frames", || {
        note(&receiver);
        let before = browser.evaluate(SHOWN_FRAME).as_u64().unwrap();
        let image = browser.call("Page.captureScreenshot", &json!({ "format": "png" }));
        (frame, encoded) = (before, image["data"].as_str().unwrap().to_owned());
        browser.evaluate(SHOWN_FRAME).as_u64() == Some(before)
    });
    let drawn = browser.evaluate("document.documentElement.dataset.drawing");
    assert_eq!(drawn.as_str().map(str::to_lowercase).as_deref(), Some(drawing));
    let until = Instant::now() + Duration::from_secs(1);
    while Instant::now() < until {
        note(&receiver);
        std::thread::sleep(Duration::from_millis(20));
    }
    let bytes = base64::engine::general_purpose::STANDARD.decode(encoded).unwrap();
    let browsers = image::load_from_memory(&bytes).unwrap().into_rgb8();
    assert_eq!(browsers.dimensions(), (SIDE, SIDE));
    let (motion, colors) = known.get(&frame).unwrap();

    let mut state = receiver.state();
    let rig = state.rig.clone().unwrap();
    let mut navigation = Navigation::new(&rig);
    navigation.jump(&rig.cameras[0]);
    let (mut posed, mut axes) = (Posed::default(), PosedAxes::default());
    let template = state.people.get_mut(0).unwrap().template();
    template.pose(motion, &mut posed);
    let has_axes = template.pose_axes(motion, &posed, &mut axes);
    assert_eq!((has_axes, template.has_colors()), (who != Shown::Person, who == Shown::Avatar));
    drop(state);
    let mut scene = PeopleScene::new(&gpu.fastest()).unwrap();
    let mut draw = |axes: Option<&PosedAxes>| {
        scene.set_people([ShownPerson { posed: &posed, colors, axes }]).unwrap();
        scene.draw(&navigation.camera(SIDE, SIDE)).unwrap()
    };
    let spheres = draw(None);
    let ours = draw(has_axes.then_some(&axes));
    let behind: Vec<u8> = BACKGROUND.repeat((SIDE * SIDE) as usize);
    let on_grey = composite_over(&ours.rgba, &behind);

    let count = of_person(&ours.rgba, browsers.as_raw()).count();
    let psnr = psnr_of_person(&ours.rgba, &on_grey, browsers.as_raw());
    let mut notes = format!("{psnr:.2} dB on {count} pixels of the person");
    if who != Shown::Person {
        // Rendering plain spheres would not pass.
        let spheres = composite_over(&spheres.rgba, &behind);
        let without = psnr_of_person(&ours.rgba, &on_grey, &spheres);
        notes += &format!(", spheres instead of Gaussians {without:.2} dB");
        assert!(without < 35.0 && psnr > without + 5.0, "{notes}");
    }
    println!("{drawing}: the {} {seconds:.1} s after the browser was started; {notes}", who.name());
    if let Ok(out) = std::env::var("FLYRIG_TEST_OUT") {
        browsers.save(format!("{out}/{}-{drawing}.png", who.name())).unwrap();
        image::RgbImage::from_raw(SIDE, SIDE, on_grey).unwrap().save(format!("{out}/{}-rig.png", who.name())).unwrap();
    }
    assert!(count > 5000, "{count}");
    psnr
}

/// Returns the pixels that show the person in `rgba` or in `rgb`, which is over the background. Background pixels would raise the
/// score.
fn of_person<'a>(rgba: &'a [u8], rgb: &'a [u8]) -> impl Iterator<Item = usize> + 'a {
    let pixels = rgba.chunks_exact(4).zip(rgb.chunks_exact(3)).enumerate();
    pixels.filter_map(|(at, (ours, theirs))| {
        let is_grey = theirs.iter().zip(BACKGROUND).all(|(value, grey)| value.abs_diff(grey) <= 1);
        (ours[3] > 0 || !is_grey).then_some(at)
    })
}

/// Returns the PSNR of `theirs` against `on_grey` (`ours` over the background), on the pixels of the person, dB.
fn psnr_of_person(ours: &[u8], on_grey: &[u8], theirs: &[u8]) -> f64 {
    let (mut sum, mut count) = (0.0, 0usize);
    for at in of_person(ours, theirs) {
        let numbers = 3 * at..3 * at + 3;
        sum += on_grey[numbers.clone()]
            .iter()
            .zip(&theirs[numbers])
            .map(|(a, b)| f64::from(a.abs_diff(*b)).powi(2))
            .sum::<f64>();
        count += 3;
    }
    -10.0 * (sum / count as f64 / 255.0f64.powi(2)).log10()
}

#[test]
#[ignore = "needs Chromium; make test-browser"]
fn a_browser_without_webgl2_shows_the_reason() {
    let folder = tempfile::tempdir().unwrap();
    let port = || std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    let (web, debugging) = (port(), port());
    let listen = format!("127.0.0.1:{web}");
    let _server = Process::start(
        PROGRAM,
        &["serve", "--connect", "tcp/127.0.0.1:1", "--listen", &listen],
        folder.path(),
        "serve",
    );
    wait_until("the page", || TcpStream::connect(("127.0.0.1", web)).is_ok());
    let mut browser = Browser::open(&format!("http://{listen}/"), folder.path(), debugging, &["--disable-3d-apis"]);
    wait_until("words about WebGL2", || {
        let text = browser.evaluate("document.getElementById('trouble')?.textContent ?? ''");
        text.as_str().is_some_and(|text| text.contains("This browser has no WebGL2"))
    });
}

/// JavaScript expression for the page's message, and for its line on what is shown.
const MESSAGE: &str = "document.getElementById('trouble')?.textContent ?? ''";
const LINE: &str = "document.getElementById('state')?.textContent ?? ''";
/// JavaScript expression for the position of the page's camera, metres.
const EYE: &str = "document.documentElement.dataset.eye?.split(' ').map(Number) ?? []";

impl Browser {
    fn text(&mut self, expression: &str) -> String {
        self.evaluate(expression).as_str().unwrap_or_default().to_owned()
    }

    fn eye(&mut self) -> Vec<f64> {
        self.evaluate(EYE).as_array().map(|eye| eye.iter().filter_map(Value::as_f64).collect()).unwrap_or_default()
    }

    fn mouse(&mut self, kind: &str, [x, y]: [u32; 2]) {
        let buttons = u32::from(kind != "mouseReleased");
        let event = json!({ "type": kind, "x": x, "y": y, "button": "left", "buttons": buttons, "clickCount": 1 });
        self.call("Input.dispatchMouseEvent", &event);
    }

    /// Drags from the middle to the right.
    fn drag(&mut self, [width, height]: [u32; 2]) {
        let from = [width / 2, height / 2];
        self.mouse("mousePressed", from);
        (1..8).for_each(|step| self.mouse("mouseMoved", [from[0] + 12 * step, from[1] + 2 * step]));
        self.mouse("mouseReleased", [from[0] + 84, from[1] + 14]);
    }

    fn press(&mut self, key: &str) {
        for kind in ["rawKeyDown", "keyUp"] {
            let event = json!({ "type": kind, "key": key, "code": format!("Key{}", key.to_uppercase()) });
            self.call("Input.dispatchKeyEvent", &event);
        }
    }

    /// Waits until the camera stands still, and returns its position.
    fn settled(&mut self) -> Vec<f64> {
        let mut last = Vec::new();
        wait_until("a camera that stands still", || {
            std::thread::sleep(Duration::from_millis(700));
            let eye = self.eye();
            !eye.is_empty() && std::mem::replace(&mut last, eye.clone()) == eye
        });
        last
    }
}

fn apart(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt()
}

#[test]
#[ignore = "needs Chromium; make test-browser"]
fn a_page_that_shows_a_person_obeys_pointers_and_keys_and_comes_back() {
    let folder = tempfile::tempdir().unwrap();
    let port = || std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    let (web, debugging) = (port(), port());
    let endpoint = small_rig("browser", folder.path(), "");
    // One set in five seconds.
    std::fs::write(folder.path().join("sim.toml"), "width = 96\nheight = 96\ntexture_px = 128\nfps = 0.2\n").unwrap();
    let _rig = Process::start(PROGRAM, &["run", "rig.toml"], folder.path(), "run");
    let listen = format!("127.0.0.1:{web}");
    let serve = || {
        let args = ["serve", "--connect", &endpoint, "--rig", "browser", "--listen", &listen];
        Process::start(PROGRAM, &args, folder.path(), "serve")
    };
    let server = serve();
    wait_until("the page", || TcpStream::connect(("127.0.0.1", web)).is_ok());
    let size = [900, 600];
    let mut browser = Browser::open(&format!("http://{listen}/"), folder.path(), debugging, WEBGL2);
    let device = json!({ "width": size[0], "height": size[1], "deviceScaleFactor": 1, "mobile": false });
    browser.call("Emulation.setDeviceMetricsOverride", &device);
    let ready = |browser: &mut Browser| {
        wait_until("a whole person", || browser.evaluate("document.documentElement.dataset.ready") == "yes");
    };
    ready(&mut browser);
    // A slow rig is no slow line, and the age is that of a set of such a rig.
    let line = browser.text(LINE);
    assert!(line.starts_with("live") && !line.contains("slow"), "{line}");

    let start = browser.settled();
    browser.drag(size);
    let turned = browser.settled();
    assert!(apart(&start, &turned) > 0.3, "{start:?} {turned:?}");
    browser.press("r");
    wait_until("the viewpoint of the start", || apart(&browser.eye(), &start) < 0.01);

    let distance = |browser: &mut Browser| apart(&browser.settled(), &[0.0, 0.0, 0.93]);
    let far = distance(&mut browser);
    for delta in [10_000, -10_000] {
        for _ in 0..40 {
            let wheel = json!({ "type": "mouseWheel", "x": 450, "y": 300, "deltaX": 0, "deltaY": delta });
            browser.call("Input.dispatchMouseEvent", &wheel);
        }
        let found = distance(&mut browser);
        assert!((0.2..4.0 * far).contains(&found), "{delta}: {found} m of {far}");
    }
    browser.press("r");
    wait_until("the viewpoint of the start", || apart(&browser.eye(), &start) < 0.01);
    let touch = json!({ "enabled": true, "maxTouchPoints": 2 });
    browser.call("Emulation.setTouchEmulationEnabled", &touch);
    for spread in [200, 5, 0, 250] {
        let points = |by: i32| json!([{ "x": 450 - by, "y": 300, "id": 0 }, { "x": 450 + by, "y": 300, "id": 1 }]);
        for (kind, points) in [("touchStart", points(100)), ("touchMove", points(spread)), ("touchEnd", json!([]))] {
            browser.call("Input.dispatchTouchEvent", &json!({ "type": kind, "touchPoints": points }));
        }
    }
    let found = distance(&mut browser);
    assert!((0.2..4.0 * far).contains(&found), "{found} m of {far}");

    browser.press("h");
    wait_until("details", || browser.text("document.getElementById('details').textContent").contains("rig browser"));
    browser.press("h");
    assert_eq!(browser.evaluate("document.getElementById('help').hidden"), true);

    // The server ends and comes again.
    drop(server);
    wait_until("words about the server", || browser.text(MESSAGE).contains("trying again"));
    // The message takes no drag, and no text is selected.
    let center = "document.getElementById('trouble').getBoundingClientRect()";
    let under = format!("(b => document.elementFromPoint(b.x + b.width / 2, b.y + b.height / 2).id)({center})");
    assert_eq!(browser.text(&under), "view");
    let before = browser.settled();
    browser.drag(size);
    assert!(apart(&browser.settled(), &before) > 0.3);
    assert_eq!(browser.text("getSelection().toString()"), "");
    let _server = serve();
    ready(&mut browser);
}

#[test]
#[ignore = "needs Chromium; make test-browser"]
fn a_page_without_a_rig_says_so_and_is_dragged_through_its_message() {
    let folder = tempfile::tempdir().unwrap();
    let port = || std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    let (web, debugging) = (port(), port());
    let listen = format!("127.0.0.1:{web}");
    let args = ["serve", "--connect", "tcp/127.0.0.1:1", "--listen", &listen];
    let _server = Process::start(PROGRAM, &args, folder.path(), "serve");
    wait_until("the page", || TcpStream::connect(("127.0.0.1", web)).is_ok());
    let mut browser = Browser::open(&format!("http://{listen}/"), folder.path(), debugging, WEBGL2);
    wait_until("words about the rig", || browser.text(MESSAGE).starts_with("No rig 'flyrig' yet"));
    assert_eq!(browser.text(LINE), "");
    browser.drag([800, 600]);
    assert_eq!(browser.text("getSelection().toString()"), "");
    browser.call("Runtime.evaluate", &json!({ "expression": "document.execCommand('selectAll')" }));
    assert_eq!(browser.text("getSelection().toString()").trim(), "");
}

/// Returns the pixels of a screenshot that differ from the background, and a checksum of the image.
fn shown(browser: &mut Browser) -> (usize, u64) {
    let answer = browser.call("Page.captureScreenshot", &json!({ "format": "png" }));
    let bytes = base64::engine::general_purpose::STANDARD.decode(answer["data"].as_str().unwrap()).unwrap();
    let image = image::load_from_memory(&bytes).unwrap().into_rgb8();
    if let Ok(out) = std::env::var("FLYRIG_TEST_OUT") {
        image.save(format!("{out}/take.png")).unwrap();
    }
    // Without the bar and the title.
    let person = image.enumerate_pixels().filter(|(_, y, pixel)| {
        (60..440).contains(y) && pixel.0.iter().zip(BACKGROUND).any(|(value, grey)| value.abs_diff(grey) > 8)
    });
    let sum = image.as_raw().iter().fold(0u64, |sum, value| sum.wrapping_mul(31).wrapping_add(u64::from(*value)));
    (person.count(), sum)
}

#[test]
#[ignore = "needs Chromium; make test-browser"]
fn the_page_of_a_take_plays_from_the_file_system() {
    let data = write_dataset().unwrap();
    let folder = data.root.parent().unwrap();
    let args = ["eval", "data", "--inputs", "00,02,05", "--gaussians", "12000", "--nodes", "200"];
    let evaluated = run(PROGRAM, &args, folder).unwrap();
    assert_eq!(evaluated.code, Some(0), "{evaluated:?}");
    let page = folder.join("out/eval/take.html");
    let alone = tempfile::tempdir().unwrap();
    // Nothing but the one file is there.
    std::fs::copy(&page, alone.path().join("take.html")).unwrap();
    let port = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    let url = format!("file://{}/take.html?bare", alone.path().display());
    let mut browser = Browser::open(&url, folder, port, WEBGL2);
    let size = json!({ "width": SIDE, "height": SIDE, "deviceScaleFactor": 1, "mobile": false });
    browser.call("Emulation.setDeviceMetricsOverride", &size);
    wait_until("the person with all colours", || browser.evaluate("document.documentElement.dataset.ready") == "yes");
    let seek = |browser: &mut Browser, seconds: f64| {
        browser.evaluate(&format!("time.value = {seconds}; time.dispatchEvent(new Event('input'))"));
        std::thread::sleep(Duration::from_millis(700));
        browser.evaluate(SHOWN_FRAME).as_u64().unwrap()
    };
    assert_eq!(seek(&mut browser, 1.0), 5, "the last frame");
    let (count, last) = shown(&mut browser);
    assert!(count > 10_000, "the person fills the page: {count} pixels");
    // Back and forth: each instant looks as before, and is complete.
    assert_eq!(seek(&mut browser, 0.0), 0);
    assert_ne!(shown(&mut browser).1, last);
    assert_eq!(browser.evaluate("document.documentElement.dataset.ready"), "yes");
    let again = (seek(&mut browser, 1.0), shown(&mut browser).1);
    assert_eq!(again, (5, last));

    // A drag from the centre turns and selects nothing; R resets; the wheel cannot lose the person.
    let mouse = |browser: &mut Browser, kind: &str, x: u32, more: Value| {
        let mut parameters = json!({ "type": kind, "x": x, "y": 250, "button": "left", "buttons": 1, "clickCount": 1 });
        parameters.as_object_mut().unwrap().extend(more.as_object().unwrap().clone());
        browser.call("Input.dispatchMouseEvent", &parameters);
    };
    mouse(&mut browser, "mousePressed", 256, json!({}));
    mouse(&mut browser, "mouseMoved", 400, json!({}));
    mouse(&mut browser, "mouseReleased", 400, json!({}));
    std::thread::sleep(Duration::from_millis(300));
    assert_ne!(shown(&mut browser).1, last, "it turned");
    assert_eq!(browser.evaluate("getSelection().toString()"), "");
    mouse(&mut browser, "mouseWheel", 256, json!({ "deltaX": 0, "deltaY": 10_000, "buttons": 0 }));
    std::thread::sleep(Duration::from_millis(300));
    assert!(shown(&mut browser).0 > 1000, "one turn of the wheel is one step");
    for kind in ["keyDown", "keyUp"] {
        browser.call("Input.dispatchKeyEvent", &json!({ "type": kind, "code": "KeyR", "key": "r" }));
    }
    std::thread::sleep(Duration::from_millis(300));
    let reset = shown(&mut browser).0;
    assert!(reset.abs_diff(count) < count / 8, "{reset} pixels, {count} at the start");
}
