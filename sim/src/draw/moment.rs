//! Requests to the rasteriser: the people around an instant, the images to draw, and the results.

use bytemuck::{Pod, Zeroable};
use flyrig_types::Camera;
use glam::Vec3;

use crate::camera::optics::{OpticsConfig, SubFrame};
use crate::draw::figure::Figured;

/// People around an instant.
#[derive(Debug, Clone)]
pub(crate) struct Moment {
    /// Time of the first key from the instant, seconds, and keys per second; the keys are evenly spaced.
    pub first_secs: f64,
    pub keys_a_second: f64,
    pub people: Vec<Figured>,
    /// Bounding ball of all people at all keys.
    pub ball: (Vec3, f32),
    /// Bounding cylinder of each person.
    pub bounds: Vec<Bound>,
    pub capsules: Vec<ShadeCapsule>,
}

/// Image to render.
#[derive(Debug, Clone)]
pub(crate) struct ImageRequest {
    pub nanos: i64,
    pub camera: Camera,
    pub optics: OpticsConfig,
    /// Whether to render people; the plate otherwise.
    pub people: bool,
}

/// Linear light and coverage by the person, as halves.
pub(crate) type RawImage = Vec<[u16; 4]>;

/// Ground truth at pixel centres.
pub(crate) struct Truth {
    /// Canonical position and camera-space z.
    pub canonical_depth: Vec<[f32; 4]>,
    /// World normal; part index plus one, 0 where the person is not seen.
    pub normal_part: Vec<[f32; 4]>,
}

/// Part of a person that occludes the ambient light: a line with a radius, metres.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub(crate) struct ShadeCapsule {
    pub a: [f32; 3],
    pub radius: f32,
    pub b: [f32; 3],
    pub padding: f32,
}

/// Upright cylinder from the floor around a person, metres.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub(crate) struct Bound {
    pub center: [f32; 2],
    pub radius: f32,
    pub top: f32,
}

/// Step of a batch: one sub-frame of one requested image.
pub(crate) struct Step {
    pub secs: f64,
    pub take: usize,
    pub frame: SubFrame,
    pub first: bool,
    pub last: bool,
}

/// Lists all sub-frames, those of equal time together.
pub(crate) fn steps(takes: &[ImageRequest]) -> Vec<Step> {
    let mut steps: Vec<Step> = Vec::new();
    for (take, of) in takes.iter().enumerate() {
        let frames = of.optics.sub_frames();
        steps.extend(frames.into_iter().map(|frame| Step { secs: frame.secs, take, frame, first: false, last: false }));
    }
    steps.sort_by(|a, b| a.secs.total_cmp(&b.secs).then(a.take.cmp(&b.take)));
    for take in 0..takes.len() {
        if let Some(step) = steps.iter_mut().find(|step| step.take == take) {
            step.first = true;
        }
        if let Some(step) = steps.iter_mut().rfind(|step| step.take == take) {
            step.last = true;
        }
    }
    steps
}
