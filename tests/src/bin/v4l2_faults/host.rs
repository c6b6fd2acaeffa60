//! Host functions: fault injection and counters of leaks.

use std::{
    fs::{self, File},
    os::unix::process::CommandExt as _,
    process::Command,
    thread,
    time::{Duration, Instant},
};

use flyrig_capture::camera_reports;

/// Sets a control of the kernel's test driver.
pub fn set_control(bus: &str, name: &str, value: i32) {
    let node = camera_reports().into_iter().find(|report| report.bus_info.as_deref() == Some(bus));
    let Some(report) = node else { return eprintln!("{bus} is not there") };
    let output = Command::new("v4l2-ctl")
        .args(["-d".as_ref(), report.node.node.as_os_str()])
        .arg("-c")
        .arg(format!("{name}={value}"))
        .output();
    match output {
        Ok(output) if output.status.success() => {}
        Ok(output) => eprintln!("{name} on {bus}: {}", String::from_utf8_lossy(&output.stderr)),
        Err(error) => eprintln!("v4l2-ctl: {error}"),
    }
}

/// Opens a camera in another process as another user; returns its success and its message.
pub fn open_as_nobody(bus: &str, user: u32) -> (bool, String) {
    let program = "/proc/self/exe";
    match Command::new(program).args(["--open", bus]).uid(user).gid(user).output() {
        Ok(output) => (output.status.success(), String::from_utf8_lossy(&output.stdout).trim().to_owned()),
        Err(error) => (false, error.to_string()),
    }
}

/// Unbinds and rebinds all cameras; returns the names of their nodes. `hold` keeps the old nodes open meanwhile, so that the
/// new ones get other numbers.
pub fn replug_all(hold: bool) -> Vec<String> {
    let nodes = |reports: &[flyrig_capture::CameraReport]| -> Vec<String> {
        reports.iter().map(|report| report.node.node.display().to_string()).collect()
    };
    let before = nodes(&camera_reports());
    let held: Vec<File> =
        if hold { before.iter().filter_map(|node| File::open(node).ok()).collect() } else { Vec::new() };
    let driver = "/sys/bus/platform/drivers/vivid";
    for action in ["unbind", "bind"] {
        if let Err(error) = fs::write(format!("{driver}/{action}"), "vivid.0") {
            eprintln!("{action}: {error}");
        }
    }
    let deadline = Instant::now() + Duration::from_secs(5);
    let mut after = nodes(&camera_reports());
    while after.len() < before.len() && Instant::now() < deadline {
        thread::sleep(Duration::from_millis(20));
        after = nodes(&camera_reports());
    }
    drop(held);
    after
}

/// Counts the open file descriptors of this process.
pub fn open_files() -> usize {
    fs::read_dir("/proc/self/fd").map_or(0, Iterator::count)
}

/// Counts the threads of this process.
pub fn threads() -> usize {
    fs::read_dir("/proc/self/task").map_or(0, Iterator::count)
}

/// Returns the CPU time of this process, seconds.
pub fn cpu_secs() -> f64 {
    let stat = fs::read_to_string("/proc/self/stat").unwrap_or_default();
    let after_name = stat.rsplit(')').next().unwrap_or("");
    let ticks: f64 = after_name.split_whitespace().skip(11).take(2).filter_map(|text| text.parse::<f64>().ok()).sum();
    ticks / 100.0
}
