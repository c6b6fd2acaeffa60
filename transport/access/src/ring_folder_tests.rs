//! Tests of rings and their keys.

use super::*;

fn new_ring() -> (tempfile::TempDir, Ring) {
    let folder = tempfile::tempdir().unwrap();
    let ring = Ring::create(&folder.path().join("keys"), "studio", &["rig.local".to_owned()], 7450).unwrap();
    (folder, ring)
}

#[test]
fn a_ring_and_its_keys_come_back_as_they_were_made() {
    let (folder, mut ring) = new_ring();
    let desk = ring.add("desk", Role::Viewer, 30).unwrap();
    let cameras = ring.add("left-pc", Role::Cameras, 30).unwrap();
    assert_eq!(desk.connect, ["rig.local:7450"]);
    assert_eq!(cameras.connect, ["rig.local:7451"]);
    assert_ne!(desk.private_key, cameras.private_key);
    let file = folder.path().join("desk.key");
    desk.write_new(&file).unwrap();
    assert_eq!(KeyFile::read(&file, &Role::ALL).unwrap(), desk);
    assert!(!format!("{desk:?} {ring:?}").contains("PRIVATE"));
    let again = Ring::open(ring.folder()).unwrap();
    assert_eq!(again.holders(), ring.holders());
    assert_eq!(again.authority().certificate, ring.authority().certificate);
    #[cfg(unix)]
    for secret in [file, ring.folder().join(AUTHORITY[1]), ring.folder().join(OWN[1])] {
        let mode = std::fs::metadata(&secret).unwrap().permissions();
        assert_eq!(std::os::unix::fs::PermissionsExt::mode(&mode) & 0o777, 0o600, "{}", secret.display());
    }
    // IPv6 addresses are written as such.
    let hosts = ["fd00::1".to_owned(), "10.0.0.5".to_owned()];
    let mut six = Ring::create(&folder.path().join("six"), "studio", &hosts, 9000).unwrap();
    assert_eq!(six.add("a", Role::Relay, 1).unwrap().connect, ["[fd00::1]:9000", "10.0.0.5:9000"]);
}

#[test]
fn a_rig_with_an_ipv6_host_listens_on_ipv6() {
    let folder = tempfile::tempdir().unwrap();
    let new = |name: &str, hosts: &[&str]| {
        let hosts: Vec<String> = hosts.iter().map(|host| (*host).to_owned()).collect();
        Ring::create(&folder.path().join(name), "studio", &hosts, 9000)
    };
    for (n, (hosts, listen, connect)) in [
        (&["fd00::5"][..], "[::]:9000", "[fd00::5]:9000"),
        (&["[fd00:0::5]"], "[::]:9000", "[fd00::5]:9000"),
        (&["rig.local", "::1"], "[::]:9000", "rig.local:9000"),
        (&["rig.local"], "0.0.0.0:9000", "rig.local:9000"),
        (&["10.0.0.5"], "0.0.0.0:9000", "10.0.0.5:9000"),
    ]
    .into_iter()
    .enumerate()
    {
        let mut ring = new(&n.to_string(), hosts).unwrap();
        assert_eq!(ring.address(Role::Viewer).to_string(), listen, "{hosts:?}");
        assert_eq!(ring.address(Role::Cameras).port(), 9001);
        assert_eq!(ring.add("desk", Role::Viewer, 1).unwrap().connect[0], connect, "{hosts:?}");
    }
    for (host, part) in [
        ("fe80::1%eth0", "--host fe80::1%eth0: other computers cannot use a link-local address or a zone"),
        ("[fe80::1]", "link-local"),
        ("fd00::5%2", "a zone"),
        ("::", "no computer is reached"),
        ("0.0.0.0", "no computer is reached"),
        ("[fd00::5]:9000", "without a port"),
        ("[rig.local]", "without a port"),
        ("fd00::g", "without a port"),
        ("a\u{1b}[2Jb", "--host a\\u{1b}[2Jb: give a name"),
    ] {
        let text = new("bad", &[host]).unwrap_err().to_string();
        assert!(text.contains(part), "{host}: {text}");
    }
    assert!(new("bad", &["a"; 65]).unwrap_err().to_string().contains("at most 64"));
}

