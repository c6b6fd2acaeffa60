//! Window onto the people of a rig: receives the person stream, and poses and draws the people from any viewpoint.
//!
//! [`Receiver`] keeps the people of a rig, [`PeopleScene`] draws them, [`open_window`] shows them.
//!
//! ```no_run
//! use flyrig_transport::TransportConfig;
//! use flyrig_viewer::Receiver;
//!
//! let receiver = Receiver::start(&TransportConfig::subscriber("studio"), || println!("a motion arrived"))?;
//! std::thread::sleep(std::time::Duration::from_secs(2));
//! let state = receiver.state();
//! println!("{} people", state.people.iter().count());
//! # drop(state);
//! # Ok::<(), flyrig_transport::TransportError>(())
//! ```

mod ellipsoids;
mod painter;
mod receiver;
mod scene;
mod shown_person;
mod window;

pub use receiver::{Receiver, ReceiverState, age_secs, clock_secs};
pub use scene::PeopleScene;
pub use shown_person::ShownPerson;
pub use window::{Screenshot, ViewOptions, ViewerError, check_desktop, open_window};
