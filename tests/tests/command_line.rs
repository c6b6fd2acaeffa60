//! The command explains itself and refuses what it cannot do.
#![allow(clippy::unwrap_used, clippy::panic)] // a test may fail by panicking, in its helpers too

use flyrig_tests::run;

const PROGRAM: &str = env!("CARGO_BIN_EXE_flyrig-under-test");

#[test]
fn the_printed_configuration_is_accepted_and_a_wrong_key_is_not() {
    let folder = tempfile::tempdir().unwrap();
    let printed = run(PROGRAM, &["config", "print"], folder.path()).unwrap();
    assert_eq!(printed.code, Some(0));
    std::fs::write(folder.path().join("rig.toml"), &printed.stdout).unwrap();
    let checked = run(PROGRAM, &["config", "check", "rig.toml"], folder.path()).unwrap();
    assert_eq!((checked.code, checked.stdout.as_str()), (Some(0), "rig.toml is right\n"));

    std::fs::write(folder.path().join("rig.toml"), printed.stdout.replace("max_wait_ms", "max_wait_msec")).unwrap();
    let refused = run(PROGRAM, &["config", "check", "rig.toml"], folder.path()).unwrap();
    assert_eq!(refused.code, Some(1));
    assert!(refused.stderr.contains("unknown field `max_wait_msec`"), "{}", refused.stderr);
    assert!(refused.stderr.contains("did you mean `max_wait_ms`?"), "{}", refused.stderr);
    let missing = run(PROGRAM, &["run", "nowhere.toml"], folder.path()).unwrap();
    assert_eq!(missing.code, Some(1));
    assert!(missing.stderr.contains("cannot read the configuration nowhere.toml"), "{}", missing.stderr);
}

#[test]
fn help_teaches() {
    let folder = tempfile::tempdir().unwrap();
    let help = run(PROGRAM, &["--help"], folder.path()).unwrap();
    assert_eq!(help.code, Some(0));
    for word in ["demo", "run", "watch", "eval", "config", "flyrig config print > rig.toml"] {
        assert!(help.stdout.contains(word), "{word}");
    }
    let unknown = run(PROGRAM, &["--adapter", "no such card", "demo"], folder.path()).unwrap();
    assert_eq!(unknown.code, Some(1));
    assert!(unknown.stderr.contains("no graphics adapter has 'no such card'"), "{}", unknown.stderr);
}