#[test]
fn a_camera_key_names_its_cameras_and_keeps_them_when_it_is_renewed() {
    let (folder, mut ring) = new_ring();
    let file = |name: &str| folder.path().join(name);
    let names = |names: &[&str]| -> Vec<String> { names.iter().map(|name| (*name).to_owned()).collect() };
    let key = ring.add_file(&file("a.key"), "a", Role::Cameras, &names(&["left", "cam.2"]), 1).unwrap();
    assert_eq!(KeyFile::read(&file("a.key"), &[Role::Cameras]).unwrap(), key);
    assert!(key.may_send("left") && key.may_send("cam.2") && !key.may_send("right"));
    let again = ring.renew_file(&file("b.key"), "a", 1).unwrap();
    assert_eq!(again.cameras, key.cameras);
    let of_list = || Ring::open(ring.folder()).unwrap().valid_holder("a").unwrap().cameras.clone();
    assert_eq!(of_list(), key.cameras);
    // Keys without names, such as older ones, send every camera.
    let old = ring.add("old", Role::Cameras, 1).unwrap();
    assert!(old.may_send("left") && old.cameras.is_empty());
    let listed = std::fs::read_to_string(ring.folder().join(LIST)).unwrap();
    assert_eq!(listed.matches("cameras = [").count(), 1, "{listed}");
    assert!(!ring.add("desk", Role::Viewer, 1).unwrap().may_send("left"));
    for (role, cameras, part) in [
        (Role::Viewer, names(&["left"]), "a key of role viewer sends no cameras; add --role cameras"),
        (Role::Cameras, names(&["left", "a/b"]), "--camera 'a/b'"),
        (Role::Cameras, names(&["*"]), "--camera '*'"),
        (Role::Cameras, names(&[""]), "--camera ''"),
        (Role::Cameras, names(&["x"; 33]), "33 are too many"),
    ] {
        let error = ring.add_file(&file("c.key"), "c", role, &cameras, 1).unwrap_err().to_string();
        assert!(error.contains(part) && !file("c.key").exists(), "{error}");
    }
}

#[test]
fn changes_at_the_same_time_are_all_kept() {
    let (folder, mut ring) = new_ring();
    let file = |name: &str| folder.path().join(name);
    for n in 0..30 {
        ring.add_file(&file(&format!("r{n}.key")), &format!("r{n}"), Role::Viewer, &[], 1).unwrap();
        ring.add_file(&file(&format!("g{n}.key")), &format!("g{n}"), Role::Viewer, &[], 1).unwrap();
    }
    std::thread::scope(|scope| {
        for n in 0..100 {
            let (mut ring, file) = (Ring::open(ring.folder()).unwrap(), &file);
            let work = move || match n {
                0..40 => {
                    let name = format!("a{n}");
                    ring.add_file(&file(&format!("{name}.key")), &name, Role::Relay, &[], 1).unwrap();
                }
                40..70 => ring.revoke(&format!("g{}", n - 40)).unwrap(),
                _ => {
                    let name = format!("r{}", n - 70);
                    ring.renew_file(&file(&format!("{name}.new.key")), &name, 1).unwrap();
                }
            };
            std::thread::Builder::new().name("keys".to_owned()).spawn_scoped(scope, work).unwrap();
        }
    });
    let ring = Ring::open(ring.folder()).unwrap();
    let print = |name: &str| {
        let key = KeyFile::read(&file(name), &Role::ALL).unwrap();
        fingerprint(&CertificateDer::from_pem_slice(key.certificate.as_bytes()).unwrap())
    };
    let is_valid = |name: &str| ring.holders().iter().any(|of| of.fingerprint == print(name) && !of.revoked);
    assert!((0..40).all(|n| is_valid(&format!("a{n}.key"))), "every key that was added is listed");
    assert!((0..30).all(|n| !is_valid(&format!("g{n}.key"))), "every revocation holds");
    assert!((0..30).all(|n| is_valid(&format!("r{n}.new.key")) && !is_valid(&format!("r{n}.key"))), "every renewal");
    let mut numbers: Vec<usize> = ring.holders().iter().filter(|of| !of.revoked).map(|of| of.number).collect();
    numbers.sort_unstable();
    numbers.dedup();
    assert_eq!(numbers.len(), 70, "no two holders have one number");
}

