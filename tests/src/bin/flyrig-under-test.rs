//! `flyrig` command, built by this package so that its tests can run it.

use std::process::ExitCode;

fn main() -> ExitCode {
    flyrig::main()
}
