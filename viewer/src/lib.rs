//! A window onto the people of a rig: receives the person stream, poses and draws the people itself, from wherever one likes.
//!
//! [`StreamPerson`] decodes one person, [`Scene`] draws, [`Receiver`] keeps both supplied from a rig, [`open_window`] shows them.

mod person;
mod scene;

pub use person::StreamPerson;
pub use scene::Scene;
