//! Progress bars.

use indicatif::{ProgressBar, ProgressStyle};

/// Returns a progress bar with rate, remaining time and a message.
#[must_use]
pub fn progress_bar(total: u64, what: impl Into<std::borrow::Cow<'static, str>>) -> ProgressBar {
    let style = ProgressStyle::with_template("{prefix} {bar:32} {pos}/{len} {per_sec} {eta} left {msg}")
        .unwrap_or_else(|_| ProgressStyle::default_bar());
    ProgressBar::new(total).with_style(style).with_prefix(what)
}
