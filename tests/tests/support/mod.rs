//! Processes of rigs and viewers.
#![allow(dead_code, clippy::unwrap_used, clippy::panic)] // each test uses a part; a test may fail by panicking

use std::{
    path::Path,
    process::{Child, Command, Stdio},
    time::{Duration, Instant},
};

/// Timeout, far longer than any step takes: a hang fails the test.
pub const PATIENCE: Duration = Duration::from_secs(90);

/// Process that is killed when its test ends.
pub struct Process(pub Child);

impl Process {
    /// Starts `program`; its standard error goes to a file named after `log` in the folder.
    pub fn start(program: &str, args: &[&str], folder: &Path, log: &str) -> Self {
        let child = Command::new(program)
            .args(args)
            .current_dir(folder)
            .stdout(Stdio::null())
            .stderr(std::fs::File::create(folder.join(format!("{log}.log"))).unwrap())
            .spawn()
            .unwrap();
        Self(child)
    }

    /// Sends a signal, named without SIG.
    pub fn signal(&self, name: &str) {
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

/// Counts the PNG files in a folder.
pub fn pictures(folder: &Path) -> usize {
    std::fs::read_dir(folder)
        .map_or(0, |entries| entries.flatten().filter(|e| e.path().extension().is_some_and(|e| e == "png")).count())
}

/// Waits until the condition holds; panics at the timeout.
pub fn wait_until(what: &str, mut done: impl FnMut() -> bool) {
    wait_for(what, || done().then_some(()));
}

/// Waits for a value, which may be gone again a moment later; panics at the timeout.
pub fn wait_for<T>(what: &str, mut ready: impl FnMut() -> Option<T>) -> T {
    let deadline = Instant::now() + PATIENCE;
    loop {
        if let Some(value) = ready() {
            return value;
        }
        assert!(Instant::now() < deadline, "timed out waiting for {what}");
        std::thread::sleep(Duration::from_millis(50));
    }
}

/// Number of simulated cameras of [`small_rig`].
pub const SMALL_SIM: &str = "width = 96\nheight = 96\ntexture_px = 128\n";

/// Writes `rig.toml` and `sim.toml` of a small simulated rig with this name; returns the endpoint that it listens on. `more` is
/// appended to `rig.toml`.
pub fn small_rig(name: &str, folder: &Path, more: &str) -> String {
    let endpoint = format!("tcp/127.0.0.1:{}", flyrig_tests::free_port());
    let config = format!(
        "[rig]\nname = \"{name}\"\n[source]\npath = \"sim.toml\"\ncameras = [\"00\", \"03\"]\n\
         [perception]\npose = \"given\"\nmasks = \"given\"\n\
         [body]\ngaussians = 3000\nnodes = 100\n[output]\nwidth = 96\nheight = 96\n\
         [transport]\nlisten = [\"{endpoint}\"]\n{more}"
    );
    std::fs::write(folder.join("rig.toml"), config).unwrap();
    std::fs::write(folder.join("sim.toml"), SMALL_SIM).unwrap();
    endpoint
}
