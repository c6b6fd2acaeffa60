//! Fingers and the head's rotation, from landmark networks on crops around the wrists and the face.
//!
//! The body's pose is known already: it places a crop around each hand and the face in every view where they are large
//! enough. The landmarks of all views then bend the fingers of the template ([`hand_fit`]) and turn its head
//! ([`head_fit`]). Inferences are spread over frame sets ([`crop_schedule`]); a hand without a usable one is relaxed, and
//! the quality says so. Off by default in a live rig.

mod crop_schedule;
pub(crate) mod face_net;
mod face_points;
pub(crate) mod face_study;
mod hand_fit;
mod hand_model;
pub(crate) mod hand_net;
mod head_fit;
pub(crate) mod quality;
mod sight;
pub(crate) mod tracker;
