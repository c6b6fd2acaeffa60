//! Learning of the person while the rig runs: an avatar is fitted to frame sets of the past, and the person is made of it where that
//! shows views better that it was not fitted to.
//!
//! [`key_sets`] chooses frame sets that show new poses and sides. [`workshop`] fits the avatar to three of four of them in rounds of
//! bounded length; [`judge`] compares it with the person in use on the others, each of their cameras held out in turn. [`person_learner`]
//! connects a session with its workshop, in place or in a thread beside it.

mod judge;
pub(crate) mod key_sets;
pub(crate) mod person_learner;
mod thread;
pub(crate) mod workshop;
