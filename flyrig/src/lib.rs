//! The `flyrig` command.
fn main() {}
