//! The web page on which browsers show the people of a rig, and its server.
//!
//! [`WebServer`] serves a page and a WebSocket. While somebody watches, one subscription to the rig feeds all browsers; what a browser
//! is too slow for is left out, newest first. The page decodes and poses people with the code of the window (`page/`, as WebAssembly)
//! and draws them with WebGL2. Off loopback it is served through HTTPS.
//!
//! A WebSocket message is a kind (0 rig, 1 template, 2 motion, 3 colours, 4 state, 5 forget), three zero bytes, a person's number (u32, little endian) and the payload. The browser
//! sends one text message, the token of its link.

mod assets;
mod config;
mod error;
mod guard;
mod hub;
mod server;
mod socket;
mod tls;
mod upstream;

pub use config::WebConfig;
pub use error::WebError;
pub use server::WebServer;
