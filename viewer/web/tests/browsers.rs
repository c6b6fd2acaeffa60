//! Browsers at the web page of a rig: what they get, what they cannot do, and what they cannot do to each other.
#![allow(clippy::unwrap_used, clippy::panic)] // a test may fail by panicking, in its helpers too

use std::{
    io::{ErrorKind, Read as _, Write as _},
    net::{SocketAddr, TcpStream},
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    thread::JoinHandle,
    time::{Duration, Instant},
};

use flyrig_page::{Page, PageMessageKind};
use flyrig_stream::{
    ColorEncoder, ColorSettings, EncodedTemplate, Motion, MotionEncoder, Stamp, StreamJoint, TemplateSource,
};
use flyrig_transport::{Publisher, TransportConfig};
use flyrig_types::{Camera, Intrinsics, Isometry, Rig};
use flyrig_web::{WebConfig, WebServer};
use glam::DVec3;
use rustls_pki_types::{CertificateDer, ServerName, pem::PemObject as _};
use tokio_rustls::rustls::{self, ClientConfig, ClientConnection, RootCertStore, StreamOwned};
use tokio_tungstenite::tungstenite::{self, Message, WebSocket, client::IntoClientRequest as _};

const PATIENCE: Duration = Duration::from_secs(60);
const GAUSSIANS: usize = 500;
const NAME: &str = "web-test";

/// A rig of one person who stands at x; it publishes until it is dropped.
struct TestRig {
    endpoint: String,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl TestRig {
    fn start(listen: &str, x: f32) -> Self {
        let config = TransportConfig { listen: vec![listen.to_owned()], ..TransportConfig::publisher(NAME) };
        // The port of the rig before may be free a moment later.
        let started = Instant::now();
        let publisher = loop {
            match Publisher::open(&config) {
                Ok(publisher) => break publisher,
                Err(error) => assert!(started.elapsed() < PATIENCE, "{error}"),
            }
            std::thread::sleep(Duration::from_millis(20));
        };
        publisher.set_calibration(&cameras()).unwrap();
        let endpoint = publisher.endpoints()[0].clone();
        let stop = Arc::<AtomicBool>::default();
        let ended = Arc::clone(&stop);
        let work = move || {
            let encoded = template(1.0 + x);
            publisher.offer_template(4, encoded.template.hash, encoded.bytes.clone().into());
            let mut motions = MotionEncoder::new(&encoded);
            let mut colors = ColorEncoder::new(&encoded, ColorSettings::default(), 1);
            for frame in 1.. {
                if ended.load(Ordering::Relaxed) {
                    break;
                }
                let capture_nanos = 33_000_000 * frame as i64;
                let stamp = Stamp { template: encoded.template.hash, person: 4, frame, capture_nanos };
                let motion = Motion {
                    stamp,
                    root_translation: [x, 0.0, 1.0],
                    joint_rotations: vec![[0.0, 0.0, 0.0, 1.0]],
                    nodes: Vec::new(),
                };
                publisher.publish_person(&stamp, None, motions.encode(&motion).unwrap().into());
                let layers = colors.encode(stamp, &[[0.5, 0.2, 0.1, 1.0]; GAUSSIANS]);
                for (layer, bytes) in layers.into_iter().enumerate().filter(|(_, bytes)| !bytes.is_empty()) {
                    publisher.publish_person(&stamp, Some(layer), bytes.into());
                }
                std::thread::sleep(Duration::from_millis(33));
            }
            publisher.close().unwrap();
        };
        let thread = std::thread::Builder::new().name("rig".to_owned()).spawn(work).unwrap();
        Self { endpoint, stop, thread: Some(thread) }
    }
}

impl Drop for TestRig {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        self.thread.take().unwrap().join().unwrap();
    }
}

fn cameras() -> Rig {
    let camera = Camera {
        time_offset_nanos: 0,
        color: Default::default(),
        id: "a".into(),
        intrinsics: Intrinsics::pinhole(640, 480, 500.0),
        camera_from_world: Isometry::look_at(DVec3::new(0.0, -3.0, 1.0), DVec3::Z, DVec3::Z),
    };
    Rig { cameras: vec![camera], world_up: DVec3::Z }
}

