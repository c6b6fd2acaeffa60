//! Helpers of this and other crates' tests.

use crate::{AdapterChoice, GpuContext};

/// Runs a test with the kernels of the best adapter, then with those of the processor.
///
/// # Panics
/// Without an adapter.
#[allow(clippy::expect_used)]
pub fn on_both(test: impl Fn(&GpuContext)) {
    let device = GpuContext::new(&AdapterChoice::Best).expect("a graphics adapter");
    test(&device);
    test(&device.on_processor());
}
