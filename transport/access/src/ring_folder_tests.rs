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
fn numbers_are_given_once_and_again_after_they_were_revoked() {
    let (_folder, mut ring) = new_ring();
    let names: Vec<String> =
        (0..4).map(|n| ring.add(&format!("v{n}"), Role::Viewer, 1).unwrap().topic_name).collect();
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
