//! People of the stream as a viewer has them, without a window, network or graphics, so that it also builds for browsers.
//!
//! [`People`] takes the messages in and interpolates between motions; [`Navigation`] is where the viewer stands; [`Ellipsoids`] holds the
//! shapes of avatars' Gaussians as an eye sees them.
//!
//! The crate reads no clock: times are seconds of any clock that does not run backwards.

mod ellipsoids;
mod navigation;
mod people;
mod person;

pub use ellipsoids::{BACKFACING_COSINE, Ellipsoids, faces_away};
pub use navigation::Navigation;
pub use people::{MAX_PEOPLE, People, Taken};
pub use person::StreamPerson;
