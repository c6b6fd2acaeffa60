//! Health of a running rig: the metrics page, the table of cameras in the terminal, and the service manager's watchdog.

mod image_origin;
mod metrics_text;
mod monitor;
mod page_server;
mod rate_watch;
mod table;

pub use image_origin::ImageOrigin;
pub use monitor::{Arrivals, Monitor, ended_by_itself};
pub use page_server::PageServer;
pub use table::effort;
