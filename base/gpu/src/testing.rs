//! Helpers for the tests of this and other crates.

use crate::{AdapterChoice, GpuContext};

/// Opens the best adapter by its name, so that sessions run their kernels on it even where it is implemented in software.
///
/// # Panics
/// Without an adapter.
#[must_use]
#[allow(clippy::expect_used)]
pub fn device() -> GpuContext {
    let best = GpuContext::new(&AdapterChoice::Best).expect("a graphics adapter");
    let name = best.handles().1.get_info().name;
    GpuContext::new(&AdapterChoice::Named(name)).expect("the same adapter")
}

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
