//! HTML reports, plots, images, progress bars, logging, arguments and the Ctrl-C flag of the programs.

pub mod arguments;
mod contact;
mod html;
mod outlines;
pub mod plot;
pub mod png;
pub mod program;
mod progress;
pub mod stop;
mod trace;

pub use contact::contact_images;
pub use html::{ContactRow, Curve, Report, Table, write_whole};
pub use outlines::{outlined_inputs, outlined_view, paint_outline};
pub use progress::progress_bar;
pub use trace::traced;
