//! People of the person stream in a viewer, without window, network or graphics, so that it also builds for browsers.
//!
//! [`People`] ingests the messages and interpolates between motions; [`Navigation`] is the viewpoint; [`Ellipsoids`] holds the shapes of
//! avatars' Gaussians, without those that face away from the eye.
//!
//! The crate reads no clock: times are seconds of any clock that does not run backwards.
//!
//! ```
//! use std::sync::Arc;
//!
//! use flyrig_stream::{Motion, MotionEncoder, Stamp, StreamJoint, TemplateSource};
//! use flyrig_viewing::{Ingested, People};
//!
//! let rows = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];
//! let source = TemplateSource {
//!     joints: &[StreamJoint { parent: None, translation: [0.0; 3], joint_from_canonical: rows }],
//!     center_scale: &[[0.0, 0.0, 0.0, 0.01]],
//!     normals: &[[0.0, 0.0, 1.0]],
//!     skin: &[([0; 4], [1.0, 0.0, 0.0, 0.0])],
//!     node_weights: &[],
//!     nodes: &[],
//! };
//! let encoded = source.encode()?;
//! let mut encoder = MotionEncoder::new(&encoded);
//! let mut people = People::default();
//! // A person walks along x at 1 m/s, ten frames per second.
//! for frame in 0..5u64 {
//!     let stamp = Stamp { frame, capture_nanos: 100_000_000 * frame as i64, ..Stamp::default() };
//!     let root_translation = [0.1 * frame as f32, 0.0, 0.0];
//!     let motion = Motion { stamp, root_translation, joint_rotations: vec![[0.0, 0.0, 0.0, 1.0]], nodes: vec![] };
//!     let arrived = 0.1 * frame as f64;
//!     if let Ingested::Needs(hash) = people.ingest(0, true, &encoder.encode(&motion)?, arrived)? {
//!         assert_eq!(hash, encoded.template.hash);
//!         people.set_template(0, Arc::new(encoded.template.clone()));
//!     }
//! }
//! let shown = people.get(0).and_then(|person| person.motion_at(0.4, true));
//! // Interpolation shows the person one interval and a half late.
//! assert!(shown.is_some_and(|motion| (motion.root_translation[0] - 0.25).abs() < 2e-3));
//! # Ok::<(), flyrig_stream::StreamError>(())
//! ```

mod ellipsoids;
mod floor;
mod navigation;
mod people;
mod person;

pub use ellipsoids::{BACKFACING_COSINE, Ellipsoids, faces_away};
pub use floor::{Floor, SHADOW_SIDE};
pub use navigation::Navigation;
pub use people::{Ingested, MAX_PEOPLE, People};
pub use person::StreamPerson;
