//! Fault injection through real camera drivers. `make test-v4l2` runs it inside a virtual machine whose kernel has its test
//! drivers loaded (`scripts/test-v4l2.sh`). Prints a table of faults; fails when a bound is exceeded.

#[cfg(target_os = "linux")]
#[path = "v4l2_faults/mod.rs"]
mod faults;

#[cfg(target_os = "linux")]
fn main() -> std::process::ExitCode {
    faults::main()
}

#[cfg(not(target_os = "linux"))]
fn main() {}
