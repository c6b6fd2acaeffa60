//! Viewers come early, twice, stop, and are killed; the rig goes on.
#![allow(clippy::unwrap_used, clippy::panic)] // a test may fail by panicking, in its helpers too

use std::{
    path::Path,
    process::{Child, Command, Stdio},
    time::{Duration, Instant},
};

const PROGRAM: &str = env!("CARGO_BIN_EXE_flyrig-under-test");
/// Far longer than anything here takes: a hang fails instead of hanging.
const PATIENCE: Duration = Duration::from_secs(90);

/// A process that does not outlive its test.
struct Process(Child);

impl Process {
    fn start(args: &[&str], folder: &Path) -> Self {
        let child = Command::new(PROGRAM)
            .args(args)
            .current_dir(folder)
            .stdout(Stdio::null())
            .stderr(std::fs::File::create(folder.join(format!("{}.log", args[0]))).unwrap())
            .spawn()
            .unwrap();
        Self(child)
    }

    fn signal(&self, name: &str) {
        let status = Command::new("kill").args([&format!("-{name}"), &self.0.id().to_string()]).status().unwrap();
        assert!(status.success());
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn pictures(folder: &Path) -> usize {
    std::fs::read_dir(folder)
        .map_or(0, |entries| entries.flatten().filter(|e| e.path().extension().is_some_and(|e| e == "png")).count())
}

fn wait_until(what: &str, mut done: impl FnMut() -> bool) {
    let deadline = Instant::now() + PATIENCE;
    while !done() {
        assert!(Instant::now() < deadline, "waited in vain for {what}");
        std::thread::sleep(Duration::from_millis(50));
    }
}

#[test]
fn the_rig_outlives_every_kind_of_viewer() {
    let folder = tempfile::tempdir().unwrap();
    let port = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    let endpoint = format!("tcp/127.0.0.1:{port}");
    let config = format!(
        "[rig]\nname = \"viewers\"\n[source]\ncameras = [\"00\", \"03\"]\n[sim]\nwidth = 96\nheight = 96\ntexture_px = 128\n\
         [body]\ngaussians = 3000\nnodes = 100\n[output]\nwidth = 96\nheight = 96\n[transport]\nlisten = [\"{endpoint}\"]\n"
    );
    std::fs::write(folder.path().join("rig.toml"), config).unwrap();
    let watch = |out: &str| -> Process {
        let args = ["watch", "--rig", "viewers", "--connect", &endpoint, "--out", out];
        Process::start(&args, folder.path())
    };
    let seen = |out: &str| pictures(&folder.path().join(out));

    // Before the publisher.
    let early = watch("early");
    std::thread::sleep(Duration::from_millis(500));
    let mut rig = Process::start(&["run", "rig.toml"], folder.path());
    wait_until("the early viewer's pictures", || seen("early") > 3);

    // Twice at the same time, one of them through a viewpoint of its own.
    let second = Process::start(
        &[
            "watch",
            "--rig",
            "viewers",
            "--connect",
            &endpoint,
            "--out",
            "second",
            "--eye",
            "2,1,1.5",
            "--size",
            "64x48",
        ],
        folder.path(),
    );
    wait_until("the second viewer's pictures", || seen("second") > 3);
    let own = std::fs::read_dir(folder.path().join("second")).unwrap().flatten().next().unwrap().path();
    let size = image::image_dimensions(own).unwrap();
    assert_eq!(size, (64, 48));

    // Stopped: the other one and the rig go on.
    early.signal("STOP");
    let (before, while_stopped) = (seen("second"), seen("early"));
    wait_until("pictures while one viewer is stopped", || seen("second") > before + 20);
    assert!(seen("early") <= while_stopped + 1, "it really was stopped");
    early.signal("CONT");
    wait_until("the stopped viewer to catch up", || seen("early") > while_stopped + 5);

    // Killed.
    early.signal("KILL");
    let before = seen("second");
    wait_until("pictures after one viewer was killed", || seen("second") > before + 20);
    drop(second);
    assert!(rig.0.try_wait().unwrap().is_none(), "the rig is still up");

    // Asked to stop, the rig ends well.
    rig.signal("INT");
    wait_until("the rig to end", || rig.0.try_wait().unwrap().is_some());
    assert!(rig.0.wait().unwrap().success());
}