#[test]
fn what_cannot_be_written_changes_nothing() {
    let (folder, mut ring) = new_ring();
    let file = folder.path().join("desk.key");
    ring.add_file(&file, "desk", Role::Viewer, &[], 1).unwrap();
    let before = std::fs::read(ring.folder().join(LIST)).unwrap();
    let nowhere = folder.path().join("no/such/desk.key");
    for (error, part) in [
        (ring.renew_file(&nowhere, "desk", 1), "no/such/desk.key: cannot be written"),
        (ring.renew_file(&file, "desk", 1), "desk.key: is there already"),
        (ring.add_file(&nowhere, "two", Role::Viewer, &[], 1), "cannot be written"),
    ] {
        let text = error.unwrap_err().to_string();
        assert!(text.contains(part), "{text}");
        assert_eq!(std::fs::read(ring.folder().join(LIST)).unwrap(), before, "{part}");
    }
    assert!(ring.valid_holder("desk").is_some() && ring.holders().len() == 1);
    // The key can be written and the list cannot, as on a full disk: a folder lies where the list is written first.
    let partial = ring.folder().join(format!("{LIST}.{}.partial", std::process::id()));
    std::fs::create_dir(&partial).unwrap();
    let new = folder.path().join("new.key");
    for error in [ring.renew_file(&new, "desk", 1), ring.add_file(&new, "two", Role::Viewer, &[], 1)] {
        let text = error.unwrap_err().to_string();
        assert!(text.contains("ring.toml: cannot be written"), "{text}");
        assert!(!new.exists(), "a key that is not listed does not stay");
    }
    assert!(ring.revoke("desk").is_err() && ring.valid_holder("desk").is_some());
    assert_eq!(std::fs::read(ring.folder().join(LIST)).unwrap(), before);
    std::fs::remove_dir(partial).unwrap();
    ring.renew_file(&new, "desk", 1).unwrap();
    assert_eq!(Ring::open(ring.folder()).unwrap().holders(), ring.holders());
}

#[test]
fn a_command_that_was_ended_between_key_and_list_is_undone_by_the_next() {
    let (folder, mut ring) = new_ring();
    let (list, file) = (ring.folder().join(LIST), folder.path().join("new.key"));
    ring.add("desk", Role::Viewer, 1).unwrap();
    let before = std::fs::read(&list).unwrap();
    let note = |file: &Path| FolderLock::take(ring.folder()).unwrap().begin(file).unwrap();
    let mut other = Ring::open(ring.folder()).unwrap();
    // The key is written, the list is not.
    other.renew_file(&file, "desk", 1).unwrap();
    std::fs::write(&list, &before).unwrap();
    note(&file);
    other.refresh().unwrap();
    assert!(!file.exists() && !ring.folder().join("ring.unfinished").exists());
    assert_eq!(std::fs::read(&list).unwrap(), before, "the old key is valid");
    // The next command takes the same name, without a word about a file that is there.
    other.renew_file(&file, "desk", 1).unwrap();
    std::fs::write(&list, &before).unwrap();
    note(&file);
    let again = other.renew_file(&file, "desk", 1).unwrap();
    assert_eq!(KeyFile::read(&file, &Role::ALL).unwrap(), again);
    // Ended after the list, and before a key was written: nothing is removed.
    note(&file);
    other.refresh().unwrap();
    assert!(file.exists(), "its key is listed");
    // Ended while the key was written.
    let whole = std::fs::read_to_string(&file).unwrap();
    for half in ["", "# Key", &whole[..whole.len() / 2]] {
        let file = folder.path().join("half.key");
        std::fs::write(&file, half).unwrap();
        note(&file);
        other.refresh().unwrap();
        assert!(!file.exists(), "{half}");
    }
    let foreign = folder.path().join("mine.txt");
    std::fs::write(&foreign, "text").unwrap();
    note(&foreign);
    other.refresh().unwrap();
    assert!(foreign.exists(), "a file that is no key of this ring stays");
    let (_folder, mut stranger) = new_ring();
    let foreign = folder.path().join("stranger.key");
    stranger.add_file(&foreign, "desk", Role::Viewer, &[], 1).unwrap();
    note(&foreign);
    other.refresh().unwrap();
    assert!(foreign.exists(), "nor does a key of another rig go");
}

