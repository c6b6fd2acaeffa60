//! Escaping of text from other programs.

use std::borrow::Cow;

pub use flyrig_types::{MAX_PRINTABLE, printable};

/// Applies [`printable`] in place.
pub(crate) fn clean(text: &mut String) {
    if let Cow::Owned(safe) = printable(text) {
        *text = safe;
    }
}
