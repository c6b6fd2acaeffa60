//! BVH motion clips.

use std::path::{Path, PathBuf};

use glam::{DQuat, DVec3};

use crate::BodyError;

/// Longest clip, frames; a longer one has a damaged header.
const MAX_FRAMES: usize = 10_000_000;

/// Degree of freedom that one number of a motion line drives.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BvhChannel {
    /// Translation along x, y, z (0, 1, 2), the clip's units.
    Position(usize),
    /// Rotation about x, y, z (0, 1, 2), degrees.
    Rotation(usize),
}

/// Joint of a clip.
#[derive(Debug, Clone, PartialEq)]
pub struct BvhJoint {
    /// Name.
    pub name: String,
    /// Index of the parent, smaller than the joint's own; `None` for the root.
    pub parent: Option<usize>,
    /// Position in the parent at rest, in the clip's units.
    pub offset: DVec3,
    /// Channels in the order of the motion lines; the first rotation is the outermost.
    pub channels: Vec<BvhChannel>,
    /// Position of the limb's end in this joint, where the file gives an end site.
    pub end_site: Option<DVec3>,
}

/// Motion clip: a skeleton and one line of numbers per frame. Lengths have no unit in BVH.
#[derive(Debug, Clone, PartialEq)]
pub struct BvhClip {
    /// File, for messages.
    pub path: PathBuf,
    /// Joints, parents first, the root at 0.
    pub joints: Vec<BvhJoint>,
    /// Time between frames, seconds.
    pub frame_secs: f64,
    /// Numbers of each frame: all joints' channels in order.
    pub frames: Vec<Vec<f64>>,
}

/// Joint in a frame: position and `parent_from_joint` rotation.
#[derive(Debug, Clone, Copy)]
pub(crate) struct BvhLocal {
    pub translation: DVec3,
    pub rotation: DQuat,
}

impl BvhClip {
    /// Returns the local transform of each joint in a frame; at rest where `frame` does not exist.
    pub(crate) fn locals(&self, frame: usize) -> Vec<BvhLocal> {
        let mut numbers = self.frames.get(frame).into_iter().flatten().copied();
        let local = |joint: &BvhJoint| {
            let mut local = BvhLocal { translation: joint.offset, rotation: DQuat::IDENTITY };
            let mut moved = None;
            for channel in &joint.channels {
                let number = numbers.next().unwrap_or(0.0);
                match *channel {
                    BvhChannel::Position(axis) => moved.get_or_insert(DVec3::ZERO)[axis] = number,
                    BvhChannel::Rotation(axis) => {
                        local.rotation *= DQuat::from_axis_angle(DVec3::AXES[axis], number.to_radians());
                    }
                }
            }
            // Position channels replace the offset.
            local.translation = moved.unwrap_or(local.translation);
            local
        };
        self.joints.iter().map(local).collect()
    }
}

/// Reads a BVH file.
///
/// # Errors
/// [`BodyError::Io`]; [`BodyError::Bvh`] names the line.
pub fn load_bvh(path: impl AsRef<Path>) -> Result<BvhClip, BodyError> {
    let path = path.as_ref();
    let bytes = std::fs::read(path).map_err(|source| BodyError::Io { path: path.into(), source })?;
    parse_bvh(&String::from_utf8_lossy(&bytes), path)
}

