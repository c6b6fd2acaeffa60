//! A program beside a test.

use std::process::Child;

/// Ends the process when the test ends, however it does.
#[derive(Debug)]
pub struct Running(pub Child);

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}
