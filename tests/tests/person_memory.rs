//! Saved person: `flyrig run` resumes the person that it saved.
#![allow(clippy::unwrap_used)] // a test may fail by panicking

mod support;

const PROGRAM: &str = env!("CARGO_BIN_EXE_flyrig-under-test");

#[test]
fn a_rig_resumes_the_person_that_it_saved() {
    let folder = tempfile::tempdir().unwrap();
    support::small_rig("memory", folder.path(), "");
    std::fs::write(folder.path().join("sim.toml"), format!("{}frames = 6\n", support::SMALL_SIM)).unwrap();
    let path = folder.path().join("rig.toml");
    let config = std::fs::read_to_string(&path).unwrap();
    let config = config.replace("nodes = 100\n", "nodes = 100\nperson = \"me.person\"\n");
    std::fs::write(&path, config.replace("[source]\n", "[source]\nreal_time = false\n")).unwrap();

    let first = flyrig_tests::run(PROGRAM, &["run", "rig.toml"], folder.path()).unwrap();
    assert_eq!(first.code, Some(0), "{}", first.stderr);
    let saved = std::fs::read(folder.path().join("me.person")).unwrap();
    assert!(saved.len() > 100_000 && !first.stderr.contains("resumed"), "{}", first.stderr);
    // It has learnt no avatar.
    let none = flyrig_tests::run(PROGRAM, &["avatar", "build", "me.person", "--out", "me.flyavatar"], folder.path());
    let none = none.unwrap();
    assert_eq!(none.code, Some(1));
    assert!(none.stderr.contains("me.person holds no avatar yet"), "{}", none.stderr);
    assert!(!folder.path().join("me.flyavatar").exists());
    let second = flyrig_tests::run(PROGRAM, &["run", "rig.toml"], folder.path()).unwrap();
    assert_eq!(second.code, Some(0), "{}", second.stderr);
    assert!(second.stderr.contains("the person is resumed from me.person"), "{}", second.stderr);

    std::fs::write(folder.path().join("me.person"), &saved[..saved.len() / 2]).unwrap();
    let third = flyrig_tests::run(PROGRAM, &["run", "rig.toml"], folder.path()).unwrap();
    assert_eq!(third.code, Some(1));
    assert!(third.stderr.contains("saved person me.person: "), "{}", third.stderr);
}