/// Reads BVH text; `path` is for messages.
///
/// # Errors
/// [`BodyError::Bvh`] names the line.
pub fn parse_bvh(text: &str, path: &Path) -> Result<BvhClip, BodyError> {
    let mut words = Words { path, line: 0, rest: Vec::new().into_iter(), lines: text.lines() };
    words.expect("HIERARCHY")?;
    words.expect("ROOT")?;
    let mut joints = vec![joint(&mut words, None)?];
    // The open braces: the joint they belong to.
    let mut open = vec![0];
    while let Some(&current) = open.last() {
        match words.next("a joint, an end site or '}'")?.to_ascii_uppercase().as_str() {
            "OFFSET" => joints[current].offset = words.vector()?,
            "CHANNELS" => joints[current].channels = channels(&mut words)?,
            "JOINT" => {
                let child = joint(&mut words, Some(current))?;
                if joints.iter().any(|known| known.name == child.name) {
                    return Err(words.fail(format!("a second joint is called '{}'", child.name)));
                }
                open.push(joints.len());
                joints.push(child);
            }
            "END" => {
                words.expect("SITE")?;
                words.expect("{")?;
                words.expect("OFFSET")?;
                joints[current].end_site = Some(words.vector()?);
                words.expect("}")?;
            }
            "}" => {
                open.pop();
            }
            other => return Err(words.fail(format!("'{other}' where a joint, an end site or '}}' should stand"))),
        }
    }
    words.expect("MOTION")?;
    words.expect("FRAMES:")?;
    let count = words.number()?;
    if !(count >= 1.0 && count <= MAX_FRAMES as f64 && count.fract() == 0.0) {
        return Err(words.fail(format!("{count} frames; a clip has 1 to {MAX_FRAMES}")));
    }
    words.expect("FRAME")?;
    words.expect("TIME:")?;
    let frame_secs = words.number()?;
    if !(1e-5..=10.0).contains(&frame_secs) {
        return Err(words.fail(format!("the frame time is {frame_secs} s; it must lie between 0.00001 and 10")));
    }
    let width: usize = joints.iter().map(|joint| joint.channels.len()).sum();
    if width == 0 {
        return Err(words.fail("no joint has channels, nothing moves".to_owned()));
    }
    let mut frames = Vec::new();
    for _ in 0..count as usize {
        frames.push((0..width).map(|_| words.number()).collect::<Result<Vec<_>, _>>()?);
    }
    Ok(BvhClip { path: path.into(), joints, frame_secs, frames })
}

fn joint(words: &mut Words<'_>, parent: Option<usize>) -> Result<BvhJoint, BodyError> {
    let name = words.next("a joint name")?.to_owned();
    words.expect("{")?;
    Ok(BvhJoint { name, parent, offset: DVec3::ZERO, channels: Vec::new(), end_site: None })
}

fn channels(words: &mut Words<'_>) -> Result<Vec<BvhChannel>, BodyError> {
    let count = words.number()?;
    if !(0.0..=6.0).contains(&count) || count.fract() != 0.0 {
        return Err(words.fail(format!("{count} channels; a joint has 0 to 6")));
    }
    let mut channels = Vec::new();
    for _ in 0..count as usize {
        let word = words.next("a channel name")?.to_ascii_lowercase();
        let axis = ["x", "y", "z"].iter().position(|axis| word.starts_with(axis));
        channels.push(match (axis, word.get(1..)) {
            (Some(axis), Some("position")) => BvhChannel::Position(axis),
            (Some(axis), Some("rotation")) => BvhChannel::Rotation(axis),
            _ => return Err(words.fail(format!("channel '{word}'; known are Xposition .. Zrotation"))),
        });
    }
    Ok(channels)
}

/// Words of a text with their line numbers.
struct Words<'a> {
    path: &'a Path,
    line: usize,
    rest: std::vec::IntoIter<&'a str>,
    lines: std::str::Lines<'a>,
}

impl<'a> Words<'a> {
    fn next(&mut self, wanted: &str) -> Result<&'a str, BodyError> {
        loop {
            if let Some(word) = self.rest.next() {
                return Ok(word);
            }
            let Some(line) = self.lines.next() else {
                return Err(self.fail(format!("the file ends where {wanted} should stand; it is cut off")));
            };
            self.line += 1;
            self.rest = line.split_whitespace().collect::<Vec<_>>().into_iter();
        }
    }

    fn expect(&mut self, wanted: &str) -> Result<(), BodyError> {
        let found = self.next(&format!("'{wanted}'"))?;
        match found.eq_ignore_ascii_case(wanted) {
            true => Ok(()),
            false => Err(self.fail(format!("'{found}' where '{wanted}' should stand"))),
        }
    }

    fn number(&mut self) -> Result<f64, BodyError> {
        let word = self.next("a number")?;
        match word.parse::<f64>() {
            Ok(number) if number.is_finite() => Ok(number),
            _ => Err(self.fail(format!("'{word}' where a finite number should stand"))),
        }
    }

    fn vector(&mut self) -> Result<DVec3, BodyError> {
        Ok(DVec3::new(self.number()?, self.number()?, self.number()?))
    }

    fn fail(&self, message: String) -> BodyError {
        BodyError::Bvh { path: self.path.into(), line: self.line.max(1), message }
    }
}
