//! Recordings of other programs: images, calibrations and coordinate frames in foxglove's and ROS's schemas.
//!
//! [`foreign_cameras`] reads a file once and maps its topics to cameras; [`crate::McapReplay`] then reads the images of a
//! topic.

mod lens;
#[cfg(test)]
mod tests;
mod topics;
mod transforms;

use std::{collections::BTreeMap, path::Path};

use flyrig_types::{CameraId, Intrinsics, Isometry, shortened};
use glam::DVec3;
use mcap::Message;

use self::{
    lens::Projection,
    topics::PairedTopic,
    transforms::{Frames, Poses},
};
use super::{
    message,
    messages::cause,
    parts::Parts,
    reader::{FrameTimes, RecordedCamera, not_readable},
    schemas::{Kind, LensMessage, Schema},
};
use crate::error::{CaptureError, CaptureErrorKind};

/// Largest difference between the spans of two cameras' timestamps that may still be of one clock, nanoseconds.
const MOST_APART_NANOS: i64 = 10_000_000_000;
/// Most topics that an error lists.
const MOST_LISTED: usize = 8;

/// Cameras of a recording by another program.
#[derive(Debug, Clone, PartialEq)]
pub struct ForeignCameras {
    /// Cameras in the order of their names.
    pub cameras: Vec<ForeignCamera>,
    /// Direction against gravity in the world of the poses, where it is known.
    pub up: Option<DVec3>,
    /// Reason why some camera has no lens or no pose; `None` if all have both.
    pub lacks: Option<String>,
    /// Parts of the file that were left out or read in a way of their own, one text each.
    pub notes: Vec<String>,
}

/// Camera of a recording by another program.
#[derive(Debug, Clone, PartialEq)]
pub struct ForeignCamera {
    /// Name, and where its images are.
    pub images: RecordedCamera,
    /// Lens and sensor, where the file has them.
    pub intrinsics: Option<Intrinsics>,
    /// Pose, where the file has those of all cameras.
    pub camera_from_world: Option<Isometry>,
}

/// Reads which cameras a recording of another program has, with their calibration. Reads the file to its end.
///
/// # Errors
/// `NotFound` if the file is missing, `Corrupt` when it is no MCAP file, `Unsupported` when it has no images that can be
/// read; names the topics with the reason of each.
pub fn foreign_cameras(path: &Path) -> Result<ForeignCameras, CaptureError> {
    let scan = Scan::read(path)?;
    let chosen = scan.choose(path)?;
    Ok(scan.cameras(&chosen))
}

/// Times of a topic's messages, nanoseconds.
#[derive(Debug, Clone, Copy)]
struct Times {
    first: i64,
    last: i64,
    /// Messages whose time was not later than the one before, or was missing.
    disordered: usize,
}

impl Times {
    fn add(times: &mut Option<Self>, nanos: i64) {
        let times = times.get_or_insert(Self { first: nanos, last: i64::MIN, disordered: 0 });
        if nanos > times.last && nanos > 0 {
            times.first = if times.last == i64::MIN { nanos } else { times.first };
            times.last = nanos;
        } else {
            times.disordered += 1;
        }
    }

    /// Returns whether frames can have these times: all but one in a hundred, which are left out.
    fn are_usable(&self, frames: usize) -> bool {
        self.disordered * 100 <= frames
    }
}

/// Images of a topic.
#[derive(Debug)]
struct ImageTopic {
    frames: usize,
    frame_id: String,
    /// Size of the first image, or why it cannot be read.
    size: Result<(u32, u32), String>,
    stamped: Option<Times>,
}

/// Topics of a file that concern cameras.
#[derive(Debug, Default)]
struct Scan {
    images: BTreeMap<String, ImageTopic>,
    lenses: BTreeMap<String, Result<LensMessage, String>>,
    frames: Frames,
    /// Topics of cameras that are not read, with the reason.
    refused: BTreeMap<String, String>,
    /// Number of all other topics.
    others: BTreeMap<String, ()>,
}

