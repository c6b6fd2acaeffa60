//! Background process of a test.

use std::process::Child;

/// Guard that kills the process when the test ends, also by a panic.
#[derive(Debug)]
pub struct Running(pub Child);

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}
