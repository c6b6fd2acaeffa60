//! Web page on which browsers show the people of a rig, and its server.
//!
//! [`WebServer`] serves a page and a WebSocket. While browsers watch, one subscription to the rig feeds all of them; a browser that is too
//! slow misses the oldest messages. The page decodes and poses people with the code of the window (`viewer/page`, as WebAssembly) and draws
//! them with the rig's kernels through WebGPU, or with WebGL2. Off loopback it is served through HTTPS, and only links with a token are
//! admitted.
//!
//! A WebSocket message is a kind (0 rig, 1 template, 2 motion, 3 colours, 4 state, 5 forget), three zero bytes, the number of a person (u32,
//! little endian) and the payload. The browser sends one text message, the token of its link.
//!
//! [`TakePage`] is a page in one file that plays a stored take without a server.
//!
//! ```no_run
//! use flyrig_transport::TransportConfig;
//! use flyrig_web::{WebConfig, WebServer};
//!
//! let config = WebConfig { listen: "127.0.0.1:8080".to_owned(), ..WebConfig::default() };
//! let server = WebServer::start(&config, TransportConfig::subscriber("studio"))?;
//! println!("open {}", server.link());
//! # Ok::<(), flyrig_web::WebError>(())
//! ```

mod assets;
mod config;
mod error;
mod guard;
mod hub;
mod server;
mod socket;
mod take_page;
mod tls;
mod upstream;

pub use config::WebConfig;
pub use error::WebError;
pub use server::WebServer;
pub use take_page::TakePage;