impl Scan {
    fn read(path: &Path) -> Result<Self, CaptureError> {
        let mut scan = Self::default();
        let mut is_empty = true;
        for message in Parts::open(path)? {
            match message {
                Ok(message) => scan.add(message),
                Err(error) if is_empty => return Err(not_readable(path, &error)),
                Err(error) => {
                    tracing::warn!("{} breaks off: {}", path.display(), cause(&error));
                    break;
                }
            }
            is_empty = false;
        }
        Ok(scan)
    }

    fn add(&mut self, message: Message<'static>) {
        let topic = message.channel.topic.as_str();
        let schema = match Schema::of(&message.channel) {
            Some(Ok(schema)) => schema,
            Some(Err(reason)) => {
                self.refused.entry(topic.to_owned()).or_insert(reason);
                return;
            }
            None => {
                self.others.entry(topic.to_owned()).or_default();
                return;
            }
        };
        let (channel, data) = (message.channel, message.data.into_owned());
        let topic = &channel.topic;
        match schema.kind() {
            Kind::CompressedImage | Kind::RawImage => self.add_image(topic, schema, data),
            Kind::Lens => {
                // The first valid one holds: calibrations are repeated with every image.
                if !self.lenses.get(topic).is_some_and(Result::is_ok) {
                    self.lenses.insert(topic.clone(), schema.lens(data));
                }
            }
            Kind::Link | Kind::Links => match schema.links(data) {
                Ok(links) => links.into_iter().for_each(|link| self.frames.add(link)),
                Err(reason) => drop(self.refused.entry(topic.clone()).or_insert(reason)),
            },
            Kind::Video => {}
        }
    }

    fn add_image(&mut self, topic: &str, schema: Schema, data: Vec<u8>) {
        let image = schema.image(data);
        let stamp_nanos = image.as_ref().map_or(0, |image| image.stamp_nanos);
        let known = self.images.entry(topic.to_owned()).or_insert_with(|| ImageTopic {
            frames: 0,
            frame_id: String::new(),
            size: Err(String::new()),
            stamped: None,
        });
        known.frames += 1;
        match image {
            Ok(image) => {
                Times::add(&mut known.stamped, stamp_nanos);
                if known.size.is_err() {
                    known.frame_id.clone_from(&image.frame_id);
                    let camera = CameraId::from(shortened(topic).as_ref());
                    let decoded = message::to_image(&camera, image);
                    known.size = decoded.map(|i| (i.width(), i.height())).map_err(|error| error.message);
                }
            }
            Err(reason) if known.size.is_err() => known.size = Err(reason),
            // A damaged message among others; the replay leaves it out.
            Err(_) => {}
        }
    }

