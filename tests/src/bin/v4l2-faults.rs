//! What real drivers do to a rig, and what the rig makes of it: run by `make test-v4l2` inside a virtual machine whose
//! kernel has its test drivers loaded (`scripts/test-v4l2.sh`). Prints a table; fails when a bound is broken.

#[cfg(target_os = "linux")]
#[path = "v4l2_faults/mod.rs"]
mod faults;

#[cfg(target_os = "linux")]
fn main() -> std::process::ExitCode {
    faults::main()
}

#[cfg(not(target_os = "linux"))]
fn main() {}