#[test]
fn numbers_are_given_once_and_again_after_they_were_revoked() {
    let (_folder, mut ring) = new_ring();
    let names: Vec<String> = (0..4).map(|n| ring.add(&format!("v{n}"), Role::Viewer, 1).unwrap().topic_name).collect();
    assert!(names.iter().enumerate().all(|(n, name)| name.ends_with(&format!("-{n}"))), "{names:?}");
    ring.revoke("v1").unwrap();
    assert_eq!(ring.add("v4", Role::Viewer, 1).unwrap().topic_name, names[1]);
    assert_eq!(ring.renew("v2", 1).unwrap().topic_name, names[2]);
    // The same name again, after it was revoked.
    assert!(ring.add("v1", Role::Viewer, 1).unwrap().topic_name.ends_with("-4"));
    let valid: Vec<_> =
        ring.holders().iter().filter(|of| !of.revoked).map(|of| (of.name.as_str(), of.number)).collect();
    assert_eq!(valid, [("v0", 0), ("v3", 3), ("v4", 1), ("v2", 2), ("v1", 4)]);
    for _ in 0..2 * MAX_REVOKED {
        ring.renew("v0", 1).unwrap();
    }
    assert_eq!(ring.holders().len(), 5 + MAX_REVOKED, "the list does not grow for ever");
    assert_eq!(Ring::open(ring.folder()).unwrap().holders(), ring.holders());
    let prints: std::collections::BTreeSet<_> = ring.holders().iter().map(|of| of.fingerprint.clone()).collect();
    assert_eq!(prints.len(), ring.holders().len());
}

#[test]
fn requests_that_are_not_possible_are_refused_in_words_and_change_nothing() {
    let (folder, mut ring) = new_ring();
    ring.add("desk", Role::Viewer, 1).unwrap();
    let before = std::fs::read(ring.folder().join(LIST)).unwrap();
    let words = |result: Result<(), AccessError>| result.unwrap_err().to_string();
    for (result, part) in [
        (ring.add("desk", Role::Cameras, 1).map(drop), "flyrig keys renew desk"),
        (ring.add("a/b", Role::Viewer, 1).map(drop), "holder 'a/b'"),
        (ring.add("", Role::Viewer, 1).map(drop), "holder ''"),
        (ring.add("x", Role::Viewer, 0).map(drop), "--days 0"),
        (ring.add("x", Role::Viewer, u64::MAX).map(drop), "use 1 to 36500"),
        (ring.renew("x", 1).map(drop), "'x' has no key; known: desk"),
        (ring.revoke("x"), "'x' has no key; known: desk"),
    ] {
        let text = words(result);
        assert!(text.contains(part), "{text}");
    }
    assert_eq!(std::fs::read(ring.folder().join(LIST)).unwrap(), before);
    let new = |name: &str, rig: &str, hosts: &[&str], port| {
        let hosts: Vec<String> = hosts.iter().map(|host| (*host).to_owned()).collect();
        words(Ring::create(&folder.path().join(name), rig, &hosts, port).map(drop))
    };
    assert!(new("keys", "studio", &["a"], 1).contains("is there already"));
    assert!(new("b", "stu dio", &["a"], 1).contains("rig 'stu dio'"));
    assert!(new("b", "studio", &[], 1).contains("--host"));
    assert!(new("b", "studio", &["a:7450"], 1).contains("without a port"));
    assert!(new("b", "studio", &["a"], 0).contains("--port 0"));
    assert!(new("none/b", "studio", &["a"], 1).contains("cannot be made"));
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1, "nothing half-made stays");
}

