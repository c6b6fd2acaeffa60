//! Tests of a gate in front of a session that echoes.

use std::{
    io::{ErrorKind, Read as _, Write as _},
    net::{SocketAddr, TcpListener, TcpStream},
    sync::Arc,
    thread::Builder,
    time::{Duration, Instant},
};

use rustls_pki_types::ServerName;
use tokio_rustls::rustls::{ClientConnection, ServerConnection, StreamOwned};

use super::*;
use crate::KeyFile;

struct Place {
    _folder: tempfile::TempDir,
    ring: Ring,
    gate: Gate,
}

/// Starts a session that echoes what it receives, behind a letter for the common name that it was shown.
fn session(inner: &Inner) -> SocketAddr {
    let (certificate, key) = inner.certificate_and_key();
    let config = tls::server(tls::client_verifier(inner.authority()).unwrap(), certificate, key).unwrap();
    let config = Arc::new(config);
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap();
    let spawn = |work: Box<dyn FnOnce() + Send>| drop(Builder::new().name("session".to_owned()).spawn(work).unwrap());
    spawn(Box::new(move || {
        for stream in listener.incoming() {
            let config = Arc::clone(&config);
            spawn(Box::new(move || {
                let connection = ServerConnection::new(config).unwrap();
                let mut stream = StreamOwned::new(connection, stream.unwrap());
                let mut bytes = [0; 4096];
                while let Ok(count @ 1..) = stream.read(&mut bytes) {
                    let names = stream.conn.peer_certificates().unwrap()[0].to_vec();
                    let is_viewer = names.windows(8).any(|part| part == b"viewer-0");
                    stream.write_all(if is_viewer { b"v" } else { b"?" }).unwrap();
                    stream.write_all(&bytes[..count]).unwrap();
                }
            }));
        }
    }));
    address
}

fn place() -> Place {
    let folder = tempfile::tempdir().unwrap();
    let ring = Ring::create(&folder.path().join("keys"), "studio", &["127.0.0.1".to_owned()], 7450).unwrap();
    let inner = Inner::new().unwrap();
    let session = session(&inner);
    let any = SocketAddr::from(([127, 0, 0, 1], 0));
    let gate = Gate::start(&ring, &[Role::Viewer], any, inner, session).unwrap();
    Place { _folder: folder, ring, gate }
}

impl Place {
    fn here(&self, key: KeyFile) -> KeyFile {
        KeyFile { connect: vec![self.gate.address().to_string()], ..key }
    }

    fn add(&mut self, name: &str) -> KeyFile {
        let key = self.ring.add(name, Role::Viewer, 1).unwrap();
        self.here(key)
    }

    /// Issues a key that ends at a time, in seconds since 1970.
    fn add_until(&mut self, name: &str, end: u64) -> KeyFile {
        self.add(name);
        let key = self.ring.replace_validity(name, end);
        self.here(key)
    }
}

fn connect(key: &KeyFile) -> StreamOwned<ClientConnection, TcpStream> {
    let config = tls::client(&key.authority, &key.certificate, &key.private_key).unwrap();
    let stream = TcpStream::connect(&key.connect[0]).unwrap();
    stream.set_read_timeout(Some(Duration::from_secs(10))).unwrap();
    let name = ServerName::try_from("127.0.0.1").unwrap();
    StreamOwned::new(ClientConnection::new(Arc::new(config), name).unwrap(), stream)
}

fn echo(stream: &mut StreamOwned<ClientConnection, TcpStream>, text: &[u8]) -> Vec<u8> {
    stream.write_all(text).unwrap();
    let mut back = vec![0; text.len() + 1];
    stream.read_exact(&mut back).unwrap();
    back
}

/// Asks again until it is so: the gate reads its list from time to time.
fn until(what: &str, mut is_so: impl FnMut() -> bool) {
    let end = Instant::now() + Duration::from_secs(90);
    while !is_so() {
        assert!(Instant::now() < end, "waited in vain for {what}");
        std::thread::sleep(Duration::from_millis(50));
    }
}

/// Knocks until the key is refused in these words, which are returned: on a busy machine an answer may be late.
fn refused(key: &KeyFile, words: &str) -> String {
    let mut text = String::new();
    until(words, || {
        text = key.knock().err().map_or_else(String::new, |error| error.to_string());
        text.contains(words)
    });
    text
}