fn template(size: f32) -> EncodedTemplate {
    let rows = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];
    let joints = [StreamJoint { parent: None, translation: [0.0; 3], joint_from_canonical: rows }];
    let center_scale: Vec<[f32; 4]> =
        (0..GAUSSIANS).map(|i| [0.0, 0.0, size * i as f32 / GAUSSIANS as f32, 0.01]).collect();
    let skin = vec![([0; 4], [1.0, 0.0, 0.0, 0.0]); GAUSSIANS];
    let normals = vec![[0.0, -1.0, 0.0]; GAUSSIANS];
    let (center_scale, normals, skin) = (&center_scale, &normals, &skin);
    let source = TemplateSource { joints: &joints, center_scale, normals, skin, node_weights: &[], nodes: &[] };
    source.encode().unwrap()
}

fn server(endpoint: &str, listen: &str, insecure: bool) -> WebServer {
    let transport = TransportConfig { connect: vec![endpoint.to_owned()], ..TransportConfig::subscriber(NAME) };
    let names = vec!["rig.local".to_owned()];
    let config = WebConfig { listen: listen.to_owned(), insecure, names, max_browsers: 3, ..WebConfig::default() };
    WebServer::start(&config, transport).unwrap()
}

type Socket = WebSocket<TcpStream>;

fn browser(address: SocketAddr, token: &str) -> Socket {
    let stream = TcpStream::connect(address).unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    let request = format!("ws://{address}/stream").into_client_request().unwrap();
    let (mut socket, _) = tungstenite::client(request, stream).unwrap();
    socket.send(Message::text(token)).unwrap();
    socket
}

/// The next message: kind, person, payload.
fn next(socket: &mut Socket) -> (u8, u32, Vec<u8>) {
    loop {
        if let Message::Binary(bytes) = socket.read().unwrap() {
            return (bytes[0], u32::from_le_bytes(bytes[4..8].try_into().unwrap()), bytes[8..].to_vec());
        }
    }
}

/// Reads as the page does until `done`.
fn watch(socket: &mut Socket, page: &mut Page, what: &str, mut done: impl FnMut(&mut Page, &str) -> bool) {
    let started = Instant::now();
    let mut state = String::new();
    while !done(page, &state) {
        assert!(started.elapsed() < PATIENCE, "waited in vain for {what}: {state}");
        let (kind, person, payload) = next(socket);
        match kind {
            4 => state = String::from_utf8(payload).unwrap(),
            5 => page.forget_people(),
            kind => page
                .ingest(PageMessageKind::of(kind.into()).unwrap(), person, &payload, started.elapsed().as_secs_f64())
                .unwrap(),
        }
        page.pose(started.elapsed().as_secs_f64(), false);
    }
}

fn ask(address: SocketAddr, request: &str) -> String {
    let mut stream = TcpStream::connect(address).unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    stream.write_all(request.as_bytes()).unwrap();
    let mut answer = Vec::new();
    let _ = stream.read_to_end(&mut answer);
    String::from_utf8_lossy(&answer).into_owned()
}

#[test]
fn browsers_see_a_rig_that_comes_late_goes_and_comes_again_as_another() {
    // The system gives those from 32768 on to whoever asks for any port, and to the server's attempts to connect.
    let mut ports = (0..12_000).map(|n| 20_000 + ((std::process::id() + n) % 12_000) as u16);
    let port = ports.find(|port| std::net::TcpListener::bind(("127.0.0.1", *port)).is_ok()).unwrap();
    let endpoint = format!("tcp/127.0.0.1:{port}");
    let server = server(&endpoint, "127.0.0.1:0", false);
    let (mut socket, mut page) = (browser(server.address(), ""), Page::default());
    watch(&mut socket, &mut page, "a rig that is not there", |_, state| state.contains("No rig 'web-test' yet"));
    let stands_at = |page: &mut Page, x: f32| {
        page.is_complete()
            && page.people_shown() == 1
            && page.centers().first().is_some_and(|center| (center[0] - x).abs() < 1e-2)
    };
    let rig = TestRig::start(&endpoint, 0.25);
    assert_eq!(rig.endpoint, endpoint);
    watch(&mut socket, &mut page, "the person", |page, state| {
        stands_at(page, 0.25) && state.contains("\"trouble\":null") && state.contains("\"color_layers\":[3,3]")
    });
    assert!((page.colors()[7][0] - 0.5).abs() < 0.05 && page.order(320, 240).len() == GAUSSIANS);
    // A second browser joins a stream under way.
    let (mut second, mut late) = (browser(server.address(), ""), Page::default());
    watch(&mut second, &mut late, "the person, late", |page, _| stands_at(page, 0.25));
    drop(rig);
    watch(&mut socket, &mut page, "the end of the rig", |page, state| {
        page.people_shown() == 0 && state.contains("No rig")
    });
    let _rig = TestRig::start(&endpoint, 0.75);
    watch(&mut socket, &mut page, "the other person", |page, _| stands_at(page, 0.75));
}

