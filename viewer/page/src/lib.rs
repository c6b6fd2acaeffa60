//! WebAssembly of the web page: messages of the person stream in, Gaussians in drawing order out. The page draws them in JavaScript
//! (`viewer/web/assets/draw_webgpu.js`, `draw_webgl2.js`).
//!
//! [`Page`] is plain Rust, and tested as such; `exports.rs` is the interface that JavaScript calls. World coordinates are the rig's, metres;
//! times are seconds of the browser's clock.
//!
//! ```
//! use flyrig_page::{Page, PageMessageKind};
//!
//! let mut page = Page::default();
//! assert!(page.ingest(PageMessageKind::Rig, 0, b"{}", 0.0).is_err(), "no rig");
//! assert_eq!((page.pose(0.0, true), page.people_shown()), ((false, false), 0));
//! ```

#[cfg(target_arch = "wasm32")]
mod exports;
mod order;
mod page;

pub use order::DrawOrder;
pub use page::{CAMERA_FLOATS, MAX_MESSAGE_BYTES, Page, PageError, PageMessageKind};
