//! Missing camera: the rig starts without it, and reports its state from the first second.
#![cfg(target_os = "linux")]
#![allow(clippy::unwrap_used, clippy::panic)] // a test may fail by panicking, in its helpers too

use std::{
    io::{Read as _, Write as _},
    net::TcpStream,
    os::unix::net::UnixDatagram,
    path::Path,
    process::{Command, Stdio},
    time::{Duration, Instant},
};

use flyrig_tests::{Running, free_port, run};

const PROGRAM: &str = env!("CARGO_BIN_EXE_flyrig-under-test");
/// Timeout, far longer than any step takes: a hang fails the test.
const PATIENCE: Duration = Duration::from_secs(90);

/// Writes a calibration, and a configuration of one camera that is not plugged in.
fn write_rig(folder: &Path, health: u16) {
    let sim = "width = 64\nheight = 64\ntexture_px = 64\ncameras.count = 1\n";
    std::fs::write(folder.join("sim.toml"), sim).unwrap();
    let args = ["sim", "export", "sim.toml", "--out", "calibration", "--frames", "1", "--no-truth"];
    let exported = run(PROGRAM, &args, folder).unwrap();
    assert_eq!(exported.code, Some(0), "{exported:?}");
    let rig = format!(
        "[source]\nkind = \"cameras\"\npath = \"calibration\"\n[[source.cameras]]\nname = \"00\"\nserial = \"none such\"\n\
         size = [64, 64]\n[perception]\npose = \"estimated\"\nmasks = \"estimated\"\n[transport]\n\
         listen = [\"tcp/127.0.0.1:0\"]\n[health]\nlisten = \"127.0.0.1:{health}\"\n"
    );
    std::fs::write(folder.join("rig.toml"), rig).unwrap();
}

fn page(port: u16) -> Option<String> {
    let mut client = TcpStream::connect(("127.0.0.1", port)).ok()?;
    client.write_all(b"GET /metrics HTTP/1.1\r\n\r\n").ok()?;
    let mut answer = String::new();
    client.read_to_string(&mut answer).ok()?;
    Some(answer)
}

#[test]
fn a_rig_starts_without_its_camera_and_says_so() {
    let folder = tempfile::tempdir().unwrap();
    let health = free_port();
    write_rig(folder.path(), health);
    let socket = folder.path().join("notify");
    let manager = UnixDatagram::bind(&socket).unwrap();
    manager.set_read_timeout(Some(PATIENCE)).unwrap();
    let child = Command::new(PROGRAM)
        .args(["run", "rig.toml"])
        .current_dir(folder.path())
        .env("NOTIFY_SOCKET", &socket)
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut rig = Running(child);
    // The watchdog is fed while the rig waits for a person whose shape it can measure.
    let mut states = String::new();
    while states.matches("WATCHDOG=1").count() < 2 {
        let mut bytes = [0; 1024];
        let length = manager.recv(&mut bytes).unwrap_or_else(|error| panic!("{error}, after {states}"));
        states += &String::from_utf8_lossy(&bytes[..length]);
    }
    assert!(states.contains("READY=1"), "{states}");
    let deadline = Instant::now() + PATIENCE;
    while !states.contains("STATUS=no camera delivers frames: camera 00") {
        assert!(Instant::now() < deadline, "{states}");
        let mut bytes = [0; 1024];
        let length = manager.recv(&mut bytes).unwrap();
        states += &String::from_utf8_lossy(&bytes[..length]);
    }
    // The page is published a moment after the status, and a machine that pauses may break an answer off.
    let lines = [
        "flyrig_camera_up{camera=\"00\"} 0",
        "flyrig_thread_restarts_total{thread=\"camera 00\"} 0",
        "flyrig_thread_stuck{thread=\"camera 00\"} 0",
    ];
    let deadline = Instant::now() + PATIENCE;
    loop {
        let metrics = page(health).unwrap_or_default();
        let Some(missing) = lines.iter().find(|line| !metrics.contains(**line)) else { break };
        assert!(Instant::now() < deadline, "{missing} in\n{metrics}");
        std::thread::sleep(Duration::from_millis(50));
    }
    assert!(rig.0.try_wait().unwrap().is_none(), "the rig must keep running");
    let id = rig.0.id().to_string();
    assert!(Command::new("kill").args(["-TERM", &id]).status().unwrap().success());
    let mut said = String::new();
    rig.0.stderr.take().unwrap().read_to_string(&mut said).unwrap();
    assert!(rig.0.wait().unwrap().success(), "the rig must exit with 0 on SIGTERM: {said}");
}

#[test]
fn a_recording_that_breaks_off_fails_the_command_after_a_clean_end() {
    let folder = tempfile::tempdir().unwrap();
    let sim = "width = 160\nheight = 160\ntexture_px = 64\nframes = 20\ncameras.count = 2\n";
    std::fs::write(folder.path().join("sim.toml"), sim).unwrap();
    let config = "[source]\nkind = \"sim\"\npath = \"sim.toml\"\nreal_time = false\ncameras = [\"00\", \"01\"]\n\
        [record]\njpeg_quality = 0\nrotate = \"1MB\"\n[perception]\npose = \"given\"\nmasks = \"given\"\n\
        [body]\ngaussians = 2000\nnodes = 50\n[transport]\nlisten = [\"tcp/127.0.0.1:0\"]\n";
    std::fs::write(folder.path().join("rig.toml"), config).unwrap();
    let command = |args: &[&str]| run(PROGRAM, args, folder.path()).unwrap();
    let whole = command(&["record", "rig.toml", "--out", "whole.mcap"]);
    assert_eq!(whole.code, Some(0), "{whole:?}");
    assert!(folder.path().join("whole-0002.mcap").exists(), "40 frames of 77 kB must fill three files of 1 MB");
    // A file blocks the path of the third part.
    std::fs::write(folder.path().join("take-0002.mcap"), "").unwrap();
    let broken = command(&["run", "rig.toml", "--record", "take.mcap"]);
    assert_eq!(broken.code, Some(1), "{broken:?}");
    assert!(broken.stderr.contains("run: 20 frame sets"), "the rig must go on: {}", broken.stderr);
    assert!(broken.stderr.contains("error: the recording broke off after"), "{}", broken.stderr);
    assert!(broken.stderr.contains("take-0002.mcap cannot be created"), "{}", broken.stderr);
}