#[test]
fn a_browser_that_stops_reading_delays_no_other() {
    let rig = TestRig::start("tcp/127.0.0.1:0", 0.5);
    let server = server(&rig.endpoint, "127.0.0.1:0", false);
    let _stopped = [browser(server.address(), ""), browser(server.address(), "")];
    let mut socket = browser(server.address(), "");
    let (started, mut motions) = (Instant::now(), 0);
    // Three seconds give ninety, where the machine is not busy.
    while started.elapsed() < Duration::from_secs(3) || motions <= 20 {
        motions += u32::from(next(&mut socket).0 == 2);
        assert!(started.elapsed() < PATIENCE, "{motions} motions");
    }
    // Three may watch.
    let mut fourth = browser(server.address(), "");
    let closed = loop {
        match fourth.read().unwrap() {
            Message::Close(frame) => break frame.unwrap(),
            message => assert!(!message.is_binary(), "a browser beyond the limit is served"),
        }
    };
    assert!(closed.reason.contains("all places are taken"), "{closed}");
    drop(socket);
    let deadline = Instant::now() + PATIENCE;
    while server.browsers() > 2 {
        assert!(Instant::now() < deadline, "the place of a browser that left stays taken");
        std::thread::sleep(Duration::from_millis(20));
    }
}

#[test]
fn strangers_are_refused_in_words() {
    let server = server("tcp/127.0.0.1:1", "127.0.0.1:0", false);
    let (address, port) = (server.address(), server.address().port());
    assert_eq!(server.link(), format!("http://127.0.0.1:{port}/"));
    let get =
        |path: &str, more: &str| ask(address, &format!("GET {path} HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n{more}\r\n"));
    let page = get("/", "");
    assert!(
        page.starts_with("HTTP/1.1 200") && page.contains("content-security-policy") && page.contains("<canvas"),
        "{page}"
    );
    for (path, kind) in [
        ("/page.js", "javascript"),
        ("/draw_webgl2.js", "javascript"),
        ("/draw_webgpu.js", "javascript"),
        ("/page.wasm", "application/wasm"),
        ("/kernels.json", "application/json"),
    ] {
        let answer = get(path, "");
        assert!(answer.starts_with("HTTP/1.1 200") && answer.contains(kind), "{path}");
    }
    assert!(get("/../etc/passwd", "").starts_with("HTTP/1.1 404"));
    assert!(get("/stream", "").starts_with("HTTP/1.1 426"));
    assert!(get("/", "Origin: http://evil.example\r\n").contains("pages of http://evil.example may not watch"));
    let named = ask(address, "GET / HTTP/1.1\r\nHost: evil.example\r\n\r\n");
    assert!(named.starts_with("HTTP/1.1 403") && named.contains("not known as 'evil.example'"), "{named}");
    assert!(ask(address, "GET / HTTP/1.1\r\nHost: rig.local:80\r\n\r\n").starts_with("HTTP/1.1 200"));
    let posted = ask(address, &format!("POST / HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nContent-Length: 1\r\n\r\nx"));
    assert!(posted.starts_with("HTTP/1.1 405"), "{posted}");
    for noise in ["\r\n\r\n", "GET / HTTP/9.9\r\n\r\n", "\u{0}\u{1}\u{2}\r\n\r\n"] {
        assert!(!ask(address, noise).contains("200 OK"));
    }
    ask(address, &format!("GET /{} HTTP/1.1\r\nHost: localhost\r\n\r\n", "a".repeat(100_000)));

    // Somebody who talks.
    let mut chatty = browser(address, "");
    chatty.send(Message::text("what")).unwrap();
    let reason = loop {
        if let Message::Close(frame) = chatty.read().unwrap() {
            break frame.unwrap().reason.to_string();
        }
    };
    assert!(reason.contains("unexpected message"), "{reason}");
}

