//! Panics as errors.

use std::{
    any::Any,
    panic::{AssertUnwindSafe, catch_unwind},
};

/// Returns the text that a panic carries.
fn panic_text(panic: &(dyn Any + Send)) -> &str {
    panic.downcast_ref::<&str>().copied().or_else(|| panic.downcast_ref::<String>().map(String::as_str)).unwrap_or("?")
}

/// Runs `call` and returns its result. After a panic, all state that the call has touched must be consistent, or be dropped.
///
/// # Errors
/// The panic's text.
pub fn caught<T>(call: impl FnOnce() -> T) -> Result<T, String> {
    catch_unwind(AssertUnwindSafe(call)).map_err(|panic| {
        let text = panic_text(&*panic).to_owned();
        // Dropping the payload runs foreign code, which may panic too.
        let _ = catch_unwind(AssertUnwindSafe(|| drop(panic)));
        text
    })
}