    /// Chooses one topic of images per camera: unrectified before rectified, colour before grey, then raw images.
    fn choose(&self, path: &Path) -> Result<Vec<Chosen<'_>>, CaptureError> {
        let mut best: BTreeMap<Vec<&str>, &str> = BTreeMap::new();
        let rank = |topic: &str| {
            let parts = topics::parts(topic);
            let is = |word: &str| parts.iter().any(|part| part.contains(word));
            (topics::is_rectified(topic), is("mono"), is("compressed"), topic.len())
        };
        for (topic, _) in self.images.iter().filter(|(_, found)| found.size.is_ok()) {
            let chosen = best.entry(topics::base(topic)).or_insert(topic);
            if rank(topic) < rank(chosen) {
                *chosen = topic;
            }
        }
        if best.is_empty() {
            return Err(self.no_images(path));
        }
        let bases: Vec<Vec<&str>> = best.keys().cloned().collect();
        let named = topics::names(&bases).into_iter().zip(best.values());
        let mut chosen: Vec<Chosen<'_>> = Vec::new();
        for (name, topic) in named {
            let refused = |text: String| {
                let text = format!("{}: topic '{}': {text}", path.display(), shortened(topic));
                CaptureError::general(CaptureErrorKind::Unsupported, text)
            };
            let id = CameraId::from(name);
            id.check().map_err(|error| refused(error.to_string()))?;
            if let Some(other) = chosen.iter().find(|other| other.id == id) {
                let text = format!("gives the camera name {id}, as does '{}'; rename one", shortened(other.topic));
                return Err(refused(text));
            }
            let Some(images) = self.images.get(*topic) else { continue };
            let size = images.size.clone().unwrap_or_default();
            chosen.push(Chosen { id, topic, images, size });
        }
        chosen.sort_by(|a, b| a.id.cmp(&b.id));
        Ok(chosen)
    }

    fn no_images(&self, path: &Path) -> CaptureError {
        let unread = self.images.iter().filter_map(|(topic, found)| Some((topic, found.size.as_ref().err()?)));
        let mut reasons: Vec<String> = unread
            .chain(&self.refused)
            .map(|(topic, reason)| format!("topic '{}': {}", shortened(topic), shortened(reason)))
            .collect();
        let others = self.others.keys().map(|topic| format!("'{}'", shortened(topic))).take(MOST_LISTED);
        let others = others.collect::<Vec<_>>().join(", ");
        let count = reasons.len();
        reasons.truncate(MOST_LISTED);
        let found = match (count, others.is_empty()) {
            (0, true) => "it has no messages".to_owned(),
            (0, false) => format!("it has the topics {others}"),
            (count, _) if count > MOST_LISTED => format!("{} and {} more", reasons.join("; "), count - MOST_LISTED),
            _ => reasons.join("; "),
        };
        let text = format!(
            "{}: names no cameras and holds no images that can be read; it is no recording of flyrig's, nor one of \
             foxglove's or ROS's images: {found}",
            path.display()
        );
        CaptureError::general(CaptureErrorKind::Unsupported, text)
    }

    fn cameras(&self, chosen: &[Chosen<'_>]) -> ForeignCameras {
        let mut notes = self.left_out(chosen);
        let times = times(chosen, &mut notes);
        let mut lacks = Vec::new();
        let projections = self.projections(chosen, &mut lacks);
        let frames: Vec<&str> = projections.iter().map(|(_, frame_id)| frame_id.as_str()).collect();
        let poses = if self.frames.is_empty() {
            Err("it has no transforms (topic /tf_static)".to_owned())
        } else {
            self.frames.poses(&frames)
        };
        let Poses { frame_from_world, up } = poses.unwrap_or_else(|reason| {
            lacks.push(format!("the cameras have no poses: {reason}"));
            Poses { frame_from_world: Vec::new(), up: None }
        });
        let camera = |(slot, chosen): (usize, &Chosen<'_>)| {
            let projection = projections[slot].0;
            let pose = frame_from_world.get(slot).zip(projection);
            ForeignCamera {
                images: RecordedCamera { id: chosen.id.clone(), topic: chosen.topic.to_owned(), times },
                intrinsics: projection.map(|projection| projection.intrinsics),
                camera_from_world: pose.map(|(pose, projection)| projection.pose(*pose)),
            }
        };
        let cameras = chosen.iter().enumerate().map(camera).collect();
        ForeignCameras { cameras, up, lacks: (!lacks.is_empty()).then(|| lacks.join("; ")), notes }
    }

    /// Returns the projection of each camera, where the file has one, and its coordinate frame.
    fn projections(&self, chosen: &[Chosen<'_>], lacks: &mut Vec<String>) -> Vec<(Option<Projection>, String)> {
        let of_camera = |chosen: &Chosen<'_>| (chosen.topic.to_owned(), chosen.images.frame_id.clone());
        let of_lens = |(topic, lens): (&String, &Result<LensMessage, String>)| {
            (topic.clone(), lens.as_ref().map_or_else(|_| String::new(), |lens| lens.frame_id.clone()))
        };
        let cameras: Vec<_> = chosen.iter().map(of_camera).collect();
        let lenses: Vec<_> = self.lenses.iter().map(of_lens).collect();
        let paired =
            |(topic, frame_id): &'_ (String, String), name: &'_ str| (topic.clone(), frame_id.clone(), name.to_owned());
        let named: Vec<_> = cameras.iter().zip(chosen).map(|(c, chosen)| paired(c, chosen.id.as_str())).collect();
        let unnamed: Vec<_> = lenses.iter().map(|lens| paired(lens, "")).collect();
        fn view(all: &[(String, String, String)]) -> Vec<PairedTopic<'_>> {
            all.iter().map(|(topic, frame_id, name)| PairedTopic { topic, frame_id, name }).collect()
        }
        let pairs = topics::pair(&view(&named), &view(&unnamed));
        let mut projections = Vec::new();
        for (chosen, pair) in chosen.iter().zip(pairs) {
            let message = pair.and_then(|i| self.lenses.values().nth(i));
            let projection = match message {
                None => Err("the file has no calibration (CameraInfo, CameraCalibration) of it".to_owned()),
                Some(Err(reason)) => Err(format!("its calibration is damaged: {reason}")),
                Some(Ok(message)) => lens::projection(message, chosen.size, topics::is_rectified(chosen.topic)),
            };
            let frame_id = message.and_then(|lens| lens.as_ref().ok()).map(|lens| lens.frame_id.clone());
            let frame_id = frame_id.filter(|id| !id.is_empty()).unwrap_or_else(|| chosen.images.frame_id.clone());
            if let Err(reason) = &projection {
                lacks.push(format!("camera {} has no lens: {reason}", chosen.id));
            }
            projections.push((projection.ok(), frame_id));
        }
        projections
    }

    /// Names the topics of images that are not read.
    fn left_out(&self, chosen: &[Chosen<'_>]) -> Vec<String> {
        let note = |(topic, found): (&String, &ImageTopic)| match &found.size {
            Err(reason) => Some(format!("topic '{}' is left out: {}", shortened(topic), shortened(reason))),
            Ok(_) if chosen.iter().all(|chosen| chosen.topic != topic) => {
                let base = topics::base(topic);
                let taken = chosen.iter().find(|chosen| topics::base(chosen.topic) == base)?;
                let taken = shortened(taken.topic);
                Some(format!("topic '{}' is left out: '{taken}' has the same camera's images", shortened(topic)))
            }
            Ok(_) => None,
        };
        let refused = self.refused.iter();
        let refused = refused.map(|(topic, why)| format!("topic '{}' is left out: {why}", shortened(topic)));
        self.images.iter().filter_map(note).chain(refused).collect()
    }
}

/// Topic that was chosen for a camera.
#[derive(Debug)]
struct Chosen<'a> {
    id: CameraId,
    topic: &'a str,
    images: &'a ImageTopic,
    size: (u32, u32),
}

/// Decides which times the frames get: those in the images' headers, unless they are of no use as times of one clock.
fn times(chosen: &[Chosen<'_>], notes: &mut Vec<String>) -> FrameTimes {
    let mut fall_back = |why: String| {
        notes.push(format!("frames have the times at which they were recorded: {why}"));
        FrameTimes::Logged
    };
    let mut spans = Vec::new();
    for chosen in chosen {
        match chosen.images.stamped.filter(|times| times.are_usable(chosen.images.frames)) {
            Some(times) => spans.push(times),
            None => return fall_back(format!("the timestamps of camera {} do not increase", chosen.id)),
        }
    }
    let latest = spans.iter().map(|times| times.first).max().unwrap_or(0);
    let earliest = spans.iter().map(|times| times.last).min().unwrap_or(0);
    if latest.saturating_sub(earliest) > MOST_APART_NANOS {
        return fall_back("the cameras' timestamps are of different clocks".to_owned());
    }
    FrameTimes::Stamped
}