#[test]
fn other_computers_need_permission_and_a_token() {
    let transport = TransportConfig::subscriber(NAME);
    let refused = |config: &WebConfig| WebServer::start(config, transport.clone()).unwrap_err().to_string();
    let listening = |listen: &str| WebConfig { listen: listen.to_owned(), ..WebConfig::default() };
    for (config, words) in [
        (listening(""), "'' is no address and port, such as"),
        (listening("localhost"), "web.listen: 'localhost' is no address"),
        (WebConfig { max_browsers: 0, ..listening("127.0.0.1:0") }, "web.max_browsers is 0, it must be in 1..=256"),
    ] {
        assert!(refused(&config).contains(words), "{}", refused(&config));
    }
    let half = WebConfig { key: "key.pem".into(), ..listening("127.0.0.1:0") };
    assert!(refused(&half).contains("web.certificate and web.key belong together"), "{}", refused(&half));
    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let refusal = refused(&listening(&taken.local_addr().unwrap().to_string()));
    assert!(refusal.contains("cannot listen on") && refusal.contains("another"), "{refusal}");

    let rig = TestRig::start("tcp/127.0.0.1:0", 0.5);
    let server = server(&rig.endpoint, "0.0.0.0:0", true);
    let address = SocketAddr::from(([127, 0, 0, 1], server.address().port()));
    let link = server.link();
    let token = link.split_once('#').unwrap().1.to_owned();
    for wrong in ["", &token[1..], &token.replace(&token[..1], "x")] {
        let mut socket = browser(address, wrong);
        let Message::Close(Some(frame)) = socket.read().unwrap() else { panic!("'{wrong}' was let in") };
        assert!(frame.reason.contains("token is wrong or missing"), "{frame}");
    }
    assert_eq!(next(&mut browser(address, &token)).0 % 4, 0, "a state or the rig comes first");
}

#[test]
fn other_computers_are_served_through_https() {
    let rig = TestRig::start("tcp/127.0.0.1:0", 0.5);
    let folder = tempfile::tempdir().unwrap();
    let transport = TransportConfig { connect: vec![rig.endpoint.clone()], ..TransportConfig::subscriber(NAME) };
    let config = WebConfig {
        listen: "0.0.0.0:0".to_owned(),
        certificate: folder.path().join("cert.pem"),
        key: folder.path().join("key.pem"),
        ..WebConfig::default()
    };
    let server = WebServer::start(&config, transport).unwrap();
    let address = SocketAddr::from(([127, 0, 0, 1], server.address().port()));
    let link = server.link();
    assert!(!link.contains("0.0.0.0"), "{link}");
    assert!(link.starts_with("https://") && server.fingerprint().is_some(), "{link}");
    let token = link.split_once('#').unwrap().1.to_owned();
    let answer = ask(address, "GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n");
    assert!(answer.starts_with("HTTP/1.1 400") && answer.contains("write https://"), "{answer}");
    // A client that trusts the certificate connects; one that trusts only others does not.
    let connect = |roots: RootCertStore, origin: &str| {
        let provider = Arc::new(rustls::crypto::ring::default_provider());
        let settings = ClientConfig::builder_with_provider(provider).with_safe_default_protocol_versions().unwrap();
        let settings = settings.with_root_certificates(roots).with_no_client_auth();
        let name = ServerName::try_from("127.0.0.1").unwrap();
        let stream = TcpStream::connect(address).unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        let stream = StreamOwned::new(ClientConnection::new(Arc::new(settings), name).unwrap(), stream);
        let mut request = format!("wss://{address}/stream").into_client_request().unwrap();
        request.headers_mut().insert("Origin", origin.parse().unwrap());
        tungstenite::client(request, stream).map_err(|error| error.to_string())
    };
    let mut roots = RootCertStore::empty();
    roots.add(CertificateDer::from_pem_file(&config.certificate).unwrap()).unwrap();
    let (mut socket, _) = connect(roots.clone(), &format!("https://{address}")).unwrap();
    socket.send(Message::text(token.as_str())).unwrap();
    let came = std::iter::repeat_with(|| socket.read().unwrap()).find(Message::is_binary).unwrap();
    assert!(came.len() >= 8);
    assert!(connect(roots, &format!("http://{address}")).is_err(), "another scheme is another site");
    let unknown = connect(RootCertStore::empty(), &format!("https://{address}")).err().unwrap();
    assert!(unknown.contains("UnknownIssuer"), "{unknown}");
    // Nothing is said on these; they end by themselves.
    let silent: Vec<TcpStream> = (0..100).filter_map(|_| TcpStream::connect(address).ok()).collect();
    socket.send(Message::Ping(Default::default())).unwrap();
    assert!(std::iter::repeat_with(|| socket.read().unwrap()).take(10_000).any(|message| message.is_pong()));
    drop(silent);
}

