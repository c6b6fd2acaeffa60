//! Oversized viewpoint: its viewer gets an error that names the limit; the rig and the other viewers go on.
#![allow(clippy::unwrap_used)] // a test may fail by panicking

mod support;

use support::{Process, pictures, small_rig, wait_until};

const PROGRAM: &str = env!("CARGO_BIN_EXE_flyrig-under-test");

#[test]
fn a_view_that_is_too_large_is_refused_to_its_viewer_alone() {
    let folder = tempfile::tempdir().unwrap();
    let endpoint = small_rig("oversized", folder.path(), "");
    let watch = |log: &str, more: &[&str]| {
        let mut args = vec!["watch", "--rig", "oversized", "--connect", &endpoint, "--out", log];
        args.extend(more);
        Process::start(PROGRAM, &args, folder.path(), log)
    };
    let log = |name: &str| std::fs::read_to_string(folder.path().join(format!("{name}.log"))).unwrap_or_default();
    let seen = |out: &str| pictures(&folder.path().join(out));
    let mut rig = Process::start(PROGRAM, &["run", "rig.toml"], folder.path(), "run");
    let _plain = watch("plain", &[]);
    wait_until("the plain viewer's images", || seen("plain") > 3);

    // More pixels per second than the budget of all viewers together.
    let _greedy = watch("greedy", &["--eye", "3,0,1.5", "--size", "2000x2000"]);
    // A line may be read while it is being written.
    let says = |name: &str, parts: [&str; 3]| parts.iter().all(|part| log(name).contains(part));
    let rate = ["the rig refuses the viewpoint", "Mpx/s", "ask for"];
    wait_until("the refusal of the rate", || says("greedy", rate));

    // Larger than Mesa's software adapter can bind; other adapters refuse the rate.
    let _large = watch("large", &["--eye", "3,0,1.5", "--size", "4096x4096"]);
    wait_until("the refusal of the size", || says("large", ["the rig refuses the viewpoint", "Mpx", "ask for"]));

    let before = seen("plain");
    wait_until("the plain viewer's images after that", || seen("plain") > before + 10);
    assert!(rig.0.try_wait().unwrap().is_none(), "the rig must keep running: {}", log("run"));
    rig.signal("INT");
    wait_until("the rig to end", || rig.0.try_wait().unwrap().is_some());
    assert!(rig.0.wait().unwrap().success());
}
