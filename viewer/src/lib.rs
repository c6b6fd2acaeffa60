//! A window onto the people of a rig: receives the person stream, poses and draws the people itself, from wherever one likes.
//!
//! [`StreamPerson`] decodes one person, [`Scene`] draws, [`Receiver`] keeps both supplied from a rig, [`open_window`] shows them.

mod navigation;
mod painter;
mod person;
mod receiver;
mod scene;
mod window;

pub use navigation::Navigation;
pub use person::StreamPerson;
pub use receiver::{Receiver, ReceiverState};
pub use scene::Scene;
pub use window::{Screenshot, ViewOptions, ViewerError, open_window};