#[test]
fn half_open_connections_and_floods_delay_no_other() {
    let server = server("tcp/127.0.0.1:1", "127.0.0.1:0", false);
    let address = server.address();
    // Nothing is ever said on these.
    let half_open: Vec<TcpStream> = (0..800).filter_map(|_| TcpStream::connect(address).ok()).collect();
    assert!(half_open.len() > 400, "{}", half_open.len());
    let started = Instant::now();
    for _ in 0..200 {
        let answer = ask(address, "GET / HTTP/1.1\r\nHost: localhost\r\n\r\n");
        assert!(answer.starts_with("HTTP/1.1 200"), "{answer}");
    }
    assert!(started.elapsed() < PATIENCE);
    drop(half_open);
    // A message that claims to be huge costs its sender the place.
    let mut socket = browser(address, "");
    let _ = socket.send(Message::binary(vec![0u8; 1 << 20]));
    let ended = (0..100).any(|_| matches!(socket.read(), Err(_) | Ok(Message::Close(_))));
    assert!(ended);
}

/// Asks for the page and returns how long the answer took, by the turns that this thread had: a machine that pauses or is busy has fewer of
/// them.
fn page_time(address: SocketAddr) -> Duration {
    let turn = Duration::from_millis(5);
    let begun = Instant::now();
    let mut stream = TcpStream::connect(address).unwrap();
    let connecting = begun.elapsed();
    stream.set_read_timeout(Some(turn)).unwrap();
    stream.write_all(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n").unwrap();
    let (mut answer, mut turns) = (Vec::new(), 0);
    while turns * turn < PATIENCE {
        let mut bytes = [0; 4096];
        match stream.read(&mut bytes) {
            Ok(count @ 1..) => answer.extend_from_slice(&bytes[..count]),
            Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => turns += 1,
            _ => break,
        }
    }
    assert!(answer.starts_with(b"HTTP/1.1 200"), "{}", String::from_utf8_lossy(&answer));
    connecting + turns * turn
}

/// Opens connections on which a request is sent, and little or nothing read.
fn requests(address: SocketAddr, count: usize, request: &str) -> Vec<TcpStream> {
    let open = |_| {
        let mut stream = TcpStream::connect(address).ok()?;
        stream.write_all(request.as_bytes()).ok()?;
        stream.set_nonblocking(true).ok()?;
        Some(stream)
    };
    (0..count).filter_map(open).collect()
}

#[test]
fn clients_that_read_slowly_or_not_at_all_delay_no_other() {
    let server = server("tcp/127.0.0.1:1", "127.0.0.1:0", false);
    let address = server.address();
    let mut slow = requests(address, 600, "GET /page.wasm HTTP/1.1\r\nHost: localhost\r\n\r\n");
    assert!(slow.len() > 540, "{}: raise the limit of open files", slow.len());
    for _ in 0..20 {
        let took = page_time(address);
        assert!(took < Duration::from_secs(1), "{took:?}");
        // Half of them read a byte at a time.
        slow.iter_mut().step_by(2).for_each(|stream| drop(stream.read(&mut [0])));
        std::thread::sleep(Duration::from_millis(50));
    }
}

#[test]
fn an_answer_that_is_not_read_ends() {
    let server = server("tcp/127.0.0.1:1", "127.0.0.1:0", false);
    let mut deaf = TcpStream::connect(server.address()).unwrap();
    deaf.write_all(b"GET /page.wasm HTTP/1.1\r\nHost: localhost\r\n\r\n").unwrap();
    // Much longer than the server waits: it may be late on a busy machine.
    std::thread::sleep(Duration::from_secs(20));
    let mut answer = Vec::new();
    let _ = deaf.read_to_end(&mut answer);
    assert!(answer.starts_with(b"HTTP/1.1 200") && answer.len() < 200_000, "{} bytes", answer.len());
}

#[test]
fn sockets_without_a_token_are_bounded_and_delay_no_other() {
    let server = server("tcp/127.0.0.1:1", "127.0.0.1:0", false);
    let address = server.address();
    let mut watching = browser(address, "");
    let upgrade = "GET /stream HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n\
                   Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n";
    let begun = Instant::now();
    let mut silent = requests(address, 900, upgrade);
    assert!(silent.len() > 800, "{}: raise the limit of open files", silent.len());
    assert!(page_time(address) < Duration::from_secs(1));
    let is_open = |stream: &mut TcpStream| loop {
        match stream.read(&mut [0; 512]) {
            Ok(0) => break false,
            Ok(_) => {}
            Err(error) => break error.kind() == ErrorKind::WouldBlock,
        }
    };
    let open = silent.iter_mut().filter_map(|stream| is_open(stream).then_some(())).count();
    // After five seconds they end by themselves.
    assert!((open > 0 || begun.elapsed() > Duration::from_secs(5)) && open < 512, "{open}");
    // One that has shown its token stays, and another is let in.
    watching.send(Message::Ping(Default::default())).unwrap();
    assert!(std::iter::repeat_with(|| watching.read().unwrap()).take(1000).any(|message| message.is_pong()));
    next(&mut browser(address, ""));
    // Without a token they end by themselves.
    let deadline = Instant::now() + PATIENCE;
    while silent.iter_mut().any(is_open) {
        assert!(Instant::now() < deadline, "sockets without a token stay open");
        std::thread::sleep(Duration::from_millis(100));
    }
}

#[test]
fn browsers_that_join_between_two_rare_frame_sets_see_the_person_whole() {
    let config = TransportConfig { listen: vec!["tcp/127.0.0.1:0".to_owned()], ..TransportConfig::publisher(NAME) };
    let publisher = Publisher::open(&config).unwrap();
    publisher.set_calibration(&cameras()).unwrap();
    let encoded = template(1.0);
    let hash = encoded.template.hash;
    publisher.offer_template(4, hash, encoded.bytes.clone().into());
    let stamp = Stamp { template: hash, person: 4, frame: 7, capture_nanos: 1 };
    let joint_rotations = vec![[0.0, 0.0, 0.0, 1.0]];
    let motion = Motion { stamp, root_translation: [0.0, 0.0, 1.0], joint_rotations, nodes: Vec::new() };
    publisher.publish_person(&stamp, None, MotionEncoder::new(&encoded).encode(&motion).unwrap().into());
    let mut encoder = ColorEncoder::new(&encoded, ColorSettings::default(), 1);
    for (layer, bytes) in encoder.encode(stamp, &[[0.5, 0.2, 0.1, 1.0]; GAUSSIANS]).into_iter().enumerate() {
        publisher.publish_person(&stamp, Some(layer), bytes.into());
    }
    // Nothing more is published: the first browser gets what was, the second what the first one got.
    let server = server(&publisher.endpoints()[0], "127.0.0.1:0", false);
    let mut open = Vec::new();
    for _ in 0..2 {
        let (mut socket, mut page) = (browser(server.address(), ""), Page::default());
        let has_floor = |page: &Page| page.floor().is_some_and(|floor| floor.numbers()[3] > 0.0);
        watch(&mut socket, &mut page, "a whole person on the floor", |page, _| {
            page.people_shown() == 1 && page.is_complete() && has_floor(page)
        });
        assert!(page.colors().iter().all(|color| (color[0] - 0.5).abs() < 0.05 && (color[2] - 0.1).abs() < 0.05));
        page.choose(4);
        assert_eq!((page.person(0), page.person(1)), (Some(4), None));
        open.push((socket, page));
    }
}