#[test]
fn damaged_rings_and_keys_are_named() {
    let (folder, mut ring) = new_ring();
    let key = folder.path().join("desk.key");
    ring.add("desk", Role::Viewer, 1).unwrap().write_new(&key).unwrap();
    let good = std::fs::read_to_string(&key).unwrap();
    let words = |text: &[u8]| {
        std::fs::write(&key, text).unwrap();
        KeyFile::read(&key, &Role::ALL).unwrap_err().to_string()
    };
    for (text, part) in [
        (String::new(), "is no key"),
        ("x = ".to_owned(), "is no key"),
        (good.replace("version = 1", "version = 2"), "version 2, this program knows 1; update"),
        (good.replace("connect = [\"rig.local:7450\"]", "connect = []"), "is damaged"),
        (good.replace("topic_name = \"", "topic_name = \"*/"), "is damaged"),
        (good.replace("role = \"viewer\"", "role = \"king\""), "is damaged"),
        (good.replacen("BEGIN CERTIFICATE", "BEGIN CERT", 1), "is damaged"),
        (good.replace("BEGIN PRIVATE", "BEGIN PUBLIC"), "is damaged"),
    ] {
        let error = words(text.as_bytes());
        assert!(error.contains("desk.key") && error.contains(part), "{part}: {error}");
    }
    assert!(words(&[0xff; 100]).contains("is no key"));
    assert!(words(&vec![b'#'; 100_000]).contains("too large"));
    std::fs::write(&key, &good).unwrap();
    assert!(KeyFile::read(&key, &[Role::Cameras]).unwrap_err().to_string().contains("is a key of role viewer"));
    // Every byte of a key and of a list, changed: an error or a key, never a panic.
    let list = ring.folder().join(LIST);
    let listed = std::fs::read(&list).unwrap();
    for n in (0..good.len()).step_by(7) {
        let mut bytes = good.clone().into_bytes();
        bytes[n] = bytes[n].wrapping_add(n as u8 | 1);
        std::fs::write(&key, &bytes).unwrap();
        let _ = KeyFile::read(&key, &Role::ALL);
    }
    for n in 0..listed.len() {
        let mut bytes = listed.clone();
        bytes[n] = bytes[n].wrapping_add(n as u8 | 1);
        std::fs::write(&list, &bytes).unwrap();
        let _ = Ring::open(ring.folder());
    }
    std::fs::write(&list, "version = 1").unwrap();
    assert!(Ring::open(ring.folder()).unwrap_err().to_string().contains("ring.toml: is no list of keys"));
    std::fs::write(&list, &listed).unwrap();
    std::fs::write(ring.folder().join(AUTHORITY[1]), "nothing").unwrap();
    assert!(Ring::open(ring.folder()).unwrap_err().to_string().contains("authority-key.pem: is damaged"));
    std::fs::remove_file(ring.folder().join(OWN[0])).unwrap();
    std::fs::write(ring.folder().join(AUTHORITY[1]), "").unwrap();
    assert!(Ring::open(&folder.path().join("none")).unwrap_err().to_string().contains("flyrig keys new"));
}
