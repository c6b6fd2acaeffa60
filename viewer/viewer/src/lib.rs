//! A window onto the people of a rig: receives the person stream, poses and draws the people itself, from wherever one likes.
//!
//! [`Receiver`] keeps the people of a rig, [`PeopleScene`] draws them, [`open_window`] shows them.

mod ellipsoids;
mod painter;
mod receiver;
mod scene;
mod shown_person;
mod window;

pub use receiver::{Receiver, ReceiverState, age_secs, clock_secs};
pub use scene::PeopleScene;
pub use shown_person::ShownPerson;
pub use window::{Screenshot, ViewOptions, ViewerError, open_window};