fn admitted(key: &KeyFile) {
    until("the gate to admit a key", || key.knock().is_ok());
}

/// Waits until a connection ends on which nothing more comes; returns the time by the turns that this thread had. A machine that pauses or is
/// busy has fewer of them.
fn ended(stream: &mut StreamOwned<ClientConnection, TcpStream>) -> Duration {
    let turn = Duration::from_millis(10);
    stream.sock.set_read_timeout(Some(turn)).unwrap();
    for turns in 0..9000 {
        match stream.read(&mut [0; 9]) {
            Ok(1..) => panic!("something more came"),
            Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => {}
            _ => return turns * turn,
        }
    }
    panic!("it does not end");
}

#[test]
fn holders_are_passed_on_under_their_number() {
    let mut place = place();
    let mut stream = connect(&place.add("desk"));
    assert_eq!(echo(&mut stream, b"hello"), b"vhello");
    let mut stream = connect(&place.add("two"));
    assert_eq!(echo(&mut stream, b"hello"), b"?hello", "another number");
}

#[test]
fn a_key_that_expires_is_refused_and_an_open_connection_ends() {
    let mut place = place();
    refused(&place.add_until("old", now_secs() - 10), "refuses the key of 'old': it expired on ");
    // One that ends in the middle.
    let mut stream = connect(&place.add_until("soon", now_secs() + 8));
    echo(&mut stream, b"hello");
    assert!(ended(&mut stream) < Duration::from_secs(13));
}

#[test]
fn a_list_that_cannot_be_read_changes_nothing() {
    let mut place = place();
    let key = place.add("desk");
    let mut stream = connect(&key);
    echo(&mut stream, b"hello");
    std::fs::write(place.ring.folder().join("ring.toml"), "half a li").unwrap();
    std::thread::sleep(2 * CHECK_EVERY);
    assert_eq!(echo(&mut stream, b"again"), b"vagain");
    admitted(&key);
}

/// As a gate without file descriptors finds it: the list is there, and cannot be opened for a while.
#[test]
fn a_revocation_that_could_not_be_read_is_read_later_whatever_the_time_of_its_list() {
    let mut place = place();
    let key = place.add("desk");
    let mut stream = connect(&key);
    echo(&mut stream, b"hello");
    std::thread::sleep(2 * CHECK_EVERY);
    let list = place.ring.folder().join("ring.toml");
    let copy = list.with_file_name("copy");
    std::fs::create_dir(&copy).unwrap();
    for name in ["ring.toml", "authority.pem", "authority-key.pem", "rig.pem", "rig-key.pem"] {
        std::fs::copy(list.with_file_name(name), copy.join(name)).unwrap();
    }
    Ring::open(&copy).unwrap().revoke("desk").unwrap();
    let revoked = copy.join("ring.toml");
    // A folder of the same name and time cannot be read.
    std::fs::remove_file(&list).unwrap();
    std::fs::create_dir(&list).unwrap();
    let time = std::fs::metadata(&list).unwrap().modified().unwrap();
    std::thread::sleep(3 * CHECK_EVERY);
    assert_eq!(echo(&mut stream, b"again"), b"vagain", "nothing is known yet");
    std::fs::remove_dir(&list).unwrap();
    std::fs::File::options().write(true).open(&revoked).unwrap().set_modified(time).unwrap();
    std::fs::rename(&revoked, &list).unwrap();
    let took = ended(&mut stream);
    assert!(took < Duration::from_secs(2), "{took:?}");
    refused(&key, "it was revoked");
}

#[test]
fn two_changes_within_the_resolution_of_file_times_are_both_seen() {
    let mut place = place();
    let (one, two) = (place.add("one"), place.add("two"));
    let list = place.ring.folder().join("ring.toml");
    place.ring.revoke("one").unwrap();
    let time = std::fs::metadata(&list).unwrap().modified().unwrap();
    std::thread::sleep(3 * CHECK_EVERY);
    refused(&one, "it was revoked");
    admitted(&two);
    place.ring.revoke("two").unwrap();
    std::fs::File::options().write(true).open(&list).unwrap().set_modified(time).unwrap();
    refused(&two, "it was revoked");
}

