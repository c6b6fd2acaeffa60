//! The part of the web page that runs as WebAssembly: messages of the person stream in, Gaussians in drawing order out. The page
//! draws them itself (`viewer/web/assets/draw_webgpu.js`, `draw_webgl2.js`).
//!
//! [`Page`] is plain Rust, and tested as such; `exports.rs` gives it the plain interface that JavaScript calls. World coordinates are the
//! rig's, metres; times are seconds of the browser's clock.

#[cfg(target_arch = "wasm32")]
mod exports;
mod order;
mod page;

pub use order::DrawOrder;
pub use page::{CAMERA_FLOATS, MAX_MESSAGE_BYTES, Page, PageError, PageMessageKind};
