#[path = "../../tests/src/bin/v4l2_faults/mod.rs"]
mod faults;
fn main() -> std::process::ExitCode {
    faults::main()
}