#[test]
fn revoked_and_expired_keys_are_refused_in_the_same_words_after_a_restart() {
    let mut place = place();
    let (revoked, forgotten) = (place.add("revoked"), place.add("forgotten"));
    let expired = place.add_until("expired", now_secs() - 10);
    place.ring.revoke("forgotten").unwrap();
    // Only the holders revoked last stay listed.
    place.add("busy");
    for _ in 0..300 {
        place.ring.renew("busy", 1).unwrap();
    }
    place.ring.revoke("revoked").unwrap();
    assert!(place.ring.holders().iter().all(|of| of.name != "forgotten"));
    let refusals = |address: SocketAddr| {
        let words = [(&revoked, "it was revoked"), (&forgotten, "it was revoked"), (&expired, "it expired on")];
        words.map(|(key, words)| {
            let here = KeyFile { connect: vec![address.to_string()], ..key.clone() };
            refused(&here, words).replace(&address.to_string(), "HERE")
        })
    };
    let before = refusals(place.gate.address());
    let Place { _folder, ring, gate } = place;
    drop(gate);
    let inner = Inner::new().unwrap();
    let session = session(&inner);
    let any = SocketAddr::from(([127, 0, 0, 1], 0));
    let gate = Gate::start(&Ring::open(ring.folder()).unwrap(), &[Role::Viewer], any, inner, session).unwrap();
    assert_eq!(refusals(gate.address()), before);
}

#[test]
fn a_holder_may_send_its_own_cameras_at_any_time() {
    let mut place = place();
    let file = place.ring.folder().join("a.key");
    let a = place.ring.add_file(&file, "a", Role::Cameras, &["left".to_owned()], 1).unwrap();
    let all = place.ring.add("all", Role::Cameras, 1).unwrap();
    let viewer = place.ring.add("desk", Role::Viewer, 1).unwrap();
    let holders = place.gate.holders();
    until("the new holders", || holders.may_send(&a.topic_name, "left") && holders.may_send(&all.topic_name, "right"));
    assert!(holders.may_send(&a.topic_name, "left") && !holders.may_send(&a.topic_name, "right"));
    assert!(holders.may_send(&all.topic_name, "right"));
    for name in [viewer.topic_name.as_str(), "", "ffffffff-0", "*"] {
        assert!(!holders.may_send(name, "left"), "{name}");
    }
    place.ring.revoke("a").unwrap();
    until("the revocation", || !holders.may_send(&a.topic_name, "left"));
}

#[test]
fn one_key_has_its_share_of_connections() {
    let mut place = place();
    let key = place.add("greedy");
    let other = place.add("other");
    let mut open: Vec<_> = (0..CONNECTIONS_OF_ONE).map(|_| connect(&key)).collect();
    for stream in &mut open {
        echo(stream, b"x");
    }
    let mut more = connect(&key);
    let _ = more.write_all(b"x");
    assert!(!matches!(more.read(&mut [0; 9]), Ok(1..)));
    assert_eq!(echo(&mut connect(&other), b"x"), b"?x");
    drop(open);
    // Places are given back.
    let end = Instant::now() + Duration::from_secs(90);
    loop {
        let mut stream = connect(&key);
        if stream.write_all(b"x").is_ok() && matches!(stream.read(&mut [0; 9]), Ok(1..)) {
            break;
        }
        assert!(Instant::now() < end, "no place became free");
        std::thread::sleep(Duration::from_millis(100));
    }
}

#[test]
fn noise_and_plain_text_get_nothing() {
    let place = place();
    for text in [&b"GET / HTTP/1.1\r\n\r\n"[..], &[0; 3000], &[0x16, 3, 1, 0xff, 0xff, 1, 0, 0, 1]] {
        let mut stream = TcpStream::connect(place.gate.address()).unwrap();
        stream.set_read_timeout(Some(Duration::from_secs(10))).unwrap();
        let _ = stream.write_all(text);
        let mut back = Vec::new();
        let _ = stream.read_to_end(&mut back);
        assert!(back.len() < 100, "{} bytes", back.len());
    }
}
