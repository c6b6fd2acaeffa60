//! Panics, caught.

use std::{
    any::Any,
    panic::{AssertUnwindSafe, catch_unwind},
};

/// Returns the text that a panic carries.
fn panic_text(panic: &(dyn Any + Send)) -> &str {
    panic.downcast_ref::<&str>().copied().or_else(|| panic.downcast_ref::<String>().map(String::as_str)).unwrap_or("?")
}

/// Runs a call. Everything that the call has touched must be whole after a panic, or dropped.
///
/// # Errors
/// The text of its panic.
pub fn caught<T>(call: impl FnOnce() -> T) -> Result<T, String> {
    catch_unwind(AssertUnwindSafe(call)).map_err(|panic| {
        let text = panic_text(&*panic).to_owned();
        // What the panic carries is somebody else's code too.
        let _ = catch_unwind(AssertUnwindSafe(|| drop(panic)));
        text
    })
}
